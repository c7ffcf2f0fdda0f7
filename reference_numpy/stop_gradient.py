"""Stop-gradient without gradients: constants are recorded on one pass and replayed on later ones.

A central difference evaluates a loss at two shifted sets of parameters. What the gradient treats as a constant must not
move with them. So the loss runs once at the unshifted parameters while `recording`, and at each shifted set while
`replaying`:

    with recording() as tape:
        loss(params)
    with replaying(tape):
        upper = loss(shifted_up)
    with replaying(tape):
        lower = loss(shifted_down)

Chapters: spec/00-notation.md, spec/02-distributions.md.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Tape = list[Array]


class _Replay:
    """A tape and how far it has been played."""

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self.position = 0

    def next(self, shape: tuple[int, ...]) -> Array:
        call = self.position
        if call >= len(self.tape):
            raise ValueError(
                f"stop_gradient was called more often than recorded: {len(self.tape)} calls are on the tape"
            )
        if self.tape[call].shape != shape:
            raise ValueError(f"stop_gradient call {call}: recorded shape {self.tape[call].shape}, got {shape}")
        self.position += 1
        return self.tape[call].copy()


_active: Tape | _Replay | None = None


def stop_gradient(x: Any) -> Array:
    """The value of x, constant in the gradient. Implements [CON-14], [DIS-2].

    Paper: the operator sg in section World model learning.

    Args:
      x: an array of any shape.

    Returns:
      x itself; while replaying, the value that the same call had while recording.

    Raises:
      ValueError: while replaying, a call that was not recorded or had another shape.
    """
    x = np.asarray(x, dtype=np.float64)
    if isinstance(_active, _Replay):
        return _active.next(x.shape)
    if _active is not None:
        _active.append(x.copy())
    return x


@contextmanager
def recording() -> Iterator[Tape]:
    """A context in which stop_gradient also writes a copy of each value to the tape, in order.
    Implements [CON-14], [DIS-2].

    Raises:
      ValueError: inside another recording or replay.
    """
    tape: Tape = []
    with _activated(tape):
        yield tape


@contextmanager
def replaying(tape: Tape) -> Iterator[None]:
    """A context in which stop_gradient returns the recorded values, in order. Implements [CON-14], [DIS-2].

    Raises:
      ValueError: inside another recording or replay, or at the end if values were left over.
    """
    replay = _Replay(tape)
    with _activated(replay):
        yield
    if replay.position != len(tape):
        raise ValueError(f"stop_gradient was called {replay.position} times, recorded were {len(tape)} calls")


@contextmanager
def _activated(mode: Tape | _Replay) -> Iterator[None]:
    global _active
    if _active is not None:
        raise ValueError("a recording or replay is already going on; end it first")
    _active = mode
    try:
        yield
    finally:
        _active = None
