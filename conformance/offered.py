"""What an adapter offers, what the checks can ask of it, and which of it no check could use."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any

from conformance.case import Case, Cases, Drawn, Setting
from conformance.check import CHECKS, Check
from conformance.drawing import cases
from conformance.execute import Result, missing
from conformance.interface import INTERFACE

GRADIENTS_OF_ALL = ("gradients", "gradients_given", "loss_derivatives")
"""With one of these the gradient of every loss is judged."""


def offered(adapter: object) -> list[str]:
    """The functions of the interface that an adapter has, in its order."""
    return [name for name in INTERFACE if callable(getattr(adapter, name, None))]


def narrowed(check: Check, adapter: object, setting: Setting) -> Check:
    """The check with the cases that ask only what the adapter offers: whoever has `prior` need not have `posterior`.

    It is the check itself where all is offered, and where nothing would be left.
    """
    lacking = frozenset(missing(adapter, check))
    if not lacking or check.cases is None or lacking.issuperset(check.uses):
        return check
    build = _without(check.cases, lacking)
    if not cases(build, setting):
        return check
    uses = tuple(name for name in check.uses if name not in lacking)
    return dataclasses.replace(check, cases=build, uses=uses, lacking=tuple(sorted(lacking)))


@functools.cache  # so that what is cached by function is found again
def _without(build: Callable[[Setting], Cases], lacking: frozenset[str]) -> Callable[[Setting], Cases]:
    def kept(build: Callable[..., Cases], *arguments: Any, **drawn: Any) -> Iterator[Case | Drawn]:
        for item in build(*arguments, **drawn):
            if isinstance(item, Drawn):
                yield Drawn(functools.partial(kept, item.build), **item.strategies)
            elif item.functions.isdisjoint(lacking):
                yield item

    return functools.partial(kept, build)


def unchecked(functions: Collection[str], results: Iterable[Result]) -> list[dict[str, Any]]:
    """Offered functions that no check was run with, because each check needs others too.

    Returns:
      Entries with `function`, and `needs`: what the check lacks that lacks least. A function that no check was asked to
        use is left out.
    """
    results = list(results)
    found = []
    for name in functions:
        using = [result for result in results if name in result.check.uses]
        lacking = [[other for other in result.check.uses if other not in functions] for result in using]
        if lacking and all(lacking):
            found.append({"function": name, "needs": min(lacking, key=len)})
    return found


def without_gradients(results: Iterable[Result]) -> list[str]:
    """Functions whose values were judged and whose gradients were not, because nothing that is offered shows them."""
    judged = [result.check for result in results if result.status != "not offered"]
    if any(not set(check.uses).isdisjoint(GRADIENTS_OF_ALL) for check in judged):
        return []
    shown = {name for check in judged if "vjp" in check.uses for name in check.uses}
    valued = {name for check in judged for name in check.uses}
    have_gradients = dict.fromkeys(name for check in CHECKS.values() if "vjp" in check.uses for name in check.uses)
    return [name for name in have_gradients if name in valued - shown]
