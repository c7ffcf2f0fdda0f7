"""The worked numbers of the chapters (spec/examples): the reference gives every one of them, and the chapters print
them."""

from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from conformance.compare import Comparisons
from conformance.interface import INTERFACE
from conformance.our_candidates import load_adapter
from conformance.requirements import chapter_of, requirements
from conformance.worked import Worked, worked
from docs import examples as pages
from spec import profiles
from spec.worked import CHAPTERS, allowed, examples, number, read

ROOT = Path(__file__).resolve().parent.parent
CASES = [case for chapter in CHAPTERS for case in worked(chapter)]
EXAMPLES = [example for chapter in CHAPTERS for example in examples(chapter).values()]


def agrees(case: Worked, function: Any) -> None:
    """Calls a function of the reference, and compares what comes with the example."""
    actual = function(*case.arguments)
    if case.expected is not None:
        comparisons = Comparisons("float64")
        comparisons.compare(case.name, actual, case.expected, magnitude=case.bound, bound=1.0)
        assert comparisons.compared


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_the_reference_gives_the_worked_numbers(case: Worked) -> None:
    made = getattr(load_adapter("numpy"), case.function)
    if case.calls:
        made = made(*case.arguments)
        for call in case.calls:
            agrees(call, getattr(made, call.function) if call.function else made)
    else:
        agrees(case, made)


@pytest.mark.parametrize("profile", profiles())
def test_an_example_sets_every_hyperparameter_that_matters(profile: str) -> None:
    for case in (case for chapter in CHAPTERS for case in worked(chapter, profile=profile) if not case.calls):
        agrees(case, getattr(load_adapter("numpy"), case.function))


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"no example 'a retrun'; known: a return by hand, "):
        worked("returns", "a retrun")
    with pytest.raises(ValueError, match=r"unknown chapter 'return'; known: .*returns"):
        worked("return")


@pytest.mark.parametrize(
    ("written", "precision", "expected"),
    [
        (Decimal("1.50"), "printed", 0.005),
        (Decimal("1.50"), "exact", 0.0),
        (Decimal("-2.0"), 1e-3, 2e-3),
        (3, "printed", 3e-12),
        ("1 - 1/2", "printed", 5e-13),
        (0, 1e-3, 0.0),
        (Decimal("inf"), "printed", 0.0),
    ],
)
def test_what_a_number_allows(written: Any, precision: Any, expected: float) -> None:
    assert allowed(written, precision) == pytest.approx(expected, rel=1e-15)


def test_formulas_are_numbers_and_nothing_else() -> None:
    assert number("(1 - 1/4)**2 + ln(e)") == 1.5625
    for wrong in ("1 +", "__import__('os')", "x", "ln(1, 2)", "1/0"):
        with pytest.raises(ValueError, match="expected a number or a formula"):
            number(wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"give": 1}, "unknown keys: give"),
        ({"text": None}, "missing keys: text"),
        ({"cases": [{"gives": 1}]}, "one of gives, cases and calls"),
        ({"gives": None, "cases": [{"x": 1}]}, "needs its gives"),
        ({"gives": "one"}, "expected a number or a formula, got 'one'"),
        ({"with": {"spaces": {"observations": {"x": "Vektor(1)"}}}}, r"expected a space such as Vector\(2\)"),
    ],
)
def test_a_wrong_entry_is_named(change: dict[str, Any], message: str) -> None:
    entry = {"requirements": ["TRA-3"], "function": "symlog", "gives": 1, "precision": "exact", "text": "1", **change}
    with pytest.raises(ValueError, match=rf"spec/examples/transforms.toml: 'an example': .*{message}"):
        read("transforms", "an example", {key: value for key, value in entry.items() if value is not None})


@pytest.mark.parametrize("example", EXAMPLES, ids=[f"{example.chapter}: {example.name}" for example in EXAMPLES])
def test_an_example_stands_in_its_chapter(example: Any) -> None:
    """It names a function of the interface and requirements that there are, and its chapter prints it once."""
    assert example.function in INTERFACE
    assert set(example.requirements) <= set(requirements())
    chapters = {chapter_of(requirement) for requirement in example.requirements}
    texts = [(ROOT / chapter).read_text(encoding="utf-8") for chapter in chapters]
    assert sum(text.count(pages.paragraph(example)) for text in texts) == 1, "see docs/examples.py"
