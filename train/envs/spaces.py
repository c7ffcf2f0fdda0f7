"""Gymnasium spaces and values, translated to `spec.Spaces` and its arrays.

Observations  Box uint8 [H, W], or [H, W, C] with C = 1, 3 or 4   -> Image, resized to image_size x image_size
              any other Box                                       -> Vector, flattened
              Discrete, MultiDiscrete, MultiBinary                -> Discrete, counted from 0
Actions       Box of floats                                       -> Vector; -1 and 1 are the bounds
              Discrete, MultiDiscrete, MultiBinary                -> Discrete

A Dict, also nested, gives one key per entry (`{"arm": {"angle": ...}}` -> `arm_angle`). A space that is not a Dict gets the key
`observation` or `action`.
"""

import dataclasses
import importlib
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces as gym

from spec import Discrete, Image, Spaces, Vector
from train.errors import UserError

Path = tuple[str, ...]

MOST_NUMBERS = 2**20  # that one observation or action may become


@dataclasses.dataclass(frozen=True)
class Translation:
    """How one task's values become arrays of the contract, and flat actions become the task's actions.

    observations, actions: key -> (path inside the task's Dict, Gymnasium space of that entry).
    """

    spaces: Spaces
    observations: Mapping[str, tuple[Path, gym.Space[Any]]]
    actions: Mapping[str, tuple[Path, gym.Space[Any]]]

    def observation(self, value: Any) -> dict[str, np.ndarray]:
        """One observation of the task -> key -> array as in `spec.spaces`, always in memory of its own.

        Raises:
          UserError: a missing or unexpected entry, a wrong dtype or shape, a NaN or an infinity, a number outside a discrete space.
        """
        entries = dict(_values(value, {path for path, _ in self.observations.values()}))
        return {key: _encode(key, entries[path], space, self.spaces.observations[key]) for key, (path, space) in self.observations.items()}

    def action(self, flat: np.ndarray) -> Any:
        """A flat action [A] -> an action of the task: reals are clipped to [-1, 1] and scaled to finite bounds."""
        result: Any = None
        start = 0
        for key, target in self.spaces.actions.items():
            path, space = self.actions[key]
            part = flat[start : start + target.encoded_size]
            start += target.encoded_size
            value = _decode_box(part, space) if isinstance(space, gym.Box) else _decode_choices(part, target, space)
            result = _insert(result, path, value)
        return result


def translate(observation_space: gym.Space[Any], action_space: gym.Space[Any], image_size: int = 64) -> Translation:
    """The translation of a task's spaces.

    Raises:
      UserError: a space that has no translation; the message names its key.
    """
    observations = _keyed(observation_space, "observation")
    actions = _keyed(action_space, "action")
    try:
        spaces = Spaces(
            {key: _observation_target(key, space, image_size) for key, (_, space) in observations.items()},
            {key: _action_target(key, space) for key, (_, space) in actions.items()},
        )
    except ValueError as error:
        raise UserError(f"unsupported spaces: {error}") from error
    for kind, entries in (("observation", spaces.vectors), ("action", spaces.actions)):
        for key, entry in entries.items():
            if entry.encoded_size > MOST_NUMBERS:  # Before anything is allocated for it.
                raise UserError(
                    f"the {kind} {key!r} becomes {entry.encoded_size:,} numbers; expected at most {MOST_NUMBERS:,}: describe it by fewer, "
                    "such as the digits of a number or its features, with a wrapper of your own"
                )
    return Translation(spaces, observations, actions)


def random_actions(spaces: Spaces, rng: np.random.Generator, count: int) -> np.ndarray:
    """`count` flat actions [count, A]: reals uniform in [-1, 1), choices uniform over the classes."""
    parts: list[np.ndarray] = []
    for space in spaces.actions.values():
        if isinstance(space, Vector):
            parts.append(rng.uniform(-1.0, 1.0, (count, space.size)))
        else:
            parts += [rng.integers(classes, size=count)[:, None] == np.arange(classes) for classes in space.classes]
    return np.concatenate(parts, axis=1, dtype=np.float32)


