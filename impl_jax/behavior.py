"""Actor and critic: actions, their log-probability and entropy, and the three losses. Chapter: spec/08-behavior.md.

The losses are elementwise and not weighted by their scales [BEH-17]; they accept any leading axes in place of [N, H],
so that training can keep time first.
"""

import functools
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jax.typing import ArrayLike

from impl_jax.distributions import (
    bounded_normal,
    categorical_entropy,
    categorical_log_prob,
    categorical_sample,
    normal_entropy,
    normal_log_prob,
    normal_sample,
    symexp_twohot_loss,
    symexp_twohot_mean,
    unimix_log_probs,
)
from impl_jax.shapes import require_keys, require_same_shape, require_shape, require_shapes, widen
from impl_jax.transforms import exponential_bins
from spec import Config, Discrete, Spaces

Outputs = Mapping[str, Mapping[str, jax.Array]]


def _require_outputs(outputs: Outputs, spaces: Spaces) -> tuple[int, ...]:
    """The leading axes of the actor's outputs, after checks of keys and shapes. [BEH-23]"""
    require_keys("outputs", outputs, spaces.actions, exactly=True)
    leading: tuple[Any, ...] = (...,)
    for key, space in spaces.actions.items():
        names = ("logits",) if isinstance(space, Discrete) else ("mean", "std")
        require_keys(f"outputs[{key!r}]", outputs[key], names, exactly=True)
        for name in names:
            shape = outputs[key][name].shape
            require_shape(f"outputs[{key!r}][{name!r}]", shape, *leading, space.encoded_size)
            leading = shape[:-1]  # the first one's, for all others
    return leading


class _Categorical(NamedTuple):
    """One entry of a Discrete. [BEH-2]"""

    log_probs: jax.Array  # [..., classes]
    length: int  # in the flat action
    noise: int = 1  # length in the noise

    def sample(self, noise: jax.Array) -> jax.Array:
        return categorical_sample(self.log_probs, noise[..., 0])

    def mode(self) -> jax.Array:
        return jax.nn.one_hot(jnp.argmax(self.log_probs, -1), self.length, dtype=self.log_probs.dtype)

    def log_prob(self, action: jax.Array) -> jax.Array:
        return categorical_log_prob(self.log_probs, action)

    def entropy(self) -> jax.Array:
        return categorical_entropy(self.log_probs)


class _Normals(NamedTuple):
    """All dimensions of a Vector. [BEH-4]"""

    mean: jax.Array  # [..., size]
    std: jax.Array  # [..., size]
    length: int
    noise: int

    def sample(self, noise: jax.Array) -> jax.Array:
        return normal_sample(self.mean, self.std, noise)

    def mode(self) -> jax.Array:
        return self.mean

    def log_prob(self, action: jax.Array) -> jax.Array:
        return jnp.sum(normal_log_prob(self.mean, self.std, action), -1)

    def entropy(self) -> jax.Array:
        return jnp.sum(normal_entropy(self.std), -1)


def _distributions(outputs: Outputs, spaces: Spaces, config: Config) -> Iterator[_Categorical | _Normals]:
    """The independent parts of the policy, in the order of the flat action. [BEH-22]"""
    for key, space in spaces.actions.items():
        if isinstance(space, Discrete):
            start = 0
            for classes in space.classes:
                segment = outputs[key]["logits"][..., start : start + classes]
                yield _Categorical(unimix_log_probs(segment, config.actor_unimix), classes)
                start += classes
        else:
            mean, std = outputs[key]["mean"], outputs[key]["std"]
            mean, std = bounded_normal(mean, std, config.actor_min_std, config.actor_max_std)
            yield _Normals(mean, std, space.size, space.size)


def sample_action(outputs: Outputs, noise: jax.Array, spaces: Spaces, config: Config) -> jax.Array:
    """A flat action [..., A] from noise [..., K], neither clipped nor squashed, constant. [BEH-1] to [BEH-5]"""
    leading = _require_outputs(outputs, spaces)
    require_shape("noise", noise.shape, *leading, spaces.action_noise_size)
    actions, start = [], 0
    for part in _distributions(outputs, spaces, config):
        actions.append(part.sample(noise[..., start : start + part.noise]))
        start += part.noise
    return jnp.concatenate(actions, -1)


