"""Editions: the data, how a candidate is judged in one, and which one fits."""

import json
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Cases, Setting, exact, refused, related
from conformance.check import Check
from conformance.cli import main
from conformance.compare import Comparisons
from conformance.editions import (
    NOT_JUDGED,
    PREFERRED,
    Fit,
    alike,
    best,
    fit,
    fits_better,
    judge,
    judge_twice,
    may_fit_better,
    own_reference,
    telling_checks,
)
from conformance.execute import run_check, selected_checks
from conformance.mutants import MUTANTS, MutantAdapter
from conformance.requirements import chapter_of, requirements
from conformance.results import FAILING
from docs.render import ROOT, chapters_with_editions
from reference_numpy import returns
from spec import Config, built_profiles, editions, find_edition, hyperparameters, load_config, profiles

CHECKS = {check.name: check for check in selected_checks("float64")}
CHEAP = (
    "layers.rms_norm_matches",
    "training_loop.training_starts_with_enough_items",
    "optimizer.laprop_matches",
    "world_model.reconstruction_matches",
)
TELLING = [
    check
    for check in telling_checks(CHECKS.values())
    if check.name.partition(".")[0] in ("transforms", "distributions", "behavior") or check.name in CHEAP
]
EXAMPLES = 2


def reference(edition: str) -> object:
    """An adapter that is right in an edition."""
    mutant = own_reference(edition)
    return NumpyAdapter() if mutant is None else MutantAdapter(mutant)


def statuses(adapter: object, edition: str, checks: list[Check] = TELLING) -> dict[str, str]:
    return {
        check.name: judge(check, adapter, editions()[edition], "float64", 0, EXAMPLES, shrink=False).status
        for check in checks
    }


class Stubborn:
    """The reference with the values of one profile, whatever configuration it is given."""

    def __init__(self, profile: str) -> None:
        self._values, self._reference = profiles()[profile], NumpyAdapter()
        self._others = {name: hyperparameters()[name]["value"] for values in profiles().values() for name in values}

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._reference, name)

        def call(*arguments: Any) -> Any:
            return function(
                *(self._mine(argument) if isinstance(argument, Config) else argument for argument in arguments)
            )

        return call

    def _mine(self, config: Config) -> Config:
        own = {**self._others, **self._values}
        settings = ("beta2", "continue_target", "vector_loss_scale", "actor_unimix", "start_continue")
        return type(config)(**{**vars(config), **{name: own[name] for name in settings}})


# --- The data
# ------------------------------------------------------------------------------


def test_the_data_are_sound() -> None:
    assert set(editions()) == set(PREFERRED)
    assert {edition.profile for edition in editions().values()} == set(profiles())
    for edition in editions().values():
        load_config(edition.profile)
        for requirement, difference in edition.differs.items():
            assert requirement in requirements()
            assert difference.instead.endswith(".")
            assert not (difference.like and difference.settings)
            assert difference.like is None or difference.like in MUTANTS
            assert set(difference.settings) <= set(profiles()[edition.profile])
        for target in edition.beyond:
            chapter, name = target.split(".")
            assert hasattr(__import__(f"reference_numpy.{chapter}", fromlist=[chapter]), name)


def test_every_value_of_a_profile_belongs_to_a_requirement() -> None:
    for edition in editions().values():
        told = [name for difference in edition.differs.values() for name in difference.settings]
        assert sorted(told) == sorted(profiles()[edition.profile])
        for name, value in profiles()[edition.profile].items():
            assert value != hyperparameters()[name]["value"], (
                f"{edition.name} sets {name} to the value that it has anyway"
            )


def test_names() -> None:
    assert find_edition("official").name == find_edition("2024-12").name == "2024-12"
    with pytest.raises(ValueError, match="unknown edition 'v3'; known: 2023, 2024-04, 2024-12, paper"):
        find_edition("v3")
    assert built_profiles() == ["paper", "2024-04", "official"]


@pytest.mark.parametrize("name", [name for name in PREFERRED if editions()[name].mutants])
def test_the_mutants_of_an_edition_go_together_and_are_seen(name: str) -> None:
    """Each requirement that a mutant stands for has a check that names it and does not hold in the edition."""
    mutant = own_reference(name)
    assert mutant is not None
    assert set(mutant.replacements) == {target for like in editions()[name].mutants for target in MUTANTS[like].edits}
    for requirement in mutant.violates:
        checks = [
            check
            for check in CHECKS.values()
            if requirement in check.requirements and "loss_derivatives" not in check.uses
        ]
        found = (
            run_check(
                check, MutantAdapter(mutant), Setting("float64", editions()[name].profile, examples=5), shrink=False
            )
            for check in checks
        )
        assert any(result.status in ("fail", "error") for result in found), requirement