# Spaces


def _keyed(space: gym.Space[Any], kind: str) -> dict[str, tuple[Path, gym.Space[Any]]]:
    keyed: dict[str, tuple[Path, gym.Space[Any]]] = {}
    for path, leaf in _leaves(space, ()):
        key = re.sub(r"[^A-Za-z0-9_-]", "_", "_".join(path)) or kind
        if key in keyed:
            raise UserError(f"unsupported {kind} space: {keyed[key][0]} and {path} both become the key {key!r}; rename one")
        keyed[key] = (path, leaf)
    return keyed


def _leaves(space: gym.Space[Any], path: Path) -> Iterator[tuple[Path, gym.Space[Any]]]:
    if isinstance(space, gym.Dict):
        for key, entry in space.spaces.items():
            yield from _leaves(entry, (*path, str(key)))
    else:
        yield path, space


def _observation_target(key: str, space: gym.Space[Any], image_size: int) -> Vector | Discrete | Image:
    if isinstance(space, gym.Box):
        if _is_image(space):
            return Image(image_size, image_size, space.shape[2] if len(space.shape) == 3 else 1)
        if space.dtype == np.uint8 and len(space.shape) == 3 and space.shape[0] < min(space.shape[1:]):
            raise _unsupported(
                "observation", key, space, "this looks like an image with channels first; give it as height, width, channels"
            )
        if space.dtype.kind in "fiub" and 0 not in space.shape:
            return Vector(int(np.prod(space.shape)))
    if (classes := _classes(space)) is not None:
        return Discrete(classes)
    raise _unsupported("observation", key, space, "supported: Dict, Box, Discrete, MultiDiscrete, MultiBinary")


def _action_target(key: str, space: gym.Space[Any]) -> Vector | Discrete:
    if isinstance(space, gym.Box) and space.dtype.kind == "f" and 0 not in space.shape:
        return Vector(int(np.prod(space.shape)))
    if (classes := _classes(space)) is not None:
        return Discrete(classes)
    raise _unsupported("action", key, space, "supported: Dict, Box of floats, Discrete, MultiDiscrete, MultiBinary")


def _unsupported(kind: str, key: str, space: gym.Space[Any], remedy: str) -> UserError:
    return UserError(f"unsupported space of the {kind} {key!r}: {space}; {remedy}")


def _is_image(space: gym.Box) -> bool:
    """A uint8 box [H, W], or [H, W, C] with fewer channels than rows and columns: colours, or several frames."""
    return space.dtype == np.uint8 and (len(space.shape) == 2 or (len(space.shape) == 3 and space.shape[2] <= min(space.shape[:2])))


def _classes(space: gym.Space[Any]) -> tuple[int, ...] | None:
    """The class count of each entry of a discrete space; None for other spaces."""
    if isinstance(space, gym.Discrete):
        return (int(space.n),)
    if isinstance(space, gym.MultiDiscrete):
        return tuple(int(n) for n in space.nvec.ravel())
    if isinstance(space, gym.MultiBinary):
        return (2,) * int(np.prod(space.shape))
    return None


def _start(space: gym.Space[Any]) -> Any:
    """The number that a discrete space counts from: a scalar, or an array of the space's shape."""
    return getattr(space, "start", 0)


# Observations


