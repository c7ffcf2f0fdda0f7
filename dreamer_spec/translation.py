"""How an environment's values become the arrays of `spec.spaces`, and flat actions the environment's. NumPy alone: a
policy holds it.

Chapter: spec/12-training-loop.md, Spaces. What a Gymnasium space becomes is decided in dreamer_spec/envs/spaces.py.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from dreamer_spec.resize import resize
from reference_numpy.training_loop import environment_action
from spec import Discrete, Image, Spaces, Vector

Path = tuple[
    str | int, ...
]  # the keys of Dicts and the places in Tuples that lead to a value; () for a space that is neither
Target = Vector | Discrete | Image

LEAST_SIDE = 16  # pixels of an image, see E-18
DTYPES = frozenset(
    {"bool", "float16", "float32", "float64", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
)


@dataclasses.dataclass(frozen=True)
class Entry:
    """One value of the environment.

    path: where it lies. shape, dtype: its form there. scalar: it is one number, not an array.
    low, high: of an image, the numbers that become 0 and 255; of a real-valued action, its bounds in row-major order,
    infinite where there is none; low of choices, the numbers that they are counted from. One number stands for as many
    equal ones. Empty where bounds do not count.
    """

    path: Path
    shape: tuple[int, ...]
    dtype: str
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    scalar: bool = False


@dataclasses.dataclass(frozen=True)
class Translation:
    """observations, actions: key of `spaces` -> value of the environment. left_out: paths of observations that are not
    used.

    lines: what was understood, for people; see dreamer_spec/envs/spaces.py.
    """

    spaces: Spaces
    observations: Mapping[str, Entry]
    actions: Mapping[str, Entry]
    left_out: tuple[Path, ...] = ()
    lines: tuple[str, ...] = dataclasses.field(default=(), compare=False)

    def observation(self, value: Any) -> dict[str, np.ndarray]:
        """One observation of the environment -> key -> array as in `spec.spaces`, always in memory of its own.
        [LOOP-31]

        Raises:
          ValueError: a missing or unexpected entry, a wrong dtype or shape, a NaN or an infinity, a number outside of
            an image's or a discrete space.
        """
        wanted = {entry.path for entry in self.observations.values()}
        values = dict(_values(value, wanted, wanted | set(self.left_out)))
        return {
            key: _encode(key, values[entry.path], entry, self.spaces.observations[key])
            for key, entry in self.observations.items()
        }

    def action(self, flat: Any) -> Any:
        """A flat action [A] -> what the environment receives, always in memory of its own. [LOOP-12], [LOOP-60]

        Raises:
          ValueError: a wrong shape or a number that is not finite.
        """
        return self.batch_of_actions(np.asarray(flat)[None])[0]

    def batch_of_actions(self, flat: np.ndarray) -> list[Any]:
        """`action` of each of N flat actions [N, A]; one call, because each takes as long as a step of a simple
        environment."""
        reals = {key: entry for key, entry in self.actions.items() if isinstance(self.spaces.actions[key], Vector)}
        low, high = (
            {key: np.broadcast_to(getattr(entry, bound), math.prod(entry.shape)) for key, entry in reals.items()}
            for bound in ("low", "high")
        )
        parts = environment_action(flat, self.spaces, low, high)
        return [
            _nested(
                [(entry.path, _decode(parts[key][row], entry, key in reals)) for key, entry in self.actions.items()]
            )
            for row in range(len(flat))
        ]

    def differences(self, other: "Translation") -> list[str]:
        """A text for each key that is not the same in another environment."""
        mine, theirs = self._parts(), other._parts()
        changed = [name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name)]
        return [f"{name} is {_show(*theirs.get(name, ()))}, elsewhere {_show(*mine.get(name, ()))}" for name in changed]

    def _parts(self) -> dict[str, tuple[Target, Entry]]:
        observations = {
            f"observation {key!r}": (self.spaces.observations[key], entry) for key, entry in self.observations.items()
        }
        return observations | {
            f"action {key!r}": (self.spaces.actions[key], entry) for key, entry in self.actions.items()
        }

    def to_json(self) -> dict[str, Any]:
        """All but the spaces and the lines, in plain JSON types. An infinite bound is null."""
        described = {
            name: {key: _described(entry) for key, entry in getattr(self, name).items()}
            for name in ("observations", "actions")
        }
        return {**described, "left_out": [list(path) for path in self.left_out]}

    @classmethod
    def from_json(cls, description: Any, spaces: Spaces) -> "Translation":
        """The inverse of `to_json`, once through JSON.

        Raises:
          ValueError: anything that `to_json` does not write for these spaces.
        """
        match description:
            case {"observations": dict(observations), "actions": dict(actions), "left_out": [*left_out]} if (
                len(description) == 3
            ):
                result = cls(
                    spaces,
                    _entries("observation", observations, spaces.observations),
                    _entries("action", actions, spaces.actions),
                    tuple(_path(entry) for entry in left_out),
                )
                _require_tree([*(entry.path for entry in result.observations.values()), *result.left_out])
                _require_tree([entry.path for entry in result.actions.values()])
                return result
        raise ValueError(
            f"translation: expected the objects observations and actions and the list left_out, got {description!r:.80}"
        )


def side_axes(shape: tuple[int, ...]) -> tuple[int, int] | None:
    """The two axes of an image's rows and columns: neighbours, and the only ones of at least LEAST_SIDE entries.
    [LOOP-55]"""
    long = [axis for axis, size in enumerate(shape) if size >= LEAST_SIDE]
    return (long[0], long[1]) if len(long) == 2 and long[1] == long[0] + 1 and 2 <= len(shape) <= 4 else None


def _show(target: Target | None = None, entry: Entry | None = None) -> str:
    """Vector(size=2) of float32 [2] in -1.0, 1.0"""
    if entry is None:
        return "missing"
    bounds = ", ".join(str(list(bound)).strip("[]")[:60] for bound in (entry.low, entry.high) if bound)
    return f"{target} of {entry.dtype} {list(entry.shape)}" + (f" in {bounds}" if bounds else "")


# Observations


def _values(value: Any, wanted: set[Path], known: set[Path], path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """The wanted entries of an observation by path; every one must be there, and nothing that is not known."""
    if path in wanted:
        yield path, value
        return
    below = [entry[len(path)] for entry in known if entry[: len(path)] == path and entry != path]
    expected = sorted({entry[len(path)] for entry in wanted if entry[: len(path)] == path}, key=str)
    name = "/".join(map(str, path)) or "observation"
    if any(isinstance(key, int) for key in below):
        size = 1 + max(key for key in below if isinstance(key, int))
        if not isinstance(value, tuple | list) or len(value) != size:
            raise ValueError(f"observation {name!r} is a {type(value).__name__}; its space is a Tuple of {size}")
        entries: dict[Any, Any] = dict(enumerate(value))
    else:
        if not isinstance(value, Mapping):
            raise ValueError(
                f"observation {name!r} is a {type(value).__name__}; its space is a Dict "
                f"with the keys {_names(expected)}"
            )
        entries = {str(key): entry for key, entry in value.items()}
        if missing := [key for key in expected if key not in entries]:
            raise ValueError(f"observation {name!r} lacks the keys {_names(missing)} of its space")
        if extra := sorted(entries.keys() - set(below)):
            raise ValueError(f"observation {name!r} has the keys {_names(extra)} that its space does not have")
    for key in expected:
        yield from _values(entries[key], wanted, known, (*path, key))


def _names(keys: Iterable[Any]) -> str:
    return ", ".join(map(str, keys))


def _encode(key: str, value: Any, entry: Entry, target: Target) -> np.ndarray:
    array = np.asarray(value)
    if array.shape != entry.shape:
        raise ValueError(f"observation {key!r} has shape {array.shape}; its space says {entry.shape}")
    if not np.can_cast(
        array.dtype, entry.dtype, casting="same_kind"
    ):  # float64 for float32 is welcome, float for uint8 is not
        raise ValueError(f"observation {key!r} has dtype {array.dtype}; its space says {entry.dtype}")
    if isinstance(target, Image):
        return _image(key, array, entry, target)
    if isinstance(target, Vector):
        with np.errstate(over="ignore"):
            vector = np.array(array, np.float32).reshape(-1)
        if not np.isfinite(vector).all():
            worst = vector[~np.isfinite(vector)][0]
            raise ValueError(f"observation {key!r} holds {worst} (a number that float32 cannot hold, or not a number)")
        return vector
    first = np.broadcast_to(np.array(entry.low, np.int64), len(target.classes))
    choices = array.reshape(-1).astype(np.int64) - first
    if (wrong := (choices < 0) | (choices >= target.classes)).any():
        at = int(np.flatnonzero(wrong)[0])
        space = f"{first[at]} to {first[at] + target.classes[at] - 1}"
        raise ValueError(f"observation {key!r} holds {array.reshape(-1)[at]}, outside its space: {space}")
    return choices


def _image(key: str, array: np.ndarray, entry: Entry, target: Image) -> np.ndarray:
    """[LOOP-55], [LOOP-56]: rows and columns first, every other axis flattened to channels, numbers as uint8, then the
    size."""
    axes = side_axes(entry.shape)
    assert axes is not None
    image = np.moveaxis(array, axes, (0, 1)).reshape(entry.shape[axes[0]], entry.shape[axes[1]], -1)
    (low,), (high,) = entry.low, entry.high
    if (image.dtype, low, high) != (np.uint8, 0, 255):
        pixels = np.rint((image.astype(np.float64) - low) / (high - low) * 255)
        if not ((pixels >= 0) & (pixels <= 255)).all():  # a NaN is neither
            wrong = image[~((pixels >= 0) & (pixels <= 255))][0]
            raise ValueError(f"observation {key!r} holds {wrong}, outside the bounds of its space: {low:g} to {high:g}")
        image = pixels.astype(np.uint8)
    return resize(image, target.height, target.width)


# Actions


def _decode(part: np.ndarray, entry: Entry, real: bool) -> Any:
    """One action in the environment's shape and dtype; choices counted from where the environment counts."""
    value = (part if real else part + np.array(entry.low, np.int64)).reshape(entry.shape).astype(entry.dtype)
    return value[()] if entry.scalar else value


