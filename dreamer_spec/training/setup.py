"""From options to a run that is ready to start: whatever the user may have got wrong is found here."""

import math
import os
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dreamer_spec import suites
from dreamer_spec.backend import Learner, learner_class
from dreamer_spec.disk import checkpoint, logdir
from dreamer_spec.disk.about import About, write_about
from dreamer_spec.disk.checkpoint import Checkpoint
from dreamer_spec.envs import Adapted, Environments, Record, Trial, doubts, env_maker, try_out
from dreamer_spec.envs.frames import repeated_twice
from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.logger import Display, Logger, Watch
from dreamer_spec.monitoring.outcome import mean_of
from dreamer_spec.options import Options
from dreamer_spec.replay import Prefetcher, Replay, erase
from dreamer_spec.system import threads
from dreamer_spec.training import resume, saved_run
from dreamer_spec.training.evaluation import play_randomly, report_failure
from dreamer_spec.training.forecast import say_memory
from dreamer_spec.training.schedule import say_outlook
from dreamer_spec.training.state import Counters, Scores, TrainingRun
from dreamer_spec.training.warm_start import begin_from, require_same_origin
from dreamer_spec.words import counted
from reference_numpy.training_loop import ReplayRatio, derive_seed
from spec import Spaces, parameter_table

if TYPE_CHECKING:
    from conformance.preflight import Report


