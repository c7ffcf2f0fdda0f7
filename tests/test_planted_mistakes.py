"""Checks can fail: each planted mistake is caught, and the reference without a mistake passes everything."""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance import cli, mutants
from conformance.adapter import load_adapter
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.check import Check, Run, round_to
from conformance.commands import mutants as command
from conformance.execute import run_check, selected_checks
from conformance.mutants import MUTANTS, MutantAdapter
from reference_numpy import layers

CHECKS = selected_checks("float64")
NARROW_CHECKS = {check.name: check for check in selected_checks("bfloat16")}


@functools.cache
def passes_without_a_mistake(check: Check) -> bool:
    """A check that fails anyway would catch everything."""
    return run_check(check, NumpyAdapter(), "float64", "paper", examples=5).status == "pass"


@pytest.mark.parametrize("name", MUTANTS)
def test_the_mistake_is_caught(name: str) -> None:
    adapter = MutantAdapter(MUTANTS[name])
    caught = (check for check in CHECKS if run_check(check, adapter, "float64", "paper", examples=5).status in ("fail", "error"))
    assert any(passes_without_a_mistake(check) for check in caught), f"no check caught: {MUTANTS[name].explanation}"


@pytest.mark.parametrize("profile", ["paper", "official"])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_the_reference_passes(check, profile: str) -> None:
    result = run_check(check, NumpyAdapter(), "float64", profile)
    assert result.status in ("pass", "not offered"), result.message


def test_broken_checks_catch_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Deviations and what raises are counted apart, and a check that the reference does not pass is not counted at all."""

    def deviates(run: Run) -> None:
        run.exact("silu", run.call("silu", np.zeros(1)), np.ones(1))

    def raises(run: Run) -> None:
        raise KeyError("oops")

    def right(run: Run) -> None:
        run.exact("symlog", run.call("symlog", np.zeros(1)), np.zeros(1))

    def literal(run: Run) -> None:
        run.expect("silu", (np.ones(1),), np.array([0.7310586]), bound=1e-6)

    def index(run: Run) -> None:
        run.holds("a number", run.call("silu", np.ones(1))[0] > 0)

    bodies = (deviates, raises, right, literal, index)
    checks = [Check(f"row.{body.__name__}", (), ("silu",), 0, body, ("float64",)) for body in bodies]
    planted = {
        "harmless": mutants.Mutant("harmless", "none", {"layers.silu": layers.silu}),
        "scalar": mutants.Mutant("scalar", "silu forgets the axes", {"layers.silu": lambda x: np.float64(0.5)}),
    }
    monkeypatch.setattr(command, "selected_checks", lambda dtype: checks)
    monkeypatch.setattr(command, "MUTANTS", planted)
    assert cli.main(["mutants", "--json", str(tmp_path / "mutants.json")]) == 1
    report = json.loads((tmp_path / "mutants.json").read_text(encoding="utf-8"))
    assert {name: entry["caught_by"] for name, entry in report["mutants"].items()} == {
        "harmless": [],
        "scalar": ["row.literal", "row.index"],
    }
    assert mutants.caught_by(planted["scalar"], checks[2:]) == {"fail": ["row.literal"], "error": ["row.index"]}
    out = capsys.readouterr().out
    assert "row.deviates is not counted" in out
    assert "row.raises is not counted" in out
    assert "2 mutants, 1 survived; 3 checks, 2 more" in out


def run_narrow(name: str, adapter: object) -> tuple[str, str]:
    result = run_check(NARROW_CHECKS[name], adapter, "bfloat16", "paper", examples=5)
    return result.status, result.message


@pytest.mark.parametrize(("rounded", "status"), [(True, "pass"), (False, "fail")])
def test_scales_that_are_not_rounded_are_seen(rounded: bool, status: str) -> None:
    """In bfloat16 an RMSNorm MUST round its scale before it multiplies: [LAY-1]."""

    class Adapter(NumpyAdapter):
        def rms_norm(self, x: np.ndarray, scale: np.ndarray, epsilon: float) -> np.ndarray:
            return round_to(layers.rms_norm(x, round_to(scale, "bfloat16") if rounded else scale, epsilon), "bfloat16")

    assert run_narrow("layers.rms_norm_matches", Adapter())[0] == status


class NarrowGradients:
    """The PyTorch backend in bfloat16, with some gradients rounded to bfloat16 and the others not."""

    def __init__(self, is_rounded: Callable[[str], bool]) -> None:
        self._right = load_adapter("torch", "bfloat16")
        self._is_rounded = is_rounded

    def __getattr__(self, name: str) -> Any:
        return getattr(self._right, name)

    def gradients(self, *arguments: Any) -> dict[str, np.ndarray]:
        gradients = self._right.gradients(*arguments)  # type: ignore[attr-defined]
        # The others get digits: this tests the check, and not the backend.
        return {name: round_to(value, "bfloat16") * (1 if self._is_rounded(name) else 1 + 2.0**-12) for name, value in gradients.items()}


@pytest.mark.parametrize("name", ["encoder/image/conv1/bias", "decoder/image/out/bias", "rssm/gru/kernel", "actor/hidden0/scale"])
def test_gradients_that_are_rounded_are_seen(name: str) -> None:
    check = "notation.what_must_be_float32_is_float32"
    assert run_narrow(check, NarrowGradients(lambda parameter: "conv" in parameter and parameter.endswith("kernel")))[0] == "pass"
    status, message = run_narrow(check, NarrowGradients(lambda parameter: parameter == name))
    assert (status, name in message) == ("fail", True), message
