"""What an agent sees and does, in the form that the algorithm works with.

Observations and actions are dictionaries by key, always walked in sorted order. One time step of each, after any
leading axes:

  Vector    float [..., size]
  Discrete  int   [..., len(classes)], entry i in 0 .. classes[i]-1
  Image     uint8 [..., height, width, channels]

A flat action [..., action_size] is the concatenation over the keys of a Vector as it is and of a Discrete as one
one-hot per entry. Chapter: spec/00-notation.md.
"""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True)
class Vector:
    """`size` real numbers."""

    size: int

    @property
    def encoded_size(self) -> int:
        return self.size

    @property
    def array_shape(self) -> tuple[int, ...]:
        return (self.size,)

    def __post_init__(self) -> None:
        if self.size < 1:
            raise ValueError(f"a Vector needs at least one number, got size {self.size}")


@dataclasses.dataclass(frozen=True)
class Discrete:
    """One whole number for each entry of `classes`, below that entry."""

    classes: tuple[int, ...]

    @property
    def encoded_size(self) -> int:
        return sum(self.classes)

    @property
    def array_shape(self) -> tuple[int, ...]:
        return (len(self.classes),)

    def __post_init__(self) -> None:
        if not self.classes or min(self.classes) < 1:
            raise ValueError(f"a Discrete needs class counts of at least 1, got {self.classes}")


@dataclasses.dataclass(frozen=True)
class Image:
    """height x width x channels of uint8."""

    height: int
    width: int
    channels: int

    @property
    def array_shape(self) -> tuple[int, ...]:
        return (self.height, self.width, self.channels)

    def __post_init__(self) -> None:
        if min(self.array_shape) < 1:
            raise ValueError(f"an Image needs positive sides and channels, got {self.array_shape}")


_KEY = re.compile(r"[A-Za-z0-9_-]+")
_RESERVED = frozenset(
    {"reward", "continue_", "is_first", "is_last", "is_terminal", "prev_action", "action", "deter", "stoch", "ids"}
)


@dataclasses.dataclass(frozen=True)
class Spaces:
    """The observations and actions of a task.

    Raises:
      ValueError: no observation or no action, a key that cannot name a parameter or that a record, a batch or a
        prediction uses itself, or images of different sizes.
    """

    observations: Mapping[str, Vector | Discrete | Image]
    actions: Mapping[str, Vector | Discrete]

    def __post_init__(self) -> None:
        object.__setattr__(self, "observations", dict(sorted(self.observations.items())))
        object.__setattr__(self, "actions", dict(sorted(self.actions.items())))
        if not self.observations or not self.actions:
            raise ValueError("a task needs at least one observation and one action")
        for key in (*self.observations, *self.actions):
            if not _KEY.fullmatch(key):
                raise ValueError(f"the key {key!r} may hold only letters, digits, '_' and '-'")
        for key in sorted(_RESERVED.intersection(self.observations)):
            raise ValueError(f"the observation key {key!r} is reserved for records, batches and predictions; rename it")
        if len({(image.height, image.width) for image in self.images.values()}) > 1:
            raise ValueError(f"all images must share height and width, got {self.images}")

    @property
    def images(self) -> dict[str, Image]:
        return {key: space for key, space in self.observations.items() if isinstance(space, Image)}

    @property
    def vectors(self) -> dict[str, Vector | Discrete]:
        """The observations that are not images."""
        return {key: space for key, space in self.observations.items() if not isinstance(space, Image)}

    @property
    def image_channels(self) -> int:
        return sum(image.channels for image in self.images.values())

    @property
    def action_size(self) -> int:
        """Length of a flat action."""
        return sum(space.encoded_size for space in self.actions.values())

    @property
    def action_noise_size(self) -> int:
        """Random numbers that one action takes: a normal for each real number, a uniform for each categorical."""
        return sum(space.array_shape[0] for space in self.actions.values())

    def to_json(self) -> dict[str, Any]:
        """A description in plain JSON types, for checkpoints."""

        def describe(space: Vector | Discrete | Image) -> dict[str, Any]:
            return {"kind": type(space).__name__.lower(), **dataclasses.asdict(space)}

        return {
            "observations": {key: describe(space) for key, space in self.observations.items()},
            "actions": {key: describe(space) for key, space in self.actions.items()},
        }

    @classmethod
    def from_json(cls, description: Any) -> "Spaces":
        """The inverse of `to_json`.

        Raises:
          ValueError: anything that `to_json` does not write.
        """
        match description:
            case {"observations": dict(observations), "actions": dict(actions)}:
                return cls(
                    {key: _from_json(f"observation {key!r}", entry, _OBSERVED) for key, entry in observations.items()},
                    {key: _from_json(f"action {key!r}", entry, _CHOSEN) for key, entry in actions.items()},
                )
        raise ValueError(f"spaces: expected an object with observations and actions, got {description!r:.80}")


_OBSERVED, _CHOSEN = (Vector, Discrete, Image), (Vector, Discrete)


def _from_json(name: str, entry: Any, kinds: tuple[type, ...]) -> Any:
    space: Any = None
    match entry:
        case {"kind": "vector", "size": size} if _whole(size):
            space = Vector(size)
        case {"kind": "discrete", "classes": [*classes]} if _whole(*classes):
            space = Discrete(tuple(classes))
        case {"kind": "image", "height": h, "width": w, "channels": c} if _whole(h, w, c):
            space = Image(h, w, c)
    if not isinstance(space, kinds):
        expected = " or ".join(kind.__name__.lower() for kind in kinds)
        raise ValueError(f"{name}: expected a {expected} space, got {entry!r:.80}")
    return space


def _whole(*numbers: Any) -> bool:
    return all(type(number) is int for number in numbers)
