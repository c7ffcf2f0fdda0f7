"""TorchRL: the components of its DreamerV3: transforms, RSSM, KL losses, returns, actor and critic losses, optimizer,
update ratio.

Written for torchrl 0.14.1. TorchRL computes norms, returns and moments in float32: check it with `--dtype float32`.
Latents are flat there, and rows of linear layers are outputs. `torchrl_losses` holds what its loss modules compute.
Where a rollout samples, `torch.rand` hands out the given noise. What no public function gives (the uniform mixture,
sampling, single layers, the returns along a replayed sequence) is taken from the functions that TorchRL's own modules
call.
"""

import warnings
from unittest import mock

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl import __version__
from torchrl.modules import RSSMPosteriorV3, RSSMPriorV3, RSSMRolloutV3, SymExpTwoHot
from torchrl.modules.functional import symexp, symlog
from torchrl.modules.models import model_based
from torchrl.modules.value_norm import PercentileValueNorm
from torchrl.objectives import categorical_kl_terms, dreamer_v3
from torchrl.objectives import two_hot_cross_entropy as symexp_twohot_loss
from torchrl.objectives import two_hot_decode as symexp_twohot_mean
from torchrl.objectives import two_hot_encode as twohot
from torchrl.trainers.algorithms.dreamer_v3 import DreamerV3Optimizer, DreamerV3UpdateRatio

from conformance.examples.torchrl_losses import (
    actor_loss,
    critic_loss,
    cumulative_weights,
    lambda_return,
    replay_critic_loss,
    update_slow_critic,
)

__all__ = [
    "__version__",
    "actor_loss",
    "critic_loss",
    "cumulative_weights",
    "lambda_return",
    "replay_critic_loss",
    "symexp",
    "symexp_twohot_loss",
    "symexp_twohot_mean",
    "symlog",
    "twohot",
    "update_slow_critic",
]  # offered as they are


def setup(dtype):
    warnings.filterwarnings("ignore", category=UserWarning, module="torchrl")


def convert(array):
    tensor = torch.as_tensor(array)
    return tensor.float() if tensor.is_floating_point() else tensor


def exponential_bins(bins):
    return SymExpTwoHot(bins).bins


def unimix_log_probs(logits, unimix):
    return model_based._unimix_probs(logits, unimix).log()


def categorical_sample(log_probs, uniform):
    return model_based._straight_through_categorical(log_probs, uniform=uniform)


def draw_categorical(logits, unimix, seed, n):
    torch.manual_seed(seed)
    return model_based._straight_through_categorical(logits.expand(n, *logits.shape), unimix)


def block_linear(x, kernel, bias):
    return model_based._dreamer_v3_block_linear(x, kernel, bias)


def linear(x, kernel, bias):
    return model_based._dreamer_v3_linear(x, kernel.mT, bias)


def rms_norm(x, scale, epsilon):
    return model_based._dreamer_v3_rms_norm(x, scale, epsilon)


def dense_state(params, name):
    return [
        {"weight": params[f"{name}/kernel"].mT, "bias": params[f"{name}/bias"]},
        {"weight": params[f"{name}/scale"]},
        {},
    ]


def head_state(params, name, layers):
    parts = [part for layer in range(layers) for part in dense_state(params, f"{name}/hidden{layer}")]
    return numbered([*parts, {"weight": params[f"{name}/out/kernel"].mT, "bias": params[f"{name}/out/bias"]}])


def numbered(parts):
    return {f"{index}.{key}": value for index, part in enumerate(parts) for key, value in part.items()}


def sizes(config):
    latents = {"num_categoricals": config.stoch, "num_classes": config.classes, "unimix": config.latent_unimix}
    return {**latents, "hidden_dim": config.units, "rnn_hidden_dim": config.deter, "norm_eps": config.norm_epsilon}


def prior_network(params, config):
    kind = {"recurrent_model": "block_gru", "num_blocks": config.blocks, "prior_num_layers": config.prior_layers}
    network = RSSMPriorV3(action_dim=len(params["rssm/embed_action/kernel"]), **kind, **sizes(config))
    network.rnn_to_prior_projector.load_state_dict(head_state(params, "rssm/prior", config.prior_layers))
    for part, name in (("belief", "embed_deter"), ("state", "embed_stoch"), ("action", "embed_action")):
        getattr(network.rnn, f"{part}_projection").load_state_dict(numbered(dense_state(params, f"rssm/{name}")))
    hidden = {
        "0.weight": params["rssm/hidden/kernel"],
        "0.bias": params["rssm/hidden/bias"],
        "1.weight": params["rssm/hidden/scale"],
    }
    network.rnn.hidden_layers.load_state_dict(hidden)
    network.rnn.gates.load_state_dict({"weight": params["rssm/gru/kernel"], "bias": params["rssm/gru/bias"]})
    return network


def posterior_network(params, config):
    tokens = len(params["rssm/posterior/hidden0/kernel"]) - config.deter
    network = RSSMPosteriorV3(
        obs_embed_dim=tokens, use_rms_norm=True, num_layers=config.posterior_layers, **sizes(config)
    )
    network.obs_rnn_to_post_projector.load_state_dict(head_state(params, "rssm/posterior", config.posterior_layers))
    return network


def core(params, deter, stoch, action, config):
    return prior_network(params, config).rnn(stoch.flatten(-2), deter, action)


def prior(params, deter, config):
    return prior_network(params, config).rnn_to_prior_projector(deter)


def posterior(params, deter, tokens, config):
    return posterior_network(params, config)(deter, tokens)[0]


