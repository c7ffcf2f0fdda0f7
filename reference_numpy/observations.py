"""Raw observations as numbers, for the encoder and for the reconstruction losses. Chapters: spec/05-networks.md,
06-world-model.md."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import require_shape
from spec.spaces import Discrete

Array = NDArray[np.float64]


def one_hots(key: str, value: Any, space: Discrete) -> Array:
    """A Discrete observation as one one-hot for each entry. Implements [NET-3], [NET-4], [CON-26].

    Args:
      key: name of the observation, for messages.
      value: integers [..., len(classes)].

    Returns:
      [..., sum of classes].

    Raises:
      ValueError: the dtype is not an integer one, or a value is out of range.
    """
    value = np.asarray(value)
    if not np.issubdtype(value.dtype, np.integer):
        raise ValueError(f"observation {key!r}: a Discrete needs an integer dtype, got {value.dtype}")
    require_shape(f"observation {key!r}", value.shape, ..., len(space.classes))
    outputs = []
    for entry, classes in enumerate(space.classes):
        column = value[..., entry]
        wrong = column[(column < 0) | (column >= classes)]
        if wrong.size:
            raise ValueError(
                f"observation {key!r}, entry {entry}: expected values in 0 .. {classes - 1}, got {wrong.flat[0]}"
            )
        outputs.append((column[..., None] == np.arange(classes)).astype(np.float64))
    return np.concatenate(outputs, axis=-1)


def scaled_image(key: str, value: Any) -> Array:
    """Brightness between 0 and 1. Implements [NET-6], [WM-4].

    Args:
      key: name of the observation, for messages.
      value: uint8 [..., height, width, channels].

    Returns:
      value / 255.

    Raises:
      ValueError: the dtype is not uint8.
    """
    value = np.asarray(value)
    if value.dtype != np.uint8:
        raise ValueError(f"observation {key!r}: an Image needs the dtype uint8, got {value.dtype}")
    return value.astype(np.float64) / 255.0
