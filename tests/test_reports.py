"""Reports: one result, rendered in many ways, and what hostile text cannot do."""

import copy
import io
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from html_document import Document
from report_data import ABSENT, ADAPTER, CHECKS, ERROR, FAIL, HOSTILE, PASS, adapter, make
from rich.console import Console

from conformance.case import Setting
from conformance.cli import main
from conformance.execute import run_check
from conformance.offered import offered, unchecked
from conformance.pages import prose, tex
from conformance.reports import badge, html, junit, markdown, summary, terminal
from conformance.requirements import check_label, requirements
from conformance.results import read


@pytest.fixture(scope="module")
def data() -> dict[str, Any]:
    return make()


@pytest.fixture(scope="module")
def hostile() -> dict[str, Any]:
    """Every text that an implementation or a file can bring in."""
    made = make(reasons={FAIL: HOSTILE})
    made["candidate"] = made["device"] = made["implementation"]["name"] = made["implementation"]["edition"] = made[
        "edition"
    ] = HOSTILE
    made["fit"] = {
        "editions": [{"edition": HOSTILE, "passed": 1, "judged": 2, "offered": 3}],
        "alike": [HOSTILE],
        "better": HOSTILE,
    }
    made["verdict"]["problems"] = [HOSTILE]
    made["versions"][HOSTILE] = HOSTILE
    made["diagnoses"][0] |= dict.fromkeys(("mutant", "explanation", "provenance", "chapter", "fix"), HOSTILE)
    for check in made["checks"].values():
        check["message"] = check["where"] = HOSTILE
        if check["failure"]:
            check["failure"] |= {"command": HOSTILE, "snippet": HOSTILE}
            check["failure"]["arguments"] = [{"name": HOSTILE, "type": HOSTILE, "text": HOSTILE, "whole": True}]
    for entry in made["requirements"].values():
        entry["where"] = HOSTILE
    made["checks"][f"{HOSTILE}.{HOSTILE}"] = made["checks"][ERROR]
    return made


def shown(data: Mapping[str, Any]) -> str:
    console = Console(file=io.StringIO(), width=150)
    terminal.show(console, data)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_shares() -> None:
    shares = {None: "not measurable", 0.0: "0%", 0.344: "34%", 9.5: "950%", 123.4: "123×", 3.21e14: "3e14×"}
    assert {share: summary.percent(share) for share in shares} == shares


def test_a_run_prints_its_seed_and_version(data: dict[str, Any]) -> None:
    assert "seed 3, 5 examples, dreamer-spec" in shown(data)
    assert summary.settings({**data, "versions": {"dreamer-spec": "9.9"}}).endswith("dreamer-spec 9.9")


# --- The renderings
# ------------------------------------------------------------------------------


def test_the_terminal(data: dict[str, Any]) -> None:
    text = shown(data)
    assert "failed: 2 checks fail\n" in text
    assert "4 checks, " in text
    assert "1 pass, 1 fail, 1 error, 1 not offered" in text
    assert "behaves like return_bootstraps_from_itself" in text
    assert "known from: the paper's printed indices" in text
    assert "RuntimeError: out of order" in text
    assert data["checks"][FAIL]["failure"]["command"] in text
    assert "  lambda_return, called with\n    reward = [[9.0, 1.0, 0.0, 2.0]]\n" in text
    assert "--html" not in text
    assert len(text.splitlines()) < 65


