"""Checks of spec/09-optimizer.md."""

import dataclasses
import functools
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Equal, Setting, equal, exact, exactly, judged, refused
from conformance.check import check
from conformance.compare import WIDE, Comparisons
from conformance.problems import random_state, small_config, spaces
from conformance.strategies import normals, seeds
from conformance.worked import worked_cases
from reference_numpy import optimizer as reference
from spec import Config

KERNELS = ((), (1,), (5,), (3, 4), (3, 3, 2, 4))


def config_of(setting: Setting, **overrides: Any) -> Config:
    return small_config(setting.profile, WIDE[setting.dtype], **overrides)


@check("OPT-1", uses=["adaptive_gradient_clip"], level=0)
def clip_literals(setting: Setting) -> Cases:
    """A gradient of norm 5 at a parameter of norm 2 is shortened to 0.6; one of norm 0.5 is left alone; the floor is
    epsilon."""
    yield from worked_cases(setting, "optimizer", "clipping by hand", bound=16 * setting.u)
    short, parameter = setting.cast([[0.3, 0.0], [0.0, -0.4]]), np.array([[2.0, 0.0], [0.0, 0.0]])
    yield exact("adaptive_gradient_clip", (short, parameter, 0.3, 1e-3), short, where="short gradient")


@check("OPT-1", "OPT-2", uses=["adaptive_gradient_clip"], level=0)
def clip_matches(setting: Setting) -> Cases:
    """Tensors of any rank, with one norm for the whole tensor, over many scales of gradient and parameter."""

    def case(seed: int, shape: tuple[int, ...], scale: float) -> Cases:
        gradient, parameter = setting.cast(normals(seed, *shape, scale=scale)), setting.cast(normals(seed + 1, *shape))
        expected = reference.adaptive_gradient_clip(gradient, parameter, 0.3, 1e-3)
        yield equal("adaptive_gradient_clip", (gradient, parameter, 0.3, 1e-3), expected, bound=64 * setting.u)

    yield Drawn(case, seed=seeds(), shape=st.sampled_from(KERNELS), scale=st.sampled_from([1e-6, 1e-2, 1.0, 1e3]))


@check("OPT-3", "OPT-4", "OPT-5", uses=["adaptive_gradient_clip"], level=0)
def clip_extremes(setting: Setting) -> Cases:
    """Huge and tiny norms neither overflow nor vanish, a zero gradient stays zero, and a norm that is not finite gives
    NaN."""
    function, ones = "adaptive_gradient_clip", np.ones(2)
    for scale in (1e25, 1e-25):
        gradient, parameter = (setting.cast(np.array(x) * scale) for x in ([3.0, -4.0], [3.0, 4.0]))
        for arguments in ((gradient, ones, 0.3, 1e-3), (ones, parameter, 0.3, 1e-3)):
            yield equal(function, arguments, reference.adaptive_gradient_clip(*arguments), bound=64 * setting.u)
    yield exact(function, (np.zeros(3), np.zeros(3), 0.3, 1e-3), np.zeros(3), where="zero")
    yield from worked_cases(setting, "optimizer", "a clip of 0")
    for long, size in (([np.inf, 1.0], [1.0, 1.0]), ([np.nan, 1.0], [1.0, 1.0]), ([1.0, 1.0], [np.inf, 1.0])):
        arguments = (np.array(long), np.array(size), 0.3, 1e-3)
        yield exact(function, arguments, np.full(2, np.nan), where="non-finite")


@check("OPT-6", uses=["learning_rate"], level=0)
def learning_rate_literals(setting: Setting) -> Cases:
    """With a warmup of 1000 steps the rate is 0, 1/1000, 1/2 and 1 times the full rate after 0, 1, 500 and 1000
    updates."""
    yield from worked_cases(setting, "optimizer", "learning rates", bound=16 * setting.u)


