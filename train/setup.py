"""From options to a run that is ready to start: whatever the user may have got wrong is found here."""

import math
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

import numpy as np

from reference_numpy.training_loop import ReplayRatio, derive_seed
from spec import Spaces, parameter_table
from train import checkpoint, resume
from train.about import write_about
from train.backend import Learner, learner_class
from train.checkpoint import Checkpoint
from train.envs import Environments, Record, doubts, env_maker, is_slow
from train.errors import UserError
from train.evaluation import play_randomly
from train.logger import Display, Logger
from train.options import Options
from train.replay import Prefetcher, Replay, erase
from train.state import Counters, Run, Scores

if TYPE_CHECKING:
    from conformance.preflight import Report


def prepare(options: Options, learner: type[Learner] | None, stack: ExitStack) -> Run:
    """Everything that can go wrong is tried here, the cheap things first. What must be closed is left to the stack."""
    _require_trainable(options)
    _hold_logdir(options, stack)
    display = stack.enter_context(Display(options.steps))
    saved = _find_checkpoint(options, display)
    learner_type = learner or import_learner(options.backend)
    envs, test_envs = _make_environments(options, stack)
    if saved:
        checkpoint.require_same_spaces(saved, envs.spaces.to_json())
        checkpoint.require_same_translation(saved, envs.translation.to_json())
    for line in envs.translation.lines:
        display.say(line)
    parameters = _count_parameters(options, envs.spaces)
    agent = make_learner(learner_type, options, envs.spaces)  # Before preflight: it says what is wrong with the device.
    report = _preflight(options, envs.spaces, display) if options.preflight else None
    replay, saved, record = _open_replay(options, saved, envs, display)
    starts, step = _progress(options, saved)
    about = write_about(
        options,
        spaces=envs.spaces,
        device=agent.device,
        parameters=parameters,
        preflight=report,
        resumed_at=step if saved else None,
        understood=envs.translation.lines,
    )
    logger = Logger(options.logdir, saved.info["log"] if saved else None, wandb=options.wandb, about=about)
    for line in logger.warnings:
        display.say(f"WARNING: {line}")
    run = Run(
        options=options,
        envs=envs,
        test_envs=test_envs,
        learner=agent,
        replay=stack.enter_context(closing(replay)),
        ratio=ReplayRatio(options.config.replay_ratio, options.config.batch_size * options.config.batch_length),
        logger=stack.enter_context(closing(logger)),
        display=display,
        counters=Counters(),
        scores=Scores(envs.count),
        record=_begin(options, envs, starts) if record is None else record,
        carry=agent.initial_carry(envs.count),
    )
    for line in doubts(envs.spaces, run.record):
        display.say(line)
    display.say(
        f"{options.task}: {options.backend} on {run.learner.device}, {parameters:,} parameters, {envs.count} environments, "
        f"seed {options.seed}; logs in {options.logdir}"
    )
    if saved:
        resume.restore(run, saved, exactly=record is not None)
    else:
        _measure_random_policy(run)
    run.counters.starts += record is None
    return run


def _progress(options: Options, saved: Checkpoint | None) -> tuple[int, int]:
    """How often the environments began anew, and the environment step."""
    if not saved:
        return 0, 0
    return saved.info["counters"]["starts"], saved.info["counters"]["records"] * options.action_repeat


def _begin(options: Options, envs: Environments, starts: int) -> Record:
    """The first records of new episodes everywhere: [LOOP-25]."""
    return envs.reset([derive_seed(options.seed, "environment", worker + envs.count * starts) for worker in range(envs.count)])


def _hold_logdir(options: Options, stack: ExitStack) -> None:
    """Locks the log directory until the run ends, however it ends: two processes would cut each other's files.

    Raises:
      UserError: another process holds it, or it cannot be written.
    """
    import fcntl  # Not on Windows, where `train eval` needs this module too.

    try:
        options.logdir.mkdir(parents=True, exist_ok=True)
        lock = stack.enter_context((options.logdir / ".lock").open("w"))
    except OSError as error:
        raise UserError(f"cannot write to the log directory {options.logdir}: {error.strerror}; choose another with --logdir") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UserError(f"another process is training in {options.logdir}; let it end, or choose another with --logdir") from error
    except OSError:
        pass  # Some network file systems have no locks: there it is left to the user.


def _require_trainable(options: Options) -> None:
    """[LOOP-13]: with fewer items than a batch has time steps, training would never start."""
    config = options.config
    if config.replay_capacity < config.batch_size * config.batch_length:
        raise UserError(
            f"hyperparameter replay_capacity is {config.replay_capacity}; expected at least batch_size x batch_length = "
            f"{config.batch_size * config.batch_length}, or training would never start"
        )


