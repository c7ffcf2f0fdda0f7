"""One stream, of an environment or of a vector, in this process or in one of its own, behind the same functions. What
goes wrong comes back as a `Failure`."""

import contextlib
import functools
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import connection
from typing import Any, Literal

import numpy as np
from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from dreamer_spec.envs.contract_vector import Adapted
from dreamer_spec.envs.failure import Failure
from dreamer_spec.envs.guest import guest
from dreamer_spec.envs.history import History
from dreamer_spec.envs.process import DYING, ended, no_answer, not_started, start_method, starting
from dreamer_spec.envs.steps import Step, separate
from dreamer_spec.envs.stream import StreamEnv

# What Gymnasium raises where the process has ended: when something is received, when it is sent, and when that had
# failed.
GONE = (EOFError, OSError, NoAsyncCallError)

Answer = list[Step] | Failure  # a step of each environment of the stream


class InProcess:
    """Works when it is asked for its answer, and for as long as the environment takes: nobody could notice that it
    hangs.

    make_stream: env -> stream of that environment, or of one that it makes itself. env: the environment, if it has been
    made already.
    """

    def __init__(self, make_stream: Callable[..., StreamEnv], env: Adapted | None = None) -> None:
        self._make_stream = make_stream
        self._stream = self._make_stream(env)
        self._work: Callable[[], Step] | None = None

    def begin(self, histories: Sequence[History]) -> None:
        """Makes the environment if there is none, resets it, and replays the actions of its history: [LOOP-34].

        histories: as many as there are environments in the stream.
        """
        self._work = functools.partial(self._stream.resume, histories)

    def step(self, action: np.ndarray) -> None:
        """Sends a flat action [A] off, or those [N, A] of a vector."""
        self._work = functools.partial(self._stream.step, action)

    def receive(self) -> Answer:
        """What followed."""
        assert self._work is not None, "nothing was sent off"
        step = self._work()
        return step[4].get("failure") or separate(step)

    def shut(self) -> None:
        """Asks the environment to close. After this and `kill`, `begin` makes a new one."""
        with guest():
            self._stream.shut()

    def kill(self, deadline: float) -> None:
        """Ends what has not ended by itself at the deadline, by `time.monotonic`."""
        self._stream = self._make_stream()


