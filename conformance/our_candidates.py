"""What of ours can be checked, and how its adapter is made."""

import importlib

from conformance.compare import DTYPES

IMPLEMENTATIONS = ("numpy", "jax", "torch")
TRAINER = "trainer"
OUR_CANDIDATES = (*IMPLEMENTATIONS, TRAINER)
"""What of ours can be checked: the implementations of the algorithm, and of the trainer what it has of the chapters on
replay and the training loop."""


def load_adapter(candidate: str, dtype: str = "float64", device: str | None = None) -> object:
    """The adapter of one of our candidates, computing in `dtype` on `device` (None: its default).

    Raises:
      ValueError: an unknown candidate, dtype or device, or one that the candidate does not have.
    """
    if candidate not in OUR_CANDIDATES:
        raise ValueError(f"unknown candidate {candidate!r}; known: {', '.join(OUR_CANDIDATES)}")
    if dtype not in DTYPES:
        raise ValueError(f"unknown dtype {dtype!r}; known: {', '.join(DTYPES)}")
    return importlib.import_module(f"conformance.adapters.{candidate}_adapter").make_adapter(dtype, device)
