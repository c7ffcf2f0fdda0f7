"""The whole agent of r2dreamer in its configuration `rep_loss: dreamer`, with given parameters and given samples.

Their `Dreamer` is built as their program builds it. It computes in float32 here, where their program has float16 under
autocast; where it draws stand the given samples.
"""

import itertools
from contextlib import nullcontext
from types import SimpleNamespace as Namespace
from unittest import mock

import dreamer
import networks
import rssm
import torch
from r2dreamer_networks import (
    Actor,
    Decoder,
    Options,
    actor_of,
    decoder_of,
    decoder_options,
    encoded,
    encoded_size,
    encoder_of,
    encoder_options,
    head_of,
    mlp_options,
    require_theirs,
    rssm_of,
    rssm_options,
    shapes_of,
    split,
    token_rows,
    with_epsilon,
)
from tensordict import TensorDict
from torch import nn

LOSSES = {
    "dyn": "dynamics",
    "rep": "representation",
    "rew": "reward",
    "con": "continue",
    "policy": "actor",
    "value": "critic",
    "repval": "replay_critic",
}


def agent_of(spaces, config):
    """Their `Dreamer`, freshly initialized."""
    require_theirs(spaces, config)
    heads = {
        name: mlp_options(name, layers, config, shape=(size,), outscale=outscale, dist=Options(name=dist, bin_num=size))
        for name, layers, size, outscale, dist in (
            ("reward", config.reward_layers, config.bins, config.reward_outscale, "symexp_twohot"),
            ("cont", config.continue_layers, 1, 1.0, "binary"),
            ("critic", config.critic_layers, config.bins, config.critic_outscale, "symexp_twohot"),
        )
    }
    actor = mlp_options("actor", 1, config, dist=Options(cont=Options()))
    scales = {name: getattr(config, f"{ours}_scale") for name, ours in LOSSES.items()}
    options = Options(
        **heads, actor=actor, encoder=encoder_options(config), decoder=decoder_options(config),
        rssm=rssm_options(config), loss_scales={**scales, "recon": config.reconstruction_scale},
        device="cpu", rep_loss="dreamer", compile=False, log_grads=False, act_entropy=config.entropy_scale,
        kl_free=config.free_nats, imag_horizon=config.imagination_horizon, horizon=config.discount_horizon,
        lamb=config.return_lambda, slow_target_update=1, slow_target_fraction=1 - config.slow_critic_decay,
        lr=config.learning_rate, agc=config.agc_clip, pmin=config.agc_epsilon, eps=config.laprop_epsilon,
        beta1=config.beta1, beta2=config.beta2, warmup=config.warmup_steps,
    )  # fmt: skip
    observations = Namespace(spaces={key: Namespace(shape=shape) for key, shape in shapes_of(spaces).items()})
    actions = Namespace(shape=(sum(encoded_size(space) for space in spaces.actions.values()),))
    theirs = networks.MLPHead

    def head(options, inputs):
        return Actor(spaces, config, inputs) if options is actor else theirs(options, inputs)

    with (
        mock.patch.object(networks, "MLPHead", head),
        mock.patch.object(networks, "MultiDecoder", lambda *arguments: Decoder(spaces, *arguments)),
    ):
        agent = dreamer.Dreamer(options, observations, actions)
    agent.horizon = config.discount_horizon  # of which they take the whole part
    agent.return_ema.alpha = 1 - config.return_decay
    agent.return_ema.range = torch.tensor([config.return_percentile_low, config.return_percentile_high]) / 100
    for key in split(spaces)[0]:
        if not hasattr(spaces.observations[key], "classes"):
            agent._loss_scales[key] *= config.vector_loss_scale
    return with_epsilon(agent, config)


