"""The diagnosis names the mistake: of every mutant as if it were a third-party implementation, of backends, and of
nothing where there is nothing."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.compare import Worst
from conformance.diagnosis import VALUES, Diagnosis, diagnose
from conformance.execute import Result, run_check, selected_checks
from conformance.mutants import MUTANTS, MutantAdapter, PlantedAdapter, relevant, sound, trial
from conformance.our_candidates import load_adapter
from impl_torch import agent as torch_agent
from impl_torch import returns as torch_returns
from impl_torch import world_model as torch_world_model

EXAMPLES = 5
FAST = list(MUTANTS)[::14]  # the others are marked slow

reach = functools.cache(lambda: sound(selected_checks("float64"), EXAMPLES)[0])


def diagnosed(name: str) -> list[Diagnosis]:
    """Of a mutant as a third-party implementation."""
    mutant = MUTANTS[name]
    results = list(trial(mutant, relevant(mutant, reach()), EXAMPLES))
    unmoved = [Result(check, "pass", Worst(), 1) for check in reach() if not reach()[check] & mutant.edits.keys()]
    return diagnose(MutantAdapter(mutant), results + unmoved, Setting("float64", "paper", 0, EXAMPLES)).diagnoses


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in FAST else pytest.mark.slow) for name in MUTANTS]
)
def test_the_mutant_is_named(name: str) -> None:
    first, *others = diagnosed(name)
    assert (first.mutant.name, first.alternatives, first.unexplained, others) == (name, (), (), [])
    assert first.explained


def diagnose_in(adapter: object, *only: str, dtype: str = "float64") -> list[Diagnosis]:
    """Of an adapter, from the checks whose name or requirements contain one of these texts."""
    checks = [check for text in only for check in selected_checks(dtype, text)]
    results = [run_check(check, adapter, Setting(dtype, "paper", examples=EXAMPLES), shrink=False) for check in checks]
    return diagnose(adapter, results, Setting(dtype, "paper", examples=EXAMPLES)).diagnoses


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_mistake_in_a_backend_is_named(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    right = torch_returns.lambda_return

    @functools.wraps(right)
    def wrong(reward: torch.Tensor, continue_: torch.Tensor, *others: Any) -> torch.Tensor:
        return right(reward, torch.ones_like(continue_), *others)

    for module in (torch_returns, torch_agent):
        monkeypatch.setattr(module, "lambda_return", wrong)
    (found,) = diagnose_in(
        load_adapter("torch", dtype), "lambda_return_literals", "lambda_return_matches", *VALUES, dtype=dtype
    )
    assert (found.mutant.name, found.alternatives, found.unexplained) == ("return_without_continue", (), ())
    assert {"returns.lambda_return_literals", "losses.actor_matches"} <= set(found.explained)


def test_a_missing_gradient_in_a_backend_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The losses are right, and only their derivatives tell."""
    right = torch_world_model.kl_losses
    monkeypatch.setattr(
        torch_world_model, "kl_losses", functools.wraps(right)(lambda *arguments: right(*arguments)[::-1])
    )
    (found,) = diagnose_in(load_adapter("torch", "float32"), *VALUES, "constants_of_the_kl", dtype="float32")
    assert (found.mutant.name, found.alternatives, found.unexplained) == ("kl_stop_gradients_swapped", (), ())


def test_wrong_numbers_may_be_rounded_as_their_own_size_asks() -> None:
    """Divergences without a mixture reach thousands of nats, next to tens of those that the check expects."""

    class Rounded:
        def kl_losses(self, *arguments: Any) -> Any:
            exact = MutantAdapter(MUTANTS["kl_without_unimix"]).kl_losses(*arguments)
            return tuple(loss.astype(np.float32).astype(np.float64) * (1 + 1e-7) for loss in exact)

    first, *_ = diagnose_in(Rounded(), "world_model.kl_matches", dtype="float32")
    assert "kl_without_unimix" in [mutant.name for mutant in (first.mutant, *first.alternatives)]


def test_two_mistakes_are_both_named() -> None:
    both = PlantedAdapter({**MUTANTS["return_without_continue"].replacements, **MUTANTS["clip_by_unit"].replacements})
    found = diagnose_in(both, "returns.lambda", "optimizer.clip")
    assert {diagnosis.mutant.name for diagnosis in found} == {"return_without_continue", "clip_by_unit"}
    assert not set(found[0].explained) & set(found[1].explained)
    assert set(found[0].unexplained) == set(found[1].explained)


