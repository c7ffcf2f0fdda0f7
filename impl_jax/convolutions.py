"""The three convolutions without bias, each with hand-written gradients. The layers of chapter 03 are in layers.py.

On accelerators they are the compiler's own. On the CPU those reach a quarter of the matrix rate, and less in the
gradients, so there a few images at a time are unfolded into a matrix of patches that stays in the cache and is
multiplied with the kernel; the gradients are arranged so that each of them is again such a product, without the zeros
that a dilated convolution would multiply.

In one dimension, with taps k = 0 ... 4, the three are

    same    y[i] = sum over k of x[i + k - 2] K[k]
    halve   y[i] = sum over k of x[2i + k - 1] K[k]
    double  y[2i + k - 1] sums x[i] K[k]

With g = dL/dy the gradients follow by collecting what each x[j] and K[k] was multiplied with:

    same    dx[j] = sum over k of g[j - k + 2] K[k]ᵀ: `same` of g with the taps in reverse
            dK[k] = sum over i of x[i + k - 2]ᵀ g[i]
    halve   dx[2i + k - 1] sums g[i] K[k]ᵀ: `double` of g
            dK[k] = sum over i of x[2i + k - 1]ᵀ g[i]
    double  dx[i] = sum over k of g[2i + k - 1] K[k]ᵀ: `halve` of g
            dK[k] = sum over i of x[i]ᵀ g[2i + k - 1]: that of `halve` with x and g exchanged, transposed
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

_NHWC = ("NHWC", "HWIO", "NHWC")
_PATCH_BYTES = 12 << 20  # of patches at a time: a share of the last cache
_THIN = 8  # channels below which copying patches costs more than multiplying them


def precision(dtype: jnp.dtype) -> lax.Precision:
    """float32 products must not be rounded to TF32 [LAY-1]; bfloat16 operands have nothing to lose."""
    return lax.Precision.DEFAULT if dtype == jnp.bfloat16 else lax.Precision.HIGHEST


def _padding(size: int, stride: int) -> tuple[int, int]:
    """Zeros before and after an image. [LAY-6]"""
    return (1, 2) if stride == 2 else (size // 2, size // 2)


def depth_to_space(x: jax.Array) -> jax.Array:
    """[n, h, w, (2, 2, c)] -> [n, 2h, 2w, c]."""
    n, h, w, c = x.shape
    return x.reshape(n, h, w, 2, 2, c // 4).transpose(0, 1, 3, 2, 4, 5).reshape(n, 2 * h, 2 * w, c // 4)


def doubling_kernel(kernel: jax.Array) -> jax.Array:
    """A transposed convolution's kernel [5, 5, in, out] as [3, 3, in, (2, 2, out)], for `same` and `depth_to_space`.

    Output 2i + a reads input i + q through tap a + 1 - 2q: three inputs, of which one tap may not exist.
    """
    inputs, outputs = kernel.shape[2:]
    # A tap -1 of zeros in front, then backwards: place (r, s) of [3, 2] holds tap 4 - 2r - s, that of q = r - 1 and
    # a = 1 - s; the second reversal puts a in order.
    taps = jnp.pad(kernel, ((1, 0), (1, 0), (0, 0), (0, 0)))[::-1, ::-1].reshape(3, 2, 3, 2, inputs, outputs)
    return taps[:, ::-1, :, ::-1].transpose(0, 2, 4, 1, 3, 5).reshape(3, 3, inputs, 4 * outputs)


def upsampling_kernel(kernel: jax.Array) -> jax.Array:
    """As `doubling_kernel`, for nearest-neighbour upsampling and then `same`: taps on the same pixel add up.

    Output 2i + a reads input i + q through the taps 2q + b + 2 - a for b = 0, 1: nine products instead of twenty-five.
    """

    def fold(taps: jax.Array, axis: int) -> jax.Array:
        """An axis of 5 taps -> one of 3, with a new first axis of 2 for a."""
        edge = [(0, 0)] * taps.ndim
        edge[axis] = (1, 1)
        taps = jnp.pad(taps, edge)  # tap k at place k + 1 of 7
        phases = [
            lax.slice_in_dim(taps, 1 - a, 7 - a, axis=axis) for a in (0, 1)
        ]  # tap 2 (q + 1) + b - a at (q + 1, b)
        shape = (*taps.shape[:axis], 3, 2, *taps.shape[axis + 1 :])
        return jnp.stack([phase.reshape(shape).sum(axis + 1) for phase in phases], axis=0)

    folded = fold(fold(kernel, 1), 1)  # columns: [2, 5, 3, in, out], then rows: [2, 2, 3, 3, in, out]
    inputs, outputs = kernel.shape[2:]
    return folded.transpose(2, 3, 4, 0, 1, 5).reshape(3, 3, inputs, 4 * outputs)


def _patches(x: jax.Array, size: int, stride: int) -> jax.Array:
    """The inputs of every output: [n, H, W, c] -> [n * H/stride * W/stride, size * size * c]."""
    n, height, width, channels = x.shape
    padding = _padding(size, stride)
    x = jnp.pad(x, ((0, 0), padding, padding, (0, 0)))

    def shift(x: jax.Array, tap: int, axis: int, outputs: int) -> jax.Array:
        """What one tap reads for all outputs along an axis."""
        return lax.slice_in_dim(x, tap, tap + stride * (outputs - 1) + 1, stride, axis)

    rows, columns = height // stride, width // stride
    if channels < _THIN:  # first along the columns, then along the rows: the second copy moves `size` times longer runs
        # [n, H + 4, W/stride, size * c] -> [n, H/stride, W/stride, size * size * c]
        x = jnp.concatenate([shift(x, column, 2, columns) for column in range(size)], -1)
        x = jnp.concatenate([shift(x, row, 1, rows) for row in range(size)], -1)
    else:
        x = jnp.concatenate(
            [shift(shift(x, row, 1, rows), column, 2, columns) for row in range(size) for column in range(size)], -1
        )
    return x.reshape(n * rows * columns, size * size * channels)


def divisor(count: int, most: int) -> int:
    """The largest divisor of `count` that is at most `most`, and at least 1."""
    return next(d for d in range(max(1, min(count, most)), 0, -1) if count % d == 0)


def _by_chunks(function: Callable[[jax.Array], jax.Array], x: jax.Array, patch_numbers: int) -> jax.Array:
    """`function` on a few images at a time."""
    images = x.shape[0]
    chunk = divisor(images, _PATCH_BYTES // (patch_numbers * x.dtype.itemsize))
    if chunk == images:
        return function(x)
    y = lax.map(function, x.reshape(images // chunk, chunk, *x.shape[1:]))
    return y.reshape(images, *y.shape[2:])


def _correlate_cpu(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    size, _, inputs, outputs = kernel.shape
    height, width = x.shape[1] // stride, x.shape[2] // stride
    matrix = kernel.reshape(size * size * inputs, outputs)  # rows in the order of a patch

    def thick(x: jax.Array) -> jax.Array:
        """[n, H, W, in] -> [n, H/stride, W/stride, out]: one product of all patches with the kernel."""
        y = jnp.matmul(_patches(x, size, stride), matrix, precision=precision(x.dtype))
        return y.reshape(x.shape[0], height, width, outputs)

    def thin(x: jax.Array) -> jax.Array:
        """For a few output channels the other way round: multiply first, then add up shifted planes.

        A matrix with so few columns would not be worth the copies of x that its patches are.
        """
        wide = jnp.promote_types(x.dtype, jnp.float32)
        # Every tap with every pixel: [n, 5, 5, out, H, W]; summed in float32, as a product would be.
        planes = jnp.einsum("klio,nhwi->nklohw", kernel, x, precision=precision(x.dtype), preferred_element_type=wide)
        edge = size // 2
        planes = jnp.pad(planes, ((0, 0),) * 4 + ((edge, edge), (edge, edge)))
        taps = [(row, column) for row in range(size) for column in range(size)]
        shifted = (planes[:, r, c, :, r : r + height, c : c + width] for r, c in taps)
        return functools.reduce(jnp.add, shifted).transpose(0, 2, 3, 1).astype(x.dtype)

    is_thin = stride == 1 and outputs < _THIN <= inputs
    patch_numbers = height * width * size * size * (outputs if is_thin else inputs)
    return _by_chunks(thin if is_thin else thick, x, patch_numbers)


def _correlate_native(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    padding = [_padding(kernel.shape[0], stride)] * 2
    strides = (stride, stride)
    return lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=_NHWC, precision=precision(x.dtype))


def _correlate(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """[n, H, W, in], [k, k, in, out] -> [n, H/stride, W/stride, out], chosen when it is compiled for a platform."""
    kernel = kernel.astype(x.dtype)
    cpu, native = (functools.partial(f, stride=stride) for f in (_correlate_cpu, _correlate_native))
    return lax.platform_dependent(x, kernel, cpu=cpu, default=native)


def _double_cpu(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Patches of 3 x 3 with all four outputs of a pixel at once, where dilation would multiply three zeros in four."""
    kernel = doubling_kernel(kernel)
    matrix = kernel.reshape(-1, kernel.shape[3])

    def function(x: jax.Array) -> jax.Array:
        y = jnp.matmul(_patches(x, 3, 1), matrix, precision=precision(x.dtype))
        return depth_to_space(y.reshape(*x.shape[:3], matrix.shape[1]))

    return _by_chunks(function, x, x.shape[1] * x.shape[2] * matrix.shape[0])


