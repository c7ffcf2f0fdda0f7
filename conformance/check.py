"""The checks: which there are, what requirements they cover, and which functions of the interface they need.

Most checks build cases (conformance/case.py). A check that hands a candidate's result to another call, or that drives
an object, is a script (conformance/script.py). Where an adapter does not offer a function that a check uses, the check
is not asked there; of cases those are judged that ask others alone (conformance/offered.py).
"""

import dataclasses
import inspect
from collections.abc import Callable, Iterable
from typing import Any

from conformance.case import Cases, Setting
from conformance.compare import DTYPES
from conformance.script import Script


@dataclasses.dataclass(frozen=True)
class Check:
    """One registered check.

    cases: builds its cases, None for a script. script: judges a candidate itself, None where there are cases. lacking:
    functions that an adapter does not offer, and whose cases have been left out for it.
    """

    name: str
    requirements: tuple[str, ...]
    uses: tuple[str, ...]
    level: int
    dtypes: tuple[str, ...]
    summary: str
    cases: Callable[[Setting], Cases] | None = None
    script: Callable[[Script], None] | None = None
    lacking: tuple[str, ...] = ()

    @property
    def is_large(self) -> bool:
        """Whether it asks again what others ask, at many times the work: of fast implementations, not of mutants of the
        reference."""
        return self.name.startswith("large.")


CHECKS: dict[str, Check] = {}


def check(
    *requirements: str, uses: Iterable[str], level: int, dtypes: tuple[str, ...] = DTYPES
) -> Callable[[Callable[[Setting], Cases]], Callable[[Setting], Cases]]:
    """Registers a function that builds cases under `chapter.function_name`. Its docstring says what holds."""

    def register(build: Callable[[Setting], Cases]) -> Callable[[Setting], Cases]:
        _register(build, Check(_name(build), requirements, tuple(uses), level, dtypes, _summary(build), cases=build))
        return build

    return register


def script(
    *requirements: str, uses: Iterable[str], level: int, dtypes: tuple[str, ...] = DTYPES
) -> Callable[[Callable[[Script], None]], Callable[[Script], None]]:
    """Registers a script, as `check` registers a builder."""

    def register(body: Callable[[Script], None]) -> Callable[[Script], None]:
        _register(body, Check(_name(body), requirements, tuple(uses), level, dtypes, _summary(body), script=body))
        return body

    return register


def _register(function: Callable[..., Any], made: Check) -> None:
    if made.name in CHECKS:
        raise ValueError(f"two checks are named {made.name}")
    if inspect.isgeneratorfunction(function) != (made.cases is not None):
        raise TypeError(f"{made.name}: @check takes a function that yields cases, @script one that does not")
    CHECKS[made.name] = made


def _name(function: Callable[..., Any]) -> str:
    return f"{function.__module__.rsplit('.', 1)[-1]}.{function.__name__}"


def _summary(function: Callable[..., Any]) -> str:
    """The first paragraph of the docstring, in one line."""
    return " ".join((inspect.getdoc(function) or "").partition("\n\n")[0].split())
