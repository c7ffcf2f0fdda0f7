"""sheeprl 0.8: its DreamerV3 after the Nature paper, `sheeprl.algos.dreamer_v3_5`.

Their code is time first, keeps latents flat, and computes losses in float32. What they write inside of a longer
function is reached by calling that function with stand-ins for the networks, one element at a time: `world_model_loss`
for the KL losses, `imagine` for the weights, and `actor_critic_loss` for the losses of actor and critic. Their policies
have either real or discrete actions; where an agent has both, each action key gets a policy of its own here, and
log-probabilities and entropies are added up as theirs are.

Layers, encoder and decoder stand in `sheeprl_v3_5_networks`. Not offered: samples from given noise, since they draw
with the generator of PyTorch; whole training steps, which take a configuration of Hydra and a Fabric.
"""

from importlib.metadata import version
from types import SimpleNamespace as Namespace

import torch
from sheeprl.algos.dreamer_v3_5 import agent, dreamer_v3_5, loss
from sheeprl.algos.dreamer_v3_5.optim import LaProp
from sheeprl.utils.utils import symexp, symlog  # noqa: F401
from sheeprl_adapter import (  # noqa: F401 - offered here, too
    categorical_kl,
    convert,
    percentile,
    return_scale,
    setup,
    update_return_range,
)
from sheeprl_v3_5_networks import (  # noqa: F401 - some are offered here, too
    block_linear,
    decoder,
    dense_of,
    encoder,
    fill,
    linear,
    max_pool,
    mlp_of,
    out_of,
    rms_norm,
    upsample,
)
from torch import nn

__version__ = version("sheeprl")


def edition():
    return "official"


# transforms and distributions


def exponential_bins(bins):
    return loss.symexp_bins(bins)


def twohot(x, bins):
    return loss.TwoHot(torch.zeros_like(bins), bins).encode(x)


def symexp_twohot_loss(logits, target, bins):
    return loss.TwoHot(logits, bins).loss(torch.as_tensor(target))


def symexp_twohot_mean(logits, bins):
    return loss.TwoHot(logits, bins).mean


def unimix_log_probs(logits, unimix):
    return agent.RSSM(None, None, None, logits.shape[-1], unimix).uniform_mix(logits)[..., 0, :]


def bernoulli_loss(logit, target):
    return loss.binary_loss(logit, target)


def bounded_normal(mean, std, min_std, max_std):
    config = Namespace(actor_min_std=min_std, actor_max_std=max_std, actor_unimix=0.0)
    state = torch.stack([mean, std], -1)
    normal = actor_of_outputs(Namespace(size=1), config).distributions(state)[0].base_dist
    return normal.loc[..., 0], normal.scale[..., 0]


def mse_loss(prediction, target):
    return loss.mse(prediction[..., None], target[..., None], 1)


def symlog_mse_loss(prediction, target, scale):
    return scale * loss.symlog_mse(prediction[..., None], target[..., None], 1)


def draw_categorical(logits, unimix, seed, n):
    torch.manual_seed(seed)
    rssm = agent.RSSM(None, None, None, logits.shape[-1], unimix)
    return rssm.sample(rssm.uniform_mix(logits.flatten(-2).expand(n, -1))).unflatten(-1, logits.shape)


# rssm


def rssm_of(params, config):
    flat, tokens = config.stoch * config.classes, len(params["rssm/posterior/hidden0/kernel"]) - config.deter
    actions, epsilon = len(params["rssm/embed_action/kernel"]), config.norm_epsilon
    recurrent = agent.RecurrentModel(config.deter, flat, actions, config.units, config.blocks, eps=epsilon)
    posterior = agent.RepresentationModel(
        config.deter, tokens, config.units, flat, config.posterior_layers, eps=epsilon
    )
    prior = nn.Sequential(
        *agent.mlp(config.deter, config.units, config.prior_layers, eps=epsilon), agent.Linear(config.units, flat)
    )
    embeddings = dense_of(params, "rssm/embed_deter", "rssm/embed_stoch", "rssm/embed_action")
    blocks = [
        params[f"rssm/{name}"] for name in ("hidden/kernel", "hidden/bias", "hidden/scale", "gru/kernel", "gru/bias")
    ]
    fill(recurrent, embeddings + blocks)
    fill(posterior, mlp_of(params, "rssm/posterior", config.posterior_layers) + out_of(params, "rssm/posterior/out"))
    fill(prior, mlp_of(params, "rssm/prior", config.prior_layers) + out_of(params, "rssm/prior/out"))
    return agent.RSSM(recurrent, posterior, prior, config.classes, config.latent_unimix)


