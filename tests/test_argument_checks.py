"""What is wrong with an argument is checked, and said, in the same way in every implementation."""

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance.our_candidates import IMPLEMENTATIONS, load_adapter
from conformance.problems import make_problem
from dreamer_spec.backend import learner_class

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("reference_numpy", "impl_jax", "impl_torch")
SHARED = ("require", "require_shape", "require_keys", "require_shapes", "_differences", "_refuse")

PROBLEM = make_problem(0, "paper", "both", "mixed", "float32")
CONFIG, SPACES, PARAMS = PROBLEM.config, PROBLEM.spaces, PROBLEM.state["params"]
X = np.zeros((2, 3))


def changed(**arrays: Any) -> tuple[Any, ...]:
    """The arguments of `losses` with other entries in the batch, or without those that are None."""
    params, slow_critic, return_range, batch, *rest = PROBLEM.loss_arguments
    batch = {key: value for key, value in {**batch, **arrays}.items() if value is not None}
    return (params, slow_critic, return_range, batch, *rest)


def step_with(gradients: dict[str, np.ndarray]) -> tuple[Any, ...]:
    return ({"a": np.ones(2)}, gradients, {"step": 0, "second_moment": {"a": X[0, :2]}, "momentum": {"a": X[0, :2]}})


MISTAKES: list[tuple[str, tuple[Any, ...], str]] = [
    ("twohot", (X, np.zeros(1)), "bins: expected at least 2 bins, got 1"),
    ("ordered_expectation", (X, np.zeros((3, 1))), "bins: expected shape [K], got [3, 1]"),
    ("ordered_expectation", (X, np.array([-1.0, 1.0])), "bins: expected an odd number of at least 3, got 2"),
    ("exponential_bins", (4,), "bins: expected an odd number of at least 3, got 4"),
    ("categorical_sample", (X, np.zeros(3)), "uniform: expected shape [2], got [3]"),
    ("normal_log_prob", (X, X, X[:1]), "value: expected shape [2, 3], got [1, 3]"),
    ("symexp_twohot_loss", (X, X[:, 0], np.array([-1.0, 1.0])), "logits: expected shape [..., 2], got [2, 3]"),
    ("linear", (X, np.zeros((2, 2)), np.zeros(2)), "x: expected shape [..., 2], got [2, 3]"),
    ("block_linear", (X, X, np.zeros(2)), "kernel: expected shape [G, in/G, out/G], got [2, 3]"),
    ("rms_norm", (X, np.zeros(2), 1e-4), "x: expected shape [..., 2], got [2, 3]"),
    ("max_pool", (np.zeros((4, 5, 1)),), "x: expected an even height and width, got [4, 5, 1]"),
    ("max_pool", (X,), "x: expected shape [..., H, W, C], got [2, 3]"),
    ("lambda_return", (X[0], X, X, 0.9, 0.9), "reward: expected shape [rows, steps] with at least 2 steps, got [3]"),
    ("lambda_return", (X, X, X[:1], 0.9, 0.9), "value: expected shape [2, 3], got [1, 3]"),
    ("cumulative_weights", (X, 0.0), "discount: expected above 0 and at most 1, got 0.0"),
    ("percentile", (X, 101.0), "q: expected 0 to 100, got 101.0"),
    ("feature", (X, X), "stoch: expected shape [2, S, C], got [2, 3]"),
    ("reward_head", ({}, X, CONFIG), f"feature: expected shape [..., {CONFIG.feature_size}], got [2, 3]"),
    ("encoder", ({}, {"sight": X}, SPACES, CONFIG), "observations: missing 'depth'; missing 'image'; missing 'mode'; "),
    ("kl_losses", (X, X, CONFIG), "posterior_logits: expected shape [..., 3, 5], got [2, 3]"),
    ("prior", (PARAMS, X, CONFIG), "deter: expected shape [..., 16], got [2, 3]"),
    ("core", (PARAMS, np.zeros((2, 16)), X, X, CONFIG), "stoch: expected shape [2, 3, 5], got [2, 3]"),
    ("sample_action", ({"arm": {}}, X, SPACES, CONFIG), "outputs: missing 'buttons'"),
    ("actor_loss", (X, X, X, X[:1], X, 1.0, CONFIG), "value: expected shape [2, 3], got [1, 3]"),
    ("update_slow_critic", ({"critic/a": X}, {"critic/b": X}, 0.9), "slow: missing 'critic/b'; unknown 'critic/a'"),
    ("optimizer_step", (*step_with({"a": X}), CONFIG), "gradients: 'a': expected shape [2], got [2, 3]"),
    ("adaptive_gradient_clip", (X, X[0], 0.3, 1e-3), "gradient: expected shape [3], got [2, 3]"),
    ("losses", changed(deter=X), "batch['deter']: expected shape [2, 16], got [2, 3]"),
    ("losses", changed(image=X), "batch['image']: expected shape [2, 5, 12, 16, 3], got [2, 3]"),
    ("losses", changed(reward=None), "batch: missing 'reward'"),
]


@pytest.mark.covers("CON-8")
@pytest.mark.parametrize(("function", "arguments", "message"), MISTAKES)
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_an_error_says_the_same_in_every_implementation(
    implementation: str, function: str, arguments: tuple[Any, ...], message: str
) -> None:
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the whole message is compared
        getattr(load_adapter(implementation, "float32"), function)(*arguments)
    assert str(error.value).startswith(message)


def test_a_message_lists_some_of_many_problems() -> None:
    state = {f"params/{name}": np.zeros(7) for name in PARAMS}
    for backend in ("jax", "torch"):
        learner = learner_class(backend)(SPACES, CONFIG, seed=0, device="cpu")
        with pytest.raises(ValueError, match=r"^training state: (missing '\S+'; ){8}\d+ more$"):
            learner.load_state_dict(state)


@pytest.mark.parametrize("name", SHARED)
def test_the_checks_are_the_same_code_in_every_implementation(name: str) -> None:
    sources = set()
    for package in PACKAGES:
        source = (ROOT / package / "shapes.py").read_text(encoding="utf-8")
        [node] = [one for one in ast.parse(source).body if isinstance(one, ast.FunctionDef) and one.name == name]
        sources.add(ast.get_source_segment(source, node))
    assert len(sources) == 1
