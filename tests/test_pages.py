"""The pages: whatever comes into a template is escaped, nothing is left out unnoticed, and all stand on one base."""

import dataclasses
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jinja2
import numpy as np
import pytest
from html_document import Document
from report_data import ERROR, FAIL, PASS, make

from conformance import pages
from conformance.reports import html
from dreamer_spec.report import page, svg
from dreamer_spec.report.runs import Curve, RunLog
from dreamer_spec.report.series import Band

ROOT = Path(__file__).resolve().parent.parent
TEMPLATES = sorted(path for path in ROOT.glob("*/*/templates/*"))
HOSTILE = "\"'><script>alert(1)<img src=x onerror=alert(1)>{{ 7 * 7 }}&amp;</script>"
HARMLESS = re.sub("[^ /]", "x", HOSTILE)  # lines break at spaces and slashes
KEPT = ("status", "choice", "dtype", "edition", "outcome", "candidate")  # of a result: what has a meaning of its own


def structure(text: str) -> list[tuple[str, list[str]]]:
    """Elements and the names of their attributes."""
    return [(tag, list(attributes)) for tag, attributes in Document(text).elements]


def told(value: Any, words: str) -> Any:
    """A result in which every text ends in these words, names of checks and requirements too."""
    if isinstance(value, dict):
        return {
            name if name in KEPT else told(name, words) if re.search("[.-]", name) else name: (
                entry if name in KEPT and isinstance(entry, str) else told(entry, words)
            )
            for name, entry in value.items()
        }
    if isinstance(value, list):
        return [told(entry, words) for entry in value]
    return value + words if isinstance(value, str) else value


def run_of(words: str) -> RunLog:
    """A run that says nothing but these words."""
    steps = np.array([1.0, 2.0, 3.0])
    names = (words, f"time/{words}", f"train/loss/reconstruction/{words}", "episode/return", "evaluation/return")
    curves = {name: Curve(steps, np.array([1.0, np.nan, 2.0])) for name in names}
    start = {"time": words, "step": words, "backend": words, "commit": words, "versions": {words: words}}
    return RunLog(
        **{"logdir": Path(words), "curves": curves, "step": 3, "seconds": 1.0, "written": 0.0, "parameters": None},
        **dict.fromkeys(("task", "backend", "device", "command", "profile", "size"), words),
        **{"options": {"seed": words, words: words}, "hyperparameters": {words: words}, "changed": {words: words}},
        spaces={"observations": {words: {"kind": words, words: words}}, "actions": {words: words}},
        preflight={"summary": words, "comparisons": [{"name": words, "requirements": [words], "share": 0.5}]},
        machine={words: words, "memory_gib": words, "versions": {words: words}},
        starts=[start, {**start, "changed": {words: [words]}}],
        pictures=[Path(f"000000000001-{words.replace('/', '')}.png")],
        notes=[words],
    )


# --- Everything is escaped
# ------------------------------------------------------------------------------


def test_whatever_a_result_says_stays_text() -> None:
    data = make((PASS, FAIL, ERROR), {ERROR: "later"})
    extreme = {**data, "checks": {**data["checks"], FAIL: {**data["checks"][FAIL], "extreme": True}}}
    harmless, hostile = (html.render([told(data, words), told(extreme, words)]) for words in (HARMLESS, HOSTILE))
    assert structure(hostile) == structure(harmless)
    assert Document(hostile).text.count(HOSTILE) > 100


def test_whatever_a_run_says_stays_text() -> None:
    def rendered(words: str) -> str:
        run = run_of(words)
        return page.render([run, dataclasses.replace(run, backend=f"{words}2"), run_of(f"{words}3")], 0.0)

    assert structure(rendered(HOSTILE)) == structure(rendered(HARMLESS))
    assert Document(rendered(HOSTILE)).text.count(HOSTILE) > 100


def test_whatever_a_chart_shows_stays_text() -> None:
    def drawn(words: str) -> str:
        steps = np.array([1.0, 2.0])
        band = Band(steps, steps, steps, steps + 1, steps)
        series = [svg.Series(words, 0, band, dots=True)]
        line = svg.line_chart(series, svg.LARGE, words, x_end=2, reference=1.0)
        return line + svg.stacked_chart(steps, {words: steps}, {words: 1}, words, 2)

    assert structure(drawn(HOSTILE)) == structure(drawn(HARMLESS))
    labels = [attributes.get("aria-label") for tag, attributes in Document(drawn(HOSTILE)).elements if tag == "svg"]
    assert labels == [HOSTILE, HOSTILE]


def test_a_badge_is_escaped() -> None:
    values = {"label": HOSTILE, "words": HOSTILE, "color": HOSTILE, "widths": [50, 60], "padding": 7}
    badge = ElementTree.fromstring(pages.render("conformance.reports", "badge.svg", **values))
    assert badge.get("aria-label") == f"{HOSTILE}: {HOSTILE}"
    assert not [element for element in badge.iter() if "script" in element.tag]


def test_filters_escape() -> None:
    assert pages.prose("`<a>` **<b>** *<i>* <p> [<q>](x)") == (
        "<code>&lt;a&gt;</code> <b>&lt;b&gt;</b> <i>&lt;i&gt;</i> &lt;p&gt; &lt;q&gt;"
    )
    assert pages.breakable("a/b_<c>") == "a/<wbr>b_<wbr>&lt;c&gt;"


def test_nothing_goes_around_the_escaping() -> None:
    for path in TEMPLATES:
        assert not re.search(r"\|\s*safe\b|autoescape", path.read_text(encoding="utf-8")), path
    for path in sorted({*ROOT.glob("conformance/**/*.py"), *ROOT.glob("dreamer_spec/**/*.py")}):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"from html import|html\.escape|Markup\(f|Markup\([^)]*%", text), path


# --- One base
# ------------------------------------------------------------------------------


def test_a_name_that_is_not_given_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="'widths' is undefined"):
        pages.render("conformance.reports", "badge.svg", label="", words="", color="", padding=7)
    with pytest.raises(jinja2.UndefinedError, match="has no attribute 'name'"):
        pages.render("dreamer_spec.report", "run.html", tasks=[{}])


def test_the_pages_stand_on_one_base() -> None:
    documents = [path for path in TEMPLATES if path.suffix == ".html" and path.parent.parent.name != "pages"]
    assert [path.name for path in documents] == ["conformance.html", "run.html"]
    for path in documents:
        text = path.read_text(encoding="utf-8")
        assert text.startswith('{% extends "base.html" %}')
        assert not re.search("<(html|head|body|style|script|meta)[ >]", text)
    base = (ROOT / "conformance/pages/templates/base.css").read_text(encoding="utf-8")
    assert base in html.render([make((PASS,))])
    assert base in page.render([run_of(HARMLESS)], 0.0)


def test_every_style_adds_what_no_other_has() -> None:
    """A rule stands once: what both pages have belongs to the base."""
    styles = [set(re.findall(r"[^{}]+\{[^{}]*\}", path.read_text())) for path in TEMPLATES if path.suffix == ".css"]
    assert len(styles) == 3
    assert len(set.union(*styles)) == sum(map(len, styles))


def test_the_templates_are_published() -> None:
    """The wheel itself is looked at in test_distribution.py."""
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {".".join(path.relative_to(ROOT).parts[:-2]) for path in TEMPLATES}
    assert folders == {"conformance.pages", "conformance.reports", "dreamer_spec.report"}
    assert folders <= set(setuptools["packages"])
    assert all(setuptools["package-data"][folder] == ["templates/*"] for folder in folders)
