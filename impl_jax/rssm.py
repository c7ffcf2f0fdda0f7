"""The recurrent state-space model: the core, posterior and prior, observing and imagining. Chapter: spec/04-rssm.md.

D = deter, S = stoch, C = classes, A = action, E = tokens, d = units, G = blocks.

Inside the time loops the recurrent state is kept block-major, [G, N, D/G], so that each block is a matrix product of
its own: XLA would otherwise transpose it at every step. The part of the hidden layer's input that all blocks share is
one dense product with the regrouped kernel rows, [h, u] @ W = h @ W_h + u @ W_u. What does not depend on the recurrent
state (the action embedding and the tokens' share of the posterior's first layer) is computed before the loop, in one
batch.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.lax import stop_gradient

from impl_jax.distributions import categorical_sample, straight_through, unimix_log_probs
from impl_jax.layers import (
    Params,
    activate,
    add_bias,
    block_kernel_gradient,
    block_product,
    dense,
    from_blocks,
    linear,
    mlp,
    product,
    product_kernel_gradient,
    rms_norm_over,
    silu,
    to_blocks,
)
from impl_jax.shapes import compute_dtype, require_shape, wide_dtype
from spec import Config

Carry = Mapping[str, jax.Array]
Arrays = dict[str, jax.Array]
# A linear layer of the loop by name: input -> output, bias included.
Apply = Callable[[str, jax.Array], jax.Array]

_CORE = ("embed_deter", "embed_stoch", "hidden_block", "hidden_shared", "gru")


def _loop_weights(params: Params, names: tuple[str, ...], config: Config) -> tuple[Arrays, Arrays]:
    """Kernels and biases of the layers of a loop, by short name, in the arrangement that the loop multiplies with.

    `rssm/hidden` becomes `hidden_block` [G, D/G, D/G], for a block's own memory, and `hidden_shared` [3d, D].
    """
    size = config.deter // config.blocks
    kernels, biases = {}, {}
    for name in names:
        if name in ("hidden_block", "hidden_shared"):
            kernel = params["rssm/hidden/kernel"]  # [G, D/G + 3d, D/G]
            shared = kernel[:, size:].transpose(1, 0, 2).reshape(-1, config.deter)
            kernels[name] = kernel[:, :size] if name == "hidden_block" else shared
            if name == "hidden_shared":
                biases[name] = params["rssm/hidden/bias"]
        else:
            kernels[name], biases[name] = params[f"rssm/{name}/kernel"], params[f"rssm/{name}/bias"]
    biases["gru"] = biases["gru"].reshape(config.blocks, 1, -1)  # for products [G, N, 3D/G]
    return kernels, biases


def _plain_apply(kernels: Arrays, biases: Arrays) -> Apply:
    """Layers as they are: product and bias."""

    def apply(name: str, x: jax.Array) -> jax.Array:
        y = block_product(x, kernels[name]) if kernels[name].ndim == 3 else product(x, kernels[name])
        return add_bias(y, biases[name]) if name in biases else y

    return apply


def _embed_action(params: Params, action: jax.Array, config: Config) -> jax.Array:
    """[..., A] -> [..., d], the action divided by a constant max(1, |a|). [RSSM-2], [RSSM-24]"""
    action = action.astype(compute_dtype(config))
    action = action / stop_gradient(jnp.maximum(1.0, jnp.abs(action)))
    return dense(params, "rssm/embed_action", action, config.norm_epsilon)


def _core_step(
    apply: Apply, scales: Arrays, deter: jax.Array, stoch: jax.Array, action: jax.Array, config: Config
) -> jax.Array:
    """deter [G, N, D/G], flat stoch [N, S*C], embedded action [N, d] -> deter [G, N, D/G]. [RSSM-3] to [RSSM-7]"""
    epsilon = config.norm_epsilon
    embedded = [
        activate(apply(name, x), scales[name], epsilon)  # [N, d]
        for name, x in (("embed_deter", from_blocks(deter)), ("embed_stoch", stoch))
    ]
    shared = apply("hidden_shared", jnp.concatenate([*embedded, action], -1))  # [N, 3d] -> [N, D]
    hidden = apply("hidden_block", deter) + to_blocks(shared, config.blocks)  # [G, N, D/G]
    # The norm is over all of D: axes 0 and 2.
    hidden = silu(rms_norm_over(hidden, scales["hidden"].reshape(config.blocks, 1, -1), epsilon, (0, 2)))
    reset, candidate, update = jnp.split(apply("gru", hidden), 3, axis=-1)  # [G, N, 3D/G] -> [G, N, D/G] each
    candidate = jnp.tanh(jax.nn.sigmoid(reset) * candidate)
    update = jax.nn.sigmoid(update - 1.0)
    return update * candidate + (1.0 - update) * deter


def _core_scales(params: Params) -> Arrays:
    return {name: params[f"rssm/{name}/scale"] for name in ("embed_deter", "embed_stoch", "hidden")}


def core(params: Params, deter: jax.Array, stoch: jax.Array, action: jax.Array, config: Config) -> jax.Array:
    """The memory update: deter [..., D], stoch [..., S, C], action [..., A] -> deter [..., D]. [RSSM-1] to [RSSM-7]

    Section "Networks".

    Raises:
      ValueError: a shape that does not fit. [RSSM-27]
    """
    leading = deter.shape[:-1]
    require_shape("deter", deter.shape, ..., config.deter)
    require_shape("stoch", stoch.shape, *leading, config.stoch, config.classes)
    require_shape("action", action.shape, *leading, _action_size(params))
    dtype = compute_dtype(config)
    embedded = _embed_action(params, action, config).reshape(-1, config.units)  # [N, d]
    apply = _plain_apply(*_loop_weights(params, _CORE, config))
    rows = to_blocks(deter.astype(dtype).reshape(-1, config.deter), config.blocks)  # [G, N, D/G]
    flat = stoch.astype(dtype).reshape(-1, config.stoch * config.classes)  # [N, S*C]
    deter = _core_step(apply, _core_scales(params), rows, flat, embedded, config)
    return from_blocks(deter).reshape(*leading, config.deter)


def prior(params: Params, deter: jax.Array, config: Config) -> jax.Array:
    """Logits of the prior before the mixture: deter [..., D] -> [..., S, C], float32 or better. [RSSM-8], [RSSM-10]"""
    require_shape("deter", deter.shape, ..., config.deter)
    hidden = mlp(params, "rssm/prior", deter.astype(compute_dtype(config)), config.prior_layers, config.norm_epsilon)
    return _logits(linear(hidden, params["rssm/prior/out/kernel"], params["rssm/prior/out/bias"]), config)


def posterior(params: Params, deter: jax.Array, tokens: jax.Array, config: Config) -> jax.Array:
    """Logits of the posterior: [..., D], tokens [..., E] -> [..., S, C], float32 or better. [RSSM-9], [RSSM-10]"""
    require_shape("deter", deter.shape, ..., config.deter)
    require_shape("tokens", tokens.shape, *deter.shape[:-1], _token_size(params, config))
    x = jnp.concatenate([a.astype(compute_dtype(config)) for a in (deter, tokens)], -1)
    hidden = mlp(params, "rssm/posterior", x, config.posterior_layers, config.norm_epsilon)
    return _logits(linear(hidden, params["rssm/posterior/out/kernel"], params["rssm/posterior/out/bias"]), config)


def _action_size(params: Params) -> int:
    return params["rssm/embed_action/kernel"].shape[0]


def _token_size(params: Params, config: Config) -> int:
    return params["rssm/posterior/hidden0/kernel"].shape[0] - config.deter


def _logits(x: jax.Array, config: Config) -> jax.Array:
    return x.reshape(*x.shape[:-1], config.stoch, config.classes).astype(wide_dtype(config))


def _sample(logits: jax.Array, uniform: jax.Array, config: Config) -> jax.Array:
    """A straight-through sample of all latents: [..., S, C] in the compute dtype. [RSSM-11], [RSSM-12], [RSSM-26]"""
    log_probs = unimix_log_probs(logits, config.latent_unimix)
    return straight_through(log_probs, categorical_sample(log_probs, uniform)).astype(compute_dtype(config))


def _mask(keep: jax.Array, x: jax.Array) -> jax.Array:
    """x where keep, zeros elsewhere, selected and not multiplied: what is dropped may be NaN. [RSSM-13], [RSSM-14]"""
    return jnp.where(keep.reshape(keep.shape + (1,) * (x.ndim - keep.ndim)), x, jnp.zeros((), x.dtype))


def observe_step(
    params: Params,
    carry: Carry,
    tokens: jax.Array,
    prev_action: jax.Array,
    is_first: jax.Array,
    uniform: jax.Array,
    config: Config,
) -> tuple[Arrays, jax.Array]:
    """One observed step of N rows: (carry, logits [N, S, C]); zeros for rows with is_first. [RSSM-13] to [RSSM-16]

    carry: of N rows; tokens [N, E]; prev_action [N, A]; is_first [N]; uniform [N, S].
    """
    require_shape("is_first", is_first.shape, "N")
    N = is_first.shape[0]
    _require_carry(carry, N, config)
    require_shape("tokens", tokens.shape, N, _token_size(params, config))
    require_shape("prev_action", prev_action.shape, N, _action_size(params))
    require_shape("uniform", uniform.shape, N, config.stoch)
    states = observe(params, carry, tokens[:, None], prev_action[:, None], is_first[:, None], uniform[:, None], config)
    return {"deter": states["deter"][:, 0], "stoch": states["stoch"][:, 0]}, states["logits"][:, 0]


def observe(
    params: Params,
    carry: Carry,
    tokens: jax.Array,
    prev_action: jax.Array,
    is_first: jax.Array,
    uniform: jax.Array,
    config: Config,
) -> Arrays:
    """Reads a sequence: {"deter" [B, T, D], "stoch" and "logits" [B, T, S, C]}. [RSSM-13] to [RSSM-19], [RSSM-23]

    carry: of B rows, constant; tokens [B, T, E]; prev_action [B, T, A]; is_first [B, T]; uniform [B, T, S].

    Raises:
      ValueError: a shape that does not fit. [RSSM-27]
    """
    require_shape("is_first", is_first.shape, "B", "T")
    B, T = is_first.shape
    require_shape("tokens", tokens.shape, B, T, _token_size(params, config))
    require_shape("prev_action", prev_action.shape, B, T, _action_size(params))
    require_shape("uniform", uniform.shape, B, T, config.stoch)
    _require_carry(carry, B, config)

    # Before the loop, for all B * T rows at once: what does not depend on the recurrent state.
    dtype = compute_dtype(config)
    keep = jnp.logical_not(is_first)
    action = _embed_action(params, _mask(keep, prev_action), config)  # [B, T, d]
    kernel = params["rssm/posterior/hidden0/kernel"]  # [D + E, d]
    from_tokens = add_bias(product(tokens.astype(dtype), kernel[config.deter :]), params["rssm/posterior/hidden0/bias"])

    layers = tuple(f"posterior/hidden{layer}" for layer in range(config.posterior_layers))
    kernels, biases = _loop_weights(params, (*_CORE, *layers, "posterior/out"), config)
    kernels["posterior/hidden0"] = kernel[: config.deter]  # what the loop multiplies with; the tokens' part is done
    scales = _core_scales(params) | {name: params[f"rssm/{name}/scale"] for name in layers}
    # Every bias as an array of its own for each step and row: its gradient is then that of the layer's product, step by
    # step, which `_observe_loop` makes the kernels' gradients of; `add_bias` sums it up for the bias itself.
    del biases["posterior/hidden0"]
    shapes = {name: (config.blocks, B) if name == "gru" else (B,) for name in biases}
    added = {
        name: add_bias(jnp.zeros((T, *shapes[name], bias.shape[-1]), dtype), bias) for name, bias in biases.items()
    }
    added["posterior/hidden0"] = from_tokens.swapaxes(0, 1)  # [T, B, d]
    start = {
        "deter": stop_gradient(to_blocks(carry["deter"].astype(dtype), config.blocks)),
        "stoch": stop_gradient(carry["stoch"].astype(dtype)),
    }
    inputs = {"keep": keep.swapaxes(0, 1), "uniform": uniform.swapaxes(0, 1)}
    states = _observe_loop(config, kernels, scales, added, action.swapaxes(0, 1), start, inputs)
    deter = states["deter"].transpose(2, 0, 1, 3).reshape(B, T, config.deter)  # [T, G, B, D/G] -> [B, T, D]
    return {"deter": deter, "stoch": states["stoch"].swapaxes(0, 1), "logits": states["logits"].swapaxes(0, 1)}


def _observe_scan(
    config: Config, kernels: Arrays, scales: Arrays, added: Arrays, action: jax.Array, start: Arrays, inputs: Arrays
) -> tuple[Arrays, Arrays]:
    """The loop over time: states with time first, and the input of every kernel at every step.

    added: what is added to each layer's product, [T, ...]: the bias, or the tokens' share with the bias; action
    [T, B, d], embedded; start: "deter" [G, B, D/G], "stoch" [B, S, C]; inputs: "keep" [T, B], "uniform" [T, B, S].
    """

    def step(carry: Arrays, now: Any) -> tuple[Arrays, Any]:
        added, action, keep, uniform = now
        seen: Arrays = {}  # layer -> x of y = x W

        def apply(name: str, x: jax.Array) -> jax.Array:
            seen[name] = x
            y = block_product(x, kernels[name]) if kernels[name].ndim == 3 else product(x, kernels[name])
            return y + added[name] if name in added else y

        deter = jnp.where(keep[None, :, None], carry["deter"], 0)  # [G, B, D/G]
        stoch = _mask(keep, carry["stoch"])
        deter = _core_step(apply, scales, deter, stoch.reshape(stoch.shape[0], -1), action, config)
        hidden = from_blocks(deter)  # [B, D], then [B, d]
        for layer in range(config.posterior_layers):
            name = f"posterior/hidden{layer}"
            hidden = activate(apply(name, hidden), scales[name], config.norm_epsilon)
        logits = _logits(apply("posterior/out", hidden), config)
        carry = {"deter": deter, "stoch": _sample(logits, uniform, config)}
        return carry, (carry | {"logits": logits}, seen)

    _, (states, seen) = lax.scan(step, start, (added, action, inputs["keep"], inputs["uniform"]))
    return states, seen


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _observe_loop(
    config: Config, kernels: Arrays, scales: Arrays, added: Arrays, action: jax.Array, start: Arrays, inputs: Arrays
) -> Arrays:
    """`_observe_scan`, with the gradients of the kernels taken after the loop.

    Automatic differentiation would add up each kernel's gradient step by step: T thin products and T passes over all
    weights. Here the loop is differentiated with constant kernels. A layer is y_t = x_t W + b_t, where b_t, an entry of
    `added`, is an argument for every step: the loop's own adjoint gives dL/db_t, which is dL/dy_t. Then one product
    over all T * B rows makes the kernel's gradient, dL/dW = sum over t of x_tᵀ dL/dy_t, x_t being kept as `seen`.
    """
    return _observe_scan(config, kernels, scales, added, action, start, inputs)[0]


def _observe_loop_fwd(
    config: Config, kernels: Arrays, scales: Arrays, added: Arrays, action: jax.Array, start: Arrays, inputs: Arrays
) -> tuple[Arrays, Any]:
    # Converted to the compute dtype once, and not at every step.
    constants = jax.tree.map(lambda kernel: kernel.astype(compute_dtype(config)), kernels)

    def scan(scales: Arrays, added: Arrays, action: jax.Array) -> tuple[Arrays, Arrays]:
        return _observe_scan(config, constants, scales, added, action, start, inputs)

    states, pullback, seen = jax.vjp(scan, scales, added, action, has_aux=True)
    like = jax.tree.map(lambda kernel: jnp.zeros((), kernel.dtype), kernels)  # says the dtypes of the gradients
    return states, (pullback, seen, like)


def _observe_loop_bwd(config: Config, saved: Any, g: Arrays) -> tuple[Any, ...]:
    pullback, seen, like = saved
    scales, added, action = pullback(g)  # gradients; `added` holds dL/dy_t of every layer, [T, B, out]

    def kernel_gradient(name: str) -> jax.Array:
        if name in ("gru", "hidden_block"):
            gradient = added["gru"]  # [T, G, B, 3D/G]
            if name == "hidden_block":  # its product was added to that of `hidden_shared` [T, B, D]: the same gradient
                shared = added["hidden_shared"]
                gradient = shared.reshape(*shared.shape[:2], config.blocks, -1).transpose(0, 2, 1, 3)  # [T, G, B, D/G]
            # [T, G, B, n] -> [G, T * B, n]
            x, gradient = (a.swapaxes(0, 1).reshape(config.blocks, -1, a.shape[-1]) for a in (seen[name], gradient))
            return block_kernel_gradient(x, gradient, like[name].dtype)
        return product_kernel_gradient(seen[name], added[name], like[name].dtype)

    # None for the start, a constant, and for the inputs, which are not differentiable.
    return {name: kernel_gradient(name) for name in like}, scales, added, action, None, None


_observe_loop.defvjp(_observe_loop_fwd, _observe_loop_bwd)


def imagine(
    params: Params,
    carry: Carry,
    policy: Callable[[jax.Array, jax.Array], jax.Array],
    uniform: jax.Array,
    config: Config,
) -> Arrays:
    """Follows a policy through the prior, constant: {"deter" [N, H+1, D], "stoch" [N, H+1, S, C], "action" [N, H, A]}.

    [RSSM-20] to [RSSM-25]. Trajectories run on after a predicted end.

    carry: of N rows; policy(feature [N, F], t) -> action [N, A]; uniform [N, H, S].
    """
    require_shape("uniform", uniform.shape, "N", "H", config.stoch)
    features, actions = imagine_features(params, carry, policy, uniform.swapaxes(0, 1), config)
    features = features.swapaxes(0, 1)
    stoch = features[..., config.deter :].reshape(*features.shape[:2], config.stoch, config.classes)
    return {"deter": features[..., : config.deter], "stoch": stoch, "action": actions.swapaxes(0, 1)}


def imagine_features(
    params: Params,
    carry: Carry,
    policy: Callable[[jax.Array, jax.Array], jax.Array],
    uniform: jax.Array,
    config: Config,
) -> tuple[jax.Array, jax.Array]:
    """`imagine` with time first, as training wants it: uniform [H, N, S] -> features [H+1, N, F], actions [H, N, A].

    Features, joined once for each step, are what all heads read.
    """
    require_shape("uniform", uniform.shape, "H", "N", config.stoch)
    H, N, _ = uniform.shape
    _require_carry(carry, N, config)
    params, carry = stop_gradient((dict(params), dict(carry)))
    dtype = compute_dtype(config)
    kernels, biases = _loop_weights(params, _CORE, config)
    apply = _plain_apply(jax.tree.map(lambda kernel: kernel.astype(dtype), kernels), biases)  # converted once
    scales = _core_scales(params)

    def step(carry: tuple[jax.Array, jax.Array], now: tuple[jax.Array, jax.Array]) -> tuple[Any, Any]:
        (deter, feature), (uniform, t) = carry, now  # [G, N, D/G], [N, F], [N, S]
        action = stop_gradient(policy(feature, t))  # [N, A]
        require_shape("action", action.shape, N, _action_size(params))
        embedded = _embed_action(params, action, config)  # [N, d]
        deter = _core_step(apply, scales, deter, feature[:, config.deter :], embedded, config)
        flat = from_blocks(deter)  # [N, D]
        stoch = _sample(prior(params, flat, config), uniform, config)  # [N, S, C]
        new = jnp.concatenate([flat, stoch.reshape(N, -1)], -1)
        return (deter, new), (feature, action)

    deter = carry["deter"].astype(dtype)
    start = jnp.concatenate([deter, carry["stoch"].astype(dtype).reshape(N, -1)], -1)
    (_, last), (features, actions) = lax.scan(step, (to_blocks(deter, config.blocks), start), (uniform, jnp.arange(H)))
    return stop_gradient((jnp.concatenate([features, last[None]]), actions))


def _require_carry(carry: Carry, rows: int, config: Config) -> None:
    require_shape("carry['deter']", carry["deter"].shape, rows, config.deter)
    require_shape("carry['stoch']", carry["stoch"].shape, rows, config.stoch, config.classes)
