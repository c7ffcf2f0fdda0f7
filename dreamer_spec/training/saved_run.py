"""What a checkpoint says of a run, checked before any of it is used: form, range, finite numbers. Implements [LOOP-54].

Whoever forges a file forges its checksum too, and a file may come from another version: what is wrong must be one line
that names the entry, and never a traceback some steps later.
"""

import dataclasses
import math
from fractions import Fraction
from typing import Any

import numpy as np

from conformance.schema import closed, misfit, validator
from dreamer_spec.disk.checkpoint import Checkpoint, name_of
from dreamer_spec.disk.files import Arrays
from dreamer_spec.envs.history import LONGEST
from dreamer_spec.errors import UserError
from dreamer_spec.training.state import Counters
from spec import Config, Discrete, Image, Spaces

COUNT = {"type": "count"}
FAR = COUNT | {"maximum": 2**53}  # no run comes to it, and no counter that goes on from it leaves 64 bits
NUMBER = {"type": "finite"}
# a remainder of time steps, exactly: the smallest ratio has a denominator of 2**1074
CREDIT = r"[0-9]{1,700}(/[1-9][0-9]{0,700})?"


SCHEMA: dict[str, Any] = {
    "type": "object",
    "properties": {
        "identity": {"type": "object"},
        "spaces": {"type": "object", "additionalProperties": {"type": "object"}},
        "translation": closed(
            {"observations": {"type": "object"}, "actions": {"type": "object"}, "left_out": {"type": "array"}}
        ),
        "backend": {"type": "string", "maxLength": 100},
        "counters": closed(
            {name: NUMBER | {"minimum": 0} if kind is float else FAR for name, kind in Counters.__annotations__.items()}
        ),
        "environments": {
            "type": "array",
            "items": {"anyOf": [{"type": "null"}, closed({"seed": COUNT, "episode": COUNT})]},
        },
        "replay_ratio": closed(
            {
                "step": {"anyOf": [{"type": "null"}, COUNT]},
                "credit": {"type": "string", "pattern": f"^{CREDIT}$", "maxLength": 1402},
            }
        ),
        "random_return": {"anyOf": [{"type": "null"}, NUMBER]},
        "evaluation": {"anyOf": [{"type": "null"}, closed({"step": COUNT, "return": NUMBER})]},
        "returns": {"type": "array", "items": NUMBER, "maxItems": 20},
        "metrics": {
            "type": "object",
            "additionalProperties": {
                "type": "array",
                "prefixItems": [{"type": "number"}, COUNT],
                "minItems": 2,
                "maxItems": 2,
            },
        },
        "log": COUNT,
        "replay": {"type": "object"},
    },
    "required": [
        *(
            "identity",
            "spaces",
            "translation",
            "backend",
            "counters",
            "environments",
            "replay_ratio",
            "random_return",
            "evaluation",
            "returns",
        ),
        *("metrics", "log", "replay"),
    ],
}
EXPECTED = validator(
    SCHEMA,
    count=lambda value: type(value) is int and 0 <= value < 2**63,
    finite=lambda value: type(value) in (int, float) and math.isfinite(value) and abs(value) <= 1e300,
)


@dataclasses.dataclass(frozen=True)
class Form:
    """An array: kinds of its dtype as in NumPy's `dtype.kind`, sides, and where its numbers are. high: one past the
    largest, by entry."""

    kinds: str
    shape: tuple[int | str, ...]
    low: float = -math.inf
    high: Any = math.inf


def check_info(saved: Checkpoint) -> None:
    """Raises:
    UserError: checkpoint.json lacks something, or something in it is of another kind or out of range.
    """
    if problem := misfit(saved.info, EXPECTED):
        raise _unfit(saved, f"checkpoint.json: {problem}")
    counters, ratio, repeat = (
        saved.info["counters"],
        saved.info["replay_ratio"],
        saved.info["identity"].get("action_repeat"),
    )
    for name, mean in saved.info["metrics"].items():
        if mean[1] < 1:
            raise _unfit(saved, f"checkpoint.json: metrics/{name:.50}: a mean of no value")
    if ratio["step"] not in (None, counters["records"]):
        expected = f"expected null or the counter of records, {counters['records']}"
        raise _unfit(saved, f"checkpoint.json: replay_ratio/step is {ratio['step']}; {expected}")
    if type(repeat) is not int or name_of(counters["records"] * repeat) != saved.path.name.partition(".")[0]:
        raise _unfit(
            saved,
            f"checkpoint.json: counters/records is {counters['records']}, which is not the step of {saved.path.name}",
        )


