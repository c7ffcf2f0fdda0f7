"""Actions from the actor's outputs, the actor and critic losses, and the slow critic. Chapter: spec/08-behavior.md."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.distributions import (
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
from reference_numpy.shapes import checked, require_keys, require_shapes
from reference_numpy.stop_gradient import stop_gradient
from reference_numpy.transforms import exponential_bins
from spec.config import Config
from spec.spaces import Discrete, Spaces, Vector

Array = NDArray[np.float64]
Outputs = Mapping[str, Mapping[str, Any]]


def sample_action(outputs: Outputs, noise: Any, spaces: Spaces, config: Config) -> Array:
    """A flat action from the actor's raw outputs, a constant.
    Implements [BEH-1] to [BEH-5], [BEH-8], [BEH-22], [BEH-23].

    Paper: section Critic learning, the actor; D-22, D-66, D-67, D-70.

    Args:
      outputs: action key -> {"logits": [..., sum of classes]} or {"mean", "std": [..., size]}.
      noise: [..., K], for each key in sorted order its standard normals (Vector) or uniforms (Discrete).

    Returns:
      [..., A], not clipped.

    Raises:
      ValueError: wrong keys or shapes.
    """
    converted = _checked_outputs(outputs, spaces, config)
    noise = checked("noise", noise, *_leading(converted), spaces.action_noise_size)
    parts = []
    used = 0
    for key, space in spaces.actions.items():
        count = space.array_shape[0]
        own = noise[..., used : used + count]
        used += count
        if isinstance(space, Vector):
            mean, std = _normal(converted[key], config)
            parts.append(normal_sample(mean, std, own))
        else:
            for entry, (log_probs, _) in enumerate(_categoricals(converted[key]["logits"], space, config)):
                parts.append(categorical_sample(log_probs, own[..., entry]))
    return np.asarray(stop_gradient(np.concatenate(parts, axis=-1)))


def mode_action(outputs: Outputs, spaces: Spaces, config: Config) -> Array:
    """The mode of the actor instead of a sample. Implements [LOOP-71]; paper: silent, E-26.

    Args:
      outputs: as in `sample_action`.

    Returns:
      [..., A]: for a Vector the mean; for every entry of a Discrete one-hot at the most probable class, the first of
      equals.

    Raises:
      ValueError: wrong keys or shapes.
    """
    converted = _checked_outputs(outputs, spaces, config)
    parts = []
    for key, space in spaces.actions.items():
        if isinstance(space, Vector):
            parts.append(_normal(converted[key], config)[0])
        else:
            for log_probs, _ in _categoricals(converted[key]["logits"], space, config):
                parts.append(np.eye(log_probs.shape[-1])[np.argmax(log_probs, axis=-1)])
    return np.asarray(stop_gradient(np.concatenate(parts, axis=-1)))


def action_log_prob(outputs: Outputs, action: Any, spaces: Spaces, config: Config) -> Array:
    """The log-probability of a flat action. Implements [BEH-2], [BEH-4] to [BEH-6], [BEH-22], [BEH-23].

    Paper: section Actor learning; D-22, D-66 to D-68.

    Args:
      outputs: as in `sample_action`.
      action: [..., A], as sampled; a constant in the gradient.

    Returns:
      [...], nats, summed over dimensions, entries and keys.

    Raises:
      ValueError: wrong keys or shapes.
    """
    converted = _checked_outputs(outputs, spaces, config)
    leading = _leading(converted)
    action = np.asarray(stop_gradient(checked("action", action, *leading, spaces.action_size)))
    total = np.zeros(leading)
    start = 0
    for key, space in spaces.actions.items():
        own = action[..., start : start + space.encoded_size]
        start += space.encoded_size
        if isinstance(space, Vector):
            mean, std = _normal(converted[key], config)
            total = total + np.sum(normal_log_prob(mean, std, own), axis=-1)
        else:
            for log_probs, segment in _categoricals(converted[key]["logits"], space, config):
                total = total + categorical_log_prob(log_probs, own[..., segment])
    return total


def action_entropy(outputs: Outputs, spaces: Spaces, config: Config) -> Array:
    """The entropy of the policy. Implements [BEH-2], [BEH-4], [BEH-7], [BEH-22], [BEH-23].

    Paper: section Actor learning; D-60, D-68.

    Args:
      outputs: as in `sample_action`.

    Returns:
      [...], nats, summed over dimensions, entries and keys; negative where normals are narrow.

    Raises:
      ValueError: wrong keys or shapes.
    """
    converted = _checked_outputs(outputs, spaces, config)
    total = np.zeros(_leading(converted))
    for key, space in spaces.actions.items():
        if isinstance(space, Vector):
            _, std = _normal(converted[key], config)
            total = total + np.sum(normal_entropy(std), axis=-1)
        else:
            for log_probs, _ in _categoricals(converted[key]["logits"], space, config):
                total = total + categorical_entropy(log_probs)
    return total


def actor_loss(log_prob: Any, entropy: Any, returns: Any, value: Any, weight: Any, scale: Any, config: Config) -> Array:
    """The Reinforce loss with entropy regularizer.
    Implements [BEH-9] to [BEH-11], [BEH-17], [BEH-18], [BEH-22] to [BEH-24].

    Paper: section Actor learning, the loss with its sign corrected; D-09, D-60, D-61.

    Args:
      log_prob, entropy: [N, H], nats; the gradient passes through these two only.
      returns, value: [N, H], units of reward: the λ-return and the live critic's mean at the same states.
      weight: [N, H].
      scale: scalar, units of reward.

    Returns:
      [N, H], not reduced.

    Raises:
      ValueError: a wrong shape.
    """
    log_prob = checked("log_prob", log_prob, "N", "H")
    entropy = checked("entropy", entropy, *log_prob.shape)
    returns = checked("returns", returns, *log_prob.shape)
    value = checked("value", value, *log_prob.shape)
    weight = checked("weight", weight, *log_prob.shape)
    scale = checked("scale", scale)
    advantage = stop_gradient((returns - value) / scale)
    return np.asarray(-stop_gradient(weight) * (advantage * log_prob + config.entropy_scale * entropy))


def critic_loss(logits: Any, slow_logits: Any, returns: Any, weight: Any, config: Config) -> Array:
    """The critic's loss at imagined states. Implements [BEH-12], [BEH-13], [BEH-16] to [BEH-18], [BEH-22] to [BEH-24].

    Paper: section Critic learning; D-09, D-51, D-53.

    Args:
      logits, slow_logits: [N, H, bins], critic and slow critic at the same states; the gradient passes through the
        first only.
      returns: [N, H], units of reward.
      weight: [N, H].

    Returns:
      [N, H], nats, not reduced.

    Raises:
      ValueError: a wrong shape.
    """
    weight = checked("weight", weight, "N", "H")
    return np.asarray(
        stop_gradient(weight) * _regularized_value_loss(logits, slow_logits, returns, weight.shape, config)
    )


def replay_critic_loss(logits: Any, slow_logits: Any, returns: Any, is_last: Any, config: Config) -> Array:
    """The critic's loss along replayed sequences. Implements [BEH-14] to [BEH-18], [BEH-22] to [BEH-24].

    Paper: section Critic learning, the paragraph on the critic replay loss; D-32, D-54, D-55.

    Args:
      logits, slow_logits: [B, T-1, bins], critic and slow critic at the posterior states 0 .. T-2; the gradient passes
        through the first only.
      returns: [B, T-1], units of reward, of `replay_lambda_return`.
      is_last: [B, T-1], flags of the same steps, booleans or 0 and 1.

    Returns:
      [B, T-1], nats, not reduced; 0 at the last step of an episode.

    Raises:
      ValueError: a wrong shape.
    """
    is_last = checked("is_last", is_last, "B", "T-1")
    return np.asarray((1 - is_last) * _regularized_value_loss(logits, slow_logits, returns, is_last.shape, config))


def update_slow_critic(slow: Mapping[str, Any], critic: Mapping[str, Any], decay: float) -> dict[str, Array]:
    """The slow critic after one more step of its moving average. Implements [BEH-19] to [BEH-21].

    Paper: section Critic learning and table of hyperparameters; D-52.

    Args:
      slow: name -> array.
      critic: name -> array, the parameters after the optimizer step; names outside `critic/` are ignored.
      decay: `config.slow_critic_decay`.

    Returns:
      Name -> array, a new mapping with the names of `slow`.

    Raises:
      ValueError: names or shapes do not match.
    """
    require_shapes("slow", slow, {name: np.shape(x) for name, x in critic.items() if name.startswith("critic/")})
    updated: dict[str, Array] = {}
    for name in slow:
        old, new = np.asarray(slow[name], dtype=np.float64), np.asarray(critic[name], dtype=np.float64)
        updated[name] = decay * old + (1 - decay) * new
    return updated


def _regularized_value_loss(
    logits: Any, slow_logits: Any, returns: Any, shape: tuple[int, ...], config: Config
) -> Array:
    """[rows, steps]: cross entropy towards the return and towards the slow critic's mean, both targets constant."""
    logits = checked("logits", logits, *shape, config.bins)
    slow_logits = checked("slow_logits", slow_logits, *shape, config.bins)
    returns = checked("returns", returns, *shape)
    bins = exponential_bins(config.bins)
    slow_mean = stop_gradient(symexp_twohot_mean(slow_logits, bins))
    towards_return = symexp_twohot_loss(logits, stop_gradient(returns), bins)
    towards_slow = symexp_twohot_loss(logits, slow_mean, bins)
    return np.asarray(towards_return + config.slow_critic_scale * towards_slow)


