"""Actions per second of a NumPy-only policy: `OPENBLAS_NUM_THREADS=1 python -m benchmarks.policy`.

Vectors of 24 numbers in, six real numbers out, random parameters, in one environment and in 16. Seconds are those of the processor that
the process took, so that other load on the machine counts little.
"""

import time

import numpy as np

from spec import Spaces, Vector, load_config
from train.machine import describe
from train.policy import Policy
from train.saved_agent import SavedAgent, acting_table
from train.translation import Entry, Translation

SPACES = Spaces({"observation": Vector(24)}, {"action": Vector(6)})
TASK = Translation(SPACES, {"observation": Entry((), (24,), "float32")}, {"action": Entry((), (6,), "float32", (-1.0,), (1.0,))})
REPEATS, SECONDS = 5, 1.0


def rate(size: str, rows: int) -> float:
    """The best of some repeats."""
    rng, config = np.random.default_rng(0), load_config("paper", size)
    parameters = {name: rng.normal(0, 0.05, entry.shape).astype(np.float32) for name, entry in acting_table(config, SPACES).items()}
    policy = Policy(SavedAgent(config, SPACES, parameters, {}, TASK))
    policy.reset(rows)
    observation, is_first = {"observation": rng.normal(size=(rows, 24))}, np.zeros(rows, bool)
    rates = []
    for _ in range(REPEATS):
        steps, start = 0, time.process_time()
        while time.process_time() - start < SECONDS:
            policy(observation, is_first)
            steps += 1
        rates.append(rows * steps / (time.process_time() - start))
    return max(rates)


def main() -> None:
    print(describe())
    for size in ("tiny", "1m", "12m"):
        print(f"| {size} | {rate(size, 1):,.0f} | {rate(size, 16):,.0f} |")


if __name__ == "__main__":
    main()
