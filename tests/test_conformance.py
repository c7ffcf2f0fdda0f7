"""The backends conform: every check, in both profiles and every precision.

What CI runs is float64 for both backends, and for PyTorch both profiles and float32; the rest is marked slow.
"""

import functools

import pytest

from conformance.case import Setting
from conformance.check import Check
from conformance.compare import DTYPES
from conformance.execute import run_check, selected_checks
from conformance.our_candidates import load_adapter
from impl_torch import layers


def marks(backend: str, dtype: str, profile: str, check: Check) -> list[pytest.MarkDecorator]:
    # JAX compiles every function for each shape, so that it gets one pass here; PyTorch gets both profiles and float32.
    quick = (dtype == "float64" and profile == "paper") or (
        backend == "torch" and (dtype, profile) != ("float32", "official")
    )
    quick = quick and dtype != "bfloat16"
    return [pytest.mark.xdist_group(f"{backend}-{dtype}"), *([] if quick else [pytest.mark.slow])]


CASES = [
    pytest.param(
        backend,
        dtype,
        profile,
        check,
        id=f"{backend}-{dtype}-{profile}-{check.name}",
        marks=marks(backend, dtype, profile, check),
    )
    for backend in ("jax", "torch")
    for dtype in DTYPES
    for profile in ("paper", "official")
    for check in selected_checks(dtype)
]


@functools.cache
def adapter_of(backend: str, dtype: str) -> object:
    """One for all checks, so that what they share is compiled once."""
    adapter = load_adapter(backend, dtype)
    if compile_calls := getattr(adapter, "compile_calls", None):
        compile_calls(())
    return adapter


@pytest.mark.parametrize(("backend", "dtype", "profile", "check"), CASES)
def test_the_backend_passes(backend: str, dtype: str, profile: str, check: Check) -> None:
    result = run_check(check, adapter_of(backend, dtype), Setting(dtype, profile, examples=5))
    assert result.status in ("pass", "not offered"), result.message


ROUTED = [
    check
    for check in selected_checks("float32")
    if {"linear", "block_linear", "observe", "imagine", "train_step"}.intersection(check.uses)
]


@pytest.mark.parametrize("check", [pytest.param(check, id=check.name) for check in ROUTED])
def test_products_of_many_rows_are_the_same(check: Check, monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch computes products of many rows by another route, which the small problems of the kit would not take."""
    monkeypatch.setattr(layers, "CONVOLUTION_ROWS", 1)
    result = run_check(check, load_adapter("torch", "float32"), Setting("float32", "paper", examples=5))
    assert result.status in ("pass", "not offered"), result.message


@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_the_backend_offers_what_its_checks_use(backend: str) -> None:
    adapter = load_adapter(backend)
    shared = {"Replay", "ReplayRatio", "train_step_with", "run"}
    missing = {name for check in selected_checks("float64") for name in check.uses if not hasattr(adapter, name)}
    without_noise = {name for name in missing if name.endswith("_given") or name.startswith("draw_")}
    assert {name for name in missing - shared - without_noise if not _belongs_to_the_trainer(name)} == set()


def _belongs_to_the_trainer(name: str) -> bool:
    from reference_numpy import replay, training_loop

    return name in vars(replay) or name in vars(training_loop)