class OwnProcess:
    """A vector environment of one: its process can be killed and another started, and no other worker notices.

    make_stream: of its environment. place: how many steps -> where that is, for messages. timeout: seconds for an
    answer. together: how many environments a vector has; it may have processes of its own. patience: the timeout, or
    more while actions are replayed. pipe: through which the answer comes.
    """

    def __init__(
        self,
        make_stream: Callable[[], StreamEnv],
        index: int,
        place: Callable[[int], str],
        timeout: float,
        together: int | None = None,
    ) -> None:
        self._make_stream = make_stream
        self._index, self._place, self._timeout, self._together = index, place, timeout, together
        self._envs: AsyncVectorEnv | None = None
        self._wait: Callable[[float | None], Step] = self._wait_for_reset
        self._steps = 0
        self._ended = False
        self._not_started = ""  # why it has no process
        self.patience = timeout
        self.pipe: connection.Connection | None = None

    @property
    def process(self) -> Any:
        """The worker process."""
        return self._running().processes[0]

    def begin(self, histories: Sequence[History]) -> None:
        replayed = max(len(history.actions) for history in histories)
        self._wait, self.patience, self._steps = self._wait_for_reset, self._timeout * (1 + replayed), replayed
        if self._envs is None:
            self._start()
        with contextlib.suppress(*GONE):  # `receive` will say so.
            self._running().reset_async(options={"histories": histories})

    def _start(self) -> None:
        try:
            with starting():
                makers = [self._make_stream]
                self._envs = AsyncVectorEnv(
                    makers,
                    copy=False,
                    context=start_method(),
                    daemon=self._together is None,  # A daemon may not start processes, as AsyncVectorEnv does.
                    autoreset_mode=AutoresetMode.DISABLED,
                )
                (self.pipe,) = self._envs.parent_pipes
        except (Exception, SystemExit) as error:  # `receive` will say so. What is pickled may raise anything.
            self._not_started = not_started(error)

    def step(self, action: np.ndarray) -> None:
        self._wait, self.patience = self._wait_for_step, self._timeout
        self._steps += not self._ended
        with contextlib.suppress(*GONE):
            self._running().step_async(action[None])

    def receive(self) -> Answer:
        try:
            step = self._wait(None)
        except GONE:
            return self._failure("crash", self._last_words())
        self._ended = step[2] or step[3]
        if "failure" in step[4]:
            return step[4]["failure"][0]
        return separate((*step[:4], {name: step[4][name][0] for name in ("metrics", "batch") if name in step[4]}))

    def expired(self) -> Failure:
        """The answer that stands for none within `patience` seconds."""
        return self._failure("timeout", no_answer(self.patience))

    def shut(self) -> None:
        with contextlib.suppress(*GONE, AlreadyPendingCallError):
            self._running().call_async("shut")

    def kill(self, deadline: float) -> None:
        if self._envs is None or self.pipe is None:
            return
        with contextlib.suppress(*GONE, multiprocessing.TimeoutError):
            with contextlib.suppress(NoAsyncCallError):
                self._wait(_left(deadline))  # It still owes this answer, so it could not be asked to close.
                self.shut()
            self._envs.call_wait(_left(deadline))
        self.process.kill()  # Not terminate, which workers ignore.
        self.process.join(DYING)
        self.pipe.close()
        self._envs.closed = True  # Gymnasium would wait without limit.
        self._envs = self.pipe = None

    def _running(self) -> AsyncVectorEnv:
        if self._envs is None:
            raise EOFError
        return self._envs

    def _wait_for_reset(self, timeout: float | None) -> Step:
        observation, info = self._running().reset_wait(timeout)
        return _only(observation), info["reward"][0], info["terminated"][0], info["truncated"][0], info

    def _wait_for_step(self, timeout: float | None) -> Step:
        observation, reward, terminated, truncated, info = self._running().step_wait(timeout)
        return _only(observation), reward[0], terminated[0], truncated[0], info

    def _last_words(self) -> str:
        if self._envs is None:
            return self._not_started
        self.process.join(DYING)
        return ended(self.process.exitcode)

    def _failure(self, kind: Literal["crash", "timeout"], what: str) -> Failure:
        message = f"{self._place(self._steps)}: {what}"
        return Failure(self._index, kind, message, certain=self._envs is None)


Worker = InProcess | OwnProcess


def receive(workers: Mapping[int, Worker]) -> dict[int, Answer]:
    """The answers of these workers, in the order given. They are waited for together, as long as the most patient of
    them allows."""
    answers: dict[int, Answer] = {}
    waiting: dict[connection.Connection, tuple[int, OwnProcess]] = {}
    here: dict[int, Worker] = {}
    for index, worker in workers.items():
        if isinstance(worker, OwnProcess) and worker.pipe is not None:
            waiting[worker.pipe] = index, worker
        else:
            here[index] = worker
    if here:
        with guest():  # once for all of them: it takes as long as a step of a simple environment
            answers |= {index: worker.receive() for index, worker in here.items()}
    deadline = time.monotonic() + max((worker.patience for _, worker in waiting.values()), default=0.0)
    while waiting:
        ready: list[Any] = connection.wait(list(waiting), _left(deadline))
        for pipe in ready or list(waiting):
            index, late = waiting.pop(pipe)
            answers[index] = late.receive() if ready else late.expired()
    return {index: answers[index] for index in workers}


def _only(observation: Any) -> dict[str, np.ndarray]:
    return {key: value[0] for key, value in observation.items()}


def _left(deadline: float) -> float:
    return max(deadline - time.monotonic(), 0.0)
