"""What of the reference a check can reach, from the code alone: nothing is run."""

import functools
import types
from collections.abc import Collection, Iterable, Iterator
from typing import Any

from conformance.adapters import numpy_adapter
from conformance.check import Check
from conformance.interface import INTERFACE

PACKAGE = "reference_numpy"


def reach_of(check: Check) -> frozenset[str]:
    """The functions and classes, as "chapter.name", that the functions of the interface may enter which the check
    uses. More than the check really enters: not every branch is taken."""
    return frozenset().union(*map(_offered, check.uses))


def suspects(reach: Iterable[str], failing: Collection[Check], passing: Collection[Check]) -> list[str]:
    """What of the reference is likely to be what a candidate has otherwise: what failing checks reach and passing ones
    do not comes first. The measure is that of Ochiai, from the localization of faults."""
    reached = {check: reach_of(check) for check in (*failing, *passing)}

    def suspicion(name: str) -> float:
        fails, passes = (sum(name in reached[check] for check in checks) for checks in (failing, passing))
        return fails / (len(failing) * (fails + passes)) ** 0.5 if fails else 0.0

    return sorted(reach, key=lambda name: (-suspicion(name), name))


@functools.cache
def _offered(name: str) -> frozenset[str]:
    """Of a function of the interface. What the adapter makes of others is followed, too."""
    adapter = numpy_adapter.NumpyAdapter()
    try:
        function = getattr(adapter, name)
    except AttributeError:
        return frozenset()
    if _is_ours(function):
        return _entered(function)
    found: set[str] = set()
    for word in _words(function.__code__):
        if word in INTERFACE and word != name:
            found |= _offered(word)
    return frozenset(found).union(*map(_entered, _named(function)))


def _entered(start: Any) -> frozenset[str]:
    """A function or class of the reference, and all that it calls."""
    found: dict[str, Any] = {}
    left = [start]
    while left:
        one = left.pop()
        if (name := f"{one.__module__.removeprefix(PACKAGE + '.')}.{one.__qualname__}") not in found:
            found[name] = one
            left += [called for function in _functions(one) for called in _named(function)]
    return frozenset(found)


def _named(function: types.FunctionType) -> Iterator[Any]:
    """The functions and classes of the reference that a function names, on their own or as parts of a module."""
    words = _words(function.__code__)
    scopes = [function.__globals__]
    scopes += [vars(value) for word in words if isinstance(value := scopes[0].get(word), types.ModuleType)]
    for scope in scopes:
        yield from (scope[word] for word in words if _is_ours(scope.get(word)))


def _functions(one: Any) -> list[types.FunctionType]:
    if isinstance(one, type):
        return [value for value in vars(one).values() if isinstance(value, types.FunctionType)]
    return [getattr(one, "__wrapped__", one)]


def _is_ours(value: Any) -> bool:
    return isinstance(value, types.FunctionType | type) and value.__module__.startswith(f"{PACKAGE}.")


def _words(code: types.CodeType) -> set[str]:
    """The names in a piece of code, nested functions included."""
    inner = (constant for constant in code.co_consts if isinstance(constant, types.CodeType))
    return set(code.co_names).union(*map(_words, inner))
