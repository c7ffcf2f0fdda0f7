"""What `dreamerv3_2026_adapter` offers of transforms, distributions and policies.

Distributions are made by the methods of the authors' heads, with stand-ins for the last layers.
"""

from types import SimpleNamespace as Namespace

import elements
import jax
import jax.numpy as jnp
import numpy as np
from dreamerv3 import agent
from dreamerv3_2026_names import placed
from dreamerv3_2026_networks import SCALAR
from embodied.jax import heads, outs
from embodied.jax.nets import symexp, symlog  # noqa: F401 - offered as they are


def stand_in(**attributes):
    """Of one of their modules, which have a path."""
    return Namespace(_path="module", **attributes)


def head(kind, outputs, space=SCALAR, **options):
    """The distribution that a method of their heads makes of the outputs of its last layers."""
    module = stand_in(space=space, kw={}, sub=lambda name, *size, **initial: lambda x: outputs[name], **options)
    return getattr(heads.Head, kind)(module, None)


# transforms and distributions


def twohot_of(logits, bins):
    return outs.TwoHot(logits, jnp.asarray(bins, jnp.float32))


def exponential_bins(bins):
    return head("symexp_twohot", {"logits": jnp.zeros(max(bins, 0))}, bins=bins).bins


def twohot(x, bins):
    """Their encoding is a part of the loss, where its weights are what the gradient by the logits takes off.

    Of logits that are sure of one bin, all others have no other gradient; so there are two, sure of different bins.
    """
    bins, x = jnp.asarray(bins), jnp.asarray(x)

    def weights(sure):
        logits = jnp.broadcast_to(-1e30 * (jnp.arange(len(bins)) != sure), (*x.shape, len(bins)))
        return -jax.grad(lambda logits: twohot_of(logits, bins).loss(x).sum())(logits)

    return jnp.where(jnp.arange(len(bins)) == 0, weights(len(bins) - 1), weights(0))


@jax.jit  # as their agent is: the processor rounds other products then
def ordered_expectation(probs, bins):
    dist = twohot_of(jnp.zeros_like(probs), bins)
    dist.probs = probs
    return dist.pred()


def symexp_twohot_loss(logits, target, bins):
    return twohot_of(logits, bins).loss(jnp.asarray(target, jnp.float32))


@jax.jit
def symexp_twohot_mean(logits, bins):
    return twohot_of(logits, bins).pred()


def unimix_log_probs(logits, unimix):
    return jax.nn.log_softmax(outs.OneHot(logits, unimix).dist.logits)  # as their distributions do with logits


def straight_through(log_probs, sample):
    return outs.OneHot(log_probs)._onehot_with_grad(sample.argmax(-1))


def categorical_log_prob(log_probs, onehot):
    return outs.OneHot(log_probs).logp(onehot)


def categorical_entropy(log_probs):
    return outs.OneHot(log_probs).entropy()


def categorical_kl(log_probs_p, log_probs_q):
    return outs.OneHot(log_probs_p).kl(outs.OneHot(log_probs_q))


def bernoulli_loss(logit, target):
    return outs.Binary(logit).loss(target)


def bernoulli_mean(logit):
    return outs.Binary(logit).prob(1)


def bounded_normal(mean, std, min_std, max_std):
    normal = head("bounded_normal", {"mean": mean, "stddev": std}, minstd=min_std, maxstd=max_std)
    return normal.mean, normal.stddev


def normal_log_prob(mean, std, value):
    return -outs.Normal(mean, std).loss(value)


def normal_entropy(std):
    return outs.Normal(jnp.zeros_like(std), std).entropy()


def mse_loss(prediction, target):
    return outs.MSE(prediction).loss(target)


def symlog_mse_loss(prediction, target, scale):
    return scale * head("symlog_mse", {"pred": prediction}).loss(target)


def draw_categorical(logits, unimix, seed, n):
    return outs.OneHot(logits, unimix).sample(jax.random.PRNGKey(seed), (n,))


def draw_normal(mean, std, seed, n):
    return outs.Normal(mean, std).sample(jax.random.PRNGKey(seed), (n,))


# policies


def policies(outputs, spaces, config):
    """Their distribution of every action of theirs, and its place in a flat action."""
    for _, part, where in placed(spaces.actions):
        raw = {name: x[..., part.encoded] for name, x in outputs[part.key].items()}
        if not part.space.discrete:
            bounds = {"minstd": config.actor_min_std, "maxstd": config.actor_max_std}
            dist = head("bounded_normal", {"mean": raw["mean"], "stddev": raw["std"]}, part.space, **bounds)
        else:
            logits = {"logits": raw["logits"].reshape(*raw["logits"].shape[:-1], *part.space.shape, -1)}
            if config.actor_unimix:  # which their heads have, and their agent does not use
                onehots = elements.Space(np.float32, logits["logits"].shape[-2:], 0.0, 1.0)
                dist = head("onehot", logits, onehots, unimix=config.actor_unimix)
            else:
                dist = head("categorical", logits, part.space)
        yield outs.Agg(dist, 1, jnp.sum), where


def event_of(dist, x):
    """Their action. For an integer, one that is all zeros is missing, which they write as -1."""
    if isinstance(dist.output, outs.Normal):
        return x
    onehots = x.reshape(*x.shape[:-1], *dist.output.entropy().shape[x.ndim - 1 :], -1)
    return onehots if isinstance(dist.output, outs.OneHot) else jnp.where(onehots.any(-1), onehots.argmax(-1), -1)


def action_log_prob(outputs, action, spaces, config):
    every, action = policies(outputs, spaces, config), agent.sg(action)  # as in `imag_loss`
    return sum(dist.logp(event_of(dist, action[..., where])) for dist, where in every)


def action_entropy(outputs, spaces, config):
    return sum(dist.entropy() for dist, _ in policies(outputs, spaces, config))


def draw_actions(outputs, spaces, config, seed, n):
    every = [dist for dist, _ in policies(outputs, spaces, config)]
    keys, drawn = jax.random.split(jax.random.PRNGKey(seed), len(every)), []
    for dist, key in zip(every, keys, strict=True):
        sample = dist.sample(key, (n,))
        classes = jnp.issubdtype(sample.dtype, jnp.integer)
        sample = jax.nn.one_hot(sample, dist.output.logits.shape[-1]) if classes else sample
        drawn.append(sample.reshape(n, -1))
    return jnp.concatenate(drawn, -1)