def core(params, deter, stoch, action, config):
    rssm = rssm_of(params, config)
    return rssm.recurrent_model(deter, stoch.flatten(-2), rssm.embed_actions(action))


def prior(params, deter, config):
    return rssm_of(params, config).transition_model(deter).unflatten(-1, (config.stoch, config.classes))


def posterior(params, deter, tokens, config):
    rssm = rssm_of(params, config)
    return rssm.representation_model(deter, rssm.project_observations(tokens)).unflatten(
        -1, (config.stoch, config.classes)
    )


def observe_given(params, carry, tokens, prev_action, is_first, stoch, config):
    rssm, logits, states = rssm_of(params, config), [], [carry["deter"]]
    rssm.representation_model.register_forward_hook(lambda module, inputs, output: logits.append(output))
    keep = 1 - is_first.float()[..., None]
    actions = rssm.embed_actions(prev_action * keep)
    sequence = stoch.flatten(-2)
    previous = torch.cat([carry["stoch"].flatten(-2)[:, None], sequence[:, :-1]], 1)
    projections = rssm.project_observations(tokens)
    logits.clear()
    for t in range(is_first.shape[1]):
        states.append(rssm.dynamic(previous[:, t], states[-1], actions[:, t], projections[:, t], 1 - keep[:, t])[0])
    deter, shape = torch.stack(states[1:], 1), (config.stoch, config.classes)
    prior_logits = rssm.transition_model(deter)
    return {
        "deter": deter,
        "posterior": torch.stack(logits, 1).unflatten(-1, shape),
        "prior": prior_logits.unflatten(-1, shape),
    }


def imagine_given(params, carry, action, stoch, config):
    rssm, states = rssm_of(params, config), [carry["deter"]]
    previous = torch.cat([carry["stoch"][:, None], stoch], 1).flatten(-2)
    for t in range(action.shape[1]):
        states.append(rssm.imagination(previous[:, t], states[-1], action[:, t])[1])
    deter = torch.stack(states, 1)
    return {"deter": deter, "prior": rssm.transition_model(deter[:, 1:]).unflatten(-1, (config.stoch, config.classes))}


# networks


def width(space):
    return sum(space.classes) if hasattr(space, "classes") else space.size


def head(params, name, feature, layers, outputs, config):
    """As the function `head` of their `build_agent` makes it."""
    hidden = agent.mlp(feature.shape[-1], config.units, layers, eps=config.norm_epsilon)
    network = nn.Sequential(*hidden, agent.Linear(config.units, outputs))
    return fill(network, mlp_of(params, name, layers) + out_of(params, f"{name}/out"))(feature)


def reward_head(params, feature, config):
    return head(params, "reward", feature, config.reward_layers, config.bins, config)


def continue_head(params, feature, config):
    return head(params, "continue", feature, config.continue_layers, 1, config)[..., 0]


def critic(params, feature, config):
    return head(params, "critic", feature, config.critic_layers, config.bins, config)