def _checked_outputs(outputs: Outputs, spaces: Spaces, config: Config) -> dict[str, dict[str, Array]]:
    """The outputs in float64, their keys and shapes checked; all share their leading axes."""
    require_keys("outputs", outputs, spaces.actions, exactly=True)
    leading: tuple[int, ...] | None = None
    converted: dict[str, dict[str, Array]] = {}
    for key, space in spaces.actions.items():
        names = ("logits",) if isinstance(space, Discrete) else ("mean", "std")
        require_keys(f"outputs[{key!r}]", outputs[key], names, exactly=True)
        converted[key] = {}
        for name in names:
            axes = (...,) if leading is None else leading
            array = checked(f"outputs[{key!r}][{name!r}]", outputs[key][name], *axes, space.encoded_size)
            leading = array.shape[:-1]
            converted[key][name] = array
    return converted


def _leading(converted: dict[str, dict[str, Array]]) -> tuple[int, ...]:
    first = next(iter(next(iter(converted.values())).values()))
    return first.shape[:-1]


def _normal(outputs: Mapping[str, Array], config: Config) -> tuple[Array, Array]:
    mean, std = bounded_normal(outputs["mean"], outputs["std"], config.actor_min_std, config.actor_max_std)
    return mean, std


def _categoricals(logits: Array, space: Discrete, config: Config) -> Iterator[tuple[Array, slice]]:
    """For each entry of `classes` its mixed log-probabilities, and its place in the logits and in the flat action."""
    start = 0
    for classes in space.classes:
        segment = slice(start, start + classes)
        start += classes
        yield unimix_log_probs(logits[..., segment], config.actor_unimix), segment
