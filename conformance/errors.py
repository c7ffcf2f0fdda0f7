"""The one kind of error that a command answers with a line instead of a traceback."""

import stat
import sys
from pathlib import Path


class UserError(Exception):
    """Something that the user can mend. The message names the thing and the remedy; the command prints it in one line
    and exits with code 2.

    details: what helps to understand it and needs its own lines, such as the traceback of an environment; printed
    before the message, and a note of the exception where nobody catches it.
    """

    def __init__(self, message: str, details: str = "") -> None:
        super().__init__(message)
        self.details = details
        if details:
            self.add_note(details)


def say_error(command: str, error: UserError, where: str = "") -> None:
    """The line on stderr. where: what the message begins with."""
    if error.details:
        print(error.details.rstrip(), file=sys.stderr)
    print(f"{command}: error: {where}{' '.join(str(error).split())}", file=sys.stderr)


def read_text(path: Path) -> str:
    """A text that the user has named.

    Raises:
      UserError: it cannot be read, or is no file: nobody waits for a pipe.
      ValueError: it is no UTF-8.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise UserError(f"cannot read {path}: it is no file")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
