"""The one kind of error that `conformance` answers with a line instead of a traceback."""

import stat
from pathlib import Path


class UserError(Exception):
    """Something that the user can mend. The message names the thing and the remedy; the command prints it in one line,
    exit code 2."""


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
