"""`train --from RUN`: a new run that begins with the parameters of another one. [LOOP-72]"""

from typing import Any

import numpy as np

from dreamer_spec.backend import Learner
from dreamer_spec.disk.about import read_about
from dreamer_spec.disk.checkpoint import Checkpoint, differences, open_checkpoint, space_entries
from dreamer_spec.disk.saved_agent import agent_of
from dreamer_spec.errors import UserError
from dreamer_spec.options import Options
from spec import Spaces, parameter_table

TAKEN = ("params/", "slow_critic/", "return_range/")  # the optimizer starts from zero


def begin_from(options: Options, learner: Learner, spaces: Spaces) -> dict[str, Any]:
    """Gives a fresh learner the parameters, the slow critic and the return range of `options.from_`. Returns where they
    come from.

    Raises:
      UserError: no checkpoint is there, it is damaged, or its agent has other spaces or other parameters.
    """
    assert options.from_ is not None
    checkpoint = open_checkpoint(options.from_)
    saved = agent_of(checkpoint)
    _require_same(
        f"{checkpoint.path} is of a task with other spaces",
        space_entries(saved.spaces.to_json()),
        space_entries(spaces.to_json()),
    )
    shapes = {name: list(entry.shape) for name, entry in parameter_table(options.config, spaces).items()}
    _require_same(
        f"{checkpoint.path} has other parameters", {name: list(x.shape) for name, x in saved.parameters.items()}, shapes
    )
    learner.load_state_dict(learner.state_dict() | _taken(checkpoint, learner.state_dict()))
    known = {name: saved.info[name] for name in ("task", "step", "backend")}
    return {
        "from": str(options.from_),
        "checkpoint": str(checkpoint.path),
        **known,
        "train_steps": saved.info["source"]["train_steps"],
    }


def require_same_origin(options: Options) -> None:
    """Raises:
    UserError: the run that is continued did not begin with the parameters of `options.from_`.
    """
    origin = (read_about(options.logdir) or {}).get("origin")
    began = origin.get("from") if isinstance(origin, dict) else None
    if options.from_ is not None and str(options.from_) != began:
        where = f"with the parameters of {began}" if began else "with parameters of its own"
        raise UserError(
            f"{options.logdir} holds a run already, which began {where}, and --from is for "
            f"a new run; choose another --logdir"
        )


def _taken(checkpoint: Checkpoint, fresh: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What is taken over, after it was compared with a fresh training state."""
    state = checkpoint.learner
    taken = {name: state.get(name) for name in fresh if name.startswith(TAKEN)}
    for name, array in taken.items():
        if (
            array is None
            or array.shape != fresh[name].shape
            or array.dtype != np.float32
            or not np.isfinite(array).all()
        ):
            raise UserError(
                f"the checkpoint {checkpoint.path} does not hold a training state: {name} "
                f"is missing or not as it should be"
            )
    return {name: array for name, array in taken.items() if array is not None}


def _require_same(what: str, saved: dict[str, Any], given: dict[str, Any]) -> None:
    found = differences(saved, given)
    if found:
        more = f" and {len(found) - 3} more" if len(found) > 3 else ""
        raise UserError(
            f"--from: {what}: {'; '.join(found[:3])}{more}. They must be the same: give "
            f"its --task, --size and model options"
        )
