"""Folders that are written whole or not at all: checkpoints, policies and incidents all are."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dreamer_spec.disk.folders import open_sealed, require_intact, write_folder
from dreamer_spec.errors import UserError

NAMES = ("x.safetensors", "x.json")


def write(path: Path, number: int) -> None:
    write_folder(path, {NAMES[0]: {"a": np.arange(6).reshape(2, 3).T * number}, NAMES[1]: {"n": number}}, "thing")


def read(path: Path) -> tuple[Any, Any]:
    sealed = open_sealed(path, NAMES)
    require_intact(sealed, NAMES)
    return sealed.arrays(NAMES[0])["a"].tolist(), sealed.json(NAMES[1])


def fail(*_: Any) -> None:
    raise OSError("disk full")


def test_what_is_written_is_read_and_nothing_else_stays(tmp_path: Path) -> None:
    for number in (1, 2):
        write(tmp_path / "deep" / "thing", number)
        assert read(tmp_path / "deep" / "thing") == (
            [[0, 3 * number], [number, 4 * number], [2 * number, 5 * number]],
            {"n": number},
        )
        assert [path.name for path in (tmp_path / "deep").iterdir()] == ["thing"]


def test_what_others_have_put_there_moves_over(tmp_path: Path) -> None:
    write(tmp_path / "thing", 1)
    (tmp_path / "thing" / "notes.txt").write_text("mine")
    write(tmp_path / "thing", 2)
    assert read(tmp_path / "thing")[1] == {"n": 2}
    assert (tmp_path / "thing" / "notes.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


@pytest.mark.parametrize("what", ["seal", "save_file"])
def test_a_disk_that_refuses_leaves_the_older_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    write(tmp_path / "thing", 1)
    monkeypatch.setattr(f"dreamer_spec.disk.folders.{what}", fail)
    with pytest.raises(UserError, match=f"cannot write the thing {tmp_path}/thing: disk full"):
        write(tmp_path / "thing", 2)
    assert read(tmp_path / "thing")[1] == {"n": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


@pytest.mark.parametrize("what", ["file", "link", "folder of others"])
def test_something_else_stays_as_it_is(tmp_path: Path, what: str) -> None:
    path, other = tmp_path / "thing", tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").touch()
    path.touch() if what == "file" else path.symlink_to(other) if what == "link" else other.rename(path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match="thing is no thing, and one must be written there: move it away"):
        write(path, 1)
    assert sorted(tmp_path.rglob("*")) == before