def mode_action(outputs: Outputs, spaces: Spaces, config: Config) -> jax.Array:
    """The mode of the policy as a flat action [..., A], constant. [LOOP-71]"""
    _require_outputs(outputs, spaces)
    return stop_gradient(jnp.concatenate([part.mode() for part in _distributions(outputs, spaces, config)], -1))


def action_log_prob(outputs: Outputs, action: jax.Array, spaces: Spaces, config: Config) -> jax.Array:
    """Log-probability of a flat action [..., A], a constant, summed over its parts: [...], nats. [BEH-5], [BEH-6]"""
    leading = _require_outputs(outputs, spaces)
    require_shape("action", action.shape, *leading, spaces.action_size)
    total, start = [], 0
    for part in _distributions(outputs, spaces, config):
        total.append(part.log_prob(action[..., start : start + part.length]))
        start += part.length
    return functools.reduce(jnp.add, total)


def action_entropy(outputs: Outputs, spaces: Spaces, config: Config) -> jax.Array:
    """Entropy of the policy, summed over all its parts: [...], nats. [BEH-7]"""
    _require_outputs(outputs, spaces)
    return functools.reduce(jnp.add, [part.entropy() for part in _distributions(outputs, spaces, config)])


def actor_loss(
    log_prob: jax.Array,
    entropy: jax.Array,
    returns: jax.Array,
    value: jax.Array,
    weight: jax.Array,
    scale: ArrayLike,
    config: Config,
) -> jax.Array:
    """-weight * (advantage * log_prob + entropy_scale * entropy): [N, H] five times -> [N, H]. [BEH-9], [BEH-10]

    Section "Actor learning".
    """
    require_same_shape(log_prob=log_prob, entropy=entropy, returns=returns, value=value, weight=weight)
    require_shape("scale", jnp.shape(scale))
    log_prob, entropy = widen(log_prob), widen(entropy)
    advantage = stop_gradient((widen(returns) - widen(value)) / widen(scale))
    return -stop_gradient(widen(weight)) * (advantage * log_prob + config.entropy_scale * entropy)


def _value_loss(logits: jax.Array, slow_logits: jax.Array, returns: jax.Array, config: Config) -> jax.Array:
    """Cross-entropy towards the return and towards the slow critic's mean. Section "Critic learning"."""
    require_shape("logits", logits.shape, *returns.shape, config.bins)
    require_same_shape(logits=logits, slow_logits=slow_logits)
    bins = exponential_bins(config.bins)
    slow_mean = stop_gradient(symexp_twohot_mean(slow_logits, bins))
    towards_return = symexp_twohot_loss(logits, returns, bins)  # XLA finds that both losses take the same log-softmax
    return towards_return + config.slow_critic_scale * symexp_twohot_loss(logits, slow_mean, bins)


def critic_loss(
    logits: jax.Array, slow_logits: jax.Array, returns: jax.Array, weight: jax.Array, config: Config
) -> jax.Array:
    """The critic's loss in imagination: [N, H, bins] twice and [N, H] twice -> [N, H]. [BEH-12], [BEH-13]"""
    require_same_shape(weight=weight, returns=returns)
    return stop_gradient(widen(weight)) * _value_loss(logits, slow_logits, returns, config)


def replay_critic_loss(
    logits: jax.Array, slow_logits: jax.Array, returns: jax.Array, is_last: jax.Array, config: Config
) -> jax.Array:
    """The critic's loss on replayed steps 0 .. T-2, 0 where an episode ends. [BEH-14], [BEH-15]

    [B, T-1, bins] twice and [B, T-1] twice -> [B, T-1].
    """
    require_same_shape(is_last=is_last, returns=returns)
    loss = _value_loss(logits, slow_logits, returns, config)
    return (1.0 - jnp.asarray(is_last).astype(loss.dtype)) * loss


def update_slow_critic(
    slow: Mapping[str, jax.Array], critic: Mapping[str, jax.Array], decay: float
) -> dict[str, jax.Array]:
    """decay * slow + (1 - decay) * critic for every name of the slow critic, in its precision. [BEH-19], [BEH-20]

    Raises:
      ValueError: names or shapes that differ.
    """
    require_shapes("slow", slow, {name: x.shape for name, x in critic.items() if name.startswith("critic/")})
    return {
        name: (decay * value + (1.0 - decay) * critic[name].astype(value.dtype)).astype(value.dtype)
        for name, value in slow.items()
    }