def test_every_chapter_that_editions_leave_says_so() -> None:
    """What stands in the tables is compared in test_repository.py."""
    for chapter in chapters_with_editions():
        text = (ROOT / chapter).read_text(encoding="utf-8")
        assert f"<!-- table: editions of {Path(chapter).stem} -->" in text
    assert "spec/01-transforms.md" in chapters_with_editions()
    assert chapter_of("TRA-7") == "spec/01-transforms.md"
    text = (ROOT / "spec/08-behavior.md").read_text(encoding="utf-8")
    assert "| BEH-2 | holds | holds | The actor has no uniform mixture. `actor_unimix` 0.0 | holds |" in text


# --- Judging
# ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "checks", [TELLING, pytest.param([*CHECKS.values()], marks=pytest.mark.slow)], ids=["some", "all"]
)
@pytest.mark.parametrize("name", PREFERRED)
def test_each_reference_passes_in_its_own_edition_alone(name: str, checks: list[Check]) -> None:
    """But for those of paper and 2024-12, which take their differences from the configuration, so that both pass in
    both."""
    for other in PREFERRED:
        found = statuses(reference(name), other, checks)
        failing = [check for check, status in found.items() if status in FAILING]
        assert (not failing) == (editions()[name].mutants == editions()[other].mutants), (other, failing)
        assert "pass" in found.values()


def test_results_are_compared_with_those_of_the_edition() -> None:
    """The first version's two-hot fails in the paper's edition and passes in its own; the right one the other way
    round."""
    check = CHECKS["transforms.twohot_matches"]
    first, right = reference("2023"), NumpyAdapter()
    for adapter, edition, status in (
        (first, "2023", "pass"),
        (first, "paper", "fail"),
        (right, "2023", "fail"),
        (right, "paper", "pass"),
    ):
        result = judge(check, adapter, editions()[edition], "float64", 0, 5, shrink=False)
        assert result.status == status, (edition, result.message)
    wrong = judge(check, right, editions()["2023"], "float64", 0, 5, shrink=False)
    assert wrong.message.startswith("twohot[")
    assert wrong.call is not None
    assert wrong.call.expected is not None


def test_what_the_edition_refuses_must_be_refused() -> None:
    """The chapter's literals do not count where the edition has others; refusals do."""
    mutant = own_reference("2023")
    assert mutant is not None
    right = MutantAdapter(mutant).twohot

    def careless(x: np.ndarray, bins: np.ndarray) -> np.ndarray:
        try:
            return np.asarray(right(x, bins))
        except ValueError:
            return np.zeros(np.size(bins))

    def expects(setting: Setting) -> Cases:
        yield exact("twohot", (np.array(0.3), np.array([-2.0, 0, 2])), np.zeros(3))
        yield refused("twohot", np.array(0.3), np.zeros((2, 2)))

    check = Check("transforms.made_up", ("TRA-7",), ("twohot",), 0, ("float64",), "", expects)
    for function, status in ((right, "pass"), (careless, "fail")):
        result = judge(check, types.SimpleNamespace(twohot=function), editions()["2023"], "float64")
        assert result.status == status, result.message
        assert status == "pass" or "must raise a ValueError" in result.message


