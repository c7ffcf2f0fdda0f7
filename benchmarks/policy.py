"""Actions per second of a NumPy-only policy: `OPENBLAS_NUM_THREADS=1 python -m benchmarks.policy`.

Vectors of 24 numbers or one RGB image in, six real numbers out, random parameters, in one environment and in 16.
Seconds are those of the processor that the process took, so that other load on the machine counts little.
"""

import time

import numpy as np

from dreamer_spec.disk.saved_agent import SavedAgent, acting_table
from dreamer_spec.policy import Policy
from dreamer_spec.system.machine import describe
from dreamer_spec.translation import Entry, Translation
from spec import Image, Spaces, Vector, load_config

OBSERVATIONS = {"vector": Vector(24), "image of 32 x 32": Image(32, 32, 3), "image of 64 x 64": Image(64, 64, 3)}
REPEATS, SECONDS = 5, 0.5


def rate(size: str, observed: str, rows: int) -> float:
    """The best of some repeats."""
    space = OBSERVATIONS[observed]
    spaces = Spaces({"observation": space}, {"action": Vector(6)})
    rng, config = np.random.default_rng(0), load_config("paper", size)
    parameters = {
        name: rng.normal(0, 0.05, entry.shape).astype(np.float32)
        for name, entry in acting_table(config, spaces).items()
    }
    policy = Policy(SavedAgent(config, spaces, parameters, {}, _translation(spaces)))
    policy.reset(rows)
    shape, is_first = (rows, *space.array_shape), np.zeros(rows, bool)
    value = rng.integers(0, 256, shape).astype(np.uint8) if isinstance(space, Image) else rng.normal(size=shape)
    rates = []
    for _ in range(REPEATS):
        steps, start = 0, time.process_time()
        while time.process_time() - start < SECONDS:
            policy({"observation": value}, is_first)
            steps += 1
        rates.append(rows * steps / (time.process_time() - start))
    return max(rates)


def _translation(spaces: Spaces) -> Translation:
    (observed,) = spaces.observations.values()
    entry = (
        Entry((), observed.array_shape, "uint8", (0.0,), (255.0,))
        if isinstance(observed, Image)
        else Entry((), (24,), "float32")
    )
    return Translation(spaces, {"observation": entry}, {"action": Entry((), (6,), "float32", (-1.0,), (1.0,))})


def main() -> None:
    print(describe())
    for size in ("tiny", "1m", "12m"):
        for observed in OBSERVATIONS:
            print(
                f"| {size} | {observed} | {rate(size, observed, 1):,.0f} | {rate(size, observed, 16):,.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
