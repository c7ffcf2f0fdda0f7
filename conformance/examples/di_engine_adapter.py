"""DI-engine 0.5: its DreamerV3, in `ding.policy.mbpolicy`, `ding.world_model` and `ding.torch_utils.network.dreamer`.

Their code is time first with a last axis of length 1. The two-hot distribution has 255 bins, even between two ends in
symlog space; the ends are taken from the bins that the kit gives. λ-returns and weights are results of
`compute_target`, which here gets given predictions in place of networks. KL losses are means, taken of one state at a
time. Where an agent has both real and discrete actions, each action key gets a policy of its own.

Not offered: recurrent cell and heads, which have LayerNorm and other shapes than the kit's, and the actor's loss, which
is the gradient through the dynamics and has no log-probabilities.
"""

from importlib.metadata import version
from types import SimpleNamespace as Namespace

import torch
from ding.policy.mbpolicy.utils import RewardEMA, compute_target
from ding.rl_utils.value_rescale import inv_symlog, symlog
from ding.torch_utils.network.dreamer import ActionHead, Bernoulli, OneHotDist, SymlogDist, TwoHotDistSymlog
from ding.world_model.model.networks import RSSM
from torch import distributions

__version__ = version("DI-engine")
convert = torch.as_tensor
symexp = inv_symlog


def edition():
    return "2023"


def setup(dtype):
    distributions.Distribution.set_default_validate_args(False)
    torch.set_default_dtype(getattr(torch, dtype))


def twohot_of(logits, bins):
    if len(bins) != 255:
        raise NotImplementedError("another number of bins than 255")
    return TwoHotDistSymlog(logits, *(float(symlog(end)) for end in (bins[0], bins[-1])))


def symexp_twohot_loss(logits, target, bins):
    return -twohot_of(logits, bins).log_prob(torch.as_tensor(target)[..., None])


def symexp_twohot_mean(logits, bins):
    return twohot_of(logits, bins).mean()[..., 0]


def unimix_log_probs(logits, unimix):
    return OneHotDist(logits, unimix_ratio=unimix).logits


def draw_categorical(logits, unimix, seed, n):
    torch.manual_seed(seed)
    return OneHotDist(logits, unimix_ratio=unimix).sample((n,))


def kl_losses(posterior_logits, prior_logits, config):
    rssm = Namespace(_discrete=config.classes, _unimix_ratio=config.latent_unimix)
    rssm.get_dist = lambda state: RSSM.get_dist(rssm, state)
    pairs = zip(posterior_logits.flatten(0, -3), prior_logits.flatten(0, -3), strict=True)
    losses = [
        RSSM.kl_loss(rssm, {"logit": q[None]}, {"logit": p[None]}, False, config.free_nats, 1.0, 1.0)[2:]
        for q, p in pairs
    ]
    representation, dynamics = (
        torch.stack(kind).reshape(posterior_logits.shape[:-2]) for kind in zip(*losses, strict=True)
    )
    return dynamics, representation


def binary(logit):
    return Bernoulli(distributions.Independent(distributions.Bernoulli(logits=logit[..., None]), 1))


def bernoulli_loss(logit, target):
    return -binary(logit).log_prob(target[..., None])[..., 0]


def bernoulli_mean(logit):
    return binary(logit).mean[..., 0]


def symlog_mse_loss(prediction, target, scale):
    return -scale * SymlogDist(prediction[..., None], dim_to_reduce=[-1]).log_prob(target[..., None])


def policy(kind, outputs, size, **options):
    """The distribution that their actor makes of the outputs of its last layer."""
    options = {"_min_std": 0.1, "_max_std": 1.0, "_unimix_ratio": 0.0, **options}
    through = {"_pre_layers": lambda x: x, "_dist_layer": lambda x: x}
    return ActionHead.forward(Namespace(_dist=kind, _size=size, **through, **options), outputs)


def bounded_normal(mean, std, min_std, max_std):
    normal = policy("normal", torch.stack([mean, std], -1), 1, _min_std=min_std, _max_std=max_std).base_dist
    return normal.loc[..., 0], normal.scale[..., 0]


def policies(outputs, spaces, config):
    """The distribution of every action, and its size."""
    for key, space in sorted(spaces.actions.items()):
        raw = outputs[key]
        if "mean" in raw:
            bounds = {"_min_std": config.actor_min_std, "_max_std": config.actor_max_std}
            yield policy("normal", torch.cat([raw["mean"], raw["std"]], -1), space.size, **bounds), space.size
        else:
            for logits in raw["logits"].split(list(space.classes), -1):
                yield policy("onehot", logits, logits.shape[-1], _unimix_ratio=config.actor_unimix), logits.shape[-1]


def action_log_prob(outputs, action, spaces, config):
    every = list(policies(outputs, spaces, config))
    parts = action.split([size for _, size in every], -1)
    return sum(one.log_prob(part) for (one, _), part in zip(every, parts, strict=True))


def action_entropy(outputs, spaces, config):
    return sum(one.entropy() for one, _ in policies(outputs, spaces, config))


def draw_actions(outputs, spaces, config, seed, n):
    torch.manual_seed(seed)
    return torch.cat([one.sample((n,)) for one, _ in policies(outputs, spaces, config)], -1)


def targets(reward, continue_, value, discount, lambda_):
    """λ-returns and weights, [N, H] and [N, H+1], of imagined states 0 to H."""
    world_model = Namespace(
        heads={"discount": lambda states: Namespace(mean=continue_.mT[..., None])},
        dynamics=Namespace(get_feat=lambda states: states),
    )
    critic = lambda states: Namespace(mode=lambda: value.mT[..., None])  # noqa: E731
    config = Namespace(discount=discount, lambda_=lambda_)
    results = compute_target(config, world_model, critic, None, None, reward.mT[..., None], None, None)
    return tuple(x[..., 0].mT for x in results[:2])


def lambda_return(reward, continue_, value, discount, lambda_):
    return targets(reward, continue_, value, discount, lambda_)[0]


def cumulative_weights(continue_, discount):
    zero = torch.zeros_like(continue_)
    return targets(zero, continue_, zero, discount, 0.95)[1][:, :-1]


def percentile(values, q):
    moving = RewardEMA("cpu", alpha=1.0)
    moving.range = torch.tensor([q / 100, q / 100], dtype=values.dtype)
    return moving(values)[0]


def update_return_range(low, high, returns, config):
    moving = RewardEMA("cpu", alpha=1 - config.return_decay)
    moving.values = torch.tensor([low, high], dtype=returns.dtype)
    moving.range = torch.tensor(
        [config.return_percentile_low / 100, config.return_percentile_high / 100], dtype=returns.dtype
    )
    moving(returns)
    return tuple(moving.values)
