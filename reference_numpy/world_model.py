"""The losses of the world model, one value per loss and time step. Chapter: spec/06-world-model.md."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy import networks, rssm
from reference_numpy.distributions import (
    bernoulli_loss,
    bernoulli_mean,
    categorical_kl,
    categorical_log_prob,
    categorical_sample,
    mse_loss,
    symexp_twohot_loss,
    symexp_twohot_mean,
    symlog_mse_loss,
    unimix_log_probs,
)
from reference_numpy.observations import one_hots, scaled_image
from reference_numpy.shapes import checked, require, require_keys, require_observations, require_shape
from reference_numpy.stop_gradient import stop_gradient
from reference_numpy.transforms import exponential_bins, symexp
from spec.config import Config
from spec.spaces import Discrete, Image, Spaces, Vector

Array = NDArray[np.float64]


def continue_target(is_terminal: Any, config: Config) -> Array:
    """What the continue head learns. Implements [WM-7].

    Paper: World model learning ("continuation flags"); D-06.

    Args:
      is_terminal: [...] bool, true terminations only.

    Returns:
      [...]: 0 at terminations; elsewhere 1, or the discount if `continue_target` is "discounted".
    """
    going_on = 1.0 - np.asarray(is_terminal, dtype=bool)
    return going_on * config.discount if config.continue_target == "discounted" else going_on


def kl_losses(posterior_logits: Any, prior_logits: Any, config: Config) -> tuple[Array, Array]:
    """Dynamics and representation loss, in nats. Implements [WM-10] to [WM-14], [WM-18], [WM-19].

    Paper: World model learning (L_dyn, L_rep, free bits); D-18 to D-21, D-23.

    Args:
      posterior_logits: [..., S, C], before the uniform mixture.
      prior_logits: [..., S, C], before the uniform mixture.

    Returns:
      dynamics [...] and representation [...], each at least `free_nats`.

    Raises:
      ValueError: a shape does not fit.
    """
    posterior_logits = checked("posterior_logits", posterior_logits, ..., config.stoch, config.classes)
    prior_logits = checked("prior_logits", prior_logits, *posterior_logits.shape)
    posterior = unimix_log_probs(posterior_logits, config.latent_unimix)
    prior = unimix_log_probs(prior_logits, config.latent_unimix)
    dynamics = categorical_kl(stop_gradient(posterior), prior).sum(axis=-1)
    representation = categorical_kl(posterior, stop_gradient(prior)).sum(axis=-1)
    return np.maximum(config.free_nats, dynamics), np.maximum(config.free_nats, representation)


def reconstruction_losses(
    predictions: Mapping[str, Any], observations: Mapping[str, Any], spaces: Spaces, config: Config
) -> dict[str, Array]:
    """How badly each observation was reconstructed. Implements [WM-2] to [WM-5], [WM-17], [WM-19].

    Paper: Robust predictions (vectors); D-14 to D-17.

    Args:
      predictions: output of the decoder: Vector [..., size] in symlog space, Discrete [..., sum of classes], Image
        [..., height, width, channels].
      observations: raw observations by key, each [..., *array_shape]; other keys are ignored.

    Returns:
      By observation key: [...], summed over everything that belongs to one observation.

    Raises:
      ValueError: a key is missing, or a shape, dtype or Discrete value does not fit.
    """
    require_keys("predictions", predictions, spaces.observations)
    rows = require_observations("observations", observations, spaces)
    losses = {}
    for key, space in spaces.observations.items():
        size = space.array_shape if isinstance(space, Image) else (space.encoded_size,)
        prediction = checked(f"predictions[{key!r}]", predictions[key], *rows, *size)
        if isinstance(space, Image):
            target = scaled_image(observations[key])
            losses[key] = mse_loss(prediction, target).sum(axis=(-3, -2, -1))
        elif isinstance(space, Discrete):
            target = one_hots(key, observations[key], space)
            losses[key] = _cross_entropy(prediction, target, space)
        else:
            target = np.asarray(observations[key], dtype=np.float64)
            losses[key] = symlog_mse_loss(prediction, target, config.vector_loss_scale).sum(axis=-1)
    return losses


def world_model_losses(
    params: Mapping[str, Any], batch: Mapping[str, Any], states: Mapping[str, Any], spaces: Spaces, config: Config
) -> dict[str, Array]:
    """Every loss of the world model at every time step, without weights.

    Implements [WM-1], [WM-6], [WM-8], [WM-9], [WM-15], [WM-16], [WM-19].

    Paper: World model learning (L_pred, L_dyn, L_rep); D-12, D-13, D-91, D-134, D-135.

    Args:
      params: `rssm/prior/...`, `decoder/...`, `reward/...` and `continue/...`.
      batch: raw observations, "reward" [B, T] and "is_terminal" [B, T] bool.
      states: "deter" [B, T, D], "stoch" [B, T, S, C] and "logits" [B, T, S, C], as `rssm.observe` returns them.

    Returns:
      {name: [B, T]}: "reconstruction/{key}" for every observation key, "reward", "continue", "dynamics" and
      "representation".

    Raises:
      ValueError: a key is missing, or a shape, dtype or Discrete value does not fit.
    """
    require_keys("batch", batch, (*spaces.observations, "reward", "is_terminal"))
    require_keys("states", states, ("deter", "stoch", "logits"))
    deter = checked("states['deter']", states["deter"], "B", "T", config.deter)
    rows = deter.shape[:-1]
    stoch = checked("states['stoch']", states["stoch"], *rows, config.stoch, config.classes)
    require_shape("states['logits']", np.shape(states["logits"]), *rows, config.stoch, config.classes)
    for key in ("reward", "is_terminal"):
        require_shape(f"batch[{key!r}]", np.shape(batch[key]), *rows)
    require_observations("batch", batch, spaces, rows)

    feature = networks.feature(deter, stoch)
    predictions = networks.decoder(params, feature, spaces, config)
    reconstruction = reconstruction_losses(predictions, batch, spaces, config)
    reward_logits = networks.reward_head(params, feature, config)
    continue_logit = networks.continue_head(params, feature, config)
    dynamics, representation = kl_losses(states["logits"], rssm.prior(params, deter, config), config)
    return {
        **{f"reconstruction/{key}": loss for key, loss in reconstruction.items()},
        "reward": symexp_twohot_loss(reward_logits, batch["reward"], exponential_bins(config.bins)),
        "continue": bernoulli_loss(continue_logit, continue_target(batch["is_terminal"], config)),
        "dynamics": dynamics,
        "representation": representation,
    }


def open_loop(
    params: Mapping[str, Any],
    observation: Mapping[str, Any],
    prev_action: Any,
    is_first: Any,
    context: int,
    noise: Mapping[str, Any],
    spaces: Spaces,
    config: Config,
) -> dict[str, Array]:
    """What the model sees coming: a few observations, then actions alone. Implements [WM-20] to [WM-24].

    Paper: World model learning (figure of multi-step predictions); D-138.

    Args:
      params: `encoder/...`, `rssm/...`, `decoder/...`, `reward/...` and `continue/...`.
      observation: key -> [B, T, ...], raw; what comes after the context is not read.
      prev_action: [B, T, A]; entry t is the flat action that led to observation t.
      is_first: [B, T] bool.
      context: steps with observations, 1 to T - 1.
      noise: {"posterior" [B, context, S], "prior" [B, T - context, S]}, numbers in [0, 1).

    Returns:
      At every step, by observation key: Vector [B, T, size] in its own units, Discrete [B, T, sum of classes]
      probabilities, Image [B, T, height, width, channels] in [0, 1]; and "reward" and the probability "continue_"
      [B, T].

    Raises:
      ValueError: a key is missing, a shape, dtype or Discrete value does not fit, or the context is no part of the
        sequence.
    """
    is_first = np.asarray(is_first, dtype=bool)
    require_shape("is_first", is_first.shape, "B", "T")
    rows, steps = is_first.shape
    require(1 <= context < steps, "context", f"1 to {steps - 1} steps of {steps}", context)
    prev_action = checked("prev_action", prev_action, rows, steps, spaces.action_size)
    posterior_noise = checked("noise['posterior']", noise["posterior"], rows, context, config.stoch)
    prior_noise = checked("noise['prior']", noise["prior"], rows, steps - context, config.stoch)
    require_observations("observation", observation, spaces, (rows, steps))

    seen = {key: np.asarray(observation[key])[:, :context] for key in spaces.observations}
    tokens = networks.encoder(params, seen, spaces, config)
    zeros = {"deter": np.zeros((rows, config.deter)), "stoch": np.zeros((rows, config.stoch, config.classes))}
    states = rssm.observe(
        params, zeros, tokens, prev_action[:, :context], is_first[:, :context], posterior_noise, config
    )
    deters, stochs = list(np.moveaxis(states["deter"], 1, 0)), list(np.moveaxis(states["stoch"], 1, 0))
    for t in range(context, steps):
        starts = is_first[:, t, None]
        stoch = np.where(starts[..., None], 0.0, stochs[-1])
        deter = rssm.core(
            params, np.where(starts, 0.0, deters[-1]), stoch, np.where(starts, 0.0, prev_action[:, t]), config
        )
        log_probs = unimix_log_probs(rssm.prior(params, deter, config), config.latent_unimix)
        deters.append(deter)
        stochs.append(categorical_sample(log_probs, prior_noise[:, t - context]))

    feature = networks.feature(np.stack(deters, axis=1), np.stack(stochs, axis=1))
    predictions = networks.decoder(params, feature, spaces, config)
    return {
        **{key: _in_units(predictions[key], space) for key, space in spaces.observations.items()},
        "reward": symexp_twohot_mean(networks.reward_head(params, feature, config), exponential_bins(config.bins)),
        "continue_": bernoulli_mean(networks.continue_head(params, feature, config)),
    }


def _in_units(prediction: Array, space: Vector | Discrete | Image) -> Array:
    """The decoder's output as what it predicts: [WM-23]."""
    if isinstance(space, Vector):
        return symexp(prediction)
    if isinstance(space, Discrete):
        entries = np.split(prediction, np.cumsum(space.classes)[:-1], axis=-1)
        return np.concatenate([np.exp(unimix_log_probs(logits, 0.0)) for logits in entries], axis=-1)
    return prediction


def _cross_entropy(logits: Array, target: Array, space: Discrete) -> Array:
    """Cross entropy of one categorical for each entry of a Discrete, their sum: [..., sum of classes] -> [...]."""
    total, first = np.zeros(logits.shape[:-1]), 0
    for classes in space.classes:
        entry = slice(first, first + classes)
        total = total - categorical_log_prob(unimix_log_probs(logits[..., entry], 0.0), target[..., entry])
        first += classes
    return total