def _values(value: Any, paths: set[Path], path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """The entries of an observation by path; every path must be there, and nothing else."""
    if path in paths:
        yield path, value
        return
    expected = sorted({full[len(path)] for full in paths if full[: len(path)] == path})
    name = "/".join(path) or "observation"
    if not isinstance(value, Mapping):
        raise UserError(f"observation {name!r} is a {type(value).__name__}; its space is a Dict with the keys {', '.join(expected)}")
    entries = {str(key): entry for key, entry in value.items()}
    if missing := [key for key in expected if key not in entries]:
        raise UserError(f"observation {name!r} lacks the keys {', '.join(missing)} of its space")
    if extra := sorted(entries.keys() - set(expected)):
        raise UserError(f"observation {name!r} has the keys {', '.join(extra)} that its space does not have")
    for key in expected:
        yield from _values(entries[key], paths, (*path, key))


def _encode(key: str, value: Any, space: gym.Space[Any], target: Vector | Discrete | Image) -> np.ndarray:
    array = _checked_array(key, value, space)
    if isinstance(target, Image):
        return _resize(array.reshape(*array.shape[:2], -1), target)
    if isinstance(target, Vector):
        with np.errstate(over="ignore"):
            vector = np.array(array, np.float32).reshape(-1)
        if not np.isfinite(vector).all():
            worst = vector[~np.isfinite(vector)][0]
            raise UserError(f"observation {key!r} holds {worst} (a number that float32 cannot hold, or not a number)")
        return vector
    counted = array.astype(np.int64) - _start(space)
    choices = counted.reshape(-1)
    if (choices < 0).any() or (choices >= target.classes).any():
        raise UserError(f"observation {key!r} is {value!r}, outside its space {space}")
    return choices


def _checked_array(key: str, value: Any, space: gym.Space[Any]) -> np.ndarray:
    """The value as an array of the space's shape and of a dtype of its kind: float64 for float32 is welcome, float for uint8 is not."""
    array = np.asarray(value)
    if array.shape != space.shape:
        raise UserError(f"observation {key!r} has shape {array.shape}; its space says {space.shape}")
    if not np.can_cast(array.dtype, np.dtype(space.dtype), casting="same_kind"):
        raise UserError(f"observation {key!r} has dtype {array.dtype}; its space says {space.dtype}")
    return array


def _resize(image: np.ndarray, target: Image) -> np.ndarray:
    """[H, W, C] uint8 -> [height, width, C], bilinear. Channel by channel unless RGB: Pillow would take a fourth channel for opacity."""
    if image.shape == target.array_shape:
        return np.array(image, np.uint8)
    pillow = _pillow(image.shape, target)
    size = (target.width, target.height)
    image = np.ascontiguousarray(image, np.uint8)
    if target.channels == 3:
        return np.array(pillow.fromarray(image).resize(size, pillow.Resampling.BILINEAR))
    channels = [np.asarray(pillow.fromarray(image[..., c]).resize(size, pillow.Resampling.BILINEAR)) for c in range(target.channels)]
    return np.stack(channels, axis=-1)


def _pillow(shape: tuple[int, ...], target: Image) -> Any:
    """Pillow, which acting needs only where an image has another size."""
    try:
        return importlib.import_module("PIL.Image")
    except ModuleNotFoundError as error:
        sizes = f"{shape[0]} x {shape[1]} pixels to {target.height} x {target.width}"
        raise UserError(f"resizing an image of {sizes} needs Pillow: pip install pillow") from error


# Actions


def _decode_box(part: np.ndarray, space: gym.Box) -> np.ndarray:
    """Clipped to [-1, 1], then scaled to the bounds where both are finite; elsewhere only a one-sided bound still clips."""
    clipped = np.clip(part.astype(np.float64).reshape(space.shape), -1.0, 1.0)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    finite = np.isfinite(low) & np.isfinite(high)
    scale = np.where(finite, high, 1.0) - np.where(finite, low, -1.0)
    scaled = np.where(finite, np.where(finite, low, -1.0) + (clipped + 1.0) / 2.0 * scale, clipped)
    return np.clip(scaled, low, high).astype(space.dtype)


def _decode_choices(part: np.ndarray, target: Vector | Discrete, space: gym.Space[Any]) -> Any:
    assert isinstance(target, Discrete)
    groups = np.split(part, np.cumsum(target.classes)[:-1])
    choices = np.array([np.argmax(group) for group in groups], np.int64).reshape(space.shape or ())
    value = (choices + _start(space)).astype(space.dtype)
    return value[()] if isinstance(space, gym.Discrete) else value


def _insert(tree: Any, path: Path, value: Any) -> Any:
    """The tree of dictionaries with the value added at the path."""
    if not path:
        return value
    tree = {} if tree is None else tree
    tree[path[0]] = _insert(tree.get(path[0]), path[1:], value)
    return tree
