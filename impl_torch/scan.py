"""The recurrence over an observed sequence, with a backward pass written by hand.

The steps follow each other, so what must be done inside the loop decides the speed. Autograd would run every step's
products backward for the kernels too: T times it would write and add up gradients as large as the parameters, each from
a few rows. Here the loop back carries only the gradient of the state. Every factor that does not depend on it is
computed for all steps at once before the loop, and the gradient of each kernel is one product over all steps after it.
The values are those of `rssm.observe_step`.

Everything here is time-major. T steps, B rows, D = deter, Z = S * C = stoch * classes, G blocks, d = units. Step t in
symbols, with the array that holds each of them for all steps; act(x) = silu(rms_norm(x) * scale), s = softmax(l):

    h, z   = 0 where is_first[t], else h', z' of step t-1       states      [T, B, D + Z]
    e_0    = h embed_deter + bias                               embed       [T, B, 2, d]
    e_1    = z embed_stoch + bias                               the same
    u      = act(e_0), act(e_1)                                 embedded    [T, B, 2d]
    x      = action_drive[t] + u shared + h block               hidden      [T, B, D]
    y      = act(x)                                             activated   [T, G, B, D/G]
    g      = y gru + bias: reset r, candidate c, update k       gates       [T, G, B, 3, D/G]
    h'     = (1 - σ(k-1)) h + σ(k-1) tanh(σ(r) c)               features    [T, B, D + Z], its first D
    p_0    = token_drive[t] + h' post_deter                     post[0]     [T, B, d]
    p_i    = act(p_i-1) kernel_i + bias                         post[i]     [T, B, d], for each of `deeper`, n in all
    l      = act(p_n) out + bias                                logits      [T, B, S, C]
    z'     = onehot(l) + π - sg(π)                              features    its last Z; π = (1 - unimix) s + unimix / C

The adjoint. ∂x is the gradient of the loss by x, `by_...` in the code; act'(x, ∂y) takes ∂y of y = act(x) to ∂x, see
`_NormSiluBack`. Given are ∂features and ∂logits. The steps are walked from the last to the first; ∂h', ∂z' begin as
∂features[t] plus ∂h, ∂z of step t+1, and ∂l begins as ∂logits[t]:

    ∂l    += (1 - unimix) s (∂z' - sum over C of s ∂z')         by_out      the derivative of π
    ∂p_n   = act'(p_n, ∂l outᵀ)                                 by_post[n]
    ∂p_i-1 = act'(p_i-1, ∂p_i kernel_iᵀ)                        by_post[i-1]
    ∂h'   += ∂p_0 post_deterᵀ                                   by_memory
    ∂g     = ∂h' dh'/dg                                         by_gates    see `_gate_slopes`
    ∂x     = act'(x, ∂g gruᵀ)                                   by_hidden
    ∂e     = act'(e, ∂x sharedᵀ)                                by_embed
    ∂h     = ∂h' (1 - σ(k-1)) + ∂x blockᵀ + ∂e_0 embed_deterᵀ   by_state    its first D
    ∂z     = ∂e_1 embed_stochᵀ                                  by_state    its last Z; both are 0 where is_first[t]

After the loop, a kernel W of y = x W has the gradient sum over t of x_tᵀ ∂y_t, and its bias the sum of ∂y_t. The drives
were added as they are: their gradients are ∂x and ∂p_0.
"""

import dataclasses
from typing import Any

import torch
from torch import Tensor

from impl_torch.distributions import sample_onehot, unimix_probs
from impl_torch.layers import norm_silu_forward, normalize, silu_slope, wide_product
from impl_torch.shapes import widen


