"""sheeprl 0.8: its DreamerV3 after the paper of 2023, `sheeprl.algos.dreamer_v3`.

Their code is time first with a last axis of length 1, keeps latents flat, and has two-hot bins that are even between
two ends in symlog space; the ends are taken from the bins that the kit gives. What they write inside of a longer
function is reached by calling that function with stand-ins for the networks, one element at a time:
`reconstruction_loss` for the KL losses, `imagine` for the weights, `Actor.forward` for the policies. Where an agent has
both real and discrete actions, each action key gets a policy of its own.

Not offered: recurrent cell and heads, which have LayerNorm and other shapes in this edition, and the critic's loss,
which the kit checks together with the one on replayed states. Adam and the clipping of gradients are those of PyTorch.
"""

from importlib.metadata import version
from types import SimpleNamespace as Namespace

import torch
from sheeprl.algos.dreamer_v2.utils import compute_stochastic_state
from sheeprl.algos.dreamer_v3 import dreamer_v3, loss
from sheeprl.algos.dreamer_v3.agent import RSSM, Actor
from sheeprl.algos.dreamer_v3.utils import Moments, compute_lambda_values
from sheeprl.utils.distribution import (
    BernoulliSafeMode,
    MSEDistribution,
    SymlogDistribution,
    TwoHotEncodingDistribution,
)
from sheeprl.utils.utils import symexp, symlog
from torch.distributions import Distribution

__version__ = version("sheeprl")
ALONE = Namespace(all_gather=lambda x: x)  # a Fabric of one process


def setup(dtype):
    Distribution.set_default_validate_args(False)  # as their command line does


def edition():
    return "2023"


def convert(array):
    array = torch.as_tensor(array)
    return array.float() if array.is_floating_point() else array


def exponential_bins(bins):
    return symexp(TwoHotEncodingDistribution(torch.zeros(bins), dims=1).bins)


def twohot_of(logits, bins):
    return TwoHotEncodingDistribution(logits, 1, *(float(symlog(end)) for end in (bins[0], bins[-1])))


def symexp_twohot_loss(logits, target, bins):
    return -twohot_of(logits, bins).log_prob(torch.as_tensor(target)[..., None])


def symexp_twohot_mean(logits, bins):
    return twohot_of(logits, bins).mean[..., 0]


def unimix_log_probs(logits, unimix):
    return Actor._uniform_mix(Namespace(_unimix=unimix), logits).log_softmax(
        -1
    )  # what PyTorch's distributions do with logits


def mixed_latents(logits, config):
    """[..., S, C] -> [1, N, S, C]."""
    flat = RSSM._uniform_mix(
        Namespace(unimix=config.latent_unimix, discrete=logits.shape[-1]),
        logits.flatten(-2).reshape(1, -1, logits.shape[-2] * logits.shape[-1]),
    )
    return flat.unflatten(-1, logits.shape[-2:])


def categorical_kl(log_probs_p, log_probs_q):
    return loss.categorical_kl(log_probs_p[..., None, :], log_probs_q[..., None, :])


def bernoulli_loss(logit, target):
    return -BernoulliSafeMode(logits=logit).log_prob(target)


def bernoulli_mean(logit):
    return BernoulliSafeMode(logits=logit).mean


def mse_loss(prediction, target):
    return -MSEDistribution(prediction[..., None], dims=1).log_prob(target[..., None])


def symlog_mse_loss(prediction, target, scale):
    return -scale * SymlogDistribution(prediction[..., None], dims=1).log_prob(target[..., None])


def draw_categorical(logits, unimix, seed, n):
    torch.manual_seed(seed)
    mixed = mixed_latents(logits[None], Namespace(latent_unimix=unimix))
    return compute_stochastic_state(mixed.flatten(-2).expand(1, n, -1), discrete=logits.shape[-1])[0]


def kl_losses(posterior_logits, prior_logits, config):
    posteriors, priors = mixed_latents(posterior_logits, config)[0], mixed_latents(prior_logits, config)[0]
    losses = torch.stack(
        [
            torch.stack([one_kl(q, p, config, share) for share in (1.0, 0.0)])
            for q, p in zip(posteriors, priors, strict=True)
        ]
    )
    return tuple(losses.mT.unflatten(-1, posterior_logits.shape[:-2]))


def one_kl(posterior, prior, config, share):
    """The loss of one state: of the dynamics for a share of 1, of the representation for 0."""
    zero = torch.zeros(1, 1, 1)
    nothing = MSEDistribution(zero, dims=1)
    given = {"kl_dynamic": share, "kl_representation": 1 - share, "kl_free_nats": config.free_nats}
    return loss.reconstruction_loss(
        {"x": nothing}, {"x": zero}, nothing, zero, prior[None, None], posterior[None, None], **given
    )[2]


