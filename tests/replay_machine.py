"""A state machine that compares the buffer of a run with the naive one, through crashes at any moment."""

import copy
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import hypothesis.strategies as st
import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from dreamer_spec.replay import Replay
from reference_numpy.replay import Replay as Naive

WORKERS = 3
SEEDS = st.integers(0, 2**32 - 1)


class Killed(BaseException):
    """The process dies here: nothing in the buffer may catch it."""


def record(rng: np.random.Generator, number: int) -> dict[str, np.ndarray]:
    """A record whose numbers bfloat16 holds exactly."""
    return {
        "x": np.array([number, rng.random()], np.float32),
        "image": rng.integers(0, 256, (16, 16, 3), np.uint8),
        "mode": np.array(number % 5, np.int64),
        "reward": np.array(rng.random(), np.float32),
        **{flag: np.array(rng.random() < 0.2) for flag in ("is_first", "is_last", "is_terminal")},
        "action": rng.random(2, np.float32),
        **latents(rng, ()),
    }


def latents(rng: np.random.Generator, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    deter = rng.integers(-128, 128, (*shape, 3)).astype(np.float32) / 128
    return {"deter": deter, "stoch": rng.integers(0, 32, (*shape, 2)).astype(np.int32)}


def assert_same(actual: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert actual.keys() == expected.keys()
    for key, value in expected.items():
        assert actual[key].dtype == value.dtype, key
        np.testing.assert_array_equal(actual[key], value, err_msg=key)


@contextmanager
def death(at: int) -> Iterator[None]:
    """Kills at the `at`-th thing done to the disk; a write is killed half done."""
    left = at

    def dying(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **keywords: Any) -> Any:
            nonlocal left
            left -= 1
            if left == 0:
                if real is pwrite:
                    pwrite(args[0], bytes(args[1])[: len(args[1]) // 2], args[2])
                raise Killed
            return real(*args, **keywords)

        return call

    pwrite = os.pwrite
    with (
        mock.patch("os.pwrite", dying(os.pwrite)),
        mock.patch("os.fsync", dying(os.fsync)),
        mock.patch("os.posix_fallocate", dying(os.posix_fallocate)),
        mock.patch("pathlib.Path.unlink", dying(Path.unlink)),
        mock.patch("pathlib.Path.rename", dying(Path.rename)),
        mock.patch("os.replace", dying(os.replace)),
    ):
        yield


class ReplayMachine(RuleBasedStateMachine):
    """`naive` is what `replay` must be. `saves`: (name, description, what the naive one was), oldest first."""

    def __init__(self) -> None:
        super().__init__()
        memory = Path("/dev/shm")  # Where it is, a flush costs nothing.
        self.root = Path(tempfile.mkdtemp(prefix="replay-machine-", dir=memory if memory.is_dir() else None))

    def teardown(self) -> None:
        shutil.rmtree(self.root)

    @initialize(
        capacity=st.sampled_from([1, 3, 7, 25]),
        length=st.integers(1, 4),
        block=st.sampled_from([1, 2, 4]),
        blocks=st.integers(1, 3),
        memory_limit=st.sampled_from([0, 2**14, 2**30]),
    )
    def begin(self, capacity: int, length: int, block: int, blocks: int, memory_limit: int) -> None:
        self.capacity, self.length = capacity, length
        self.settings = {"memory_limit": memory_limit}
        self.sizes = {"chunk_records": block * blocks, "block_records": block}
        self.directories = self.count = 0
        self.saves: list[tuple[str, dict[str, Any], Naive]] = []
        self.drawn: list[np.ndarray] = [np.zeros((1, 2), np.int64)]
        self.naive = Naive(capacity, length)
        self.replay = Replay(capacity, length, self.new_directory(), **self.settings, **self.sizes)

    def new_directory(self) -> Path:
        self.directories += 1
        return self.root / str(self.directories)

    @rule(seed=SEEDS, worker=st.integers(0, WORKERS - 1), number=st.integers(1, 12))
    def add(self, seed: int, worker: int, number: int) -> None:
        rng = np.random.default_rng(seed)
        for _ in range(number):
            step = record(rng, self.count)
            self.count += 1
            self.replay.add(step, worker)
            self.naive.add(step, worker)

    @rule(seed=SEEDS, rounds=st.integers(1, 4))
    def add_batch(self, seed: int, rounds: int) -> None:
        rng = np.random.default_rng(seed)
        for _ in range(rounds):
            steps = [record(rng, self.count + worker) for worker in range(WORKERS)]
            self.count += WORKERS
            self.replay.add_batch({key: np.stack([step[key] for step in steps]) for key in steps[0]})
            for worker, step in enumerate(steps):
                self.naive.add(step, worker)

    @precondition(lambda self: len(self.naive))
    @rule(seed=SEEDS, rows=st.integers(1, 4), online=st.booleans())
    def sample(self, seed: int, rows: int, online: bool) -> None:
        uniform = np.random.default_rng(seed).random(rows)
        batch = self.replay.sample(uniform, online)
        assert_same(batch, self.naive.sample(uniform, online))
        self.drawn.append(batch["ids"])

    @precondition(lambda self: len(self.naive))
    @rule(seed=SEEDS, rows=st.integers(1, 6))
    def train(self, seed: int, rows: int) -> None:
        self.sample(seed, rows, True)
        self.write_back(seed, 0)

    @rule(seed=SEEDS, which=st.integers(0, 3))
    def write_back(self, seed: int, which: int) -> None:
        ids = self.drawn[max(0, len(self.drawn) - 1 - which)]
        fresh = latents(np.random.default_rng(seed), (len(ids), self.length))
        self.replay.write_back(ids, fresh)
        self.naive.write_back(ids, fresh)

    @rule()
    def compare_everything(self) -> None:
        actual, expected = self.replay.state_dict(), self.naive.state_dict()
        if not len(
            self.naive
        ):  # Without an item there are no records either, and only the reference knows their form by then.
            actual, expected = (
                {key: value for key, value in state.items() if "/" not in key} for state in (actual, expected)
            )
        assert_same(actual, expected)

    @rule(kept=st.sampled_from([3, 2, 1]))
    def save(self, kept: int) -> None:
        name = f"step {self.count}"
        description = self.replay.save(name)
        self.saves = [save for save in self.saves if save[0] != name]
        self.saves.append((name, description, copy.deepcopy(self.naive)))
        self.saves = self.saves[-kept:]
        self.replay.keep([name for name, _, _ in self.saves])

    @rule()
    def load(self) -> None:
        """A new buffer of the state of this one; saves belong to the directory and stay behind."""
        state = self.replay.state_dict()
        self.replay = Replay(self.capacity, self.length, self.new_directory(), **self.settings, **self.sizes)
        self.replay.load_state_dict(state)
        self.naive.load_state_dict(self.naive.state_dict())
        self.saves = []

    @precondition(lambda self: self.saves)
    @rule()
    def load_own_state(self) -> None:
        """The same into the buffer itself: its saves stay restorable."""
        self.replay.load_state_dict(self.replay.state_dict())
        self.naive.load_state_dict(self.naive.state_dict())

    @rule(
        lives=st.lists(st.sampled_from(["train", "save", "add"]), max_size=6),
        which=st.integers(0, 2),
        continue_streams=st.booleans(),
        during=st.sampled_from(["nothing", "add", "write_back", "save", "keep", "restore"]),
        at=st.integers(1, 12),
        seed=SEEDS,
        copied=st.booleans(),
        again=st.booleans(),
        saved_again=st.booleans(),
    )
    def crash(
        self,
        lives: list[str],
        which: int,
        continue_streams: bool,
        during: str,
        at: int,
        seed: int,
        copied: bool,
        again: bool,
        saved_again: bool,
    ) -> None:
        """After some more life the process dies while it does something; one of the saves is restored: the last, if it
        is not damaged."""
        for number, what in enumerate(["save", *lives] if not self.saves else lives):
            if what == "save":
                self.save(3)
            else:
                self.add_batch(seed + number, 3 if what == "add" else 1)
                if what == "train" and len(self.naive):
                    self.train(seed + number, 3)
        which, newest = min(which, len(self.saves) - 1), self.saves[-1][0]
        self.saves = self.saves[: len(self.saves) - which]
        _, description, naive = self.saves[-1]
        directory = self.replay.directory
        with suppress(Killed), death(at):
            self.die(during, seed, description, continue_streams)
        if copied:
            directory = Path(shutil.copytree(directory, self.new_directory()))
        for _ in range(1 + again):
            self.replay = self.restored(directory, description, continue_streams)
        assert self.replay.warnings == []
        self.naive = copy.deepcopy(naive)
        if not continue_streams:
            self.naive.load_state_dict(self.naive.state_dict())
        self.compare_everything()
        if len(self.naive):
            self.sample(seed, 5, True)
        if which and saved_again:  # As in a run, which makes the same steps again, and saves of the same names.
            self.saves.append((newest, self.replay.save(newest), copy.deepcopy(self.naive)))
            self.replay.keep([name for name, _, _ in self.saves])

    def die(self, during: str, seed: int, description: dict[str, Any], continue_streams: bool) -> None:
        rng = np.random.default_rng(seed)
        if during == "add":
            for worker in range(WORKERS):
                for number in range(5):
                    self.replay.add(record(rng, number), worker)
        elif during == "write_back":
            for ids in self.drawn[-3:]:
                self.replay.write_back(ids, latents(rng, (len(ids), self.length)))
        elif during == "save":
            self.replay.write_back(self.drawn[-1], latents(rng, (len(self.drawn[-1]), self.length)))
            self.replay.save("killed")
            self.replay.write_back(self.drawn[-1], latents(rng, (len(self.drawn[-1]), self.length)))
        elif during == "keep":
            self.replay.keep([name for name, _, _ in self.saves])
        elif during == "restore":
            self.restored(self.replay.directory, description, continue_streams)

    def restored(self, directory: Path, description: dict[str, Any], continue_streams: bool) -> Replay:
        return Replay.restore(
            directory, description, self.capacity, self.length, continue_streams=continue_streams, **self.settings
        )

    @invariant()
    def same_length(self) -> None:
        if hasattr(self, "naive"):
            assert len(self.replay) == len(self.naive)


def run_machine(examples: int, steps: int = 40, shrink: bool = True) -> None:
    """Runs the machine on histories that are the same every time.

    shrink: whether to look for a shorter history that fails too.

    Raises:
      whatever shows that the buffer is wrong.
    """
    quiet = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    run_state_machine_as_test(
        ReplayMachine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            database=None,
            phases=(Phase.generate, Phase.shrink) if shrink else (Phase.generate,),
            derandomize=True,
            report_multiple_bugs=False,
            suppress_health_check=quiet,
        ),
    )
