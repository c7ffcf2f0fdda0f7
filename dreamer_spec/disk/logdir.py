"""Whose a log directory is: what lies under the names that a run writes, and the lock. [LOOP-51], [LOOP-52]"""

import os
import re
import secrets
from contextlib import ExitStack, suppress
from pathlib import Path

import filelock

from dreamer_spec.disk.about import FORMAT, NAME, read_about, write_json
from dreamer_spec.disk.files import entries
from dreamer_spec.errors import UserError

MARK = "has_checkpoint"
MOST_NAMES = 5


def hold(logdir: Path, stack: ExitStack) -> None:
    """Locks a log directory until the stack is closed, or the process ends in another way: two processes would cut each
    other's files.

    Raises:
      UserError: another process holds it, it cannot be written, or `.lock` is somebody else's file.
    """
    path = logdir / ".lock"
    try:
        str(logdir).encode()
    except UnicodeEncodeError as error:  # TensorBoard cannot write there.
        raise UserError(
            f"the name of the log directory {str(logdir)!a} is not UTF-8; choose another with --logdir"
        ) from error
    try:
        logdir.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path) and (path.is_symlink() or not path.is_file() or path.stat().st_size):
            raise UserError(
                f"{path} is not the lock of a run, which is an empty file: move it away, or choose another --logdir"
            )
        log = logdir / "metrics.jsonl"
        if os.path.lexists(log) and (log.is_symlink() or not log.is_file()):
            raise UserError(
                f"{log} is no file of a run, but a link, a directory or a device: move it "
                f"away, or choose another --logdir"
            )
        lock = filelock.FileLock(path, timeout=0)
        try:
            lock.acquire()
        except filelock.Timeout as error:
            raise UserError(
                f"another process is training in {logdir}; let it end, or choose another with --logdir"
            ) from error
        except (NotImplementedError, OSError) as error:
            if isinstance(error, PermissionError) or not os.access(logdir, os.W_OK):
                raise
            return  # Some network file systems have no locks: there it is left to the user.
        stack.callback(lock.release)
    except OSError as error:
        raise UserError(
            f"cannot write to the log directory {logdir}: {error.strerror}; choose another with --logdir"
        ) from error


def wait_until_free(logdir: Path, seconds: float) -> None:
    """Until nobody holds a log directory, or so long; says that it waits. What else is wrong with it, `hold` says."""
    path = logdir / ".lock"
    if path.is_symlink() or not path.is_file():
        return
    lock = filelock.FileLock(path, timeout=0)
    with suppress(filelock.Timeout, NotImplementedError, OSError):
        try:
            lock.acquire()
        except filelock.Timeout:
            print(f"waits for another process, which still holds {logdir}", flush=True)
            lock.acquire(timeout=seconds)
        lock.release()


def require_free(logdir: Path) -> None:
    """To be called where no checkpoint was found: whether a run may begin here.

    What a run left that was ended before its first checkpoint may be replaced: `claim` has marked it.

    Raises:
      UserError: under the names that a run writes lie files that are not marked so, or those of a run that did have a
        checkpoint.
      Unreadable: that cannot be found out.
    """
    found = _found(logdir)
    about = read_about(logdir) or {}
    if not found or (isinstance(about.get("id"), str) and about.get(MARK) is False):
        return
    names = ", ".join(str(path.relative_to(logdir)) for path in found[:MOST_NAMES])
    more = f" and {len(found) - MOST_NAMES} more" if len(found) > MOST_NAMES else ""
    if about.get(MARK) is True:
        raise UserError(
            f"{logdir} holds a run ({names}{more}) whose checkpoints are not there. Move them back into "
            f"{logdir / 'checkpoints'} to "
            "continue it; to begin a new run choose another --logdir, or move these files away"
        )
    raise UserError(
        f"{logdir} holds files that no run of this command has written, or whose run.json is lost: "
        f"{names}{more}. Nothing was changed: "
        "choose another --logdir, or move these files away"
    )


def claim(logdir: Path) -> None:
    """Marks a log directory as that of a run that has no checkpoint yet: to be called before anything else is written.

    Raises:
      UserError: the disk refuses it.
    """
    write_json(logdir / NAME, {"format": FORMAT, "id": secrets.token_hex(8), MARK: False})


def note_first_checkpoint(logdir: Path) -> None:
    """To be called after a checkpoint was saved.

    Raises:
      UserError: the disk refuses it.
    """
    about = read_about(logdir) or {}
    if about.get(MARK) is not True:
        write_json(logdir / NAME, {"format": FORMAT, "id": secrets.token_hex(8), **about, MARK: True})


def _found(logdir: Path) -> list[Path]:
    """What lies under the names of files that a run replaces, cuts or deletes. Other files are no obstacle."""
    files = [logdir / name for name in (NAME, "metrics.jsonl", "curve.png")]
    checkpoints = [
        path
        for path in entries(logdir / "checkpoints")
        if re.fullmatch(r"[0-9]{12}(\.old|\.damaged(-[0-9]+)?)?", path.name)
    ]
    incidents = [path for path in entries(logdir / "nonfinite") if re.fullmatch(r"[0-9]{12}", path.name)]
    pictures = [path for path in entries(logdir / "predictions") if re.fullmatch(r"[0-9]{12}-.+\.(png|gif)", path.name)]
    buffer = [
        path
        for path in entries(logdir / "replay")
        if re.fullmatch(r"(chunk|journal|saved)-[0-9]{10}\.(bin|safetensors)", path.name)
    ]
    return [*(path for path in files if os.path.lexists(path)), *buffer, *checkpoints, *incidents, *pictures]