def actor(params, feature, spaces, config):
    outputs = {}
    for key, space in spaces.actions.items():
        continuous = not hasattr(space, "classes")
        sizes = [space.size] if continuous else list(space.classes)
        policy = agent.Actor(
            feature.shape[-1], sizes, continuous, config.units, config.actor_layers, eps=config.norm_epsilon
        )
        names = ("mean", "std") if continuous else ("logits",)
        kernel = torch.cat([params[f"actor/out/{key}/{name}/kernel"] for name in names], -1)
        bias = torch.cat([params[f"actor/out/{key}/{name}/bias"] for name in names])
        parts = [len(bias)] if continuous else sizes
        heads = [x for pair in zip(kernel.mT.split(parts), bias.split(parts), strict=True) for x in pair]
        fill(policy, mlp_of(params, "actor", config.actor_layers) + heads)
        raw = torch.cat([output(policy.model(feature)) for output in policy.mlp_heads], -1)
        outputs[key] = dict(zip(names, raw.chunk(len(names), -1), strict=True))
    return outputs


def actor_of_outputs(space, config):
    """Their actor for one action key, whose network hands its input through: raw outputs in, distributions out."""
    continuous = not hasattr(space, "classes")
    sizes = [space.size] if continuous else list(space.classes)
    bounds = {"min_std": config.actor_min_std, "max_std": config.actor_max_std, "unimix": config.actor_unimix}
    policy = agent.Actor(1, sizes, continuous, mlp_layers=0, **bounds)
    del policy.mlp_heads
    ends = [sum(sizes[: i + 1]) for i in range(len(sizes))]
    cuts = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    policy.mlp_heads = [lambda x: x] if continuous else [lambda x, cut=cut: x[..., cut] for cut in cuts]
    return policy


def policies(outputs, spaces, config):
    """For each key: the actor, its raw outputs, and where its part of a flat action lies."""
    first = 0
    for key, space in sorted(spaces.actions.items()):
        raw = outputs[key]
        state = raw["logits"] if "logits" in raw else torch.cat([raw["mean"], raw["std"]], -1)
        yield actor_of_outputs(space, config), state, [space.size] if "mean" in raw else list(space.classes), first
        first += width(space)


def action_log_prob(outputs, action, spaces, config):
    total, action = 0, action.detach()  # drawn in `imagine`, which runs without gradients
    for policy, state, sizes, first in policies(outputs, spaces, config):
        parts = action[..., first : first + sum(sizes)].split(sizes, -1)
        total = total + sum(one.log_prob(part) for one, part in zip(policy.distributions(state), parts, strict=True))
    return total


def action_entropy(outputs, spaces, config):
    return sum(
        one.entropy() for policy, state, *_ in policies(outputs, spaces, config) for one in policy.distributions(state)
    )


def draw_actions(outputs, spaces, config, seed, n):
    torch.manual_seed(seed)
    drawn = [policy(state.expand(n, -1))[0] for policy, state, *_ in policies(outputs, spaces, config)]
    return torch.cat([action for actions in drawn for action in actions], -1)


# losses and returns


def kl_losses(posterior_logits, prior_logits, config):
    rssm = agent.RSSM(None, None, None, config.classes, config.latent_unimix)
    posterior_logits, prior_logits = (rssm.uniform_mix(x.flatten(-2)) for x in (posterior_logits, prior_logits))
    pairs = zip(posterior_logits.flatten(0, -3), prior_logits.flatten(0, -3), strict=True)
    losses = torch.stack([torch.stack([one_kl(q, p, config, share) for share in (1.0, 0.0)]) for q, p in pairs])
    return tuple(losses.mT.unflatten(-1, posterior_logits.shape[:-2]))


def one_kl(posterior_logits, prior_logits, config, share):
    """The loss of one state: of the dynamics for a share of 1, of the representation for 0."""
    zero = torch.zeros(1, 1, 1)
    model = Namespace(
        encoder=lambda observations: zero,
        rssm=Namespace(
            project_observations=lambda tokens: zero,
            embed_actions=lambda actions: zero,
            dynamic=lambda *inputs: (zero, zero, posterior_logits[None, None]),
            prior_logits=lambda memories: prior_logits[None, None],
        ),
        observation_model=lambda states: {"x": zero},
        reward_model=lambda states: zero.expand(1, 1, 255),
        continue_model=lambda states: zero,
    )
    scales = {
        **dict.fromkeys(("observation_scale", "reward_scale", "continue_scale"), 0.0),
        "dynamic_scale": share,
        "representation_scale": 1 - share,
    }
    keys = {"cnn_keys": (), "mlp_keys": ("x",), "cnn_decoder_keys": (), "mlp_decoder_keys": ("x",)}
    rest = {
        "kl_free_nats": config.free_nats,
        "continue_target": 1.0,
        "reward_grad": True,
        "replay_grad": True,
        "entropies": False,
    }
    return dreamer_v3_5.world_model_loss(
        model, {"x": zero}, zero, zero, zero, zero, zero, zero, **keys, **rest, **scales
    )[0]


