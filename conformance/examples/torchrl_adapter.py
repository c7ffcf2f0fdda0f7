"""TorchRL: the components of its DreamerV3: transforms, RSSM, KL losses, returns, actor and critic losses, optimizer, update ratio.

Written for torchrl 0.14.1. TorchRL computes norms, returns and moments in float32: check it with `--dtype float32`. Latents are flat there,
rows of linear layers are outputs, and its loss modules work on TensorDicts: the modules that they call are replaced by ones that hand out
given numbers. Where it samples, `torch.rand` hands out the given noise. What no public function gives (the uniform mixture, sampling,
single layers) is taken from the functions that its own modules call.
"""

from unittest import mock

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl import __version__
from torchrl.modules import RSSMPosteriorV3, RSSMPriorV3, RSSMRolloutV3, SymExpTwoHot
from torchrl.modules.functional import symexp, symlog
from torchrl.modules.models import model_based
from torchrl.modules.value_norm import PercentileValueNorm
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3ValueLoss, SoftUpdate, ValueEstimators, categorical_kl_terms, dreamer_v3
from torchrl.objectives import two_hot_cross_entropy as symexp_twohot_loss
from torchrl.objectives import two_hot_decode as symexp_twohot_mean
from torchrl.objectives import two_hot_encode as twohot
from torchrl.trainers.algorithms.dreamer_v3 import DreamerV3Optimizer, DreamerV3UpdateRatio

__all__ = ["__version__", "symexp", "symexp_twohot_loss", "symexp_twohot_mean", "symlog", "twohot"]


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


# Networks: what they hold, loaded by name.


def dense_state(params, name):
    return [{"weight": params[f"{name}/kernel"].mT, "bias": params[f"{name}/bias"]}, {"weight": params[f"{name}/scale"]}, {}]


def head_state(params, name, layers):
    parts = [part for layer in range(layers) for part in dense_state(params, f"{name}/hidden{layer}")]
    return numbered([*parts, {"weight": params[f"{name}/out/kernel"].mT, "bias": params[f"{name}/out/bias"]}])


def numbered(parts):
    return {f"{index}.{key}": value for index, part in enumerate(parts) for key, value in part.items()}


def prior_network(params, config):
    actions = params["rssm/embed_action/kernel"].shape[0]
    sizes = {"num_categoricals": config.stoch, "num_classes": config.classes, "hidden_dim": config.units, "rnn_hidden_dim": config.deter}
    depth = {"num_blocks": config.blocks, "prior_num_layers": config.prior_layers}
    network = RSSMPriorV3(
        action_dim=actions, recurrent_model="block_gru", norm_eps=config.norm_epsilon, unimix=config.latent_unimix, **sizes, **depth
    )
    network.rnn_to_prior_projector.load_state_dict(head_state(params, "rssm/prior", config.prior_layers))
    for part, name in (("belief", "embed_deter"), ("state", "embed_stoch"), ("action", "embed_action")):
        getattr(network.rnn, f"{part}_projection").load_state_dict(numbered(dense_state(params, f"rssm/{name}")))
    hidden = {"0.weight": params["rssm/hidden/kernel"], "0.bias": params["rssm/hidden/bias"], "1.weight": params["rssm/hidden/scale"]}
    network.rnn.hidden_layers.load_state_dict(hidden)
    network.rnn.gates.load_state_dict({"weight": params["rssm/gru/kernel"], "bias": params["rssm/gru/bias"]})
    return network


def posterior_network(params, config):
    tokens = params["rssm/posterior/hidden0/kernel"].shape[0] - config.deter
    sizes = {"num_categoricals": config.stoch, "num_classes": config.classes, "hidden_dim": config.units, "rnn_hidden_dim": config.deter}
    network = RSSMPosteriorV3(
        obs_embed_dim=tokens, use_rms_norm=True, num_layers=config.posterior_layers, norm_eps=config.norm_epsilon, unimix=config.latent_unimix, **sizes
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
            in_keys=[("next", "belief"), ("next", "encoded")],
            out_keys=[("next", "posterior_logits"), ("next", "state")],
        ),
        reset_key="is_first",
    )
    rows, steps = is_first.shape
    start = {"state": carry["stoch"].flatten(-2), "belief": carry["deter"]}
    first = {key: torch.cat([x[:, None], x.new_zeros(rows, steps - 1, x.shape[-1])], 1) for key, x in start.items()}
    data = TensorDict({**first, "action": prev_action, "is_first": is_first[..., None], "next": {"encoded": tokens}}, [rows, steps])
    noise = uniform.transpose(0, 1)[:, None].expand(-1, 2, -1, -1)
    with mock.patch.object(torch, "rand", lambda *shape, **where: noise):
        result = rollout(data)["next"]
    return {"deter": result["belief"], "stoch": result["state"], "logits": result["posterior_logits"]}


