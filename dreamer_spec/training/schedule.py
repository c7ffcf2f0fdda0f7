"""What happens beside learning: metrics, evaluations and checkpoints while a run goes on, and its last words."""

import contextlib
import dataclasses
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from dreamer_spec.envs import Record
from dreamer_spec.envs.info import is_pattern, names_of
from dreamer_spec.errors import writing
from dreamer_spec.monitoring.curve import draw_curve
from dreamer_spec.monitoring.logger import duration
from dreamer_spec.monitoring.outcome import first_train_step, last_words, next_commands, read_outcome, why_untrained
from dreamer_spec.monitoring.pictures import draw_predictions, prune_pictures
from dreamer_spec.monitoring.prediction import SequenceRecorder, predict, prediction_errors
from dreamer_spec.training import resume
from dreamer_spec.training.divergence import finite_action, mean_metrics
from dreamer_spec.training.evaluation import Agent, Episode, Interrupted, evaluate, report_failures
from dreamer_spec.training.forecast import TimeForecast
from dreamer_spec.training.state import TrainingRun
from reference_numpy.training_loop import derive_seed


class Schedule:
    """Does each thing when it is due."""

    def __init__(self, run: TrainingRun) -> None:
        self._clock = self._logged_at = self._saved_at = time.monotonic()
        self._logged = dataclasses.replace(run.counters)
        self._forecast = TimeForecast()

    def attend(self, run: TrainingRun) -> None:
        """To be called after every step of the environments."""
        now = time.monotonic()
        run.counters.seconds += now - self._clock
        self._clock = now
        if now - self._logged_at >= run.options.log_every:
            with run.clock.part("log"):
                self._log(run, now)
        if not run.shares_environment:
            self.evaluate(run)
        self._forecast.attend(run)

    def evaluate(self, run: TrainingRun) -> None:
        """Plays an evaluation if one is due. To be called before the first step too: a resumed run may have been
        interrupted in one."""
        if evaluation_is_due(run) and not run.interrupted:
            with run.clock.part("evaluation"):
                run_evaluation(run)

    def save(self, run: TrainingRun) -> None:
        """To be called while the environments wait for actions: only then can their state be saved."""
        if (
            time.monotonic() - self._saved_at >= run.options.checkpoint_every
            and not run.interrupted
            and run.step < run.options.steps
        ):
            with run.clock.part("checkpoint"):
                resume.save(run)
            self._saved_at = time.monotonic()

    def _log(self, run: TrainingRun, now: float) -> None:
        elapsed = max(now - self._logged_at, 1e-9)
        done, before = run.counters, self._logged
        steps = (done.records - before.records) * run.options.action_repeat / elapsed
        train_steps = (done.train_steps - before.train_steps) / elapsed
        speed = {
            "speed/steps": steps,
            "speed/policy_steps": (done.policy_steps - before.policy_steps) / elapsed,
            "speed/train_steps": train_steps,
        }
        self._logged_at, self._logged = now, dataclasses.replace(done)
        run.logger.write(run.step, done.seconds, {**mean_metrics(run), **speed, **run.clock.take(), **_state(run)})
        if done.train_steps:
            run.display.update(run.step, _facts(run, steps, train_steps))
        else:
            config = run.options.config
            run.display.phase("prefill", len(run.replay), config.batch_size * config.batch_length, "sequences")


def _state(run: TrainingRun) -> dict[str, float]:
    config = run.options.config
    trained = run.counters.train_steps * config.batch_size * config.batch_length
    state = {
        "replay/items": len(run.replay),
        "replay/ratio": trained / max(run.counters.records, 1),
        "environments/failures": run.envs.failures,
    }
    memory = {"memory/resident": _resident_memory(), "memory/device": run.learner.memory()}
    return state | {name: size / 2**30 for name, size in memory.items() if size is not None}