def test_mutants_that_cannot_be_told_apart_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    twin = dataclasses.replace(MUTANTS["slow_critic_decay_swapped"], name="twin")
    monkeypatch.setitem(MUTANTS, "twin", twin)
    (found,) = diagnose_in(MutantAdapter(twin), "behavior.slow_critic")
    assert found.mutant.name == "slow_critic_decay_swapped"
    assert found.alternatives == (twin,)
    assert found.to_json()["alternatives"] == ["twin"]


def test_passing_checks_tell_mutants_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mutant that gives the same wrong numbers, and others in a check that the candidate passes, is not its
    mistake."""
    slow, returns = MUTANTS["slow_critic_decay_swapped"], MUTANTS["return_without_discount"]
    both = dataclasses.replace(slow, name="both", edits={**slow.edits, **returns.edits})
    monkeypatch.setitem(MUTANTS, "both", both)
    (found,) = diagnose_in(MutantAdapter(slow), "behavior.slow_critic")
    assert found.alternatives == (both,)
    (found,) = diagnose_in(MutantAdapter(slow), "behavior.slow_critic", "returns.lambda_return_literals")
    assert (found.mutant, found.alternatives) == (slow, ())


def test_a_mutant_that_a_passing_check_refutes_is_only_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    """The candidate has the slow critic of the mutant, and not its other mistake."""
    slow, returns = MUTANTS["slow_critic_decay_swapped"], MUTANTS["return_without_discount"]
    both = dataclasses.replace(slow, name="both", edits={**slow.edits, **returns.edits})
    monkeypatch.delitem(MUTANTS, slow.name)
    monkeypatch.setitem(MUTANTS, "both", both)
    (found,) = diagnose_in(MutantAdapter(slow), "behavior.slow_critic", "returns.lambda_return_literals")
    assert (found.mutant, found.refuted_by) == (both, "returns.lambda_return_literals")
    (found,) = diagnose_in(MutantAdapter(slow), "behavior.slow_critic")
    assert (found.mutant, found.refuted_by) == (both, "")


class Strange:
    """An implementation whose symlog is wrong in a way of its own."""

    def __init__(self, symlog: Callable[[np.ndarray], Any]) -> None:
        self.symlog = symlog


def crash(x: np.ndarray) -> Any:
    raise ZeroDivisionError


GENERATOR = np.random.default_rng(0)


@pytest.mark.parametrize(
    "symlog",
    [
        pytest.param(lambda x: NumpyAdapter().symlog(x) + GENERATOR.normal(0, 1e-6, np.shape(x)), id="noise"),
        pytest.param(lambda x: np.full(np.shape(x), np.nan), id="nan"),
        pytest.param(lambda x: np.zeros((7, 3)), id="shape"),
        pytest.param(lambda x: {"symlog": [None, "text"]}, id="type"),
        pytest.param(lambda x: object(), id="object"),
        pytest.param(crash, id="crash"),
        pytest.param(lambda x: 2 * NumpyAdapter().symlog(x), id="unknown mistake"),
    ],
)
def test_what_no_mutant_does_is_not_named(symlog: Callable[[np.ndarray], Any]) -> None:
    assert diagnose_in(Strange(symlog), "transforms.") == []


def test_nothing_is_wrong_with_the_reference() -> None:
    assert diagnose_in(NumpyAdapter(), "returns.") == []


def test_the_words_of_a_diagnosis() -> None:
    (found,) = diagnose_in(MutantAdapter(MUTANTS["return_bootstraps_from_itself"]), "returns.lambda_return_literals")
    assert found.to_json() == {
        "kind": "known",
        "mutant": "return_bootstraps_from_itself",
        "explanation": (
            "lambda-return bootstraps from its own value: reward, continue and value "
            "are those of the state that is left"
        ),
        "provenance": "the paper's printed indices (D-03); NaturalDreamer and naivoder's implementation",
        "chapter": "spec/07-returns.md",
        "requirements": ["RET-1", "CON-13"],
        "fix": "Use reward, continue and value of the state that is reached, t + 1.",
        "explained": ["returns.lambda_return_literals"],
        "unexplained": [],
        "alternatives": [],
        "refuted_by": "",
    }
