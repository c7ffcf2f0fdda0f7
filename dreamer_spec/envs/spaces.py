"""Gymnasium spaces, translated to `spec.Spaces`: what each becomes, and a line that says so. The table is in
docs/environments.md.

A Dict or Tuple, also nested, gives one key per entry (`{"arm": {"angle": ...}}` -> `arm_angle`; places in a Tuple are
counted from 0). A space that is neither gets the key `observation` or `action`.
"""

import fnmatch
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces as gym

from dreamer_spec.errors import UserError
from dreamer_spec.translation import DTYPES, LEAST_SIDE, Entry, Path, Target, Translation, side_axes
from dreamer_spec.words import counted
from reference_numpy.training_loop import environment_action
from spec import Discrete, Image, Spaces, Vector

NO_BOUND = 1e6  # from here on a bound is none, see E-20
MOST_CODES = 32  # values of an entry of a board that become one-hots, see E-19
MOST_ENCODED = 8_192  # length of all one-hots of a board
MOST_CHOICES = 256  # values of a whole number that is an action
MOST_ENTRIES, MOST_NUMBERS = 32_768, 2**20  # of discrete spaces; that one observation or action may become
MANY = 1_024  # numbers of a box of several axes that could be meant as an image
CODES = "if its numbers are codes, declare the highest of them as `high` of the Box"

Leaf = tuple[Path, gym.Space[Any]]


class Meaning(NamedTuple):
    """What a space becomes, and in words: what was declared, what it becomes, and what of it may surprise."""

    target: Target
    entry: Entry
    declared: str
    words: str
    warnings: tuple[str, ...] = ()


def translate(
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    image_size: int = 64,
    use: Sequence[str] = (),
    leave_out: Sequence[str] = (),
) -> Translation:
    """The translation of a task's spaces.

    use, leave_out: keys of observations, or patterns of them as file names have; where `use` is empty, all are used.

    Raises:
      UserError: a space that has no translation, or a pattern that fits no key; the message names the key.
    """
    leaves = list(_leaves("observation", observation_space, ()))
    keys = [_key(path, "observation") for path, _ in leaves]
    chosen = _choose(keys, use, leave_out)
    sees = {
        key: _observation(key, *leaf, image_size) for key, leaf in _unique("observation", keys, leaves, chosen).items()
    }
    acting = list(_leaves("action", action_space, ()))
    names = [_key(path, "action") for path, _ in acting]
    does = {key: _action(key, *leaf) for key, leaf in _unique("action", names, acting, set(names)).items()}
    try:
        spaces = Spaces(
            {key: meaning.target for key, meaning in sees.items()}, {key: _choosable(does[key].target) for key in does}
        )
    except ValueError as error:
        raise UserError(f"unsupported spaces: {error}") from error
    _require_small(spaces)
    left_out = [(key, path) for key, (path, _) in zip(keys, leaves, strict=True) if key not in chosen]
    return Translation(
        spaces,
        {key: sees[key].entry for key in spaces.observations},
        {key: does[key].entry for key in spaces.actions},
        tuple(path for _, path in left_out),
        (
            *_lines("observation", {key: sees[key] for key in spaces.observations}),
            *(f"observation {key}: left out" for key, _ in sorted(left_out)),
            *_lines("action", {key: does[key] for key in spaces.actions}),
        ),
    )


def _require_small(spaces: Spaces) -> None:
    """Before anything is allocated for it."""
    for kind, entries in (("observation", spaces.vectors), ("action", spaces.actions)):
        for key, entry in entries.items():
            if entry.encoded_size > MOST_NUMBERS:
                raise UserError(
                    f"the {kind} {key!r} becomes {entry.encoded_size:,} numbers; expected at most "
                    f"{MOST_NUMBERS:,}: describe it by fewer, "
                    "such as the digits of a number or its features, with a wrapper of your own"
                )


