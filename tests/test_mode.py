"""Evaluation by the mode of the actor: the same in the reference, both backends and exported policies."""

import importlib
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import torch
from train_agents import random_learner_state, save_checkpoint

import impl_jax.behavior
import impl_torch.behavior
from conformance.problems import random_observations, small_config
from dreamer_spec.backend import Learner, learner_class
from dreamer_spec.cli import main
from dreamer_spec.disk.checkpoint import open_checkpoint
from dreamer_spec.disk.saved_agent import agent_of
from dreamer_spec.policy import Policy
from reference_numpy import behavior, networks
from spec import Config, Discrete, Image, Spaces, Vector

TASK = Spaces(
    {"image": Image(16, 16, 3), "speed": Vector(2), "room": Discrete((3,))},
    {"arm": Vector(2), "buttons": Discrete((2, 3))},
)
CARTPOLE = Spaces({"observation": Vector(4)}, {"action": Discrete((2,))})
CONFIG: Config = small_config("paper", "float32")
ROWS = 64


def outputs(seed: int = 0) -> dict[str, dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    arm = {name: rng.normal(size=(ROWS, 2)) for name in ("mean", "std")}
    return {"arm": arm, "buttons": {"logits": rng.integers(-1, 2, (ROWS, 5)).astype(float)}}  # with many ties


def mode_by(implementation: str, raw: dict[str, dict[str, np.ndarray]]) -> np.ndarray:
    convert: Any
    module: Any
    convert, module = {
        "numpy": (np.asarray, behavior),
        "jax": (jnp.asarray, impl_jax.behavior),
        "torch": (lambda x: torch.tensor(x, dtype=torch.float32), impl_torch.behavior),
    }[implementation]
    return np.asarray(
        module.mode_action(
            {key: {name: convert(x) for name, x in part.items()} for key, part in raw.items()}, TASK, CONFIG
        )
    )


@pytest.mark.covers("LOOP-71")
@pytest.mark.parametrize("implementation", ["numpy", "jax", "torch"])
def test_the_mode_is_the_mean_and_the_first_most_probable_class(implementation: str) -> None:
    raw = outputs()
    action = mode_by(implementation, raw)
    silent = behavior.sample_action(raw, np.zeros((ROWS, TASK.action_noise_size)), TASK, CONFIG)
    np.testing.assert_allclose(action[:, :2], silent[:, :2], rtol=1e-5, atol=1e-6)  # the sample at noise 0
    logits = raw["buttons"]["logits"]
    for part, own in ((action[:, 2:4], logits[:, :2]), (action[:, 4:], logits[:, 2:])):
        expected = [list(row).index(max(row)) for row in own]
        np.testing.assert_array_equal(part, np.eye(own.shape[1])[expected])


@pytest.mark.covers("LOOP-71")
@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_a_learner_takes_the_mode_of_the_actor_at_sampled_latents(backend: str) -> None:
    learner: Learner = learner_class(backend)(TASK, CONFIG, seed=0, device="cpu")
    state = random_learner_state(CONFIG, TASK)
    learner.load_state_dict(state)
    params = {name.removeprefix("params/"): value for name, value in state.items() if name.startswith("params/")}
    observation, is_first = random_observations(np.random.default_rng(1), TASK, (ROWS,)), np.arange(ROWS) % 2 == 0
    action, latents, carry = learner.policy(observation, is_first, learner.initial_carry(ROWS), 3, mode=True)
    sampled, same_latents, _ = learner.policy(observation, is_first, learner.initial_carry(ROWS), 3)
    for name in ("deter", "stoch"):
        np.testing.assert_array_equal(np.asarray(latents[name]), np.asarray(same_latents[name]))
    assert not np.array_equal(action, sampled)
    stoch = np.eye(CONFIG.classes)[np.asarray(latents["stoch"])]
    raw = networks.actor(params, networks.feature(np.asarray(latents["deter"], float), stoch), TASK, CONFIG)
    np.testing.assert_allclose(action, behavior.mode_action(raw, TASK, CONFIG), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(learner.save_carry(carry)["action"], action)  # it is what the next step remembers


@pytest.mark.covers("LOOP-71")
def test_an_exported_policy_takes_the_mode_as_a_backend_does(tmp_path: Path) -> None:
    saved = agent_of(open_checkpoint(save_checkpoint(tmp_path, CONFIG, TASK, image_size=16, task="gym:Robot-v0")))
    policy = Policy(saved)
    policy.reset(ROWS)
    observation = random_observations(np.random.default_rng(1), TASK, (ROWS,))
    first, noise = np.ones(ROWS, bool), {"posterior": np.full((ROWS, CONFIG.stoch), 0.3)}
    size = TASK.action_noise_size
    action = policy(observation, first, noise | {"action": np.full((ROWS, size), 0.9)}, mode=True)
    policy.reset(ROWS)
    np.testing.assert_array_equal(
        policy(observation, first, noise | {"action": np.zeros((ROWS, size))}, mode=True), action
    )
    step: Any = importlib.import_module("impl_torch.agent").policy_step
    params = {name: torch.tensor(value) for name, value in saved.parameters.items()}
    carry = {"deter": torch.zeros(ROWS, CONFIG.deter), "stoch": torch.zeros(ROWS, CONFIG.stoch, CONFIG.classes)}
    inputs = {key: torch.tensor(value) for key, value in observation.items()}
    draws = {"posterior": torch.full((ROWS, CONFIG.stoch), 0.3), "action": torch.rand(ROWS, size)}
    before = torch.zeros(ROWS, TASK.action_size)
    _, expected = step(
        params, carry, before, inputs, torch.ones(ROWS, dtype=torch.bool), draws, TASK, CONFIG, mode=True
    )
    np.testing.assert_allclose(action, expected.numpy(), rtol=1e-4, atol=1e-4)


@pytest.mark.covers("LOOP-19", "LOOP-71")
@pytest.mark.parametrize("mode", [False, True])
def test_eval_plays_the_mode_only_if_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], mode: bool
) -> None:
    save_checkpoint(tmp_path / "run", CONFIG, CARTPOLE, task="gym:CartPole-v1", backend="torch")
    learner: Any = learner_class("torch")
    policy, asked = learner.policy, set()

    def spy(self: Any, *arguments: Any, mode: bool = False) -> Any:
        asked.add(mode)
        return policy(self, *arguments, mode=mode)

    monkeypatch.setattr(learner, "policy", spy)
    arguments = ["eval", str(tmp_path / "run"), "--episodes=2", "--device=cpu", f"--json={tmp_path / 'result.json'}"]
    assert main([*arguments, *(["--mode"] if mode else [])]) == 0
    assert asked == {mode}
    assert json.loads((tmp_path / "result.json").read_text())["mode"] is mode
    assert (", by the mode, seed 0" in capsys.readouterr().out) is mode
