"""What notices a mutant of an implementation: a check, the preflight, a test, or nothing."""

import contextlib
import dataclasses
import json
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from conformance.mutants.implementations import Patch
from conformance.mutants.implementations.planting import environment, planted

JUDGING = "conformance.mutants.implementations.judging"
DTYPES = ("float32", "float64", "bfloat16")
TIMEOUT = 1800.0  # seconds of one process: a mutant may hang
EXAMPLES = 5
PROCESS = ("timeout", "signal")  # how a process ends that does not answer
CRASHES = (signal.SIGSEGV, signal.SIGABRT)  # of the mutant's own making; somebody may have ended the process otherwise


@dataclasses.dataclass(frozen=True)
class Outcome:
    """by: "check", "preflight", "test", "no device" (not judged), or None for a survivor. name: of what noticed it.
    dtype: of the check. how: "fail" or "error", and "timeout" or "signal" of the process."""

    by: str | None = None
    name: str | None = None
    dtype: str | None = None
    how: str | None = None
    seconds: float = 0.0

    @property
    def is_caught(self) -> bool:
        return self.by in ("check", "preflight", "test")

    @property
    def words(self) -> str:
        if self.by is None:
            return "survived"
        precision = f" in {self.dtype}" if self.dtype else ""
        return f"{self.by} {self.name}{precision}"


class Trials:
    """Judges mutants one by one, each in a process of its own.

    confirm: a check, the preflight or a test counts only if the implementation without the mistake passes it; what it
    passes is asked once. examples: that are drawn for each property.
    """

    def __init__(self, confirm: bool = True, examples: int = EXAMPLES) -> None:
        self._confirm, self._examples = confirm, examples
        self._passes: dict[tuple[str | None, ...], bool] = {}

    def judge(self, patch: Patch, compiled: Path) -> Outcome:
        """compiled: a folder for programs that JAX has compiled."""
        began = time.monotonic()
        with planted(patch) as root:
            found = self._noticed(patch, root, compiled)
        return dataclasses.replace(found, seconds=round(time.monotonic() - began, 1))

    def _noticed(self, patch: Patch, root: Path, compiled: Path) -> Outcome:
        skip: list[tuple[str, str]] = []
        preflight = patch.candidate != "trainer" and not patch.file.endswith("learner.py")
        while True:
            found = judged(patch, root, compiled, skip=skip, preflight=preflight, examples=self._examples)
            if not found.is_caught or self._sound(patch, found, compiled):
                break
            if found.how in PROCESS:  # not of the mistake's making: nothing more can be learned from checks
                found = Outcome()
                break
            if found.by == "check":
                skip.append((str(found.dtype), str(found.name)))
            else:
                preflight = False
        if found.by is not None:
            return found
        for arguments in patch.tests:
            tested = tested_with(arguments, root, compiled)
            alone = " ".join([str(tested.name), *arguments.split()[1:]])  # the test that failed, of the same backend
            if tested.is_caught and self._sound(patch, dataclasses.replace(tested, name=alone), compiled):
                return tested
        return found

    def _sound(self, patch: Patch, found: Outcome, compiled: Path) -> bool:
        """Whether the implementation without the mistake passes what noticed it."""
        if not self._confirm:
            return True
        key = (patch.candidate, found.by, found.dtype, found.name if found.by != "preflight" else None)
        if key not in self._passes:
            with planted(None) as root:
                if found.by == "test":
                    again = tested_with(str(found.name), root, compiled)
                else:
                    one = [found.dtype, found.name] if found.by == "check" else ["", ""]
                    only = None if found.how in PROCESS else one
                    dtypes = [str(found.dtype)] if found.by == "check" else []
                    preflight = found.by == "preflight"
                    again = judged(
                        patch, root, compiled, only=only, dtypes=dtypes, preflight=preflight, examples=self._examples
                    )
            self._passes[key] = not again.is_caught
        return self._passes[key]


def judged(
    patch: Patch,
    root: Path,
    compiled: Path,
    *,
    skip: list[tuple[str, str]] | None = None,
    only: list[Any] | None = None,
    dtypes: list[str] | None = None,
    preflight: bool,
    examples: int,
) -> Outcome:
    """What the checks, and after them the preflight, find in the copy at `root`. dtypes: of the checks; those that the
    candidate has, the likeliest first, by default.

    Each precision has a process of its own: what JAX compiles for all of them is more than one can hold.

    Raises:
      RuntimeError: judging itself does not work.
    """
    likeliest = "bfloat16" if patch.kind == "precision" else "float32"
    if dtypes is None:
        dtypes = ["float64"] if patch.candidate == "trainer" else sorted(DTYPES, key=lambda dtype: dtype != likeliest)
    request = {
        "candidate": patch.candidate,
        "file": patch.file,
        "device": patch.device,
        "examples": examples,
        "skip": skip or [],
        "only": only,
    }
    found = Outcome()
    for dtype in dtypes:
        found = _answer(patch, {**request, "dtypes": [dtype], "preflight": False}, root, compiled)
        if found.by is not None:
            return found
    return _answer(patch, {**request, "dtypes": [], "preflight": True}, root, compiled) if preflight else found


def _answer(patch: Patch, request: Mapping[str, Any], root: Path, compiled: Path) -> Outcome:
    """What one process finds."""
    ran = _run([sys.executable, "-m", JUDGING, json.dumps(request)], root, compiled)
    by, dtype = ("check", request["dtypes"][0]) if request["dtypes"] else ("preflight", None)
    if ran is None:
        return Outcome(by, "(the process did not end)", dtype, "timeout")
    if -ran.returncode in CRASHES:
        return Outcome(by, f"(the process got signal {-ran.returncode})", dtype, "signal")
    if ran.returncode:
        raise RuntimeError(f"judging {patch.name} ended with {ran.returncode}:\n{ran.stderr[-2000:]}")
    answer: Mapping[str, Any] = json.loads(ran.stdout.strip().splitlines()[-1])
    return Outcome(**answer)


def tested_with(arguments: str, root: Path, compiled: Path) -> Outcome:
    """What the tests find in the copy at `root`: the first that fails.

    Raises:
      RuntimeError: pytest itself does not work.
    """
    command = [sys.executable, "-m", "pytest", "-x", "-p", JUDGING, "-p", "no:cacheprovider", "--tb=no"]
    ran = _run([*command, *shlex.split(arguments)], root, compiled)
    if ran is None:
        return Outcome("test", arguments, None, "timeout")
    if ran.returncode == 0:
        return Outcome()
    failed = re.search(r"^(?:FAILED|ERROR) ([^\s\[]+)", ran.stdout, re.MULTILINE)
    if ran.returncode != 1 or failed is None:
        raise RuntimeError(f"pytest {arguments} ended with {ran.returncode}:\n{ran.stdout[-2000:]}{ran.stderr[-2000:]}")
    return Outcome("test", failed[1], None, "fail")


def _run(command: list[str], root: Path, compiled: Path) -> subprocess.CompletedProcess[str] | None:
    """None if it did not end in time."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        return subprocess.run(
            command,
            cwd=root,
            env=environment(root, compiled),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
    return None


def trials(chosen: list[Patch], confirm: bool = True) -> Iterator[tuple[Patch, Outcome]]:
    """Each mutant with what noticed it."""
    judge = Trials(confirm).judge
    with tempfile.TemporaryDirectory(prefix="compiled-", ignore_cleanup_errors=True) as compiled:
        for patch in chosen:
            yield patch, judge(patch, Path(compiled))