def lambda_return(reward, continue_, value, discount, lambda_):
    continue_ = continue_.mT
    return loss.lambda_return(torch.zeros_like(continue_), 1 - continue_, reward.mT, value.mT, discount, lambda_).mT


def replay_lambda_return(reward, is_last, is_terminal, annotation, discount, lambda_):
    if reward.shape[1] < 2:
        return reward[:, 1:]  # their training skips sequences of one step
    return loss.lambda_return(is_last.mT, is_terminal.mT, reward.mT, annotation.mT, discount, lambda_).mT


def cumulative_weights(continue_, discount):
    rows, steps = continue_.shape
    zero, logits = torch.zeros(1, rows, 1), torch.zeros(steps, rows, 255)
    model = Namespace(
        rssm=Namespace(imagination=lambda *state: (zero, zero)),
        reward_model=lambda states: logits,
        continue_model=lambda states: continue_.mT[..., None].logit(),
    )
    sizes = {"horizon": steps - 1, "discount": discount, "lmbda": 0.95}
    critic = lambda states: logits  # noqa: E731
    return dreamer_v3_5.imagine(model, lambda states: ([zero], None), critic, critic, zero, zero, **sizes)[-1][:-1].mT


def behavior_loss(
    part,
    actor=None,
    imagined=None,
    actions=None,
    values=None,
    slow_values=None,
    returns=None,
    weight=None,
    scale=1.0,
    **given,
):
    """A part of `actor_critic_loss` for one imagined state: "policy", "value" or "replay_value".

    A state is the logits of the critic, then those of the slow critic. What `imagine` computes comes without gradients,
    as there.
    """
    empty = torch.zeros(2, 1, 2 * 255) if imagined is None else imagined
    bins = empty.shape[-1] // 2
    pair = torch.zeros(2, 1)
    policy = Namespace(log_prob=lambda action: pair[:1], entropy=lambda: pair[:1]) if actor is None else actor
    rest = {"ent_coef": 0.0, "slow_regularizer": 1.0, "replay_loss": False, **given}
    sizes = {"actions_dim": (1,), "gamma": 1.0, "lmbda": 1.0}
    scales = {f"{name}_scale": float(name == part) for name in ("policy", "value", "replay_value")}
    replayed = {name: rest.pop(name, pair) for name in ("latent_states", "last", "terminated", "rewards")}
    return dreamer_v3_5.actor_critic_loss(
        lambda states, with_actions: ((), (policy,)),
        lambda states: states[..., :bins],
        lambda states: states[..., bins:],
        empty,
        torch.zeros(2, 1, 1),
        *(pair if x is None else x.detach() for x in (values, slow_values)),
        pair[:1] if returns is None else returns.detach(),
        pair if weight is None else weight.detach(),
        torch.as_tensor(scale, dtype=torch.float32).detach(),
        *replayed.values(),
        **sizes,
        **scales,
        **rest,
    )[0]


def twice(x):
    """[2, 1]: an imagined state, and the one after it, which no loss reads."""
    return x.reshape(1, 1).expand(2, 1)


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    losses = []
    for lp, e, r, v, w in zip(*(x.flatten() for x in (log_prob, entropy, returns, value, weight)), strict=True):
        policy = Namespace(log_prob=lambda action, lp=lp: lp.reshape(1, 1), entropy=lambda e=e: e.reshape(1, 1))
        given = {
            "values": twice(v),
            "returns": r.reshape(1, 1),
            "weight": twice(w),
            "scale": scale,
            "ent_coef": config.entropy_scale,
        }
        losses.append(behavior_loss("policy", policy, **given))
    return torch.stack(losses).reshape(returns.shape)


