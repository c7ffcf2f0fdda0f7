"""Environments that return what their spaces do not allow, and tasks that cannot be made: each is named."""

import sys

import numpy as np
import pytest
import train_fakes

from dreamer_spec.envs import ContractEnv, make_env
from dreamer_spec.errors import UserError


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"observation": np.float32([0, np.nan])}, ["'observation'", "nan"]),
        ({"observation": np.float64([0, 1e300])}, ["'observation'", "inf"]),
        ({"observation": np.zeros(3, np.float32)}, ["'observation'", "(3,)", "(2,)"]),
        ({"observation": np.array(["a", "b"])}, ["'observation'", "<U1", "float32"]),
        ({"observation": np.zeros(2, complex)}, ["'observation'", "complex128"]),
        ({"reward": np.nan}, ["reward", "nan"]),
        ({"reward": np.zeros(2)}, ["reward", "(2,)"]),
        ({"reward": "1"}, ["reward", "'1'"]),
        ({"values": 4}, ["4 values", "terminated, truncated"]),
    ],
)
@pytest.mark.covers("LOOP-31")
def test_what_the_space_does_not_allow_is_refused(wrong: dict, words: list[str]) -> None:
    env = ContractEnv(train_fakes.Faulty(3, **wrong), "my:task", index=5)
    env.reset()
    env.step(np.zeros(2, np.float32))
    env.step(np.zeros(2, np.float32))
    with pytest.raises(UserError) as error:
        env.step(np.zeros(2, np.float32))
    assert all(word in str(error.value) for word in ["task my:task, environment 5, step 3", *words]), error.value


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("camera", np.zeros((20, 30, 3), np.float32), ["'camera'", "float32", "uint8"]),
        ("room", np.int64(15), ["'room'", "15", "outside"]),
        ("room", 12.0, ["'room'", "float64", "int64"]),
        ("items", np.array([0, 0]), ["'items'", "outside"]),
        ("arm", {"angle": 0.5}, ["'arm'", "touch"]),
        ("arm", 3, ["'arm'", "int", "angle, touch"]),
    ],
)
@pytest.mark.covers("LOOP-31")
def test_wrong_entries_are_named(key: str, value: object, words: list[str]) -> None:
    inner = train_fakes.Everything()
    observation = inner.observation()
    inner.observation = lambda: {**observation, key: value}  # type: ignore[method-assign]
    with pytest.raises(UserError) as error:
        ContractEnv(inner, "t").reset()
    assert all(word in str(error.value) for word in words), error.value


def test_repeated_rewards_that_float32_cannot_hold_are_refused() -> None:
    env = ContractEnv(train_fakes.Faulty(1, reward=3e38), "t", action_repeat=2)
    env._env.step = lambda action: (np.zeros(2, np.float32), 3e38, False, False, {})
    env.reset()
    with pytest.raises(UserError, match="2 repeated actions add up"):
        env.step(np.zeros(2, np.float32))


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("CartPole-v1", ["unknown task", "gym:ID"]),
        ("gym:NoSuchGame-v0", ["unknown task", "NoSuchGame"]),
        ("gym:no_such_module:Game-v0", ["unknown task", "no_such_module"]),
        ("no_such_module:make", ["unknown task", "no_such_module"]),
        ("./my_module.py:make", ["unknown task", "'./my_module.py' is a file", "my_module:make"]),
        ("tasks/my_module:make", ["unknown task", "is a file", "my_module:make"]),
        (".my_module:make", ["unknown task", "is a file"]),
        ("train_fakes:no_such_function", ["unknown task", "no_such_function"]),
        ("train_fakes:FakeLearner.diary", ["unknown task"]),
        ("builtins:dict", ["dict", "gymnasium.Env"]),
    ],
)
def test_unknown_tasks_are_named(task: str, words: list[str]) -> None:
    with pytest.raises(UserError) as error:
        make_env(task)
    assert all(word in str(error.value) for word in words), error.value


def test_a_missing_extra_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(UserError, match=r"pip install 'dreamer-spec\[atari\]'"):
        make_env("gym:ALE/Pong-v5")


def test_a_missing_package_of_gymnasium_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium.envs.mujoco.half_cheetah_v5", None)
    monkeypatch.setitem(sys.modules, "gymnasium.envs.mujoco", None)
    with pytest.raises(UserError, match=r"pip install 'dreamer-spec\[mujoco\]'"):
        make_env("gym:HalfCheetah-v5")
