"""What the diagnosis says where no single known mistake fits: variants generated from the equations, two mistakes at
once, mistakes that only extreme input shows, and where its search ends."""

import functools
import importlib
import inspect
import io
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_document import Document
from report_data import FAIL, PASS, make
from rich.console import Console

from conformance import diagnosis
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.check import CHECKS
from conformance.diagnosis import Findings, diagnose
from conformance.editions import judge_twice
from conformance.execute import FAILING, run_check, selected_checks
from conformance.mutants import MUTANTS, Mutant, MutantAdapter, PlantedAdapter
from conformance.mutants.pairs import both, pairs
from conformance.mutants.reach import reach_of, suspects
from conformance.mutants.trial import on_the_reference
from conformance.mutants.variants import CHAPTERS, variants
from conformance.reports import html, junit, summary, terminal
from reference_numpy import returns, world_model
from spec import editions

ROOT = Path(returns.__file__).parents[1]
SETTING = Setting("float64", "paper", examples=5)


def found_in(adapter: object, *only: str) -> Findings:
    checks = dict.fromkeys(check for text in only for check in selected_checks("float64", text))
    results = [run_check(check, adapter, SETTING, shrink=False) for check in checks]
    return diagnose(adapter, results, SETTING)


def functions() -> Iterator[str]:
    """Of the reference, "chapter.function": those that hold equations."""
    for chapter in CHAPTERS:
        module = importlib.import_module(f"reference_numpy.{chapter}")
        own = [value for value in vars(module).values() if inspect.isfunction(value)]
        yield from (f"{chapter}.{value.__name__}" for value in own if value.__module__ == module.__name__)


def continue_of_the_state_that_is_left(
    reward: np.ndarray, continue_: np.ndarray, value: np.ndarray, discount: float, lambda_: float
) -> np.ndarray:
    """As somebody may write it who shifts one index too many."""
    later, results = value[:, -1], []
    for t in range(reward.shape[1] - 2, -1, -1):
        later = reward[:, t + 1] + discount * continue_[:, t] * ((1 - lambda_) * value[:, t + 1] + lambda_ * later)
        results.append(later)
    return np.stack(results[::-1], 1)


def test_an_index_that_nobody_is_known_to_shift_is_named() -> None:
    adapter = types.SimpleNamespace(lambda_return=continue_of_the_state_that_is_left)
    (found,), is_cut = found_in(adapter, "returns.lambda_return_l", "returns.lambda_return_m")
    assert (found.mutant.kind, found.unexplained, found.refuted_by, is_cut) == ("generated", (), "", False)
    assert found.mutant.explanation == (
        "lambda_return (spec/07-returns.md, RET-1) behaves as if `continue_[:, t + 1]` were `continue_[:, t]`"
    )
    file, line = found.mutant.name.partition(": ")[0].split(":")
    assert "continue_[:, t + 1]" in (ROOT / file).read_text(encoding="utf-8").splitlines()[int(line) - 1]
    assert found.mutant.fix == f"Compare with {file}:{line}, which has `continue_[:, t + 1]`."
    made = found.to_json()
    assert (made["kind"], made["provenance"], made["requirements"]) == ("generated", "", ["RET-1"])


@pytest.mark.parametrize(
    ("name", "wrong", "only", "sentence"),
    [
        pytest.param(
            "symlog",
            lambda x: np.log1p(np.abs(x)),
            "transforms.symlog",
            "`np.sign(x) * np.log1p(np.abs(x))` were `np.log1p(np.abs(x))`",
            id="factor",
        ),
        pytest.param(
            "return_scale",
            lambda low, high, limit: float(np.maximum(limit, high)),
            "returns.return_scale",
            "`checked('high', high) - checked('low', low)` were `checked('high', high)`",
            id="summand",
        ),
        pytest.param(
            "rms_norm",
            lambda x, scale, epsilon: x / np.sqrt(np.sum(x**2, axis=-1, keepdims=True) + epsilon) * scale,
            "layers.rms_norm",
            "`np.mean(x ** 2, axis=-1, keepdims=True)` were `np.sum(x ** 2, axis=-1, keepdims=True)`",
            id="mean",
        ),
        pytest.param(
            "percentile",
            lambda values, q: _percentile_without_one_minus(np.sort(np.ravel(values)), q),
            "returns.percentile_l",
            "`(1 - fraction) * flat[below]` were `flat[below]`",
            id="one minus",
        ),
        pytest.param(
            "cumulative_weights",
            lambda continue_, discount: np.cumprod(discount * np.asarray(continue_)[:, :-1], 1) / (discount or 1.0),
            "returns.weights_refuse_discounts",
            "`0 < discount <= 1` were `0 <= discount <= 1`",
            id="comparison",
        ),
    ],
)
def test_one_term_that_is_otherwise_is_named(name: str, wrong: Callable[..., Any], only: str, sentence: str) -> None:
    if name == "cumulative_weights":
        wrong = functools.partial(_refusing, wrong)
    diagnoses = found_in(types.SimpleNamespace(**{name: wrong}), only).diagnoses
    told = [mutant.explanation for found in diagnoses[:1] for mutant in (found.mutant, *found.alternatives)]
    assert any(sentence in text for text in told), told


