"""Layers: the parts that networks are built from. Chapter: spec/03-layers.md.

Images are [..., H, W, C]. PyTorch calls that a "channels last" tensor seen through a permutation: nothing is copied.

Parameters keep their own precision and are converted to the dtype of x, the compute dtype. Autograd takes the gradient
back through that conversion, and what it sums in bfloat16 it rounds to bfloat16. The functions written by hand here are
there to keep gradients of parameters in float32 [CON-23], or to keep less for the way back.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (so it is called everywhere)
from torch import Tensor

from impl_torch.shapes import require, require_shape, widen

Params = Mapping[str, Tensor]

TRUNCATED_STD = 0.8796256610342398  # of the standard normal cut at +-2
# From this many rows on, a float32 product on the CPU is computed as a 1x1 convolution. PyTorch gives matrix products
# to MKL, which on AMD processors does not use AVX-512, and convolutions to oneDNN, which does: about 1.8 times faster
# on a Zen 5, and no slower elsewhere. Below it, oneDNN's rearrangement of the kernel costs more than it wins. A single
# thread never reaches oneDNN, and loses nothing.
CONVOLUTION_ROWS = 256

NARROW = (torch.bfloat16, torch.float16)
_WIDE_OUTPUT = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 8)  # torch.mm and torch.bmm know out_dtype


def wide_product(x: Tensor, y: Tensor) -> Tensor:
    """x @ y, of two or three axes, in float32 or better whatever their dtype: for gradients of kernels. [CON-23]"""
    if x.dtype not in NARROW:
        return x @ y
    if _WIDE_OUTPUT and x.device.type == "cuda":
        return (torch.mm if x.ndim == 2 else torch.bmm)(x, y, out_dtype=torch.float32)
    return x.float() @ y.float()  # products of two bfloat16 are exact in float32: this only widens the sum


class _NarrowProduct(torch.autograd.Function):
    """A linear or block-linear layer in bfloat16 whose kernel and bias have gradients in float32.

    y = x W + b; x [G, N, in], W [G, in, out], b [G, 1, out] or None.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
        narrow = kernel.to(x.dtype)
        ctx.save_for_backward(x, narrow)
        ctx.dtypes = kernel.dtype, None if bias is None else bias.dtype
        return torch.bmm(x, narrow) if bias is None else torch.baddbmm(bias.to(x.dtype), x, narrow)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        # ∂x = ∂y Wᵀ [G, N, in], ∂W = xᵀ ∂y [G, in, out], ∂b = sum over N of ∂y [G, 1, out]
        x, kernel = ctx.saved_tensors
        kernel_dtype, bias_dtype = ctx.dtypes
        by_x = torch.bmm(gradient, kernel.mT) if ctx.needs_input_grad[0] else None
        by_bias = None if bias_dtype is None else gradient.sum(1, keepdim=True, dtype=torch.float32).to(bias_dtype)
        return by_x, wide_product(x.mT, gradient).to(kernel_dtype), by_bias


def _as_convolution(x: Tensor, rows: int) -> bool:
    return (
        rows >= CONVOLUTION_ROWS
        and x.device.type == "cpu"
        and x.dtype == torch.float32
        and torch.backends.mkldnn.is_available()
    )


def for_many_rows(params: Params) -> Params:
    """The same parameters with kernels in the memory order that oneDNN wants: each product would rearrange its own."""

    def arrange(x: Tensor) -> Tensor:
        fits = x.ndim in (2, 3) and _as_convolution(x, CONVOLUTION_ROWS)
        return x.mT.contiguous().mT if fits else x

    return {name: arrange(x) for name, x in params.items()}


