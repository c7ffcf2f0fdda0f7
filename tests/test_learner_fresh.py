"""Both learners before their first step: names, shapes and numbers of a fresh state."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from conformance.problems import make_problem, random_carry, small_config, spaces
from dreamer_spec.backend import Learner, learner_class
from dreamer_spec.disk import checkpoint
from impl_torch import agent, layers, rssm
from spec import Config, Spaces, parameter_table

TASK = spaces("vector", "mixed")
CONFIG = small_config("paper", "float32")
STATE_GROUPS = ("params", "optimizer/second_moment", "optimizer/momentum")


def make(backend: str, seed: int = 0, task: Spaces = TASK, config: Config = CONFIG) -> Learner:
    return learner_class(backend)(task, config, seed=seed, device="cpu")


@pytest.fixture(params=("jax", "torch"))
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.mark.covers("AGT-1", "AGT-8", "AGT-9", "CON-22", "CON-29", "CON-30")
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("profile", ["paper", "official"])
@pytest.mark.parametrize(
    ("observations", "actions"), [("vector", "discrete"), ("image", "continuous"), ("both", "mixed")]
)
def test_the_state_has_the_names_shapes_and_types_of_the_chapter(
    backend: str, observations: str, actions: str, profile: str, dtype: str
) -> None:
    task, config = spaces(observations, actions), small_config(profile, dtype)
    table = parameter_table(config, task)
    expected = {f"{group}/{name}": (entry.shape, "float32") for group in STATE_GROUPS for name, entry in table.items()}
    expected |= {
        f"slow_critic/{name}": (entry.shape, "float32") for name, entry in table.items() if name.startswith("critic/")
    }
    expected |= {f"return_range/{end}": ((), "float32") for end in ("low", "high")}
    expected |= {"optimizer/step": ((), "int64")}
    state = make(backend, 0, task, config).state_dict()
    assert {name: (array.shape, array.dtype.name) for name, array in state.items()} == expected
    assert all(isinstance(array, np.ndarray) for array in state.values())


@pytest.mark.covers("AGT-3", "AGT-4", "AGT-5", "AGT-6", "AGT-7")
def test_a_fresh_state(backend: str) -> None:
    config = small_config("paper", "float32", units=64, deter=64, actor_outscale=0.01)
    state, table = make(backend, 0, TASK, config).state_dict(), parameter_table(config, TASK)
    kernels = []
    for name, entry in table.items():
        value = state[f"params/{name}"]
        assert not state[f"optimizer/second_moment/{name}"].any()
        assert not state[f"optimizer/momentum/{name}"].any()
        if name.startswith("critic/"):
            np.testing.assert_array_equal(state[f"slow_critic/{name}"], value)
        if entry.initializer != "truncated_normal":
            np.testing.assert_array_equal(value, float(entry.initializer == "ones"))
        elif entry.outscale == 0:
            assert not value.any(), name
        else:
            scale = entry.outscale / entry.fan_in**0.5
            assert np.abs(value).max() <= 2.2737 * scale
            assert abs(value.std() / scale - 1) < 4 / value.size**0.5, name
            assert abs(value.mean()) < 5 * scale / value.size**0.5, name
            kernels.append(value.ravel()[:16] / scale)
    assert len(np.unique(np.round(kernels, 6))) == 16 * len(kernels), "kernels share random numbers"
    assert [state[name] for name in ("optimizer/step", "return_range/low", "return_range/high")] == [0] * 3


@pytest.mark.covers("AGT-9")
def test_a_checkpoint_of_a_float64_run_is_float32(backend: str, tmp_path: Path) -> None:
    state = make(backend, 0, TASK, small_config("paper", "float64")).state_dict()
    path = checkpoint.save(tmp_path, 0, state, {}, {}, keep=1)
    types = {array.dtype.name for array in load_file(path / "learner.safetensors").values()}
    assert types == {"float32", "int64"}


@pytest.mark.covers("CON-21", "LOOP-24")
def test_parameters_come_from_the_seed(backend: str) -> None:
    fresh, again, begun = (make(backend, seed).state_dict() for seed in (0, 0, 1))
    assert all(np.array_equal(array, again[name]) for name, array in fresh.items())
    same = [
        name
        for name, array in fresh.items()
        if name.endswith("kernel") and name.startswith("params") and np.array_equal(array, begun[name])
    ]
    assert set(same) == {"params/reward/out/kernel", "params/critic/out/kernel"}, "only what starts as zeros"


@pytest.mark.covers("AGT-7", "BEH-21")
def test_a_fresh_slow_critic_is_a_copy() -> None:
    params = {"critic/out/bias": torch.ones(3), "actor/out/bias": torch.ones(2)}
    state = agent.initial_state(params)
    params["critic/out/bias"].zero_()
    assert state["slow_critic"]["critic/out/bias"].tolist() == [1, 1, 1]


@pytest.mark.covers("RSSM-12", "RSSM-23")
def test_one_observed_step_has_the_gradient_of_a_sequence_of_one() -> None:
    """Whoever walks through a sequence step by step learns the same: the straight-through sample included."""
    problem = make_problem(0, "paper", "vector", "discrete", "float64")
    config, rng = problem.config, np.random.default_rng(0)
    params = {name: torch.tensor(value) for name, value in problem.state["params"].items()}
    carry = {name: torch.tensor(value) for name, value in random_carry(rng, config, (2,)).items()}
    inputs = (torch.tensor(rng.normal(size=(2, config.units))), torch.zeros(2, problem.spaces.action_size).double())
    is_first, uniform = torch.tensor([False, True]), torch.tensor(rng.random((2, config.stoch)))
    weights = torch.tensor(rng.normal(size=(2, config.stoch, config.classes)))

    def gradients(of_sequence: bool) -> list[torch.Tensor]:
        leaves = {name: value.clone().requires_grad_() for name, value in params.items() if name.startswith("rssm/")}
        if of_sequence:
            steps = (x[:, None] for x in (*inputs, is_first, uniform))
            stoch = rssm.observe(leaves, carry, *steps, config)["stoch"][:, 0]
        else:
            stoch = rssm.observe_step(leaves, carry, *inputs, is_first, uniform, config)[0]["stoch"]
        found = torch.autograd.grad((stoch * weights).sum(), list(leaves.values()), materialize_grads=True)
        return list(found)

    step, sequence = gradients(of_sequence=False), gradients(of_sequence=True)
    assert any(x.abs().max() > 0.01 for x in step)
    for one, other in zip(step, sequence, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.covers("LAY-8")
def test_a_layer_without_leading_axes_has_its_gradient() -> None:
    vector, scale = (torch.tensor(x, requires_grad=True) for x in ([1.0, -2.0, 3.0], [1.0, 0.5, 2.0]))
    (one,) = torch.autograd.grad(layers.norm_silu(vector, scale, 1e-4).sum(), [scale])
    (row,) = torch.autograd.grad(layers.norm_silu(vector[None], scale, 1e-4).sum(), [scale])
    torch.testing.assert_close(one, row)
