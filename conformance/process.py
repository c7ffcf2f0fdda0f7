"""The process interface: an implementation in a process of its own, asked by JSON lines over its standard streams.

Every request has one reply, and the next request is sent after it. Whatever the other side does, the kit gets a result:
a process that dies, hangs, prints without end or breaks the protocol is `CandidateLost`, which ends the check; the
next check restarts it. The messages are those of protocol.schema.json, docs/adapters.md explains them, serve.py is the
other side for Python.
"""

import collections
import contextlib
import dataclasses
import json
import os
import queue
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from typing import IO, Any

from conformance.compare import CandidateLost
from conformance.errors import UserError
from conformance.foreign import ForeignAdapter, as_edition
from conformance.serve import PROTOCOL, BadMessage, decode, encode, to_numpy

RESTARTS = 5
UNEXPECTED_LINES = 100
MESSAGE_BYTES = 2**26
VALUES = 200_000  # numbers, texts, lists, maps and arrays in one result
FUNCTIONS = 5000  # that a process may offer: a module with all of its imports has some hundreds
NAME = 200  # characters of a name
TEXT = 20_000  # characters of an error that are kept: a long traceback
IN_ALL = (
    100  # times the timeout: what the replies of all checks may take together, repetitions for smaller cases included
)
STDERR_LINES = 10
RAISED = {"ValueError": ValueError, "KeyError": KeyError, "NotImplementedError": NotImplementedError}
"""Errors that the requirements ask for, and what is not implemented; others are a `CandidateError`."""


class CandidateError(Exception):
    """The implementation answered with an error."""


