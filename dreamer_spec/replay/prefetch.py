"""Draws the batch of the next train step while this one is being computed."""

import concurrent.futures
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.replay.batches import Batch, empty_batch, require_same_form
from dreamer_spec.replay.buffer import Replay
from dreamer_spec.replay.layout import Packed

_SAVED = "drawn/"


class Prefetcher:
    """A buffer whose batches are drawn one train step ahead, in a thread. Implements [REP-33].

    The thread does one thing after another: the draw for step k + 1 when `take` gives out the batch of step k, then the
    write-back of step k, then the draw for step k + 2. What the caller adds waits for the draw that was asked for
    before. So what a batch holds depends on the order of the calls alone, never on time, and latents are one train step
    late at most: [LOOP-17].

    Args:
      replay: to be used through this object only.
      uniform: train step -> the numbers [B] in [0, 1) that draw its batch; the same for every call.
      step: of the first batch.
    """

    def __init__(self, replay: Replay, uniform: Callable[[int], Any], step: int = 0) -> None:
        self.replay, self.step = replay, step
        self._uniform = uniform
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "replay")
        self._drawn: concurrent.futures.Future[Batch] | None = None
        self._written: concurrent.futures.Future[None] | None = None

    def __len__(self) -> int:
        """The number of items."""
        return len(self.replay)

    def take(self) -> Batch:
        """The batch of train step `step`, the caller's own; the next one is drawn from here on.

        Raises:
          whatever a draw or a write-back in the thread has raised.
        """
        if self._written is not None and self._written.done():
            self._settle_write_back()
        if self._drawn is None:
            self._drawn = self._draw(self.step)
        batch = self._drawn.result()
        self.step += 1
        self._drawn = self._draw(self.step)
        return batch

    def write_back(
        self, ids: Any, latents: Mapping[str, Any], computed: Callable[[], None] = lambda: None, skipped: Any = 0.0
    ) -> None:
        """Hands over the latents of the train step whose batch was taken last. Does not wait for them: they may still
        be computed.

        computed: called in the thread when they are there. skipped: the metric of that train step, which may still be
        computed too. Where it is 1 the buffer stays as it is: [LOOP-43].

        Raises:
          whatever the write-back before has raised.
        """
        self._settle_write_back()
        self._written = self._thread.submit(self._write_back, ids, dict(latents), computed, skipped)

    def pack(self, steps: Mapping[str, Any]) -> Packed:
        """See Replay.pack."""
        return self.replay.pack(steps)

    def add_packed(self, packed: Packed, row: int, worker: int) -> None:
        """See Replay.add_packed. Waits for the draw that was asked for before."""
        self._settle_draw()
        self.replay.add_packed(packed, row, worker)

    def add(self, step: Mapping[str, Any], worker: int) -> None:
        """See Replay.add. Waits for the draw that was asked for before."""
        self._settle_draw()
        self.replay.add(step, worker)

    def add_batch(self, steps: Mapping[str, Any], workers: Iterable[int] | None = None) -> None:
        """See Replay.add_batch. Waits for the draw that was asked for before."""
        self._settle_draw()
        self.replay.add_batch(steps, workers)

    def save(self, name: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """The description of the saved buffer, and the batch that is drawn already; both belong into a checkpoint."""
        self._settle_write_back()
        self._settle_draw()
        drawn = (
            {}
            if self._drawn is None
            else {f"{_SAVED}{key}": np.array(array) for key, array in self._drawn.result().items()}
        )
        return self.replay.save(name), drawn

    def load_drawn(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Takes up the batch that was drawn when a checkpoint was made: to be called before anything else. [REP-38]

        Raises:
          ValueError: it is not of the form of a batch of this buffer.
        """
        batch = {key.removeprefix(_SAVED): np.array(array) for key, array in arrays.items() if key.startswith(_SAVED)}
        if batch:
            storage = self.replay.storage
            if storage is None:
                raise ValueError("a batch was drawn ahead of a buffer that holds nothing")
            require_same_form(batch, empty_batch(storage.layout, len(self._uniform(self.step)), self.replay.length))
            storage.layout.require_indices("stoch of the batch drawn ahead", batch["stoch"])
            self._drawn = concurrent.futures.Future()
            self._drawn.set_result(batch)

    def close(self) -> None:
        """Waits for the thread.

        Raises:
          whatever the last write-back has raised. A batch that nobody took does not matter.
        """
        self._thread.shutdown(wait=True)
        self._settle_write_back()

    def _draw(self, step: int) -> "concurrent.futures.Future[Batch]":
        return self._thread.submit(lambda: self.replay.sample(self._uniform(step)))

    def _write_back(self, ids: Any, latents: Mapping[str, Any], computed: Callable[[], None], skipped: Any) -> None:
        arrays = {name: np.asarray(value) for name, value in latents.items()}
        computed()
        if not float(skipped):
            self.replay.write_back(ids, arrays)

    def _settle_draw(self) -> None:
        if self._drawn is not None:
            self._drawn.result()

    def _settle_write_back(self) -> None:
        written, self._written = self._written, None
        if written is not None:
            written.result()
