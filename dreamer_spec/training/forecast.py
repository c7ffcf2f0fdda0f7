"""What a run will need, said before it does: memory and disk before training, time after the first train steps."""

import math
import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.logger import duration
from dreamer_spec.options import Options
from dreamer_spec.replay.layout import TYPES, RecordLayout
from dreamer_spec.system import cgroups
from dreamer_spec.system.machine import physical_memory
from dreamer_spec.training.state import TrainingRun
from spec import Discrete, Image, Spaces

COPIES = 5  # of all parameters, in float32: themselves, the gradient, two moments, and what an update computes
MEASURED, LONG_ENOUGH = 10, 10.0  # train steps, and seconds, after which a rate can be believed
DAY = 86_400.0


def say_memory(options: Options, spaces: Spaces, parameters: int, say: Callable[[str], None]) -> None:
    """Before anything is allocated: the sizes, and a warning where the machine has less.

    Raises:
      UserError: the parameters and their optimizer alone take more memory than there is.
    """
    state, record = 4 * COPIES * parameters, record_bytes(spaces, options)
    records = min(options.config.replay_capacity, math.ceil(options.steps / options.action_repeat))
    disk, mapped = records * record, min(records * record, int(options.replay_memory * 2**30))
    say(
        f"needs {size(state)} for {parameters:,} parameters and their optimizer, {size(disk)} on the disk for "
        f"{records:,} records in the "
        f"replay buffer, {size(mapped)} of which in memory at most, and memory for a batch's intermediate arrays"
    )
    memory = machine_memory()
    if memory is not None and state > memory:
        sizes = {key: space.encoded_size for key, space in (*spaces.vectors.items(), *spaces.actions.items())}
        largest = f", or describe {max(sizes, key=lambda key: sizes[key])!r} by fewer numbers" if sizes else ""
        raise UserError(
            f"{parameters:,} parameters and their optimizer take {size(state)}, and this machine gives "
            f"{size(memory)}: choose a smaller "
            f"--size{largest}"
        )
    if memory is not None and state + mapped > memory:
        say(
            f"WARNING: that is more than the {size(memory)} of memory that this machine gives; choose a "
            f"smaller --size or --replay-memory"
        )
    there = sum(file.stat().st_size for file in (options.logdir / "replay").glob("chunk-*"))
    place = options.logdir.absolute()  # It need not be there yet.
    free = shutil.disk_usage(next(folder for folder in (place, *place.parents) if folder.exists())).free
    if disk > there + free:
        say(f"WARNING: {options.logdir} has {size(free)} left; choose another --logdir or a smaller --replay-capacity")


def record_bytes(spaces: Spaces, options: Options) -> int:
    """Of one stored record."""
    config = options.config
    shapes = {"action": (spaces.action_size,), "deter": (config.deter,), "stoch": (config.stoch,)}
    entries: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
        **{key: (np.dtype(_dtype(space)), space.array_shape) for key, space in spaces.observations.items()},
        **{name: (np.dtype(kind), shapes.get(name, ())) for name, kind in TYPES.items()},
    }
    return RecordLayout(entries, options.replay_deter, config.classes).record_bytes


def _dtype(space: Any) -> type[np.generic]:
    return np.uint8 if isinstance(space, Image) else np.int64 if isinstance(space, Discrete) else np.float32


def machine_memory() -> int | None:
    """Bytes that this machine, or the container, gives; None where the system does not say."""
    memory = physical_memory()
    return None if memory is None else min([memory, *cgroups.memory_limits()])


def size(count: float) -> str:
    """1.5e9 -> 1.4 GiB."""
    for unit in ("bytes", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.3g} {unit}"
        count /= 1024
    return f"{count:,.3g} GiB"


class TimeForecast:
    """Says once how long the run will take, as soon as some train steps have shown it. The first, which may be
    compiled, does not count.

    now: a clock in seconds.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._begin: tuple[float, int, int, int] | None = None
        self._said = False

    def attend(self, run: TrainingRun) -> None:
        """To be called after every step of the environments, and after the evaluation that may follow it."""
        done = run.counters
        if self._said or not run.warm or done.due:
            return
        if self._begin is None or self._begin[3] != done.evaluations:
            self._begin = self._now(), done.records, done.train_steps, done.evaluations
            return
        since, records, train_steps, _ = self._begin
        seconds = self._now() - since
        if done.train_steps - train_steps < MEASURED or seconds < LONG_ENOUGH:
            return
        self._said = True
        rate = (done.records - records) * run.options.action_repeat / seconds
        for line in lines(run.options.steps, run.options.steps - run.step, rate):
            run.display.say(line)


def lines(steps: int, left: int, rate: float) -> Iterator[str]:
    """The forecast for a run of `steps`, of which some are left. rate: environment steps per second."""
    seconds = left / rate
    yield (
        f"at {rate:,.3g} steps/s the {left:,} steps that are left of {steps:,} take "
        f"{duration(seconds)}, without evaluations"
    )
    if seconds > DAY:
        yield (
            f"WARNING: that is {seconds / DAY:,.1f} days; --preset laptop, or a smaller --size, "
            f"--replay-ratio, --batch-length or --steps, "
            "takes less"
        )
