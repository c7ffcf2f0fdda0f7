"""Which mutants of the reference a case notices."""

from collections import Counter

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.mutants import MUTANTS, MutantAdapter
from conformance.mutants.trial import tracing
from conformance.vectors.reading import StoredCase, deviations


def kills(case: StoredCase) -> list[str]:
    """The names of the mutants that deviate from the case, or raise in it. Only those that change what the case calls
    are run."""
    entered: Counter[str] = Counter()
    with tracing(entered), np.errstate(all="ignore"):
        deviations(case, NumpyAdapter(), "float64")
    return [
        name
        for name, mutant in MUTANTS.items()
        if not mutant.replacements.keys().isdisjoint(entered) and _deviates(case, MutantAdapter(mutant))
    ]


def _deviates(case: StoredCase, adapter: object) -> bool:
    try:
        with np.errstate(all="ignore"):
            return bool(deviations(case, adapter, "float64"))
    except Exception:
        return True