@check("OPT-8", "OPT-12", "OPT-13", uses=["laprop"], level=0)
def laprop_literals(setting: Setting) -> Cases:
    """The first update is the sign of the gradient, whatever its size; the second follows by hand."""
    yield from worked_cases(setting, "optimizer", "exact updates", bound=16 * setting.u)


@check("OPT-8", "OPT-11", "OPT-12", uses=["laprop"], level=0)
def laprop_matches(setting: Setting) -> Cases:
    """Random moments at any step; normalization before momentum, bias corrections accurate at every step."""
    step, scale = st.sampled_from([0, 1, 2, 10, 1000, 100_000]), st.sampled_from([1e-12, 1e-3, 1.0, 1e6])
    yield Drawn(functools.partial(update, setting, config_of(setting)), seed=seeds(), step=step, scale=scale)


@check("OPT-8", "OPT-11", uses=["laprop"], level=0)
def laprop_with_long_averages_matches(setting: Setting) -> Cases:
    """Where moving averages are longer than usual, their corrections still count after a thousand updates."""
    config = dataclasses.replace(config_of(setting), beta1=0.999, beta2=0.9995)
    yield from update(setting, config, setting.seed, 1000, 1.0)


def update(setting: Setting, config: Config, seed: int, step: int, scale: float) -> Cases:
    """One update after `step` others, with gradients of this size."""
    cast = setting.cast
    gradient = cast(normals(seed, 3, 4, scale=scale))
    second = cast(np.random.default_rng(seed + 1).uniform(0, 2, (3, 4)) * scale**2 * (step > 0))
    momentum = cast(normals(seed + 2, 3, 4) * (step > 0))
    expected = reference.laprop(gradient, second, momentum, step, config)
    magnitude = (np.abs(expected[0]) + 1, expected[1], 1.0)
    # [OPT-11] allows the bias corrections a relative error of 1e-6 in float32.
    bound = 1e-12 if setting.dtype == "float64" else 1e-5
    yield equal("laprop", (gradient, second, momentum, step, config), expected, magnitude=magnitude, bound=bound)


@check("OPT-9", "OPT-10", uses=["laprop"], level=0)
def laprop_tiny_gradients(setting: Setting) -> Cases:
    """A gradient below 1e-16 counts as zero, a zero gradient moves nothing, and 1e-15 is normalized like any other."""
    config = config_of(setting)
    gradient = np.array([0.0, -0.0, 9e-17, -1e-30, 1e-40, 1e-15, -1e-10, np.nan])

    def nothing(c: Comparisons, result: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        c.exact("second moment of nothing", result[1][:5], np.zeros(5))
        c.exact("momentum of nothing", result[2][:5], np.zeros(5))

    update = Equal(np.array([0, 0, 0, 0, 0, 1, -1, np.nan]), at=(0,), where="update", magnitude=1.0, bound=2e-5)
    yield judged("laprop", (gradient, np.zeros(8), np.zeros(8), 0, config), update, nothing)
    zeros, no_epsilon = np.zeros(2), dataclasses.replace(config, laprop_epsilon=0.0)
    yield exact("laprop", (zeros, zeros, zeros, 0, no_epsilon), zeros, at=(0,), where="epsilon 0")


def step_problem(setting: Setting) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Any], Config]:
    """Parameters of the whole table, gradients of many scales, and moments in the middle of training."""
    config = config_of(setting)
    state = random_state(setting.rng(), config, spaces(), WIDE[setting.dtype])
    rng = np.random.default_rng(setting.seed + 1)
    gradients = {
        name: setting.cast(rng.normal(size=x.shape) * 10 ** rng.uniform(-6, 3)) for name, x in state["params"].items()
    }
    gradients["reward/out/kernel"] = np.zeros_like(gradients["reward/out/kernel"])
    return state["params"], gradients, {**state["optimizer"], "step": 4}, config


