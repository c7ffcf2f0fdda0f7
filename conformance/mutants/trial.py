"""Which checks find which mutant."""

import contextlib
import functools
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from types import FrameType
from typing import Any

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.check import Check
from conformance.execute import Result, run_check
from conformance.mutants.catalogue import Mutant, MutantAdapter

Reach = Mapping[Check, frozenset[str]]


@contextlib.contextmanager
def tracing(entered: Counter[str]) -> Iterator[None]:
    """While this context lasts, it is counted how often the functions and classes of the reference are entered, as
    "chapter.name"."""

    def note(frame: FrameType, event: str, argument: Any) -> None:
        module = frame.f_globals.get("__name__", "")
        if event == "call" and module.startswith("reference_numpy."):
            entered[f"{module.removeprefix('reference_numpy.')}.{frame.f_code.co_qualname.partition('.')[0]}"] += 1

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(before)


class TracedReference:
    """The reference, with a note of what its calls entered."""

    def __init__(self) -> None:
        self.entered: Counter[str] = Counter()
        self._reference = NumpyAdapter()

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._reference, name)

        def call(*arguments: Any) -> Any:
            with tracing(self.entered):
                return function(*arguments)

        return call


@functools.cache
def on_the_reference(check: Check, setting: Setting) -> tuple[Result, frozenset[str]]:
    """What a check finds on the reference without a mistake, and which of its functions and classes the check
    reaches."""
    adapter = TracedReference()
    result = run_check(check, adapter, setting, shrink=False)
    return result, frozenset(adapter.entered)


def sound(checks: Iterable[Check], examples: int = 5) -> tuple[dict[Check, frozenset[str]], list[Result]]:
    """The checks that the reference without a mistake passes, each with what it reaches of the reference; and the
    results of the others.

    A check that the reference does not pass would catch anything, so it says nothing about a mutant.
    """
    found = [on_the_reference(check, setting_of_trials(examples)) for check in checks if not check.is_large]
    reach = {result.check: entered for result, entered in found if result.status == "pass"}
    return reach, [result for result, _ in found if result.status in ("fail", "error")]


def setting_of_trials(examples: int) -> Setting:
    return Setting("float64", "paper", 0, examples)


def relevant(mutant: Mutant, reach: Reach) -> list[Check]:
    """The checks that can notice the mutant: first those that call what it changes, then those that reach it through
    others."""
    names = {target.partition(".")[2] for target in mutant.edits}
    return sorted(
        (check for check, entered in reach.items() if entered & mutant.edits.keys()),
        key=lambda check: (names.isdisjoint(check.uses), check.level, check.name),
    )


@functools.cache
def on_the_mutant(mutant: Mutant, check: Check, setting: Setting) -> Result:
    """What a check finds when the mutant is the candidate."""
    return run_check(check, MutantAdapter(mutant), setting, shrink=False)


def trial(mutant: Mutant, checks: Iterable[Check], examples: int = 5) -> Iterator[Result]:
    """What the checks find when the mutant is the candidate, one after the other."""
    for check in checks:
        yield on_the_mutant(mutant, check, setting_of_trials(examples))
