"""Cases: what a check asks, as data.

A case is calls with fixed arguments, and demands on their results. Judging a candidate, naming its mistake, judging it
in another edition and writing golden vectors are loops over the same cases. A check is a function that builds them:

    @check("RET-7", uses=["cumulative_weights"], level=0)
    def weights_match(setting: Setting) -> Cases:
        \"""Random continues.\"""

        def case(seed: int, horizon: int) -> Cases:
            continue_ = imagined(setting, seed, horizon)[1]
            yield equal("cumulative_weights", (continue_, GAMMA), reference.cumulative_weights(continue_, GAMMA))

        yield Drawn(case, seed=seeds(), horizon=st.sampled_from([1, 4, 15]))
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.compare import EPSILON, SMALLEST_NORMAL, WIDE, Comparisons, Path, is_extreme, part_of, round_to


@dataclasses.dataclass(frozen=True)
class Setting:
    """What cases are built for.

    dtype: precision of the candidate. profile: name of the profile that configurations are drawn from. seed and
    examples: of the drawn cases. inputs: the precision that inputs are rounded to, that of the candidate unless given.
    """

    dtype: str
    profile: str
    seed: int = 0
    examples: int = 25
    inputs: str | None = None

    @property
    def u(self) -> float:
        """Distance from 1 to the next number in the precision of losses, returns and transforms: float32 or better."""
        return EPSILON[WIDE[self.dtype]]

    @property
    def tiny(self) -> float:
        """Smallest normal number of that precision."""
        return SMALLEST_NORMAL[WIDE[self.dtype]]

    def rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)

    def cast(self, x: Any) -> np.ndarray:
        """Rounds inputs to what the candidate can hold, so that reference and candidate start from the same numbers."""
        return round_to(x, self.inputs or self.dtype)


@dataclasses.dataclass(frozen=True, eq=False)
class Call:
    """One call of a function of the interface."""

    function: str
    arguments: tuple[Any, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Equal:
    """A result is this, as `Comparisons.compare` says: a golden value.

    at: the part of the result. call: which of the case. where: what messages call it.
    """

    expected: Any
    at: Path = ()
    call: int = 0
    where: str = ""
    magnitude: Any = None
    factor: float = 1.0
    bound: float | None = None

    def judge(self, comparisons: Comparisons, case: "Case", results: list[Any]) -> None:
        where = self.where or case.calls[self.call].function
        try:
            actual = part_of(results[self.call], self.at)
        except (LookupError, TypeError):
            comparisons.fail(
                where, f"{where}: the result has no part {list(self.at)}, it is {results[self.call]!r:.80}"
            )
            return
        how = {"magnitude": self.magnitude, "factor": self.factor, "bound": self.bound}
        comparisons.compare(where, actual, self.expected, **how)


@dataclasses.dataclass(frozen=True, eq=False)
class Related:
    """Results have a relation: `relation(comparisons, *results)` compares them with each other."""

    relation: Callable[..., None]

    def judge(self, comparisons: Comparisons, case: "Case", results: list[Any]) -> None:
        self.relation(comparisons, *results)


@dataclasses.dataclass(frozen=True, eq=False)
class Refused:
    """The call raises a ValueError with a message; `naming` are words that it must hold."""

    naming: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """Calls and what is demanded of their results, in this order.

    refused: of a case with one call and no other demand. keeps: the calls leave their arguments as they were. by_hand:
    an example of a chapter, with numbers that can be followed by hand.
    """

    calls: tuple[Call, ...]
    demands: tuple[Equal | Related, ...] = ()
    refused: Refused | None = None
    keeps: bool = False
    by_hand: bool = False

    @property
    def functions(self) -> frozenset[str]:
        """What it asks, the function whose gradient it asks for included."""
        pulled = {str(call.arguments[0]) for call in self.calls if call.function == "vjp"}
        return frozenset(call.function for call in self.calls) | pulled

    @functools.cached_property
    def is_extreme(self) -> bool:
        """Whether it is about input that is refused, not finite, tiny or huge."""
        return self.refused is not None or any(is_extreme(call.arguments) for call in self.calls)

    def whole(self, call: int) -> Equal | None:
        """The demand that says what the whole result of a call is."""
        found = (demand for demand in self.demands if isinstance(demand, Equal) and demand.call == call)
        return next((demand for demand in found if not demand.at), None)


class Drawn:
    """Cases whose values hypothesis draws, and makes smaller where the candidate deviates."""

    def __init__(self, build: Callable[..., "Cases"], **strategies: st.SearchStrategy[Any]) -> None:
        self.build, self.strategies = build, strategies


Cases = Iterator[Case | Drawn]


def equal(
    function: str,
    arguments: tuple[Any, ...],
    expected: Any,
    *,
    at: Path = (),
    where: str = "",
    magnitude: Any = None,
    factor: float = 1.0,
    bound: float | None = None,
) -> Case:
    """A call with its golden result, see `Comparisons.compare`."""
    return Case((Call(function, arguments),), (Equal(expected, at, 0, where, magnitude, factor, bound),))


def exact(function: str, arguments: tuple[Any, ...], expected: Any, *, at: Path = (), where: str = "") -> Case:
    """A call whose result is equal in every bit but the sign of zero."""
    return equal(function, arguments, expected, at=at, where=where, magnitude=1.0, bound=0.0)


def exactly(expected: Any, at: Path = (), where: str = "", call: int = 0) -> Equal:
    """A demand of a result that is equal in every bit but the sign of zero."""
    return Equal(expected, at, call, where, magnitude=1.0, bound=0.0)


def judged(
    function: str, arguments: tuple[Any, ...], *demands: Equal | Callable[..., None], keeps: bool = False
) -> Case:
    """One call with several demands; a function takes the comparisons and the result."""
    return Case((Call(function, arguments),), _demands(demands), keeps=keeps)


def related(relation: Callable[..., None], *calls: tuple[str, tuple[Any, ...]]) -> Case:
    """Calls whose results have a relation: the function takes the comparisons and one result for each call."""
    return Case(tuple(Call(*call) for call in calls), (Related(relation),))


def refused(function: str, *arguments: Any, naming: Iterable[str] = ()) -> Case:
    """A call that must raise a ValueError with a message; `naming` are words that it must hold."""
    return Case((Call(function, arguments),), refused=Refused(tuple(naming)))


def _demands(demands: Iterable[Equal | Callable[..., None]]) -> tuple[Equal | Related, ...]:
    return tuple(demand if isinstance(demand, Equal) else Related(demand) for demand in demands)
