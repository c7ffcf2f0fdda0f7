"""How many frames an environment plays for each of its own steps: an action repeat comes on top of it."""

from typing import Any

import gymnasium

NAMES = (
    "frameskip",
    "frame_skip",
    "skip",
)  # of environments such as ALE's, of Gymnasium's AtariPreprocessing, of MaxAndSkipObservation


def frame_skip(env: gymnasium.Env[Any, Any]) -> int:
    """The product of what its specification and those of its wrappers say; the most where chance decides, 1 where
    nothing is said."""
    spec = env.spec
    if spec is None:
        return 1
    skip = 1
    for arguments in (spec.kwargs, *(wrapper.kwargs or {} for wrapper in spec.additional_wrappers)):
        skip *= max((_most(arguments[name]) for name in NAMES if name in arguments), default=1)
    return skip


def _most(value: Any) -> int:
    """ALE draws from low to high - 1 where it is given a pair."""
    if isinstance(value, tuple | list) and len(value) == 2 and all(type(number) is int for number in value):
        return max(1, value[1] - 1)
    return max(1, value) if type(value) is int else 1


def repeated_twice(task: str, skip: int, action_repeat: int) -> str | None:
    """What is to be said where both skip frames; else None."""
    if skip == 1 or action_repeat == 1:
        return None
    return (
        f"WARNING: {task} plays {skip} frames for each of its steps already, so with --action-repeat "
        f"{action_repeat} each action lasts "
        f"{skip * action_repeat} frames; leave out --action-repeat, or take an environment that skips none "
        f"(for ALE, one with frameskip=1)"
    )