def _percentile_without_one_minus(values: np.ndarray, q: float) -> float:
    below, fraction = divmod(q / 100 * (len(values) - 1), 1)
    following = values[int(below) + 1] if fraction else 0.0
    return float(values[int(below)] + fraction * following)


def _refusing(function: Callable[..., Any], continue_: np.ndarray, discount: float) -> Any:
    """All but a discount of 0."""
    if not 0 <= discount <= 1:
        raise ValueError("discount")
    return function(continue_, discount)


def test_every_variant_can_be_run_and_says_where_it_is() -> None:
    made = [mutant for target in functions() for mutant in variants(target)]
    assert len(made) > 1000
    for mutant in made:
        assert mutant.replacements.keys() == mutant.edits.keys()
        assert mutant.kind == "generated"
        assert mutant.chapter in mutant.explanation
        assert mutant.violates[0] in mutant.explanation
        file, line = mutant.name.partition(": ")[0].split(":")
        assert (ROOT / file).read_text(encoding="utf-8").splitlines()[int(line) - 1].strip()


def test_stop_gradients_are_left_out_and_moved() -> None:
    names = [mutant.name for mutant in variants("world_model.kl_losses")]
    assert any(name.endswith("posterior for stop_gradient(posterior)") for name in names)
    moved = "categorical_kl(posterior, stop_gradient(prior)) for categorical_kl(stop_gradient(posterior), prior)"
    assert any(name.endswith(moved) for name in names)


SAMPLE = [
    mutant for target in functions() if target.startswith(("returns.", "optimizer.")) for mutant in variants(target)
]


@pytest.mark.parametrize("mutant", SAMPLE[::9], ids=lambda mutant: mutant.name)
def test_a_variant_as_a_candidate_is_explained(mutant: Mutant) -> None:
    """By itself, by one that does the same there, or by a known mistake: the catalogue comes first."""
    (target,) = mutant.edits
    chapter, name = target.split(".")
    adapter = MutantAdapter(mutant)
    results = [run_check(check, adapter, SETTING, shrink=False) for check in selected_checks("float64", f"{chapter}.")]
    diagnoses = diagnose(adapter, results, SETTING).diagnoses
    failing = [one.check.name for one in results if one.status == "fail" and name in one.check.uses]
    if failing:
        assert diagnoses
        assert diagnoses[0].refuted_by == ""
        assert set(failing) <= {check for one in diagnoses for check in one.explained}


PAIRS = [
    ("return_without_discount", "return_starts_from_zero"),
    ("return_aligned_like_v2", "return_with_lambda_swapped"),
    ("return_crosses_episodes", "replayed_return_of_the_step_before"),
    ("epsilon_of_adam", "no_correction_of_the_momentum"),
]


@pytest.mark.parametrize("names", PAIRS, ids="+".join)
def test_two_mistakes_in_one_function_are_both_named(names: tuple[str, str]) -> None:
    made = both(*(MUTANTS[name] for name in names))
    assert made is not None
    first, *_ = found_in(MutantAdapter(made), f"{made.chapter[8:-3]}.".replace("-", "_")).diagnoses
    assert (first.mutant.kind, first.refuted_by, first.unexplained) == ("pair", "", ())
    assert set(first.mutant.name.split(" and ")) == set(names)
    assert all(MUTANTS[name].explanation in first.mutant.explanation for name in names)


def test_two_mistakes_in_two_functions_explain_together_what_both_reach() -> None:
    made = both(MUTANTS["return_without_continue"], MUTANTS["no_unimix"])
    assert made is not None
    checks = ("returns.lambda_return_literals", "distributions.mixture_literals", "losses.actor_matches")
    (found,) = found_in(MutantAdapter(made), *checks).diagnoses
    assert (found.mutant.name, found.explained) == (made.name, checks)


def test_pairs_change_one_function_in_two_places() -> None:
    made = list(pairs(mutant for mutant in MUTANTS.values() if "returns.lambda_return" in mutant.edits))
    assert len(made) > 10
    assert all(pair.replacements for pair in made)
    same_words = ("return_range_not_smoothed", "return_range_decay_swapped")
    assert both(*(MUTANTS[name] for name in same_words)) is None


