"""What is to be known of an environment before a run has any: its spaces, and whether its steps deserve a process."""

import contextlib
import dataclasses
import functools
import multiprocessing
import time
from collections.abc import Callable, Iterator
from multiprocessing import connection
from typing import Any

import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from dreamer_spec.envs.contract_vector import Adapted, ContractVector, count_of
from dreamer_spec.envs.failure import Failure, attempt
from dreamer_spec.envs.guest import guest
from dreamer_spec.envs.history import History
from dreamer_spec.envs.process import (
    CLOSING,
    DYING,
    begin_worker,
    ended,
    no_answer,
    not_started,
    start_method,
    starting,
)
from dreamer_spec.envs.spaces import random_actions
from dreamer_spec.envs.steps import is_last
from dreamer_spec.translation import Translation

SLOW_STEP = 5e-4  # seconds; from here on a process of its own is faster than taking turns

Make = Callable[[int], Adapted]
Tell = Callable[[Failure], None]


@dataclasses.dataclass(frozen=True)
class Trial:
    """task, translation, frame_skip: of all environments. together: how many a vector has; None where they are made one
    by one.

    deserves_process: because its steps are slow, or because it failed when it was tried out.
    """

    task: str
    translation: Translation
    frame_skip: int
    together: int | None = None
    deserves_process: bool = True


def try_out(make: Make, tell: Tell, task: str = "", seed: int | None = None, timeout: float = 600.0) -> Trial:
    """Makes one environment in a process of its own, and looks at it.

    tell: gets the failures that do not matter. task: for messages. seed: of a reset and of random steps, 0.3 seconds of
    them at most, which show how long a step takes; None: neither. timeout: seconds that making, a reset or all the
    steps may take.

    Raises:
      UserError: it cannot be made in three attempts, or this or the reset hangs.
    """
    attempts = 0
    while True:
        with _process(make, task, seed, timeout) as receive:
            made = receive("when it was made")
            if not isinstance(made, Failure):
                known_task, translation, frame_skip, together = made
                return Trial(
                    known_task, translation, frame_skip, together, seed is None or _deserves_process(receive, tell)
                )
        attempts += 1
        _require_another(made, attempts, tell)


def make_here(make: Make, tell: Tell, task: str = "") -> Adapted:
    """The first environment, in this process.

    Raises:
      UserError: it cannot be made in three attempts.
    """

    def make_once() -> Adapted | Failure:
        with guest():
            return attempt(lambda: make(0), 0, lambda: _place(task, "when it was made"))

    attempts = 0
    while isinstance(made := make_once(), Failure):
        attempts += 1
        _require_another(made, attempts, tell)
    return made


def _require_another(failure: Failure, attempts: int, tell: Tell) -> None:
    if failure.is_final(attempts):
        raise failure.error(attempts)
    tell(failure)


def _deserves_process(receive: Callable[[str], Any], tell: Tell) -> bool:
    answer = receive("at its first reset")
    if isinstance(answer, Failure) and answer.kind == "timeout":
        raise answer.error(1)
    if not isinstance(answer, Failure):
        answer = receive("in its first steps")
    if isinstance(answer, Failure):
        tell(answer)
        return True
    return bool(answer > SLOW_STEP)


@contextlib.contextmanager
def _process(make: Make, task: str, seed: int | None, timeout: float) -> Iterator[Callable[[str], Any]]:
    """A function that returns the next answer of `_look`, or a Failure."""
    sent: Any = functools.partial(make, 0)
    try:
        context: Any = multiprocessing.get_context(start_method())
        with starting():
            ours, theirs = context.Pipe(duplex=False)
            process = context.Process(
                target=_look, args=(CloudpickleWrapper(sent), task, seed, theirs)
            )  # No daemon, which could not make a vector with processes of its own.
            process.start()
            theirs.close()
    except (Exception, SystemExit) as error:  # What is pickled may raise anything.
        failure = Failure(0, "crash", f"{_place(task, 'when it was made')}: {not_started(error)}", certain=True)
        yield lambda what: failure
        return

    patience = CLOSING

    def receive(what: str) -> Any:
        nonlocal patience
        patience = 0.0
        if not connection.wait([ours], timeout):
            return Failure(0, "timeout", f"{_place(task, what)}: {no_answer(timeout)}")
        patience = CLOSING
        try:
            return ours.recv()
        except (EOFError, OSError):
            process.join(DYING)
            return Failure(0, "crash", f"{_place(task, what)}: {ended(process.exitcode)}")

    try:
        yield receive
        process.join(patience)
    finally:
        process.kill()  # Not terminate, which workers ignore.
        process.join(DYING)
        ours.close()


def _look(make: Callable[[], Adapted], task: str, seed: int | None, pipe: connection.Connection) -> None:
    """Runs in the process. Answers with the task and its spaces, then with None after a reset, then with the seconds of
    a step."""
    begin_worker()
    env = attempt(make, 0, lambda: _place(task, "when it was made"))
    if isinstance(env, Failure):
        pipe.send(env)
        return
    pipe.send((env.task, env.translation, env.frame_skip, count_of(env)))
    if seed is not None:
        began = attempt(lambda: _begin(env, seed), 0, lambda: _place(task, "at its first reset"))
        pipe.send(began)
        if began is None:
            pipe.send(attempt(lambda: _seconds(env, seed), 0, lambda: _place(task, "in its first steps")))
    attempt(env.close, 0, lambda: _place(task, "when it was closed"))


def _begin(env: Adapted, seed: int) -> None:
    if isinstance(env, ContractVector):
        nothing = np.zeros((0, env.spaces.action_size), np.float32)
        env.resume([History(seed + index, 0, nothing) for index in range(env.count)])
    else:
        env.reset(seed=seed)


def _seconds(env: Adapted, seed: int) -> float:
    """That a step takes: the mean over 100 random steps, or over 0.3 seconds."""
    rng = np.random.default_rng(seed)
    start, steps = time.perf_counter(), 0
    while steps < 100 and time.perf_counter() - start < 0.3:
        steps += 1
        if isinstance(env, ContractVector):
            env.step(random_actions(env.spaces, rng, env.count))
        elif is_last(env.step(random_actions(env.spaces, rng, 1)[0])):
            env.reset()
    return (time.perf_counter() - start) / steps


def _place(task: str, what: str) -> str:
    return f"task {task}, environment 0, {what}" if task else f"environment 0, {what}"
