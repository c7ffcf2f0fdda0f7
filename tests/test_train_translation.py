"""Training, evaluation and an exported policy act alike in every kind of space, and a run goes on in the same
environment only."""

import copy
import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import train_fakes
from gymnasium import spaces as gym
from train_fakes import FakeLearner
from train_runs import Make, run_quietly

from dreamer_spec.cli import main
from dreamer_spec.envs import ContractEnv, translate, trial
from dreamer_spec.errors import UserError
from dreamer_spec.policy import Policy
from dreamer_spec.training import resume, setup
from dreamer_spec.translation import Translation

ROOT = Path(__file__).resolve().parent.parent
F4, U1, I8 = np.float32, np.uint8, np.int64


class Kinds(gymnasium.Env[Any, Any]):
    """Every kind of space, and a diary of what it returned and received."""

    returned: ClassVar[list[Any]] = []
    received: ClassVar[list[Any]] = []
    observation_space = gym.Dict(
        {
            "camera": gym.Box(0, 255, (20, 30, 3), U1),
            "floats": gym.Box(0, 1, (3, 16, 16), F4),
            "frames": gym.Box(0, 255, (2, 16, 18, 1), I8),
            "depth": gym.Box(0, 65535, (16, 16), np.uint16),
            "board": gym.Box(1, 4, (3, 3), np.int8),
            "mixed": gym.Box(np.array([[0, 5], [1, 0]]), np.array([[1, 9], [1, 3]]), dtype=I8),
            "vector": gym.Box(-np.inf, np.inf, (2, 3), np.float64),
            "scalar": gym.Box(-1, 1, (), F4),
            "flags": gym.Box(0, 1, (4,), bool),
            "body": gym.Tuple(
                [gym.Discrete(5, start=-3), gym.Dict({"items": gym.MultiDiscrete([[2, 3]], start=[[1, -1]])})]
            ),
            "touch": gym.MultiBinary((2, 2)),
            "notes": gym.Text(5),
        }
    )
    action_space = gym.Dict(
        {
            "bounded": gym.Box(np.array([[-3, 0.1]]), np.array([[1, 0.3]]), dtype=np.float64),
            "single": gym.Box(0, 5, (2,), F4),
            "half": gym.Box(-2, 2, (1,), np.float16),
            "open": gym.Box(
                np.array([-np.inf, 0, -np.inf, -1e10]), np.array([np.inf, np.inf, 5, 1e10]), dtype=np.float64
            ),
            "scalar": gym.Box(-1, 1, (), F4),
            "discrete": gym.Discrete(4, start=-2),
            "several": gym.MultiDiscrete([[2, 3], [4, 2]], start=[[0, 1], [-5, 9]]),
            "binary": gym.MultiBinary(3),
            "whole": gym.Box(np.array([[-1, 7]]), np.array([[1, 7]]), dtype=np.int16),
            "switch": gym.Box(0, 1, (2,), bool),
            "nested": gym.Tuple(
                [gym.Dict({"left": gym.Discrete(2), "right": gym.Box(0, 9, (1,), F4)}), gym.Discrete(2, start=1)]
            ),
        }
    )

    def __init__(self, length: int = 5) -> None:
        self._length = length

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._time = 0
        self.observation_space.seed(seed)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.received.append(copy.deepcopy(action))
        self._time += 1
        return self._observation(), 1.0, False, self._time == self._length, {}

    def _observation(self) -> Any:
        value = {**self.observation_space.sample(), "notes": object()}
        self.returned.append(value)
        return value


def bits(value: Any) -> Any:
    """Structure, types, shapes, dtypes and bytes."""
    if isinstance(value, dict):
        return {key: bits(value[key]) for key in sorted(value)}
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    return type(value).__name__, value.dtype.str, value.shape, value.tobytes()


