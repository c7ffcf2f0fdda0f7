"""What the trainer runs of the chapters on replay and the training loop passes their checks, and it is what the trainer
runs."""

from typing import Any

import numpy as np
import pytest

from conformance.candidate import load_candidate
from conformance.case import Setting
from conformance.check import Check
from conformance.errors import UserError
from conformance.execute import missing, run_check, selected_checks
from conformance.offered import offered
from conformance.our_candidates import load_adapter
from dreamer_spec import translation
from dreamer_spec.envs import vector
from dreamer_spec.training import loop, setup
from reference_numpy.training_loop import environment_action, make_record

TRAINER = load_adapter("trainer")
CHECKS = {check.name: check for check in selected_checks("float64") if not missing(TRAINER, check)}
SETTING = Setting("float64", "paper", examples=10)


@pytest.mark.parametrize("check", [pytest.param(check, id=name) for name, check in CHECKS.items()])
def test_the_trainer_passes(check: Check) -> None:
    result = run_check(check, TRAINER, SETTING)
    assert result.status == "pass", result.message


def test_the_trainer_offers_all_of_its_two_chapters() -> None:
    assert offered(TRAINER) == [
        "Replay",
        "ReplayRatio",
        "can_train",
        "step_flags",
        "make_record",
        "environment_action",
        "derive_seed",
        "run",
    ]
    chapters = ("replay.", "training_loop.", "running_loop.", "going_on.")
    of_these = {check.name for check in selected_checks("float64") if check.name.startswith(chapters)}
    assert set(CHECKS) == of_these
    assert len(of_these) >= 51


def kept_at_the_end(record: Any, action: Any, latents: Any) -> Any:
    return {**STORED(record, action, latents), "action": action}


STORED = loop.stored


@pytest.mark.parametrize(
    ("module", "name", "mistake", "check"),
    [
        (setup, "ReplayRatio", lambda ratio, batch: lambda step: 1, "training_loop.train_steps_by_hand"),
        (setup, "Replay", lambda *a, **k: [], "replay.a_small_buffer_by_hand"),
        (loop, "can_train", lambda items, config: True, "training_loop.training_starts_with_enough_items"),
        (loop, "derive_seed", lambda seed, purpose, index: seed + index, "training_loop.seeds_by_hand"),
        (loop, "stored", kept_at_the_end, "training_loop.records_by_hand"),
        (
            vector,
            "step_flags",
            lambda reset, terminated, truncated: {"is_first": reset, "is_last": truncated, "is_terminal": terminated},
            "training_loop.flags_by_hand",
        ),
        (
            vector,
            "observed",
            lambda observations, rewards, flags: {"reward": np.array(rewards), **flags[0]},
            "training_loop.records_by_hand",
        ),
        (
            translation,
            "environment_action",
            lambda action, spaces, low, high: environment_action(action * 0.5, spaces, low, high),
            "training_loop.environment_actions_by_hand",
        ),
    ],
)
def test_a_mistake_in_the_trainer_is_caught(
    monkeypatch: pytest.MonkeyPatch, module: Any, name: str, mistake: Any, check: str
) -> None:
    """It is planted where the trainer looks the function up: the checks judge what a run calls."""
    monkeypatch.setattr(module, name, mistake)
    assert run_check(CHECKS[check], TRAINER, SETTING).status in ("fail", "error")


@pytest.mark.covers("LOOP-9", "LOOP-10", "CON-9", "CON-10")
def test_records_of_several_workers_are_those_of_each() -> None:
    rng = np.random.default_rng(0)
    flags = [vector.step_flags(*said) for said in ((True, False, False), (False, True, False), (False, False, True))]
    observations = [{"b": rng.random(2, np.float32), "a": np.array([worker])} for worker in range(3)]
    rewards = [0.0, 1.5, -2.0]
    action, deter = rng.normal(size=(3, 4)).astype(np.float32), rng.normal(size=(3, 5)).astype(np.float32)
    stoch = np.array([[0, 2], [1, 1], [2, 0]])
    together = loop.stored(vector.observed(observations, rewards, flags), action, {"deter": deter, "stoch": stoch})
    for worker in range(3):
        alone = make_record(
            observations[worker],
            rewards[worker],
            flags[worker],
            action[worker],
            deter[worker],
            np.eye(3)[stoch[worker]],
        )
        assert set(together) == set(alone)
        for key, value in alone.items():
            np.testing.assert_array_equal(together[key][worker], value)
            assert key == "stoch" or together[key].dtype == value.dtype, key


def test_precision_and_device_are_the_backends() -> None:
    for dtype, device, asked in (("float32", None, "--dtype float32"), ("float64", "cuda", "--device cuda")):
        with pytest.raises(UserError, match=f"the trainer has no {asked}"):
            load_candidate("trainer", dtype, device)
    load_candidate("trainer", "float64", "cpu")
