"""Frames that an environment skips by itself, and an action repeat on top of them."""

from typing import Any

import gymnasium
import pytest
import train_fakes
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import MaxAndSkipObservation, TimeLimit
from train_fakes import FakeLearner
from train_runs import Make

from dreamer_spec.envs.frames import frame_skip, repeated_twice
from dreamer_spec.training import loop


class Skipping(train_fakes.Counting):
    """As ALE's environments: it is told how many frames a step has."""

    def __init__(self, frameskip: Any = 4) -> None:
        super().__init__()


@pytest.fixture(autouse=True)
def registered() -> Any:
    for version, frameskip in enumerate((4, (2, 5), 1)):
        entry_point: Any = Skipping
        spec = EnvSpec(id=f"Skipping{version}-v0", entry_point=entry_point, kwargs={"frameskip": frameskip})
        gymnasium.registry[spec.id] = spec
    yield
    for version in range(3):
        del gymnasium.registry[f"Skipping{version}-v0"]


@pytest.mark.parametrize(("id", "given", "expected"), [(0, {}, 4), (1, {}, 4), (2, {}, 1), (2, {"frameskip": 3}, 3)])
def test_what_an_id_skips_is_known(id: int, given: dict[str, Any], expected: int) -> None:
    assert frame_skip(gymnasium.make(f"Skipping{id}-v0", disable_env_checker=True, **given)) == expected


def test_wrappers_skip_too() -> None:
    env = gymnasium.make("Skipping0-v0", disable_env_checker=True)
    assert frame_skip(MaxAndSkipObservation(TimeLimit(env, 5), skip=3)) == 12
    assert frame_skip(train_fakes.Counting()) == 1, "an environment that no id made"
    assert frame_skip(gymnasium.make("CartPole-v1")) == 1


def test_both_together_are_a_warning() -> None:
    assert repeated_twice("gym:T", 4, 1) is None
    assert repeated_twice("gym:T", 1, 4) is None
    warning = repeated_twice("gym:T", 4, 4)
    assert warning is not None
    for words in ("WARNING", "gym:T", "--action-repeat 4", "16 frames", "leave out --action-repeat"):
        assert words in warning


@pytest.mark.parametrize(("repeat", "count"), [(1, 0), (4, 1)])
def test_a_run_warns_once(make: Make, capsys: pytest.CaptureFixture[str], repeat: int, count: int) -> None:
    loop.run(make(task="gym:Skipping0-v0", action_repeat=repeat, processes="no"), FakeLearner)
    assert capsys.readouterr().out.count("each action lasts 16 frames") == count