def critic_loss(logits, slow_logits, returns, weight, config):
    slow_values = loss.TwoHot(slow_logits).mean  # as in `imagine`
    losses = []
    for rows in zip(*(x.flatten(0, 1) for x in (logits, slow_logits, slow_values, returns, weight)), strict=True):
        logit, slow, slow_value, target, w = rows
        states = torch.cat([logit, slow]).expand(2, 1, -1)
        given = {"slow_values": twice(slow_value), "returns": target.reshape(1, 1), "weight": twice(w)}
        losses.append(behavior_loss("value", imagined=states, slow_regularizer=config.slow_critic_scale, **given))
    return torch.stack(losses).reshape(returns.shape)


def replay_critic_loss(logits, slow_logits, returns, is_last, config):
    """Two replayed steps each: where the second is terminal, its reward is the return of the first."""
    losses = []
    for logit, slow, target, last in zip(
        *(x.flatten(0, 1) for x in (logits, slow_logits, returns, is_last)), strict=True
    ):
        states = torch.cat([logit, slow]).expand(2, 1, -1)
        given = {
            "latent_states": states,
            "last": torch.tensor([[float(last)], [0.0]]),
            "terminated": torch.tensor([[0.0], [1.0]]),
            "rewards": torch.stack([torch.zeros(()), target])[:, None],
        }
        imagined = {"imagined": states.expand(2, 2, -1), "values": torch.zeros(2, 2), "slow_values": torch.zeros(2, 2)}
        weights = {"returns": torch.zeros(1, 2), "weight": torch.zeros(2, 2)}
        options = {"replay_loss": True, "slow_regularizer": config.slow_critic_scale}
        losses.append(behavior_loss("replay_value", **imagined, **weights, **options, **given))
    return torch.stack(losses).reshape(returns.shape)


# optimizer


def optimizer_of(params, gradients, second_moment, momentum, step, config, **changes):
    tensors = {name: nn.Parameter(value.clone()) for name, value in params.items()}
    options = {
        "betas": (config.beta1, config.beta2),
        "eps": config.laprop_epsilon,
        "agc": config.agc_clip,
        "agc_pmin": config.agc_epsilon,
    }
    options |= {"lr": config.learning_rate, "warmup": config.warmup_steps, **changes}
    optimizer = LaProp(tensors.values(), **options)
    for name, tensor in tensors.items():
        tensor.grad = gradients[name].clone()
        optimizer.state[tensor] = {"exp_avg": momentum[name].clone(), "exp_avg_sq": second_moment[name].clone()}
    optimizer.param_groups[0]["step"] = step
    optimizer.step()
    return tensors, {name: optimizer.state[tensor] for name, tensor in tensors.items()}


def optimizer_step(params, gradients, state, config):
    new, moments = optimizer_of(params, gradients, state["second_moment"], state["momentum"], state["step"], config)
    second_moment, momentum = ({name: moments[name][entry] for name in params} for entry in ("exp_avg_sq", "exp_avg"))
    return new, {"step": state["step"] + 1, "second_moment": second_moment, "momentum": momentum}


def laprop(gradient, second_moment, momentum, step, config):
    given = ({"x": x} for x in (torch.zeros_like(gradient), gradient, second_moment, momentum))
    new, moments = optimizer_of(*given, step, config, lr=1.0, agc=0.0, warmup=0)
    return -new["x"], moments["x"]["exp_avg_sq"], moments["x"]["exp_avg"]


def learning_rate(step, config):
    """How far a parameter moves whose normalized gradient is 1."""
    one = torch.ones(1)
    new, _ = optimizer_of({"x": 0 * one}, {"x": one}, {"x": one}, {"x": one}, step, config, betas=(0.0, 0.0), agc=0.0)
    return -float(new["x"])
