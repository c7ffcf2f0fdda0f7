"""Which mutants of the reference a case notices."""

import contextlib
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.mutants import MUTANTS, MutantAdapter
from conformance.vectors.reading import Case, deviations


def kills(case: Case) -> list[str]:
    """The names of the mutants that deviate from the case, or raise in it. Only those that change what the case calls are run."""
    entered: set[str] = set()
    with _tracing(entered), np.errstate(all="ignore"):
        deviations(case, NumpyAdapter(), "float64")
    return [name for name, mutant in MUTANTS.items() if entered & mutant.replacements.keys() and _deviates(case, MutantAdapter(mutant))]


def _deviates(case: Case, adapter: object) -> bool:
    try:
        with np.errstate(all="ignore"):
            return bool(deviations(case, adapter, "float64"))
    except Exception:
        return True


@contextlib.contextmanager
def _tracing(entered: set[str]) -> Iterator[None]:
    """While this context lasts, the functions of the reference that are called are added, as "row.function"."""

    def note(frame: FrameType, event: str, argument: Any) -> None:
        module = frame.f_globals.get("__name__", "")
        if event == "call" and module.startswith("reference_numpy."):
            entered.add(f"{module.removeprefix('reference_numpy.')}.{frame.f_code.co_name}")

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(before)