@pytest.mark.covers("LOOP-12", "LOOP-31", "LOOP-60", "LOOP-68", "CON-34")
def test_training_evaluation_and_an_exported_policy_act_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each flat action, and each observation, that passed the environment of a run or of `train eval` is what the
    policy folder makes."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "tests"), *sys.path])
    passed: list[tuple[np.ndarray, Any, dict[str, np.ndarray], Any]] = []  # flat action, received; arrays, returned
    step = ContractEnv.step

    def watched(env: ContractEnv, action: np.ndarray) -> Any:
        result = step(env, action)
        passed.append((np.array(action), Kinds.received[-1], copy.deepcopy(result[0]), Kinds.returned[-1]))
        return result

    monkeypatch.setattr(ContractEnv, "step", watched)
    monkeypatch.setattr(trial, "SLOW_STEP", 1e9)  # What is evaluated is evaluated in this process.
    run, folder = str(tmp_path / "run"), tmp_path / "policy"
    words = (
        "--size tiny --deter 16 --units 8 --stoch 3 --classes 5 --bins 31 --envs 2 --batch-size 2 "
        "--batch-length 4 --replay-ratio 1"
    )
    words += (
        " --steps 40 --image-size 16 --leave-out notes --env-arg length=6 "
        "--no-preflight --processes no --eval-episodes 0"
    )
    words += " --random-episodes 0 --compute-dtype float32"
    assert main(["--backend", "torch", "--task", "test_train_translation:Kinds", "--logdir", run, *words.split()]) == 0
    trained = len(passed)
    assert (
        main(["eval", run, "--episodes", "1", "--task", "test_train_translation:Kinds"]) == 0
    )  # One is played in this process.
    assert trained >= 30
    assert len(passed) - trained == 6
    assert main(["export", run, str(folder)]) == 0
    policy = Policy.load(folder)
    for flat, received, arrays, returned in passed:
        (action,) = policy.environment_action(flat[None])
        assert bits(action) == bits(received)
        row = {key: value[0] for key, value in policy.observation([returned]).items()}
        assert bits(row) == bits(arrays)
    assert len({str(bits(received)) for _, received, _, _ in passed}) > 20, "the actions must differ"
    assert policy.info["env_arg"] == {"length": 6}
    # The policy acts alone.
    env = Kinds()
    observation, _ = env.reset(seed=0)
    policy.reset(1)
    for time in range(5):
        action = policy(policy.observation([observation]), [time == 0])
        observation, *_ = env.step(policy.environment_action(action)[0])


@pytest.mark.covers("LOOP-68")
def test_a_translation_survives_its_description() -> None:
    translation = translate(Kinds.observation_space, Kinds.action_space, 16, leave_out=["notes"])
    description = json.loads(json.dumps(translation.to_json(), allow_nan=False))
    assert description["actions"]["open"]["low"] == [None, 0, None, None]
    assert Translation.from_json(description, translation.spaces) == translation


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("observations", "camera", "shape"), [20, 30, 4]),
        (("observations", "camera", "shape"), [8, 30, 3]),
        (("observations", "camera", "low"), []),
        (("observations", "camera", "high"), [0]),
        (("observations", "camera", "high"), [None]),
        (("observations", "board", "low"), [None]),
        (("observations", "camera", "dtype"), "object"),
        (("observations", "camera", "scalar"), True),
        (("observations", "board", "low"), [0.5]),
        (("observations", "board", "low"), [2**63]),
        (("observations", "body_0", "path"), ["body", 2]),
        (("observations", "body_0", "path"), ["body"]),
        (("observations", "body_0", "path"), [["body"]]),
        (("observations", "vector", "shape"), [2, 4]),
        (("observations", "touch"), None),
        (("actions", "bounded", "high"), [0, 0]),
        (("actions", "bounded", "high"), [1e999, 1]),
        (("actions", "bounded", "high"), [1, 2, 3]),
        (("actions", "discrete", "path"), ["single"]),
        (("actions", "discrete"), {"path": []}),
        (("left_out",), [["body"]]),
        (("left_out",), [[-1]]),
        (("left_out",), "notes"),
        (("more",), 1),
    ],
)
@pytest.mark.covers("LOOP-68")
def test_a_description_that_does_not_fit_is_refused(place: tuple[str, ...], value: Any) -> None:
    translation = translate(Kinds.observation_space, Kinds.action_space, 16, leave_out=["notes"])
    description = json.loads(json.dumps(translation.to_json()))
    entry = description
    for key in place[:-1]:
        entry = entry[key]
    entry[place[-1]] = value
    with pytest.raises(ValueError, match="translation"):
        Translation.from_json(description, translation.spaces)


@pytest.mark.covers("LOOP-64")
@pytest.mark.parametrize(
    ("attribute", "space", "words"),
    [
        ("action_space", gym.Box(F4([0, -np.inf]), F4([20, np.inf])), ["actions action", "20.0", "10.0"]),
        ("observation_space", gym.Box(-np.inf, np.inf, (2, 1), F4), ["observations observation", "[2, 1]"]),
        (
            "observation_space",
            gym.Dict({"observation": gym.Box(-np.inf, np.inf, (2,), F4)}),
            ["observations observation", "path"],
        ),
    ],
)
def test_a_run_goes_on_in_the_same_environment_only(
    make: Make, monkeypatch: pytest.MonkeyPatch, attribute: str, space: gymnasium.Space, words: list[str]
) -> None:
    options = make(processes="no")
    with ExitStack() as stack:
        resume.save(setup.prepare(options, FakeLearner, stack))
    monkeypatch.setattr(train_fakes.Counting, attribute, space)
    with pytest.raises(UserError) as error:
        run_quietly(options)
    assert all(word in str(error.value) for word in ["another configuration", *words]), error.value
