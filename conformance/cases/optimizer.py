"""Checks of spec/09-optimizer.md."""

import dataclasses
import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.check import Run, check
from conformance.problems import random_state, small_config, spaces
from conformance.strategies import normals, seeds, shapes
from reference_numpy import optimizer as reference
from spec import Config


def config_of(run: Run, **overrides: Any) -> Config:
    return small_config(run.profile, "float64" if run.dtype == "float64" else "float32", **overrides)


@check("OPT-1", uses=["adaptive_gradient_clip"], level=0)
def clip_literals(run: Run) -> None:
    """A gradient of norm 5 at a parameter of norm 2 is shortened to 0.6; one of norm 0.5 is left alone; the floor is
    epsilon."""
    parameter = np.array([[2.0, 0.0], [0.0, 0.0]])
    long, short = np.array([[3.0, 0.0], [0.0, -4.0]]), np.array([[0.3, 0.0], [0.0, -0.4]])
    run.expect(
        "adaptive_gradient_clip", (long, parameter, 0.3, 1e-3), np.array([[0.36, 0], [0, -0.48]]), bound=16 * run.u
    )
    run.exact(
        "short gradient", run.call("adaptive_gradient_clip", run.cast(short), parameter, 0.3, 1e-3), run.cast(short)
    )
    run.expect(
        "adaptive_gradient_clip",
        (long, np.zeros((2, 2)), 0.3, 1e-3),
        np.array([[1.8e-4, 0], [0, -2.4e-4]]),
        bound=16 * run.u,
    )


@check("OPT-1", "OPT-2", uses=["adaptive_gradient_clip"], level=0)
def clip_matches(run: Run) -> None:
    """Tensors of any rank, with one norm for the whole tensor, over many scales of gradient and parameter."""

    @run.for_all(seed=seeds(), shape=shapes(4, 5), scale=st.sampled_from([1e-6, 1e-2, 1.0, 1e3]))
    def _(seed: int, shape: tuple[int, ...], scale: float) -> None:
        gradient, parameter = run.cast(normals(seed, *shape, scale=scale)), run.cast(normals(seed + 1, *shape))
        expected = reference.adaptive_gradient_clip(gradient, parameter, 0.3, 1e-3)
        run.expect("adaptive_gradient_clip", (gradient, parameter, 0.3, 1e-3), expected, bound=64 * run.u)


@check("OPT-3", "OPT-4", "OPT-5", uses=["adaptive_gradient_clip"], level=0)
def clip_extremes(run: Run) -> None:
    """Huge and tiny norms neither overflow nor vanish, a zero gradient stays zero, and a norm that is not finite gives
    NaN."""
    for scale in (1e25, 1e-25):
        gradient = run.cast(np.array([3.0, -4.0]) * scale)
        expected = reference.adaptive_gradient_clip(gradient, np.ones(2), 0.3, 1e-3)
        run.expect("adaptive_gradient_clip", (gradient, np.ones(2), 0.3, 1e-3), expected, bound=64 * run.u)
        parameter = run.cast(np.array([3.0, 4.0]) * scale)
        expected = reference.adaptive_gradient_clip(np.ones(2), parameter, 0.3, 1e-3)
        run.expect("adaptive_gradient_clip", (np.ones(2), parameter, 0.3, 1e-3), expected, bound=64 * run.u)
    run.exact("zero", run.call("adaptive_gradient_clip", np.zeros(3), np.zeros(3), 0.3, 1e-3), np.zeros(3))
    run.exact("clip 0", run.call("adaptive_gradient_clip", np.array([0.0, 1.0]), np.ones(2), 0.0, 1e-3), np.zeros(2))
    for long, size in (([np.inf, 1.0], [1.0, 1.0]), ([np.nan, 1.0], [1.0, 1.0]), ([1.0, 1.0], [np.inf, 1.0])):
        run.exact(
            "non-finite",
            run.call("adaptive_gradient_clip", np.array(long), np.array(size), 0.3, 1e-3),
            np.full(2, np.nan),
        )


@check("OPT-6", uses=["learning_rate"], level=0)
def learning_rate_literals(run: Run) -> None:
    """With a warmup of 1000 steps the rate is 0, 1/1000, 1/2 and 1 times the full rate after 0, 1, 500 and 1000
    updates."""
    warm = config_of(run, warmup_steps=1000, learning_rate=4e-5)
    for step, share in ((0, 0.0), (1, 0.001), (500, 0.5), (1000, 1.0), (5000, 1.0)):
        run.expect("learning_rate", (step, warm), 4e-5 * share, bound=16 * run.u)
        run.expect("learning_rate", (step, config_of(run, warmup_steps=0, learning_rate=4e-5)), 4e-5, bound=16 * run.u)


