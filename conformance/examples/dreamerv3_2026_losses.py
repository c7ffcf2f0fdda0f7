"""What `dreamerv3_2026_adapter` offers of returns and of single losses.

What the authors write inside of a longer function is reached by calling that function with stand-ins for the networks:
`imag_loss` for returns, weights and the losses of actor and critic, `repl_loss` for the critic's on replayed states,
`RSSM.loss` for the KL losses, and `Agent.loss` for the continue target and the reconstruction losses. Where a loss
makes the returns itself, each element is a trajectory of one step that ends: its reward is its return.
"""

from functools import partial
from types import SimpleNamespace as Namespace

import embodied.jax
import jax.numpy as jnp
import ninjax as nj
from dreamerv3 import agent, rssm
from dreamerv3.agent import imag_loss, repl_loss
from dreamerv3_2026_distributions import exponential_bins, head, stand_in, twohot_of
from dreamerv3_2026_names import flat, is_image, observation_of, parts, spaces_of
from embodied.jax import outs

NONE = embodied.jax.Normalize("none", name="none")


# returns


def horizon_of(discount):
    """Their configuration has the horizon of which the discount is made."""
    return 1 / (1 - discount) if discount != 1 else float("inf")


def prediction(pred=None, loss=None):
    return Namespace(pred=lambda: pred, loss=lambda target: jnp.zeros_like(pred) if loss is None else loss)


def trajectories(rew, con, value, policy=None, slow=None, retnorm=NONE, **options):
    """Losses and returns of trajectories [N, H+1]. The discount is 1 unless there is a horizon."""
    zeros = jnp.zeros_like(con)
    policy = policy or Namespace(logp=lambda action: zeros, entropy=lambda: zeros)
    options = {"contdisc": True, "slowtar": False, "actent": 0.0, "slowreg": 0.0} | options
    norms, slow = (retnorm, NONE, NONE), slow or value
    losses, found, _ = imag_loss(
        {"action": zeros}, rew, con, {"action": policy}, value, slow, *norms, update=False, **options
    )
    return losses, found["ret"]


def lambda_return(reward, continue_, value, discount, lambda_):
    horizon = {"contdisc": False, "horizon": horizon_of(discount)}
    return trajectories(reward, continue_, prediction(value), lam=lambda_, **horizon)[1]


def cumulative_weights(continue_, discount):
    """What a loss of 1 becomes."""
    ones, horizon = jnp.ones_like(continue_), {"contdisc": False, "horizon": horizon_of(discount)}
    return trajectories(ones, continue_, prediction(ones, ones), **horizon)[0]["value"]


def replay_lambda_return(reward, is_last, is_terminal, annotation, discount, lambda_):
    value = prediction(annotation)
    options = {"update": False, "slowtar": False, "horizon": horizon_of(discount), "lam": lambda_}
    return repl_loss(is_last.astype(bool), is_terminal, reward, annotation, value, value, NONE, **options)[1]["ret"]


def range_of(function, low=0.0, high=0.0, **options):
    """What a function of their normalizer returns, and its range after that."""
    norm = embodied.jax.Normalize("perc", debias=False, name="range", **options)
    ends = {"range/lo/value": jnp.float32(low), "range/hi/value": jnp.float32(high)}
    state, found = nj.pure(lambda: function(norm))(ends)
    return found, *(state[name] for name in ends)


def percentile(values, q):
    return range_of(lambda norm: norm.update(values), rate=1.0, perclo=q)[1]


def update_return_range(low, high, returns, config):
    ends = {"perclo": config.return_percentile_low, "perchi": config.return_percentile_high}
    return range_of(lambda norm: norm.update(returns), low, high, rate=1 - config.return_decay, **ends)[1:]


def return_scale(low, high, limit):
    return range_of(lambda norm: norm.stats(), low, high, limit=limit)[0][1]


# losses


def world_model(observation, is_terminal, config, spaces=None, recons=None):
    """`Agent.loss` [N, 1] of predictions, with stand-ins for all networks: the loss of the continue head is its
    target."""
    shape = (len(is_terminal), 1)
    feature = {"deter": jnp.zeros((*shape, 1)), "stoch": jnp.zeros((*shape, 1, 1))}
    zeros = lambda inputs: jnp.zeros(inputs.shape[:2])  # noqa: E731
    answer = lambda inputs, axes: Namespace(  # noqa: E731
        loss=lambda target: target, pred=lambda: zeros(inputs), prob=lambda event: zeros(inputs)
    )
    given = {"enc": lambda *inputs: ({}, {}, None), "dec": lambda *inputs: ({}, {}, recons or {})}
    given["dyn"] = Namespace(
        loss=lambda *inputs: ({}, {}, {}, feature, {}),
        starts=lambda *inputs: {},
        imagine=lambda *inputs: ({}, feature, {}),
    )
    given |= dict.fromkeys(("rew", "con", "val", "slowval"), answer) | {"pol": lambda *inputs: {}}
    given |= dict.fromkeys(("retnorm", "valnorm", "advnorm"), NONE)
    settings = {"reward_grad": True, "imag_last": 0, "imag_length": 1, "ac_grads": False, "repval_loss": False}
    settings |= {"contdisc": config.continue_target == "discounted", "horizon": config.discount_horizon}
    names = (*(recons or {}), "rew", "con", "policy", "value")
    model = Namespace(
        config=Namespace(**settings, imag_loss={}),
        obs_space=spaces,
        scales=dict.fromkeys(names, 1.0),
        feat2tensor=lambda feature: feature["deter"],
        **given,
    )
    flags = {"is_first": jnp.zeros(shape, bool), "is_terminal": is_terminal.reshape(shape), "reward": jnp.zeros(shape)}
    return agent.Agent.loss(model, ({}, {}, {}), observation | flags, {}, True)[1][2]["losses"]


