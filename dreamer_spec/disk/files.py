"""Files: complete or absent when written, and not trusted when read.

Reading knows three outcomes beside success, and never takes one for another:

  FileNotFoundError   it is not there
  Unreadable          it is, or may be, and cannot be read now: nothing follows, and nothing may be changed for it
  ValueError          it was read, and is not what was written: damaged

Nothing is unpickled or run, sizes are compared before anything is allocated, and reading takes memory in proportion to
the size of the file, whatever the file says.

Writing goes to a fresh name in the same folder, which is then renamed: what else lies there is neither opened, followed
nor deleted.
"""

import collections
import errno
import json
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from dreamer_spec.errors import UserError

BINARY = getattr(os, "O_BINARY", 0)  # of os.open: without it Windows replaces line ends
LONGEST_TEXT = 2**20  # bytes: of a JSON file, of a list of checksums, and of the header of a safetensors file
MOST_AXES = 8
DTYPES = ("F64", "F32", "F16", "I64", "I32", "I16", "I8", "U64", "U32", "U16", "U8", "BOOL")

Arrays = dict[str, np.ndarray]


class Unreadable(UserError):
    """Something that cannot be read now, whatever it holds."""


# Reading


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """What the system refuses inside becomes `Unreadable`, but for a file that is not there."""
    try:
        yield
    except FileNotFoundError as error:
        if path.is_symlink():  # To a disk that is not mounted, say.
            raise _unreadable(path, f"it is a link to {os.readlink(path)}, which is not there") from error
        raise
    except OSError as error:
        raise _unreadable(path, error.strerror or str(error)) from error


def _unreadable(path: Path, why: str) -> Unreadable:
    return Unreadable(
        f"cannot read {path}: {why}. Nothing was changed: mount its disk or mend its "
        f"permissions, and give the same command"
    )


def open_file(path: Path) -> BufferedReader:
    """A file, opened for reading. A pipe or a device, which might never end, is none.

    Raises:
      FileNotFoundError, Unreadable.
      ValueError: there is something else than a file.
    """
    with reading(path):
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | BINARY)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(f"{path.name} is not a file")
    return os.fdopen(descriptor, "rb")


def entries(directory: Path) -> list[Path]:
    """What is in a directory, by name; nothing if it is not there.

    Raises:
      Unreadable.
    """
    try:
        with reading(directory):
            return sorted(directory / name for name in os.listdir(directory))
    except FileNotFoundError:
        return []


def read_text(path: Path) -> str:
    """A short text in UTF-8.

    Raises:
      FileNotFoundError, Unreadable.
      ValueError: not a file, too long, or not UTF-8.
    """
    with open_file(path) as file:
        return text_in(path, file)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
      FileNotFoundError, Unreadable.
      ValueError: not JSON or not an object, a name twice in one object, a whole number of more than 64 bits, too deep,
        too long.
    """
    with open_file(path) as file:
        return object_in(path, file)


def read_arrays(path: Path) -> Arrays:
    """The arrays of a safetensors file by name.

    Raises:
      FileNotFoundError, Unreadable.
      ValueError: the file is not in the format, or holds arrays that NumPy does not have; the message names the file.
    """
    with open_file(path) as file:
        return arrays_in(path, file)


def text_in(path: Path, file: BufferedReader) -> str:
    """What `read_text` returns, of a file that is open."""
    with reading(path):
        file.seek(0)
        data = file.read(LONGEST_TEXT + 1)
    if len(data) > LONGEST_TEXT:
        raise ValueError(f"{path.name} is longer than {LONGEST_TEXT:,} bytes")
    return data.decode("utf-8")


def object_in(path: Path, file: BufferedReader) -> dict[str, Any]:
    """What `read_json` returns, of a file that is open."""
    return _parse_json(text_in(path, file), path.name)


def arrays_in(path: Path, file: BufferedReader) -> Arrays:
    """What `read_arrays` returns, of a file that is open.

    The parser of safetensors allows a header of 100 MB, and takes the last of two arrays of one name: the header is
    read here first.
    """
    with reading(path):
        file.seek(0)
        length = int.from_bytes(file.read(8), "little")
        if length > LONGEST_TEXT:
            raise ValueError(
                f"{path.name}: the header says that it is {length:,} bytes long; expected at most {LONGEST_TEXT:,}"
            )
        header = _parse_json(file.read(length).decode("utf-8"), f"{path.name}, header")
        file.seek(0)
        data = file.read()
    for name, entry in header.items():
        if name != "__metadata__":
            _require_plain(f"{path.name}: {name!r:.80}", entry)
    try:
        return dict(sorted(safetensors.numpy.load(data).items()))
    except (SafetensorError, TypeError, KeyError) as error:
        raise ValueError(f"{path.name}: {error}") from error


def _parse_json(text: str, name: str) -> dict[str, Any]:
    try:
        value = json.loads(text, object_pairs_hook=_no_name_twice, parse_int=_int64)
        json.dumps(value, ensure_ascii=False).encode("utf-8")  # Half a surrogate pair could not be printed.
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name}: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{name} holds a {type(value).__name__}; expected an object")
    return value


def _no_name_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) < len(pairs):
        name, _ = collections.Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"the name {name!r} occurs more than once in one object")
    return value


def _int64(text: str) -> int:
    value = int(text)
    if not -(2**63) <= value < 2**63:
        raise ValueError(f"{text:.40} is not a number of 64 bits")
    return value


def _require_plain(name: str, entry: Any) -> None:
    """safetensors knows dtypes that NumPy lacks, and an array without elements may have sides that no array can
    have."""
    match entry:
        case {"dtype": str(dtype), "shape": [*shape]} if all(type(side) is int for side in shape):
            if dtype not in DTYPES:
                raise ValueError(f"{name} has the dtype {dtype:.20}; expected one of {', '.join(DTYPES)}")
            if len(shape) > MOST_AXES or (0 in shape and any(side >= 2**31 for side in shape)):
                raise ValueError(
                    f"{name} has the shape {str(shape)[:80]}; expected at most {MOST_AXES} axes, each below 2³¹"
                )
        case _:
            raise ValueError(f"{name} is described as {entry!r:.80}; expected dtype, shape and data_offsets")


# Writing


def require_place(path: Path) -> None:
    """Whether a file may stand there, asked before hours of work are done for it.

    Raises:
      OSError: the path is a folder, or lies in none.
    """
    if not path.name or path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, f"there is no folder {path.parent}", str(path))


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file beside `path`, which takes its place when all of it is on the disk. A link at `path` is replaced, not
    followed.

    Raises:
      OSError: the disk refuses it; then what stood there is as it was.
    """
    require_place(path)
    name = path.with_name(f".{path.name}-{secrets.token_hex(4)}.tmp")
    descriptor = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | BINARY, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise


def free_name(path: Path) -> Path:
    """`path`, or what follows of path-2, path-3, ... that is not there yet."""
    number, free = 1, path
    while os.path.lexists(free):
        number += 1
        free = path.with_name(f"{path.name}-{number}")
    return free


def flush(path: Path) -> None:
    """Sees to it that a file's content, or which names a folder holds, is on the disk."""
    if path.is_dir() and os.name == "nt":  # Windows flushes folders by itself and does not open them.
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