def random_actions(spaces: Spaces, rng: np.random.Generator, count: int) -> np.ndarray:
    """`count` flat actions [count, A]: reals uniform in [-1, 1), choices uniform over the classes."""
    parts: list[np.ndarray] = []
    for space in spaces.actions.values():
        if isinstance(space, Vector):
            parts.append(rng.uniform(-1.0, 1.0, (count, space.size)))
        else:
            parts += [rng.integers(classes, size=count)[:, None] == np.arange(classes) for classes in space.classes]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def doubts(spaces: Spaces, record: Mapping[str, np.ndarray]) -> list[str]:
    """Lines about images that hold codes, going by the first records [N, ...] of a run: [LOOP-61]."""
    highest = {key: int(record[key].max()) for key in spaces.images}
    return [
        f"WARNING: observation {key}: the first images hold no number above {most} of 255; {CODES}"
        for key, most in highest.items()
        if 0 < most < MOST_CODES
    ]


# Keys


def _leaves(kind: str, space: gym.Space[Any], path: Path) -> Iterator[Leaf]:
    if isinstance(space, gym.Dict) and space.spaces:
        for key, entry in space.spaces.items():
            if kind == "action" and not isinstance(key, str):  # An observation is looked up by the text of its keys.
                raise _unsupported(
                    kind, _key((*path, str(key)), kind), space, "the keys of a Dict of actions must be strings"
                )
            yield from _leaves(kind, entry, (*path, str(key)))
    elif isinstance(space, gym.Tuple) and space.spaces:
        for place, entry in enumerate(space.spaces):
            yield from _leaves(kind, entry, (*path, place))
    else:
        yield path, space


