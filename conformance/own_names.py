"""The top-level names of our packages. No other module can bear one of them beside ours: Python knows one module of a
name. What happens depends on which of the two it finds first; here is what is said of it."""

import contextlib
import importlib.util
from pathlib import Path
from types import ModuleType

OURS = ("spec", "reference_numpy", "impl_jax", "impl_torch", "conformance", "dreamer_spec")
HOME = Path(__file__).parent.parent  # our packages lie side by side


def require_ours() -> None:
    """To be called before any of our packages is used, where somebody else's files may come first: in the folder of a
    script, under PYTHONPATH, or where `python -m` is started.

    Raises:
      ImportError: Python finds something else under one of our names.
    """
    for name in OURS:
        if found := _other_package(name):
            raise ImportError(
                f"{found} hides the package {name} of dreamer-spec, because Python looks there first; rename it, or "
                f"start from another folder"
            )


def _other_package(name: str) -> Path | None:
    """The file or folder that Python finds under that name and that is not ours."""
    found = None
    with contextlib.suppress(ValueError):  # A module that somebody has made in memory.
        found = importlib.util.find_spec(name)
    places = [found.origin, *(found.submodule_search_locations or [])] if found else []
    place = next((Path(place) for place in places if place), None)
    if place is None or place.parent.resolve() == (HOME / name).resolve():  # The folder: files may be links.
        return None
    return place


def ours(module: str) -> str | None:
    """The name of our package that a dotted name, or the name of a Python file, would mean."""
    name = Path(module).stem if module.endswith(".py") else module.partition(".")[0]
    return name if name in OURS else None


def ours_in(error: ImportError | AttributeError) -> str | None:
    """The name of our package that lacks what was asked of it: somebody's code may have meant a module of theirs."""
    if isinstance(error, ImportError):
        return ours(error.name or "")
    return ours(error.obj.__name__) if isinstance(error.obj, ModuleType) else None
