"""rlax: signed logarithm, two-hot encoding over given bins, λ-returns, categorical and squared losses.

Written for rlax 0.1.9. Its two-hot encoding over uneven bins is `unbiased_transform_pair`, which wants at least one
leading axis. Its λ-returns are those of one trajectory, from the first transition on, with a discount for each step.
Its l2_loss is half a square, and its categorical functions take logits, which log-probabilities are too.
"""

import warnings

import jax
import jax.numpy as jnp
import rlax

__version__ = rlax.__version__
convert = jnp.asarray


def setup(dtype):
    warnings.filterwarnings("ignore", category=PendingDeprecationWarning, message="Rlax")
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)


def symlog(x):
    return rlax.signed_logp1(x)


def symexp(x):
    return rlax.signed_expm1(x)


def twohot_over(bins):
    """The pair of a two-hot encoding and its mean, with the given bins in place of a transformed even grid."""
    return rlax.unbiased_transform_pair(0.0, 1.0, len(bins), rlax.TxPair(rlax.identity, lambda grid: bins))


def twohot(x, bins):
    return twohot_over(bins).apply(x).reshape(*x.shape, len(bins))


def ordered_expectation(probs, bins):
    return twohot_over(bins).apply_inv(probs).reshape(probs.shape[:-1])


def categorical_log_prob(log_probs, onehot):
    return rlax.softmax().logprob(jnp.argmax(onehot, -1), log_probs)


def categorical_entropy(log_probs):
    return rlax.softmax().entropy(log_probs)


def categorical_kl(log_probs_p, log_probs_q):
    return rlax.categorical_kl_divergence(log_probs_p, log_probs_q)


def symexp_twohot_loss(logits, target, bins):
    return rlax.categorical_cross_entropy(twohot(target, bins), logits)


def symexp_twohot_mean(logits, bins):
    return ordered_expectation(rlax.softmax().probs(logits), bins)


def mse_loss(prediction, target):
    return 2 * rlax.l2_loss(prediction, target)


def symlog_mse_loss(prediction, target, scale):
    return 2 * scale * rlax.l2_loss(prediction, rlax.signed_logp1(target))


def draw_categorical(logits, unimix, seed, n):
    probs = (1 - unimix) * rlax.softmax().probs(logits) + unimix / logits.shape[-1]
    return rlax.categorical_sample(jax.random.key(seed), jnp.broadcast_to(probs, (n, *probs.shape)))


def draw_normal(mean, std, seed, n):
    return rlax.gaussian_diagonal().sample(jax.random.key(seed), jnp.broadcast_to(mean, (n, *mean.shape)), std)


def lambda_return(reward, continue_, value, discount, lambda_):
    returns = jax.vmap(rlax.lambda_returns, in_axes=(0, 0, 0, None))
    return returns(reward[:, 1:], discount * continue_[:, 1:], value[:, 1:], lambda_)


def replay_lambda_return(reward, is_last, is_terminal, annotation, discount, lambda_):
    arguments = reward, discount * (1.0 - is_terminal), annotation, lambda_ * (1.0 - is_last)
    return jax.vmap(rlax.lambda_returns)(*(x[:, 1:] for x in arguments))
