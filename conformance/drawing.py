"""Cases in order: those that a check writes down, and those that hypothesis draws."""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
from hypothesis.database import InMemoryExampleDatabase

from conformance.case import Case, Cases, Drawn, Setting
from conformance.compare import Deviation, entries
from conformance.strategies import ordinary_numbers

SHRINKING = 50  # examples that hypothesis may try to find a smaller one that deviates
DRAW_BYTES = 8192
IN_VAIN = 100  # draws in a row that give no example, or one that is there already, until there are no others

Strategies = Mapping[str, st.SearchStrategy[Any]]


@dataclasses.dataclass(frozen=True, eq=False)
class Example:
    """The bytes that values were drawn from. What hypothesis draws by itself depends on the code that happens to be
    imported; these cases are the same everywhere."""

    drawn: Drawn
    data: bytes


@functools.lru_cache(maxsize=1024)
def cases(
    build: Callable[[Setting], Cases], setting: Setting, ordinary: bool = False
) -> tuple[tuple[Case, Example | None], ...]:
    """The cases of a check, each with the example that it is of, if it was drawn; always the same.

    ordinary: those alone that have no extreme input.
    """
    with ordinary_numbers(ordinary), np.errstate(all="ignore"):
        found = tuple(one_by_one(build, setting))
    return tuple((case, example) for case, example in found if not (ordinary and case.is_extreme))


def one_by_one(build: Callable[[Setting], Cases], setting: Setting) -> Iterator[tuple[Case, Example | None]]:
    """The same, each when it is asked for."""
    drawn = 0
    for item in build(setting):
        if isinstance(item, Case):
            yield item, None
        else:
            yield from draw(item, setting, drawn)
            drawn += 1


def draw(drawn: Drawn, setting: Setting, number: int) -> Iterator[tuple[Case, Example]]:
    """The cases of an example after the other. number: of what is drawn in a check, so that it differs each time."""
    found: list[Case] = []

    def keep(**values: Any) -> None:
        found[:] = built(drawn, values)

    for data in _different(_test(drawn.strategies, keep, setting), setting, number):
        yield from [(case, Example(drawn, data)) for case in found]


def smallest(example: Example, setting: Setting, judge: Callable[[Case], None]) -> None:
    """Judges an example that deviates again; raises what the smallest one raises that hypothesis makes of it in
    time."""

    def judge_all(**values: Any) -> None:
        for case in built(example.drawn, values):
            judge(case)

    shrinking = _Shrinking(judge_all)
    test = _test(example.drawn.strategies, shrinking.run, setting)
    with contextlib.suppress(Exception):
        test.hypothesis.fuzz_one_input(example.data)  # hypothesis keeps what fails
    shrinking.search(test)


def run_examples(
    body: Callable[..., None], strategies: Strategies, setting: Setting, shrink: bool, number: int = 0
) -> None:
    """Runs a function on the values of one example after the other; what it raises first is raised, and with `shrink`
    on the smallest values."""
    shrinking = _Shrinking(body)
    test = _test(strategies, shrinking.run, setting)
    try:
        for _ in _different(test, setting, number):
            pass
    except Exception:
        if shrink:
            shrinking.search(test)
        raise


def _different(test: Any, setting: Setting, number: int) -> Iterator[bytes]:
    """Runs a test on different examples, the simplest one first, and says which bytes each was drawn from."""
    rng, seen, data = np.random.default_rng([setting.seed, number]), set[bytes](), bytes(DRAW_BYTES)
    in_vain = 0
    while len(seen) < setting.examples and in_vain < IN_VAIN:
        used = test.hypothesis.fuzz_one_input(data)
        in_vain += 1
        if used is not None and used not in seen:
            seen.add(used)
            in_vain = 0
            yield used
        data = rng.bytes(DRAW_BYTES)


def built(drawn: Drawn, values: dict[str, Any]) -> Iterator[Case]:
    for case in drawn.build(**values):
        assert isinstance(case, Case), "what is drawn does not draw again"
        yield case


def _test(strategies: Strategies, body: Callable[..., None], setting: Setting) -> Any:
    """A test of hypothesis that, called, repeats what has failed and makes it smaller."""

    def one_example(**values: Any) -> None:
        body(**values)

    return hypothesis.settings(
        max_examples=setting.examples,
        deadline=None,
        database=InMemoryExampleDatabase(),
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=(hypothesis.Phase.reuse, hypothesis.Phase.shrink),
        report_multiple_bugs=False,  # several deviations would come as a group, which is no Deviation
        print_blob=False,
    )(hypothesis.given(**strategies)(one_example))


class _Enough(BaseException):
    """Smaller cases were looked for long enough. Not an Exception: hypothesis would take it for another way to fail."""


class _Shrinking:
    """Runs a function on drawn values; ends the search for smaller ones that fail after a number of attempts, which no
    clock decides: the same input is found on every machine."""

    def __init__(self, body: Callable[..., None]) -> None:
        self._body = body
        self._left, self._size = SHRINKING, math.inf
        self._smallest: dict[str, Any] = {}

    def run(self, **values: Any) -> None:
        if self._smallest:
            self._left -= 1
        if self._left < 0:
            raise _Enough
        try:
            self._body(**values)
        except hypothesis.errors.UnsatisfiedAssumption:
            raise
        except Exception:
            if (size := _count(values)) <= self._size:
                self._size, self._smallest = size, values
            raise

    def search(self, test: Callable[[], None]) -> None:
        """Fails once more with the smallest values that hypothesis finds."""
        try:
            test()
        except _Enough:
            self._body(**self._smallest)
        raise Deviation("a case that deviated does not deviate again: the candidate is not deterministic")


def _count(value: Any) -> int:
    """How many numbers a nested value holds."""
    if isinstance(value, dict | tuple | list):
        return sum(_count(value[key]) for key in entries(value))
    return int(np.size(value))