@check("OPT-8", "OPT-12", "OPT-13", uses=["laprop"], level=0)
def laprop_literals(run: Run) -> None:
    """The first update is the sign of the gradient, whatever its size; the second follows by hand."""
    config = config_of(run, beta1=0.5, beta2=0.75)
    gradient, zeros = np.array([4.0, -0.125, 0.0, 1024.0]), np.zeros(4)
    update, second, momentum = (np.asarray(x) for x in run.call("laprop", gradient, zeros, zeros, 0, config))
    run.compare("first update", update, np.array([1.0, -1, 0, 1]), magnitude=1.0, bound=16 * run.u)
    run.compare("second moment", second, gradient**2 / 4, bound=16 * run.u)
    run.compare("momentum", momentum, np.array([0.5, -0.5, 0, 0.5]), magnitude=1.0, bound=16 * run.u)
    # g = 8 after g = 4: v = 0.75 * 4 + 0.25 * 64 = 19, debiased 19 / 0.4375; u = 8 / sqrt(43.43) = 1.2139;
    # m = 0.25 + u / 2; update = m / 0.75.
    later = (np.array([8.0]), np.array([4.0]), np.array([0.5]), 1, config)
    expected = (0.25 + 0.5 * 8 / math.sqrt(19 / 0.4375)) / 0.75
    run.compare("second update", run.call("laprop", *later)[0], np.array([expected]), bound=16 * run.u)


@check("OPT-8", "OPT-11", "OPT-12", uses=["laprop"], level=0)
def laprop_matches(run: Run) -> None:
    """Random moments at any step; normalization before momentum, bias corrections accurate at every step."""

    @run.for_all(
        seed=seeds(), step=st.sampled_from([0, 1, 2, 10, 1000, 100_000]), scale=st.sampled_from([1e-12, 1e-3, 1.0, 1e6])
    )
    def _(seed: int, step: int, scale: float) -> None:
        config = config_of(run)
        gradient = run.cast(normals(seed, 3, 4, scale=scale))
        second = run.cast(np.random.default_rng(seed + 1).uniform(0, 2, (3, 4)) * scale**2 * (step > 0))
        momentum = run.cast(normals(seed + 2, 3, 4) * (step > 0))
        expected = reference.laprop(gradient, second, momentum, step, config)
        magnitude = (np.abs(expected[0]) + 1, expected[1], 1.0)
        # [OPT-11] allows the bias corrections a relative error of 1e-6 in float32.
        bound = 1e-12 if run.dtype == "float64" else 1e-5
        run.expect("laprop", (gradient, second, momentum, step, config), expected, magnitude=magnitude, bound=bound)


@check("OPT-9", "OPT-10", uses=["laprop"], level=0)
def laprop_tiny_gradients(run: Run) -> None:
    """A gradient below 1e-16 counts as zero, a zero gradient moves nothing, and 1e-15 is normalized like any other."""
    config = config_of(run)
    gradient = np.array([0.0, -0.0, 9e-17, -1e-30, 1e-40, 1e-15, -1e-10, np.nan])
    update, second, momentum = (
        np.asarray(x) for x in run.call("laprop", gradient, np.zeros(8), np.zeros(8), 0, config)
    )
    run.compare("update", update, np.array([0, 0, 0, 0, 0, 1, -1, np.nan]), magnitude=1.0, bound=2e-5)
    run.exact("second moment of nothing", second[:5], np.zeros(5))
    run.exact("momentum of nothing", momentum[:5], np.zeros(5))
    no_epsilon = dataclasses.replace(config, laprop_epsilon=0.0)
    run.exact("epsilon 0", run.call("laprop", np.zeros(2), np.zeros(2), np.zeros(2), 0, no_epsilon)[0], np.zeros(2))


