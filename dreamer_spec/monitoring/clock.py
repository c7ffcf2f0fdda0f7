"""Where the time of a run goes."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PARTS = ("policy", "environments", "replay", "train", "log", "evaluation", "checkpoint")


class Clock:
    """Splits the wall time of the loop into parts, and measures for how much of it the learner computes train steps.

    A backend may return from a train step before it is computed. So the learner's time is counted from the call, or
    from the end of the step before if that comes later, to the moment when the latents are there.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()  # `computed` is called in the thread of the replay buffer
        self._computed_at = 0.0
        self._part = "other"
        self._restart()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """What runs inside is counted for this part, and for no part around it."""
        outer, self._part = self._part, name
        self._turn(outer)
        try:
            yield
        finally:
            self._turn(name)
            self._part = outer

    def computed(self, since: float) -> None:
        """A train step that was called at `since` (time.perf_counter) has been computed."""
        with self._lock:
            now = time.perf_counter()
            self._computing += now - max(since, self._computed_at, self._start)
            self._computed_at = now

    def take(self) -> dict[str, float]:
        """Fractions of the wall time since the last call: `time/...` by part, which add up to 1, and
        `speed/learner_share`."""
        self._turn(self._part)
        total = max(self._turned - self._start, 1e-9)
        shares = {f"time/{name}": seconds / total for name, seconds in self._seconds.items()}
        with self._lock:
            shares["speed/learner_share"] = min(self._computing / total, 1.0)
            self._restart()
        return shares

    def _restart(self) -> None:
        self._seconds = dict.fromkeys((*PARTS, "other"), 0.0)
        self._computing = 0.0
        self._start = self._turned = time.perf_counter()

    def _turn(self, part: str) -> None:
        now = time.perf_counter()
        self._seconds[part] += now - self._turned
        self._turned = now
