"""Numbers that an environment says beside its rewards, such as whether an episode was a success: chosen by name,
checked, and logged."""

import dataclasses
import fnmatch
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dreamer_spec.errors import UserError


@dataclasses.dataclass(frozen=True)
class EpisodeInfo:
    """values: name -> number, of an episode's last step. (An object, because Gymnasium would take a dictionary
    apart.)"""

    values: dict[str, float] = dataclasses.field(default_factory=dict)


def names_of(option: str | None) -> tuple[str, ...]:
    """--info-metrics: "success,stats/*" -> names and patterns."""
    return tuple(name.strip() for name in (option or "").split(",") if name.strip())


def is_pattern(name: str) -> bool:
    return any(character in name for character in "*?[")


def chosen(info: Any, names: Sequence[str]) -> EpisodeInfo:
    """The numbers of an info dictionary that are asked for; an entry of a dictionary inside it is called `outer/inner`.

    names: each an exact name, whose value must be a number, or a pattern, which takes the numbers that it fits.

    Raises:
      UserError: what is named exactly is no number, or a number that is chosen is not finite.
    """
    values: dict[str, float] = {}
    for name, value in _flat(info) if names else ():
        if name in names or any(fnmatch.fnmatchcase(name, pattern) for pattern in names):
            number = _number(value)
            if number is None and name in names:
                raise UserError(f"info[{name!r}] is {value!r:.80}; --info-metrics expects a number")
            if number is not None and not math.isfinite(number):
                raise UserError(f"info[{name!r}] is {number}; --info-metrics expects a finite number")
            if number is not None:
                values[name] = number
    return EpisodeInfo(values)


def _flat(info: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in info.items() if isinstance(info, Mapping) else ():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", value


def _number(value: Any) -> float | None:
    """None for what is not one real number."""
    if isinstance(value, bool | int | float | np.generic | np.ndarray):
        array = np.asarray(value)
        if array.size == 1 and array.dtype.kind in "fiub":
            return float(array.reshape(()))
    return None