def _nested(values: list[tuple[Path, Any]]) -> Any:
    """Dicts and tuples with each value at its path."""
    if values[0][0] == ():
        return values[0][1]
    inside: dict[str | int, list[tuple[Path, Any]]] = {}
    for path, value in values:
        inside.setdefault(path[0], []).append((path[1:], value))
    entries = {key: _nested(below) for key, below in inside.items()}
    return tuple(entries[place] for place in range(len(entries))) if isinstance(values[0][0][0], int) else entries


# Descriptions


def _described(entry: Entry) -> dict[str, Any]:
    bounds = {name: [None if math.isinf(n) else n for n in getattr(entry, name)] for name in ("low", "high")}
    return {**dataclasses.asdict(entry), **bounds}


# Descriptions that nobody vouches for


def _entries(kind: str, description: dict[str, Any], targets: Mapping[str, Target]) -> dict[str, Entry]:
    if description.keys() != targets.keys():
        raise ValueError(f"translation: expected the {kind}s {_names(targets)}, got {_names(description):.80}")
    return {
        key: _entry(f"{kind} {key!r}", description[key], target, kind == "action") for key, target in targets.items()
    }


def _entry(name: str, description: Any, target: Target, acts: bool) -> Entry:
    match description:
        case {
            "path": path,
            "shape": [*shape],
            "dtype": str(dtype),
            "low": [*low],
            "high": [*high],
            "scalar": bool(scalar),
        } if (
            len(description) == 6
            and dtype in DTYPES
            and all(number is None or _is_finite(number) for number in (*low, *high))
            and all(map(_is_size, shape))
        ):
            bottom, top = (
                tuple(missing if number is None else number for number in bound)
                for bound, missing in ((low, -math.inf), (high, math.inf))
            )
            entry = Entry(_path(path), tuple(shape), dtype, bottom, top, scalar)
            most = _bounds(target, acts)
            if all(len(bound) in (min(1, size), size) for bound, size in zip((low, high), most, strict=True)) and _fits(
                entry, target
            ):
                return entry
    raise ValueError(f"translation of the {name}: {description!r:.200} does not fit {target}")


