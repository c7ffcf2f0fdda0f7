"""NM512/r2dreamer in its configuration `rep_loss: dreamer`: DreamerV3 after the Nature paper, in PyTorch.

Their repository is no package: its folder has to be on the path. Their code computes losses in float32, and has a last
axis of length 1. Where an agent has both real and discrete actions, log-probabilities and entropies are added up.

`r2dreamer_networks` has their options, and our parameters in the order of theirs; `r2dreamer_agent` the whole agent,
and `r2dreamer_behavior` what they write inside of its training step. A whole step says in every edition that it is not
implemented: its continue target is not discounted, and the continue of the start is predicted.

Not offered: samples from given noise, since they draw with the generator of PyTorch; their buffer, which is TorchRL's.
"""

import os
import subprocess
from types import SimpleNamespace as Namespace

import distributions
import dreamer
import networks
import rssm
import torch
from distributions import symexp, symlog  # noqa: F401 - offered here
from optim import LaProp, clip_grad_agc_
from r2dreamer_agent import (  # noqa: F401 - some are offered here
    agent_of,
    fill,
    gradients_given,
    handing_out,
    laprop_state,
    latents_first,
    losses_given,
    ours,
    placed,
    train_step_given,
)
from r2dreamer_behavior import (  # noqa: F401 - offered here
    actor_loss,
    critic_loss,
    cumulative_weights,
    replay_critic_loss,
)
from r2dreamer_layers import (  # noqa: F401 - some are offered here
    block_linear,
    convolution,
    dense,
    linear,
    max_pool,
    mlp,
    rms_norm,
    run,
    silu,
    upsample,
)
from r2dreamer_networks import (
    Actor,
    Options,
    actor_of,
    decoded,
    decoder_of,
    decoder_options,
    encoded,
    encoded_one,
    encoded_size,
    encoder_of,
    encoder_options,
    head_of,
    mlp_options,
    policy_of,
    require_theirs,
    rssm_of,
    rssm_options,
    shapes_of,
    split,
    table_of,
    with_epsilon,
)
from torch import nn