def test_a_check_of_extreme_input_alone_fails_with_extreme_input_only() -> None:
    one, special = np.array([1.0]), np.array([np.nan])

    def same(c: Comparisons, first: np.ndarray, second: np.ndarray) -> None:
        c.exact("both", second, first + 1)

    def refusals(setting: Setting) -> Cases:
        yield refused("f", np.zeros(0))

    def not_finite(setting: Setting) -> Cases:
        yield exact("f", (special,), special)

    def both(setting: Setting) -> Cases:
        yield from not_finite(setting)
        yield exact("f", (one,), one)

    def in_one_case(setting: Setting) -> Cases:
        yield related(same, ("f", (one,)), ("f", (special,)))

    zeros, paper = types.SimpleNamespace(f=np.zeros_like), editions()["paper"]
    for build, extreme in ((refusals, True), (not_finite, True), (both, False), (in_one_case, False)):
        check = Check("transforms.made_up", (), ("f",), 0, ("float64",), "", build)
        result = judge_twice(check, zeros, paper, "float64")
        assert (result.status, result.extreme) == ("fail", extreme), build


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("rssm.core_matches", "2023 has RSSM-3, RSSM-4, RSSM-5, RSSM-6 otherwise, which is not modelled here"),
        ("networks.heads_match", "it reaches layers.dense, which 2023 has otherwise and which is not modelled here"),
    ],
)
def test_what_is_not_modelled_is_not_judged(name: str, reason: str) -> None:
    check = CHECKS[name]
    broken = types.SimpleNamespace(**dict.fromkeys(check.uses, lambda *arguments: 1 / 0))
    result = judge(check, broken, editions()["2023"], "float64", 0, EXAMPLES)
    assert (result.status, result.message) == (NOT_JUDGED, reason)
    assert judge(check, types.SimpleNamespace(), editions()["2023"], "float64").status == "not offered"


def test_gradients_are_judged_where_the_losses_are_those_of_the_edition() -> None:
    check = CHECKS["agent.train_step_keeps_its_arguments"]
    broken = types.SimpleNamespace(**dict.fromkeys(check.uses, lambda *arguments: 1 / 0))
    assert judge(check, broken, editions()["2024-04"], "float64", 0, EXAMPLES).status == "error"
    assert judge(check, broken, editions()["2023"], "float64", 0, EXAMPLES).status == NOT_JUDGED


# --- The best fit
# ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("adapter", "edition", "others"),
    [
        (reference("2023"), "2023", []),
        (reference("2024-04"), "2024-04", []),
        (reference("paper"), "paper", ["2024-12"]),
        (Stubborn("official"), "2024-12", []),
        (Stubborn("paper"), "paper", []),
    ],
    ids=["2023", "2024-04", "any settings", "settings of 2024-12", "settings of paper"],
)
def test_the_best_fit_is_the_edition(adapter: object, edition: str, others: list[str]) -> None:
    fits = fit(TELLING, adapter, "float64", examples=EXAMPLES)
    assert best(fits).edition == edition
    assert alike(fits, best(fits)) == others


def test_no_edition_wins_by_what_it_leaves_open() -> None:
    fits = [Fit("paper", {"a": "fail", "b": "pass"}), Fit("2023", {"a": NOT_JUDGED, "b": "pass"})]
    assert best(fits).edition == "paper"
    assert alike(fits, fits[0]) == ["2023"]
    fits = [
        Fit("paper", {"a": "pass", "b": "pass", "c": "fail"}),
        Fit("2023", {"a": NOT_JUDGED, "b": "pass", "c": "pass"}),
    ]
    assert best(fits).edition == "2023"
    assert fits_better(fits[1], fits[0])
    assert not fits_better(fits[0], fits[0])


def test_a_candidate_that_raises_is_asked_once() -> None:
    asked = []

    def twohot(x: np.ndarray, bins: np.ndarray) -> np.ndarray:
        asked.append(1)
        raise RuntimeError("out of order")

    fits = fit([CHECKS["transforms.twohot_literals"]], types.SimpleNamespace(twohot=twohot), "float64")
    assert [dict(one.statuses) for one in fits] == [{"transforms.twohot_literals": "error"}] * 4
    assert len(asked) == 1


def test_what_is_not_implemented_speaks_neither_for_nor_against_an_edition() -> None:
    def twohot(x: np.ndarray, bins: np.ndarray) -> np.ndarray:
        raise NotImplementedError("soft targets")

    fits = fit(
        [CHECKS["transforms.twohot_literals"]], types.SimpleNamespace(twohot=twohot, refuses_anyhow=True), "float64"
    )
    assert [dict(one.statuses) for one in fits] == [{"transforms.twohot_literals": NOT_JUDGED}] * 4


# --- The command
# ------------------------------------------------------------------------------

FIRST = """
import numpy as np


def edition():
    return {edition!r}


def symlog(x):
    return np.sign(x) * np.log1p(np.abs(x))


def twohot(x, bins):
    x, bins = symlog(np.asarray(x)), symlog(np.asarray(bins))
    x = np.clip(x, bins[0], bins[-1])
    lower = np.clip(np.searchsorted(bins, x, side="right") - 1, 0, len(bins) - 2)
    share = (x - bins[lower]) / (bins[lower + 1] - bins[lower])
    eye = np.eye(len(bins))
    return eye[lower] * (1 - share)[..., None] + eye[lower + 1] * share[..., None]
"""