def divided_at_once(
    gradient: np.ndarray, second_moment: np.ndarray, momentum: np.ndarray, step: int, config: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """LaProp of Optax: no dead zone, and no answer to what 0/0 is."""
    second_moment = config.beta2 * second_moment + (1 - config.beta2) * gradient**2
    root = np.sqrt(second_moment / (1 - config.beta2 ** (step + 1))) + config.laprop_epsilon
    momentum = config.beta1 * momentum + (1 - config.beta1) * gradient / root
    return momentum / (1 - config.beta1 ** (step + 1)), second_moment, momentum


def test_a_mistake_that_extreme_input_alone_shows_is_named_beside_another() -> None:
    adapter = types.SimpleNamespace(laprop=divided_at_once)
    diagnoses = found_in(adapter, "optimizer.laprop").diagnoses
    assert [found.mutant.name for found in diagnoses] == ["zero_over_zero", "no_dead_zone"]
    assert {found.explained for found in diagnoses} == {("optimizer.laprop_tiny_gradients",)}


def test_numbers_that_are_others_in_an_elementary_check_speak_against_a_mistake() -> None:
    """Half the free nats: in most checks the KL is large enough for it to look like none."""

    def half(posterior: Any, prior: Any, config: Any, right: Any = world_model.kl_losses) -> Any:
        return tuple(
            np.maximum(0.5, x) for x in MutantAdapter(MUTANTS["no_free_nats"]).kl_losses(posterior, prior, config)
        )

    planted = PlantedAdapter({"world_model.kl_losses": half})
    diagnoses = found_in(planted, "world_model.kl_literals", "losses.total_matches").diagnoses
    assert diagnoses
    assert all(found.refuted_by == "world_model.kl_literals" for found in diagnoses)


def test_what_nothing_explains_stays_without_a_name() -> None:
    adapter = types.SimpleNamespace(symlog=lambda x: np.sign(x) * np.log2(1 + np.abs(x)))
    assert found_in(adapter, "transforms.symlog").diagnoses == []


def test_a_search_that_reaches_its_limit_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "WORK", 0)
    monkeypatch.setattr(diagnosis, "WORK_OF_A_CHECK", 0)
    adapter = MutantAdapter(MUTANTS["return_without_discount"])
    assert found_in(adapter, "returns.lambda_return_literals") == ([], True)


def test_the_same_is_found_again() -> None:
    adapter = types.SimpleNamespace(lambda_return=continue_of_the_state_that_is_left)
    first, second = (found_in(adapter, "returns.lambda_return") for _ in range(2))
    assert [found.to_json() for found in first.diagnoses] == [found.to_json() for found in second.diagnoses]


def test_a_check_can_reach_what_it_reaches() -> None:
    for check in (
        *selected_checks("float64", "returns."),
        CHECKS["losses.total_matches"],
        CHECKS["rssm.imagine_matches"],
    ):
        assert on_the_reference(check, SETTING)[1] <= reach_of(check)


def test_what_failing_checks_reach_alone_is_suspected_first() -> None:
    failing = [CHECKS["returns.lambda_return_literals"], CHECKS["losses.total_matches"]]
    passing = [CHECKS["distributions.mixture_literals"], CHECKS["returns.weights_literals"]]
    order = suspects(reach_of(CHECKS["losses.total_matches"]), failing, passing)
    assert order[0] == "returns.lambda_return"
    assert order.index("distributions.unimix_log_probs") > order.index("agent.losses")


class Counting:
    """An adapter with a count of its calls."""

    def __init__(self, adapter: object) -> None:
        self.calls, self._adapter = 0, adapter

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._adapter, name)

        def call(*arguments: Any) -> Any:
            self.calls += 1
            return function(*arguments)

        return call


@pytest.mark.parametrize("name", ["symlog", "unimix_log_probs", "rms_norm"])
def test_a_run_that_fails_asks_at_most_twice_as_much(name: str) -> None:
    """Of a function that is wrong everywhere."""
    right = NumpyAdapter()
    wrong = {name: lambda *arguments: 1.5 * getattr(right, name)(*arguments)}
    checks = [
        check
        for check in selected_checks("float64")
        if check.name.startswith(("transforms.", "distributions.", "layers.", "world_model.kl", "behavior."))
    ]

    def calls_of(adapter: object) -> int:
        counting = Counting(adapter)
        results = [judge_twice(check, counting, editions()["paper"], "float64") for check in checks]
        failing = [result for result in results if result.status in FAILING]
        diagnose(counting, results, Setting("float64", "paper"))
        assert bool(failing) == (adapter is not right)
        return counting.calls

    target = next(target for target in functions() if target.endswith(f".{name}"))
    assert calls_of(PlantedAdapter({target: wrong[name]})) <= 2 * calls_of(right)


def shown(data: Any) -> str:
    console = Console(file=io.StringIO(), width=150)
    terminal.show(console, data)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_what_is_generated_is_told_from_what_is_known() -> None:
    data = make()
    found = {"known": "behaves like return_", "pair": "behaves like two mistakes at once: return_"}
    found["generated"] = "no known mistake, but generated from the equation: lambda-return bootstraps"
    for kind, told in found.items():
        made = {**data, "diagnoses": [{**data["diagnoses"][0], "kind": kind}], "diagnosis_is_cut": True}
        assert told in shown(made)
        assert told in junit.render(made)
        assert told.capitalize() in Document(html.render([made])).text
        assert summary.CUT in shown(made)
    nearest = {**data["diagnoses"][0], "kind": "generated", "refuted_by": FAIL}
    text = shown({**data, "diagnoses": [nearest]})
    assert "no known mistake; the nearest variant that is generated from an equation: " in text
    assert f"but it has other numbers in {FAIL}" in text
    text = shown({**data, "diagnoses": [{**nearest, "kind": "known", "refuted_by": PASS}]})
    assert "nearest known mistake: return_" in text
    assert f"but it would fail {PASS}, which passes" in text
