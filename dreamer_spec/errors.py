"""The one kind of error that `train` answers with a line instead of a traceback."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class UserError(Exception):
    """Something that the user can mend. The message names the thing and the remedy; `train` prints it in one line and
    exits with code 2.

    details: what helps to understand it and needs its own lines, such as the traceback of an environment; printed
    before the message, and a note of the exception where nobody catches it.
    """

    def __init__(self, message: str, details: str = "") -> None:
        super().__init__(message)
        self.details = details
        if details:
            self.add_note(details)


@contextmanager
def writing(path: Path, remedy: str = "") -> Iterator[None]:
    """What the disk refuses inside becomes a UserError that names the path."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}{remedy}") from error


def is_out_of_memory(error: BaseException) -> bool:
    """Whether NumPy, JAX or PyTorch could not get the memory that it asked for."""
    words = ("resource_exhausted", "out of memory", "not enough memory", "can't allocate memory")
    return isinstance(error, MemoryError) or any(word in str(error).lower() for word in words)