def step_problem(run: Run) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Any], Config]:
    """Parameters of the whole table, gradients of many scales, and moments in the middle of training."""
    config = config_of(run)
    state = random_state(run.rng(), config, spaces(), "float64" if run.dtype == "float64" else "float32")
    rng = np.random.default_rng(run.seed + 1)
    gradients = {
        name: run.cast(rng.normal(size=x.shape) * 10 ** rng.uniform(-6, 3)) for name, x in state["params"].items()
    }
    gradients["reward/out/kernel"] = np.zeros_like(gradients["reward/out/kernel"])
    return state["params"], gradients, {**state["optimizer"], "step": 4}, config


@check("OPT-2", "OPT-15", "OPT-16", "OPT-18", uses=["optimizer_step"], level=3)
def step_matches(run: Run) -> None:
    """New parameters and moments of every tensor of the table, biases and scales included, during warmup and after
    it."""
    params, gradients, state, config = step_problem(run)
    for overrides in ({}, {"warmup_steps": 0}, {"warmup_steps": 10, "learning_rate": 0.1}):
        changed = dataclasses.replace(config, **overrides)
        expected, expected_state = reference.optimizer_step(params, gradients, state, changed)
        copies = {name: value.copy() for name, value in params.items()}
        actual, actual_state = run.call("optimizer_step", params, gradients, state, changed)
        bound = 1e-11 if run.dtype == "float64" else 2e-5
        moves = {
            name: np.abs(expected[name] - params[name]).max() + run.u * np.abs(params[name]).max() for name in params
        }
        run.compare(
            "params",
            actual,
            expected,
            magnitude={n: m + 4 * run.u * np.abs(expected[n]) / bound for n, m in moves.items()},
            bound=bound,
        )
        run.exact("step", actual_state["step"], expected_state["step"])
        run.compare("second_moment", dict(actual_state["second_moment"]), expected_state["second_moment"], bound=bound)
        run.compare("momentum", dict(actual_state["momentum"]), expected_state["momentum"], magnitude=1.0, bound=bound)
        for name, value in copies.items():
            run.exact(f"argument {name} after the step", params[name], value)


@check("OPT-7", uses=["optimizer_step"], level=3)
def step_without_learning_rate(run: Run) -> None:
    """The first update of a warmup leaves every parameter exactly as it is, and still updates moments and step."""
    params, gradients, state, config = step_problem(run)
    actual, actual_state = run.call(
        "optimizer_step", params, gradients, {**state, "step": 0}, dataclasses.replace(config, warmup_steps=5)
    )
    for name, value in params.items():
        run.exact(name, actual[name], value)
    run.exact("step", actual_state["step"], 1)
    changed = [not np.array_equal(actual_state["momentum"][name], state["momentum"][name]) for name in params]
    run.holds("every momentum has changed", np.array(changed))


@check("OPT-18", uses=["optimizer_step"], level=3)
def step_refuses_other_names(run: Run) -> None:
    """Gradients or moments with missing or additional names are refused."""
    params, gradients, state, config = step_problem(run)
    missing = {name: value for name, value in gradients.items() if name != "critic/out/bias"}
    run.refuses("optimizer_step", params, missing, state, config)
    run.refuses("optimizer_step", params, {**gradients, "extra": np.zeros(2)}, state, config)
    run.refuses("optimizer_step", params, {**gradients, "critic/out/bias": np.zeros(2)}, state, config)


@check("OPT-20", uses=["optimizer_step"], level=3)
def step_shows_non_finite_gradients(run: Run) -> None:
    """One infinite gradient entry turns its own tensor into NaN, and no other."""
    params, gradients, state, config = step_problem(run)
    broken = gradients["actor/hidden0/bias"].copy()
    broken[0] = np.inf
    actual, actual_state = run.call(
        "optimizer_step", params, {**gradients, "actor/hidden0/bias": broken}, state, config
    )
    for name in params:
        finite = name != "actor/hidden0/bias"
        run.holds(
            f"{name} is {'finite' if finite else 'NaN'}",
            np.isfinite(actual[name]) if finite else np.isnan(actual[name]),
        )
    run.exact("step", actual_state["step"], 5)


@check("OPT-19", uses=["laprop"], level=0, dtypes=("float32", "bfloat16"))
def optimizer_is_float32(run: Run) -> None:
    """Gradients and moments keep the precision of float32 whatever the compute dtype."""
    x = np.array([0.1, 0.3, 0.7], np.float32).astype(np.float64)
    config = config_of(run)
    expected = reference.laprop(x, x, x, 7, config)
    run.expect("laprop", (x, x, x, 7, config), expected, magnitude=1.0, bound=1e-5)
