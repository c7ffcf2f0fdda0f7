"""What the world model is trained for. Chapter: spec/06-world-model.md."""

from collections.abc import Mapping

import torch
import torch.nn.functional as F  # noqa: N812 (so it is called everywhere)
from torch import Tensor

from impl_torch.distributions import (
    bernoulli_loss,
    categorical_kl,
    categorical_log_prob,
    mse_loss,
    symexp_twohot_loss,
    symlog_mse_loss,
    unimix_log_probs,
)
from impl_torch.layers import Params
from impl_torch.networks import Observations, check_observations, continue_head, decoder, feature, reward_head
from impl_torch.rssm import prior
from impl_torch.shapes import expect_keys, expect_same_shape, expect_shape, wide_dtype, widen
from impl_torch.transforms import standard_bins
from spec import Config, Image, Spaces, Vector


def continue_target(is_terminal: Tensor, config: Config) -> Tensor:
    """1 where life goes on, times gamma if the head is to learn it: [...] bool -> [...]. [WM-7]"""
    scale = config.discount if config.continue_target == "discounted" else 1.0
    return scale * (1 - is_terminal.to(wide_dtype(config)))


def kl_losses(posterior_logits: Tensor, prior_logits: Tensor, config: Config) -> tuple[Tensor, Tensor]:
    """Dynamics and representation loss in nats, at least free_nats: [..., S, C] twice -> [...] twice. [WM-9] to [WM-14]"""
    expect_same_shape(posterior_logits=posterior_logits, prior_logits=prior_logits)
    posterior = unimix_log_probs(posterior_logits, config.latent_unimix)
    prior = unimix_log_probs(prior_logits.to(posterior.dtype), config.latent_unimix)
    dynamics = categorical_kl(posterior.detach(), prior).sum(-1)
    representation = categorical_kl(posterior, prior.detach()).sum(-1)
    return dynamics.clamp(min=config.free_nats), representation.clamp(min=config.free_nats)


def reconstruction_losses(predictions: Observations, observations: Observations, spaces: Spaces, config: Config) -> dict[str, Tensor]:
    """{key: [...]} from the decoder's output and the raw observations. [WM-2] [WM-3] [WM-4] [WM-5] [WM-17] [WM-18] [WM-19]"""
    expect_keys("predictions", predictions, spaces.observations)
    check_observations(observations, spaces)
    losses = {}
    for key, space in spaces.observations.items():
        prediction, target = widen(predictions[key]), observations[key]
        size = space.array_shape if isinstance(space, Image) else (space.encoded_size,)
        expect_shape(f"prediction {key!r}", prediction, (*target.shape[: target.ndim - len(space.array_shape)], *size))
        if isinstance(space, Vector):
            losses[key] = symlog_mse_loss(prediction, target, config.vector_loss_scale).sum(-1)
        elif isinstance(space, Image):
            losses[key] = mse_loss(prediction, target.to(prediction.dtype) / 255).sum((-3, -2, -1))
        else:
            entries = zip(prediction.split(space.classes, -1), target.unbind(-1), space.classes, strict=True)
            log_probs = [
                categorical_log_prob(unimix_log_probs(logits, 0.0), F.one_hot(value.long(), classes)) for logits, value, classes in entries
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
    expect_keys("batch", batch, (*spaces.observations, "reward", "is_terminal"))
    expect_keys("states", states, ("deter", "stoch", "logits"))
    shape = states["deter"].shape[:-1]
    for key in ("reward", "is_terminal"):
        expect_shape(f"batch[{key!r}]", batch[key], shape)
    state = feature(states["deter"], states["stoch"])
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
