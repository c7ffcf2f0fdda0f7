import json
from fractions import Fraction

import numpy as np
import pytest

from reference_numpy.training_loop import (
    ReplayRatio,
    can_train,
    derive_seed,
    environment_action,
    make_record,
    step_flags,
)
from spec.config import load_config
from spec.spaces import Discrete, Spaces, Vector


def test_first_call_gives_one_step_and_no_credit():
    ratio = ReplayRatio(32.0, 1024)
    assert ratio(2048) == 1
    assert [ratio(2048 + k) for k in range(1, 65)] == [0] * 31 + [1] + [0] * 31 + [1]


def test_totals_of_every_step():
    ratio = ReplayRatio(128.0, 1024)
    assert sum(ratio(step) for step in range(1088, 100_001)) == 1 + (100_000 - 1088) * 128 // 1024


def test_ratio_without_drift():
    ratio, total = ReplayRatio(0.1, 3), 0
    for step in range(0, 300_001):
        total += ratio(step)
    assert total == 1 + int(300_000 * Fraction(0.1) / 3)
    assert total == 10_001


def test_ratio_does_not_go_back():
    ratio = ReplayRatio(1024.0, 1024)
    ratio(16)
    with pytest.raises(ValueError, match="back"):
        ratio(15)


def test_ratio_zero_never_trains():
    ratio = ReplayRatio(0.0, 1024)
    assert sum(ratio(step) for step in range(5)) == 0
    assert ratio.state_dict()["step"] is None


def test_a_pause_with_ratio_zero_is_not_paid_for():
    """Ratio 1 to step 1000, ratio 0 to step 200 000, then ratio 1: the 199 000 steps in between give no credit."""
    first, pause, second = ReplayRatio(1.0, 1024), ReplayRatio(0.0, 1024), ReplayRatio(1.0, 1024)
    assert [first(0), first(1000)] == [1, 0]
    pause.load_state_dict(first.state_dict())
    assert [pause(step) for step in (1000, 50_000, 200_000)] == [0, 0, 0]
    assert pause.state_dict() == {"step": 200_000, "credit": "1000"}
    with pytest.raises(ValueError, match="back"):
        pause(199_999)
    second.load_state_dict(pause.state_dict())
    assert [second(200_000), second(200_023), second(200_024)] == [0, 0, 1]


def test_ratio_is_saved_exactly():
    ratio, copy = ReplayRatio(0.3, 7), ReplayRatio(0.3, 7)
    ratio(100)
    ratio(133)
    state = json.loads(json.dumps(ratio.state_dict()))
    copy.load_state_dict(state)
    assert [copy(step) for step in range(134, 300)] == [ratio(step) for step in range(134, 300)]
    fresh = ReplayRatio(0.3, 7)
    fresh.load_state_dict(json.loads(json.dumps(ReplayRatio(0.3, 7).state_dict())))
    assert fresh(9) == 1


def test_bad_ratio():
    for ratio, batch in ((-1.0, 1), (float("inf"), 1), (1.0, 0)):
        with pytest.raises(ValueError, match="replay_ratio"):
            ReplayRatio(ratio, batch)


def test_a_buffer_that_can_never_hold_enough():
    with pytest.raises(ValueError, match="replay_capacity"):
        can_train(0, load_config(replay_capacity=1023))


def test_when_training_starts():
    """Each worker's first item comes with its 65th record."""
    config = load_config()
    for workers in (1, 16):
        records = next(n for n in range(10_000) if can_train(workers * max(0, n - config.batch_length), config))
        assert records == 64 + 1024 // workers


SPACES = Spaces({"x": Vector(1)}, {"turn": Vector(4), "buttons": Discrete((2, 3))})


def test_environment_actions_of_a_batch():
    low, high = {"turn": [0.0, -np.inf, 0.0, -2.0]}, {"turn": [10.0, np.inf, np.inf, 2.0]}
    flat = [0.0, 1.0, 0.0, 0.0, 1.0, 0.5, -1.7, -0.25, 1.7]  # keys in sorted order: buttons, turn
    batch = environment_action(np.stack([flat, flat]), SPACES, low, high)
    assert batch["buttons"].shape == (2, 2)
    assert batch["turn"].shape == (2, 4)


def test_a_choice_without_a_preference_is_the_first():
    assert environment_action([0.0, 0.0], Spaces({"x": Vector(1)}, {"a": Discrete((2,))}), {}, {})["a"].tolist() == [0]


def test_environment_action_refuses():
    with pytest.raises(ValueError, match="action"):
        environment_action([0.0], SPACES, {}, {})
    with pytest.raises(ValueError, match="finite"):
        environment_action([np.nan], Spaces({"x": Vector(1)}, {"a": Vector(1)}), {"a": [0]}, {"a": [1]})


def test_flags_come_in_their_order():
    assert list(step_flags(True, False, False)) == ["is_first", "is_last", "is_terminal"]


def test_types_of_a_record():
    made = make_record({"x": np.float32([4])}, 2.5, step_flags(False, False, False), [1.7], [0.5], np.eye(3)[[2]])
    assert {key: value.dtype.name for key, value in made.items()} == {
        "x": "float32",
        "is_first": "bool",
        "is_last": "bool",
        "is_terminal": "bool",
        "reward": "float32",
        "action": "float32",
        "deter": "float32",
        "stoch": "int32",
    }


def test_make_record_copies():
    x, action = np.float32([4]), np.float32([1.0])
    made = make_record({"x": x}, 0.0, step_flags(False, False, False), action, [0.5], np.eye(3)[[2]])
    x[...], action[...] = 9, 9
    assert made["x"] == 4
    assert made["action"] == 1


def test_seeds_differ():
    assert len({derive_seed(seed, purpose, i) for seed in range(5) for purpose in ("a", "b") for i in range(50)}) == 500
    assert derive_seed(0, "parameters") == derive_seed(0, "parameters", 0)
