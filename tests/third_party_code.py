"""A code base as somebody else might write it: PyTorch, time first, names, layouts and habits of its own. It knows
nothing of the kit."""

import torch
from torch import nn
from torch.distributions import Independent, OneHotCategorical, kl_divergence
from torch.nn import functional as F  # noqa: N812


def lambda_values(rewards, values, pcont, bootstrap, lam):
    """All [H, B, 1]: what arrives with the next state, its value and its discounted continue; bootstrap [B, 1]."""
    outputs, last = [], bootstrap
    for reward, value, cont in reversed(list(zip(rewards, values, pcont, strict=True))):
        last = reward + cont * ((1 - lam) * value + lam * last)
        outputs.append(last)
    return torch.stack(outputs[::-1])


class TwoHot:
    def __init__(self, logits, buckets):
        self.logits, self.buckets = logits, buckets

    def encode(self, x):
        x = x.clamp(self.buckets[0], self.buckets[-1])[..., None]
        below = (self.buckets <= x).sum(-1) - 1
        above = (below + 1).clamp(max=len(self.buckets) - 1)
        low, high = self.buckets[below], self.buckets[above]
        weight = torch.where(above > below, (x[..., 0] - low) / (high - low).clamp(min=1e-300), 0.0)
        classes = len(self.buckets)
        return F.one_hot(below, classes) * (1 - weight)[..., None] + F.one_hot(above, classes) * weight[..., None]

    def log_prob(self, x):
        return (self.encode(x) * self.logits.log_softmax(-1)).sum(-1)


def unimix_dist(logits, mix):
    probs = (1 - mix) * logits.softmax(-1) + mix / logits.shape[-1]
    return Independent(OneHotCategorical(probs=probs, validate_args=False), 1)


def kl_loss(post, prior, free, mix):
    dyn = kl_divergence(unimix_dist(post.detach(), mix), unimix_dist(prior, mix))
    rep = kl_divergence(unimix_dist(post, mix), unimix_dist(prior.detach(), mix))
    return {"representation": rep.clamp(min=free), "dynamics": dyn.clamp(min=free)}


class RMSNorm(nn.Module):
    def __init__(self, size, eps):
        super().__init__()
        self.weight, self.eps = nn.Parameter(torch.ones(size)), eps

    def forward(self, x):
        return x * torch.rsqrt(x.square().mean(-1, keepdim=True) + self.eps) * self.weight


class BlockDense(nn.Module):
    """weight [G, out/G, in/G]."""

    def __init__(self, inputs, outputs, blocks):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(blocks, outputs // blocks, inputs // blocks))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x):
        x = x.unflatten(-1, (len(self.weight), -1))
        return torch.einsum("...gi,goi->...go", x, self.weight).flatten(-2) + self.bias


class Cell(nn.Module):
    """The recurrent cell; z is flat."""

    def __init__(self, deter, latents, actions, units, blocks, eps):
        super().__init__()
        self.blocks = blocks
        self.inputs = nn.ModuleList(
            nn.Sequential(nn.Linear(size, units), RMSNorm(units, eps), nn.SiLU()) for size in (deter, latents, actions)
        )
        self.mix = nn.Sequential(BlockDense(deter + blocks * 3 * units, deter, blocks), RMSNorm(deter, eps), nn.SiLU())
        self.gates = BlockDense(deter, 3 * deter, blocks)

    def forward(self, h, z, action):
        action = action / action.abs().clamp(min=1).detach()
        x = torch.cat([layer(value) for layer, value in zip(self.inputs, (h, z, action), strict=True)], -1)
        x = torch.cat(
            [h.unflatten(-1, (self.blocks, -1)), x[..., None, :].expand(*x.shape[:-1], self.blocks, -1)], -1
        ).flatten(-2)
        reset, cand, update = self.gates(self.mix(x)).unflatten(-1, (self.blocks, 3, -1)).unbind(-2)
        cand = torch.tanh(reset.flatten(-2).sigmoid() * cand.flatten(-2))
        update = (update.flatten(-2) - 1).sigmoid()
        return update * cand + (1 - update) * h
