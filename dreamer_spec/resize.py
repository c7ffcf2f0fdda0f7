"""Images to another size in NumPy alone, the same bits on every machine: a policy that acts elsewhere sees what it saw
in training."""

import functools

import numpy as np

# of a weight: with 8 of a pixel, sums over rows and columns stay below 2**53, so float64 adds them exactly in any order
BITS = 20


def resize(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """[H, W, C] uint8 -> [height, width, C] uint8, bilinear, each channel for itself; in memory of its own. Implements
    [LOOP-30]."""
    if image.shape[:2] == (height, width):
        return np.array(image, np.uint8)
    wide = _resample(image.transpose(1, 0, 2).astype(np.float64), width).transpose(1, 0, 2)
    return np.floor(_resample(wide, height) * 0.25**BITS + 0.5).astype(np.uint8)


def _resample(image: np.ndarray, size: int) -> np.ndarray:
    """Along the first axis; the numbers grow by 2**BITS."""
    return (_weights(image.shape[0], size) @ image.reshape(image.shape[0], -1)).reshape(size, *image.shape[1:])


@functools.lru_cache(maxsize=16)
def _weights(old: int, new: int) -> np.ndarray:
    """[new, old] whole numbers: a triangle around the centre of each new pixel, as wide as two pixels of the coarser
    image."""
    distance = np.arange(old) + 0.5 - (np.arange(new)[:, None] + 0.5) * (old / new)
    triangle = np.maximum(0.0, 1.0 - np.abs(distance) / max(1.0, old / new))
    return np.rint(triangle / triangle.sum(1, keepdims=True) * 2**BITS)