def test_without_a_diagnosis_the_reports_say_so(
    data: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(ADAPTER, encoding="utf-8")
    check = [
        "check",
        str(tmp_path / "mine.py"),
        "--edition",
        "paper",
        "--only",
        FAIL,
        "--json",
        str(tmp_path / "r.json"),
    ]
    assert main([*check, "--no-diagnosis"]) == 1
    printed = capsys.readouterr().out
    made = read(tmp_path / "r.json")
    assert made["diagnoses"] is None
    told = "No diagnosis was made (--no-diagnosis)."
    for text in (printed, html.render([made]), html.render([data, made])):
        assert told in text
    assert told.replace("_", "\\_") in markdown.render(made)
    assert junit.render(made).count("<failure") == 2
    for text in (printed, markdown.render(made), junit.render(made)):
        assert "behaves like" not in text.lower()
    assert told not in shown(data)


def test_what_no_mistake_explains_is_said(data: dict[str, Any]) -> None:
    failing = [name for name, check in data["checks"].items() if check["status"] in ("fail", "error")]
    explained = {name for diagnosis in data["diagnoses"] for name in diagnosis["explained"]}
    left = [name for name in failing if name not in explained]
    without = {**data, "diagnoses": []}
    told = f"No known mistake fits {', '.join(failing)}."
    for text in (html.render([without]), shown(without)):
        assert told in text
    assert ("No known mistake fits" in shown(data)) == bool(left)


def test_markdown(data: dict[str, Any]) -> None:
    text = markdown.render(data)
    assert text.startswith("# Conformance of mine 1.2\n\n**Failed: 2 checks fail.**")
    assert "Known from: the paper's printed indices." in text
    assert "- **return\\_bootstraps\\_from\\_itself**" in text
    assert f"```python\n{data['checks'][FAIL]['failure']['snippet']}\n```" in text
    assert "| `reward` | float64 \\[1, 4\\] | `[[9.0, 1.0, 0.0, 2.0]]` |" in text
    assert "07 Returns (`spec/07-returns.md`)" in text


def test_a_check_of_ten_requirements_judges_them_jointly(data: dict[str, Any]) -> None:
    ids = [f"RET-{n}" for n in range(1, 15)]
    assert check_label("losses.actor_matches", ids) == "losses.actor_matches (jointly with 13 others)"
    assert check_label("losses.actor_matches", ids[:10]) == "losses.actor_matches (jointly with 9 others)"
    assert check_label("losses.actor_matches", ids[:9]) == "losses.actor_matches"
    joint = copy.deepcopy(data)
    joint["checks"][FAIL]["requirements"] = ids
    for shown_there in (markdown.render(joint), Document(html.render([joint, joint])).text):
        assert "returns.lambda_return_literals (jointly with 13 others)" in shown_there
    line = "| RET-1 | fail | `returns.lambda_return_literals (jointly with 13 others)` |"
    assert line in markdown.render(joint).splitlines()


def test_junit(data: dict[str, Any]) -> None:
    root = ElementTree.fromstring(junit.render(data).encode())
    cases = {f"{case.get('classname')}.{case.get('name')}": case for case in root.iter("testcase")}
    kinds = {name: [child.tag for child in case] for name, case in cases.items()}
    assert kinds == {
        f"conformance.{PASS}": [],
        f"conformance.{FAIL}": ["failure"],
        f"conformance.{ERROR}": ["error"],
        f"conformance.{ABSENT}": ["skipped"],
        "conformance.verdict.verdict": ["failure"],
    }
    failure = cases[f"conformance.{FAIL}"][0]
    assert failure.get("message") == data["checks"][FAIL]["message"]
    assert data["checks"][FAIL]["failure"]["snippet"] in str(failure.text)
    assert cases[f"conformance.{ERROR}"][0].get("message") == "RuntimeError: out of order"
    suites = {suite.get("name"): suite for suite in root}
    assert (suites["layers"].get("tests"), suites["layers"].get("errors"), suites["layers"].get("skipped")) == (
        "2",
        "1",
        "1",
    )
    (seed,) = [entry.get("value") for entry in suites["layers"].iter("property") if entry.get("name") == "seed"]
    assert seed == "3"


def test_junit_skips_expected_failures() -> None:
    root = ElementTree.fromstring(junit.render(make((PASS, FAIL), {FAIL: "as printed"})).encode())
    assert [entry.get("message") for entry in root.iter("skipped")] == ["expected failure: as printed"]
    assert not list(root.iter("failure"))


def test_the_badge(data: dict[str, Any]) -> None:
    assert badge.outcome(data) == ("2 of 3 checks fail", badge.RED)
    assert badge.outcome(make((PASS,))) == ("1 check passes", badge.GREEN)
    assert badge.outcome(make((PASS, FAIL), {FAIL: "x"})) == ("1 of 2 checks", badge.YELLOW)
    assert badge.outcome(make((ABSENT,))) == ("nothing offered", badge.GREY)
    assert badge.outcome(make((PASS,), at_least=2)) == ("failing", badge.RED)
    assert ElementTree.fromstring(badge.render(data)).get("aria-label") == "DreamerV3 conformance: 2 of 3 checks fail"


def test_the_verdict_in_words() -> None:
    assert summary.outcome(make((PASS,))) == "Conforms in what it offers"
    assert summary.outcome(make((PASS, FAIL))) == "Does not conform"
    at_extremes = make((PASS, FAIL))
    at_extremes["checks"][FAIL]["extreme"] = True
    assert summary.outcome(at_extremes) == "Conforms with ordinary input only"
    assert summary.outcome(make((PASS,), at_least=2)) == "Does not conform"


def test_the_page(data: dict[str, Any]) -> None:
    document = Document(html.render([data]))
    assert "1 of 3 offered checks pass" in document.text
    assert "Does not conform" in document.text
    assert data["checks"][FAIL]["failure"]["snippet"] in document.text
    assert "Behaves like return_bootstraps_from_itself" in document.text
    targets = {attributes["id"] for _, attributes in document.elements if "id" in attributes}
    links = [str(attributes["href"]) for tag, attributes in document.elements if tag == "a"]
    assert links
    assert {link.removeprefix("#") for link in links} <= targets


def test_the_page_needs_nothing_else(data: dict[str, Any]) -> None:
    document = Document(html.render([data]))
    (policy,) = [attributes["content"] for _, attributes in document.elements if "http-equiv" in attributes]
    assert policy == "default-src 'none'; style-src 'unsafe-inline'"
    assert not {tag for tag, _ in document.elements} & {"script", "link", "img", "iframe", "object", "form"}
    assert not [
        name for _, attributes in document.elements for name in attributes if name.startswith("on") or name == "src"
    ]
    assert "prefers-color-scheme: dark" in document.text


def test_a_page_of_several(data: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = make((PASS, "transforms.symexp_matches"))
    other |= {
        "implementation": {"name": "other", "version": "", "edition": "official", "offered": []},
        "edition": "2024-12",
        "choice": "claimed",
    }
    paths = []
    for name, result in (("a", data), ("b", other)):
        paths.append(str(tmp_path / f"{name}.json"))
        Path(paths[-1]).write_text(json.dumps(result), encoding="utf-8")
    assert main(["report", *paths, "--out", str(tmp_path / "page.html")]) == 0
    document = Document((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert "Failures: mine 1.2" in document.text
    assert "Failures: other" not in document.text
    assert "Judged as the edition 2024-12 (the authors' code since December 2024), as it claims." in document.text
    assert main(["report", str(tmp_path / "page.html")]) == 2
    assert capsys.readouterr().err.startswith("conformance: error: ")


def test_two_runs_of_one_implementation_are_told_apart(data: dict[str, Any]) -> None:
    text = Document(html.render([data, {**data, "dtype": "float32"}])).text
    assert "mine 1.2 float64, paper" in text
    assert "mine 1.2 float32, paper" in text


def test_what_is_alike_in_several_results_is_told_apart(data: dict[str, Any]) -> None:
    other = {**data, "implementation": {**data["implementation"], "version": "1.3"}}
    paper, half = {**data, "edition": "paper"}, {**data, "dtype": "float32"}
    assert summary.names([paper, other], ["a", "b"]) == ["mine 1.2", "mine 1.3"]
    found = summary.names([paper, half, paper, other], ["a", "b", "c", "d"])
    assert found == ["mine 1.2 float64, paper, a", "mine 1.2 float32, paper", "mine 1.2 float64, paper, c", "mine 1.3"]


# --- What fails only with extreme input
# ------------------------------------------------------------------------------


@pytest.fixture
def extreme(data: dict[str, Any]) -> dict[str, Any]:
    """The failure that a mistake explains is one with extreme input; the error is none."""
    return {**data, "checks": {**data["checks"], FAIL: {**data["checks"][FAIL], "extreme": True}}}


def test_failures_are_ordered(data: dict[str, Any], extreme: dict[str, Any]) -> None:
    found = summary.failures(data)
    assert [name for name, _ in found.ordinary] == [FAIL, ERROR]  # the explained one first
    assert summary.headline(data) == "failed: 2 checks fail"
    found = summary.failures(extreme)
    assert ([name for name, _ in found.ordinary], [name for name, _ in found.extreme]) == ([ERROR], [FAIL])
    assert summary.headline(extreme) == "failed: 1 check fails, 1 more only with extreme input"
    assert summary.status(extreme, "RET-1") == "fail at extremes"
    only = {**extreme, "checks": {FAIL: extreme["checks"][FAIL]}}
    assert summary.headline(only) == "failed: 1 check fails, only with extreme input"
    expected = make((FAIL, ERROR), {FAIL: "as printed"}, at_least=9)
    assert [name for name, _ in summary.failures(expected).expected] == [FAIL]
    assert summary.problems(expected) == ["1 check fails", "0 checks passed, and at least 9 must"]


def test_extreme_failures_come_under_a_heading(extreme: dict[str, Any]) -> None:
    for text in (shown(extreme), markdown.render(extreme), Document(html.render([extreme])).text):
        command, heading = extreme["checks"][FAIL]["failure"]["command"], "Only with extreme input"
        assert text.index(extreme["checks"][ERROR]["failure"]["command"]) < text.index(heading) < text.index(command)
    boxes = [
        attributes
        for _, attributes in Document(html.render([extreme])).elements
        if "failure-0" in str(attributes.get("id"))
    ]
    assert {box["id"]: "open" in box for box in boxes} == {f"failure-0-{ERROR}": True, f"failure-0-{FAIL}": False}


def test_the_terminal_names_what_it_does_not_show(data: dict[str, Any]) -> None:
    many = {**data, "checks": {**data["checks"], **{f"layers.copy_{n}": data["checks"][ERROR] for n in range(5)}}}
    assert "and 2 more: layers.copy_3, layers.copy_4" in shown(many)
    assert shown(many).endswith("\neverything in full: --html FILE\n")


def test_a_traceback_comes_last_and_folded(data: dict[str, Any]) -> None:
    message = data["checks"][ERROR]["message"]
    assert message.startswith("Traceback")
    assert summary.cause(message) == "RuntimeError: out of order"
    assert summary.cause("a: got 1\n  expected 2\n") == "a: got 1\n  expected 2"
    page = html.render([data])
    assert "<pre>RuntimeError: out of order</pre>" in page
    assert page.index("See it again") < page.index("<details><summary>Traceback</summary><pre>Traceback")


# --- What was not judged
# ------------------------------------------------------------------------------


def test_offered_but_not_checked() -> None:
    made = adapter("def mse_loss(prediction, target): ...\ndef symlog(x): return x")
    results = [
        run_check(CHECKS[name], made, Setting("float64", "paper", examples=1))
        for name in ("distributions.squared_errors_match", PASS)
    ]
    assert offered(made) == ["symlog", "mse_loss"]
    assert unchecked(offered(made), results) == [{"function": "mse_loss", "needs": ["symlog_mse_loss"]}]
    data = {**make(), "unchecked": unchecked(offered(made), results)}
    line = "Offered but not checked: mse_loss (needs symlog_mse_loss)."
    assert line in shown(data)
    assert line in Document(html.render([data])).text
    assert line.replace("_", "\\_") in markdown.render(data)


def test_what_is_not_implemented_is_told_once() -> None:
    data = make()
    for name in ("transforms.symlog_matches", "transforms.symexp_matches"):
        data["checks"][name] = {
            **data["checks"][PASS],
            "status": "not offered",
            "message": "not implemented: symlog (negative numbers)",
        }
    line = "Not implemented, as the candidate says: symlog (negative numbers)."
    assert shown(data).count(line) == 1
    assert line in Document(html.render([data])).text
    assert line in markdown.render(data)


def test_cells_say_what_was_not_offered(data: dict[str, Any]) -> None:
    page = html.render([data])
    assert '<td class="cell fail">1 fail, 1 not offered</td>' in page  # layers: RMSNorm raises, silu is absent
    assert "<details><summary>1 not offered</summary>" in page


def test_formulas_are_plain_text() -> None:
    text = (
        r"`a$b$` is $16 \delta (1 + \lvert x \rvert)$, $p_{c+j} \ge 10^{-12}$, "
        r"$\mathrm{sg}(x_0)$ and $\frac{1}{2} \sqrt{n}$"
    )
    assert tex.plain(text) == "`a$b$` is 16 δ (1 + |x|), p_(c+j) ≥ 10⁻¹², sg(x₀) and 1/2 √n"
    assert (
        prose("**[X-1]** a `b*c*` *d* $e < 2 * f * g$") == "<b>[X-1]</b> a <code>b*c*</code> <i>d</i> e &lt; 2 * f * g"
    )


def test_no_requirement_is_cut_or_shows_tex() -> None:
    for identifier, text in requirements().items():
        assert text.endswith((".", ".)")), identifier
        assert not re.search(r"\$|\\[a-z]", re.sub("`[^`]*`", "", tex.plain(text))), identifier


def test_chapters_are_linked_where_the_repository_is_known(
    data: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(summary, "repository", lambda: "https://example.org/dreamer-spec")
    address = "https://example.org/dreamer-spec/blob/main/spec/07-returns.md"
    assert f'<a href="{address}">07 Returns</a>' in html.render([data])
    assert f"[07 Returns]({address})" in markdown.render(data)
    monkeypatch.setattr(summary, "repository", lambda: "javascript:alert(1)//")
    assert "javascript:" not in html.render([data])


def test_hostile_text_stays_text(hostile: dict[str, Any]) -> None:
    document = Document(html.render([hostile, hostile]))
    assert "script" not in {tag for tag, _ in document.elements}
    assert document.text.count("<script>alert(1)</script>") > 20
    ElementTree.fromstring(junit.render(hostile).encode())
    ElementTree.fromstring(badge.render(hostile))
    assert "[bold]x[/bold]" in shown(hostile)
    assert not re.search(r"[\x00\x1b]", shown(hostile))


def test_hostile_text_stays_text_in_markdown(hostile: dict[str, Any]) -> None:
    """Outside of code nothing is markup, and no block of code ends early."""
    outside, fence = [], ""
    for line in markdown.render(hostile).splitlines():
        marker = re.match("`{3,}", line)
        if not fence and marker:
            fence = marker.group()
        elif fence:
            fence = "" if line == fence else fence
        else:
            outside.append(re.sub(r"(`+)(?!`).*?(?<!`)\1(?!`)", "", line))
    assert fence == ""
    assert not re.search(r"(?<!\\)<", "\n".join(outside))
