"""Drawing ahead: in the order of the calls, whatever the threads do."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from replay_machine import assert_same, latents, record

from dreamer_spec.replay import Prefetcher, Replay

LENGTH, WORKERS, ROWS = 3, 2, 3


def uniform(step: int) -> np.ndarray:
    return np.random.default_rng([7, step]).random(ROWS)


def steps_of(n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(n)
    records = [record(rng, n) for _ in range(WORKERS)]
    return {key: np.stack([one[key] for one in records]) for key in records[0]}


def fresh(step: int) -> dict[str, np.ndarray]:
    return latents(np.random.default_rng([1, step]), (ROWS, LENGTH))


class InOrder:
    """What a prefetcher must be equal to: one step late, in one thread."""

    def __init__(self, replay: Replay) -> None:
        self.replay, self.step = replay, 0
        self.drawn: dict[str, Any] | None = None
        self.pending: tuple[Any, Any] | None = None

    def take(self) -> dict[str, Any]:
        batch = self.drawn or self.replay.sample(uniform(self.step))
        self.step += 1
        if self.pending:
            self.replay.write_back(*self.pending)
        self.drawn = self.replay.sample(uniform(self.step))
        return batch

    def write_back(self, ids: Any, fresh: Any) -> None:
        self.pending = ids, fresh

    def add_batch(self, steps: Any) -> None:
        self.replay.add_batch(steps)


class Slow:
    """Latents that are still being computed: whoever looks waits."""

    def __init__(self, value: np.ndarray, ready: threading.Event) -> None:
        self.value, self.ready = value, ready

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        self.ready.wait(10)
        return self.value

    def __float__(self) -> float:
        return float(np.asarray(self))


def history(buffer: Any, begin: int, end: int) -> list[dict[str, np.ndarray]]:
    batches = []
    for n in range(begin, end):
        buffer.add_batch(steps_of(n))
        if n >= LENGTH:
            for _ in range(n % 3):
                batch = buffer.take()
                batches.append({key: np.array(array) for key, array in batch.items()})
                buffer.write_back(batch["ids"], fresh(buffer.step))
    return batches


@pytest.mark.covers("REP-33")
def test_batches_follow_from_the_order_of_the_calls() -> None:
    expected = history(InOrder(Replay(20, LENGTH)), 0, 40)
    for _ in range(3):
        buffer = Prefetcher(Replay(20, LENGTH), uniform)
        for actual, wanted in zip(history(buffer, 0, 40), expected, strict=True):
            assert_same(actual, wanted)
        buffer.close()


@pytest.mark.covers("REP-33", "LOOP-17")
def test_latents_are_written_back_before_the_draw_after_next() -> None:
    buffer = Prefetcher(Replay(50, LENGTH), uniform)
    for n in range(10):
        buffer.add_batch(steps_of(n))
    ready, events = threading.Event(), []
    sample, write_back = buffer.replay.sample, buffer.replay.write_back
    buffer.replay.sample = lambda *args: (events.append("draw"), sample(*args))[1]  # type: ignore[method-assign]
    replay: Any = buffer.replay
    replay.write_back = lambda *args: (events.append("write"), write_back(*args))[1]
    first = buffer.take()
    buffer.write_back(first["ids"], {key: Slow(value, ready) for key, value in fresh(0).items()})
    second = buffer.take()  # Drawn already: it does not wait for the latents of the first.
    assert events == ["draw", "draw"]
    ready.set()
    buffer.write_back(second["ids"], fresh(1))
    buffer.take()
    buffer.close()
    assert events == ["draw", "draw", "write", "draw", "write", "draw"]


@pytest.mark.covers("LOOP-43")
def test_the_latents_of_a_skipped_train_step_are_not_written_back() -> None:
    """The thread waits for the word, not the caller; the next step's latents are written again."""
    buffer = Prefetcher(Replay(50, LENGTH), uniform)
    for n in range(10):
        buffer.add_batch(steps_of(n))
    before, ready = buffer.replay.state_dict(), threading.Event()
    spoiled = {key: np.full_like(value, np.nan if key == "deter" else 0) for key, value in fresh(0).items()}
    buffer.write_back(buffer.take()["ids"], spoiled, skipped=Slow(np.array(1.0), ready))
    batch = buffer.take()
    ready.set()
    buffer.write_back(batch["ids"], fresh(1), skipped=np.array(0.0))
    buffer.close()
    expected = Replay(50, LENGTH)
    expected.load_state_dict(before)
    expected.write_back(batch["ids"], fresh(1))
    assert_same(buffer.replay.state_dict(), expected.state_dict())
    assert not np.array_equal(before["records/deter"], buffer.replay.state_dict()["records/deter"])


@pytest.mark.covers("REP-29", "REP-33")
def test_a_restored_run_takes_the_same_batches(tmp_path: Path) -> None:
    whole = Prefetcher(Replay(20, LENGTH), uniform)
    expected = history(whole, 0, 40)
    whole.close()
    first = Prefetcher(Replay(20, LENGTH, tmp_path, chunk_records=8, block_records=4), uniform)
    taken = history(first, 0, 21)
    description, drawn = first.save("a")
    history(first, 21, 30)
    first.close()
    second = Prefetcher(
        Replay.restore(tmp_path, description, 20, LENGTH, continue_streams=True), uniform, step=len(taken)
    )
    second.load_drawn(drawn)
    taken += history(second, 21, 40)
    second.close()
    for actual, wanted in zip(taken, expected, strict=True):
        assert_same(actual, wanted)


def test_errors_of_the_thread_surface(tmp_path: Path) -> None:
    buffer = Prefetcher(Replay(20, LENGTH), lambda step: uniform(step) if step < 2 else np.array([2.0]))
    with pytest.raises(ValueError, match="nothing to sample"):
        buffer.take()
    buffer = Prefetcher(buffer.replay, lambda step: uniform(step) if step < 2 else np.array([2.0]))
    for n in range(10):
        buffer.add_batch(steps_of(n))
    batch = buffer.take()
    buffer.write_back(batch["ids"], {"deter": np.zeros((1, 1, 3)), "stoch": np.zeros((1, 1, 2), int)})
    with pytest.raises(ValueError, match="latents"):
        buffer.write_back(batch["ids"], fresh(0))
    buffer.take()
    with pytest.raises(ValueError, match="uniform"):
        buffer.add_batch(steps_of(10))
    with pytest.raises(ValueError, match="uniform"):
        buffer.take()
    buffer.write_back(batch["ids"], {"deter": np.zeros((1, 1, 3)), "stoch": np.zeros((1, 1, 2), int)})
    with pytest.raises(ValueError, match="latents"):
        buffer.close()
