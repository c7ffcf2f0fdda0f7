"""What happens beside learning: metrics, evaluations and checkpoints while a run goes on, and its last words."""

import dataclasses
import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from train import checkpoint
from train.curve import draw_curve
from train.envs import Record
from train.errors import UserError
from train.evaluation import Agent, Interrupted, evaluate
from train.logger import duration
from train.state import Run


class Schedule:
    """Does each thing when it is due."""

    def __init__(self, run: Run) -> None:
        self._clock = self._logged_at = self._saved_at = time.monotonic()
        self._logged = dataclasses.replace(run.counters)
        self._evaluations_due = _evaluations_due(run)

    def attend(self, run: Run) -> None:
        """To be called after every step of the environments."""
        now = time.monotonic()
        run.counters.seconds += now - self._clock
        self._clock = now
        if now - self._logged_at >= run.options.log_every:
            self._log(run, now)
        if run.interrupted:
            return
        if _evaluations_due(run) > self._evaluations_due and run.step < run.options.steps:  # At the end `finish` does it.
            self._evaluations_due = _evaluations_due(run)
            run_evaluation(run)
        if now - self._saved_at >= run.options.checkpoint_every:
            save(run)
            self._saved_at = time.monotonic()

    def _log(self, run: Run, now: float) -> None:
        elapsed = max(now - self._logged_at, 1e-9)
        steps = (run.counters.records - self._logged.records) * run.options.action_repeat / elapsed
        train_steps = (run.counters.train_steps - self._logged.train_steps) / elapsed
        self._logged_at, self._logged = now, dataclasses.replace(run.counters)
        speed = {"speed/steps": steps, "speed/train_steps": train_steps}
        run.logger.write(run.step, run.counters.seconds, {**mean_metrics(run), **speed})
        run.display.update(run.step, _facts(run, steps, train_steps))


def _facts(run: Run, steps: float, train_steps: float) -> Iterator[str]:
    if run.returns:
        yield f"return {np.mean(run.returns):.4g}"
    if run.evaluation:
        yield f"evaluation {run.evaluation['return']:.4g}"
    if steps > 0:
        yield f"{duration((run.options.steps - run.step) / steps)} left"
    yield f"{steps:.0f} steps/s"
    yield f"{train_steps:.1f} train steps/s"


def _evaluations_due(run: Run) -> int:
    return run.step // run.options.eval_every if run.options.eval_every else 0


def log_episode(run: Run, score: float, length: int) -> None:
    """A training episode has ended."""
    run.counters.episodes += 1
    run.returns.append(score)
    run.logger.write(run.step, run.counters.seconds, {"episode/return": score, "episode/length": length})


def mean_metrics(run: Run) -> dict[str, float]:
    """Means of what the train steps since the last call returned, under `train/`.

    Raises:
      UserError: a loss or the gradient is not finite.
    """
    taken, run.metrics = run.metrics, []
    means = {name: float(np.mean([float(entry[name]) for entry in taken])) for name in (taken[0] if taken else ())}
    _require_finite(run, means)
    return {f"train/{name}": value for name, value in means.items()}


def _require_finite(run: Run, metrics: Mapping[str, float]) -> None:
    for name, value in metrics.items():
        if ("loss" in name or name == "gradient_norm") and not math.isfinite(value):  # [OPT-20]
            raise diverged(run, name)


def diverged(run: Run, what: str) -> UserError:
    saved = f"the checkpoint in {run.options.logdir} is from before; " if checkpoint.find(run.options.logdir) else ""
    return UserError(
        f"training diverged: {what} is not finite at train step {run.counters.train_steps} (step {run.step}); "
        f"{saved}try a smaller --learning-rate or another --compute-dtype, with a --logdir of its own"
    )


def finite_action(run: Run, action: np.ndarray) -> np.ndarray:
    """The policy's action in float32. [LOOP-12]

    Raises:
      UserError: a number is not finite.
    """
    action = np.array(action, np.float32)
    if not np.isfinite(action).all():
        raise diverged(run, "the policy's action")
    return action


def run_evaluation(run: Run) -> None:
    """Plays evaluation episodes with the agent as it is. An interrupted evaluation leaves nothing behind."""
    options, counters = run.options, run.counters
    if not options.eval_episodes or not run.test_envs:
        return
    agent = Agent(run.learner, run.test_envs, options.seed, counters.evaluation_steps)

    def act(record: Record) -> np.ndarray:
        return finite_action(run, agent(record))

    try:
        returns = evaluate(act, run.test_envs, options.eval_episodes, options.seed, counters.evaluations, run.interrupted)
    except Interrupted:
        return
    counters.evaluations += 1
    counters.evaluation_steps = agent.step
    error = float(np.std(returns) / math.sqrt(len(returns)))
    run.evaluation = {"step": run.step, "return": float(np.mean(returns))}
    metrics = {"return": run.evaluation["return"], "return_standard_error": error, "return_min": min(returns), "return_max": max(returns)}
    run.logger.write(run.step, counters.seconds, {f"evaluation/{name}": value for name, value in metrics.items()})


def save(run: Run) -> Path:
    """Writes a checkpoint: [LOOP-21].

    Raises:
      UserError: the disk refuses it, or the run has diverged (then the checkpoint before stays).
    """
    for metrics in run.metrics[-1:]:
        _require_finite(run, {name: float(value) for name, value in metrics.items()})
    name = checkpoint.name_of(run.step)
    description, drawn = run.replay.save(name)
    info = {
        "identity": run.options.identity(),
        "spaces": run.envs.spaces.to_json(),
        "backend": run.options.backend,
        "counters": dataclasses.asdict(run.counters),
        "replay_ratio": run.ratio.state_dict(),
        "random_return": run.random_return,
        "evaluation": run.evaluation,
        "replay": description,
    }
    path = checkpoint.save(run.options.logdir, run.step, run.learner.state_dict(), drawn, info)
    run.replay.replay.keep([name])
    return path


def finish(run: Run) -> None:
    """The last evaluation, the last checkpoint, the picture, and what came of it all."""
    if run.metrics:
        run.logger.write(run.step, run.counters.seconds, mean_metrics(run))
    if run.evaluation is None or run.evaluation["step"] != run.step:
        save(run)  # An evaluation may take long, and whatever ends it must not cost the training.
        run_evaluation(run)
        save(run)
    options = run.options
    title = f"{options.task}, {options.backend}, seed {options.seed}"
    picture = draw_curve(options.logdir, title, run.random_return)
    run.display.say(
        f"{run.step:,} steps, {run.counters.train_steps:,} train steps and {run.counters.episodes:,} episodes in "
        f"{duration(run.counters.seconds)}; curve in {picture}"
    )
    run.display.say(last_words(run))


def last_words(run: Run) -> str:
    """return 187.3, random 22.1, ratio 8.5"""
    if run.evaluation:
        result = run.evaluation["return"]
    elif run.returns:
        result = float(np.mean(run.returns))
    else:
        return "no episode has ended yet"
    words = f"return {result:.4g}"
    if run.random_return is not None:
        words += f", random {run.random_return:.4g}"
        if run.random_return > 0:
            words += f", ratio {result / run.random_return:.2f}"
    return words
