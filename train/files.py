"""Folders of JSON and safetensors files: complete or absent when written, and not trusted when read.

A checksum tells an accident from what was written, not a forger from its owner: whoever changes a file can change its checksum too. So
nothing is unpickled or run, sizes are compared before anything is allocated, and reading takes memory in proportion to the size of the
file, whatever the file says.
"""

import collections
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

SUMS = "SHA256SUMS"
LONGEST_TEXT = 2**20  # bytes: of a JSON file, of a list of checksums, and of the header of a safetensors file
MOST_AXES = 8
DTYPES = ("F64", "F32", "F16", "I64", "I32", "I16", "I8", "U64", "U32", "U16", "U8", "BOOL")

Arrays = dict[str, np.ndarray]


def seal(folder: Path, names: Sequence[str]) -> None:
    """Writes the checksums of a folder's files, which `sha256sum --check` reads too, and flushes all of it to the disk."""
    sums = "".join(f"{_sha256(folder / name)}  {name}\n" for name in names)
    (folder / SUMS).write_text(sums, encoding="ascii", newline="\n")
    for path in (*(folder / name for name in names), folder / SUMS, folder):
        flush(path)


def require_intact(folder: Path, names: Sequence[str]) -> None:
    """Raises:
    FileNotFoundError: a file is missing.
    ValueError: a file is not what was written; the message names it.
    OSError: a file cannot be read.
    """
    lines = read_text(folder / SUMS).splitlines()
    if [line[66:] for line in lines] != list(names):
        raise ValueError(f"{SUMS} does not list {', '.join(names)}")
    for line, name in zip(lines, names, strict=True):
        if _sha256(folder / name) != line[:64]:
            raise ValueError(f"{name} does not have the checksum in {SUMS}")


def flush(path: Path) -> None:
    """Sees to it that a file's content, or which names a folder holds, is on the disk."""
    if path.is_dir() and os.name == "nt":  # Windows flushes folders by itself and does not open them.
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_text(path: Path) -> str:
    """A short text in UTF-8.

    Raises:
      ValueError: not a file, too long, or not UTF-8.
      OSError: it cannot be read.
    """
    return _read_start(path, LONGEST_TEXT).decode("utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
      ValueError: not JSON or not an object, a name twice in one object, a whole number of more than 64 bits, too deep, too long.
      OSError: it cannot be read.
    """
    return _parse_json(read_text(path), path.name)


def read_arrays(path: Path) -> Arrays:
    """The arrays of a safetensors file by name.

    Raises:
      ValueError: the file is not in the format, or holds arrays that NumPy does not have; the message names the file.
      OSError: it cannot be read.
    """
    _check_header(path)
    try:
        with safe_open(path, framework="np") as file:
            names = file.keys()
            for name in names:
                entry = file.get_slice(name)
                _require_plain(f"{path.name}: {name!r}", entry.get_dtype(), entry.get_shape())
            return {name: file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise ValueError(f"{path.name}: {error}") from error


def _sha256(path: Path) -> str:
    _require_file(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _require_file(path: Path) -> None:
    """A pipe or a device might never end."""
    if path.exists() and not path.is_file():
        raise ValueError(f"{path.name} is not a file")


def _read_start(path: Path, most: int) -> bytes:
    _require_file(path)
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"{path.name} is longer than {most:,} bytes")
    return data


def _check_header(path: Path) -> None:
    """The parser of safetensors allows a header of 100 MB, and takes the last of two arrays of one name."""
    _require_file(path)
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if length > LONGEST_TEXT:
            raise ValueError(f"{path.name}: the header says that it is {length:,} bytes long; expected at most {LONGEST_TEXT:,}")
        _parse_json(file.read(length).decode("utf-8"), f"{path.name}, header")


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


def _require_plain(name: str, dtype: str, shape: Sequence[int]) -> None:
    """safetensors knows dtypes that NumPy lacks, and an array without elements may have sides that no array can have."""
    if dtype not in DTYPES:
        raise ValueError(f"{name} has the dtype {dtype}; expected one of {', '.join(DTYPES)}")
    if len(shape) > MOST_AXES or any(side >= 2**31 for side in shape):
        raise ValueError(f"{name} has the shape {str(list(shape))[:80]}; expected at most {MOST_AXES} axes, each below 2³¹")
