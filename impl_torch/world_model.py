"""What the world model is trained for. Chapter: spec/06-world-model.md."""

from collections.abc import Mapping

import torch
import torch.nn.functional as F  # noqa: N812 (so it is called everywhere)
from torch import Tensor

from impl_torch.distributions import (
    bernoulli_loss,
    bernoulli_mean,
    categorical_kl,
    categorical_log_prob,
    mse_loss,
    sample_onehot,
    symexp_twohot_loss,
    symexp_twohot_mean,
    symlog_mse_loss,
    unimix_log_probs,
    unimix_probs,
)
from impl_torch.layers import Params
from impl_torch.networks import continue_head, decoder, encoder, feature, reward_head
from impl_torch.rssm import core, observe, prepare, prior
from impl_torch.shapes import (
    Observations,
    compute_dtype,
    require,
    require_keys,
    require_observations,
    require_same_shape,
    require_shape,
    wide_dtype,
    widen,
)
from impl_torch.transforms import standard_bins, symexp
from spec import Config, Discrete, Image, Spaces, Vector


def continue_target(is_terminal: Tensor, config: Config) -> Tensor:
    """1 where the episode continues, times gamma if the head is to learn it: [...] bool -> [...]. [WM-7]"""
    scale = config.discount if config.continue_target == "discounted" else 1.0
    return scale * (1 - is_terminal.to(wide_dtype(config)))


def kl_losses(posterior_logits: Tensor, prior_logits: Tensor, config: Config) -> tuple[Tensor, Tensor]:
    """Dynamics and representation loss, at least free_nats: [..., S, C] twice -> [...] twice, nats. [WM-9] to [WM-14]

    Where a KL is below the free nats, the gradient of the clamp is exactly 0.
    """
    require_shape("posterior_logits", posterior_logits.shape, ..., config.stoch, config.classes)
    require_same_shape(posterior_logits=posterior_logits, prior_logits=prior_logits)
    posterior = unimix_log_probs(posterior_logits, config.latent_unimix)
    prior = unimix_log_probs(prior_logits.to(posterior.dtype), config.latent_unimix)
    dynamics = categorical_kl(posterior.detach(), prior).sum(-1)
    representation = categorical_kl(posterior, prior.detach()).sum(-1)
    return dynamics.clamp(min=config.free_nats), representation.clamp(min=config.free_nats)


def reconstruction_losses(
    predictions: Observations, observations: Observations, spaces: Spaces, config: Config
) -> dict[str, Tensor]:
    """{key: [...]} from the decoder's output and the raw observations. [WM-2] to [WM-5] [WM-17] to [WM-19]"""
    require_keys("predictions", predictions, spaces.observations)
    leading = require_observations("observations", observations, spaces)
    losses = {}
    for key, space in spaces.observations.items():
        prediction, target = widen(predictions[key]), observations[key]
        size = space.array_shape if isinstance(space, Image) else (space.encoded_size,)
        require_shape(f"predictions[{key!r}]", prediction.shape, *leading, *size)
        if isinstance(space, Vector):
            losses[key] = symlog_mse_loss(prediction, target, config.vector_loss_scale).sum(-1)
        elif isinstance(space, Image):
            losses[key] = mse_loss(prediction, target.to(prediction.dtype) / 255).sum((-3, -2, -1))
        else:
            entries = zip(prediction.split(space.classes, -1), target.unbind(-1), space.classes, strict=True)
            log_probs = [
                categorical_log_prob(unimix_log_probs(logits, 0.0), F.one_hot(value.long(), classes))
                for logits, value, classes in entries
            ]
            losses[key] = -torch.stack(log_probs).sum(0)
    return losses


