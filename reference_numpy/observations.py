"""Raw observations as numbers, for the encoder and the reconstruction losses. Chapters: spec/05-networks.md, 06."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spec.spaces import Discrete

Array = NDArray[np.float64]


def one_hots(key: str, value: Any, space: Discrete) -> Array:
    """A Discrete observation as one one-hot for each entry. Implements [NET-3], [NET-4], [CON-26].

    Args:
      key: name of the observation, for messages.
      value: integers [..., len(classes)], as `require_observations` has let them through.

    Returns:
      [..., sum of classes].

    Raises:
      ValueError: a value is out of range.
    """
    value = np.asarray(value)
    outputs = []
    for entry, classes in enumerate(space.classes):
        column = value[..., entry]
        wrong = column[(column < 0) | (column >= classes)]
        if wrong.size:
            raise ValueError(
                f"observations[{key!r}], entry {entry}: expected values in 0 .. {classes - 1}, got {wrong.flat[0]}"
            )
        outputs.append((column[..., None] == np.arange(classes)).astype(np.float64))
    return np.concatenate(outputs, axis=-1)


def scaled_image(value: Any) -> Array:
    """Brightness between 0 and 1. Implements [NET-6], [WM-4].

    Args:
      value: uint8 [..., height, width, channels].

    Returns:
      value / 255.
    """
    return np.asarray(value, dtype=np.float64) / 255.0
