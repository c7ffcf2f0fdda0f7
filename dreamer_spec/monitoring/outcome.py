"""What came of a run, with its uncertainty: the last line of `train`, and the last lines of several seeds."""

import collections
import dataclasses
import math
import shlex
import shutil
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.logger import iterate_metrics
from dreamer_spec.options import Options, names_code
from dreamer_spec.words import counted

EPISODES = 20  # of training, that stand for an evaluation where there was none


@dataclasses.dataclass(frozen=True)
class Mean:
    """A mean and its standard error; None from one episode."""

    value: float
    error: float | None

    def __str__(self) -> str:
        return f"{self.value:.4g}" + ("" if self.error is None else f" ± {self.error:.2g}")


@dataclasses.dataclass(frozen=True)
class Outcome:
    """score: of the last evaluation or, without any, of the last EPISODES of training; random: of the random policy.
    None: no episodes."""

    score: Mean | None
    random: Mean | None

    @property
    def ratio(self) -> Mean | None:
        """Of both, to first order in their errors. None if the random policy's return is not clearly above 0."""
        if self.score is None or self.random is None or self.random.value <= 2 * (self.random.error or 0.0):
            return None
        ratio = self.score.value / self.random.value
        if self.score.error is None or self.random.error is None:
            return Mean(ratio, None)
        return Mean(ratio, math.hypot(self.score.error, ratio * self.random.error) / self.random.value)


def mean_of(returns: Sequence[float]) -> Mean:
    """The mean of returns; its error comes from the standard deviation of the sample."""
    return Mean(
        statistics.fmean(returns), statistics.stdev(returns) / math.sqrt(len(returns)) if len(returns) > 1 else None
    )


def read_outcome(logdir: Path) -> Outcome:
    """The outcome of a run, from its metrics.jsonl.

    Raises:
      UserError: the file cannot be read.
    """
    last: dict[str, Mean] = {}
    path = logdir / "metrics.jsonl"
    episodes: collections.deque[float] = collections.deque(maxlen=EPISODES)
    try:
        for line in filter(None, iterate_metrics(path)):
            for name in ("evaluation", "random"):
                if f"{name}/return" in line:
                    last[name] = Mean(line[f"{name}/return"], line.get(f"{name}/return_standard_error"))
            if "episode/return" in line:
                episodes.append(line["episode/return"])
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    return Outcome(last.get("evaluation") or (mean_of(episodes) if episodes else None), last.get("random"))


def last_words(outcome: Outcome, train_steps: int | None) -> str:
    """return 187.3 ± 4.2, random 22.1 ± 1.3, ratio 8.48 ± 0.53 after 1,226 train steps"""
    after = "" if train_steps is None else f" after {counted(train_steps, 'train step')}"
    if outcome.score is None:
        return f"no episode has ended yet{after}"
    words = {"return": outcome.score, "random": outcome.random, "ratio": outcome.ratio}
    return ", ".join(f"{name} {mean}" for name, mean in words.items() if mean is not None) + after


def first_train_step(options: Options) -> int:
    """The environment step, with action repeat, at which the buffer holds what a batch needs: [LOOP-13]."""
    config = options.config
    return (config.envs + config.batch_size) * config.batch_length * options.action_repeat


def why_untrained(options: Options) -> str:
    """Why a run of these options makes no train step, and what to raise."""
    config = options.config
    if config.replay_ratio == 0:
        return "--replay-ratio is 0"
    return (
        f"training starts at step {first_train_step(options):,}, when the buffer holds batch_size x batch_length = "
        f"{config.batch_size * config.batch_length:,} sequences, and --steps is {options.steps:,}: raise "
        f"--steps, or lower --batch-size, "
        "--batch-length or --envs"
    )


def next_commands(options: Options, step: int) -> list[str]:
    """What can be done with a run that has ended at this environment step, ready to be typed."""
    train, run = program(), shlex.quote(str(options.logdir))
    task = f" --task {shlex.quote(options.task)}" if names_code(options.task) else ""
    commands = {
        "report": f"{train} report {run}",
        "eval": f"{train} eval {run} --episodes 100{task}",
        "export": f"{train} export {run} policy",
        "resume": f"{train} resume {run} --steps {2 * max(step, first_train_step(options))}{task}",
    }
    with_code = ("eval", "resume") if options.make else ()  # A callable of a script that may have no other name.
    return [command for name, command in commands.items() if name not in with_code]


def program() -> str:
    """The words that call this command: its name if the shell finds it, else where it lies."""
    path, found = Path(sys.argv[0]), shutil.which("train")
    if path.name != "train":
        return f"{shlex.quote(sys.executable)} -m dreamer_spec"
    return "train" if found and path.exists() and Path(found).samefile(path) else shlex.quote(str(path))


def summary(outcomes: Mapping[int, Outcome]) -> str:
    """3 seeds: return 187.3 ± 12 (standard deviation 21, min 165, max 207), random 22.1 ± 0.4. Of seeds, each a mean of
    its episodes."""
    scores = [outcome.score.value for outcome in outcomes.values() if outcome.score]
    randoms = [outcome.random.value for outcome in outcomes.values() if outcome.random]
    words = f"{counted(len(outcomes), 'seed')}: "
    if not scores:
        return words + "no episode has ended yet"
    spread = f"standard deviation {statistics.stdev(scores):.2g}, " if len(scores) > 1 else ""
    words += f"return {mean_of(scores)} ({spread}min {min(scores):.4g}, max {max(scores):.4g})"
    return words + (f", random {mean_of(randoms)}" if randoms else "")