def describe(value: Any) -> Any:
    """A configuration, spaces or a table entry in plain JSON types: its fields, what is derived from them, and its
    kind."""
    if dataclasses.is_dataclass(value):
        fields = [field.name for field in dataclasses.fields(value)]
        derived = [name for name, entry in vars(type(value)).items() if isinstance(entry, property)]
        return {
            "kind": type(value).__name__.lower(),
            **{name: describe(getattr(value, name)) for name in (*fields, *derived)},
        }
    if isinstance(value, Mapping):
        return {key: describe(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return [describe(entry) for entry in value]
    return value


def encode_argument(value: Any) -> Any:
    """`encode`, for the objects of the specification too."""
    if dataclasses.is_dataclass(value):
        return {"object": describe(value)}
    if isinstance(value, Mapping):
        return {"map": {key: encode_argument(entry) for key, entry in value.items()}}
    if isinstance(value, tuple | list):
        return [encode_argument(entry) for entry in value]
    return encode(value)


class Connection:
    """A running process. Threads read its output, so that no pipe of it fills up and nothing that it does blocks the
    kit."""

    def __init__(self, command: list[str]) -> None:
        """Raises OSError if there is no such program."""
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.partial = 0
        self._stdin = self.process.stdin
        self._lines: queue.Queue[bytes | None] = queue.Queue()
        self._errors: collections.deque[str] = collections.deque(maxlen=STDERR_LINES)
        self._readers = [
            threading.Thread(target=self._read_lines, args=(self.process.stdout,), daemon=True),
            threading.Thread(target=self._read_errors, args=(self.process.stderr,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def send(self, message: Mapping[str, Any]) -> None:
        """In the background: a process that does not read cannot hold up the kit."""
        line = json.dumps(message, allow_nan=False).encode("ascii") + b"\n"
        threading.Thread(target=self._write, args=(line,), daemon=True).start()

    def receive(self, deadline: float) -> bytes | None:
        """The next line, or None where the process has ended its output.

        Raises:
          TimeoutError: there is none before the deadline, a time of `time.monotonic`.
        """
        while True:
            try:
                return self._lines.get(timeout=max(0.0, min(deadline - time.monotonic(), 1.0)))
            except queue.Empty:
                if time.monotonic() >= deadline:
                    raise TimeoutError from None
                if self.process.poll() is not None and self._lines.empty():
                    return None  # a child of it may still hold the pipe

    def ended(self) -> str:
        """How the process ended, after it has closed its output."""
        try:
            code = self.process.wait(timeout=2)
        except subprocess.TimeoutExpired:
            return "closed its standard output"
        return (
            f"was ended by signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"ended with exit code {code}"
        )

    def last_errors(self) -> list[str]:
        """The last lines of its standard error."""
        self._readers[1].join(timeout=1)
        return list(self._errors)

    def kill(self) -> None:
        """With all that it has started, where the system has process groups."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL) if hasattr(os, "killpg") else self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # a process of another user may outlive this
            self.process.wait(timeout=2)
        self._stdin.close()

    def _write(self, line: bytes) -> None:
        rest = memoryview(line)
        with contextlib.suppress(OSError, ValueError):  # it is gone, which the next `receive` finds out
            while rest:
                rest = rest[self._stdin.write(rest) :]

    def _read_lines(self, stdout: IO[bytes]) -> None:
        """Until there is more than can become a reply, so that nobody fills the memory."""
        pieces: list[bytes] = []
        with contextlib.suppress(OSError, ValueError), stdout:
            while (
                self.partial <= MESSAGE_BYTES
                and self._lines.qsize() <= UNEXPECTED_LINES + 1
                and (chunk := stdout.read(2**20))
            ):
                *ends, rest = chunk.split(b"\n")
                for end in ends:
                    self._lines.put(b"".join([*pieces, end]))
                    pieces, self.partial = [], 0
                pieces.append(rest)
                self.partial += len(rest)
        self._lines.put(None)

    def _read_errors(self, stderr: IO[bytes]) -> None:
        rest = b""
        with contextlib.suppress(OSError, ValueError), stderr:
            while chunk := stderr.read(2**16):
                *lines, rest = (rest + chunk)[-(2**16) :].split(b"\n")
                self._errors.extend(line.decode(errors="replace") for line in lines)
        if rest:
            self._errors.append(rest.decode(errors="replace"))


class ProcessAdapter(ForeignAdapter):
    """The functions of an implementation in another process."""

    def __init__(self, command: str, dtype: str, timeout: float) -> None:
        """command: as in a shell, but no shell runs it. timeout: seconds for each reply.

        Raises:
          UserError: it cannot be started, or does not answer `start`; or the timeout is not above 0.
        """
        if not timeout > 0:
            raise UserError(f"--timeout: expected seconds above 0, got {timeout:g}")
        try:
            self._command = shlex.split(command)
        except ValueError as error:
            raise UserError(f"--process {command!r}: {error}") from error
        self._dtype = dtype
        self._timeout = timeout
        self._requests = 0
        self._starts = 0
        self._waited = 0.0
        self._connection: Connection | None = None
        self._unexpected = 0
        try:
            started = self._start()
        except CandidateLost as error:
            raise UserError(_in_one_line(error)) from error
        except BaseException:
            self.close()
            raise
        self.name: str = started["name"]
        self.version: str = started["version"]
        self.names: list[str] = started["functions"]

    def offers(self, name: str) -> bool:
        return name in self.names

    def call(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """Raises what the implementation raised, or `CandidateLost`."""
        result = self._ask("run", function=name, args=[encode_argument(argument) for argument in arguments])
        began = time.monotonic()
        try:
            _require_plain(result)
            return to_numpy(decode(result))
        except (
            BadMessage,
            TypeError,
            ValueError,
            OverflowError,
            RecursionError,
        ) as error:  # a ValueError here refuses no argument
            raise CandidateError(f"{name}: {_shortened(str(error))}") from error
        finally:
            self._waited += time.monotonic() - began

    def edition(self) -> str | None:
        try:
            edition = as_edition(self._ask("edition"))
            if edition is not None and len(edition) > NAME:
                raise UserError(f"edition: expected a name, got {len(edition):,} characters")
            return edition
        except (CandidateLost, CandidateError, ValueError, KeyError) as error:
            raise UserError(f"edition: {_in_one_line(error)}") from error

    def close(self) -> None:
        """Ends the process: with `stop`, and after two seconds by force."""
        if self._connection is None:
            return
        connection, self._connection = self._connection, None
        try:
            connection.send({"id": self._requests + 1, "method": "stop"})
            deadline = time.monotonic() + min(2.0, self._timeout)
            while connection.receive(deadline) is not None:
                pass
        except TimeoutError:
            pass
        finally:
            connection.kill()

    def _start(self) -> Mapping[str, Any]:
        if self._starts > RESTARTS:
            raise CandidateLost(f"the process is not started again: it was lost {self._starts} times")
        self._starts += 1
        self._unexpected = 0
        try:
            self._connection = Connection(self._command)
        except (OSError, IndexError) as error:
            raise CandidateLost(f"cannot run {shlex.join(self._command)!r}: {error}") from error
        try:
            started = self._exchange("start", {"protocol": PROTOCOL, "dtype": self._dtype})
        except (CandidateError, ValueError, KeyError) as error:
            raise self._lost("start", str(error)) from error
        if problem := _problem_of_start(started):
            raise self._lost("start", problem)
        return dict(started)

    def _ask(self, method: str, **content: Any) -> Any:
        if self._connection is None:
            self._start()
        if self._waited > IN_ALL * self._timeout:
            raise CandidateLost(
                f"its replies have taken more than {IN_ALL * self._timeout:g} s in all, {IN_ALL} times --timeout"
            )
        began = time.monotonic()
        try:
            return self._exchange(method, content)
        finally:
            self._waited += time.monotonic() - began

    def _exchange(self, method: str, content: Mapping[str, Any]) -> Any:
        """Sends a request and returns the result of its reply."""
        assert self._connection is not None
        self._requests += 1
        what = f"{method} {content['function']}" if method == "run" else method
        deadline = time.monotonic() + self._timeout
        self._connection.send({"id": self._requests, "method": method, **content})
        reply = self._reply(what, deadline)
        if reply.get("id") != self._requests:
            raise self._lost(what, f"answered request {reply.get('id')!r:.80} where {self._requests} was asked")
        if reply.keys() == {"id", "result"}:
            return reply["result"]
        error = reply.get("error")
        match error:
            case {"kind": str(kind), "message": str(message)} if reply.keys() == {"id", "error"}:
                if kind in RAISED:
                    raise RAISED[kind](_shortened(message))
                raise CandidateError(f"{kind:.{NAME}}: {_shortened(message)}")
        keys = f"{sorted(reply)!s:.{NAME}}"
        raise self._lost(
            what, f"a reply needs either a result or an error with kind and message as text, got the keys {keys}"
        )

    def _reply(self, what: str, deadline: float) -> dict[str, Any]:
        """The next line that is a message. Others are shown and left out, up to UNEXPECTED_LINES of one process."""
        assert self._connection is not None
        while True:
            try:
                line = self._connection.receive(deadline)
            except TimeoutError:
                half = (
                    f"; {self._connection.partial} bytes of an unfinished line came" if self._connection.partial else ""
                )
                raise self._lost(what, f"no reply within {self._timeout:g} s{half}") from None
            if line is None:
                raise self._lost(what, self._why_ended())
            try:
                message = json.loads(line)
            except (ValueError, RecursionError):
                message = None
            if isinstance(message, dict) and "id" in message:
                return message
            self._unexpected += 1
            text = line[:200].decode(errors="replace")
            if self._unexpected > UNEXPECTED_LINES:
                raise self._lost(
                    what, f"more than {UNEXPECTED_LINES} lines on standard output are no messages, the last: {text!r}"
                )
            print(f"{self._command[0]}: {text}", file=sys.stderr)

    def _why_ended(self) -> str:
        assert self._connection is not None
        partial = self._connection.partial
        if partial > MESSAGE_BYTES:
            return f"a line is longer than {MESSAGE_BYTES:,} bytes"
        return self._connection.ended() + (f" in the middle of a line of {partial} bytes" if partial else "")

    def _lost(self, what: str, reason: str) -> CandidateLost:
        """Ends the process, and says why."""
        assert self._connection is not None
        self._connection.kill()
        errors = self._connection.last_errors()
        self._connection = None
        shown = ["its standard error ended with:", *errors] if errors else []
        return CandidateLost("\n".join([f"the process was lost at {what}: {reason}", *shown]))


def _shortened(text: str) -> str:
    return text if len(text) <= TEXT else f"{text[:TEXT]} ... ({len(text):,} characters)"


def _require_plain(result: Any) -> None:
    """Raises:
    BadMessage: more values than a result may have, or a whole number that no array holds.
    """
    left, count = [result], 0
    while left:
        value = left.pop()
        count += 1
        if isinstance(value, dict | list):
            left.extend(value.values() if isinstance(value, dict) else value)
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise BadMessage("a whole number of more than 64 bits")
        if count + len(left) > VALUES:
            raise BadMessage(f"more than {VALUES:,} values in one result; send arrays as dtype, shape and data")


def _in_one_line(error: BaseException) -> str:
    return " | ".join(str(error).splitlines())


def _problem_of_start(started: Any) -> str:
    if not isinstance(started, dict) or started.keys() != {"protocol", "name", "version", "functions"}:
        return f"expected protocol, name, version and functions, got {started!r:.80}"
    if started["protocol"] != PROTOCOL:
        return f"it speaks protocol {started['protocol']!r}, and the kit {PROTOCOL}"
    for name in ("name", "version"):
        if not isinstance(started[name], str) or len(started[name]) > NAME:
            return f"expected the {name} as text of at most {NAME} characters, got {started[name]!r:.80}"
    functions = started["functions"]
    if not isinstance(functions, list) or not all(isinstance(name, str) for name in functions):
        return f"expected the names of the functions as a list of text, got {functions!r:.80}"
    if len(functions) > FUNCTIONS or any(len(name) > NAME for name in functions):
        return (
            f"expected at most {FUNCTIONS:,} functions with names of at most {NAME} characters, got {len(functions):,}"
        )
    return ""
