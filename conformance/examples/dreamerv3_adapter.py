"""dreamerv3 1.5: the code of the authors of DreamerV3, as released in 2023.

Their code is time first, and has two-hot bins that are even between two ends in symlog space; the ends are taken from
the bins that the kit gives. Distributions, KL losses, returns, weights and the actor's loss are methods of classes with
networks. The methods are called as they are, with stand-ins for the networks; for the actor's loss, whose mean they
take, one element at a time. Where an agent has both real and discrete actions, each action key gets a policy of its
own.

Not offered: recurrent cell and heads, which have LayerNorm and other shapes in this edition, and the critic's loss,
which the kit checks together with the one on replayed states. Adam and the clipping of gradients are those of Optax.
"""

from functools import partial
from importlib.metadata import version
from types import SimpleNamespace as Namespace

import jax
import jax.numpy as jnp
from dreamerv3 import agent, jaxutils, nets
from dreamerv3 import ninjax as nj
from dreamerv3.jaxutils import symexp, symlog

__version__ = version("dreamerv3")
convert = jnp.asarray


def network(**attributes):
    """Stands in for one of their modules, which have a path."""
    return Namespace(_path="network", **attributes)


def edition():
    return "2023"


def exponential_bins(bins):
    return symexp(jaxutils.DiscDist(jnp.zeros(bins)).bins)


def twohot_of(logits, bins):
    return jaxutils.DiscDist(logits, 0, *(float(symlog(end)) for end in (bins[0], bins[-1])))


def symexp_twohot_loss(logits, target, bins):
    return -twohot_of(logits, bins).log_prob(jnp.asarray(target))


def symexp_twohot_mean(logits, bins):
    return twohot_of(logits, bins).mean()


def rssm_of(stoch, classes, unimix):
    """Their RSSM with one categorical network, which hands its input through."""
    rssm = network(_stoch=stoch, _classes=classes, _unimix=unimix, get=lambda *names: lambda x: x)
    rssm.get_dist = partial(nets.RSSM.get_dist, rssm)
    return rssm


def latents(logits, unimix):
    """Their RSSM, and its statistics of logits [..., S, C]."""
    rssm = rssm_of(*logits.shape[-2:], unimix)
    return rssm, nets.RSSM._stats(rssm, "stats", logits.reshape(*logits.shape[:-2], -1))


def unimix_log_probs(logits, unimix):
    return jax.nn.log_softmax(
        latents(logits[..., None, :], unimix)[1]["logit"][..., 0, :]
    )  # as their distributions do with logits


def kl_losses(posterior_logits, prior_logits, config):
    rssm, posterior = latents(posterior_logits, config.latent_unimix)
    prior = latents(prior_logits, config.latent_unimix)[1]
    return tuple(
        method(rssm, posterior, prior, free=config.free_nats) for method in (nets.RSSM.dyn_loss, nets.RSSM.rep_loss)
    )


def draw_categorical(logits, unimix, seed, n):
    rssm, stats = latents(logits, unimix)
    return rssm.get_dist(stats).sample(n, seed=jax.random.PRNGKey(seed))


def head(kind, outputs, shape, **options):
    """The distribution that one of their heads makes of the outputs of its last layers: {"out": ...} and perhaps
    {"std": ...}."""
    options = {"_minstd": 1.0, "_maxstd": 1.0, "_unimix": 0.0, **options}
    one = network(_dist=kind, _shape=shape, _outscale=1.0, _outnorm=False, _bins=255, **options)
    one.get = lambda name, *size, **initial: lambda inputs: outputs[name]
    return nets.Dist.inner(one, outputs["out"])


def bernoulli_loss(logit, target):
    return -head("binary", {"out": logit[..., None]}, (1,)).log_prob(target[..., None])


def bernoulli_mean(logit):
    return head("binary", {"out": logit[..., None]}, (1,)).mean()[..., 0]


def bounded_normal(mean, std, min_std, max_std):
    outputs = {"out": mean[..., None], "std": std[..., None]}
    normal = head("normal", outputs, (1,), _minstd=min_std, _maxstd=max_std)
    return normal.mean()[..., 0], normal.stddev()[..., 0]


def mse_loss(prediction, target):
    return -head("mse", {"out": prediction[..., None]}, (1,)).log_prob(target[..., None])


def symlog_mse_loss(prediction, target, scale):
    return -scale * head("symlog_mse", {"out": prediction[..., None]}, (1,)).log_prob(target[..., None])