def imagine(params, carry, action, uniform, config):
    network = prior_network(params, config)
    deters, stochs = [carry["deter"]], [carry["stoch"].flatten(-2)]
    for t in range(action.shape[1]):
        _, stoch, deter = network(stochs[-1], deters[-1], action[:, t], _uniform=uniform[:, t])
        deters.append(deter)
        stochs.append(stoch)
    return {"deter": torch.stack(deters, 1), "stoch": torch.stack(stochs, 1).unflatten(-1, (config.stoch, config.classes)), "action": action}


def kl_losses(posterior_logits, prior_logits, config):
    def one(posterior_logits, prior_logits):
        return categorical_kl_terms(posterior_logits, prior_logits, config.free_nats, config.latent_unimix)

    rows = posterior_logits.shape[:-2]
    dynamics, representation = torch.vmap(one)(*(x.reshape(-1, *x.shape[-2:]) for x in (posterior_logits, prior_logits)))
    return dynamics.reshape(rows), representation.reshape(rows)


# Returns and losses: an imagined state holds its own value, continuation, log-probability and entropy.


class Column(nn.Module):
    """Reads one number of a state."""

    def __init__(self, index):
        super().__init__()
        self.index = index

    def forward(self, state):
        return state[..., self.index, None]


class Policy(nn.Module):
    """An actor whose distribution has the log-probability and the entropy that the state holds."""

    in_keys = ("state",)

    def get_dist(self, data):
        dist = mock.Mock()
        dist.log_prob = lambda action: Column(2)(data["state"])
        dist.entropy = lambda: Column(3)(data["state"])
        return dist


class Dream(nn.Module):
    """A world model that has already dreamt: reset and rollout return what is given."""

    def __init__(self, data):
        super().__init__()
        self.data = data

    def reset(self, data):
        return data

    def rollout(self, **options):
        return self.data.clone()


def actor_loss_module(state, next_state, reward, discount, lambda_, **options):
    """The loss module and the data of one dream: state and next_state [N, H, 4], reward [N, H]."""
    data = TensorDict({"state": state, "belief": state, "action": state, "next": {"state": next_state, "belief": state, "reward": reward[..., None]}}, reward.shape)
    value, continuation = (TensorDictModule(Column(i), ["state"], [key]) for i, key in ((0, "state_value"), (1, "continuation")))
    loss = DreamerV3ActorLoss(Policy(), value, Dream(data), continuation_model=continuation, use_reinforce=True, **options)
    loss.make_value_estimator(ValueEstimators.TDLambda, gamma=discount, lmbda=lambda_)
    return loss, data


def dreamt(reward, continue_, value, discount, lambda_):
    state = torch.stack([value, continue_, torch.zeros_like(value), torch.zeros_like(value)], -1)
    loss, data = actor_loss_module(state[:, :-1], state[:, 1:], reward[:, 1:], discount, lambda_)
    return loss(data)[1]


def lambda_return(reward, continue_, value, discount, lambda_):
    return dreamt(reward, continue_, value, discount, lambda_)["lambda_target"][..., 0]


def cumulative_weights(continue_, discount):
    return dreamt(torch.zeros_like(continue_), continue_, torch.zeros_like(continue_), discount, 0.95)["discount_weight"][..., 0]


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    def one(log_prob, entropy, returns, value, weight):
        """Of a dream of one step whose reward is the return, after which nothing follows."""
        state = torch.stack([value, weight, log_prob, entropy], -1).reshape(1, 1, 4)
        module, data = actor_loss_module(state, torch.zeros(1, 1, 4), returns.reshape(1, 1), 1.0, 1.0, entropy_bonus=config.entropy_scale)
        module.eval()
        module.retnorm.high.fill_(scale)
        module.retnorm.min_scale = 0.0
        return module(data)[0]["loss_actor"]

    rows = (x.flatten() for x in (log_prob, entropy, returns, value, weight))
    return torch.stack([one(*numbers) for numbers in zip(*rows, strict=True)]).reshape(log_prob.shape)


