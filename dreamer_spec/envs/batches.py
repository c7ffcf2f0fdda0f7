"""One environment's part of what a vector environment returns: batches of nested observations, and infos."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces as gym


def leaves(space: gym.Space[Any], batch: Any) -> Iterator[Any]:
    """The batches of values in a batch of a nested space, in the order of the space. One that does not fit its space is
    a leaf as a whole."""
    if isinstance(space, gym.Dict) and isinstance(batch, Mapping):
        for key, entry in space.spaces.items():
            if key in batch:
                yield from leaves(entry, batch[key])
    elif isinstance(space, gym.Tuple) and isinstance(batch, tuple | list) and len(batch) == len(space.spaces):
        for entry, part in zip(space.spaces, batch, strict=True):
            yield from leaves(entry, part)
    else:
        yield batch


def row(space: gym.Space[Any], batch: Any, index: int, count: int) -> Any:
    """The observation of one environment in a batch of `count`. What does not fit its space, other than in its number
    of rows, is left to those who check observations.

    Raises:
      ValueError: a batch of another number of rows.
    """
    if isinstance(space, gym.Dict) and isinstance(batch, Mapping):
        entries = space.spaces
        return {key: row(entries[key], part, index, count) if key in entries else part for key, part in batch.items()}
    if isinstance(space, gym.Tuple) and isinstance(batch, tuple | list) and len(batch) == len(space.spaces):
        return tuple(row(entry, part, index, count) for entry, part in zip(space.spaces, batch, strict=True))
    if _length(batch) != count:
        raise ValueError(f"a batch of observations has {_length(batch)} rows; expected {count}")
    return batch[index]


def rows(space: gym.Space[Any], batch: Any) -> int:
    """How many environments a batch is of, going by its first value; 0 for what is no batch."""
    return _length(next(leaves(space, batch), None))


def rows_of(space: gym.Space[Any], batch: Any, which: np.ndarray) -> list[np.ndarray]:
    """Copies of the rows `which` [N] of every value that is numbers."""
    arrays = [np.asarray(leaf) for leaf in leaves(space, batch) if not isinstance(leaf, tuple | list)]
    return [array[which] for array in arrays if array.dtype.kind in "biuf"]


def differ(before: list[np.ndarray], after: list[np.ndarray]) -> bool:
    """Whether two results of `rows_of` differ."""
    return len(before) != len(after) or any(
        not np.array_equal(old, new, equal_nan=old.dtype.kind == "f" and new.dtype.kind == "f")
        for old, new in zip(before, after, strict=True)
    )


def info_of(infos: Any, index: int, count: int) -> dict[str, Any]:
    """The info of one environment, from the infos of all: arrays, each with a mask under its name and an underscore,
    https://gymnasium.farama.org/main/api/vector/. Some vectors leave the masks out."""
    own: dict[str, Any] = {}
    for key, value in infos.items() if isinstance(infos, Mapping) else ():
        mask = infos.get(f"_{key}")
        if (key.startswith("_") and key[1:] in infos) or (mask is not None and not mask[index]):
            continue
        if isinstance(value, Mapping):
            own[key] = info_of(value, index, count)
        elif not isinstance(value, str) and _length(value) == count:
            own[key] = value[index]
    return own


def _length(batch: Any) -> int:
    try:
        return len(batch)
    except TypeError:
        return 0