@check("OPT-2", "OPT-15", "OPT-16", "OPT-18", uses=["optimizer_step"], level=3)
def step_matches(setting: Setting) -> Cases:
    """New parameters and moments of every tensor of the table, biases and scales included, during warmup and after
    it."""
    params, gradients, state, config = step_problem(setting)
    bound, u = 1e-11 if setting.dtype == "float64" else 2e-5, setting.u
    for overrides in ({}, {"warmup_steps": 0}, {"warmup_steps": 10, "learning_rate": 0.1}):
        arguments = (params, gradients, state, dataclasses.replace(config, **overrides))
        expected, moments = reference.optimizer_step(*arguments)
        magnitude = {
            name: np.abs(new - params[name]).max() + u * np.abs(params[name]).max() + 4 * u * np.abs(new) / bound
            for name, new in expected.items()
        }
        second, momentum = moments["second_moment"], moments["momentum"]
        yield judged(
            "optimizer_step",
            arguments,
            Equal(expected, at=(0,), where="params", magnitude=magnitude, bound=bound),
            exactly(moments["step"], at=(1, "step"), where="step"),
            Equal(second, at=(1, "second_moment"), where="second_moment", bound=bound),
            Equal(momentum, at=(1, "momentum"), where="momentum", magnitude=1.0, bound=bound),
            keeps=True,
        )


@check("OPT-7", uses=["optimizer_step"], level=3)
def step_without_learning_rate(setting: Setting) -> Cases:
    """The first update of a warmup leaves every parameter exactly as it is, and still updates moments and step."""
    params, gradients, state, config = step_problem(setting)

    def moves(c: Comparisons, result: tuple[dict[str, np.ndarray], dict[str, Any]]) -> None:
        momentum = result[1]["momentum"]
        changed = [not np.array_equal(momentum[name], state["momentum"][name]) for name in params]
        c.holds("every momentum has changed", np.array(changed))

    yield judged(
        "optimizer_step",
        (params, gradients, {**state, "step": 0}, dataclasses.replace(config, warmup_steps=5)),
        exactly(params, at=(0,), where="params"),
        exactly(1, at=(1, "step"), where="step"),
        moves,
    )


@check("OPT-18", uses=["optimizer_step"], level=3)
def step_refuses_other_names(setting: Setting) -> Cases:
    """Gradients or moments with missing or additional names are refused."""
    params, gradients, state, config = step_problem(setting)
    missing = {name: value for name, value in gradients.items() if name != "critic/out/bias"}
    yield refused("optimizer_step", params, missing, state, config)
    yield refused("optimizer_step", params, {**gradients, "extra": np.zeros(2)}, state, config)
    yield refused("optimizer_step", params, {**gradients, "critic/out/bias": np.zeros(2)}, state, config)


@check("OPT-20", uses=["optimizer_step"], level=3)
def step_shows_non_finite_gradients(setting: Setting) -> Cases:
    """One infinite gradient entry turns its own tensor into NaN, and no other."""
    params, gradients, state, config = step_problem(setting)
    broken = gradients["actor/hidden0/bias"].copy()
    broken[0] = np.inf

    def one_tensor_is_nan(c: Comparisons, result: tuple[dict[str, np.ndarray], dict[str, Any]]) -> None:
        for name in params:
            if name == "actor/hidden0/bias":
                c.holds(f"{name} is NaN", np.isnan(result[0][name]))
            else:
                c.holds(f"{name} is finite", np.isfinite(result[0][name]))

    arguments = (params, {**gradients, "actor/hidden0/bias": broken}, state, config)
    yield judged("optimizer_step", arguments, one_tensor_is_nan, exactly(5, at=(1, "step"), where="step"))


@check("OPT-19", uses=["laprop"], level=0, dtypes=("float32", "bfloat16"))
def optimizer_is_float32(setting: Setting) -> Cases:
    """Gradients and moments keep the precision of float32 whatever the compute dtype."""
    x = np.array([0.1, 0.3, 0.7], np.float32).astype(np.float64)
    arguments = (x, x, x, 7, config_of(setting))
    yield equal("laprop", arguments, reference.laprop(*arguments), magnitude=1.0, bound=1e-5)