def continue_target(is_terminal, config):
    is_terminal = jnp.asarray(is_terminal)
    return world_model({}, is_terminal.ravel(), config)["con"].reshape(is_terminal.shape)


def reconstruction_losses(predictions, observations, spaces, config):
    if config.vector_loss_scale != 1:
        raise NotImplementedError("a scale for the squared errors of vectors")
    own, recons, arrays = spaces_of(spaces.observations), {}, observation_of(observations, spaces.observations)
    for name, part in parts(spaces.observations).items():
        raw, space = predictions[part.key], part.space
        raw = flat(raw if is_image(space) else raw[..., part.encoded], 3 if is_image(space) else 1)[:, None]
        if is_image(space):
            recons[name] = outs.Agg(outs.MSE(raw), 3, jnp.sum)
        elif space.discrete:
            logits = raw.reshape(*raw.shape[:-1], *space.shape, -1)
            recons[name] = outs.Agg(head("categorical", {"logits": logits}, space), 1, jnp.sum)
        else:
            recons[name] = outs.Agg(head("symlog_mse", {"pred": raw}, space), 1, jnp.sum)
    rows = {name: flat(x, len(own[name].shape))[:, None] for name, x in arrays.items()}
    first, x = next(iter(arrays.items()))
    leading = x.shape[: x.ndim - len(own[first].shape)]
    found = world_model(rows, jnp.zeros(len(rows[first]), bool), config, own, recons)
    losses = {}
    for name, part in parts(spaces.observations).items():
        losses[part.key] = losses.get(part.key, 0.0) + found[name].reshape(leading)
    return losses


def kl_losses(posterior_logits, prior_logits, config):
    feature = {"deter": None, "logit": posterior_logits}
    model = stand_in(unimix=config.latent_unimix, free_nats=config.free_nats, _prior=lambda memory: prior_logits)
    model._dist = partial(rssm.RSSM._dist, model)
    model.observe = lambda *arguments: ({}, {}, feature)
    losses = rssm.RSSM.loss(model, None, None, None, None, True)[2]
    return losses["dyn"], losses["rep"]


def ends(x):
    """[N, 2]: an element, and the end after it."""
    return jnp.stack([x.ravel(), jnp.zeros(x.size)], 1)


def arrivals(returns):
    """[N, 2]: rewards of which each return is made."""
    return jnp.stack([jnp.zeros(returns.size), returns.ravel()], 1)


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    policy = Namespace(logp=lambda action: ends(log_prob), entropy=lambda: ends(entropy))
    normalize = lambda returns, update: (0.0, scale)  # noqa: E731
    rest = {"policy": policy, "retnorm": normalize, "actent": config.entropy_scale}
    losses = trajectories(arrivals(returns), ends(weight), prediction(ends(value)), **rest)[0]
    return losses["policy"].reshape(returns.shape)


def two_critics(logits, slow_logits, config):
    bins = exponential_bins(config.bins)
    pad = lambda x: jnp.pad(x.reshape(-1, 1, x.shape[-1]), ((0, 0), (0, 1), (0, 0)))  # noqa: E731
    return twohot_of(pad(logits), bins), twohot_of(pad(slow_logits), bins)


def critic_loss(logits, slow_logits, returns, weight, config):
    value, slow = two_critics(logits, slow_logits, config)
    options = {"slow": slow, "slowreg": config.slow_critic_scale}
    return trajectories(arrivals(returns), ends(weight), value, **options)[0]["value"].reshape(returns.shape)


def replay_critic_loss(logits, slow_logits, returns, is_last, config):
    value, slow = two_critics(logits, slow_logits, config)
    last, term = ends(is_last).astype(bool), arrivals(jnp.ones_like(returns)).astype(bool)
    options = {"update": False, "slowtar": False, "slowreg": config.slow_critic_scale}
    losses = repl_loss(last, term, arrivals(returns), jnp.zeros(last.shape), value, slow, NONE, **options)[0]
    return losses["repval"].reshape(returns.shape)
