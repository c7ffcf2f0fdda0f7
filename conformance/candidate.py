"""From what a command line names to an adapter."""

import importlib
import importlib.util
import sys
from pathlib import Path

from conformance.adapter import COLUMNS, load_adapter
from conformance.errors import UserError


def load_candidate(name: str, dtype: str, device: str | None = None) -> object:
    """The adapter of one of our columns, or a module or file of somebody's own. dtype, device: of our columns.

    Raises:
      UserError: there is no such thing, or what it needs is not there. A mistake inside of somebody's module keeps its traceback.
    """
    if name in COLUMNS:
        try:
            return load_adapter(name, dtype, device)
        except ImportError as error:
            raise UserError(f"{error}; install it with: pip install 'dreamer-spec[{name}]'") from error
        except (ValueError, RuntimeError) as error:
            raise UserError(str(error).partition("\n")[0]) from error
    if name.endswith(".py"):
        return _load_file(Path(name))
    sys.path.insert(0, "")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise
        raise UserError(f"no module named {name!r}; give one of {', '.join(COLUMNS)}, a module on PYTHONPATH, or a .py file") from error


def _load_file(path: Path) -> object:
    if not path.exists():
        raise UserError(f"no file {path}")
    sys.path.insert(0, str(path.resolve().parent))
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module
