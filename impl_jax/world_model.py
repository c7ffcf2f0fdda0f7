"""World model losses: predictions, dynamics and representation. Chapter: spec/06-world-model.md."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax import lax
from jax.lax import stop_gradient

from impl_jax import networks, rssm
from impl_jax.distributions import (
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
from impl_jax.layers import Params
from impl_jax.shapes import (
    compute_dtype,
    require,
    require_keys,
    require_observations,
    require_same_shape,
    require_shape,
    wide_dtype,
)
from impl_jax.transforms import exponential_bins, symexp
from spec import Config, Discrete, Image, Spaces, Vector

Arrays = Mapping[str, jax.Array]


def continue_target(is_terminal: jax.Array, config: Config) -> jax.Array:
    """1 - is_terminal [...], times gamma for a "discounted" continue head; float32 or better. [WM-7]"""
    alive = 1.0 - is_terminal.astype(wide_dtype(config))
    return alive * config.discount if config.continue_target == "discounted" else alive


def kl_losses(posterior_logits: jax.Array, prior_logits: jax.Array, config: Config) -> tuple[jax.Array, jax.Array]:
    """Dynamics and representation loss, at least free_nats: [..., S, C] twice -> [...] twice, nats. [WM-10] to [WM-14]

    Section "World model learning", losses L_dyn and L_rep.
    """
    require_shape("posterior_logits", posterior_logits.shape, ..., config.stoch, config.classes)
    require_same_shape(posterior_logits=posterior_logits, prior_logits=prior_logits)
    posterior, prior = (unimix_log_probs(logits, config.latent_unimix) for logits in (posterior_logits, prior_logits))

    def clipped(p: jax.Array, q: jax.Array) -> jax.Array:
        kl = jnp.sum(categorical_kl(p, q), axis=-1)
        # Selected, not a maximum: below the free nats the gradient is exactly 0, and a NaN stays.
        return jnp.where(kl < config.free_nats, jnp.asarray(config.free_nats, kl.dtype), kl)

    return clipped(stop_gradient(posterior), prior), clipped(posterior, stop_gradient(prior))


def reconstruction_losses(
    predictions: Arrays, observations: Arrays, spaces: Spaces, config: Config
) -> dict[str, jax.Array]:
    """key -> [...]: squared symlog error, cross-entropy in nats, or squared brightness error. [WM-2] to [WM-5], [WM-17]

    Raises:
      ValueError: a missing key, or a wrong shape or dtype. [WM-19]
    """
    require_keys("predictions", predictions, spaces.observations)
    leading = require_observations("observations", observations, spaces)
    result = {}
    for key, space in spaces.observations.items():
        prediction, x = predictions[key], observations[key]
        size = space.array_shape if isinstance(space, Image) else (space.encoded_size,)
        require_shape(f"predictions[{key!r}]", prediction.shape, *leading, *size)
        if isinstance(space, Image):
            target = x.astype(wide_dtype(config)) / 255.0
            result[key] = jnp.sum(mse_loss(prediction, target), axis=(-3, -2, -1))
        elif isinstance(space, Discrete):
            result[key] = -_discrete_log_prob(prediction, x, space)
        else:
            loss = symlog_mse_loss(prediction, x.astype(wide_dtype(config)), config.vector_loss_scale)
            result[key] = jnp.sum(loss, axis=-1)
    return result


def _discrete_log_prob(logits: jax.Array, x: jax.Array, space: Discrete) -> jax.Array:
    """Log-probability of the classes x [..., entries] under joined logits, summed over the entries. [WM-3]"""
    onehots = networks.onehots(x, space, logits.dtype)
    total, start = jnp.zeros(x.shape[:-1], logits.dtype), 0
    for classes in space.classes:
        segment = slice(start, start + classes)
        total += categorical_log_prob(unimix_log_probs(logits[..., segment], 0.0), onehots[..., segment])
        start += classes
    return total


def world_model_losses(
    params: Params, batch: Arrays, states: Arrays, spaces: Spaces, config: Config
) -> dict[str, jax.Array]:
    """{name: [B, T]}, unweighted: "reconstruction/{key}", "reward", "continue", "dynamics", "representation".

    [WM-1], [WM-6], [WM-8], [WM-9], [WM-15], [WM-16]
    states: what `observe` returned, {"deter" [B, T, D], "stoch" and "logits" [B, T, S, C]}.
    """
    require_keys("batch", batch, (*spaces.observations, "reward", "is_terminal"))
    require_keys("states", states, ("deter", "stoch", "logits"))
    for key in ("reward", "is_terminal"):
        require_shape(f"batch[{key!r}]", batch[key].shape, *states["deter"].shape[:-1])
    feature = networks.feature(states["deter"], states["stoch"])
    bins = exponential_bins(config.bins)
    reconstruction = reconstruction_losses(networks.decoder(params, feature, spaces, config), batch, spaces, config)
    dynamics, representation = kl_losses(states["logits"], rssm.prior(params, states["deter"], config), config)
    return {f"reconstruction/{key}": loss for key, loss in reconstruction.items()} | {
        "reward": symexp_twohot_loss(networks.reward_head(params, feature, config), batch["reward"], bins),
        "continue": bernoulli_loss(
            networks.continue_head(params, feature, config), continue_target(batch["is_terminal"], config)
        ),
        "dynamics": dynamics,
        "representation": representation,
    }


def open_loop(
    params: Params,
    observation: Arrays,
    prev_action: jax.Array,
    is_first: jax.Array,
    context: int,
    noise: Arrays,
    spaces: Spaces,
    config: Config,
) -> dict[str, jax.Array]:
    """What the model sees coming, from a few observations and then actions alone. [WM-20] to [WM-24]

    observation: key -> [B, T, ...], of which the first `context` steps are read; prev_action [B, T, A];
    is_first [B, T]; noise: {"posterior" [B, context, S], "prior" [B, T - context, S]}.

    Returns:
      By observation key [B, T, ...]: numbers in their own units, probabilities, images in [0, 1]; "reward" and
      "continue_" [B, T].

    Raises:
      ValueError: a missing key, a wrong shape or dtype, or a context that is not within the sequence.
    """
    require_shape("is_first", is_first.shape, "B", "T")
    B, T = is_first.shape
    require(1 <= context < T, "context", f"1 to {T - 1} steps of {T}", context)
    require_shape("prev_action", prev_action.shape, B, T, spaces.action_size)
    require_shape("noise['posterior']", noise["posterior"].shape, B, context, config.stoch)
    require_shape("noise['prior']", noise["prior"].shape, B, T - context, config.stoch)
    require_observations("observation", observation, spaces, (B, T))

    known = {key: observation[key][:, :context] for key in spaces.observations}
    tokens = networks.encoder(params, known, spaces, config)
    dtype = compute_dtype(config)
    start = {"deter": jnp.zeros((B, config.deter), dtype), "stoch": jnp.zeros((B, config.stoch, config.classes), dtype)}
    seen = rssm.observe(
        params, start, tokens, prev_action[:, :context], is_first[:, :context], noise["posterior"], config
    )

    def step(
        carry: dict[str, jax.Array], now: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[dict[str, jax.Array], Arrays]:
        action, first, uniform = now  # [B, A], [B], [B, S]
        deter, stoch, action = (
            jnp.where(first.reshape(B, *[1] * (x.ndim - 1)), 0, x) for x in (carry["deter"], carry["stoch"], action)
        )
        deter = rssm.core(params, deter, stoch, action, config)
        sample = categorical_sample(unimix_log_probs(rssm.prior(params, deter, config), config.latent_unimix), uniform)
        carry = {"deter": deter, "stoch": sample.astype(dtype)}
        return carry, carry

    inputs = (
        prev_action[:, context:].swapaxes(0, 1),
        is_first[:, context:].swapaxes(0, 1),
        noise["prior"].swapaxes(0, 1),
    )
    _, unseen = lax.scan(step, {name: seen[name][:, -1] for name in start}, inputs)
    states = {name: jnp.concatenate([seen[name], unseen[name].swapaxes(0, 1)], 1) for name in start}

    feature = networks.feature(states["deter"], states["stoch"])
    predictions = networks.decoder(params, feature, spaces, config)
    return {key: _in_units(predictions[key], space) for key, space in spaces.observations.items()} | {
        "reward": symexp_twohot_mean(networks.reward_head(params, feature, config), exponential_bins(config.bins)),
        "continue_": bernoulli_mean(networks.continue_head(params, feature, config)),
    }


def _in_units(prediction: jax.Array, space: Vector | Discrete | Image) -> jax.Array:
    """The decoder's output as what it predicts. [WM-23]"""
    if isinstance(space, Vector):
        return symexp(prediction)
    if isinstance(space, Discrete):
        ends = [sum(space.classes[: entry + 1]) for entry in range(len(space.classes) - 1)]
        return jnp.concatenate([jax.nn.softmax(logits) for logits in jnp.split(prediction, ends, -1)], -1)
    return prediction
