"""A run that is interrupted and continued: what a checkpoint holds, and how a run begins from one. [LOOP-21] to
[LOOP-23]"""

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_spec.disk import checkpoint
from dreamer_spec.disk.about import options_json, read_about
from dreamer_spec.disk.checkpoint import Checkpoint, Damaged
from dreamer_spec.disk.files import Arrays, entries
from dreamer_spec.disk.logdir import note_first_checkpoint, require_free
from dreamer_spec.envs import Environments, History, Record
from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.logger import Display
from dreamer_spec.options import Options
from dreamer_spec.replay import Replay, set_aside
from dreamer_spec.training import saved_run
from dreamer_spec.training.divergence import settle
from dreamer_spec.training.state import Counters, Means, TrainingRun
from reference_numpy.training_loop import can_train

NOT_CHANGES = ("backend", "device", "logdir", "resume", "preflight", "from_")  # each start says its own
FROM_BOUNDARY = "new episodes begin, those under way when it was saved are abandoned"


def save(run: TrainingRun) -> Path:
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
    path = checkpoint.save(
        run.options.logdir, run.step, run.learner.state_dict(), loop, info, run.options.keep_checkpoints
    )
    note_first_checkpoint(run.options.logdir)
    run.replay.replay.keep([path.name for path in checkpoint.candidates(run.options.logdir)])
    return path


def find(options: Options, display: Display) -> Checkpoint | None:
    """The newest checkpoint that is not damaged; those that are get another name, loudly. [LOOP-22], [LOOP-50]

    Raises:
      Unreadable: one cannot be read now. Nothing has changed.
      UserError: all are damaged, the newest sound one is of another configuration or format, or there is none and no
        run may begin here.
    """
    found = checkpoint.candidates(options.logdir)
    for path in found:
        try:
            saved = checkpoint.open_checkpoint(path)
        except Damaged as error:
            aside = checkpoint.set_aside(path)
            display.say(f"WARNING: {error}; renamed to {aside}, going back to the checkpoint before")
            continue
        saved_run.check_info(saved)
        checkpoint.require_same_identity(saved, options.identity())
        return saved
    damaged = [
        path for path in entries(options.logdir / "checkpoints") if re.search(r"\.damaged(-[0-9]+)?$", path.name)
    ]
    if damaged:
        raise UserError(
            f"{options.logdir} has damaged checkpoints only: {', '.join(map(str, damaged))}; "
            f"to start over, choose another --logdir"
        )
    require_free(options.logdir)
    return None


def changes(saved: Checkpoint, options: Options) -> dict[str, list[Any]]:
    """The options that the run of a checkpoint is given: name -> [value before, value from here on]. [LOOP-70]

    Of what a checkpoint does not hold, such as --steps, run.json says what it was.
    """
    about = read_about(options.logdir) or {}
    earlier = about.get("options")
    before = {**(earlier if isinstance(earlier, dict) else {}), **saved.info["identity"]}
    now = json.loads(
        json.dumps({**options_json(options), **options.identity()})
    )  # Tuples become lists, as in the files.
    names = [name for name in now if name in before and name not in NOT_CHANGES]
    return {name: [before[name], now[name]] for name in names if before[name] != now[name]}


def restore_replay(
    saved: Checkpoint, options: Options, settings: Mapping[str, Any], exactly: bool, display: Display
) -> tuple[Replay, bool]:
    """The buffer of a checkpoint, and whether it is the one that the checkpoint was saved with.

    If its saved state is damaged, the newest older one takes its place, or an empty buffer if there is none: parameters
    and counters are kept whatever happens to the buffer. [LOOP-53]

    Raises:
      Unreadable: the buffer is away or cannot be read now. Nothing has changed.
    """
    directory, config = options.logdir.absolute() / "replay", options.config
    description: Any = saved.info["replay"]
    for older in [saved.path, *(path for path in checkpoint.candidates(options.logdir) if path.name < saved.path.name)]:
        is_own = older == saved.path
        try:
            description = description if is_own else checkpoint.open_checkpoint(older).info.get("replay")
            replay = Replay.restore(
                directory,
                description,
                config.replay_capacity,
                config.batch_length,
                continue_streams=exactly and is_own,
                **settings,
            )
        except (ValueError, Damaged) as error:
            display.say(f"WARNING: {error}")
            continue
        for line in replay.warnings:
            display.say(f"replay: {line}")
        if not is_own:
            display.say(
                f"WARNING: the buffer is that of {older}, with {len(replay):,} sequences; "
                f"what was recorded later is lost"
            )
        return replay, is_own
    aside = set_aside(directory)
    display.say(
        f"WARNING: no state of the replay buffer is sound, so the run goes on with an "
        f"empty one. Its files are now in {aside}; "
        "parameters and counters are those of the checkpoint"
    )
    return Replay(config.replay_capacity, config.batch_length, directory, **settings), False


def restore_environments(saved: Checkpoint, envs: Environments, display: Display) -> Record | None:
    """Brings fresh environments to where those of the checkpoint were: [LOOP-23]. None, and a line that says why, if
    that fails."""
    arrays = saved.loop
    entries = enumerate(saved.info["environments"])
    histories = [
        History.from_json(entry, arrays[name]) if entry and (name := f"actions/{i}") in arrays else None
        for i, entry in entries
    ]
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


def restore(run: TrainingRun, saved: Checkpoint, exactly: bool, own_buffer: bool = True) -> None:
    """Continues where the checkpoint stopped: [LOOP-23].

    exactly: the environments were restored, so carries and scores go on. own_buffer: so does the batch drawn ahead;
    another buffer does not have its records.

    Raises:
      UserError: what the checkpoint holds does not fit.
    """
    info, arrays = saved.info, saved.loop
    try:
        run.learner.load_state_dict(saved.learner)
        if own_buffer:
            run.replay.load_drawn(arrays)
        run.ratio.load_state_dict(info["replay_ratio"])
        if not can_train(
            len(run.replay), run.options.config
        ):  # What was lost of the buffer is recorded again, and is not paid for twice.
            run.ratio.load_state_dict({**info["replay_ratio"], "step": None})
    except ValueError as error:
        raise UserError(f"the checkpoint {saved.path} does not fit this version: {error}") from error
    if exactly:
        scores = _without_prefix("scores/", arrays)
        run.carry = run.learner.load_carry(_without_prefix("carry/", arrays))
        run.scores.total, run.scores.length = scores["total"], scores["length"]
    run.counters = Counters(**info["counters"])
    run.random_return, run.evaluation = info["random_return"], info["evaluation"]
    run.returns.extend(info["returns"])
    run.means = Means(info["metrics"])
    made_by = "" if info["backend"] == run.options.backend else f", which {info['backend']} has trained so far"
    run.display.say(f"continuing at step {run.step:,} from {saved.path}{made_by}")


def _prefixed(prefix: str, arrays: Mapping[str, Any]) -> Arrays:
    return {prefix + name: np.asarray(array) for name, array in arrays.items()}


def _without_prefix(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
