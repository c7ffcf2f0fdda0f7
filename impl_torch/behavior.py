"""Actor and critic: actions, log-probabilities, entropies, losses, the slow critic. Chapter: spec/08-behavior.md."""

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from impl_torch.distributions import (
    bounded_normal,
    categorical_entropy,
    categorical_log_prob,
    categorical_sample,
    normal_entropy,
    normal_log_prob,
    normal_sample,
    symexp_twohot_mean,
    twohot_cross_entropies,
    unimix_log_probs,
)
from impl_torch.networks import Outputs
from impl_torch.shapes import require_keys, require_same_shape, require_shape, require_shapes, widen
from impl_torch.transforms import standard_bins
from spec import Config, Spaces, Vector


@dataclasses.dataclass(frozen=True)
class _Categorical:
    """One entry of a Discrete. [BEH-2] [BEH-3]"""

    log_probs: Tensor  # [..., classes]

    @property
    def sizes(self) -> tuple[int, int]:
        """How many entries it has in a flat action and in the noise."""
        return self.log_probs.shape[-1], 1

    def sample(self, noise: Tensor) -> Tensor:
        return categorical_sample(self.log_probs, noise.squeeze(-1))

    def mode(self) -> Tensor:
        return torch.eye(self.log_probs.shape[-1]).to(self.log_probs)[self.log_probs.argmax(-1)]

    def log_prob(self, action: Tensor) -> Tensor:
        return categorical_log_prob(self.log_probs, action)

    def entropy(self) -> Tensor:
        return categorical_entropy(self.log_probs)


@dataclasses.dataclass(frozen=True)
class _Normal:
    """All dimensions of a Vector. [BEH-4]"""

    mean: Tensor  # [..., size]
    std: Tensor  # [..., size]

    @property
    def sizes(self) -> tuple[int, int]:
        return self.mean.shape[-1], self.mean.shape[-1]

    def sample(self, noise: Tensor) -> Tensor:
        return normal_sample(self.mean, self.std, noise)

    def mode(self) -> Tensor:
        return self.mean

    def log_prob(self, action: Tensor) -> Tensor:
        return normal_log_prob(self.mean, self.std, action).sum(-1)

    def entropy(self) -> Tensor:
        return normal_entropy(self.std).sum(-1)


def _distributions(outputs: Outputs, spaces: Spaces, config: Config) -> list[_Categorical | _Normal]:
    """The independent parts of a policy, in the order of a flat action."""
    require_keys("outputs", outputs, spaces.actions, exactly=True)
    leading = _leading(outputs)
    parts: list[_Categorical | _Normal] = []
    for key, space in spaces.actions.items():
        raw, names = outputs[key], ("mean", "std") if isinstance(space, Vector) else ("logits",)
        require_keys(f"outputs[{key!r}]", raw, names, exactly=True)
        for name in names:
            require_shape(f"outputs[{key!r}][{name!r}]", raw[name].shape, *leading, space.encoded_size)
        if isinstance(space, Vector):
            parts.append(_Normal(*bounded_normal(raw["mean"], raw["std"], config.actor_min_std, config.actor_max_std)))
        else:
            entries = raw["logits"].split(space.classes, -1)  # [..., classes] each
            parts += [_Categorical(unimix_log_probs(logits, config.actor_unimix)) for logits in entries]
    return parts


def _leading(outputs: Outputs) -> torch.Size:
    return next(iter(next(iter(outputs.values())).values())).shape[:-1]


@torch.no_grad()
def sample_action(outputs: Outputs, noise: Tensor, spaces: Spaces, config: Config) -> Tensor:
    """A flat action [..., A], constant, from noise [..., K]. [BEH-1] to [BEH-5] [BEH-8] [BEH-22] [BEH-23]"""
    parts = _distributions(outputs, spaces, config)
    require_shape("noise", noise.shape, *_leading(outputs), spaces.action_noise_size)
    pieces = noise.split([part.sizes[1] for part in parts], -1)
    return torch.cat([part.sample(piece) for part, piece in zip(parts, pieces, strict=True)], -1)


@torch.no_grad()
def mode_action(outputs: Outputs, spaces: Spaces, config: Config) -> Tensor:
    """The mode of the policy as a flat action [..., A], constant. [LOOP-71]"""
    return torch.cat([part.mode() for part in _distributions(outputs, spaces, config)], -1)