def observe(params, carry, tokens, prev_action, is_first, uniform, config):
    following = ("next", "prior_logits"), ("next", "state"), ("next", "belief")
    rollout = RSSMRolloutV3(
        TensorDictModule(prior_network(params, config), in_keys=["state", "belief", "action"], out_keys=[*following]),
        TensorDictModule(
            posterior_network(params, config),
            in_keys=[("next", "belief"), ("next", "encoded_latents")],
            out_keys=[("next", "posterior_logits"), ("next", "state")],
        ),
    )
    rows, steps = is_first.shape
    start = {"state": carry["stoch"].flatten(-2), "belief": carry["deter"]}
    first = {key: torch.cat([x[:, None], x.new_zeros(rows, steps - 1, x.shape[-1])], 1) for key, x in start.items()}
    data = TensorDict(
        {**first, "action": prev_action, "is_init": is_first[..., None], "next": {"encoded_latents": tokens}},
        [rows, steps],
    )
    noise = uniform.transpose(0, 1)[:, None].expand(-1, 2, -1, -1)
    with mock.patch.object(torch, "rand", return_value=noise):
        result = rollout(data)["next"]
    return {"deter": result["belief"], "stoch": result["state"], "logits": result["posterior_logits"]}


def imagine(params, carry, action, uniform, config):
    network = prior_network(params, config)
    deters, stochs = [carry["deter"]], [carry["stoch"].flatten(-2)]
    for t in range(action.shape[1]):
        _, stoch, deter = network(stochs[-1], deters[-1], action[:, t], _uniform=uniform[:, t])
        deters.append(deter)
        stochs.append(stoch)
    return {
        "deter": torch.stack(deters, 1),
        "stoch": torch.stack(stochs, 1).unflatten(-1, (config.stoch, config.classes)),
        "action": action,
    }


def kl_losses(posterior_logits, prior_logits, config):
    def one(posterior_logits, prior_logits):
        return categorical_kl_terms(posterior_logits, prior_logits, config.free_nats, config.latent_unimix)

    rows = posterior_logits.shape[:-2]
    dynamics, representation = torch.vmap(one)(
        *(x.reshape(-1, *x.shape[-2:]) for x in (posterior_logits, prior_logits))
    )
    return dynamics.reshape(rows), representation.reshape(rows)


def replay_lambda_return(reward, is_last, is_terminal, annotation, discount, lambda_):
    horizon = 1 / (1 - discount) if discount < 1 else float("inf")
    return dreamer_v3._replay_value_target(reward, is_last.bool(), is_terminal.bool(), annotation, horizon, lambda_)


def percentile_norm(low, high, **options):
    norm = PercentileValueNorm(**options)
    norm.low.fill_(low)
    norm.high.fill_(high)
    return norm


def percentile(values, q):
    share = q / 100
    norm = percentile_norm(0, 0, quantiles=(0.0, share) if share else (0.0, 1.0), rate=1.0)
    norm.update(values.reshape(-1, 1))
    return (norm.high if share else norm.low)[0]


def update_return_range(low, high, returns, config):
    quantiles = config.return_percentile_low / 100, config.return_percentile_high / 100
    norm = percentile_norm(low, high, quantiles=quantiles, rate=1 - config.return_decay)
    norm.update(returns[..., None])
    return norm.low[0], norm.high[0]


def return_scale(low, high, limit):
    return percentile_norm(low, high, min_scale=limit).scale()[0]


def updated(params, gradients, second_moments, momenta, step, **options):
    """Tensors after one update, and their moments, in the same order."""
    leaves = [nn.Parameter(x.clone()) for x in params]
    optimizer = DreamerV3Optimizer(leaves, **options)
    optimizer.param_groups[0]["step"] = step
    for leaf, gradient, second_moment, momentum in zip(leaves, gradients, second_moments, momenta, strict=True):
        leaf.grad = gradient
        optimizer.state[leaf] = {"rms": second_moment.clone(), "momentum": momentum.clone()}
    optimizer.step()
    moments = [optimizer.state[leaf] for leaf in leaves]
    return leaves, [state["rms"] for state in moments], [state["momentum"] for state in moments]


def moment_options(config):
    return {"beta1": config.beta1, "beta2": config.beta2, "eps": config.laprop_epsilon}


def laprop(gradient, second_moment, momentum, step, config):
    start = torch.zeros_like(gradient)
    rates = {"lr": 1.0, "warmup_steps": 0, "agc": 0.0}
    (moved,), (second,), (first,) = updated(
        [start], [gradient], [second_moment], [momentum], step, **rates, **moment_options(config)
    )
    return -moved, second, first


def learning_rate(step, config):
    one, zero = torch.ones(1), torch.zeros(1)
    options = {"lr": config.learning_rate, "warmup_steps": config.warmup_steps, "agc": 0.0, "beta1": 0.0, "beta2": 0.0}
    return -updated([zero], [one], [zero], [zero], step, **options)[0][0][0]


def optimizer_step(params, gradients, state, config):
    for mapping in (gradients, state["second_moment"], state["momentum"]):
        if set(mapping) != set(params):
            raise ValueError("the names are not those of params")
    by_name = [
        [mapping[name] for name in params] for mapping in (params, gradients, state["second_moment"], state["momentum"])
    ]
    clipping = {"agc": config.agc_clip, "parameter_norm_min": config.agc_epsilon}
    rates = {"lr": config.learning_rate, "warmup_steps": config.warmup_steps}
    new = updated(*by_name, state["step"], **clipping, **rates, **moment_options(config))
    new_params, second_moments, momenta = (dict(zip(params, tensors, strict=True)) for tensors in new)
    return new_params, {"step": state["step"] + 1, "second_moment": second_moments, "momentum": momenta}


class ReplayRatio(DreamerV3UpdateRatio):
    """TorchRL's ratio is that of updates to steps."""

    def __init__(self, replay_ratio, batch_steps):
        super().__init__(replay_ratio / batch_steps)
