"""Checks can fail: each planted mistake is caught, and the reference without a mistake passes everything."""

import pytest

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.execute import run_check, selected_checks
from conformance.mutants import MUTANTS, MutantAdapter

CHECKS = selected_checks("float64")


@pytest.mark.parametrize("name", MUTANTS)
def test_the_mistake_is_caught(name: str) -> None:
    adapter = MutantAdapter(MUTANTS[name])
    killers = (check.name for check in CHECKS if run_check(check, adapter, "float64", "paper", examples=5).status in ("fail", "error"))
    assert next(killers, None), f"no check caught: {MUTANTS[name].explanation}"


@pytest.mark.parametrize("profile", ["paper", "official"])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_the_reference_passes(check, profile: str) -> None:
    result = run_check(check, NumpyAdapter(), "float64", profile)
    assert result.status in ("pass", "not offered"), result.message