@dataclasses.dataclass(frozen=True)
class ScanWeights:
    """What the loop reads, in the parameters' own precision.

    The loop itself converts them to the compute dtype: done by the caller, the gradients would be rounded to it too.
    """

    embed_deter: Tensor  # [D, d]
    embed_stoch: Tensor  # [Z, d]
    embed_bias: Tensor  # [2, d]: of deter and stoch
    embed_scale: Tensor  # [2, d]
    shared: Tensor  # [2d, D]: what rssm/hidden reads of these two embeddings
    block: Tensor  # [G, D/G, D/G]: what rssm/hidden reads of the block's own memory
    hidden_scale: Tensor  # [D]
    gru: Tensor  # [G, D/G, 3D/G]
    gru_bias: Tensor  # [3D]
    out: Tensor  # [d, Z]
    out_bias: Tensor  # [Z]
    post_deter: Tensor  # [D, d]: what the posterior's first layer reads of the memory
    post_scale: Tensor  # [d]
    deeper: tuple[tuple[Tensor, Tensor, Tensor], ...] = ()  # kernel, bias and scale of the posterior's further layers

    def flat(self) -> list[Tensor]:
        """As the arguments of an `autograd.Function`, which takes tensors and no structures."""
        *tensors, deeper = (getattr(self, field.name) for field in dataclasses.fields(self))
        return tensors + [tensor for layer in deeper for tensor in layer]

    @classmethod
    def from_flat(cls, tensors: tuple[Tensor, ...]) -> "ScanWeights":
        names = [field.name for field in dataclasses.fields(cls)][:-1]
        count = len(names)
        deeper = tuple((tensors[i], tensors[i + 1], tensors[i + 2]) for i in range(count, len(tensors), 3))
        return cls(**dict(zip(names, tensors[:count], strict=True)), deeper=deeper)


@dataclasses.dataclass(frozen=True)
class ScanOptions:
    stoch: int
    epsilon: float
    unimix: float


def scan(
    options: ScanOptions,
    carry: Tensor,
    is_first: Tensor,
    uniform: Tensor,
    action_drive: Tensor,
    token_drive: Tensor,
    weights: ScanWeights,
) -> tuple[Tensor, Tensor]:
    """Runs the sequence.

    carry [B, D + Z]: a constant; is_first [T, B] bool; uniform [T, B, S]; action_drive [T, B, D]: what the action and
    the bias add to rssm/hidden; token_drive [T, B, d]: what the tokens and the bias add to the posterior's first layer.
    Returns the features [T, B, D + Z] in the compute dtype and the posterior logits [T, B, S, C] in float32 or better.
    """
    return _Scan.apply(options, carry, is_first, uniform, action_drive, token_drive, *weights.flat())


def gru(gates: Tensor, deter: Tensor) -> Tensor:
    """The new memory [..., n] from reset, candidate and update [..., 3, n] and the old memory [..., n]. [RSSM-7]"""
    return _Gru.apply(gates, deter)


class _Gru(torch.autograd.Function):
    """Keeps the gates and the old memory alone, where autograd would keep every result in between."""

    @staticmethod
    def forward(ctx: Any, gates: Tensor, deter: Tensor) -> Tensor:
        ctx.save_for_backward(gates, deter)
        return _gru_forward(gates, deter)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        slope_deter, slope_gates = _gate_slopes(*ctx.saved_tensors)  # [..., n], [..., 3, n]
        return (slope_gates * gradient.unsqueeze(-2)).to(gradient.dtype), (slope_deter * gradient).to(gradient.dtype)


def _gru_forward(gates: Tensor, deter: Tensor, out: Tensor | None = None) -> Tensor:
    reset, candidate, update = gates.unbind(-2)
    # lerp(h, v, w) = (1 - w) h + w v, in one pass over memory.
    return torch.lerp(deter, _tanh_(torch.sigmoid(reset).mul_(candidate)), (update - 1).sigmoid_(), out=out)