def action_log_prob(outputs: Outputs, action: Tensor, spaces: Spaces, config: Config) -> Tensor:
    """Log-probability of a flat action [..., A], a constant, summed over all its parts: [...]. [BEH-5] [BEH-6]"""
    parts = _distributions(outputs, spaces, config)
    require_shape("action", action.shape, *_leading(outputs), spaces.action_size)
    pieces = action.detach().split([part.sizes[0] for part in parts], -1)
    return torch.stack([part.log_prob(piece) for part, piece in zip(parts, pieces, strict=True)]).sum(0)


def action_entropy(outputs: Outputs, spaces: Spaces, config: Config) -> Tensor:
    """Entropy of the policy in nats, summed over all its parts: [...]. [BEH-7] [BEH-22] [BEH-23]"""
    return torch.stack([part.entropy() for part in _distributions(outputs, spaces, config)]).sum(0)


def actor_loss(
    log_prob: Tensor,
    entropy: Tensor,
    returns: Tensor,
    value: Tensor,
    weight: Tensor,
    scale: Tensor | float,
    config: Config,
) -> Tensor:
    """-weight * (advantage * log_prob + entropy_scale * entropy): [N, H] five times -> [N, H].

    [BEH-9] [BEH-10] [BEH-22] [BEH-23] [BEH-24]
    """
    require_same_shape(log_prob=log_prob, entropy=entropy, returns=returns, value=value, weight=weight)
    log_prob = widen(log_prob)
    scale = torch.as_tensor(scale)
    require_shape("scale", scale.shape)
    with torch.no_grad():
        advantage = (returns - value) / scale
    return -weight.detach() * (advantage * log_prob + config.entropy_scale * entropy)


def critic_loss(logits: Tensor, slow_logits: Tensor, returns: Tensor, weight: Tensor, config: Config) -> Tensor:
    """weight * (CE towards the return + slow_critic_scale * CE towards the slow mean): [N, H].

    [BEH-12] [BEH-13] [BEH-22] [BEH-23] [BEH-24]
    """
    require_same_shape(weight=weight, returns=returns)
    return weight.detach() * _critic_cross_entropy(logits, slow_logits, returns, config)


def replay_critic_loss(logits: Tensor, slow_logits: Tensor, returns: Tensor, is_last: Tensor, config: Config) -> Tensor:
    """The same without weights, 0 at the last steps of episodes: [B, T-1]. [BEH-14] [BEH-15] [BEH-22] to [BEH-24]"""
    require_same_shape(is_last=is_last, returns=returns)
    loss = _critic_cross_entropy(logits, slow_logits, returns, config)
    return (1 - is_last.to(loss.dtype)) * loss


def _critic_cross_entropy(logits: Tensor, slow_logits: Tensor, returns: Tensor, config: Config) -> Tensor:
    """Towards the return and towards the slow critic's mean: logits [..., bins] twice, returns [...] -> [...]."""
    require_shape("logits", logits.shape, *returns.shape, config.bins)
    require_same_shape(logits=logits, slow_logits=slow_logits)
    logits = widen(logits)
    bins = standard_bins(config.bins, logits.dtype, logits.device)
    slow_mean = symexp_twohot_mean(slow_logits.detach().to(logits.dtype), bins)
    # Both targets at once [..., 2], so that they share one log-softmax over the bins and one way back through it.
    targets = torch.stack([returns.to(logits.dtype), slow_mean], -1)
    towards_return, towards_slow = twohot_cross_entropies(unimix_log_probs(logits, 0.0), targets, bins).unbind(-1)
    return towards_return + config.slow_critic_scale * towards_slow


@torch.no_grad()
def update_slow_critic(slow: Mapping[str, Tensor], critic: Mapping[str, Tensor], decay: float) -> dict[str, Tensor]:
    """decay * slow + (1 - decay) * critic, a new mapping; critic may hold more than `critic/...`. [BEH-19] to [BEH-21]

    `Learner` does the same in place on flat buffers.
    """
    live = {name: x for name, x in critic.items() if name.startswith("critic/")}
    require_shapes("slow", slow, {name: x.shape for name, x in live.items()})
    return {name: decay * x + (1 - decay) * live[name].to(x.dtype) for name, x in slow.items()}
