"""The worked numbers of the chapters (spec/examples): the reference gives every one of them, and the chapters print
them."""

from pathlib import Path
from typing import Any

import pytest

from conformance.adapter import INTERFACE, load_adapter
from conformance.check import Run
from conformance.requirements import chapter_of, requirements
from conformance.worked import Worked, worked
from docs import examples as pages
from spec.worked import ROWS, examples

ROOT = Path(__file__).resolve().parent.parent
CASES = [case for row in ROWS for case in worked(row)]
EXAMPLES = [example for row in ROWS for example in examples(row).values()]


def agrees(case: Worked, function: Any) -> None:
    """Calls a function of the reference, and compares what comes with the example."""
    actual = function(*case.arguments)
    if case.expected is not None:
        run = Run(None, "float64", "paper")
        run.compare(case.name, actual, case.expected, magnitude=case.bound, bound=1.0)
        assert run.compared


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_the_reference_gives_the_worked_numbers(case: Worked) -> None:
    made = getattr(load_adapter("numpy"), case.function)
    if case.calls:
        made = made(*case.arguments)
        for call in case.calls:
            agrees(call, getattr(made, call.function) if call.function else made)
    else:
        agrees(case, made)


@pytest.mark.parametrize("example", EXAMPLES, ids=[f"{example.row}: {example.name}" for example in EXAMPLES])
def test_an_example_stands_in_its_chapter(example: Any) -> None:
    """It names a function of the interface and requirements that there are, and its chapter prints it once."""
    assert example.function in INTERFACE
    assert set(example.requirements) <= set(requirements())
    chapters = {chapter_of(requirement) for requirement in example.requirements}
    texts = [(ROOT / chapter).read_text(encoding="utf-8") for chapter in chapters]
    assert sum(text.count(pages.paragraph(example)) for text in texts) == 1, "see docs/examples.py"
