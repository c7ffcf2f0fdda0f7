"""Linear maps, convolutions, normalization, nonlinearity and initial weights. Chapter: spec/03-layers.md."""

from collections.abc import Mapping
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import checked, require

Array = NDArray[np.float64]
Params = Mapping[str, Any]

KERNEL = 5  # D-35
TRUNCATED_NORMAL_STD = 0.8796256610342398  # of a standard normal cut off at -2 and 2


def linear(x: Any, kernel: Any, bias: Any) -> Array:
    """Linear map of the last axis. Implements [LAY-1], [LAY-2], [LAY-15], [LAY-16].

    Args:
      x: [..., in].
      kernel: [in, out].
      bias: [out].

    Returns:
      [..., out].

    Raises:
      ValueError: a shape does not fit.
    """
    kernel = checked("kernel", kernel, "in", "out")
    inputs, outputs = kernel.shape
    x = checked("x", x, ..., inputs)
    bias = checked("bias", bias, outputs)
    return x @ kernel + bias


def block_linear(x: Any, kernel: Any, bias: Any) -> Array:
    """A linear map of each of G contiguous blocks of the last axis. Implements [LAY-1], [LAY-3], [LAY-15], [LAY-16].

    Paper: section Networks (block-diagonal recurrent weights); D-29.

    Args:
      x: [..., in].
      kernel: [G, in/G, out/G].
      bias: [out].

    Returns:
      [..., out].

    Raises:
      ValueError: a shape does not fit.
    """
    kernel = checked("kernel", kernel, "G", "in/G", "out/G")
    blocks, inputs, outputs = kernel.shape
    x = checked("x", x, ..., blocks * inputs)
    bias = checked("bias", bias, blocks * outputs)
    pieces = [x[..., block * inputs : (block + 1) * inputs] @ kernel[block] for block in range(blocks)]
    return np.concatenate(pieces, axis=-1) + bias


def rms_norm(x: Any, scale: Any, epsilon: float) -> Array:
    """Division by the root mean square of the last axis. Implements [LAY-1], [LAY-4], [LAY-15], [LAY-16].

    Paper: Previous Dreamer generations (RMSNorm); D-39.

    Args:
      x: [..., n].
      scale: [n].
      epsilon: added to the mean square, inside the root.

    Returns:
      [..., n].

    Raises:
      ValueError: the shapes do not fit.
    """
    scale = checked("scale", scale, "n")
    x = checked("x", x, ..., len(scale))
    mean_square = np.mean(x**2, axis=-1, keepdims=True)
    return x / np.sqrt(mean_square + epsilon) * scale


