"""A run that is interrupted and continued: what a checkpoint holds, and how a run begins from one. [LOOP-21] to [LOOP-23]"""

import dataclasses
from collections.abc import Callable, Mapping
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

COUNTERS = {name: type(value) for name, value in dataclasses.asdict(Counters()).items()}
TRANSLATION = {"observations": dict, "actions": dict, "left_out": list}
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
        "translation": run.envs.translation.to_json(),
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
        _require_sound(saved)
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
    entries = enumerate(saved.info["environments"])
    histories = [History.from_json(entry, arrays[name]) if entry and (name := f"actions/{i}") in arrays else None for i, entry in entries]
    display.phase("repeating the episodes under way")
    record = envs.restore(histories)
    if record is None:
        display.say(f"the environments cannot be restored: {FROM_BOUNDARY}")
        return None
    before = _without_prefix("record/", arrays)
    if before.keys() != record.keys() or any(record[key].tobytes() != before[key].tobytes() for key in before):
        display.say(f"the environments are not deterministic, the same actions led elsewhere: {FROM_BOUNDARY}")
        return None
    return record


def restore(run: Run, saved: Checkpoint, exactly: bool) -> None:
    """Continues where the checkpoint stopped: [LOOP-23]. exactly: the environments were restored, so carries and scores go on."""
    info, arrays = saved.info, saved.loop
    try:
        run.learner.load_state_dict(saved.learner)
        run.replay.load_drawn(arrays)
        run.ratio.load_state_dict(info["replay_ratio"])
        if exactly:
            carry, scores = _without_prefix("carry/", arrays), _without_prefix("scores/", arrays)
            _require_same_form(run.learner.save_carry(run.carry), carry)
            _require_same_form(vars(run.scores), scores)
            run.carry, run.scores.total, run.scores.length = run.learner.load_carry(carry), scores["total"], scores["length"]
    except (ValueError, KeyError, ZeroDivisionError) as error:
        raise UserError(f"the checkpoint {saved.path} does not fit this version: {error}") from error
    run.counters = Counters(**info["counters"])
    run.random_return, run.evaluation = info["random_return"], info["evaluation"]
    run.returns.extend(info["returns"])
    run.means = Means(info["metrics"])
    made_by = "" if info["backend"] == run.options.backend else f", which {info['backend']} has trained so far"
    run.display.say(f"continuing at step {run.step:,} from {saved.path}{made_by}")


def _require_sound(saved: Checkpoint) -> None:
    """Whoever forges a description forges its checksum too: what is of another type must be an error, not a traceback.

    Raises:
      UserError: the names of what is missing or of another type.
    """
    info = saved.info
    sound = {
        "identity": isinstance(info.get("identity"), dict),
        "spaces": _is_of(info.get("spaces"), lambda entries: isinstance(entries, dict)),
        "translation": isinstance(info.get("translation"), dict)
        and all(isinstance(info["translation"].get(name), kind) for name, kind in TRANSLATION.items()),
        "backend": isinstance(info.get("backend"), str),
        "counters": isinstance(info.get("counters"), dict)
        and {name: type(value) for name, value in info["counters"].items()} == COUNTERS
        and all(0 <= value < 2**63 for value in info["counters"].values()),
        "environments": isinstance(info.get("environments"), list)
        and all(entry is None or (_is_of(entry, _is_count) and entry.keys() == {"seed", "episode"}) for entry in info["environments"]),
        "replay_ratio": _is_of(info.get("replay_ratio"), lambda value: value is None or isinstance(value, str | int)),
        "random_return": info.get("random_return") is None or _is_number(info["random_return"]),
        "evaluation": info.get("evaluation") is None
        or (_is_of(info["evaluation"], _is_number) and info["evaluation"].keys() == {"step", "return"}),
        "returns": isinstance(info.get("returns"), list) and all(map(_is_number, info["returns"])),
        "metrics": _is_of(
            info.get("metrics"), lambda mean: isinstance(mean, list) and len(mean) == 2 and all(map(_is_number, mean)) and mean[1] >= 1
        ),
        "log": _is_count(info.get("log")),
        "replay": isinstance(info.get("replay"), dict),
    }
    wrong = [name for name, is_sound in sound.items() if name not in info or not is_sound]
    if wrong:
        raise UserError(f"the checkpoint {saved.path} does not fit this version: run.json lacks a sound {', '.join(wrong)}")


def _require_same_form(expected: Mapping[str, np.ndarray], arrays: Mapping[str, np.ndarray]) -> None:
    for name, array in expected.items():
        if arrays[name].shape != array.shape or arrays[name].dtype != array.dtype:
            raise ValueError(f"{name} is {arrays[name].dtype}{list(arrays[name].shape)}; expected {array.dtype}{list(array.shape)}")


def _is_of(value: Any, is_sound: Callable[[Any], bool]) -> bool:
    return isinstance(value, dict) and all(map(is_sound, value.values()))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _prefixed(prefix: str, arrays: Mapping[str, Any]) -> Arrays:
    return {prefix + name: np.asarray(array) for name, array in arrays.items()}


def _without_prefix(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
