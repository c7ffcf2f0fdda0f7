"""Where runs are made: processes on this machine, or a Ray cluster. Both are given the same words."""

import contextlib
import dataclasses
import importlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from dreamer_spec.errors import UserError, writing
from dreamer_spec.system.signals import take_back
from dreamer_spec.words import counted

RUN = ("-m", "dreamer_spec.sweeping.item")
APART = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:], start_new_session=True))"
INTERRUPTED = 130  # exit code of a run that was asked to end
MOST_STARTS = 4  # of one run on Ray in one sweep
LOOK = 0.2  # seconds


class Place(Protocol):
    """Something that runs items."""

    def start(self, command: Sequence[str], log: Path) -> Any:
        """A handle of a run that begins now. log: the file that gets what it says."""

    def code(self, handle: Any) -> int | None:
        """The exit code of a run; None while it goes on."""

    def end(self, handle: Any) -> None:
        """Asks a run to end with a checkpoint."""


class Processes:
    """This machine. jobs: at once; each gets its share of the cores, where the system can give it."""

    def __init__(self, jobs: int) -> None:
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        self._free = [set(cores[job::jobs]) for job in range(min(jobs, len(cores)))]
        self._shares: dict[int, set[int]] = {}

    def start(self, command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
        share = self._free.pop(0) if self._free else None
        with writing(log), open(log, "ab") as file, _on(share):
            run = subprocess.Popen(
                [sys.executable, *RUN, *command],
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches the sweep alone, which asks its runs to end
            )
        if share is not None:
            self._shares[run.pid] = share
        return run

    def code(self, handle: subprocess.Popen[bytes]) -> int | None:
        code = handle.poll()
        if code is not None and handle.pid in self._shares:
            self._free.append(self._shares.pop(handle.pid))
        return code

    def end(self, handle: subprocess.Popen[bytes]) -> None:
        assert handle.stdin is not None
        handle.stdin.close()


@contextlib.contextmanager
def _on(cores: set[int] | None) -> Iterator[None]:
    """Inside, this thread and the processes that it starts have these cores."""
    if cores is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@dataclasses.dataclass
class Task:
    """A run on Ray. result: what Ray will know of it. starts: how often it was handed over. ending: asked to end."""

    command: Sequence[str]
    log: Path
    result: Any
    starts: int = 1
    ending: bool = False


class Ray:
    """A Ray cluster, the one that RAY_ADDRESS names or this machine. What its tasks read and write must lie on a disk
    that all machines share. A run whose worker is lost is handed over again, and goes on from its checkpoint.

    options: of each task, such as num_cpus and num_gpus.

    Raises:
      UserError: Ray is not installed, cannot be reached, or does not take the options.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        try:
            self._ray: Any = importlib.import_module("ray")
        except ModuleNotFoundError as error:
            raise UserError("[ray] needs the package ray: pip install 'dreamer-spec[ray]'") from error
        try:
            self._run = self._ray.remote(run_to_its_end).options(max_retries=0, **options)
        except (TypeError, ValueError) as error:
            raise UserError(f"[ray]: {error}") from error
        if not self._ray.is_initialized():
            try:
                self._ray.init(log_to_driver=False)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise UserError(f"[ray]: {error}; RAY_ADDRESS names the cluster, or none for this machine") from error
        take_back()  # the handler of SIGTERM, which `ray.init` replaces by its own

    def start(self, command: Sequence[str], log: Path) -> Task:
        return Task(command, log, self._hand_over(command, log))

    def code(self, handle: Task) -> int | None:
        ready, _ = self._ray.wait([handle.result], timeout=0)
        if not ready:
            return None
        errors = self._ray.exceptions
        try:
            return int(self._ray.get(handle.result))
        except errors.TaskCancelledError:
            return INTERRUPTED
        except errors.RayError as error:
            if handle.ending:
                return INTERRUPTED
            if isinstance(error, errors.RayTaskError) or handle.starts == MOST_STARTS:
                with contextlib.suppress(OSError), open(handle.log, "a", encoding="utf-8") as file:
                    file.write(f"Ray, after {counted(handle.starts, 'start')}: {' '.join(str(error).split())}\n")
                return 1
        handle.starts += 1
        handle.result = self._hand_over(handle.command, handle.log)
        return None

    def end(self, handle: Task) -> None:
        handle.ending = True
        self._ray.cancel(handle.result)

    def _hand_over(self, command: Sequence[str], log: Path) -> Any:
        return self._run.remote(list(command), str(Path.cwd()), str(log.resolve()))


def run_to_its_end(command: list[str], folder: str, log: str) -> int:
    """A task of Ray: one run as a process. `ray.cancel` raises KeyboardInterrupt here; the task ends after the run, so
    that whoever waits for the task knows that the checkpoint is written.

    A worker that ends kills its children, without a signal that a run could answer. The run is a child of its child
    (APART), and in a session of its own: it outlives the worker, sees the pipe close, and saves.
    """
    with open(log, "ab") as file:
        run = subprocess.Popen(
            [sys.executable, "-c", APART, sys.executable, *RUN, *command],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    assert run.stdin is not None
    try:
        while run.poll() is None:
            time.sleep(LOOK)  # `run.wait()` would not notice the exception
    except KeyboardInterrupt:
        pass
    finally:
        run.stdin.close()
    return run.wait()
