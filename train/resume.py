"""A run that is interrupted and continued: what a checkpoint holds, and how a run begins from one. [LOOP-21] to [LOOP-23]"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from train import checkpoint
from train.checkpoint import Arrays, Checkpoint, Damaged
from train.envs import Environments, History, Record
from train.errors import UserError
from train.finite import settle
from train.logger import Display
from train.options import Options
from train.state import Counters, Means, Run

FROM_BOUNDARY = "new episodes begin, those under way when it was saved are abandoned"


def save(run: Run) -> Path:
    """Writes a checkpoint; the environments must be waiting for actions: [LOOP-21].

    Raises:
      UserError: the disk refuses it, or the newest train step was not finite (then the checkpoint before stays).
    """
    settle(run)
    name = checkpoint.name_of(run.step)
    description, drawn = run.replay.save(name)
    histories = run.envs.histories()
    loop: Arrays = {
        **drawn,
        **_prefixed("record/", run.record),
        **_prefixed("carry/", run.learner.save_carry(run.carry)),
        **_prefixed("scores/", vars(run.scores)),
        **_prefixed("actions/", {str(worker): history.actions for worker, history in enumerate(histories) if history}),
    }
    info = {
        "identity": run.options.identity(),
        "spaces": run.envs.spaces.to_json(),
        "backend": run.options.backend,
        "counters": dataclasses.asdict(run.counters),
        "environments": [history and history.to_json() for history in histories],
        "replay_ratio": run.ratio.state_dict(),
        "random_return": run.random_return,
        "evaluation": run.evaluation,
        "returns": list(run.returns),
        "metrics": run.means.sums,
        "log": run.logger.position(),
        "replay": description,
    }
    path = checkpoint.save(run.options.logdir, run.step, run.learner.state_dict(), loop, info, run.options.keep_checkpoints)
    run.replay.replay.keep([path.name for path in checkpoint.candidates(run.options.logdir)])
    return path


def find(options: Options, display: Display) -> Checkpoint | None:
    """The newest checkpoint that is not damaged; those that are get another name, loudly.

    Raises:
      UserError: all are damaged, or the newest sound one is of another configuration or format.
    """
    found = checkpoint.candidates(options.logdir)
    for path in found:
        try:
            saved = checkpoint.open_checkpoint(path)
        except Damaged as error:
            give_up(path, error, display)
            continue
        checkpoint.require_same_identity(saved, options.identity())
        return saved
    damaged = sorted((options.logdir / "checkpoints").glob("*.damaged"))
    if damaged:
        raise UserError(
            f"{options.logdir} has damaged checkpoints only: {', '.join(map(str, damaged))}; to begin anew, choose another --logdir"
        )
    return None


def give_up(path: Path, error: Exception, display: Display) -> None:
    """Puts a damaged checkpoint aside, so that the one before it is the newest."""
    display.say(f"WARNING: {error}; renamed to {checkpoint.set_aside(path)}, going back to the checkpoint before")


def restore_environments(saved: Checkpoint, envs: Environments, display: Display) -> Record | None:
    """Brings fresh environments to where those of the checkpoint were: [LOOP-23]. None, and a line that says why, if that fails."""
    arrays = saved.loop
    histories = [
        None if entry is None else History.from_json(entry, arrays[f"actions/{worker}"])
        for worker, entry in enumerate(saved.info["environments"])
    ]
    record = envs.restore(histories)
    if record is None:
        display.say(f"the environments cannot be restored: {FROM_BOUNDARY}")
        return None
    before = _without_prefix("record/", arrays)
    if any(record[key].tobytes() != before[key].tobytes() for key in before):
        display.say(f"the environments are not deterministic, the same actions led elsewhere: {FROM_BOUNDARY}")
        return None
    return record


def restore(run: Run, saved: Checkpoint, exactly: bool) -> None:
    """Continues where the checkpoint stopped: [LOOP-23]. exactly: the environments were restored, so carries and scores go on."""
    info, arrays = saved.info, saved.loop
    try:
        run.learner.load_state_dict(saved.learner)
        run.replay.load_drawn(arrays)
    except ValueError as error:
        raise UserError(f"the checkpoint {saved.path} does not fit this version: {error}") from error
    run.ratio.load_state_dict(info["replay_ratio"])
    run.counters = Counters(**info["counters"])
    run.random_return, run.evaluation = info["random_return"], info["evaluation"]
    run.returns.extend(info["returns"])
    run.means = Means(info["metrics"])
    if exactly:
        run.carry = run.learner.load_carry(_without_prefix("carry/", arrays))
        for name, array in _without_prefix("scores/", arrays).items():
            setattr(run.scores, name, array)
    made_by = "" if info["backend"] == run.options.backend else f", which {info['backend']} has trained so far"
    run.display.say(f"continuing at step {run.step:,} from {saved.path}{made_by}")


def _prefixed(prefix: str, arrays: Mapping[str, Any]) -> Arrays:
    return {prefix + name: np.asarray(array) for name, array in arrays.items()}


def _without_prefix(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