def silu(x: Any) -> Array:
    """x times its sigmoid, element by element. Implements [LAY-5].

    Paper: Previous Dreamer generations (SiLU).

    Args:
      x: any shape.

    Returns:
      The same shape.
    """
    x = np.asarray(x, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        return x / (1.0 + np.exp(-x))


def convolution(x: Any, kernel: Any, bias: Any, stride: int) -> Array:
    """Cross-correlation with a 5x5 kernel that keeps (stride 1) or halves (stride 2) the image.
    Implements [LAY-1], [LAY-6], [LAY-15], [LAY-16].

    Paper: section Networks (stride 2 convolutions); D-33, D-35.

    Args:
      x: [..., H, W, in].
      kernel: [5, 5, in, out].
      bias: [out].
      stride: 1 or 2.

    Returns:
      [..., H/stride, W/stride, out].

    Raises:
      ValueError: a shape or the stride does not fit, or a side is odd at stride 2.
    """
    require(stride in (1, 2), "stride", "1 or 2", stride)
    x, kernel, bias = _image_kernel_bias(x, kernel, bias)
    if stride == 2:
        _require_even_sides(x)
    before, after = (2, 2) if stride == 1 else (1, 2)
    height, width = x.shape[-3:-1]
    padded = np.zeros((*x.shape[:-3], before + height + after, before + width + after, x.shape[-1]))
    padded[..., before : before + height, before : before + width, :] = x
    result = np.zeros((*x.shape[:-3], height // stride, width // stride, len(bias)))
    for row in range(KERNEL):
        for column in range(KERNEL):
            seen = padded[..., row : row + height : stride, column : column + width : stride, :]
            result += seen @ kernel[row, column]
    return result + bias


def transposed_convolution(x: Any, kernel: Any, bias: Any) -> Array:
    """Adjoint of the stride-2 convolution: doubles the image. Implements [LAY-1], [LAY-7], [LAY-15], [LAY-16].

    Paper: section Networks (transposed stride 2 convolutions); D-33, D-35.

    Args:
      x: [..., H, W, in].
      kernel: [5, 5, in, out].
      bias: [out].

    Returns:
      [..., 2H, 2W, out].

    Raises:
      ValueError: a shape does not fit.
    """
    x, kernel, bias = _image_kernel_bias(x, kernel, bias)
    height, width = x.shape[-3:-1]
    padded = np.zeros((*x.shape[:-3], 2 * height + 3, 2 * width + 3, len(bias)))
    for row in range(KERNEL):
        for column in range(KERNEL):
            padded[..., row : row + 2 * height : 2, column : column + 2 * width : 2, :] += x @ kernel[row, column]
    return padded[..., 1 : 1 + 2 * height, 1 : 1 + 2 * width, :] + bias


def max_pool(x: Any) -> Array:
    """Maximum of each 2x2 window. Implements [LAY-12], [LAY-15], [LAY-16].

    Not in the paper; D-33.

    Args:
      x: [..., H, W, C], even sides.

    Returns:
      [..., H/2, W/2, C].

    Raises:
      ValueError: fewer than three axes, or an odd side.
    """
    x = checked("x", x, ..., "H", "W", "C")
    _require_even_sides(x)
    upper, lower = x[..., 0::2, :, :], x[..., 1::2, :, :]
    rows = np.maximum(upper, lower)
    return np.maximum(rows[..., 0::2, :], rows[..., 1::2, :])


def upsample(x: Any) -> Array:
    """Every pixel twice in both axes. Implements [LAY-13], [LAY-15], [LAY-16].

    Not in the paper; D-33.

    Args:
      x: [..., H, W, C].

    Returns:
      [..., 2H, 2W, C].

    Raises:
      ValueError: fewer than three axes.
    """
    x = checked("x", x, ..., "H", "W", "C")
    return np.repeat(np.repeat(x, 2, axis=-3), 2, axis=-2)


def dense(params: Params, name: str, x: Any, epsilon: float) -> Array:
    """Linear, RMSNorm, SiLU. Implements [LAY-8], [LAY-15], [LAY-16].

    Args:
      params: `<name>/kernel` [in, out], `<name>/bias` [out], `<name>/scale` [out].
      name: of the layer.
      x: [..., in].
      epsilon: of the norm.

    Returns:
      [..., out].

    Raises:
      ValueError: a shape does not fit.
      KeyError: a parameter is missing.
    """
    x = linear(x, params[f"{name}/kernel"], params[f"{name}/bias"])
    return silu(rms_norm(x, params[f"{name}/scale"], epsilon))


def mlp(params: Params, name: str, x: Any, layers: int, epsilon: float) -> Array:
    """Dense layers in turn: `<name>/hidden0`, `<name>/hidden1`, ... Implements [LAY-8], [LAY-15], [LAY-16].

    Paper: section Networks; D-38.

    Args:
      params: of each layer, see `dense`.
      name: of the network.
      x: [..., in].
      layers: how many, at least 1.
      epsilon: of the norms.

    Returns:
      [..., out].

    Raises:
      ValueError: a shape does not fit, or no layer.
      KeyError: a parameter is missing.
    """
    require(layers >= 1, "layers", "at least 1", layers)
    for layer in range(layers):
        x = dense(params, f"{name}/hidden{layer}", x, epsilon)
    return x


def truncated_normal(uniform: Any, fan_in: int, outscale: float) -> Array:
    """Initial weights from uniform numbers. Implements [LAY-9], [LAY-10], [LAY-11], [LAY-15].

    Not in the paper; D-77.

    Args:
      uniform: any shape, in [0, 1).
      fan_in: inputs of the layer; all blocks together for a block-linear one.
      outscale: factor of the standard deviation.

    Returns:
      The same shape, with standard deviation outscale / sqrt(fan_in).

    Raises:
      ValueError: fan_in is below 1.
    """
    require(fan_in >= 1, "fan_in", "at least 1", fan_in)
    uniform = np.asarray(uniform, dtype=np.float64)
    standard = NormalDist()
    lowest, highest = standard.cdf(-2.0), standard.cdf(2.0)
    z = np.array([standard.inv_cdf(lowest + u * (highest - lowest)) for u in uniform.ravel()]).reshape(uniform.shape)
    return np.clip(z, -2.0, 2.0) / TRUNCATED_NORMAL_STD * outscale / np.sqrt(fan_in)


def _image_kernel_bias(x: Any, kernel: Any, bias: Any) -> tuple[Array, Array, Array]:
    kernel = checked("kernel", kernel, KERNEL, KERNEL, "in", "out")
    inputs, outputs = kernel.shape[2:]
    return checked("x", x, ..., "H", "W", inputs), kernel, checked("bias", bias, outputs)


def _require_even_sides(x: Array) -> None:
    require(not (x.shape[-3] % 2 or x.shape[-2] % 2), "x", "an even height and width", list(x.shape))
