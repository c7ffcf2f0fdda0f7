"""From what a command line names to an adapter."""

import contextlib
import difflib
import importlib
import inspect
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from conformance.errors import UserError
from conformance.foreign import ForeignAdapter, as_edition
from conformance.interface import INTERFACE, OBJECTS
from conformance.our_candidates import OUR_CANDIDATES, TRAINER, load_adapter
from conformance.own_names import ours, ours_in
from conformance.process import ProcessAdapter
from conformance.serve import convert_arrays, function_of, load_file, missing_field, to_numpy

WAY_OUT = (
    "rename yours, or run the adapter in a process where ours is not: "
    'conformance check --process "python serve.py ADAPTER.py" (docs/adapters.md, Process)'
)


class ModuleAdapter(ForeignAdapter):
    """The functions of a module. Arrays go in through its `convert`, if it has one, and come out as NumPy."""

    def __init__(self, module: ModuleType, dtype: str) -> None:
        self._module = module
        self.name, self.version = module.__name__, str(getattr(module, "__version__", ""))
        getattr(module, "setup", lambda dtype: None)(dtype)

    def offers(self, name: str) -> bool:
        names = (name, "convert") if name == "vjp" else (name,)
        return any(callable(getattr(self._module, found, None)) for found in names)

    def call(self, name: str, arguments: tuple[Any, ...]) -> Any:
        function = function_of(self._module, name)
        _require_arguments(name, function)
        convert = getattr(self._module, "convert", None)
        try:
            result = function(*(convert_arrays(argument, convert) for argument in arguments))
        except SystemExit as error:  # not an Exception: it would end the kit, perhaps with exit code 0
            raise RuntimeError(f"{name} called sys.exit({error.code!r})") from error
        except AttributeError as error:
            if hint := missing_field(error):
                error.add_note(hint)
            raise
        try:
            return result if name in OBJECTS else to_numpy(result)
        except TypeError as error:
            raise TypeError(f"{name}: {error}") from error

    def edition(self) -> str | None:
        return as_edition(getattr(self._module, "edition", lambda: None)())

    @property
    def names(self) -> list[str]:
        """The public functions that the module itself defines."""
        own = [
            name
            for name, value in vars(self._module).items()
            if getattr(value, "__module__", None) == self._module.__name__
        ]
        return [name for name in own if not name.startswith("_")]


def _require_arguments(name: str, function: Any) -> None:
    """Raises TypeError, naming the arguments, unless the function takes those of the interface by position."""
    expected = INTERFACE[name]
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # a built-in function does not tell
    try:
        signature.bind(*expected)
    except TypeError as error:
        raise TypeError(
            f"{name} is called with ({', '.join(expected)}), in this order; yours takes {signature}"
        ) from error


def load_candidate(name: str, dtype: str, device: str | None = None) -> object:
    """The adapter of one of our candidates, or a module or file of somebody's own. device: of our candidates.

    Raises:
      UserError: there is no such thing, or what it needs is not there. A mistake inside of somebody's module keeps its
        traceback.
    """
    if name in OUR_CANDIDATES:
        try:
            return load_adapter(name, dtype, device)
        except ImportError as error:
            if name == "numpy":
                raise  # The reference needs no extra: its packages are always installed.
            extra = "train" if name == TRAINER else name
            raise UserError(f"{error}; install it with: pip install 'dreamer-spec[{extra}]'") from error
        except (ValueError, RuntimeError) as error:
            raise UserError(str(error).partition("\n")[0]) from error
    if taken := ours(name):
        raise UserError(f"{name} cannot be an adapter: {taken} is the name of a package of dreamer-spec; {WAY_OUT}")
    try:
        return ModuleAdapter(_load_module(name), dtype)
    except SystemExit as error:
        raise UserError(
            f'{name} calls sys.exit({error.code!r}) when it is loaded; guard it with: if __name__ == "__main__"'
        ) from error
    except (ImportError, AttributeError) as error:
        if taken := ours_in(error):
            raise UserError(
                f"{name}: {error}: {taken} is a package of dreamer-spec, which hides any other module of that name; "
                f"{WAY_OUT}"
            ) from error
        raise


def _load_module(name: str) -> ModuleType:
    if name.endswith(".py"):
        if not Path(name).is_file():
            raise UserError(f"no file {name}; `conformance new-adapter {name}` writes one to fill in")
        return load_file(Path(name))
    unknown = UserError(
        f"no module named {name!r}; give one of {', '.join(OUR_CANDIDATES)}, a module on PYTHONPATH, or a .py file"
    )
    if not all(part.isidentifier() for part in name.split(".")):
        raise unknown
    sys.path.insert(0, "")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise
        raise unknown from error


@contextlib.contextmanager
def candidate(
    name: str | None, command: str | None, dtype: str, device: str | None, timeout: float
) -> Iterator[object]:
    """An adapter while it is needed: of `load_candidate`, or of the process that a command starts.

    Raises:
      UserError: neither or both are given, or there is no such candidate.
    """
    if (name is None) == (command is None):
        raise UserError(
            "give either a candidate (jax, torch, numpy, trainer, a module or a .py file) or --process COMMAND"
        )
    if command is None:
        assert name is not None
        yield load_candidate(name, dtype, device)
        return
    adapter = ProcessAdapter(command, dtype, timeout)
    try:
        yield adapter
    finally:
        adapter.close()


def remarks(adapter: object) -> list[str]:
    """What somebody else's adapter says of itself, and names that are nearly those of the interface."""
    if not isinstance(adapter, ModuleAdapter | ProcessAdapter):
        return []
    edition = adapter.edition()
    about = f"{adapter.name} {adapter.version}".strip() + (f" claims the edition {edition}" if edition else "")
    return [
        about,
        *(
            f"{name} is not a function of the interface; is {close} meant?"
            for name, close in _near_misses(adapter.names)
        ),
    ]


def _near_misses(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    names = set(names)
    for name in sorted(names - set(INTERFACE)):
        for close in difflib.get_close_matches(name, set(INTERFACE) - names, n=1, cutoff=0.85):
            yield name, close
