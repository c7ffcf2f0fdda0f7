"""Where runs are made: processes on this machine, or a Ray cluster. Both are given the same words."""

import contextlib
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from dreamer_spec.errors import UserError

RUN = ("-m", "dreamer_spec.sweeping.item")


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
        with open(log, "ab") as file, _on(share):
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


class Ray:
    """A Ray cluster, the one that RAY_ADDRESS names or this machine. What its tasks read and write must lie on a disk
    that all machines share.

    options: of each task, such as num_cpus and num_gpus.

    Raises:
      UserError: Ray is not installed, or does not take the options.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        try:
            self._ray: Any = importlib.import_module("ray")
        except ModuleNotFoundError as error:
            raise UserError("[ray] needs the package ray: pip install 'dreamer-spec[ray]'") from error
        if not self._ray.is_initialized():
            self._ray.init(log_to_driver=False)
        try:
            self._run = self._ray.remote(run_to_its_end).options(max_retries=0, **options)
        except (TypeError, ValueError) as error:
            raise UserError(f"[ray]: {error}") from error

    def start(self, command: Sequence[str], log: Path) -> Any:
        return self._run.remote(list(command), str(Path.cwd()), str(log.resolve()))

    def code(self, handle: Any) -> int | None:
        ready, _ = self._ray.wait([handle], timeout=0)
        if not ready:
            return None
        try:
            return int(self._ray.get(handle))
        except self._ray.exceptions.TaskCancelledError:
            return 130
        except self._ray.exceptions.RayError:  # its machine is gone
            return 1

    def end(self, handle: Any) -> None:
        self._ray.cancel(handle)


def run_to_its_end(command: list[str], folder: str, log: str) -> int:
    """A task of Ray: one run as a process. It ends with the task."""
    with open(log, "ab") as file:
        run = subprocess.Popen(
            [sys.executable, *RUN, *command], cwd=folder, stdin=subprocess.PIPE, stdout=file, stderr=subprocess.STDOUT
        )
        try:
            return run.wait()
        finally:
            assert run.stdin is not None
            run.stdin.close()
            run.wait()
