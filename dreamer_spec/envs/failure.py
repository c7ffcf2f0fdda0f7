"""Whatever an environment's code raises, as a value: making it, its reset, its steps, and what NumPy asks of the things
it returns."""

import dataclasses
import signal
import traceback
from collections.abc import Callable
from typing import Literal, TypeVar

from dreamer_spec.envs.adapter import InvalidData
from dreamer_spec.envs.factory import Refusal
from dreamer_spec.errors import UserError
from dreamer_spec.system.signals import Stopped
from dreamer_spec.words import counted

Result = TypeVar("Result")

ATTEMPTS = (
    3  # that an environment gets for its first record: what fails now and then shall not end a run before it begins
)
LONGEST = 1_000, 20_000  # characters of an exception's text, and of a traceback


@dataclasses.dataclass(frozen=True)
class Failure:
    """An environment did not give its next record.

    worker: its index, 0 of a vector. kind: its process ended ("crash"), it raised ("error"), did not answer in time
    ("timeout"), or returned what its spaces do not allow ("invalid data"). together: how many environments a vector
    has. message: names task, environment and step. details: the
    traceback of an error, else empty.
    certain: whether another attempt would end alike, as with a task that does not exist.
    """

    worker: int
    kind: Literal["crash", "error", "timeout", "invalid data"]
    message: str
    details: str = ""
    certain: bool = False
    together: int | None = None

    @property
    def who(self) -> str:
        return (
            f"the vector of {counted(self.together, 'environment')}" if self.together else f"environment {self.worker}"
        )

    def is_final(self, attempts: int) -> bool:
        """Whether so many attempts to get a first record were enough."""
        return self.certain or self.kind == "timeout" or attempts >= ATTEMPTS

    def error(self, attempts: int) -> UserError:
        """What ends a run for which no environment could be had."""
        return UserError(self.message + (f" ({attempts} attempts)" if attempts > 1 else ""), self.details)


def attempt(work: Callable[[], Result], worker: int, place: Callable[[], str]) -> Result | Failure:
    """What the work gives, or why it gives nothing. place: where in the task it has come to, for messages.

    Not only an `Exception` is a failure: `sys.exit` in a game's code must not end the run. A Ctrl-C of the user's is
    none.
    """
    try:
        return work()
    except UserError as error:
        kind: Literal["invalid data", "error"] = "invalid data" if isinstance(error, InvalidData) else "error"
        return Failure(worker, kind, str(error), error.details, certain=not isinstance(error, InvalidData | Refusal))
    except BaseException as error:
        if isinstance(error, Stopped) or _is_the_users(error):
            raise
        return Failure(worker, "error", f"{place()}: the environment raised {describe(error)}", _traceback(error))


def describe(error: BaseException) -> str:
    """ZeroDivisionError: division by zero. Even of an error that cannot be described."""
    try:
        text = str(error)
    except Exception as second:
        text = f"(no text: its __str__ raised {type(second).__name__})"
    return f"{type(error).__name__}: {text[: LONGEST[0]]}" if text else type(error).__name__


def _traceback(error: BaseException) -> str:
    try:
        return "".join(traceback.format_exception(error))[-LONGEST[1] :]
    except Exception as second:
        return f"(no traceback: formatting it raised {type(second).__name__})\n"


def _is_the_users(error: BaseException) -> bool:
    """A KeyboardInterrupt is an environment's own where Ctrl-C does not raise one: in worker processes, and inside
    `dreamer_spec.system.signals`."""
    return isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is signal.default_int_handler