def prepare(
    options: Options, learner: type[Learner] | None, stack: ExitStack, watch: Watch | None = None
) -> TrainingRun:
    """Everything that can go wrong is tried here, the cheap things first. What must be closed is left to the stack."""
    _require_trainable(options)
    is_new = not options.logdir.exists()
    _require_place(options.logdir)
    if not is_new:
        logdir.hold(options.logdir, stack)
    display = stack.enter_context(Display(options.steps))
    saved = _find_checkpoint(options, display)
    learner_type = learner or import_learner(options.backend)
    envs, test_envs = _make_environments(options, display, stack)
    parameters = _understand(options, saved, envs, display)
    agent = make_learner(learner_type, options, envs.spaces)  # Before preflight: it says what is wrong with the device.
    origin = begin_from(options, agent, envs.spaces) if options.from_ and not saved else None
    report = (
        _preflight(options, envs.spaces, display)
        if options.preflight and _progress(options, saved)[1] < options.steps
        else None
    )
    if is_new:  # Only now: what was mistyped leaves no directory behind.
        logdir.hold(options.logdir, stack)
        if resume.find(options, display):
            raise UserError(
                f"another process has begun a run in {options.logdir} meanwhile; the same command continues it"
            )
    if saved:
        saved_run.check_arrays(
            saved, envs.spaces, options.config, envs.count, agent.save_carry(agent.initial_carry(envs.count))
        )
    else:
        logdir.claim(options.logdir)  # Before anything else is written there.
    replay, record, own_buffer = _open_replay(options, saved, envs, display)
    starts, step = _progress(options, saved)
    about = write_about(
        options,
        spaces=envs.spaces,
        device=agent.device,
        parameters=parameters,
        preflight=report,
        resumed_at=step if saved else None,
        given_anew=resume.changes(saved, options) if saved else {},
        origin=origin,
        understood=envs.translation.lines,
    )
    logger = Logger(options.logdir, saved.info["log"] if saved else None, wandb=options.wandb, about=about, watch=watch)
    run = TrainingRun(
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
    _say_start(run, about)
    if saved:
        resume.restore(run, saved, exactly=record is not None, own_buffer=own_buffer)
    else:
        _measure_random_policy(run)
    run.counters.starts += record is None
    say_outlook(run)
    return run


def _understand(options: Options, saved: Checkpoint | None, envs: Environments, display: Display) -> int:
    """Says what the environments are, if a checkpoint does not want others. Returns the number of parameters."""
    if saved:
        checkpoint.require_same_spaces(saved, envs.spaces.to_json())
        checkpoint.require_same_translation(saved, envs.translation.to_json())
        require_same_origin(options)
    for line in envs.translation.lines:
        display.say(line)
    if warning := repeated_twice(options.task, envs.frame_skip, options.action_repeat):
        display.say(warning)
    parameters = _count_parameters(options, envs.spaces)
    say_memory(options, envs.spaces, parameters, display.say)
    return parameters


def _say_start(run: TrainingRun, about: About) -> None:
    options, say = run.options, run.display.say
    for line in run.logger.warnings:
        say(f"WARNING: {line}")
    for line in doubts(run.envs.spaces, run.record):
        say(line)
    say(
        f"{options.task}: {options.backend} on {run.learner.device}, "
        f"{counted(_threads(options, run.envs.spaces), 'thread')}, "
        f"{about['parameters']:,} parameters, {counted(run.envs.count, 'environment')}, seed "
        f"{options.seed}; logs in {options.logdir}"
    )
    values = {**vars(options), **vars(options.config), **options.env_arg}
    if protocol := suites.in_words(options.task, values):
        say(protocol)
    if changed := about["starts"][-1].get("changed"):
        say(
            f"changed from here on: {'; '.join(f'{name} {before} -> {now}' for name, (before, now) in changed.items())}"
        )
    if (origin := about.get("origin")) and len(about["starts"]) == 1:
        say(
            f"beginning with the parameters of {origin['checkpoint']} ({origin['task']}, step "
            f"{origin['step']:,}), a fresh optimizer"
        )


def _progress(options: Options, saved: Checkpoint | None) -> tuple[int, int]:
    """How often the environments were restarted, and the environment step."""
    if not saved:
        return 0, 0
    return saved.info["counters"]["starts"], saved.info["counters"]["records"] * options.action_repeat


def _begin(options: Options, envs: Environments, starts: int) -> Record:
    """The first records of new episodes everywhere: [LOOP-25]."""
    return envs.reset(
        [derive_seed(options.seed, "environment", worker + envs.count * starts) for worker in range(envs.count)]
    )


def _require_place(logdir: Path) -> None:
    """Raises:
    UserError: the log directory is not there and cannot be made.
    """
    place = next(path for path in (logdir, *logdir.absolute().parents) if path.exists())
    if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
        raise UserError(
            f"cannot write to the log directory {logdir}: {place} is no directory that can be written to; "
            f"choose another with --logdir"
        )


def _require_trainable(options: Options) -> None:
    """[LOOP-13]: with fewer items than a batch has time steps, training would never start. [LOOP-65], [LOOP-66]: one
    environment."""
    config = options.config
    for option, usual in (("train_when", "always"), ("eval_env", "own")):
        if getattr(options, option) != usual and config.envs != 1:
            name = f"--{option.replace('_', '-')} {getattr(options, option)}"
            raise UserError(f"{name} is for a single environment, and this run has {config.envs}; add --envs 1")
    if config.replay_capacity < config.batch_size * config.batch_length:
        raise UserError(
            f"hyperparameter replay_capacity is {config.replay_capacity}; expected at "
            f"least batch_size x batch_length = "
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
    threads.spin_briefly()
    try:
        return learner_class(backend)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("impl_"):
            raise
        raise UserError(
            f"the backend {backend} needs the package {error.name}: pip install 'dreamer-spec[{backend}]'"
        ) from error


def try_environment(options: Options, make: Callable[[int], Adapted], display: Display) -> Trial | None:
    """What an environment in a process of its own shows; None where none shall have one."""
    if options.processes == "no":
        return None
    seed = options.seed if options.processes == "auto" else None
    return try_out(make, lambda failure: report_failure(failure, display.say), options.task, seed, options.env_timeout)


def _make_environments(
    options: Options, display: Display, stack: ExitStack
) -> tuple[Environments, Environments | None]:
    """The environments of training, and those of evaluation if there is any."""
    make = env_maker(options)
    if options.processes != "no":
        display.phase("an environment is tried out")
    trial = try_environment(options, make, display)

    def several(count: int) -> Environments:
        processes = trial is not None and trial.deserves_process
        made = Environments(make, count, processes, options.env_timeout, options.env_failures, trial, options.task)
        return stack.enter_context(closing(made))

    envs = several(options.config.envs)
    if envs.count != options.config.envs:
        raise UserError(
            f"task {options.task} is a vector of {counted(envs.count, 'environment')}, and this run is to have "
            f"{options.config.envs}: add --envs {envs.count}, or give the function an argument num_envs, which gets "
            f"the number of --envs"
        )
    if options.eval_env == "shared":
        return envs, envs
    tests = min(envs.count, max(options.eval_episodes, options.random_episodes))
    if not tests:
        return envs, None
    test_envs = several(tests)
    if found := envs.translation.differences(test_envs.translation):
        raise UserError(
            f"task {options.task}: an environment of evaluation is not like those of training: {'; '.join(found[:3])}"
        )
    return envs, test_envs


def _count_parameters(options: Options, spaces: Spaces) -> int:
    try:
        return sum(math.prod(parameter.shape) for parameter in parameter_table(options.config, spaces).values())
    except ValueError as error:
        remedy = " (--image-size)" if spaces.images else ""
        raise UserError(f"task {options.task}: {error}{remedy}") from error


def _preflight(options: Options, spaces: Spaces, display: Display) -> "Report":
    from conformance.preflight import preflight

    display.phase("preflight compares the backend with the reference on this configuration (--no-preflight skips it)")
    report = preflight(
        options.backend,
        spaces,
        options.config,
        options.device,
        progress=lambda what: display.phase("preflight", detail=f"{what} agrees"),
    )
    if not report.passed:
        raise UserError(
            f"the backend {options.backend} failed preflight, it deviates from the reference by "
            f"{report.worst:.3g}: {report.summary}. "
            "Training would be in vain; --no-preflight skips this check"
        )
    display.say(f"preflight: {report.summary} (worst deviation {report.worst:.3g})")
    return report


def _threads(options: Options, spaces: Spaces) -> int:
    return threads.choose(options.backend, options.config, spaces, options.threads)


def make_learner(learner: type[Learner], options: Options, spaces: Spaces) -> Learner:
    try:
        return learner(
            spaces,
            options.config,
            seed=derive_seed(options.seed, "parameters", 0),
            device=options.device,
            nonfinite=options.nonfinite,
            threads=_threads(options, spaces),
        )
    except ValueError as error:  # Spaces and configuration have been checked: what is left is the device.
        raise UserError(
            f"the backend {options.backend} does not run with --device {options.device}: {error}"
        ) from error


def _open_replay(
    options: Options, saved: Checkpoint | None, envs: Environments, display: Display
) -> tuple[Prefetcher, Record | None, bool]:
    """The buffer in LOGDIR/replay, the records of the environments if they were restored, and whether it is the
    checkpoint's own buffer."""
    config, directory = options.config, options.logdir.absolute() / "replay"  # a thread reads there
    settings: dict[str, Any] = {
        "memory_limit": int(options.replay_memory * 2**30),
        "deter_dtype": options.replay_deter,
        "classes": config.classes,
    }
    record, own_buffer = None, True
    if saved:
        record = resume.restore_environments(saved, envs, display) if options.restore_envs else None
        replay, own_buffer = resume.restore_replay(saved, options, settings, record is not None, display)
    else:
        erase(directory)
        replay = Replay(config.replay_capacity, config.batch_length, directory, **settings)

    def uniform(train_step: int) -> np.ndarray:
        return np.random.Generator(np.random.PCG64(derive_seed(options.seed, "replay", train_step))).random(
            config.batch_size
        )

    return Prefetcher(replay, uniform, saved.info["counters"]["train_steps"] if saved else 0), record, own_buffer


def _measure_random_policy(run: TrainingRun) -> None:
    if run.options.random_episodes and run.test_envs:
        run.display.phase("a random policy plays")
        returns = play_randomly(run.test_envs, run.options.random_episodes, run.options.seed)
        if run.shares_environment:
            run.record = _begin(run.options, run.envs, 0)
        mean = mean_of(returns)
        run.random_return = mean.value
        error = {} if mean.error is None else {"random/return_standard_error": mean.error}
        run.logger.write(0, 0.0, {"random/return": mean.value, **error})
        run.display.say(f"a random policy gets {mean} (mean of {counted(len(returns), 'episode')})")
