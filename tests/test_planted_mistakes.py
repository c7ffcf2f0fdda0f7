"""Checks can fail: each planted mistake is caught, and the reference without a mistake passes everything."""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance import cli
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Cases, Setting, equal, exact, judged
from conformance.check import Check
from conformance.commands import mutants as command
from conformance.compare import round_to
from conformance.execute import run_check, selected_checks
from conformance.mutants import MUTANTS, Mutant, relevant, sound, trial
from conformance.our_candidates import load_adapter
from conformance.requirements import chapter_of, requirements
from impl_torch import agent as torch_agent
from reference_numpy import layers

CHECKS = selected_checks("float64")
NARROW_CHECKS = {check.name: check for check in selected_checks("bfloat16")}
CHAPTERS = ("transforms", "distributions", "layers", "rssm", "networks", "world_model", "returns", "behavior",
            "optimizer", "agent", "replay", "training_loop")  # fmt: skip

reach = functools.cache(lambda: sound(CHECKS)[0])


@pytest.mark.parametrize("name", MUTANTS)
def test_the_mistake_is_caught(name: str) -> None:
    """By a deviation: a mutant that only crashes would say nothing of the numbers that a check compares."""
    mutant = MUTANTS[name]
    found = trial(mutant, relevant(mutant, reach()))
    assert any(result.status == "fail" for result in found), f"no check caught: {mutant.explanation}"


def test_the_catalogue_is_complete() -> None:
    assert len(MUTANTS) >= 70
    modules = [f"{target.partition('.')[0]}" for mutant in MUTANTS.values() for target in mutant.edits]
    assert set(modules) == set(CHAPTERS)
    for mutant in MUTANTS.values():
        assert mutant.explanation, mutant.name
        assert mutant.provenance, mutant.name
        assert mutant.fix.endswith("."), mutant.name
        assert set(mutant.violates) <= set(requirements()), mutant.name


def test_chapters_of_requirements() -> None:
    assert chapter_of("RET-1") == "spec/07-returns.md"
    assert MUTANTS["return_bootstraps_from_itself"].chapter == "spec/07-returns.md"
    with pytest.raises(ValueError, match="RET-999"):
        chapter_of("RET-999")


def test_a_mistake_that_does_not_fit_the_source_is_an_error() -> None:
    for text, count in (("np.arctan", 0), ("np.", 4)):
        wrong = Mutant("wrong", "none", "none", ("LAY-5",), "none.", {"layers.silu": {text: "1"}})
        with pytest.raises(ValueError, match=f"mutant wrong: layers.silu holds {count} times '{text}'"):
            _ = wrong.replacements


@pytest.mark.parametrize("profile", ["paper", "official"])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_the_reference_passes(check, profile: str) -> None:
    result = run_check(check, NumpyAdapter(), Setting("float64", profile))
    assert result.status in ("pass", "not offered"), result.message


def silu_mutant(name: str, wrong: str) -> Mutant:
    return Mutant(
        name,
        f"silu is {wrong}",
        "plausible",
        ("LAY-5",),
        "Use silu.",
        {"layers.silu": {"x / (1.0 + np.exp(-x))": wrong}},
    )


def test_broken_checks_catch_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Deviations and what raises are counted apart, and a check that the reference does not pass is not counted at
    all."""

    def deviates(setting: Setting) -> Cases:
        yield exact("silu", (np.zeros(1),), np.ones(1))

    def raises(setting: Setting) -> Cases:
        yield judged("silu", (np.zeros(1),), lambda c, result: c.holds("a key", {}["oops"]))

    def right(setting: Setting) -> Cases:
        yield exact("symlog", (np.zeros(1),), np.zeros(1))

    def literal(setting: Setting) -> Cases:
        yield equal("silu", (np.ones(1),), np.array([0.7310586]), bound=1e-6)

    def index(setting: Setting) -> Cases:
        yield judged("silu", (np.ones(1),), lambda c, result: c.holds("a number", result[0] > 0))

    builders = (deviates, raises, right, literal, index)
    checks = [Check(f"chapter.{build.__name__}", (), ("silu",), 0, ("float64",), "", build) for build in builders]
    planted = {
        "harmless": silu_mutant("harmless", "(x / (1.0 + np.exp(-x)))"),
        "scalar": silu_mutant("scalar", "np.float64(0.5)"),
    }
    monkeypatch.setattr(command, "selected_checks", lambda dtype: checks)
    monkeypatch.setattr(command, "MUTANTS", planted)
    assert cli.main(["mutants", "--json", str(tmp_path / "mutants.json")]) == 1
    report = json.loads((tmp_path / "mutants.json").read_text(encoding="utf-8"))["mutants"]
    assert {name: (entry["deviates_in"], entry["raises_in"]) for name, entry in report.items()} == {
        "harmless": ([], []),
        "scalar": (["chapter.literal"], ["chapter.index"]),
    }
    assert report["scalar"]["chapter"] == "spec/03-layers.md"
    out = capsys.readouterr().out
    assert "chapter.deviates is not counted" in out
    assert "chapter.raises is not counted" in out
    assert "2 mutants, 1 survived; 3 checks, 2 more" in out


def test_the_command_names_what_it_does_not_know(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["mutants", "--only", "nothing_of_this_name"]) == 2
    assert "no mutant matches --only 'nothing_of_this_name'" in capsys.readouterr().err


def test_only_relevant_checks_are_run() -> None:
    """Those that call what the mutant changes come first; a check that cannot reach it is left out."""
    names = [check.name for check in relevant(MUTANTS["return_bootstraps_from_itself"], reach())]
    assert names[0].startswith("returns.lambda_return")
    assert "losses.total_matches" in names
    assert "optimizer.laprop_matches" not in names
    queue = MUTANTS["no_online_queue"]
    assert {check.name.partition(".")[0] for check in relevant(queue, reach())} == {"replay"}


def run_narrow(name: str, adapter: object) -> tuple[str, str]:
    result = run_check(NARROW_CHECKS[name], adapter, Setting("bfloat16", "paper", examples=5))
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
        return {
            name: round_to(value, "bfloat16") * (1 if self._is_rounded(name) else 1 + 2.0**-12)
            for name, value in gradients.items()
        }


@pytest.mark.parametrize(
    "name", ["encoder/image/conv1/bias", "decoder/image/out/bias", "rssm/gru/kernel", "actor/hidden0/scale"]
)
def test_gradients_that_are_rounded_are_seen(name: str) -> None:
    check = "notation.what_must_be_float32_is_float32"
    assert (
        run_narrow(check, NarrowGradients(lambda parameter: "conv" in parameter and parameter.endswith("kernel")))[0]
        == "pass"
    )
    status, message = run_narrow(check, NarrowGradients(lambda parameter: parameter == name))
    assert (status, name in message) == ("fail", True), message


def test_swapped_weights_of_the_kl_losses_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both losses have the same value, so that the total is right and only its gradient is wrong, which the reference
    cannot give."""
    right, swapped = torch_agent.loss_scale, {"dynamics": "representation", "representation": "dynamics"}
    monkeypatch.setattr(torch_agent, "loss_scale", lambda name, config: right(swapped.get(name, name), config))
    checks = {check.name: check for check in CHECKS}
    for name, status in (("losses.total_matches", "pass"), ("agent.total_gradient_is_the_weighted_sum", "fail")):
        assert run_check(checks[name], load_adapter("torch"), Setting("float64", "paper")).status == status
