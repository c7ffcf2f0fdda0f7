"""How far two float64 implementations may be apart. docs/lockstep.md has the reasons and the measurements."""

import math

from conformance.lockstep.drift import Tensor

# Share of the way that one update may be off, by the part that a tensor belongs to; at least ten times the worst that
# was measured.
# rounding of stored numbers, relative to an update of the learning rate's size; and what follows from the next line
WORLD_MODEL = 1e-8
VALUES = 1e-6  # the mean over bins up to e^20 has an absolute error of 1e-9 while the outer bins are still likely
ACTOR = 1e-5  # the same absolute error in advantages that are themselves small while the critic leaves zero
SHARE = {"critic": VALUES, "replay_critic": VALUES, "actor": ACTOR}
# Each update adds such an error to the way as to the deviation, and the deviation changes the next gradient: linear
# growth covers both.
STEPS_TO_DOUBLE = 100


def bound(tensor: Tensor, steps: int, dtype: str) -> float:
    """steps: since both were last the same. Samples must agree; precisions below float64 have no bound."""
    if dtype != "float64":
        return math.inf
    return 0.0 if tensor.group == "samples" else bound_of_part(tensor.part, steps)


def bound_of_part(part: str, steps: float) -> float:
    return SHARE.get(part, WORLD_MODEL) * (1 + steps / STEPS_TO_DOUBLE)
