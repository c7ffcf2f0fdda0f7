"""What is too large for the machine: spaces, models, arrays, and the files of the buffer."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from train_fakes import FakeLearner
from train_runs import Make

from dreamer_spec.cli import main
from dreamer_spec.errors import UserError
from dreamer_spec.replay import Replay
from dreamer_spec.training import forecast, loop


@pytest.mark.parametrize("task", ["Enormous", "EnormousActions"])
def test_spaces_that_no_machine_holds_are_refused(make: Make, task: str) -> None:
    with pytest.raises(UserError, match=r"becomes [0-9,]{13,} numbers; expected at most 1,048,576"):
        loop.run(make(task=f"train_fakes:{task}"), FakeLearner)


def test_a_model_that_the_machine_cannot_hold_is_refused(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecast, "machine_memory", lambda: 10_000)
    with pytest.raises(
        UserError, match=r"parameters and their optimizer take .*, and this machine gives 9\.77 KiB: .* smaller --size"
    ):
        loop.run(make(), FakeLearner)


@pytest.mark.parametrize(
    "error", [MemoryError("Unable to allocate 8.00 EiB"), RuntimeError("RESOURCE_EXHAUSTED: Out of memory")]
)
def test_too_little_memory_is_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    def fail(*_: Any) -> bool:
        raise error

    monkeypatch.setattr(loop, "run", fail)
    assert main(["--backend", "torch"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"train: error: there is not enough memory: {error}; use a smaller --size")


def test_the_last_checkpoint_is_intact_only_where_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    record = {key: np.zeros((1, *shape), kind) for key, (shape, kind) in RECORD.items()}
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(UserError, match=f"{tmp_path} is full; there is no checkpoint yet"):
        Replay(10, 2, tmp_path).add_batch(record)


RECORD: dict[str, tuple[tuple[int, ...], Any]] = {
    **dict.fromkeys(("is_first", "is_last", "is_terminal"), ((), np.bool_)),
    **dict.fromkeys(("x", "action", "deter"), ((2,), np.float32)),
    **{"reward": ((), np.float32), "stoch": ((2,), np.int32)},
}