def report(tmp_path: Path, edition: str | None, *options: str) -> tuple[int, dict[str, Any]]:
    (tmp_path / "mine.py").write_text(FIRST.format(edition=edition), encoding="utf-8")
    code = main(
        [
            "check",
            str(tmp_path / "mine.py"),
            "--only",
            "twohot_l",
            "--examples",
            "2",
            "--json",
            str(tmp_path / "r.json"),
            *options,
        ]
    )
    return code, json.loads((tmp_path / "r.json").read_text(encoding="utf-8")) if code < 2 else {}


def test_the_edition_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, data = report(tmp_path, None)
    assert (code, data["edition"], data["profile"], data["choice"]) == (0, "2023", "2023", "best fit")
    counts = {
        entry["edition"]: (entry["passed"], entry["judged"], entry["offered"]) for entry in data["fit"]["editions"]
    }
    assert counts == {"paper": (0, 1, 1), "2024-12": (0, 1, 1), "2024-04": (0, 1, 1), "2023": (1, 1, 1)}
    assert (data["fit"]["alike"], data["fit"]["better"]) == ([], None)
    assert "Judged as the edition 2023 (the first version), which fits best." in capsys.readouterr().out

    assert main(["check", "numpy", "--only", "twohot_l", "--json", str(tmp_path / "own.json")]) == 0
    own = json.loads((tmp_path / "own.json").read_text(encoding="utf-8"))
    assert (own["edition"], own["choice"], own["fit"]) == ("paper", "given", None)

    code, data = report(tmp_path, "2023")
    assert (code, data["edition"], data["choice"], data["fit"]) == (0, "2023", "claimed", None)

    code, data = report(tmp_path, "official")
    assert (code, data["edition"], data["choice"], data["fit"]["better"]) == (1, "2024-12", "claimed", "2023")
    assert "The edition 2023 fits better." in capsys.readouterr().out

    code, data = report(tmp_path, "2023", "--edition", "paper")
    assert (code, data["edition"], data["choice"], data["fit"]["better"]) == (1, "paper", "given", "2023")
    assert "as asked; it claims 2023." in capsys.readouterr().out
    assert "--edition paper" in data["checks"]["transforms.twohot_literals"]["failure"]["command"]


def test_an_unknown_edition_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(tmp_path, "2020")[0] == 2
    assert (
        "the adapter's edition(): unknown edition '2020'; known: 2023, 2024-04, 2024-12, paper"
        in capsys.readouterr().err
    )
    with pytest.raises(SystemExit):
        report(tmp_path, None, "--edition", "2020")


def test_what_is_not_judged_does_not_pass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.py").write_text(
        "def core(params, deter, stoch, action, config):\n    return deter\n", encoding="utf-8"
    )
    run = ["check", str(tmp_path / "mine.py"), "--only", "rssm.core_matches", "--examples", "2"]
    assert main([*run, "--edition", "2023"]) == 1
    assert "1 checks, 0 numbers compared: 1 not in edition" in capsys.readouterr().out
    assert main([*run, "--edition", "2023", "--at-least", "0"]) == 0


def test_editions_are_compared_only_where_a_failure_passes_in_another() -> None:
    check = CHECKS["transforms.twohot_literals"]
    broken = types.SimpleNamespace(twohot=lambda x, bins: np.zeros((*np.shape(x), len(bins))))
    assert may_fit_better([check], reference("2023"), editions()["paper"], "float64")
    assert not may_fit_better([check], broken, editions()["paper"], "float64")
    assert not may_fit_better([], reference("2023"), editions()["paper"], "float64")


def test_returns_are_the_same_in_all_editions() -> None:
    """What no edition has otherwise is judged in all of them, and a mistake in it is one everywhere."""
    right = types.SimpleNamespace(lambda_return=returns.lambda_return)
    wrong = MutantAdapter(MUTANTS["return_bootstraps_from_itself"])
    for edition in editions():
        assert statuses(right, edition, [CHECKS["returns.lambda_return_matches"]]) == {
            "returns.lambda_return_matches": "pass"
        }
        assert statuses(wrong, edition, [CHECKS["returns.lambda_return_matches"]]) == {
            "returns.lambda_return_matches": "fail"
        }