def policies(outputs, spaces, config):
    """The distribution of every action, and its size, from the outputs of the last layers."""
    for key, space in sorted(spaces.actions.items()):
        raw = outputs[key]
        if "mean" in raw:
            bounds = {"_minstd": config.actor_min_std, "_maxstd": config.actor_max_std}
            yield head("normal", {"out": raw["mean"], "std": raw["std"]}, (space.size,), **bounds), space.size
        else:
            ends = [sum(space.classes[: i + 1]) for i in range(len(space.classes))]
            for end, classes in zip(ends, space.classes, strict=True):
                logits = raw["logits"][..., end - classes : end]
                yield head("onehot", {"out": logits}, (classes,), _unimix=config.actor_unimix), classes


def action_log_prob(outputs, action, spaces, config):
    total, first = 0.0, 0
    for policy, size in policies(outputs, spaces, config):
        total = total + policy.log_prob(action[..., first : first + size])
        first += size
    return total


def action_entropy(outputs, spaces, config):
    return sum(policy.entropy() for policy, _ in policies(outputs, spaces, config))


def draw_actions(outputs, spaces, config, seed, n):
    every = list(policies(outputs, spaces, config))
    keys = jax.random.split(jax.random.PRNGKey(seed), len(every))
    return jnp.concatenate([policy.sample(n, seed=key) for (policy, _), key in zip(every, keys, strict=True)], -1)


def horizon_of(discount):
    """Their configuration has the horizon of which the discount is made."""
    return 1 / (1 - discount) if discount < 1 else float("inf")


def lambda_return(reward, continue_, value, discount, lambda_):
    critic = network(
        rewfn=lambda trajectory: reward.T[1:],
        net=lambda trajectory: Namespace(mean=lambda: value.T),
        config=Namespace(horizon=horizon_of(discount), return_lambda=lambda_),
    )
    return agent.VFunction.score(critic, {"cont": continue_.T, "action": reward.T})[1].T


def cumulative_weights(continue_, discount):
    rows, steps = continue_.shape
    state = {"deter": jnp.zeros((rows, 1))}
    model = network(
        rssm=Namespace(initial=lambda size: state, img_step=lambda state, action: {"deter": state["deter"]}),
        heads={
            "cont": lambda trajectory: Namespace(mode=lambda: continue_.T)
        },  # given, in place of the most likely flag of a head
        config=Namespace(horizon=horizon_of(discount), imag_unroll=True),
    )
    start = {**state, "is_terminal": 1 - continue_[:, 0]}
    return agent.WorldModel.imagine(model, lambda state: state["deter"], start, steps - 1)["weight"][:-1].T


def moments(values, low=0.0, high=0.0, **options):
    """What their tracker of percentiles returns, and its two averages after that."""

    def update(values):
        tracker = jaxutils.Moments("perc_ema", name="moments", **options)
        tracker.low.write(jnp.float32(low))
        tracker.high.write(jnp.float32(high))
        return tracker(values), tracker.low.read(), tracker.high.read()

    return nj.pure(update)({}, jax.random.PRNGKey(0), values)[0]


def percentile(values, q):
    return moments(values, decay=0.0, perclo=q)[1]


def update_return_range(low, high, returns, config):
    options = {"perclo": config.return_percentile_low, "perchi": config.return_percentile_high}
    return moments(returns, low, high, decay=config.return_decay, max=1.0, **options)[1:]


def return_scale(low, high, limit):
    return moments(jnp.zeros(1), low, high, decay=1.0, max=1 / limit)[0][1]


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    rows = zip(*(x.reshape(-1, 1, 1) for x in (log_prob, entropy, returns, value, weight)), strict=True)
    return jnp.stack([one_actor_loss(*row, scale, config) for row in rows]).reshape(returns.shape)


def one_actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    twice = partial(
        jnp.repeat, repeats=2, axis=0
    )  # an imagined state, and the one after it, which the loss does not read
    policy = Namespace(log_prob=lambda action: twice(log_prob), entropy=lambda: twice(entropy))
    learner = network(
        scales={"extr": 1.0},
        critics={"extr": Namespace(score=lambda *trajectory: (returns, returns, value))},
        retnorms={"extr": lambda returns: (0.0, scale)},
        actor=lambda trajectory: policy,
        grad="reinforce",
        config=Namespace(actent=config.entropy_scale, loss_scales=Namespace(actor=1.0)),
        _metrics=lambda *values: {},
    )
    return agent.ImagActorCritic.loss(learner, {"action": twice(weight), "weight": twice(weight)})[0]
