"""distrax: categorical, normal and Bernoulli distributions.

Written for distrax 0.1.9. A sample from given standard normal noise is the affine bijector; `log_prob` of a Bernoulli
is negated.
"""

import distrax
import jax
import jax.numpy as jnp

__version__ = distrax.__version__
convert = jnp.asarray


def setup(dtype):
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)


def categorical_log_prob(log_probs, onehot):
    return distrax.OneHotCategorical(logits=log_probs).log_prob(onehot)


def categorical_entropy(log_probs):
    return distrax.OneHotCategorical(logits=log_probs).entropy()


def categorical_kl(log_probs_p, log_probs_q):
    return distrax.OneHotCategorical(logits=log_probs_p).kl_divergence(distrax.OneHotCategorical(logits=log_probs_q))


def draw_categorical(logits, unimix, seed, n):
    probs = (1 - unimix) * distrax.Categorical(logits=logits).probs + unimix / logits.shape[-1]
    return distrax.OneHotCategorical(probs=probs).sample(seed=jax.random.key(seed), sample_shape=n)


def bernoulli_loss(logit, target):
    return -distrax.Bernoulli(logits=logit).log_prob(target)


def bernoulli_mean(logit):
    return distrax.Bernoulli(logits=logit).mean()


def normal_sample(mean, std, normal):
    return distrax.ScalarAffine(shift=mean, scale=std).forward(normal)


def normal_log_prob(mean, std, value):
    return distrax.Normal(mean, std).log_prob(value)


def normal_entropy(std):
    return distrax.Normal(jnp.zeros_like(std), std).entropy()


def draw_normal(mean, std, seed, n):
    return distrax.Normal(mean, std).sample(seed=jax.random.key(seed), sample_shape=n)