def placed(agent, params, spaces, config):
    """Pairs of a parameter of theirs and what of ours is in its place. Their model states begin with the latents."""
    modules = (
        (agent.encoder, encoder_of(params, spaces, config)),
        (agent.rssm, rssm_of(params, config, token_rows(spaces, config))),
        (agent.decoder, decoder_of(params, spaces, config, latents_first(config))),
        (agent.reward, head_of(params, "reward", config.reward_layers, latents_first(config))),
        (agent.cont, head_of(params, "continue", config.continue_layers, latents_first(config))),
        (agent.actor, actor_of(params, spaces, config, latents_first(config))),
        (agent.value, critic_of(params, config)),
    )
    for module, tensors in modules:
        yield from zip(module.parameters(), tensors, strict=True)


def latents_first(config):
    return lambda kernel: torch.cat([kernel[config.deter :], kernel[: config.deter]])


def critic_of(params, config):
    return head_of(params, "critic", config.critic_layers, latents_first(config))


def fill(pairs):
    with torch.no_grad():
        for parameter, tensor in pairs:
            assert parameter.shape == tensor.shape, (parameter.shape, tensor.shape)
            parameter.copy_(tensor)


def loaded(params, slow_critic, return_range, spaces, config):
    """The agent with these parameters, which its frozen copies share."""
    agent = agent_of(spaces, config)
    fill(placed(agent, params, spaces, config))
    fill(zip(agent._slow_value.parameters(), critic_of(slow_critic, config), strict=True))
    agent.return_ema.ema_vals.copy_(torch.tensor(return_range))
    return agent


def ours(pairs_of, params, values):
    """Numbers by our names, of numbers by their parameters.

    pairs_of: params -> pairs, as of `placed`; of indices in place of numbers it says where each number is. values:
    their parameter -> numbers.
    """
    ends = list(itertools.accumulate(x.numel() for x in params.values()))
    indices = {
        name: torch.arange(end - x.numel(), end).reshape(x.shape)
        for (name, x), end in zip(params.items(), ends, strict=True)
    }
    flat = torch.zeros(ends[-1])
    for parameter, index in pairs_of(indices):
        flat[index.flatten()] = values(parameter).detach().flatten()
    return {name: flat[index] for name, index in indices.items()}


class Given:
    """Stands in for a distribution: its samples are the given ones, and the gradient is that of the probabilities."""

    def __init__(self, distribution, samples):
        self.distribution, self.samples = distribution, samples
        self.entropy = distribution.entropy

    def rsample(self):
        probs = self.distribution.base_dist.probs
        return next(self.samples, torch.zeros_like(probs)) + (probs - probs.detach())


def handing_out(module, samples, logits=None):
    """In place of `get_dist` of their RSSM: distributions whose samples are the given ones. logits: a list that takes
    down what they were made of."""
    queue = steps(samples)

    def get_dist(logit):
        if logits is not None:
            logits.append(logit)
        return Given(rssm.RSSM.get_dist(module, logit), queue)

    return get_dist


def give(agent, samples):
    """Given samples in place of the agent's draws; no loss reads what comes after them."""
    agent.rssm.get_dist = handing_out(agent.rssm, samples["posterior"])
    agent._frozen_rssm.get_dist = handing_out(agent._frozen_rssm, samples["prior"])
    queue = itertools.chain(steps(samples["action"]), itertools.repeat(samples["action"][:, -1]))
    vars(agent)["_frozen_actor"] = lambda features: Namespace(rsample=lambda: next(queue))
    return agent


def steps(samples):
    return iter(samples.unbind(1))


def batch_of(batch, spaces, config):
    """A batch as their buffer gives it, and the latents before it."""
    numbers = {name: batch[name].float()[..., None] for name in ("reward", "is_first", "is_last", "is_terminal")}
    numbers["is_first"] = batch["is_first"].bool()[..., None]
    data = {**encoded(batch, spaces), **numbers, "action": batch["prev_action"].float()}
    context = nn.functional.one_hot(batch["stoch"].long(), config.classes).float(), batch["deter"].float()
    return TensorDict(data, batch["reward"].shape), context


def whole_pass(params, slow_critic, return_range, batch, samples, spaces, config):
    """The agent after `_cal_grad`, with its gradients, and the metrics."""
    agent = give(loaded(params, slow_critic, return_range, spaces, config), samples)
    _, metrics = agent._cal_grad(*batch_of(batch, spaces, config))
    return agent, metrics