def _double_native(x: jax.Array, kernel: jax.Array) -> jax.Array:
    padding = [(3, 2), (3, 2)]  # x[i] at place 2i + 3: output j reads places j ... j + 4, taps in reverse
    return lax.conv_general_dilated(
        x,
        kernel[::-1, ::-1],
        (1, 1),
        padding,
        lhs_dilation=(2, 2),
        dimension_numbers=_NHWC,
        precision=precision(x.dtype),
    )


def _double(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return lax.platform_dependent(x, kernel.astype(x.dtype), cpu=_double_cpu, default=_double_native)


def _kernel_gradient_cpu(x: jax.Array, g: jax.Array, size: int, stride: int) -> jax.Array:
    """Patches of x transposed times g, added up over chunks of images."""
    if stride == 1 and g.shape[3] < x.shape[3]:  # unfold the thinner side: seen from there the taps run backwards
        return _kernel_gradient_cpu(g, x, size, 1)[::-1, ::-1].swapaxes(2, 3)
    inputs, outputs, images = x.shape[3], g.shape[3], x.shape[0]
    dtype = jnp.promote_types(x.dtype, jnp.float32)
    numbers = g.shape[1] * g.shape[2] * size * size * inputs
    chunk = divisor(images, _PATCH_BYTES // (numbers * x.dtype.itemsize))

    def add(total: jax.Array, pair: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        patches, g = _patches(pair[0], size, stride), pair[1].reshape(-1, outputs)  # a row for each output pixel
        product = lax.dot_general(
            patches, g, (((0,), (0,)), ((), ())), precision=precision(x.dtype), preferred_element_type=dtype
        )
        return total + product, None

    split = tuple(a.reshape(images // chunk, chunk, *a.shape[1:]) for a in (x, g))
    total, _ = lax.scan(add, jnp.zeros((size * size * inputs, outputs), dtype), split)
    return total.reshape(size, size, inputs, outputs)


def _kernel_gradient_native(x: jax.Array, g: jax.Array, size: int, stride: int) -> jax.Array:
    dtype = jnp.promote_types(x.dtype, jnp.float32)
    # A convolution that sums over images as over channels: x as [in, H, W, n], g as its kernel [n, h, w, out] with
    # `stride` between the taps. bfloat16 products are exact in float32: converting first only widens the sum [CON-23].
    return lax.conv_general_dilated(
        x.astype(dtype),
        g.astype(dtype),
        (1, 1),
        [_padding(size, stride)] * 2,
        rhs_dilation=(stride, stride),
        dimension_numbers=("CHWN", "IHWO", "HWNC"),
        precision=precision(x.dtype),
    )


def _kernel_gradient(x: jax.Array, g: jax.Array, size: int, stride: int) -> jax.Array:
    """dK [size, size, in, out] from x [n, H, W, in] and g [n, H/stride, W/stride, out], in float32 or better."""
    cpu, native = (
        functools.partial(f, size=size, stride=stride) for f in (_kernel_gradient_cpu, _kernel_gradient_native)
    )
    return lax.platform_dependent(x, g, cpu=cpu, default=native)


@jax.custom_vjp
def same(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolution of stride 1, zeros around: [n, H, W, in], [k, k, in, out] with odd k -> [n, H, W, out]."""
    return _correlate(x, kernel, 1)


def _same_bwd(saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    dx = _correlate(g, kernel[::-1, ::-1].swapaxes(2, 3), 1)
    return dx, _kernel_gradient(x, g, kernel.shape[0], 1).astype(kernel.dtype)


same.defvjp(lambda x, kernel: (same(x, kernel), (x, kernel)), _same_bwd)


@jax.custom_vjp
def halve(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolution of stride 2: [n, H, W, in], [5, 5, in, out] -> [n, H/2, W/2, out]."""
    return _correlate(x, kernel, 2)


def _halve_bwd(saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    return _double(g, kernel.swapaxes(2, 3)), _kernel_gradient(x, g, 5, 2).astype(kernel.dtype)


halve.defvjp(lambda x, kernel: (halve(x, kernel), (x, kernel)), _halve_bwd)


@jax.custom_vjp
def double(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Transposed convolution, the adjoint of `halve`: [n, H, W, in], [5, 5, in, out] -> [n, 2H, 2W, out]."""
    return _double(x, kernel)


def _double_bwd(saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    return _correlate(g, kernel.swapaxes(2, 3), 2), _kernel_gradient(g, x, 5, 2).swapaxes(2, 3).astype(kernel.dtype)


double.defvjp(lambda x, kernel: (double(x, kernel), (x, kernel)), _double_bwd)
