"""Two mutants of the catalogue in one."""

import itertools
from collections.abc import Iterable, Iterator

from conformance.mutants.catalogue import PAIR, Mutant


def pairs(mutants: Iterable[Mutant]) -> Iterator[Mutant]:
    """All pairs that change the same function and can be made at once."""
    for one, other in itertools.combinations(mutants, 2):
        if not one.edits.keys().isdisjoint(other.edits) and (made := both(one, other)):
            yield made


def both(one: Mutant, other: Mutant) -> Mutant | None:
    """The two mistakes at once; None where they change the same words."""
    for first, second in ((one, other), (other, one)):
        targets = dict.fromkeys([*first.edits, *second.edits])
        texts = {target: (first.edits.get(target, {}), second.edits.get(target, {})) for target in targets}
        if any(before.keys() & after.keys() for before, after in texts.values()):
            return None
        made = Mutant(
            name=f"{one.name} and {other.name}",
            explanation=f"{one.explanation}. And {other.explanation}",
            provenance="; ".join(dict.fromkeys([one.provenance, other.provenance])),
            violates=tuple(dict.fromkeys(one.violates + other.violates)),
            fix=" ".join(dict.fromkeys([one.fix, other.fix])),
            edits={target: {**before, **after} for target, (before, after) in texts.items()},
            kind=PAIR,
        )
        if _can_be_made(made):
            return made
    return None


def _can_be_made(mutant: Mutant) -> bool:
    """Whether the words that the second changes are still there, once."""
    try:
        return bool(mutant.replacements)
    except (ValueError, SyntaxError):
        return False