def losses_of(agent, metrics, spaces, config):
    """The total and the losses by our names."""
    losses = {}
    for name, loss in metrics.items():
        kind, _, part = name.partition("/")
        if kind == "loss":
            space = spaces.observations.get(part)
            scale = config.vector_loss_scale if hasattr(space, "size") else 1.0
            losses[LOSSES.get(part, f"reconstruction/{part}")] = scale * loss
    return metrics["opt/loss"], {"losses": losses, "return_range": tuple(agent.return_ema.ema_vals)}


def losses_given(params, slow_critic, return_range, batch, samples, spaces, config):
    require_their_losses(config)
    agent, metrics = whole_pass(params, slow_critic, return_range, batch, samples, spaces, config)
    return losses_of(agent, metrics, spaces, config)


def gradients_given(params, slow_critic, return_range, batch, samples, spaces, config):
    require_their_losses(config)
    agent, _ = whole_pass(params, slow_critic, return_range, batch, samples, spaces, config)
    return ours(lambda indices: placed(agent, indices, spaces, config), params, lambda parameter: parameter.grad)


def train_step_given(state, batch, samples, spaces, config):
    """One `update`, with a buffer that holds the batch."""
    require_their_losses(config)
    params, moments = state["params"], state["optimizer"]
    return_range = state["return_range"]["low"], state["return_range"]["high"]
    agent = give(loaded(params, state["slow_critic"], return_range, spaces, config), samples)
    resume(agent, moments, lambda tensors: placed(agent, tensors, spaces, config), config)
    data, context = batch_of(batch, spaces, config)
    latents = {}
    buffer = Namespace(
        sample=lambda: (data, None, context),
        update=lambda index, stoch, deter: latents.update(stoch=stoch, deter=deter),
    )
    agent.preprocess = lambda data: data  # which `batch_of` has called
    with mock.patch.object(dreamer, "autocast", return_value=nullcontext()):
        metrics = agent.update(buffer)
    _, aux = losses_of(agent, {**metrics}, spaces, config)
    rate = rate_of(agent, moments["step"], config)

    def by_name(values):
        return ours(lambda indices: placed(agent, indices, spaces, config), params, values)

    slow = ours(
        lambda indices: zip(agent._slow_value.parameters(), critic_of(indices, config), strict=True),
        state["slow_critic"],
        lambda parameter: parameter,
    )
    optimizer = {
        "step": moments["step"] + 1,
        "second_moment": by_name(lambda parameter: agent._optimizer.state[parameter]["exp_avg_sq"]),
        "momentum": by_name(lambda parameter: agent._optimizer.state[parameter]["exp_avg"] / rate),
    }
    low, high = agent.return_ema.ema_vals
    return {
        "params": by_name(lambda parameter: parameter),
        "slow_critic": slow,
        "optimizer": optimizer,
        "return_range": {"low": low, "high": high},
    }, {**aux, **latents}


def rate_of(agent, step, config):
    return config.learning_rate * agent._scheduler.lr_lambdas[0](step)


def resume(agent, moments, pairs_of, config):
    """Puts the optimizer where it is after `step` updates at the present rate: their momentum holds the rate."""
    rate = rate_of(agent, moments["step"], config)
    agent._optimizer.param_groups[0]["lr"] = rate
    pairs = zip(pairs_of(moments["second_moment"]), pairs_of(moments["momentum"]), strict=True)
    for (parameter, second), (_, momentum) in pairs:
        agent._optimizer.state[parameter] = laprop_state(second, momentum, moments["step"], rate, config)


def laprop_state(second_moment, momentum, step, rate, config):
    return {
        "step": step,
        "exp_avg": momentum * rate,
        "exp_avg_lr_1": rate * (1 - config.beta1**step),
        "exp_avg_lr_2": 1 - config.beta2**step,
        "exp_avg_sq": second_moment.clone(),
    }


def require_their_losses(config):
    if config.continue_target != "hard":
        raise NotImplementedError("a discounted continue target")
    if config.start_continue != "predicted":
        raise NotImplementedError("the true continue flag of the start")