def _resident_memory() -> int | None:
    """Bytes of this process in memory, mapped files included; None where the system does not say."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None


def _facts(run: TrainingRun, steps: float, train_steps: float) -> Iterator[str]:
    if run.returns:
        yield f"return {np.mean(run.returns):.4g}"
    if run.evaluation:
        yield f"evaluation {run.evaluation['return']:.4g}"
    if steps > 0:
        yield f"{duration((run.options.steps - run.step) / steps)} left"
    yield f"{steps:.0f} steps/s"
    yield f"{train_steps:.1f} train steps/s"


def evaluation_is_due(run: TrainingRun) -> bool:
    """Whether a multiple of --eval-every has been reached since the last evaluation; at the end `finish` evaluates."""
    every, last = run.options.eval_every, run.evaluation["step"] if run.evaluation else 0
    return every > 0 and run.step // every > last // every and run.step < run.options.steps


def log_episode(run: TrainingRun, score: float, length: int, info: Mapping[str, float]) -> None:
    """A training episode has ended."""
    run.counters.episodes += 1
    run.returns.append(score)
    numbers = {f"episode/info/{name}": value for name, value in info.items()}
    run.logger.write(run.step, run.counters.seconds, {"episode/return": score, "episode/length": length, **numbers})
    missing = [name for name in names_of(run.options.info_metrics) if not is_pattern(name) and name not in info]
    if missing and run.counters.episodes == 1:
        run.display.say(
            f"WARNING: the info of the first episode's last step does not have {', '.join(missing)} (--info-metrics)"
        )


def run_evaluation(run: TrainingRun) -> bool:
    """Plays evaluation episodes with the agent as it is. An interrupted evaluation leaves nothing behind, and False."""
    options, counters = run.options, run.counters
    if not options.eval_episodes or not run.test_envs:
        return True
    agent = Agent(run.learner, run.test_envs, options.seed, counters.evaluation_steps)
    recorder, ended = SequenceRecorder(), 0

    def act(record: Record) -> np.ndarray:
        nonlocal ended
        ended += int(record["is_last"].sum())
        run.display.phase("evaluation", min(ended, options.eval_episodes), options.eval_episodes, "episodes")
        action = finite_action(run, agent(record))
        recorder.add(record, action)
        return action

    try:
        with run.envs.lend() if run.shares_environment else contextlib.nullcontext():
            episodes = evaluate(
                act, run.test_envs, options.eval_episodes, options.seed, counters.evaluations, lambda: run.interrupted
            )
    except Interrupted:
        return False
    finally:
        report_failures(run.test_envs, run.display.say)
    returns = [episode.score for episode in episodes]
    errors = show_predictions(run, recorder)
    counters.evaluations += 1
    counters.evaluation_steps = agent.step
    run.evaluation = {"step": run.step, "return": float(np.mean(returns))}
    metrics = {"return": run.evaluation["return"], "return_min": min(returns), "return_max": max(returns)}
    if len(returns) > 1:
        metrics["return_standard_error"] = float(np.std(returns, ddof=1)) / math.sqrt(len(returns))
    metrics |= {f"info/{name}": value for name, value in mean_info(episodes).items()}
    run.logger.write(
        run.step, counters.seconds, {f"evaluation/{name}": value for name, value in metrics.items()} | errors
    )
    return True


def mean_info(episodes: Sequence[Episode]) -> dict[str, float]:
    """Of each number of --info-metrics, over the episodes that have it."""
    names = dict.fromkeys(name for episode in episodes for name in episode.info)
    return {
        name: float(np.mean([episode.info[name] for episode in episodes if name in episode.info])) for name in names
    }


def show_predictions(run: TrainingRun, recorder: SequenceRecorder) -> dict[str, float]:
    """Draws what the world model predicts of an evaluation's episodes without seeing them. Returns how far off it is,
    as metrics."""
    truth = recorder.sequences()
    if truth is None:
        return {}
    spaces, seed = run.envs.spaces, derive_seed(run.options.seed, "prediction", run.counters.evaluations)
    predicted = predict(run.learner, spaces, truth, seed)
    directory = run.options.logdir / "predictions"
    with writing(directory):
        pictures = draw_predictions(directory, run.step, spaces, truth, predicted)
        prune_pictures(directory, run.step)
    for name, path in pictures.items():
        run.logger.picture(f"prediction/{name}", path, run.step)
    return prediction_errors(spaces, truth, predicted)


def finish(run: TrainingRun) -> bool:
    """The last evaluation, the last checkpoint, the picture, and what came of it all. Returns False if Ctrl-C ended the
    evaluation."""
    metrics = mean_metrics(run)
    if metrics:
        run.logger.write(run.step, run.counters.seconds, metrics)
    if run.evaluation is None or run.evaluation["step"] != run.step:
        path = resume.save(run)  # An evaluation may take long, and whatever ends it must not cost the training.
        if not run_evaluation(run):
            run.display.say(
                f"{run.ending} in the last evaluation, all training is saved in {path}; the same command plays it again"
            )
            return False
        resume.save(run)
    options = run.options
    title = f"{options.task}, {options.backend}, seed {options.seed}"
    picture = draw_curve(options.logdir, title, run.random_return)
    run.display.say(
        f"{run.step:,} steps, {run.counters.train_steps:,} train steps and {run.counters.episodes:,} episodes in "
        f"{duration(run.counters.seconds)}; curve in {picture}"
    )
    if not run.counters.train_steps:
        run.display.say(f"WARNING: no train step was made, the agent is as it began: {why_untrained(options)}")
    run.display.say("next: " + "\n      ".join(next_commands(options, run.step)))
    run.display.say(last_words(read_outcome(options.logdir), run.counters.train_steps))
    return True


def say_outlook(run: TrainingRun) -> None:
    """Says if there is nothing to train within --steps."""
    options = run.options
    if run.step >= options.steps:
        run.display.say(
            f"the run is at step {run.step:,} and --steps is {options.steps:,}: nothing is "
            f"left to train; a larger --steps goes on"
        )
    elif not run.counters.train_steps and first_train_step(options) > options.steps:
        run.display.say(f"WARNING: no train step will be made: {why_untrained(options)}")