def check_credit(saved: Checkpoint, batch_steps: int) -> None:
    """Raises:
    UserError: more credit than a call of the replay ratio leaves, [LOOP-14].
    """
    credit = saved.info["replay_ratio"]["credit"]
    if not 0 <= Fraction(credit) < batch_steps:
        raise _unfit(
            saved,
            (
                f"checkpoint.json: replay_ratio/credit is {credit:.40}; expected 0 or more, and "
                f"less than {batch_steps} time steps"
            ),
        )


def check_arrays(saved: Checkpoint, spaces: Spaces, config: Config, workers: int, carry: Arrays) -> None:
    """carry: one of the learner's as `save_carry` gives it, for its form.

    Raises:
      UserError: an array is missing, or of another form, or holds numbers that no run has.
    """
    check_credit(saved, config.batch_size * config.batch_length)
    loop = saved.loop
    forms = {f"carry/{name}": Form(array.dtype.kind, array.shape) for name, array in carry.items()}
    forms |= {"scores/total": Form("f", (workers,)), "scores/length": Form("i", (workers,), 0)}
    if any(name.startswith("drawn/") for name in loop):
        forms |= {f"drawn/{name}": form for name, form in _batch_forms(spaces, config).items()}
    actions = Form("f", ("t", spaces.action_size))
    forms |= {f"actions/{worker}": actions for worker, entry in enumerate(saved.info["environments"]) if entry}
    known = [
        name for name in loop if not name.startswith("record/")
    ]  # Records are compared with those of the environments.
    if names := sorted(set(known) ^ set(forms)):
        raise _unfit(saved, f"loop.safetensors: {names[0]} is {'missing' if names[0] in forms else 'unknown'}")
    for name, form in forms.items():
        if problem := _problem(loop[name], form):
            raise _unfit(saved, f"loop.safetensors: {name} {problem}")
        if form is actions and len(loop[name]) > LONGEST:
            raise _unfit(saved, f"loop.safetensors: {name} holds {len(loop[name])} actions; expected at most {LONGEST}")
    for name, array in saved.learner.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise _unfit(saved, f"learner.safetensors: {name} holds numbers that are not finite")
        if name.startswith(("optimizer/second_moment/", "optimizer/step")) and np.any(array < 0):
            raise _unfit(saved, f"learner.safetensors: {name} holds numbers below 0")


def _batch_forms(spaces: Spaces, config: Config) -> dict[str, Form]:
    """A batch that is drawn, [REP-18]."""
    rows, steps = config.batch_size, config.batch_length
    forms = {name: Form("b", (rows, steps)) for name in ("is_first", "is_last", "is_terminal")}
    for key, space in spaces.observations.items():
        shape = (rows, steps, *space.array_shape)
        if isinstance(space, Discrete):
            forms[key] = Form("iu", shape, 0, np.array(space.classes))
        else:
            forms[key] = Form("u" if isinstance(space, Image) else "f", shape)
    return forms | {
        "reward": Form("f", (rows, steps)),
        "prev_action": Form("f", (rows, steps, spaces.action_size)),
        "deter": Form("f", (rows, config.deter)),
        "stoch": Form("i", (rows, config.stoch), 0, config.classes),
        "ids": Form("i", (rows, 2), 0, 2**40),
    }


def _problem(array: np.ndarray, form: Form) -> str | None:
    """What of an array is not as its form says, for a message."""
    sides = len(array.shape) == len(form.shape) and all(
        side == wanted or isinstance(wanted, str) for side, wanted in zip(array.shape, form.shape, strict=True)
    )
    if not sides or array.dtype.kind not in form.kinds:
        expected = ", ".join(map(str, form.shape))
        return f"is {array.dtype}{list(array.shape)}; expected [{expected}] of the kind {form.kinds!r}"
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return "holds numbers that are not finite"
    if array.dtype.kind in "iu" and not (np.all(array >= form.low) and np.all(array < form.high)):
        return (
            f"holds {array.min()} to {array.max()}; expected at least {form.low:g} and less than {np.max(form.high):g}"
        )
    return None


def _unfit(saved: Checkpoint, problem: str) -> UserError:
    return UserError(f"the checkpoint {saved.path} does not fit this version: {problem}")
