"""The optimizers by themselves, as one uses them without the rest of an agent."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch

from conformance.problems import small_config
from impl_jax import optimizer as jax_optimizer
from impl_torch import optimizer as torch_optimizer
from impl_torch.parameters import Layout

SHAPES = {"kernel": (7, 5), "bias": (5,), "zeros": (3,)}
CONFIG = small_config("paper", "float32", learning_rate=0.03, warmup_steps=4, agc_clip=0.2)
# Two steps with the gradients 0.5 and 1 at a learning rate of 0.1, from 1. The first update is g/|g| = 1. In the second
# v = 0.99 * 0.0025 + 0.01 = 0.012475, u = 1 / sqrt(v / 0.0199) = 1.2630085, m = 0.09 + 0.1 u, and the update m / 0.19.
TWO_STEPS = (0.9, 0.78615745)

Arrays = dict[str, np.ndarray]


def problem() -> tuple[Arrays, list[Arrays]]:
    """Parameters, and the gradients of some steps: of many sizes, so that some are clipped, and some entries are
    zero."""
    rng = np.random.default_rng(0)

    def draw(name: str, size: float) -> np.ndarray:
        return (size * rng.normal(size=SHAPES[name])).astype(np.float32)

    params = {name: draw(name, float(name != "zeros")) for name in SHAPES}
    gradients = [{name: draw(name, 10.0 ** rng.integers(-4, 2)) for name in SHAPES} for _ in range(6)]
    for step in gradients:
        step["kernel"][0] = 0
    return params, gradients


def in_torch(arrays: Arrays) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(x) for name, x in arrays.items()}


def assert_close(results: dict[str, object], expected: dict[str, object]) -> None:
    assert set(results) == set(expected)
    for name, x in results.items():
        np.testing.assert_allclose(np.asarray(x), np.asarray(expected[name]), rtol=1e-5, atol=1e-7, err_msg=name)


# Literal numbers


@pytest.mark.covers("OPT-8", "OPT-11", "OPT-12", "OPT-13")
def test_two_steps_of_torch() -> None:
    parameter = torch.ones(1, requires_grad=True)
    optimizer = torch_optimizer.LaProp([parameter], lr=0.1)
    for gradient, expected in zip((0.5, 1.0), TWO_STEPS, strict=True):
        parameter.grad = torch.tensor([gradient])
        optimizer.step()
        assert parameter.item() == pytest.approx(expected, abs=2e-7)
    state = optimizer.state[parameter]
    assert (state["step"], state["second_moment"].item(), state["momentum"].item()) == (
        2,
        pytest.approx(0.012475),
        pytest.approx(0.21630085),
    )


@pytest.mark.covers("OPT-8", "OPT-11", "OPT-12", "OPT-13")
def test_two_steps_of_jax() -> None:
    optimizer = optax.chain(jax_optimizer.scale_by_laprop(), optax.scale_by_learning_rate(0.1))
    parameter = jnp.ones(1)
    state = optimizer.init(parameter)
    for gradient, expected in zip((0.5, 1.0), TWO_STEPS, strict=True):
        updates, state = optimizer.update(jnp.array([gradient]), state, parameter)
        parameter = optax.apply_updates(parameter, updates)
        assert parameter.item() == pytest.approx(expected, abs=2e-7)
    moments = state[0]
    assert (int(moments.step), moments.second_moment.item(), moments.momentum.item()) == (
        2,
        pytest.approx(0.012475),
        pytest.approx(0.21630085),
    )


CLIPPED = {  # parameter, gradient, clipped to 0.3 of the parameter's norm or of 0.001
    "long": ([3, 4], [6, 8], [0.9, 1.2]),
    "short": ([3, 4], [0.6, 0.8], [0.6, 0.8]),
    "zero parameter": ([0, 0], [3, 4], [1.8e-4, 2.4e-4]),
    "zero gradient": ([3, 4], [0, 0], [0, 0]),
    "huge": ([3, 4], [6e30, 8e30], [0.9, 1.2]),
}


@pytest.mark.covers("OPT-1", "OPT-2", "OPT-3", "OPT-4")
def test_clipping_in_torch() -> None:
    """Each tensor by itself, in place; what has no gradient is left alone."""
    parameters = [
        torch.tensor(parameter, dtype=torch.float32, requires_grad=True) for parameter, _, _ in CLIPPED.values()
    ]
    for parameter, (_, gradient, _) in zip(parameters, CLIPPED.values(), strict=True):
        parameter.grad = torch.tensor(gradient, dtype=torch.float32)
    torch_optimizer.clip_gradients_([*parameters, torch.ones(2, requires_grad=True)], 0.3)
    for parameter, (name, (_, _, expected)) in zip(parameters, CLIPPED.items(), strict=True):
        np.testing.assert_allclose(parameter.grad, expected, rtol=1e-6, err_msg=name)


@pytest.mark.covers("OPT-1", "OPT-2", "OPT-3", "OPT-4")
def test_clipping_in_jax() -> None:
    params, gradients, expected = (
        {name: jnp.array(case[part], jnp.float32) for name, case in CLIPPED.items()} for part in range(3)
    )
    clipping = jax_optimizer.adaptive_gradient_clipping(0.3)
    clipped, _ = clipping.update(gradients, clipping.init(params), params)
    assert_close(clipped, expected)
    with pytest.raises(ValueError, match="params"):
        clipping.update(gradients, clipping.init(params))


# As parts of an agent use them


@pytest.mark.covers("OPT-2", "OPT-6", "OPT-15")
def test_clipping_and_laprop_of_torch_are_the_optimizer_step() -> None:
    arrays, steps = problem()
    params, zeros = in_torch(arrays), {name: np.zeros_like(x) for name, x in arrays.items()}
    state = {"step": 0, "second_moment": in_torch(zeros), "momentum": in_torch(zeros)}
    module = torch.nn.ParameterDict(in_torch(arrays))
    optimizer = torch_optimizer.LaProp(
        module.parameters(), CONFIG.learning_rate, (CONFIG.beta1, CONFIG.beta2), CONFIG.laprop_epsilon
    )
    warmup = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: min(1.0, step / CONFIG.warmup_steps))
    for gradients in steps:
        for name, parameter in module.items():
            parameter.grad = torch.tensor(gradients[name])
        torch_optimizer.clip_gradients_(module.parameters(), CONFIG.agc_clip, CONFIG.agc_epsilon)
        optimizer.step()
        warmup.step()
        params, state = torch_optimizer.optimizer_step(params, in_torch(gradients), state, CONFIG)
        assert_close({name: x.detach() for name, x in module.items()}, params)
        for moment in ("second_moment", "momentum"):
            assert_close({name: optimizer.state[x][moment] for name, x in module.items()}, state[moment])


@pytest.mark.covers("OPT-2", "OPT-6", "OPT-15")
def test_the_transformation_of_jax_is_the_optimizer_step() -> None:
    arrays, steps = problem()
    params = alone = {name: jnp.array(x) for name, x in arrays.items()}
    state, optimizer = jax_optimizer.initial_optimizer_state(params), jax_optimizer.dreamer_optimizer(CONFIG)
    optimizer_state, update = optimizer.init(alone), jax.jit(optimizer.update)
    step = jax.jit(lambda *arguments: jax_optimizer.optimizer_step(*arguments, CONFIG))
    for gradients in steps:
        updates, optimizer_state = update(gradients, optimizer_state, alone)
        alone = optax.apply_updates(alone, updates)
        params, state = step(params, gradients, state)
        assert_close(alone, params)
        for moment in ("second_moment", "momentum"):
            assert_close(getattr(optimizer_state[1], moment), state[moment])


# As a user calls them


def test_torch_learns_a_line() -> None:
    """With an ordinary module, a closure and a checkpoint in the middle."""
    x = torch.linspace(-1, 1, 20)[:, None]
    y = 2 * x - 0.5
    layer = torch.nn.Linear(1, 1)
    optimizer = torch_optimizer.LaProp(layer.parameters(), lr=0.03)
    initial = torch.nn.functional.mse_loss(layer(x), y).item()

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = torch.nn.functional.mse_loss(layer(x), y)
        loss.backward()
        torch_optimizer.clip_gradients_(layer.parameters(), 0.3)
        return loss

    assert optimizer.step(closure).item() == initial
    for _ in range(200):
        optimizer.step(closure)
    saved, optimizer = optimizer.state_dict(), torch_optimizer.LaProp(layer.parameters())
    optimizer.load_state_dict(saved)
    assert optimizer.param_groups[0]["lr"] == 0.03
    optimizer.param_groups[0]["lr"] = 0.003
    for _ in range(100):
        loss = optimizer.step(closure)
    assert loss.item() < 1e-3 * initial


def test_jax_learns_a_line() -> None:
    """With a tree of a list and a tuple."""
    x = jnp.linspace(-1, 1, 20)
    schedule = optax.piecewise_constant_schedule(0.03, {200: 0.1})
    optimizer = optax.chain(
        jax_optimizer.adaptive_gradient_clipping(0.3),
        jax_optimizer.scale_by_laprop(),
        optax.scale_by_learning_rate(schedule),
    )

    def loss(params: list[tuple[jax.Array, jax.Array]]) -> jax.Array:
        slope, offset = params[0]
        return jnp.mean(jnp.square(slope * x + offset - (2 * x - 0.5)))

    @jax.jit
    def step(params: list, state: optax.OptState) -> tuple[list, optax.OptState]:
        updates, state = optimizer.update(jax.grad(loss)(params), state, params)
        return optax.apply_updates(params, updates), state

    params = [(jnp.array(0.7), jnp.array(0.3))]
    initial, state = loss(params), optimizer.init(params)
    for _ in range(300):
        params, state = step(params, state)
    assert loss(params) < 1e-3 * initial


@pytest.mark.covers("OPT-19")
def test_torch_keeps_float32_moments_of_bfloat16_parameters() -> None:
    """Also through a checkpoint. The parameters are those of the same steps in float32, rounded after each."""
    arrays, steps = problem()
    parameters = [torch.tensor(x).bfloat16().requires_grad_() for x in arrays.values()]
    wide = [parameter.detach().float() for parameter in parameters]
    optimizer, wide_optimizer = (torch_optimizer.LaProp(group, lr=0.03) for group in (parameters, wide))
    for gradients in steps:
        for parameter, copy, gradient in zip(parameters, wide, gradients.values(), strict=True):
            parameter.grad = torch.tensor(gradient).bfloat16()
            copy.grad = parameter.grad.float()
        for each in (optimizer, wide_optimizer):
            each.step()
        saved, optimizer = optimizer.state_dict(), torch_optimizer.LaProp(parameters)
        optimizer.load_state_dict(saved)
        for parameter, copy in zip(parameters, wide, strict=True):
            copy.copy_(copy.bfloat16())
            np.testing.assert_array_equal(parameter.detach().float(), copy)
            for moment in ("second_moment", "momentum"):
                assert optimizer.state[parameter][moment].dtype == torch.float32
                np.testing.assert_array_equal(optimizer.state[parameter][moment], wide_optimizer.state[copy][moment])


@pytest.mark.covers("OPT-19")
def test_jax_keeps_float32_moments_of_bfloat16_parameters() -> None:
    params = {name: jnp.array(x, jnp.bfloat16) for name, x in problem()[0].items()}
    optimizer = jax_optimizer.scale_by_laprop()
    updates, state = optimizer.update(params, optimizer.init(params), params)
    assert {x.dtype.name for x in jax.tree.leaves((state.second_moment, state.momentum))} == {"float32"}
    assert {x.dtype.name for x in jax.tree.leaves(updates)} == {"bfloat16"}


@pytest.mark.covers("OPT-14")
@pytest.mark.parametrize("betas", [(1.0, 0.99), (0.9, 1.0), (-0.1, 0.99), (0.9, 1.5)])
def test_betas_outside_of_the_unit_interval_are_refused(betas: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="beta"):
        torch_optimizer.LaProp([torch.ones(1)], betas=betas)
    with pytest.raises(ValueError, match="beta"):
        jax_optimizer.scale_by_laprop(*betas)


# How torch arranges the work


def test_torch_walks_through_tensors_of_any_size_and_order() -> None:
    """Longer than a piece that it updates at a time, and not contiguous in memory."""
    generator = torch.Generator().manual_seed(0)
    long, columns = (
        torch.randn(torch_optimizer.CHUNK + 7, generator=generator),
        torch.randn(6, 4, generator=generator).t(),
    )
    for start in (long, columns):
        parameter = start.clone().requires_grad_()
        optimizer = torch_optimizer.LaProp([parameter], lr=0.5)
        second_moment, momentum, expected = torch.zeros_like(start), torch.zeros_like(start), start
        for step in range(2):
            parameter.grad = torch.randn(start.shape, generator=generator)
            optimizer.step()
            update, second_moment, momentum = torch_optimizer.laprop(
                parameter.grad, second_moment, momentum, step, CONFIG
            )
            expected = expected - 0.5 * update
        np.testing.assert_allclose(parameter.detach(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.covers("OPT-2", "OPT-3", "OPT-5")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torch_clips_a_flat_buffer_as_it_clips_each_tensor(dtype: torch.dtype) -> None:
    """Tensors of one row, of many, and of rows of rows, from huge to tiny, with zeros and infinity among them."""
    huge = 1e30 if dtype == torch.float32 else 1e200
    sizes = {
        "scalar": 1,
        "row": 64,
        "more": 65,
        "huge": 5000,
        "tiny": 4097,
        "zero": 70,
        "many": 64**3 + 1,
        "infinite": 200,
    }
    layout, generator = (
        Layout({name: (size,) if size > 1 else () for name, size in sizes.items()}),
        torch.Generator().manual_seed(0),
    )
    gradients, parameters = (
        [torch.randn(shape, generator=generator, dtype=dtype) for shape in layout.shapes.values()] for _ in range(2)
    )
    for index, name in enumerate(sizes):
        gradients[index] *= {"huge": huge, "tiny": 1 / huge, "zero": 0.0}.get(name, 1.0)
        if name == "infinite":
            gradients[index][100] = torch.inf
    expected = [
        torch_optimizer.adaptive_gradient_clip(*pair, 0.3, 1e-3) for pair in zip(gradients, parameters, strict=True)
    ]
    flat = layout.pack(gradients)
    norms, factors = torch_optimizer.clip_flat_gradients_(flat, layout.pack(parameters), layout, 0.3, 1e-3)
    results = dict(
        zip(sizes, zip(layout.views(flat).values(), expected, norms, factors, gradients, strict=True), strict=True)
    )
    for name, (clipped, alone, norm, factor, gradient) in results.items():
        np.testing.assert_allclose(clipped, alone, rtol=1e-5, err_msg=name)
        if name == "infinite":
            assert clipped.isnan().all()
            assert factor.isnan()
        else:
            peak = gradient.abs().max().double()
            true = peak * (gradient.double() / peak).square().sum().sqrt() if peak else peak
            np.testing.assert_allclose(norm, true, rtol=1e-6, err_msg=name)
