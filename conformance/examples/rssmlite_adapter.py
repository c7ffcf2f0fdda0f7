"""rssmlite 0.1: a small world model in the style of DreamerV3, for vector observations.

Their KL loss is one number, a mean over states of both terms, weighted with `alpha` and 1 - `alpha`: it is called for
one state at a time. Their λ-return takes rewards and continues from step 1 on. Rewards and values are real numbers in
symlog space, so that there are no bins.
"""

from importlib.metadata import version

import torch
from rssmlite.actor_critic import lambda_return as their_lambda_return
from rssmlite.utils import kl_balancing, straight_through_sample, symexp, symlog  # noqa: F401

__version__ = version("rssmlite")
convert = torch.as_tensor


def kl_losses(posterior_logits, prior_logits, config):
    pairs = list(zip(posterior_logits.flatten(0, -3), prior_logits.flatten(0, -3), strict=True))
    both = ([kl_balancing(q[None], p[None], alpha, config.free_nats) for q, p in pairs] for alpha in (1.0, 0.0))
    return tuple(torch.stack(losses).reshape(posterior_logits.shape[:-2]) for losses in both)


def draw_categorical(logits, unimix, seed, n):
    """They have no uniform mixture."""
    torch.manual_seed(seed)
    return straight_through_sample(logits.expand(n, *logits.shape)).argmax(-1)


def lambda_return(reward, continue_, value, discount, lambda_):
    return their_lambda_return(reward[:, 1:], continue_[:, 1:], value, discount, lambda_)
