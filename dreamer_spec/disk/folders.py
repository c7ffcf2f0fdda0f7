"""Folders of files that belong together: complete or absent when they are written, and not trusted when they are read.

The last file of each is SHA256SUMS, the checksums of the others, which `sha256sum --check` reads too. A checksum tells
an accident from what was written, not a forger from its owner: whoever changes a file can change its checksum too.
What others have put into such a folder is neither opened nor deleted.
"""

import dataclasses
import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import save_file

from dreamer_spec.disk.files import Arrays, arrays_in, entries, flush, object_in, open_file, reading, text_in
from dreamer_spec.errors import UserError

SUMS = "SHA256SUMS"
_TEMPORARY = re.compile(r".+\.[0-9a-f]{8}\.tmp")


# Reading


@dataclasses.dataclass(frozen=True)
class Sealed:
    """A folder with all of its files open: they can be read even after somebody has replaced or removed the folder."""

    path: Path
    files: Mapping[str, BufferedReader] = dataclasses.field(repr=False, compare=False)

    def json(self, name: str) -> dict[str, Any]:
        """As `files.read_json`."""
        return object_in(self.path / name, self.files[name])

    def arrays(self, name: str) -> Arrays:
        """As `files.read_arrays`."""
        return arrays_in(self.path / name, self.files[name])


def open_sealed(folder: Path, names: Sequence[str]) -> Sealed:
    """Opens the files of a folder. Their checksums are compared by `require_intact`.

    Raises:
      FileNotFoundError: the folder is not there.
      Unreadable.
      ValueError: a file is missing, or there is something else; the message names it.
    """
    with reading(folder):
        os.stat(folder)
    files = {}
    for name in (*names, SUMS):
        try:
            files[name] = open_file(folder / name)
        except FileNotFoundError:
            raise ValueError(f"{name} is missing") from None
    return Sealed(folder, files)


def require_intact(sealed: Sealed, names: Sequence[str]) -> None:
    """Raises:
    Unreadable.
    ValueError: a file is not what was written; the message names it.
    """
    lines = text_in(sealed.path / SUMS, sealed.files[SUMS]).splitlines()
    if [line[66:] for line in lines] != list(names):
        raise ValueError(f"{SUMS} does not list {', '.join(names)}")
    for line, name in zip(lines, names, strict=True):
        if _sha256(sealed.path / name, sealed.files[name]) != line[:64]:
            raise ValueError(f"{name} does not have the checksum in {SUMS}")


def holds_any(path: Path, names: Collection[str]) -> bool:
    """Whether it is a folder with one of these files, or of their checksums, at least.

    Raises:
      Unreadable.
    """
    try:
        with reading(path):
            is_folder = stat.S_ISDIR(os.stat(path).st_mode)
    except FileNotFoundError:  # It was removed meanwhile.
        return False
    return is_folder and any(entry.name in (*names, SUMS) for entry in entries(path))


def _sha256(path: Path, file: BufferedReader) -> str:
    with reading(path):
        file.seek(0)
        return hashlib.file_digest(file, "sha256").hexdigest()


# Writing


def write_folder(path: Path, files: Mapping[str, Mapping[str, Any]], kind: str) -> None:
    """Writes a folder under another name, seals it and renames it. An older one is replaced, and what others have put
    into it moves over; until the new one is there, the older one is beside it as <name>.old.

    Args:
      files: name -> arrays by name for NAME.safetensors, or an object for NAME.json.
      kind: what the folder is, for messages: "checkpoint".

    Raises:
      UserError: the disk refuses it, or something else stands there. Then what stood there does so still.
    """
    if os.path.lexists(path) and (path.is_symlink() or not holds_any(path, files)):
        raise UserError(f"{path} is no {kind}, and one must be written there: move it away")
    temporary, old = None, path.with_name(f"{path.name}.old")
    try:
        temporary = _new_folder(path)
        for name, content in files.items():
            _write(temporary / name, content)
        seal(temporary, tuple(files))
        if path.exists():
            discard(old, files)  # A process was killed before it could remove it.
            path.rename(old)
        temporary.rename(path)
        for other in _foreign(old, files):
            other.rename(path / other.name)
        flush(path.parent)
    except (OSError, SafetensorError) as error:
        if temporary:
            with suppress(OSError):
                _remove(temporary, files)
        raise UserError(f"cannot write the {kind} {path}: {error}") from error
    discard(old, files)


def discard(path: Path, names: Collection[str]) -> None:
    """Removes a folder of these files if the system lets us and nothing else is in it. It is renamed first: nobody
    shall find a half of it."""
    if path.is_symlink() or not path.is_dir() or _foreign(path, names):
        return
    with suppress(OSError):
        if not _TEMPORARY.fullmatch(path.name):
            path = path.rename(_new_folder(path))  # In the place of an empty folder.
        _remove(path, names)


def seal(folder: Path, names: Sequence[str]) -> None:
    """Writes the checksums of a folder's files, and flushes all of it to the disk."""
    lines = []
    for name in names:
        with open_file(folder / name) as file:
            lines.append(f"{_sha256(folder / name, file)}  {name}\n")
    (folder / SUMS).write_text("".join(lines), encoding="ascii", newline="\n")
    for path in (*(folder / name for name in names), folder / SUMS, folder):
        flush(path)


def _write(path: Path, content: Mapping[str, Any]) -> None:
    if path.suffix == ".json":
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    else:
        save_file({name: np.array(array, order="C", copy=None) for name, array in content.items()}, path)


def _new_folder(path: Path) -> Path:
    """A new, empty folder beside `path`, to be renamed to it: <name>.<8 hexadecimal digits>.tmp."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = path.with_name(f"{path.name}.{secrets.token_hex(4)}.tmp")
    folder.mkdir()
    return folder


def _foreign(path: Path, names: Collection[str]) -> list[Path]:
    """What is in a folder beside these files."""
    return [entry for entry in entries(path) if entry.name not in (*names, SUMS)]


def _remove(folder: Path, names: Collection[str]) -> None:
    """Removes these files of a folder, and the folder if nothing else is in it."""
    for name in (*names, SUMS):
        with suppress(FileNotFoundError, IsADirectoryError):
            (folder / name).unlink()
    with suppress(OSError):
        folder.rmdir()