def _find_checkpoint(options: Options, display: Display) -> Checkpoint | None:
    saved = resume.find(options, display)
    if saved and options.resume == "never":
        raise UserError(f"{options.logdir} holds a run already, and --resume is never; choose another --logdir")
    if not saved and options.resume == "must":
        raise UserError(f"{options.logdir} holds no checkpoint, and --resume is must")
    return saved


def import_learner(backend: str) -> type[Learner]:
    try:
        return learner_class(backend)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("impl_"):
            raise
        raise UserError(f"the backend {backend} needs the package {error.name}: pip install 'dreamer-spec[{backend}]'") from error


def _make_environments(options: Options, stack: ExitStack) -> tuple[Environments, Environments | None]:
    """The environments of training, and those of evaluation if there is any."""
    make = env_maker(options)
    count, processes = options.config.envs, options.processes == "yes"
    if options.processes == "auto" and count > 1:
        processes = is_slow(make, options.seed)
    envs = stack.enter_context(closing(Environments(make, count, processes, options.env_timeout, options.env_failures)))
    tests = min(count, max(options.eval_episodes, options.random_episodes))
    if not tests:
        return envs, None
    return envs, stack.enter_context(closing(Environments(make, tests, processes, options.env_timeout, options.env_failures)))


def _count_parameters(options: Options, spaces: Spaces) -> int:
    try:
        return sum(math.prod(parameter.shape) for parameter in parameter_table(options.config, spaces).values())
    except ValueError as error:
        remedy = " (--image-size)" if spaces.images else ""
        raise UserError(f"task {options.task}: {error}{remedy}") from error


def _preflight(options: Options, spaces: Spaces, display: Display) -> "Report":
    from conformance.preflight import preflight

    display.phase("preflight")
    report = preflight(options.backend, spaces, options.config, options.device)
    if not report.passed:
        raise UserError(
            f"the backend {options.backend} failed preflight, it deviates from the reference by {report.worst:.3g}: {report.summary}. "
            "Training would be in vain; --no-preflight skips this check"
        )
    display.say(f"preflight: {report.summary} (worst deviation {report.worst:.3g})")
    return report


def make_learner(learner: type[Learner], options: Options, spaces: Spaces) -> Learner:
    try:
        return learner(
            spaces, options.config, seed=derive_seed(options.seed, "parameters", 0), device=options.device, nonfinite=options.nonfinite
        )
    except ValueError as error:  # Spaces and configuration have been checked: what is left is the device.
        raise UserError(f"the backend {options.backend} does not run with --device {options.device}: {error}") from error


def _open_replay(
    options: Options, saved: Checkpoint | None, envs: Environments, display: Display
) -> tuple[Prefetcher, Checkpoint | None, Record | None]:
    """The buffer in LOGDIR/replay, the checkpoint that it is from, and the records of the environments if they were restored.

    A checkpoint whose buffer is damaged is given up for the one before.
    """
    config, directory = options.config, options.logdir / "replay"
    settings: dict[str, Any] = {
        "memory_limit": int(options.replay_memory * 2**30),
        "deter_dtype": options.replay_deter,
        "classes": config.classes,
    }
    replay = record = None
    while saved and replay is None:
        record = resume.restore_environments(saved, envs, display) if options.restore_envs else None
        try:
            replay = Replay.restore(
                directory,
                saved.info["replay"],
                config.replay_capacity,
                config.batch_length,
                continue_streams=record is not None,
                **settings,
            )
        except ValueError as error:
            resume.give_up(saved.path, error, display)
            saved = resume.find(options, display)
    if replay is not None:
        for line in replay.warnings:
            display.say(f"replay: {line}")
    else:
        erase(directory)
        replay = Replay(config.replay_capacity, config.batch_length, directory, **settings)

    def uniform(train_step: int) -> np.ndarray:
        return np.random.Generator(np.random.PCG64(derive_seed(options.seed, "replay", train_step))).random(config.batch_size)

    return Prefetcher(replay, uniform, saved.info["counters"]["train_steps"] if saved else 0), saved, record


def _measure_random_policy(run: Run) -> None:
    if run.options.random_episodes and run.test_envs:
        run.display.phase("a random policy plays")
        returns = play_randomly(run.test_envs, run.options.random_episodes, run.options.seed)
        run.random_return = float(np.mean(returns))
        run.logger.write(0, 0.0, {"random/return": run.random_return})
        run.display.say(f"a random policy gets {run.random_return:.4g} (mean of {len(returns)} episodes)")