def bounded_normal(mean, std, min_std, max_std):
    outputs = {"action": {"mean": mean[..., None], "std": std[..., None]}}
    config = Namespace(actor_min_std=min_std, actor_max_std=max_std, actor_unimix=0.0)
    normal = policies(outputs, Namespace(actions={"action": Namespace(size=1)}), config)[0][1].base_dist
    return normal.loc[..., 0], normal.scale[..., 0]


def policies(outputs, spaces, config):
    """Samples and distributions of every action, from the outputs of the last layer."""
    found = []
    for key, space in sorted(spaces.actions.items()):
        raw, continuous = outputs[key], "mean" in outputs[key]
        parts = (
            [torch.cat([raw["mean"], raw["std"]], -1)] if continuous else raw["logits"].split(list(space.classes), -1)
        )
        actor = Namespace(
            is_continuous=continuous, distribution="scaled_normal" if continuous else "discrete", init_std=2.0
        )
        actor.min_std, actor.max_std, actor._unimix = config.actor_min_std, config.actor_max_std, config.actor_unimix
        actor._uniform_mix = lambda logits, actor=actor: Actor._uniform_mix(actor, logits)
        actor.model, actor.mlp_heads = (lambda state: state), [lambda state, part=part: part for part in parts]
        found += zip(*Actor.forward(actor, None, clip=False), strict=True)
    return found


def action_log_prob(outputs, action, spaces, config):
    every = policies(outputs, spaces, config)
    return sum(
        policy.log_prob(part)
        for (_, policy), part in zip(every, action.split([s.shape[-1] for s, _ in every], -1), strict=True)
    )


def action_entropy(outputs, spaces, config):
    return sum(policy.entropy() for _, policy in policies(outputs, spaces, config))


def draw_actions(outputs, spaces, config, seed, n):
    torch.manual_seed(seed)
    many = {key: {name: value.expand(n, -1) for name, value in raw.items()} for key, raw in outputs.items()}
    return torch.cat([sample for sample, _ in policies(many, spaces, config)], -1)


def lambda_return(reward, continue_, value, discount, lambda_):
    later = (x.mT[1:, :, None] for x in (reward, value, continue_ * discount))
    return compute_lambda_values(*later, lmbda=lambda_)[..., 0].mT


def cumulative_weights(continue_, discount):
    steps, rows = continue_.shape[1], continue_.shape[0]
    zero, logits = torch.zeros(1, rows, 1), torch.zeros(steps, rows, 255)
    model = Namespace(
        rssm=Namespace(imagination=lambda *state: (zero, zero)),
        reward_model=lambda states: logits,
        continue_model=lambda states: continue_.mT[..., None].logit(),
    )
    sizes = {"horizon": steps - 1, "gamma": discount, "lmbda": 0.95}
    start = zero[..., None], zero, 1 - continue_[:, 0]
    return dreamer_v3.imagine(model, lambda states, clip: ([zero], None), lambda states: logits, *start, **sizes)[-1][
        :-1, :, 0
    ].mT


def percentile(values, q):
    return Moments(decay=0.0, percentile_low=q / 100)(values, ALONE)[0]


def update_return_range(low, high, returns, config):
    moments = Moments(config.return_decay, 1.0, config.return_percentile_low / 100, config.return_percentile_high / 100)
    moments.low, moments.high = torch.tensor(low), torch.tensor(high)
    moments(returns, ALONE)
    return moments.low, moments.high


def return_scale(low, high, limit):
    moments = Moments(decay=1.0, max_=1 / limit)
    moments.low, moments.high = torch.tensor(low), torch.tensor(high)
    return moments(torch.zeros(1), ALONE)[1]


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    losses = []
    for lp, e, r, v, w in zip(*(x.flatten() for x in (log_prob, entropy, returns, value, weight)), strict=True):
        policy = Namespace(log_prob=lambda action, lp=lp: lp.expand(2, 1), entropy=lambda e=e: e.expand(2, 1))
        value_, weight_ = v.expand(2, 1, 1), w.expand(2, 1, 1)
        given = {"objective_mix": None, "is_continuous": False, "actions_dim": (1,), "ent_coef": config.entropy_scale}
        zero, range_ = torch.zeros(2, 1, 1), (torch.zeros(()), torch.as_tensor(scale, dtype=torch.float32))
        arguments = zero, zero, value_, r.reshape(1, 1, 1), weight_, *range_
        losses.append(dreamer_v3.actor_loss(lambda states, policy=policy: ((), [policy]), *arguments, **given))
    return torch.stack(losses).reshape(returns.shape)