def _gate_slopes(gates: Tensor, deter: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the new memory by the old one [..., n] and by the three gates [..., 3, n].

    With R = σ(r), w = σ(k-1), v = tanh(R c) the new memory is h' = (1 - w) h + w v, so that dh'/dh = 1 - w, dh'/dc = w
    (1 - v²) R, dh'/dr = w (1 - v²) c R (1 - R), dh'/dk = (v - h) w (1 - w).
    """
    reset, candidate, update = widen(gates).unbind(-2)
    reset, update = torch.sigmoid(reset), torch.sigmoid(update - 1)  # R and w
    value = _tanh_(reset * candidate)  # v
    by_candidate = update * (1 - value * value) * reset
    by_reset = by_candidate * candidate * (1 - reset)
    by_update = (value - deter) * update * (1 - update)
    return 1 - update, torch.stack([by_reset, by_candidate, by_update], -2)


def _tanh_(x: Tensor) -> Tensor:
    """tanh in place, to an error that is small beside 1, not beside x: PyTorch's own is five times slower on CPUs."""
    return x.tanh_() if x.dtype == torch.float64 or x.device.type != "cpu" else x.mul_(2).sigmoid_().mul_(2).sub_(1)


def _blocks(x: Tensor, blocks: int) -> Tensor:
    """[..., B, D] -> [..., G, B, D/G], the same memory: batched products read and write it in place."""
    return x.unflatten(-1, (blocks, -1)).transpose(-2, -3)


class _Scan(torch.autograd.Function):
    """The loop and its adjoint, line by line as in the docstring of this module."""

    @staticmethod
    def forward(
        ctx: Any,
        options: ScanOptions,
        carry: Tensor,
        is_first: Tensor,
        uniform: Tensor,
        action_drive: Tensor,
        token_drive: Tensor,
        *flat: Tensor,
    ) -> Any:
        flat = tuple(x.to(action_drive.dtype) for x in flat)  # once, not once per step
        w, epsilon = ScanWeights.from_flat(flat), options.epsilon
        T, B, D = action_drive.shape
        G, Z, S, units = len(w.block), w.out.shape[1], options.stoch, w.out.shape[0]
        # The whole sequence is allocated here and every step writes its part in place: nothing is stacked at the end,
        # and the way back finds all steps side by side.
        new = action_drive.new_empty
        states, features = new(T, B, D + Z), new(T, B, D + Z)  # what a step starts from, after resets, and ends with
        embed, embedded = new(T, B, 2, units), new(T, B, 2 * units)
        hidden, activated = new(T, B, D), new(T, G, B, D // G)
        gates = new(T, G, B, 3, D // G)
        post = [new(T, B, units) for _ in range(1 + len(w.deeper))]
        logits = widen(new(0)).new_empty(T, B, S, Z // S)  # float32 or better
        embed_bias, gru_bias, zero = w.embed_bias.unbind(), w.gru_bias.view(G, 1, -1), carry.new_zeros(())
        feature = carry  # [B, D + Z]
        for t in range(T):
            # Selected, not multiplied: what a reset drops may be NaN.
            torch.where(is_first[t, :, None], zero, feature, out=states[t])
            deter, stoch, feature = states[t, :, :D], states[t, :, D:], features[t]  # h, z; feature is written below
            torch.addmm(embed_bias[0], deter, w.embed_deter, out=embed[t, :, 0])  # [B, D] @ [D, d]
            torch.addmm(embed_bias[1], stoch, w.embed_stoch, out=embed[t, :, 1])  # [B, Z] @ [Z, d]
            embedded[t] = norm_silu_forward(embed[t], w.embed_scale, epsilon).flatten(1)  # [B, 2, d] -> [B, 2d]
            # rssm/hidden in three parts: the action's came before the loop, the embeddings' is the same input for all
            # blocks and so one dense product, and each block adds that of its own memory.
            torch.addmm(action_drive[t], embedded[t], w.shared, out=hidden[t])  # [B, 2d] @ [2d, D]
            _blocks(hidden[t], G).baddbmm_(_blocks(deter, G), w.block)  # [G, B, D/G] @ [G, D/G, D/G]
            activated[t] = _blocks(norm_silu_forward(hidden[t], w.hidden_scale, epsilon), G)  # norm over all D
            torch.baddbmm(gru_bias, activated[t], w.gru, out=gates[t].flatten(-2))  # [G, B, D/G] @ [G, D/G, 3D/G]
            _gru_forward(gates[t], _blocks(deter, G), out=_blocks(feature[:, :D], G))  # h', into features[t]
            torch.addmm(token_drive[t], feature[:, :D], w.post_deter, out=post[0][t])  # [B, D] @ [D, d]
            x = norm_silu_forward(post[0][t], w.post_scale, epsilon)  # [B, d]
            for pre, (kernel, bias, scale) in zip(post[1:], w.deeper, strict=True):
                torch.addmm(bias, x, kernel, out=pre[t])  # [B, d] @ [d, d]
                x = norm_silu_forward(pre[t], scale, epsilon)
            logits[t] = torch.addmm(w.out_bias, x, w.out).view(B, S, -1)  # [B, d] @ [d, Z] -> [B, S, C]
            feature[:, D:] = sample_onehot(unimix_probs(logits[t], options.unimix), uniform[t]).flatten(1)  # z'
        # `save_for_backward` is for arguments and results, which would otherwise keep themselves alive in a circle.
        ctx.options, ctx.kept = options, (states, embed, embedded, hidden, activated, gates, post)
        ctx.save_for_backward(features, logits, is_first, *flat)
        return features, logits

    @staticmethod
    def backward(ctx: Any, by_features: Tensor, by_logits: Tensor) -> Any:
        features, logits, is_first, *flat = ctx.saved_tensors
        states, embed, embedded, hidden, activated, gates, post = ctx.kept
        w, epsilon = ScanWeights.from_flat(tuple(flat)), ctx.options.epsilon
        T, D, G = len(hidden), hidden.shape[-1], len(w.block)
        post_scales = [w.post_scale, *(scale for _, _, scale in w.deeper)]
        post_kernels = [kernel for kernel, _, _ in w.deeper] + [w.out]  # what reads act(p_0), act(p_1), ...

        # Before the loop: every factor that does not wait for the gradient of the state, for all steps at once.
        back_embed = _NormSiluBack(embed, w.embed_scale, epsilon)
        back_hidden = _NormSiluBack(hidden, w.hidden_scale, epsilon)
        back_post = [_NormSiluBack(x, scale, epsilon) for x, scale in zip(post, post_scales, strict=True)]
        keep, slope_gates = _gate_slopes(gates, _blocks(states[..., :D], G))  # [T, G, B, D/G], [T, G, B, 3, D/G]
        softmax = unimix_probs(logits, 0.0)  # s [T, B, S, C]
        mixed = softmax * (1 - ctx.options.unimix)

        # The loop back. Each gradient is kept for the products after it.
        by_embed, by_hidden, by_gates = torch.empty_like(embed), torch.empty_like(hidden), torch.empty_like(gates)
        by_post = [torch.empty_like(x) for x in post]
        by_out = torch.empty_like(logits).copy_(by_logits)  # ∂l [T, B, S, C], begun with what came from outside
        by_state = torch.zeros_like(features[0])  # ∂h, ∂z [B, D + Z] of what step t + 1 started from
        for t in reversed(range(T)):
            by_feature = by_features[t] + by_state  # ∂h', ∂z' [B, D + Z]
            straight = by_feature[:, D:].view_as(mixed[t]) * mixed[t]  # (1 - unimix) s ∂z' [B, S, C]
            by_out[t] += straight.addcmul_(softmax[t], straight.sum(-1, keepdim=True), value=-1)
            upstream = by_out[t].flatten(1).to(hidden.dtype)  # ∂l [B, Z] in the compute dtype
            for back, by_pre, kernel in zip(
                reversed(back_post), reversed(by_post), reversed(post_kernels), strict=True
            ):
                torch.mm(upstream, kernel.t(), out=back.upstream[t])  # ∂act(p_i) [B, d]
                upstream = back.step(t, by_pre[t])  # ∂p_i [B, d]
            by_memory = torch.addmm(by_feature[:, :D], upstream, w.post_deter.t())  # ∂h' [B, D]
            torch.mul(_blocks(by_memory, G).unsqueeze(-2), slope_gates[t], out=by_gates[t])  # ∂g [G, B, 3, D/G]
            _blocks(back_hidden.upstream[t], G).copy_(torch.bmm(by_gates[t].flatten(-2), w.gru.mT))  # ∂y [G, B, D/G]
            upstream = back_hidden.step(t, by_hidden[t])  # ∂x [B, D]
            torch.mm(upstream, w.shared.t(), out=back_embed.upstream[t].flatten(1))  # ∂u [B, 2d]
            by_deter_embed, by_stoch_embed = back_embed.step(t, by_embed[t]).unbind(1)  # ∂e [B, d] twice
            # The three ways to h: through the gate that keeps it, its own block of rssm/hidden, and its embedding.
            torch.mul(_blocks(by_memory, G), keep[t], out=_blocks(by_state[:, :D], G))
            _blocks(by_state[:, :D], G).baddbmm_(_blocks(upstream, G), w.block.mT)
            by_state[:, :D].addmm_(by_deter_embed, w.embed_deter.t())
            torch.mm(by_stoch_embed, w.embed_stoch.t(), out=by_state[:, D:])  # ∂z [B, Z]
            by_state.masked_fill_(is_first[t, :, None], 0)

        # After the loop: the gradient of each parameter, one product or sum over T * B rows, in float32 or better.
        by_logit = by_out.flatten(2).to(hidden.dtype)  # [T, B, Z]
        outputs = [back.output(x.dtype) for back, x in zip(back_post, post, strict=True)]  # act(p_0), act(p_1), ...
        by_later = [*by_post[1:], by_logit]  # the gradient of what each of them was multiplied into
        kernels = [_product(x, y) for x, y in zip(outputs, by_later, strict=True)]
        biases = [_sum(y) for y in by_later]
        scales = [back.by_scale() for back in back_post]
        gradients = ScanWeights(
            embed_deter=_product(states[..., :D], by_embed[..., 0, :]),
            embed_stoch=_product(states[..., D:], by_embed[..., 1, :]),
            embed_bias=_sum(by_embed),
            embed_scale=back_embed.by_scale(),
            shared=_product(embedded, by_hidden),
            block=_block_product(_blocks(states[..., :D], G), _blocks(by_hidden, G)),
            hidden_scale=back_hidden.by_scale(),
            gru=_block_product(activated, by_gates.flatten(-2)),
            gru_bias=by_gates.flatten(-2).sum((0, 2), dtype=logits.dtype).flatten(),
            out=kernels.pop(),
            out_bias=biases.pop(),
            post_deter=_product(features[..., :D], by_post[0]),
            post_scale=scales[0],
            deeper=tuple(zip(kernels, biases, scales[1:], strict=True)),
        )
        # Options, carry, is_first and uniform are constants.
        return None, None, None, None, by_hidden, by_post[0], *gradients.flat()


class _NormSiluBack:
    """act'(x, ∂y): the way back through y = silu(n scale) with n = ρ x. A step does only what needs its ∂y.

    With ρ = 1 / sqrt(mean(x²) + epsilon) over the N entries of the last axis, dn_j/dx_k = ρ (δ_jk - n_j n_k / N). So
    ∂x = a - n mean(a n) with a = ∂y silu'(n scale) scale ρ, and ∂scale is the sum of ∂y silu'(n scale) n.
    """

    def __init__(self, x: Tensor, scale: Tensor, epsilon: float) -> None:
        self.normal, inverse = normalize(x, epsilon)  # n [T, ..., N] and ρ [T, ..., 1], float32 or better
        self.scale = scale.to(inverse.dtype)
        self.slope = silu_slope(self.normal * self.scale)
        self.gain = self.slope * self.scale * inverse  # a is ∂y times this
        self.upstream = torch.empty_like(x)  # ∂y, filled in step by step and kept for the scale

    def step(self, t: int, by_x: Tensor) -> Tensor:
        """∂x at step t, given `upstream[t]`, written to by_x."""
        scaled = self.upstream[t] * self.gain[t]  # a
        along = (scaled * self.normal[t]).mean(-1, keepdim=True)
        return torch.addcmul(scaled, self.normal[t], along, value=-1, out=by_x)

    def by_scale(self) -> Tensor:
        """∂scale, over all steps and rows."""
        return (self.upstream * self.slope).mul_(self.normal).sum(tuple(range(self.normal.ndim - self.scale.ndim)))

    def output(self, dtype: torch.dtype) -> Tensor:
        """y, computed again: cheaper than to have kept it."""
        return torch.nn.functional.silu((self.normal * self.scale).to(dtype))


def _product(x: Tensor, y: Tensor) -> Tensor:
    """The gradient of a kernel: x [T, B, in], ∂y [T, B, out] -> [in, out]."""
    return wide_product(x.flatten(0, 1).t(), y.flatten(0, 1))


def _block_product(x: Tensor, y: Tensor) -> Tensor:
    """The same for every block: x [T, G, B, in/G], ∂y [T, G, B, out/G] -> [G, in/G, out/G]."""
    return wide_product(x.permute(1, 3, 0, 2).flatten(2), y.transpose(0, 1).flatten(1, 2))


def _sum(y: Tensor) -> Tensor:
    """The gradient of a bias: ∂y [T, B, ...] -> [...]."""
    return y.sum((0, 1), dtype=widen(y[:0]).dtype)
