"""The recurrent state-space model. Chapter: spec/04-rssm.md.

A state is {"deter" [N, D], "stoch" [N, S, C]}. Functions take the flat mapping of parameters; `prepare` rearranges them
once, which every function does for itself where its caller has not. D = deter, S = stoch, C = classes, E = tokens,
d = units, G = blocks.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from impl_torch.distributions import categorical_sample, sample_onehot, straight_through, unimix_log_probs, unimix_probs
from impl_torch.layers import Params, block_linear, dense, linear, mlp, norm_silu
from impl_torch.scan import ScanOptions, ScanWeights, gru, scan
from impl_torch.shapes import compute_dtype, require_shape, wide_dtype
from spec import Config

Carry = Mapping[str, Tensor]
Policy = Callable[[Tensor, int], Tensor]

SHARED, BLOCK = "rssm/hidden/shared", "rssm/hidden/block"


def prepare(params: Params, config: Config) -> Params:
    """The parameters with the kernel of rssm/hidden split in two; doing it twice changes nothing.

    Every block of rssm/hidden reads its own memory and the same three embeddings ([RSSM-4]). For the embeddings the
    kernels of all blocks side by side make one dense product, instead of one over G copies of the embeddings.
    """
    if SHARED in params or "rssm/hidden/kernel" not in params:
        return params
    # [G, D/G + 3d, D/G] -> BLOCK [G, D/G, D/G] and [G, 3d, D/G] -> SHARED [3d, D]
    own, shared = params["rssm/hidden/kernel"].split([config.deter // config.blocks, 3 * config.units], 1)
    return {**params, BLOCK: own, SHARED: shared.transpose(0, 1).reshape(3 * config.units, config.deter)}


def freeze(params: Params, config: Config) -> Params:
    """The same, as constants with kernels in the compute dtype: for many calls without gradients.

    Imagination multiplies with each kernel H times; in bfloat16 each time would convert it again. Biases and scales
    stay as they are: they are small, and norms take them in float32.
    """
    with torch.no_grad():
        prepared = prepare(params, config)
        return {
            name: x.detach().to(compute_dtype(config)) if x.ndim > 1 else x.detach() for name, x in prepared.items()
        }


def core(params: Params, deter: Tensor, stoch: Tensor, action: Tensor, config: Config) -> Tensor:
    """The memory update: [..., D], [..., S, C], [..., A] -> [..., D]. [RSSM-1] to [RSSM-7] [RSSM-24] [RSSM-27]"""
    leading = deter.shape[:-1]
    require_shape("deter", deter.shape, ..., config.deter)
    require_shape("stoch", stoch.shape, *leading, config.stoch, config.classes)
    require_shape("action", action.shape, *leading, _action_size(params))
    params, dtype, epsilon = prepare(params, config), compute_dtype(config), config.norm_epsilon
    deter, stoch, action = deter.to(dtype), stoch.flatten(-2).to(dtype), _bounded(action.to(dtype))  # stoch [..., S*C]
    inputs = {"rssm/embed_deter": deter, "rssm/embed_stoch": stoch, "rssm/embed_action": action}
    products = [linear(x, params[f"{name}/kernel"], params[f"{name}/bias"]) for name, x in inputs.items()]  # [..., d]
    # One norm and nonlinearity for the three embeddings: in eager code each operation is a pass, or a kernel launch.
    scale = torch.stack([params[f"{name}/scale"] for name in inputs])  # [3, d]
    embedded = norm_silu(torch.stack(products, -2), scale, epsilon).flatten(-2)  # [..., 3d]
    # rssm/hidden [..., D]: what all blocks share, and what each reads of its own memory.
    hidden = linear(embedded, params[SHARED], params["rssm/hidden/bias"]).add_(block_linear(deter, params[BLOCK], None))
    hidden = norm_silu(hidden, params["rssm/hidden/scale"], epsilon)  # over all of D, not block by block
    gates = block_linear(hidden, params["rssm/gru/kernel"], params["rssm/gru/bias"])  # [..., 3D], block by block
    return gru(gates.unflatten(-1, (config.blocks, 3, -1)), deter.unflatten(-1, (config.blocks, -1))).flatten(-2)


def _bounded(action: Tensor) -> Tensor:
    """a / sg(max(1, |a|)). [RSSM-2] [RSSM-24]"""
    return action / action.detach().abs().clamp(min=1)


def prior(params: Params, deter: Tensor, config: Config) -> Tensor:
    """Logits of z given the memory alone, before the mixture: [..., D] -> [..., S, C]. [RSSM-8] [RSSM-10] [RSSM-26]"""
    require_shape("deter", deter.shape, ..., config.deter)
    x = mlp(params, "rssm/prior", deter.to(compute_dtype(config)), config.prior_layers, config.norm_epsilon)
    return _logits(linear(x, params["rssm/prior/out/kernel"], params["rssm/prior/out/bias"]), config)


def posterior(params: Params, deter: Tensor, tokens: Tensor, config: Config) -> Tensor:
    """Logits of z given memory and tokens: [..., D], [..., E] -> [..., S, C]. [RSSM-9] [RSSM-10] [RSSM-26]"""
    require_shape("deter", deter.shape, ..., config.deter)
    require_shape("tokens", tokens.shape, *deter.shape[:-1], _token_size(params, config))
    x = torch.cat([deter, tokens], -1).to(compute_dtype(config))
    x = mlp(params, "rssm/posterior", x, config.posterior_layers, config.norm_epsilon)
    return _logits(linear(x, params["rssm/posterior/out/kernel"], params["rssm/posterior/out/bias"]), config)


def _action_size(params: Params) -> int:
    return params["rssm/embed_action/kernel"].shape[0]


def _token_size(params: Params, config: Config) -> int:
    return params["rssm/posterior/hidden0/kernel"].shape[0] - config.deter


def _logits(x: Tensor, config: Config) -> Tensor:
    return x.to(wide_dtype(config)).unflatten(-1, (config.stoch, config.classes))


def observe_step(
    params: Params, carry: Carry, tokens: Tensor, prev_action: Tensor, is_first: Tensor, uniform: Tensor, config: Config
) -> tuple[dict[str, Tensor], Tensor]:
    """One step with an observation of N rows. [RSSM-11] to [RSSM-16] [RSSM-26]

    carry of N rows, tokens [N, E], prev_action [N, A], is_first [N], uniform [N, S] -> (carry, logits [N, S, C]).
    """
    require_shape("is_first", is_first.shape, "N")
    N = len(is_first)
    _require_carry(carry, N, config)
    require_shape("tokens", tokens.shape, N, _token_size(params, config))
    require_shape("prev_action", prev_action.shape, N, _action_size(params))
    require_shape("uniform", uniform.shape, N, config.stoch)
    params, dtype = prepare(params, config), compute_dtype(config)
    first = is_first.bool()
    deter, stoch, action = (  # filled, not multiplied: what a reset drops may be NaN
        x.to(dtype).masked_fill(first.view(-1, *[1] * (x.ndim - 1)), 0)
        for x in (carry["deter"], carry["stoch"], prev_action)
    )
    deter = core(params, deter, stoch, action, config)
    logits = posterior(params, deter, tokens, config)
    log_probs = unimix_log_probs(logits, config.latent_unimix)
    stoch = straight_through(log_probs, categorical_sample(log_probs, uniform))
    return {"deter": deter, "stoch": stoch.to(dtype)}, logits


def observe(
    params: Params, carry: Carry, tokens: Tensor, prev_action: Tensor, is_first: Tensor, uniform: Tensor, config: Config
) -> dict[str, Tensor]:
    """`observe_step` along T steps. [RSSM-11] to [RSSM-19] [RSSM-23] [RSSM-26]

    carry of B rows, tokens [B, T, E], prev_action [B, T, A], is_first [B, T], uniform [B, T, S] ->
    {"deter" [B, T, D], "stoch" [B, T, S, C], "logits" [B, T, S, C]}.
    """
    require_shape("is_first", is_first.shape, "B", "T")
    B, T = is_first.shape
    require_shape("tokens", tokens.shape, B, T, _token_size(params, config))
    require_shape("prev_action", prev_action.shape, B, T, _action_size(params))
    require_shape("uniform", uniform.shape, B, T, config.stoch)
    _require_carry(carry, B, config)
    params, dtype, epsilon = prepare(params, config), compute_dtype(config), config.norm_epsilon

    # What does not depend on the recurrent state leaves the loop: T * B rows at once in place of T products of B rows.
    # It is the action's embedding with its share of rssm/hidden, and the tokens' share of the posterior's first layer:
    # a product with a concatenation is the sum of the products with its parts, [u, a] @ W = u @ W_u + a @ W_a.
    first = is_first.bool().t()  # [T, B]: the loop has time first, so that a step is contiguous
    action = prev_action.to(dtype).transpose(0, 1).masked_fill(first.unsqueeze(-1), 0)  # [T, B, A]
    action = dense(params, "rssm/embed_action", _bounded(action), epsilon)  # [T, B, d]
    shared, shared_action = params[SHARED].split([2 * config.units, config.units])  # [2d, D], [d, D]
    action_drive = linear(action, shared_action, params["rssm/hidden/bias"])  # [T, B, D]
    post_deter, post_tokens = params["rssm/posterior/hidden0/kernel"].split([config.deter, tokens.shape[-1]])
    token_drive = linear(tokens.to(dtype).transpose(0, 1), post_tokens, params["rssm/posterior/hidden0/bias"])

    weights = ScanWeights(
        embed_deter=params["rssm/embed_deter/kernel"],
        embed_stoch=params["rssm/embed_stoch/kernel"],
        embed_bias=torch.stack([params["rssm/embed_deter/bias"], params["rssm/embed_stoch/bias"]]),
        embed_scale=torch.stack([params["rssm/embed_deter/scale"], params["rssm/embed_stoch/scale"]]),
        shared=shared,
        block=params[BLOCK],
        hidden_scale=params["rssm/hidden/scale"],
        gru=params["rssm/gru/kernel"],
        gru_bias=params["rssm/gru/bias"],
        out=params["rssm/posterior/out/kernel"],
        out_bias=params["rssm/posterior/out/bias"],
        post_deter=post_deter,
        post_scale=params["rssm/posterior/hidden0/scale"],
        deeper=tuple(_layer(params, f"rssm/posterior/hidden{layer}") for layer in range(1, config.posterior_layers)),
    )
    start = torch.cat([carry["deter"], carry["stoch"].flatten(1)], -1).to(dtype).detach()  # [B, D + S*C]
    options = ScanOptions(config.stoch, epsilon, config.latent_unimix)
    features, logits = scan(options, start, first, uniform.transpose(0, 1), action_drive, token_drive, weights)
    deter, stoch = features.transpose(0, 1).split([config.deter, config.stoch * config.classes], -1)
    return {"deter": deter, "stoch": stoch.unflatten(-1, (config.stoch, -1)), "logits": logits.transpose(0, 1)}


def _layer(params: Params, name: str) -> tuple[Tensor, Tensor, Tensor]:
    return params[f"{name}/kernel"], params[f"{name}/bias"], params[f"{name}/scale"]


@torch.no_grad()
def imagine(params: Params, carry: Carry, policy: Policy, uniform: Tensor, config: Config) -> dict[str, Tensor]:
    """H steps without observations, all constants. [RSSM-20] [RSSM-21] [RSSM-22] [RSSM-25]

    carry of N rows, policy(feature [N, F], t) -> action [N, A], uniform [N, H, S] ->
    {"deter" [N, H+1, D], "stoch" [N, H+1, S, C], "action" [N, H, A]}.
    """
    features, actions = imagine_features(params, carry, policy, uniform, config)
    deter, stoch = torch.stack(features, 1).split([config.deter, config.stoch * config.classes], -1)
    return {"deter": deter, "stoch": stoch.unflatten(-1, (config.stoch, -1)), "action": torch.stack(actions, 1)}


@torch.no_grad()
def imagine_features(
    params: Params, carry: Carry, policy: Policy, uniform: Tensor, config: Config
) -> tuple[list[Tensor], list[Tensor]]:
    """`imagine` as lists over time: H+1 features [N, F], which is what the heads read, and H actions [N, A]."""
    require_shape("uniform", uniform.shape, "N", "H", config.stoch)
    N, H, _ = uniform.shape
    _require_carry(carry, N, config)
    params, dtype = prepare(params, config), compute_dtype(config)
    deter, stoch = carry["deter"].to(dtype), carry["stoch"].to(dtype)
    features, actions = [torch.cat([deter, stoch.flatten(1)], -1)], []
    for t in range(H):
        actions.append(policy(features[t], t))  # [N, F] -> [N, A]
        deter = core(params, deter, stoch, actions[t], config)  # [N, D]
        probs = unimix_probs(prior(params, deter, config), config.latent_unimix)  # [N, S, C]
        stoch = sample_onehot(probs, uniform[:, t]).to(dtype)  # not straight-through: nothing here has a gradient
        features.append(torch.cat([deter, stoch.flatten(1)], -1))
    return features, actions


def _require_carry(carry: Carry, rows: int, config: Config) -> None:
    require_shape("carry['deter']", carry["deter"].shape, rows, config.deter)
    require_shape("carry['stoch']", carry["stoch"].shape, rows, config.stoch, config.classes)
