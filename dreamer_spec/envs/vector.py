"""N environments side by side, each a stream of records as in spec/00-notation.md, made one by one or as a vector, and
restarted when they fail."""

import collections
import contextlib
import dataclasses
import functools
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from dreamer_spec.envs.adapter import where
from dreamer_spec.envs.contract_vector import Adapted, count_of
from dreamer_spec.envs.failure import Failure
from dreamer_spec.envs.history import History, OngoingEpisode
from dreamer_spec.envs.info import EpisodeInfo
from dreamer_spec.envs.process import CLOSING
from dreamer_spec.envs.records import Record, observed
from dreamer_spec.envs.steps import Step
from dreamer_spec.envs.stream import StreamEnv
from dreamer_spec.envs.trial import Trial, make_here, try_out
from dreamer_spec.envs.worker import InProcess, OwnProcess, Worker, receive
from dreamer_spec.errors import UserError
from dreamer_spec.translation import Translation
from reference_numpy.training_loop import derive_seed, step_flags
from spec import Spaces

WINDOW = 100_000  # records of all workers among which failures are counted


class Environments:
    """`count` environments, in this process or in one process each.

    make: index -> environment; must be picklable by cloudpickle. timeout: seconds that a step, or a reset with the
    making before it, may take. Only a process of its own can be held to it: an environment in this process that hangs
    stops everything, and nobody notices. failures_allowed: within 100,000 records of all workers together. trial: what
    is known of these environments, if they have been tried out. task: for messages, where they have not.

    `start(action)` sends the actions off, `finish()` waits for the records: what happens in between overlaps with the
    environments where they have processes of their own. `reset(seeds)` restarts all of them, and seeds this episode
    and all after it.

    An environment that crashes, raises, hangs or returns what its spaces do not allow is restarted: another is made and
    reset; its next record has `is_first`, and the others go on undisturbed: [LOOP-32]. Where `make` gives a vector,
    there are as many environments as it has, whatever `count` says, and they are restarted together: [LOOP-74].

    Raises:
      UserError: from here, if the first environment cannot be made; from `reset` and `finish`, if an environment gives
      no first record in three attempts ([LOOP-46]), or if there were too many failures.
    """

    def __init__(
        self,
        make: Callable[[int], Adapted],
        count: int,
        processes: bool,
        timeout: float = 600.0,
        failures_allowed: int = 10,
        trial: Trial | None = None,
        task: str = "",
    ) -> None:
        self.count, self.is_vector = count, False
        self.failures = 0  # so far
        self._failures_allowed = failures_allowed
        self._failed_at: collections.deque[int] = (
            collections.deque()
        )  # records before each failure, of those in the window
        self._untold: list[Failure] = []
        self._attempts = collections.Counter[int]()  # of each worker to give its first record
        self._records = 0
        first = None if processes else make_here(make, self._count, task)
        known = trial or try_out(make, self._count, task, timeout=timeout) if first is None else first
        self.translation: Translation = known.translation
        self.spaces: Spaces = known.translation.spaces
        self.frame_skip: int = known.frame_skip
        together = known.together if isinstance(known, Trial) else count_of(known)
        if together:
            self.count, self.is_vector = together, True
        self.info: list[dict[str, float]] = [
            {}
        ] * self.count  # of the last records that end an episode: the numbers chosen by --info-metrics
        self._episodes: dict[int, OngoingEpisode] = {}
        self._action = np.zeros((self.count, self.spaces.action_size), np.float32)
        self._pending = False  # whether actions were sent off whose records have not been asked for
        self._workers: list[Worker] = []
        self._places = [range(together)] if together else [range(index, index + 1) for index in range(count)]
        for index in range(len(self._places)):
            stream = functools.partial(
                StreamEnv, make, index, known.task, self.translation, os.getpid(), together=together
            )
            place = functools.partial(where, known.task, index, together=together)
            if processes:
                self._workers.append(OwnProcess(stream, index, place, timeout, together))
            else:
                self._workers.append(InProcess(stream, None if index else first))

    def reset(self, seeds: Sequence[int]) -> Record:
        """The first records of new episodes, [N, ...] each."""
        self._settle()
        self._begin_all([self._fresh(seed) for seed in seeds])
        return self._record(self._receive())

    def start(self, action: np.ndarray) -> None:
        """Sends flat actions [N, A]; where the last record was the last of an episode, the action is ignored."""
        self._action, self._pending = np.array(action, np.float32), True
        for worker, places in zip(self._workers, self._places, strict=True):
            worker.step(self._action if self.is_vector else self._action[places[0]])

    def finish(self) -> Record:
        """The records that follow the actions, [N, ...] each."""
        self._pending = False
        return self._record(self._receive())

    def step(self, action: np.ndarray) -> Record:
        """`start` and `finish` in one."""
        self.start(action)
        return self.finish()

    def histories(self) -> list[History | None]:
        """What `restore` needs to come back to the last records, also while actions are on their way. [LOOP-34]

        None for an episode that is too long to be kept.
        """
        return [self._episodes[worker].history() for worker in range(self.count)]

    def restore(self, histories: Sequence[History | None]) -> Record | None:
        """Plays every worker's episode again, and returns the last records: of deterministic environments those that
        `finish` had returned, and from here on everything is as if nothing had been interrupted. [LOOP-34]

        Returns:
          The records [N, ...], to be compared with the saved ones; or None where a history is missing or cannot be
          replayed. Then, and where they differ, `reset` must be called.
        """
        self._settle()
        fitting = [
            history for history in histories if history and history.actions.shape[1:] == (self.spaces.action_size,)
        ]
        if len(fitting) != self.count:
            return None
        self._begin_all(fitting)
        for index, history in enumerate(fitting):
            self._action[index] = history.actions[-1] if len(history.actions) else 0
        steps, failures = self._ask(range(len(self._workers)))
        for failure in failures:
            self._end(failure)
        return None if failures else self._record(steps)

    @contextlib.contextmanager
    def lend(self) -> Iterator[None]:
        """Inside, other episodes may be played. Afterwards `histories` says what it said before, and `next_episodes`
        must be called."""
        self._settle()
        episodes, action = dict(self._episodes), self._action
        try:
            yield
        finally:
            self._settle()
            self._episodes, self._action = episodes, action

    def next_episodes(self) -> Record:
        """The first records [N, ...] of the episodes that follow those whose last records were given, as `finish` would
        give them."""
        episodes = [self._episodes[index] for index in range(self.count)]
        self._begin_all([dataclasses.replace(self._fresh(own.seed), episode=own.number + 1) for own in episodes])
        return self._record(self._receive())

    def take_failures(self) -> list[Failure]:
        """The failures since the last call."""
        told, self._untold = self._untold, []
        return told

    def close(self) -> None:
        """Ends everything, within seconds, whatever the environments do (unless they are in this process)."""
        deadline = time.monotonic() + CLOSING
        for worker in self._workers:
            worker.shut()
        for worker in self._workers:
            worker.kill(deadline)

    def _fresh(self, seed: int) -> History:
        return History(seed, 0, np.zeros((0, self.spaces.action_size), np.float32))

    def _settle(self) -> None:
        """Takes the answers that nobody wants any more."""
        if self._pending:
            self.finish()

    def _begin_all(self, histories: Sequence[History]) -> None:
        for worker, places in enumerate(self._places):
            self._begin(worker, [histories[index] for index in places])

    def _begin(self, worker: int, histories: Sequence[History]) -> None:
        self._workers[worker].begin(histories)
        for index, history in zip(self._places[worker], histories, strict=True):
            self._episodes[index] = OngoingEpisode(history)

    def _receive(self) -> dict[int, Step]:
        """One step of every environment; those that fail are restarted until they give the first record of an episode:
        [LOOP-32]."""
        steps, failures = self._ask(range(len(self._workers)))
        while failures:
            for failure in failures:
                self._count(failure)
                self._end(failure)
                seeds = [self._episodes[index].seed for index in self._places[failure.worker]]
                self._begin(failure.worker, [self._fresh(derive_seed(seed, "restart", 0)) for seed in seeds])
            again, failures = self._ask([failure.worker for failure in failures])
            steps |= again
        return steps

    def _ask(self, workers: Iterable[int]) -> tuple[dict[int, Step], list[Failure]]:
        """What the workers have done, and what went wrong."""
        answers = receive({worker: self._workers[worker] for worker in workers})
        steps: dict[int, Step] = {}
        for worker, answer in answers.items():
            if not isinstance(answer, Failure):
                steps.update(zip(self._places[worker], answer, strict=True))
        return steps, [answer for answer in answers.values() if isinstance(answer, Failure)]

    def _count(self, failure: Failure) -> None:
        """Raises a UserError where there were too many."""
        self.failures += 1
        self._untold.append(dataclasses.replace(failure, together=self.count if self.is_vector else None))
        self._failed_at.append(self._records)
        while self._failed_at[0] <= self._records - WINDOW:
            self._failed_at.popleft()
        self._attempts[failure.worker] += not self._records
        if not self._records and failure.is_final(self._attempts[failure.worker]):
            raise failure.error(self._attempts[failure.worker])
        if len(self._failed_at) > self._failures_allowed:
            raise UserError(
                f"{failure.message}; the environments failed {len(self._failed_at)} times within {WINDOW:,} records, "
                f"and {self._failures_allowed} are allowed (--env-failures)",
                failure.details,
            )

    def _end(self, failure: Failure) -> None:
        worker = self._workers[failure.worker]
        worker.shut()
        worker.kill(time.monotonic() + (0 if failure.kind == "timeout" else CLOSING))

    def _record(self, steps: Mapping[int, Step]) -> Record:
        """The steps side by side, in memory of their own."""
        flags = []
        for worker in range(self.count):
            episode = self._episodes[worker]
            if episode.is_last:
                self._episodes[worker] = episode = episode.next()
            flags.append(step_flags(episode.records == 0, *steps[worker][2:4]))
            episode.add(self._action[worker], is_last=flags[-1]["is_last"])
        self._records += self.count
        self.info = [steps[worker][4].get("metrics", EpisodeInfo()).values for worker in range(self.count)]
        observations, rewards, _, _, _ = zip(*(steps[worker] for worker in range(self.count)), strict=True)
        return observed(observations, rewards, flags)
