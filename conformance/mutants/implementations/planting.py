"""A copy of our packages in a temporary folder, with one mistake or none. Nothing of it is imported here: a process of
its own runs in the copy, where Python finds it before anything that is installed."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from conformance.errors import UserError
from conformance.mutants.implementations import Patch
from conformance.own_names import HOME, OURS

COPIED = (*OURS, "tests", "pyproject.toml")


@contextlib.contextmanager
def planted(patch: Patch | None) -> Iterator[Path]:
    """The root of the copy, while this context lasts.

    Raises:
      UserError: our packages are installed without the tests.
      ValueError: the source has no such text, or more than once.
    """
    if not (HOME / "tests").is_dir():
        raise UserError(f"{HOME} holds no tests: mutants of the implementations need a checkout of the repository")
    with tempfile.TemporaryDirectory(prefix="mutant-", ignore_cleanup_errors=True) as folder:
        root = Path(folder).resolve()
        for name in COPIED:
            source = HOME / name
            if source.is_dir():
                shutil.copytree(source, root / name)  # compiled files too, which say what they were compiled from
            else:
                shutil.copy2(source, root / name)
        if patch is not None:
            _write(root / patch.file, patch)
        yield root


def _write(file: Path, patch: Patch) -> None:
    file.write_text(patch.apply(file.read_text(encoding="utf-8")), encoding="utf-8")
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        compiled.unlink()


def environment(root: Path, compiled: Path) -> dict[str, str]:
    """Of a process in the copy: what is computed is small, and several threads would cost more than they win.

    compiled: where JAX keeps programs for the next mutant: most are those of the last.
    """
    return {
        **os.environ,
        **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
        "PYTHONPATH": str(root),
        "JAX_COMPILATION_CACHE_DIR": str(compiled),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
