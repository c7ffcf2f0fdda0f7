"""Reports: one result, rendered in many ways, and what hostile text cannot do."""

import io
import json
import re
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from report_data import ABSENT, ERROR, FAIL, HOSTILE, PASS, make
from rich.console import Console

from conformance.cli import main
from conformance.reports import badge, html, junit, markdown, summary, terminal


@pytest.fixture(scope="module")
def data() -> dict[str, Any]:
    return make()


@pytest.fixture(scope="module")
def hostile() -> dict[str, Any]:
    """Every text that an implementation or a file can bring in."""
    made = make(reasons={FAIL: HOSTILE})
    made["candidate"] = made["device"] = made["implementation"]["name"] = made["implementation"]["edition"] = made["edition"] = HOSTILE
    made["fit"] = {"editions": [{"edition": HOSTILE, "passed": 1, "judged": 2, "offered": 3}], "alike": [HOSTILE], "better": HOSTILE}
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
    shares = {None: "no number", 0.0: "0%", 0.344: "34%", 9.5: "950%", 123.4: "123×", 3.21e14: "3e14×"}
    assert {share: summary.percent(share) for share in shares} == shares


def test_a_run_prints_its_seed_and_version(data: dict[str, Any]) -> None:
    assert "seed 3, 5 examples, dreamer-spec" in shown(data)
    assert summary.settings({**data, "versions": {"dreamer-spec": "9.9"}}).endswith("dreamer-spec 9.9")


# --- The renderings ----------------------------------------------------------------------------------------------------------------------


def test_the_terminal(data: dict[str, Any]) -> None:
    text = shown(data)
    assert "failed: 2 checks failed" in text
    assert "4 checks, " in text
    assert "1 pass, 1 fail, 1 error, 1 not offered" in text
    assert "behaves like return_bootstraps_from_itself" in text
    assert "RuntimeError: out of order" in text
    assert data["checks"][FAIL]["failure"]["command"] in text
    assert len(text.splitlines()) < 50


def test_markdown(data: dict[str, Any]) -> None:
    text = markdown.render(data)
    assert text.startswith("# Conformance of mine 1.2\n\n**Failed: 2 checks failed.**")
    assert "- **return\\_bootstraps\\_from\\_itself**" in text
    assert f"```python\n{data['checks'][FAIL]['failure']['snippet']}\n```" in text
    assert "| `reward` | float64 \\[1, 4\\] | `[[9.0, 1.0, 0.0, 2.0]]` |" in text
    assert "07 Returns (`spec/07-returns.md`)" in text


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
    assert (suites["layers"].get("tests"), suites["layers"].get("errors"), suites["layers"].get("skipped")) == ("2", "1", "1")
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


class Document(HTMLParser):
    """Elements and text of a page; fails where tags do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))
        if tag != "meta":
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


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
    assert not [name for _, attributes in document.elements for name in attributes if name.startswith("on") or name == "src"]
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
    assert "Failures of mine 1.2" in document.text
    assert "Failures of other" not in document.text
    assert "Judged as the edition 2024-12 (the authors' code since December 2024), as it claims." in document.text
    assert main(["report", str(tmp_path / "page.html")]) == 2
    assert capsys.readouterr().err.startswith("conformance: error: ")


def test_two_runs_of_one_implementation_are_told_apart(data: dict[str, Any]) -> None:
    text = Document(html.render([data, {**data, "dtype": "float32"}])).text
    assert "mine 1.2 float64, paper" in text
    assert "mine 1.2 float32, paper" in text


def test_chapters_are_linked_where_the_repository_is_known(data: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
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
