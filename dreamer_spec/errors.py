"""What the user can mend, which `train` answers with a line instead of a traceback; and what the system refuses."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from conformance.errors import UserError


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
