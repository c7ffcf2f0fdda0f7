"""The loop of spec/12-training-loop.md: act, remember, learn."""

import signal
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any

import numpy as np

from reference_numpy.training_loop import can_train, derive_seed
from train.backend import Learner
from train.envs import Record
from train.options import Options
from train.schedule import Schedule, finish, finite_action, log_episode, save
from train.setup import prepare
from train.state import Run


def run(options: Options, learner: type[Learner] | None = None) -> bool:
    """Trains as the options say, or continues. Returns whether it came to the end; False after Ctrl-C, with a checkpoint.

    learner: the class to train instead of the backend's.

    Raises:
      UserError: whatever the user can mend; see train/cli.py.
    """
    with ExitStack() as stack:
        run = prepare(options, learner, stack)
        with run.display:
            finished = train(run)
        if finished:
            finish(run)
        return finished


def train(run: Run) -> bool:
    """Acts, remembers and learns until the budget of steps is used up. Returns False if Ctrl-C ended it; then a checkpoint is written."""
    options, counters = run.options, run.counters
    schedule = Schedule(run)
    seeds = [derive_seed(options.seed, "environment", worker + run.envs.count * counters.starts) for worker in range(run.envs.count)]
    counters.starts += 1
    record = run.envs.reset(seeds)
    carry = run.learner.initial_carry(run.envs.count)
    scores = Scores(run.envs.count)
    with _interruptible(run.interrupted):
        while run.step < options.steps and not run.interrupted:
            observation = {key: record[key] for key in run.envs.spaces.observations}
            seed = derive_seed(options.seed, "policy", counters.policy_steps)
            action, latents, carry = run.learner.policy(observation, record["is_first"], carry, seed)
            counters.policy_steps += 1
            action = finite_action(run, action)
            run.envs.start(action)  # The environments step while the learner trains.
            remember_and_learn(run, record, action, {name: np.asarray(value) for name, value in latents.items()})
            for score, length in scores.update(record):
                log_episode(run, score, length)
            schedule.attend(run)
            record = run.envs.finish()
        if run.interrupted:
            path = save(run)
            run.display.say(f"interrupted at step {run.step:,}, saved in {path}; the same command continues from here")
    return not run.interrupted


def remember_and_learn(run: Run, record: Record, action: np.ndarray, latents: Mapping[str, np.ndarray]) -> None:
    """Adds the workers' records one by one, and after each one trains as often as the replay ratio says: [LOOP-4]."""
    action = np.where(record["is_last"][:, None], np.float32(0), action)  # [LOOP-9]: nothing can be done at an end.
    packed = run.replay.pack({**record, "action": action, **latents})
    for worker in range(run.envs.count):
        run.replay.add_packed(packed, worker, worker)
        run.counters.records += 1
        if can_train(len(run.replay), run.options.config):
            for _ in range(run.ratio(run.counters.records)):
                learn(run)


def learn(run: Run) -> None:
    """One train step. The next batch is drawn meanwhile, and the latents are written back when they are computed: [LOOP-17]."""
    batch = run.replay.take()
    ids = batch.pop("ids")
    metrics, latents = run.learner.train_step(batch, derive_seed(run.options.seed, "train", run.counters.train_steps))
    run.replay.write_back(ids, latents)
    run.counters.train_steps += 1
    run.metrics.append(metrics)


class Scores:
    """Returns and lengths of the episodes under way: [LOOP-20]."""

    def __init__(self, count: int) -> None:
        self._total = np.zeros(count)
        self._length = np.zeros(count, int)

    def update(self, record: Record) -> list[tuple[float, int]]:
        """(return, length) of the episodes that end with these records."""
        self._total = np.where(record["is_first"], 0.0, self._total) + record["reward"]
        self._length = np.where(record["is_first"], 0, self._length) + 1
        return [(float(self._total[worker]), int(self._length[worker])) for worker in np.flatnonzero(record["is_last"])]


@contextmanager
def _interruptible(received: list[int]) -> Iterator[None]:
    """The first Ctrl-C or termination signal is added to the list; the next one works as always."""
    previous: dict[int, Any] = {}

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)
        signal.signal(number, previous[number])

    try:
        for number in (int(signal.SIGINT), int(signal.SIGTERM)):
            previous[number] = signal.signal(number, receive)
    except ValueError:  # Not in the main thread: signals are somebody else's.
        previous.clear()
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
