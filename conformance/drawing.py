"""Cases in order: those that a check writes down, and those that hypothesis draws."""

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np

from conformance.case import Case, Cases, Drawn, Setting
from conformance.compare import Deviation, entries
from conformance.strategies import ordinary_numbers

SHRINKING = 50  # examples that hypothesis may try to find a smaller one that deviates
DRAW_BYTES = 8192
ATTEMPTS = 100

Strategies = Mapping[str, st.SearchStrategy[Any]]


@functools.lru_cache(maxsize=1024)
def cases(
    build: Callable[[Setting], Cases], setting: Setting, ordinary: bool = False
) -> tuple[tuple[Case, Drawn | None], ...]:
    """The cases of a check, each with what it was drawn by; always the same.

    ordinary: those alone that have no extreme input.
    """
    found: list[tuple[Case, Drawn | None]] = []
    with ordinary_numbers(ordinary), np.errstate(all="ignore"):
        for item in build(setting):
            if isinstance(item, Case):
                found.append((item, None))
            else:
                for drawn in draw(item, setting):
                    found += [(case, item) for case in drawn]
    return tuple((case, drawn) for case, drawn in found if not (ordinary and case.is_extreme))


def draw(drawn: Drawn, setting: Setting) -> list[list[Case]]:
    """What hypothesis draws where nothing deviates: the cases of each example."""
    examples: list[list[Case]] = []
    run_examples(lambda **values: examples.append(list(built(drawn, values))), drawn.strategies, setting, shrink=False)
    return examples


def draw_from_bytes(drawn: Drawn, setting: Setting, number: int) -> Iterator[Case]:
    """The cases of as many examples from bytes of NumPy's generator: what hypothesis draws by itself depends on the
    code that happens to be imported."""
    examples: list[list[Case]] = []
    quiet = hypothesis.settings(database=None, deadline=None, suppress_health_check=list(hypothesis.HealthCheck))
    collect = _taking(drawn.strategies, lambda **values: examples.append(list(built(drawn, values))))
    test: Any = quiet(collect)
    rng = np.random.default_rng([setting.seed, number])
    for _ in range(ATTEMPTS * setting.examples):
        if len(examples) < setting.examples:
            test.hypothesis.fuzz_one_input(rng.bytes(DRAW_BYTES))
    for example in examples:
        yield from example


def built(drawn: Drawn, values: dict[str, Any]) -> Iterator[Case]:
    for case in drawn.build(**values):
        assert isinstance(case, Case), "what is drawn does not draw again"
        yield case


def run_examples(body: Callable[..., None], strategies: Strategies, setting: Setting, shrink: bool) -> None:
    """Runs a function on drawn values; what it raises first is raised, and with `shrink` on the smallest values."""
    shrinking = _Shrinking(body)
    phases = [phase for phase in hypothesis.Phase if shrink or phase is not hypothesis.Phase.shrink]
    wrapped = hypothesis.settings(
        max_examples=setting.examples,
        deadline=None,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=phases,
        report_multiple_bugs=False,  # several deviations would come as a group, which is no Deviation
    )(_taking(strategies, shrinking.run))
    try:
        hypothesis.seed(setting.seed)(wrapped)()
    except _Enough:
        shrinking.repeat_smallest()


def _taking(strategies: Strategies, body: Callable[..., None]) -> Callable[..., None]:
    def one_example(**values: Any) -> None:
        body(**values)

    return hypothesis.given(**strategies)(one_example)


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

    def repeat_smallest(self) -> None:
        """Fails once more with the smallest values that were found."""
        self._body(**self._smallest)
        raise Deviation("a case that deviated does not deviate again: the candidate is not deterministic")


def _count(value: Any) -> int:
    """How many numbers a nested value holds."""
    if isinstance(value, dict | tuple | list):
        return sum(_count(value[key]) for key in entries(value))
    return int(np.size(value))