def _bounds(target: Target, acts: bool) -> tuple[int, int]:
    """How many numbers `low` and `high` stand for."""
    match target:
        case Image():
            return 1, 1
        case Discrete():
            return len(target.classes), 0
        case Vector():
            return (target.size, target.size) if acts else (0, 0)


def _fits(entry: Entry, target: Target) -> bool:
    size = math.prod(entry.shape)
    if entry.scalar and entry.shape:
        return False
    match target:
        case Image():
            axes = side_axes(entry.shape)
            return (
                axes is not None
                and size == entry.shape[axes[0]] * entry.shape[axes[1]] * target.channels
                and all(map(math.isfinite, (*entry.low, *entry.high)))
                and entry.low < entry.high
            )
        case Discrete():
            last = 2**63 - max(target.classes)
            return size == len(target.classes) and all(type(low) is int and -(2**63) <= low < last for low in entry.low)
        case Vector():
            return size == target.size and (not entry.low or bool(np.all(np.array(entry.low) <= np.array(entry.high))))


def _path(description: Any) -> Path:
    if not isinstance(description, list) or not all(isinstance(key, str) or _is_size(key) for key in description):
        raise ValueError(f"translation: {description!r:.80} is not a path of keys and places")
    return tuple(description)


def _require_tree(paths: list[Path]) -> None:
    """Raises:
    ValueError: these cannot be the paths to the values of one nested Dict or Tuple.
    """
    inside: dict[Path, set[str | int]] = {}
    for path in paths:
        for depth, key in enumerate(path):
            inside.setdefault(path[:depth], set()).add(key)
    for path, keys in inside.items():
        places = sorted(key for key in keys if isinstance(key, int))
        if places and places != list(range(len(keys))):
            raise ValueError(f"translation: the places {places} below {list(path)} are not those of a Tuple")
    if len(set(paths)) != len(paths) or not inside.keys().isdisjoint(paths):
        raise ValueError("translation: two values lie at one path")


def _is_finite(number: Any) -> bool:
    return type(number) is int or (type(number) is float and math.isfinite(number))


def _is_size(number: Any) -> bool:
    return type(number) is int and 0 <= number < 2**31