def _pointwise(x: Tensor, weight: Tensor, bias: Tensor | None, groups: int) -> Tensor:
    """The rows of x [N, in] as the pixels of one channels-last image; weight [out, in/groups] -> [N, out]."""
    rows, inputs = x.shape
    width = 32 if rows % 32 == 0 else 1  # the result is the same for every width
    image = x.reshape(1, rows // width, width, inputs).permute(0, 3, 1, 2)  # [1, in, N/width, width], the same memory
    y = F.conv2d(image, weight[:, :, None, None], bias, groups=groups)
    return y.permute(0, 2, 3, 1).reshape(rows, -1)


def linear(x: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
    """x @ kernel + bias over the last axis: [..., in], [in, out], [out] -> [..., out]. [LAY-1] [LAY-2] [LAY-15]"""
    require_shape("kernel", kernel.shape, "in", "out")
    require_shape("x", x.shape, ..., kernel.shape[0])
    if bias is not None:
        require_shape("bias", bias.shape, kernel.shape[1])
    rows = x.reshape(-1, x.shape[-1])  # [N, in]
    if x.dtype in NARROW:
        y = _NarrowProduct.apply(rows[None], kernel[None], None if bias is None else bias[None, None])[0]
    else:
        kernel, bias = kernel.to(x.dtype), None if bias is None else bias.to(x.dtype)
        if _as_convolution(x, len(rows)):
            y = _pointwise(rows, kernel.t(), bias, 1)
        else:
            y = rows @ kernel if bias is None else torch.addmm(bias, rows, kernel)
    return y.view(*x.shape[:-1], kernel.shape[1])


def block_linear(x: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
    """A linear layer of G blocks: [..., in], [G, in/G, out/G], [out] -> [..., out]. [LAY-1] [LAY-3] [LAY-15]"""
    require_shape("kernel", kernel.shape, "G", "in/G", "out/G")
    blocks, inputs, outputs = kernel.shape
    require_shape("x", x.shape, ..., blocks * inputs)
    if bias is not None:
        require_shape("bias", bias.shape, blocks * outputs)
    rows = x.reshape(-1, blocks * inputs)  # [N, in]
    if _as_convolution(x, len(rows)):
        weight = kernel.to(x.dtype).transpose(1, 2).reshape(blocks * outputs, inputs)
        y = _pointwise(rows, weight, None if bias is None else bias.to(x.dtype), blocks)
    else:
        by_block = rows.view(-1, blocks, inputs).transpose(0, 1)  # [G, N, in/G]
        bias = None if bias is None else bias.view(blocks, 1, outputs)
        if x.dtype in NARROW:
            y = _NarrowProduct.apply(by_block, kernel, bias)
        else:
            kernel = kernel.to(x.dtype)
            y = torch.bmm(by_block, kernel) if bias is None else torch.baddbmm(bias.to(x.dtype), by_block, kernel)
        y = y.transpose(0, 1).reshape(-1, blocks * outputs)  # [G, N, out/G] -> [N, out]
    return y.view(*x.shape[:-1], blocks * outputs)


def normalize(x: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    """x / root mean square over the last axis, and 1 / root mean square [..., 1], both in float32 or better."""
    x = widen(x)
    norm = torch.linalg.vector_norm(x, dim=-1, keepdim=True)  # one pass, unlike the mean of the square
    inverse = torch.rsqrt(norm * norm / x.shape[-1] + epsilon)
    return x * inverse, inverse


def rms_norm(x: Tensor, scale: Tensor, epsilon: float) -> Tensor:
    """x / sqrt(mean(x^2) + epsilon) * scale over the last axis: [..., n], [n] -> [..., n]. [LAY-1] [LAY-4] [LAY-15]"""
    require_shape("scale", scale.shape, "n")
    require_shape("x", x.shape, ..., len(scale))
    normal, _ = normalize(x, epsilon)
    rounded = scale + (scale.to(x.dtype) - scale).detach()  # in this way its gradient is not rounded too [CON-23]
    return (normal * rounded).to(x.dtype)


def silu(x: Tensor) -> Tensor:
    """x sigmoid(x), element by element. [LAY-5]"""
    return F.silu(x)


def norm_silu(x: Tensor, scale: Tensor, epsilon: float) -> Tensor:
    """silu(rms_norm(x, scale, epsilon)), fused: [..., n] and [n], or [..., k, n] and [k, n] for k norms at once."""
    return _NormSilu.apply(x, scale, epsilon)


def norm_silu_forward(x: Tensor, scale: Tensor, epsilon: float) -> Tensor:
    """The value of `norm_silu`, outside of autograd."""
    normal, _ = normalize(x, epsilon)
    return F.silu(normal.mul_(scale.to(x.dtype)).to(x.dtype), inplace=True)


def silu_slope(x: Tensor) -> Tensor:
    """The derivative of silu: s + x s (1 - s) with s = sigmoid(x)."""
    gate = torch.sigmoid(x)
    return torch.addcmul(gate, x * gate, 1 - gate)


def norm_gradients(gradient: Tensor, normal: Tensor, inverse: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """From the gradient by scale * normal, with `normal, inverse = normalize(x)`: the gradients by x and by scale.

    n = ρ x with ρ = 1 / sqrt(mean(x²) + epsilon) over N entries, so dn_j/dx_k = ρ (δ_jk - n_j n_k / N), and
    ∂x = ρ (a - n mean(a n)) with a = gradient * scale.
    """
    by_scale = (gradient * normal).sum_to_size(scale.shape)  # over every row; a sum over no axes would be over all
    scaled = gradient * scale  # a
    along = (scaled * normal).mean(-1, keepdim=True)  # [..., 1]
    return torch.addcmul(scaled, normal, along, value=-1).mul_(inverse), by_scale


class _NormSilu(torch.autograd.Function):
    """Keeps its input alone and computes the rest again, where autograd would keep and read every intermediate result.

    The way back is silu' times the gradient, and then `norm_gradients`.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, scale: Tensor, epsilon: float) -> Tensor:
        ctx.save_for_backward(x, scale)
        ctx.epsilon = epsilon
        return norm_silu_forward(x, scale, epsilon)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        x, scale = ctx.saved_tensors
        normal, inverse = normalize(x, ctx.epsilon)
        wide = scale.to(x.dtype).to(normal.dtype)  # rounded to the compute dtype, as the way there multiplied it
        by_x, by_scale = norm_gradients(silu_slope(normal * wide).mul_(gradient), normal, inverse, wide)
        return by_x.to(x.dtype), by_scale.to(scale.dtype), None


class _BiasGradient(torch.autograd.Function):
    """y [..., out] as it is, the bias [out] having been added before: here its gradient is summed, in float32. [CON-23]

    A convolution of bfloat16 would sum, and round, the gradient of its bias in bfloat16.
    """

    @staticmethod
    def forward(ctx: Any, y: Tensor, bias: Tensor) -> Tensor:
        ctx.dtype = bias.dtype
        return y.view_as(y)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        return gradient, gradient.sum(tuple(range(gradient.ndim - 1)), dtype=torch.float32).to(ctx.dtype)


def _inner_bias(bias: Tensor, dtype: torch.dtype) -> Tensor:
    """The bias as a convolution adds it: without a gradient where `_BiasGradient` takes care of it."""
    return bias.detach().to(dtype) if dtype in NARROW else bias.to(dtype)


def _require_images(x: Tensor, kernel: Tensor, bias: Tensor) -> None:
    require_shape("kernel", kernel.shape, 5, 5, "in", "out")
    require_shape("x", x.shape, ..., "H", "W", kernel.shape[2])
    require_shape("bias", bias.shape, kernel.shape[3])


def _require_even_sides(x: Tensor) -> None:
    require(not (x.shape[-3] % 2 or x.shape[-2] % 2), "x", "an even height and width", list(x.shape))


def _to_planes(x: Tensor) -> Tensor:
    """[..., H, W, C] -> [N, C, H, W], the same memory."""
    return x.reshape(-1, *x.shape[-3:]).permute(0, 3, 1, 2)


def _to_pixels(y: Tensor, x: Tensor) -> Tensor:
    """[N, C, H, W] -> [..., H, W, C] with the leading axes of x."""
    y = y.permute(0, 2, 3, 1)
    return y.reshape(*x.shape[:-3], *y.shape[1:])


def convolution(x: Tensor, kernel: Tensor, bias: Tensor, stride: int) -> Tensor:
    """5x5 cross-correlation: [..., H, W, in], [5, 5, in, out], [out] -> [..., H/stride, W/stride, out].

    [LAY-1] [LAY-6] [LAY-15]
    """
    require(stride in (1, 2), "stride", "1 or 2", stride)
    _require_images(x, kernel, bias)
    planes, padding = _to_planes(x), 2
    if stride == 2:
        _require_even_sides(x)
        planes, padding = F.pad(planes, (1, 2, 1, 2)), 0  # one before and two behind: PyTorch's own is the same on both
    weight, inner = kernel.to(x.dtype).permute(3, 2, 0, 1), _inner_bias(bias, x.dtype)  # [out, in, 5, 5]
    y = _to_pixels(F.conv2d(planes, weight, inner, stride, padding), x)
    return _BiasGradient.apply(y, bias) if x.dtype in NARROW else y


def transposed_convolution(x: Tensor, kernel: Tensor, bias: Tensor) -> Tensor:
    """The adjoint of the stride-2 convolution: [..., H, W, in], [5, 5, in, out], [out] -> [..., 2H, 2W, out].

    [LAY-1] [LAY-7] [LAY-15]
    """
    _require_images(x, kernel, bias)
    weight, inner = kernel.to(x.dtype).permute(2, 3, 0, 1), _inner_bias(bias, x.dtype)  # [in, out, 5, 5]
    y = F.conv_transpose2d(_to_planes(x), weight, inner, stride=2, padding=1)  # [N, out, 2H + 1, 2W + 1]
    y = _to_pixels(y[:, :, :-1, :-1], x)  # PyTorch pads both sides alike: one row and one column are too many
    return _BiasGradient.apply(y, bias) if x.dtype in NARROW else y


def max_pool(x: Tensor) -> Tensor:
    """Largest value of each 2x2 square: [..., H, W, C] -> [..., H/2, W/2, C]. [LAY-12] [LAY-15]"""
    require_shape("x", x.shape, ..., "H", "W", "C")
    _require_even_sides(x)
    return _to_pixels(F.max_pool2d(_to_planes(x), 2), x)


def upsample(x: Tensor) -> Tensor:
    """Every pixel twice in both directions: [..., H, W, C] -> [..., 2H, 2W, C]. [LAY-13] [LAY-15]"""
    require_shape("x", x.shape, ..., "H", "W", "C")
    return _to_pixels(F.interpolate(_to_planes(x), scale_factor=2, mode="nearest"), x)


def dense(params: Params, name: str, x: Tensor, epsilon: float) -> Tensor:
    """Linear, RMSNorm, SiLU with the parameters name/kernel, name/bias, name/scale: [..., in] -> [..., out]. [LAY-8]"""
    y = linear(x, params[f"{name}/kernel"], params[f"{name}/bias"])
    scale = params[f"{name}/scale"]
    require_shape(f"{name}/scale", scale.shape, y.shape[-1])
    return norm_silu(y, scale, epsilon)


def mlp(params: Params, name: str, x: Tensor, layers: int, epsilon: float) -> Tensor:
    """`layers` dense layers name/hidden0, name/hidden1, ...: [..., in] -> [..., out]. [LAY-8] [LAY-15]"""
    require(layers >= 1, "layers", "at least 1", layers)
    for layer in range(layers):
        x = dense(params, f"{name}/hidden{layer}", x, epsilon)
    return x


def truncated_normal(uniform: Tensor, fan_in: int, outscale: float) -> Tensor:
    """Initial weights from uniforms, any shape: standard deviation outscale / sqrt(fan_in). [LAY-9] to [LAY-11]"""
    require(fan_in >= 1, "fan_in", "at least 1", fan_in)
    normal = math.sqrt(2) * torch.erfinv((2 * uniform - 1) * math.erf(math.sqrt(2)))
    return normal.clamp(-2, 2) * (outscale / math.sqrt(fan_in) / TRUNCATED_STD)