class Given(nn.Module):
    """A critic that is its own output, or any tensors by name."""

    def __init__(self, **tensors):
        super().__init__()
        self.tensors = nn.ParameterDict(tensors)

    def forward(self, state):
        return self.tensors["logits"]


def value_loss_module(config, logits, slow_logits):
    network = TensorDictSequential(
        TensorDictModule(Given(logits=logits), ["state"], ["state_value_logits"]),
        TensorDictModule(SymExpTwoHot(config.bins), ["state_value_logits"], ["state_value"]),
    )
    loss = DreamerV3ValueLoss(
        network, "two_hot", num_value_bins=config.bins, slow_critic_regularization=config.slow_critic_scale, reduction="none"
    )
    loss.target_value_model_params["module", "0", "module", "tensors", "logits"].data.copy_(slow_logits)
    return loss


def critic_loss(logits, slow_logits, returns, weight, config):
    data = {"state": returns[..., None], "lambda_target": returns[..., None], "discount_weight": weight[..., None]}
    return value_loss_module(config, logits, slow_logits)(TensorDict(data, returns.shape))[0]["loss_value"]


def replay_critic_loss(logits, slow_logits, returns, is_last, config):
    """The return of a step is the reward of the next one, which is terminal."""
    longer = [torch.cat([x, x[:, -1:]], 1) for x in (logits, slow_logits)]
    reward, last = torch.cat([returns[:, :1], returns], 1)[..., None], torch.cat([is_last, is_last[:, :1]], 1).bool()[..., None]
    following = {"reward": reward, "done": last, "terminated": torch.ones_like(last)}
    data = TensorDict({"state": reward, "bootstrap": torch.zeros_like(reward), "next": following}, reward.shape[:2])
    return value_loss_module(config, *longer).replay_value_loss(data)["loss_replay_value"]


def update_slow_critic(slow, critic, decay):
    def held(tensors):
        return TensorDictModule(Given(**{name: x for name, x in tensors.items() if name.startswith("critic/")}), ["state"], ["state_value"])

    loss = DreamerV3ValueLoss(held(critic), slow_critic_regularization=1.0)
    targets = loss.target_value_model_params["module", "tensors"]
    for name, value in slow.items():
        targets[name].data.copy_(value)
    SoftUpdate(loss, eps=decay).step()
    return {name: targets[name] for name in slow}


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


# Optimizer and schedule.


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
    (moved,), (second,), (first,) = updated([start], [gradient], [second_moment], [momentum], step, **rates, **moment_options(config))
    return -moved, second, first


def learning_rate(step, config):
    one, zero = torch.ones(1), torch.zeros(1)
    options = {"lr": config.learning_rate, "warmup_steps": config.warmup_steps, "agc": 0.0, "beta1": 0.0, "beta2": 0.0}
    return -updated([zero], [one], [zero], [zero], step, **options)[0][0][0]


def optimizer_step(params, gradients, state, config):
    for mapping in (gradients, state["second_moment"], state["momentum"]):
        if set(mapping) != set(params):
            raise ValueError("the names are not those of params")
    by_name = [[mapping[name] for name in params] for mapping in (params, gradients, state["second_moment"], state["momentum"])]
    clipping = {"agc": config.agc_clip, "parameter_norm_min": config.agc_epsilon}
    rates = {"lr": config.learning_rate, "warmup_steps": config.warmup_steps}
    new = updated(*by_name, state["step"], **clipping, **rates, **moment_options(config))
    new_params, second_moments, momenta = (dict(zip(params, tensors, strict=True)) for tensors in new)
    return new_params, {"step": state["step"] + 1, "second_moment": second_moments, "momentum": momenta}


class ReplayRatio(DreamerV3UpdateRatio):
    """TorchRL's ratio is that of updates to steps."""

    def __init__(self, replay_ratio, batch_steps):
        super().__init__(replay_ratio / batch_steps)