def world_model_losses(
    params: Params, batch: Observations, states: Mapping[str, Tensor], spaces: Spaces, config: Config
) -> dict[str, Tensor]:
    """{name: [B, T]}, unweighted: "reconstruction/{key}", "reward", "continue", "dynamics", "representation".

    [WM-1] [WM-6] [WM-8] [WM-15] [WM-16]
    batch: raw observations, "reward" and "is_terminal" [B, T]; states: what `observe` returns.
    """
    require_keys("batch", batch, (*spaces.observations, "reward", "is_terminal"))
    require_keys("states", states, ("deter", "stoch", "logits"))
    leading = states["deter"].shape[:-1]
    for key in ("reward", "is_terminal"):
        require_shape(f"batch[{key!r}]", batch[key].shape, *leading)
    state = feature(states["deter"], states["stoch"])  # [B, T, F]: read by all heads, so joined once
    reconstructions = reconstruction_losses(decoder(params, state, spaces, config), batch, spaces, config)
    dynamics, representation = kl_losses(states["logits"], prior(params, states["deter"], config), config)
    bins = standard_bins(config.bins, wide_dtype(config), state.device)
    return {
        **{f"reconstruction/{key}": loss for key, loss in reconstructions.items()},
        "reward": symexp_twohot_loss(reward_head(params, state, config), batch["reward"], bins),
        "continue": bernoulli_loss(continue_head(params, state, config), continue_target(batch["is_terminal"], config)),
        "dynamics": dynamics,
        "representation": representation,
    }


@torch.no_grad()
def open_loop(
    params: Params,
    observation: Observations,
    prev_action: Tensor,
    is_first: Tensor,
    context: int,
    noise: Mapping[str, Tensor],
    spaces: Spaces,
    config: Config,
) -> dict[str, Tensor]:
    """What the model sees coming, from a few observations and then actions alone. [WM-20] to [WM-24]

    observation {key: [B, T, ...]}, read up to `context`; prev_action [B, T, A]; is_first [B, T];
    noise: "posterior" [B, context, S], "prior" [B, T-context, S].
    Returns {key: [B, T, ...]} in the observations' own units, probabilities for a Discrete, and "reward" and
    "continue_" [B, T].

    Raises:
      ValueError: a context outside of 1 ... T-1, or what `encoder` and `observe` refuse.
    """
    require_shape("is_first", is_first.shape, "B", "T")
    B, T = is_first.shape
    require(1 <= context < T, "context", f"1 to {T - 1} steps of {T}", context)
    require_shape("prev_action", prev_action.shape, B, T, spaces.action_size)
    require_shape("noise['posterior']", noise["posterior"].shape, B, context, config.stoch)
    require_shape("noise['prior']", noise["prior"].shape, B, T - context, config.stoch)
    require_observations("observation", observation, spaces, (B, T))

    params, dtype = prepare(params, config), compute_dtype(config)
    tokens = encoder(params, {key: observation[key][:, :context] for key in spaces.observations}, spaces, config)
    zeros = {"deter": (B, config.deter), "stoch": (B, config.stoch, config.classes)}
    start = {name: torch.zeros(shape, dtype=dtype, device=tokens.device) for name, shape in zeros.items()}
    states = observe(params, start, tokens, prev_action[:, :context], is_first[:, :context], noise["posterior"], config)
    deters, stochs = list(states["deter"].unbind(1)), list(states["stoch"].unbind(1))
    for t in range(context, T):
        first = is_first[:, t].bool()
        inputs = (deters[-1], stochs[-1], prev_action[:, t])
        deter, stoch, action = (x.masked_fill(first.view(-1, *[1] * (x.ndim - 1)), 0) for x in inputs)
        deter = core(params, deter, stoch, action, config)
        probs = unimix_probs(prior(params, deter, config), config.latent_unimix)
        deters.append(deter)
        stochs.append(sample_onehot(probs, noise["prior"][:, t - context]).to(dtype))

    state = feature(torch.stack(deters, 1), torch.stack(stochs, 1))
    predictions = decoder(params, state, spaces, config)
    bins = standard_bins(config.bins, wide_dtype(config), state.device)
    return {
        **{key: _in_units(predictions[key], space) for key, space in spaces.observations.items()},
        "reward": symexp_twohot_mean(reward_head(params, state, config), bins),
        "continue_": bernoulli_mean(continue_head(params, state, config)),
    }


def _in_units(prediction: Tensor, space: Vector | Discrete | Image) -> Tensor:
    """What the decoder's output says. [WM-23]"""
    if isinstance(space, Vector):
        return symexp(prediction)
    if isinstance(space, Discrete):
        return torch.cat([logits.softmax(-1) for logits in prediction.split(space.classes, -1)], -1)
    return prediction
