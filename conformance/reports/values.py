"""Arguments and results as text for people, and as Python source that makes them again."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from spec import Config, load_config

WHOLE = 64  # an array of so many numbers is shown whole
WRITTEN_OUT = 128  # a call with so many numbers in all is written out as source
LEAVES = 12  # a nested argument of so many arrays is shown array by array
NEIGHBOURS = 2  # of the worst element, on each side along the last axis
FIRST = 5
BRIEF = 8  # values of a call in a terminal
WIDTH = 100


def shown(name: str, value: Any, index: tuple[int, ...] | None = None) -> list[dict[str, Any]]:
    """Entries with name, type, text, and whether the text is the whole value; a nested value gives one for each of its
    arrays.

    index: of the element that matters, in an array.
    """
    leaves = list(_leaves(name, value))
    if len(leaves) > LEAVES:
        numbers = sum(np.size(leaf) for _, leaf in leaves)
        text = "\n".join(f"{label} {_shape(np.shape(leaf))}" for label, leaf in leaves)
        return [{"name": name, "type": f"{len(leaves)} arrays, {numbers:,} numbers", "text": text, "whole": False}]
    return [_shown_leaf(label, leaf, index) for label, leaf in leaves]


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _leaves(f"{name}[{key}]", entry)
    elif isinstance(value, tuple | list):
        for position, entry in enumerate(value):
            yield from _leaves(f"{name}[{position}]", entry)
    else:
        yield name, value


def _shown_leaf(name: str, value: Any, index: tuple[int, ...] | None) -> dict[str, Any]:
    if not isinstance(value, np.ndarray):
        text = source(value) if is_known(value) else f"{value!r:.200}"
        return {"name": name, "type": type(value).__name__, "text": text, "whole": is_known(value)}
    whole = value.size <= WHOLE
    text = array_text(value) if whole else _around(value, index) if index is not None else _extent(value)
    return {"name": name, "type": f"{value.dtype} {_shape(value.shape)}", "text": text, "whole": whole}


def _shape(shape: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, shape))}]"


def _around(array: np.ndarray, index: tuple[int, ...]) -> str:
    """The worst element and its neighbours along the last axis."""
    *rows, column = index
    start, stop = max(0, column - NEIGHBOURS), min(array.shape[-1], column + NEIGHBOURS + 1)
    place = ", ".join([*map(str, rows), f"{start}:{stop}"])
    return (
        f"the worst element, at {_shape(index)}: {number(array[index])}\n[{place}] = "
        f"{array_text(array[tuple(rows)][start:stop])}"
    )


def _extent(array: np.ndarray) -> str:
    """What can be said of an array in two lines."""
    finite = array[np.isfinite(array)]
    bad = array.size - finite.size
    sizes = [f"from {number(finite.min())} to {number(finite.max())}"] if finite.size else []
    sizes += [f"{bad} not finite"] if bad else []
    first = ", ".join(number(value) for value in array.flat[:FIRST])
    return f"{', '.join(sizes)}\nthe first: {first}, ..."


def brief(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each value of `shown`: the value itself where it fits into two lines, else its type. After BRIEF
    lines, dots."""
    lines = []
    for entry in entries[:BRIEF]:
        text = " ".join(entry["text"].split())
        is_small = entry["whole"] and len(text) <= 2 * WIDTH
        lines.append(f"{entry['name']} = {text}" if is_small else f"{entry['name']}: {entry['type']}")
    return lines + ["..."] * (len(entries) > BRIEF)


def number(value: Any) -> str:
    """A number as Python source: every digit, and np.nan and np.inf."""
    plain = value.item() if isinstance(value, np.generic) else value
    if isinstance(plain, float) and not math.isfinite(plain):
        return "np.nan" if math.isnan(plain) else f"{'-' if plain < 0 else ''}np.inf"
    return repr(plain)


def array_text(array: np.ndarray) -> str:
    """Every number of an array, in brackets."""
    return np.array2string(
        array, max_line_width=WIDTH, separator=", ", threshold=array.size + 1, formatter={"all": number}
    )


def is_known(value: Any) -> bool:
    """Whether `source` can write it."""
    if isinstance(value, Mapping):
        return all(map(is_known, value.values()))
    if isinstance(value, tuple | list):
        return all(map(is_known, value))
    return value is None or isinstance(value, bool | int | float | str | np.ndarray | np.generic) or _is_ours(value)


def _is_ours(value: Any) -> bool:
    """A configuration, spaces or an entry of the parameter table."""
    return dataclasses.is_dataclass(value) and type(value).__module__.partition(".")[0] == "spec"


def size(value: Any) -> int:
    """How many numbers a nested value has."""
    return sum(np.size(leaf) for _, leaf in _leaves("", value))


def source(value: Any) -> str:
    """Python source that makes the value, with np, load_config and the classes of `spec` in scope."""
    if isinstance(value, np.ndarray):
        if not value.size:
            return f"np.zeros({value.shape}, np.dtype({value.dtype.name!r}))"
        is_default = value.dtype in (np.float64, np.int64, np.bool_)
        return f"np.array({array_text(value)}{'' if is_default else f', np.dtype({value.dtype.name!r})'})"
    if isinstance(value, np.generic):
        return (
            number(value)
            if value.dtype in (np.float64, np.int64, np.bool_)
            else f"np.dtype({value.dtype.name!r}).type({number(value)})"
        )
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key!r}: {source(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, tuple):
        return f"({', '.join(map(source, value))}{',' if len(value) == 1 else ''})"
    if isinstance(value, list):
        return f"[{', '.join(map(source, value))}]"
    if isinstance(value, Config):
        return _config_source(value)
    if dataclasses.is_dataclass(value):
        fields = ", ".join(f"{field.name}={source(getattr(value, field.name))}" for field in dataclasses.fields(value))
        return f"{type(value).__name__}({fields})"
    return number(value)


def _config_source(config: Config) -> str:
    """`load_config` with what differs from the profile `paper` in the size `tiny`."""
    base = load_config("paper", "tiny")
    names = [field.name for field in dataclasses.fields(config)]
    changed = [
        f"{name}={source(getattr(config, name))}" for name in names if getattr(config, name) != getattr(base, name)
    ]
    arguments = ", ".join(["'paper'", "'tiny'", *changed])
    return f"load_config({arguments})"
