"""Preflight refuses backends that are nearly right, and only them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from conformance import preflight as module
from conformance.mutants import PlantedAdapter
from conformance.our_candidates import load_adapter
from conformance.preflight import preflight, preflight_adapter
from conformance.problems import Problem, make_problem, with_sampling_margin
from impl_torch.learner import Learner
from impl_torch.rssm import freeze
from reference_numpy import layers
from spec import Config, Discrete, Image, Spaces, Vector, load_config

PARTS = {"networks", "losses and gradient", "learner", "batch"}
SPACES = Spaces({"position": Vector(3), "image": Image(16, 16, 1)}, {"move": Vector(2), "button": Discrete((3,))})


def config(dtype: str, **overrides: Any) -> Config:
    batch = {"batch_size": 2, "batch_length": 8, "imagination_horizon": 3}
    return load_config("paper", "tiny", compute_dtype=dtype, **{**batch, **overrides})


class ChangedGradients:
    """The PyTorch backend, but for its gradients."""

    def __init__(self, dtype: str, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> None:
        self._right = load_adapter("torch", dtype)
        self._change = change

    def __getattr__(self, name: str) -> Any:
        return getattr(self._right, name)

    def gradients(self, *arguments: Any) -> dict[str, np.ndarray]:
        return self._change(self._right.gradients(*arguments))  # type: ignore[attr-defined]


@pytest.mark.parametrize("dtype", ["float64", "float32", "bfloat16"])
def test_a_right_backend_passes(dtype: str) -> None:
    report = preflight("torch", SPACES, config(dtype), "cpu")
    assert report.passed, report.summary
    named = {one.name: one for one in report.comparisons}
    assert {"encoder", "core", "critic"} <= named.keys()
    assert ("losses" in named) is ("gradient along all parameters" in named) is (dtype != "bfloat16")
    assert all(one.requirements and 0 <= one.share <= 1 for one in report.comparisons)
    assert any(name.startswith("gradient of every tensor") for name in named) is (dtype == "bfloat16")
    assert {"NET-2", "NET-12"} <= set(named["encoder"].requirements)
    assert report.seconds.keys() == ({"networks", "gradient"} if dtype == "bfloat16" else PARTS)
    assert len({one.share for one in report.comparisons}) > 5, "each has a share of its own"
    reference = preflight("numpy", SPACES, config(dtype))
    assert reference.passed
    assert "learner" not in reference.summary  # it has none
    assert "batch" not in reference.summary  # nor gradients


def test_it_tells_what_agrees_as_soon_as_it_does() -> None:
    told: list[str] = []
    report = preflight("numpy", SPACES, config("float32"), progress=told.append)
    assert told == [comparison.name for comparison in report.comparisons]
    assert "encoder" in told


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(
    "start",
    [
        "critic/",
        "actor/hidden0/kernel",
        "rssm/gru/bias",
        "encoder/image/conv0/kernel",
        "reward/out/bias",
        "continue/hidden0/scale",
    ],
)
def test_a_gradient_that_is_missing_is_seen(start: str, dtype: str) -> None:
    def without(gradients: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        assert any(name.startswith(start) for name in gradients)
        return {name: value * (not name.startswith(start)) for name, value in gradients.items()}

    report = preflight_adapter(ChangedGradients(dtype, without), SPACES, config(dtype))
    assert not report.passed
    assert "gradient along" in report.summary
    assert report.comparisons[-1].name.startswith(("total loss", "gradient along"))


@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0, -1.0, np.nan])
@pytest.mark.parametrize("tensor", ["encoder/image/conv0/kernel", "rssm/gru/bias", "critic/hidden0/scale"])
def test_a_gradient_that_is_wrong_in_bfloat16_is_seen(tensor: str, factor: float) -> None:
    def wrong(gradients: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**gradients, tensor: factor * gradients[tensor]}

    wide = load_adapter("torch", "float32")
    report = preflight_adapter(ChangedGradients("bfloat16", wrong), SPACES, config("bfloat16"), wide=wide)
    assert not report.passed
    assert report.summary.startswith(f"gradient: gradient of {tensor}")


def test_a_gradient_that_is_not_finite_is_seen() -> None:
    def spoiled(gradients: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {
            name: np.full_like(value, np.nan) if name == "continue/out/bias" else value
            for name, value in gradients.items()
        }

    assert not preflight_adapter(ChangedGradients("float64", spoiled), SPACES, config("float64")).passed


def test_a_mistake_with_many_rows_is_seen() -> None:
    """The last row of a large batch does not count."""

    class Wrong(ChangedGradients):
        def gradients(self, *arguments: Any) -> dict[str, np.ndarray]:
            *before, batch, noise, spaces, config = arguments
            if batch["reward"].size >= 32:
                length, kept = config.batch_length, config.batch_size - 1
                batch = {name: value[:kept] for name, value in batch.items()}
                starts = {name: noise[name][: kept * length] for name in ("prior", "action")}
                noise = {"posterior": noise["posterior"][:kept], **starts}
            return self._right.gradients(*before, batch, noise, spaces, config)  # type: ignore[attr-defined]

    report = preflight_adapter(Wrong("float32", dict), SPACES, config("float32", batch_size=4))
    assert not report.passed
    assert report.summary.startswith("batch: gradient along all parameters")


def test_a_mistake_of_the_learner_is_seen() -> None:
    class Stale(Learner):
        def train_step(self, batch: Any, seed: int) -> Any:
            cached = self._acting or freeze(self.parameters.mapping(), self.config)
            cached = {name: value.clone() for name, value in cached.items()}
            result = super().train_step(batch, seed)
            self._acting = cached
            return result

    class Wrong(ChangedGradients):
        def Learner(self, spaces: Spaces, config: Config, seed: int) -> Learner:  # noqa: N802
            return Stale(spaces, config, seed=seed)

    far = config("float32", learning_rate=0.1, warmup_steps=0)
    assert preflight_adapter(ChangedGradients("float32", dict), SPACES, far).passed
    report = preflight_adapter(Wrong("float32", dict), SPACES, far)
    assert not report.passed
    assert report.summary.startswith("learner: after the train step, acting step 0")


def test_a_batch_has_as_many_rows_as_take_seconds() -> None:
    """All of a small network; of a large one, or with images, at least 512 steps."""
    small, large = load_config("paper", "tiny"), load_config("paper", "400m")
    vectors = Spaces({"position": Vector(3)}, SPACES.actions)
    assert [module.rows_of_batch(spaces, small) for spaces in (vectors, SPACES)] == [16, 8]
    assert module.rows_of_batch(vectors, large) == 8
    assert module.rows_of_batch(SPACES, large) == 8
    assert module.rows_of_batch(SPACES, dataclasses.replace(large, batch_length=100)) == 6
    assert module.rows_of_batch(SPACES, dataclasses.replace(large, batch_size=2)) == 2


def tf32(x: Any) -> np.ndarray:
    """x rounded to the ten bits after the point that tensor cores read of a float32 number."""
    bits = np.asarray(x, np.float32).view(np.uint32).astype(np.uint64) + 0x1000
    return (bits & 0xFFFFE000).astype(np.uint32).view(np.float32).astype(np.float64)


LINEAR, CONVOLUTION = layers.linear, layers.convolution


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("linear", lambda x, kernel, bias: LINEAR(tf32(x), tf32(kernel), bias)),
        ("convolution", lambda x, kernel, bias, stride: CONVOLUTION(tf32(x), tf32(kernel), bias, stride)),
    ],
)
def test_tf32_is_not_float32(name: str, wrong: Callable[..., Any]) -> None:
    adapter = PlantedAdapter({f"layers.{name}": wrong})
    report = preflight_adapter(adapter, SPACES, config("float32"))
    assert not report.passed
    assert report.worst > 3 * module.NETWORK_BOUND["float32"]


def test_a_problem_without_a_margin_is_not_taken() -> None:
    def draw(attempt: int) -> Problem:
        problem = make_problem(0, "paper", "vector", "discrete")
        problem.noise["posterior"][:] = 0.0  # the boundary of the first class
        return problem

    with pytest.raises(RuntimeError, match=r"none of 3 problems keeps every sample 0\.5 away"):
        with_sampling_margin(draw, 0.5, attempts=3)
