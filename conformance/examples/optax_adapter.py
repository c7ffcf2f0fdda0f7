"""optax: adaptive gradient clipping, LaProp put together of RMS scaling and a moving average, warmup, losses, moving
averages.

Written for optax 0.2.8. Gradients are clipped over all axes; the default there is by output unit. `learning_rate` is
what `scale_by_learning_rate` would multiply by.
"""

import jax
import jax.numpy as jnp
import optax

__version__ = optax.__version__
convert = jnp.asarray


def setup(dtype):
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)


def adaptive_gradient_clip(gradient, parameter, clip, epsilon):
    transformation = optax.adaptive_grad_clip(clip, epsilon, axis=tuple(range(gradient.ndim)))
    return transformation.update(gradient, transformation.init(parameter), parameter)[0]


def laprop(gradient, second_moment, momentum, step, config):
    scale = optax.scale_by_rms(config.beta2, config.laprop_epsilon, bias_correction=True, eps_in_sqrt=False)
    average = optax.ema(config.beta1, debias=True)
    count = jnp.asarray(step, jnp.int32)
    normalized, scaled = scale.update(gradient, scale.init(gradient)._replace(count=count, nu=second_moment))
    update, averaged = average.update(normalized, average.init(gradient)._replace(count=count, ema=momentum))
    return update, scaled.nu, averaged.ema


def learning_rate(step, config):
    return optax.warmup_constant_schedule(0.0, config.learning_rate, config.warmup_steps)(step)


def bernoulli_loss(logit, target):
    return optax.sigmoid_binary_cross_entropy(logit, target)


def bernoulli_mean(logit):
    return jax.nn.sigmoid(logit)


def categorical_log_prob(log_probs, onehot):
    return -optax.softmax_cross_entropy(log_probs, onehot)


def categorical_entropy(log_probs):
    return optax.softmax_cross_entropy(log_probs, jnp.exp(log_probs))


def categorical_kl(log_probs_p, log_probs_q):
    return optax.losses.kl_divergence_with_log_targets(log_probs_q, log_probs_p)


def update_slow_critic(slow, critic, decay):
    return optax.incremental_update(
        {name: x for name, x in critic.items() if name.startswith("critic/")}, slow, 1 - decay
    )