_FOLDER = os.path.dirname(dreamer.__file__)
__version__ = subprocess.run(
    ["git", "-C", _FOLDER, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
).stdout.strip()


def convert(array):
    tensor = torch.as_tensor(array)
    return tensor.float() if tensor.is_floating_point() else tensor


# transforms and distributions


def exponential_bins(bins):
    return distributions.symexp_twohot(torch.zeros(bins), bins).bins


def ordered_expectation(probs, bins):
    twohot = distributions.TwoHot(torch.zeros_like(probs), bins)
    twohot.probs = probs
    return twohot.mode()[..., 0]


def symexp_twohot_loss(logits, target, bins):
    return -distributions.TwoHot(logits, bins).log_prob(torch.as_tensor(target).float()[..., None])


def symexp_twohot_mean(logits, bins):
    return distributions.TwoHot(logits, bins).mode()[..., 0]


def unimix_log_probs(logits, unimix):
    return distributions.onehot(logits, unimix).logits


def categorical_log_prob(log_probs, onehot):
    return distributions.onehot(log_probs, 0.0).log_prob(torch.as_tensor(onehot).float())


def categorical_entropy(log_probs):
    return distributions.onehot(log_probs, 0.0).entropy()


def categorical_kl(log_probs_p, log_probs_q):
    return distributions.kl(log_probs_p, log_probs_q)


def bernoulli_loss(logit, target):
    return -distributions.binary(logit[..., None]).log_prob(torch.as_tensor(target)[..., None])


def bernoulli_mean(logit):
    return distributions.binary(logit[..., None]).mean[..., 0]


def bounded_normal(mean, std, min_std, max_std):
    normal = distributions.bounded_normal(torch.stack([mean, std], -1), min_std, max_std).base_dist
    return normal.loc[..., 0], normal.scale[..., 0]


def elementwise(distribution, prediction, target):
    return -distribution(prediction.reshape(-1, 1, 1)).log_prob(target.reshape(-1, 1, 1)).reshape(prediction.shape)


def mse_loss(prediction, target):
    return elementwise(distributions.mse, prediction, target)


def symlog_mse_loss(prediction, target, scale):
    return scale * elementwise(distributions.symlog_mse, prediction, target)


def draw_categorical(logits, unimix, seed, n):
    torch.manual_seed(seed)
    return distributions.onehot(logits.expand(n, *logits.shape), unimix).rsample()


# rssm


def rssm_with(params, config):
    tokens = len(params["rssm/posterior/hidden0/kernel"]) - config.deter
    actions = len(params["rssm/embed_action/kernel"])
    module = with_epsilon(rssm.RSSM(rssm_options(config), tokens, actions), config)
    fill(zip(module.parameters(), rssm_of(params, config), strict=True))
    return module


def core(params, deter, stoch, action, config):
    rows = deter.shape[:-1]
    stoch, deter, action = (x.reshape(-1, *x.shape[len(rows) :]) for x in (stoch, deter, action))
    return rssm_with(params, config)._deter_net(stoch, deter, action).reshape(*rows, -1)


def prior(params, deter, config):
    return rssm_with(params, config).prior(deter)[1]


def posterior(params, deter, tokens, config):
    return rssm_with(params, config)._obs_net(torch.cat([deter, tokens], -1))


def observe_given(params, carry, tokens, prev_action, is_first, stoch, config):
    module = rssm_with(params, config)
    module.get_dist = handing_out(module, stoch)
    carry = carry["stoch"].float(), carry["deter"].float()
    _, deter, logits = module.observe(tokens, prev_action.float(), carry, is_first.bool()[..., None])
    return {"deter": deter, "posterior": logits, "prior": module.prior(deter)[1]}


def imagine_given(params, carry, action, stoch, config):
    module, logits = rssm_with(params, config), []
    module.get_dist = handing_out(module, stoch, logits)
    _, deter = module.imagine_with_action(carry["stoch"].float(), carry["deter"].float(), action.float())
    return {"deter": torch.cat([carry["deter"][:, None], deter], 1), "prior": torch.stack(logits, 1)}


# networks


def encoder(params, observation, spaces, config):
    require_theirs(spaces, config)
    vectors, images = split(spaces)
    module = with_epsilon(networks.MultiEncoder(encoder_options(config), shapes_of(spaces)), config)
    tokens = run(module, encoder_of(params, spaces, config), encoded(observation, spaces))
    image, vector = tokens.tensor_split([tokens.shape[-1] - bool(vectors) * config.units], -1)
    if images:
        halvings, space = len(config.cnn_multipliers), spaces.observations[images[0]]
        maps = image.unflatten(-1, (-1, space.height >> halvings, space.width >> halvings))
        image = maps.movedim(-3, -1).flatten(-3)
    return torch.cat([vector, image], -1)


def decoder(params, feature, spaces, config):
    require_theirs(spaces, config)
    flat = config.stoch * config.classes
    module = networks.MultiDecoder(decoder_options(config), config.deter, flat, shapes_of(spaces))
    fill(zip(module.parameters(), decoder_of(params, spaces, config, latents_first(config)), strict=True))
    deter, stoch = feature.tensor_split([config.deter], -1)
    return with_epsilon(module, config)(stoch, deter)


def head(params, name, feature, layers, outputs, config):
    options = mlp_options("head", layers, config, shape=(outputs,), dist=Options(name="identity"))
    module = with_epsilon(networks.MLPHead(options, feature.shape[-1]), config)
    return run(module, head_of(params, name, layers), feature)


def reward_head(params, feature, config):
    return head(params, "reward", feature, config.reward_layers, config.bins, config)


def continue_head(params, feature, config):
    return head(params, "continue", feature, config.continue_layers, 1, config)[..., 0]


def critic(params, feature, config):
    return head(params, "critic", feature, config.critic_layers, config.bins, config)


def actor(params, feature, spaces, config):
    module = with_epsilon(Actor(spaces, config, feature.shape[-1]), config)
    fill(zip(module.parameters(), actor_of(params, spaces, config), strict=True))
    outputs = {}
    for (key, space), part in zip(sorted(spaces.actions.items()), module.heads, strict=True):
        raw = part.last(part.mlp(feature))
        names = ("logits",) if hasattr(space, "classes") else ("mean", "std")
        outputs[key] = dict(zip(names, raw.chunk(len(names), -1), strict=True))
    return outputs


# world model and returns


def kl_losses(posterior_logits, prior_logits, config):
    return rssm.RSSM.kl_loss(None, posterior_logits, prior_logits, config.free_nats)


def reconstruction_losses(predictions, observations, spaces, config):
    losses = {}
    for key, space in spaces.observations.items():
        target, scale = encoded_one(observations[key], space), config.vector_loss_scale if hasattr(space, "size") else 1
        rows = target.shape[: -3 if hasattr(space, "channels") else -1]
        prediction, target = (x.reshape(1, -1, *x.shape[len(rows) :]) for x in (predictions[key], target))
        losses[key] = -scale * decoded(prediction, space).log_prob(target).reshape(rows)
    return losses


def lambda_return(reward, continue_, value, discount, lambda_):
    return dreamer.Dreamer._lambda_return(
        None, torch.zeros_like(continue_), 1 - continue_, reward, value, value, discount, lambda_
    )


def replay_lambda_return(reward, is_last, is_terminal, annotation, discount, lambda_):
    last, terminal = is_last.float(), is_terminal.float()
    return dreamer.Dreamer._lambda_return(None, last, terminal, reward, annotation, annotation, discount, lambda_)


def percentile(values, q):
    moving = networks.ReturnEMA("cpu", alpha=1.0)
    moving.range = torch.tensor([q / 100, q / 100])
    return moving(values)[0]


def update_return_range(low, high, returns, config):
    moving = networks.ReturnEMA("cpu", alpha=1 - config.return_decay)
    moving.ema_vals.copy_(torch.tensor([low, high]))
    moving.range = torch.tensor([config.return_percentile_low, config.return_percentile_high]) / 100
    moving(returns)
    return tuple(moving.ema_vals)


def return_scale(low, high, limit):
    """In units of the limit, which is 1 there."""
    moving = networks.ReturnEMA("cpu", alpha=0.0)
    moving.ema_vals.copy_(torch.tensor([float(low), float(high)]) / limit)
    return limit * moving(torch.zeros(2))[1]


# behavior and optimizer


def policies(outputs, spaces, config):
    """The distribution of the actions of every key, and their size."""
    for key, space in sorted(spaces.actions.items()):
        raw = outputs[key]
        output = raw["logits"] if "logits" in raw else torch.cat([raw["mean"], raw["std"]], -1)
        yield policy_of(output, space, config), encoded_size(space)


def action_log_prob(outputs, action, spaces, config):
    every = list(policies(outputs, spaces, config))
    parts = action.detach().float().split([size for _, size in every], -1)  # as their training step hands it
    return sum(one.log_prob(part) for (one, _), part in zip(every, parts, strict=True))


def action_entropy(outputs, spaces, config):
    return sum(one.entropy() for one, _ in policies(outputs, spaces, config))


def draw_actions(outputs, spaces, config, seed, n):
    torch.manual_seed(seed)
    many = {key: {name: value.expand(n, -1) for name, value in raw.items()} for key, raw in outputs.items()}
    return torch.cat([one.rsample() for one, _ in policies(many, spaces, config)], -1)


def update_slow_critic(slow, critic, decay):
    updated = {name: value.clone() for name, value in slow.items()}
    theirs = Namespace(
        value=Namespace(parameters=lambda: [critic[name] for name in slow]),
        _slow_value=Namespace(parameters=updated.values),
        **{"_slow_value_updates": 0, "slow_target_update": 1, "slow_target_fraction": 1 - decay},
    )
    dreamer.Dreamer._update_slow_target(theirs)
    return updated


def adaptive_gradient_clip(gradient, parameter, clip, epsilon):
    leaf = nn.Parameter(parameter)
    leaf.grad = gradient.clone()
    clip_grad_agc_([leaf], clip, epsilon, foreach=True)
    return leaf.grad


def learning_rate(step, config):
    agent = agent_of(Namespace(observations={"x": VECTOR}, actions={"a": VECTOR}), config)
    return config.learning_rate * agent._scheduler.lr_lambdas[0](step)


VECTOR = Namespace(size=1)


def stepped(params, gradients, second_moment, momentum, step, rate, clip, config):
    """Parameters and moments after one step, as their `update` makes it."""
    leaves = {name: nn.Parameter(value.clone()) for name, value in params.items()}
    options = {"lr": rate, "betas": (config.beta1, config.beta2), "eps": config.laprop_epsilon}
    optimizer = LaProp(leaves.values(), **options)
    for name, leaf in leaves.items():
        leaf.grad = gradients[name].clone()
        optimizer.state[leaf] = laprop_state(second_moment[name], momentum[name], step, rate, config)
    if clip:
        clip_grad_agc_(leaves.values(), config.agc_clip, config.agc_epsilon, foreach=True)
    optimizer.step()
    moments = {name: optimizer.state[leaf] for name, leaf in leaves.items()}
    second_moment = {name: state["exp_avg_sq"] for name, state in moments.items()}
    return leaves, second_moment, {name: state["exp_avg"] / rate for name, state in moments.items()}


def laprop(gradient, second_moment, momentum, step, config):
    given = ({"x": x} for x in (torch.zeros_like(gradient), gradient, second_moment, momentum))
    moved, second, first = stepped(*given, step, 1.0, False, config)
    return -moved["x"], second["x"], first["x"]


def optimizer_step(params, gradients, state, config):
    step = state["step"]
    rate = learning_rate(step, config)
    new, second, momentum = stepped(
        params, gradients, state["second_moment"], state["momentum"], step, rate, True, config
    )
    return new, {"step": step + 1, "second_moment": second, "momentum": momentum}


def draw_parameters(spaces, config, seed):
    torch.manual_seed(seed)
    agent = agent_of(spaces, config)
    table = {name: torch.empty(shape) for name, shape in table_of(spaces, config).items()}
    return ours(lambda indices: placed(agent, indices, spaces, config), table, lambda parameter: parameter)
