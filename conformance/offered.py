"""What an adapter offers, and which of it no check could use."""

from collections.abc import Collection, Iterable
from typing import Any

from conformance.adapter import INTERFACE
from conformance.execute import Result


def offered(adapter: object) -> list[str]:
    """The functions of the interface that an adapter has, in its order."""
    return [name for name in INTERFACE if callable(getattr(adapter, name, None))]


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