def _key(path: Path, kind: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", "_".join(map(str, path))) or kind


def _choose(keys: Sequence[str], use: Sequence[str], leave_out: Sequence[str]) -> set[str]:
    """[LOOP-67]"""
    for option, patterns in (("--observations", use), ("--leave-out", leave_out)):
        for pattern in patterns:
            if not any(fnmatch.fnmatchcase(key, pattern) for key in keys):
                raise UserError(f"{option} {pattern}: the observations are {', '.join(keys)}")
    chosen = {key for key in keys if not use or any(fnmatch.fnmatchcase(key, pattern) for pattern in use)}
    return {key for key in chosen if not any(fnmatch.fnmatchcase(key, pattern) for pattern in leave_out)}


def _unique(kind: str, keys: Sequence[str], leaves: Sequence[Leaf], chosen: set[str]) -> dict[str, Leaf]:
    keyed: dict[str, Leaf] = {}
    for key, leaf in zip(keys, leaves, strict=True):
        if key in keyed and key in chosen:
            raise UserError(
                f"unsupported {kind} space: {keyed[key][0]} and {leaf[0]} both become the key {key!r}; rename one"
            )
        if key in chosen:
            keyed[key] = leaf
    return keyed


# Observations


def _observation(key: str, path: Path, space: gym.Space[Any], image_size: int) -> Meaning:
    if (meaning := _choices("observation", key, path, space)) is not None:
        return meaning
    if not isinstance(space, gym.Box) or 0 in space.shape or space.dtype.name not in DTYPES:
        raise _unsupported(
            "observation", key, space, "supported: Dict, Tuple, Box, Discrete, MultiDiscrete, MultiBinary"
        )
    if (ends := _image_bounds(space)) is not None:
        return _image(path, space, ends, image_size)
    if (counts := _codes(space)) is not None:
        words = f"{counted(len(counts), 'choice')} of {_span(counts)} classes, as one-hots"
        return Meaning(Discrete(tuple(counts)), _entry(path, space, low=space.low), _declared(space), words)
    target = Vector(int(np.prod(space.shape)))
    return Meaning(
        target,
        _entry(path, space),
        _declared(space),
        counted(target.size, "real number"),
        tuple(_vector_warnings(space)),
    )


def _image_bounds(space: gym.Box) -> tuple[float, float] | None:
    """What 0 and 255 are in a box that is an image by its shape and its bounds: [LOOP-55]. None for other boxes."""
    low, high = np.unique(space.low), np.unique(space.high)
    if side_axes(space.shape) is None or len(low) > 1 or len(high) > 1 or low[0] != 0:
        return None
    highest = {"f": (1, 255), "u": (255, 65535), "i": (255, 65535)}.get(space.dtype.kind, ())
    return (0.0, float(high[0])) if float(high[0]) in highest else None


def _image(path: Path, space: gym.Box, ends: tuple[float, float], image_size: int) -> Meaning:
    axes = side_axes(space.shape)
    assert axes is not None
    height, width = (space.shape[axis] for axis in axes)
    target = Image(image_size, image_size, int(np.prod(space.shape)) // (height * width))
    words = f"image {target.height} x {target.width}, {counted(target.channels, 'channel')}"
    if (height, width) != (image_size, image_size):
        words += f", resized from {height} x {width}"
    warnings = []
    if ends[1] == 65535:
        warnings.append("its 16 bits are rounded to 8")
    if min(height, width) < 2 * LEAST_SIDE:
        warnings.append(f"a small image; {CODES}")
    return Meaning(target, _entry(path, space, low=[ends[0]], high=[ends[1]]), _declared(space), words, tuple(warnings))


def _codes(space: gym.Box) -> list[int] | None:
    """The number of classes of each entry of a board: [LOOP-57]. None for boxes that are none."""
    if space.dtype.kind not in "iu" or len(space.shape) < 2 or (space.low < 0).any():
        return None
    counts = _spans(space)
    if not 2 < max(counts) <= MOST_CODES or sum(counts) > MOST_ENCODED:
        return None
    return counts


def _vector_warnings(space: gym.Box) -> Iterator[str]:
    size, shape = int(np.prod(space.shape)), space.shape
    if space.dtype.kind in "iub" and max(_spans(space)) <= 2:
        return  # zeros and ones are as good as one-hots
    if space.dtype == np.uint8 and len(shape) > 1 and sorted(shape)[-2] < LEAST_SIDE:
        yield f"too small for an image (sides of {LEAST_SIDE}); {CODES}"
    elif size >= (MANY if len(shape) > 1 else 4 * MANY):
        yield (
            f"{size:,} numbers without convolutions; an image is a Box of uint8 from 0 "
            f"to 255, or of floats from 0 to 1, "
            f"whose two sides are at least {LEAST_SIDE} and whose other axes are shorter"
        )


# Actions


def _action(key: str, path: Path, space: gym.Space[Any]) -> Meaning:
    if (meaning := _choices("action", key, path, space)) is not None:
        return meaning
    supported = "supported: Dict, Tuple, Box, Discrete, MultiDiscrete, MultiBinary"
    if not isinstance(space, gym.Box) or 0 in space.shape or space.dtype.name not in DTYPES:
        raise _unsupported("action", key, space, supported)
    if space.dtype.kind != "f":
        counts = _spans(space)
        if max(counts) > MOST_CHOICES:
            remedy = (
                f"whole numbers are choices, at most {MOST_CHOICES} each; declare a Box of "
                f"floats, and round in the environment"
            )
            raise _unsupported("action", key, space, remedy)
        words = f"{counted(len(counts), 'choice')} of {_span(counts)} classes"
        return Meaning(Discrete(tuple(counts)), _entry(path, space, low=space.low), _declared(space), words)
    low, high = _bounds(space)
    words = f"{counted(low.size, 'real number')} in {_intervals(*_range(low, high))}"
    entry = _entry(path, space, low=low, high=high)
    return Meaning(Vector(low.size), entry, _declared(space), words, tuple(_action_warnings(low, high)))


def _bounds(space: gym.Box) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of each number, [size] each, infinite where there is none: [LOOP-58]."""
    low, high = (bound.astype(np.float64).ravel() for bound in (space.low, space.high))
    wide = high > low + 2.0
    return np.where(wide & (low <= -NO_BOUND), -np.inf, low), np.where(wide & (high >= NO_BOUND), np.inf, high)


def _range(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What -1 and 1 become between these bounds, [size] each."""
    alone = Spaces({"observation": Vector(1)}, {"action": Vector(low.size)})
    least, most = (
        environment_action(np.full(low.size, end), alone, {"action": low}, {"action": high})["action"]
        for end in (-1.0, 1.0)
    )
    return least, most


def _action_warnings(low: np.ndarray, high: np.ndarray) -> Iterator[str]:
    below, above = np.isinf(low), np.isinf(high)
    remedy = "if that is not the range, declare it, for example with gymnasium.wrappers.TransformAction"
    doubts = {
        "without bounds": ("[-1, 1]", int((below & above).sum())),
        "with one bound": ("the 2 units next to it", int((below != above).sum())),
    }
    numbers = f"of {counted(low.size, 'number')}"
    for bounds, (where, count) in doubts.items():
        if count:
            yield f"{count} {numbers} {bounds} below {NO_BOUND:,.0f}: moved in {where}; {remedy}"


# Both


def _choices(kind: str, key: str, path: Path, space: gym.Space[Any]) -> Meaning | None:
    """Discrete, MultiDiscrete and MultiBinary; None for other spaces."""
    if isinstance(space, gym.Discrete):
        counts = [int(space.n)]
    elif isinstance(space, gym.MultiDiscrete):
        counts = [int(n) for n in space.nvec.ravel()]
    elif isinstance(space, gym.MultiBinary):
        counts = [2] * int(np.prod(space.shape))
    else:
        return None
    if not 1 <= len(counts) <= MOST_ENTRIES:
        remedy = f"at most {MOST_ENTRIES:,} choices can be one-hots; declare a Box"
        raise _unsupported(kind, key, space, remedy)
    start = np.ravel(getattr(space, "start", 0))  # Gymnasium's number that a space counts from
    entry = _entry(path, space, low=start, scalar=isinstance(space, gym.Discrete))
    words = f"{counted(len(counts), 'choice')} of {_span(counts)} classes"
    return Meaning(Discrete(tuple(counts)), entry, _declared(space), words)


def _choosable(target: Target) -> Vector | Discrete:
    assert not isinstance(target, Image)
    return target


def _entry(path: Path, space: gym.Space[Any], low: Any = (), high: Any = (), scalar: bool = False) -> Entry:
    return Entry(
        path, tuple(map(int, space.shape or ())), np.dtype(space.dtype).name, _numbers(low), _numbers(high), scalar
    )


def _numbers(bound: Any) -> tuple[float, ...]:
    """In plain types; one for many that are equal."""
    numbers = [+number for number in np.ravel(bound).tolist()]  # A plus makes whole numbers of booleans.
    return tuple(numbers[:1] if len(set(numbers)) == 1 else numbers)


def _spans(space: gym.Box) -> list[int]:
    """How many whole numbers lie between the bounds, for each entry."""
    return [
        int(high) - int(low) + 1
        for low, high in zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
    ]


def _unsupported(kind: str, key: str, space: gym.Space[Any], remedy: str) -> UserError:
    return UserError(f"unsupported space of the {kind} {key!r}: {space!s:.200}; {remedy}")


# Words


def _lines(kind: str, meanings: dict[str, Meaning]) -> Iterator[str]:
    """[LOOP-61]"""
    for key, meaning in meanings.items():
        yield f"{kind} {key}: {meaning.declared} -> {meaning.words}"
        yield from (f"WARNING: {kind} {key}: {warning}" for warning in meaning.warnings)


def _declared(space: gym.Space[Any]) -> str:
    """Box uint8 [20, 30, 3] in [0, 255], or MultiDiscrete int64 [2] from 1"""
    words = (
        type(space).__name__ + f" {space.dtype} {list(space.shape)}"
        if space.shape
        else f"{type(space).__name__} {space.dtype}"
    )
    if isinstance(space, gym.Box):
        return f"{words} in {_intervals(space.low.ravel(), space.high.ravel())}"
    start = np.ravel(getattr(space, "start", 0))
    return f"{words} from {_span(start)}" if start.any() else words


def _span(numbers: Any) -> str:
    low, high = np.min(numbers), np.max(numbers)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _intervals(low: np.ndarray, high: np.ndarray) -> str:
    """[-1, 1], or [0, 10], [-2, 2], ... where they differ."""
    pairs = np.unique(np.stack([low, high]), axis=1).T if low.size > 4 else np.stack([low, high]).T
    if (pairs == pairs[0]).all():
        pairs = pairs[:1]
    shown = ", ".join(f"[{bottom:g}, {top:g}]" for bottom, top in pairs[:4].tolist())
    return shown + (", ..." if len(pairs) > 4 else "")
