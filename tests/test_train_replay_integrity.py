"""Damage and full disks: what is found, what is said, and what goes on."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from replay_machine import latents, record

from dreamer_spec.errors import UserError
from dreamer_spec.replay import Replay, chunks

CAPACITY, LENGTH, WORKERS, RECORDS = 1000, 3, 2, 41
SIZES = {"chunk_records": 8, "block_records": 4}


def filled(directory: Path, records: int = RECORDS) -> Replay:
    replay, rng = Replay(CAPACITY, LENGTH, directory, **SIZES), np.random.default_rng(0)
    for n in range(records):
        for worker in range(WORKERS):
            replay.add(record(rng, n), worker)
    return replay


def restored(directory: Path, description: dict, **settings) -> Replay:
    return Replay.restore(directory, description, CAPACITY, LENGTH, **settings)


def chunk_files(directory: Path) -> list[Path]:
    return sorted(directory.glob("chunk-*"))


def flip(path: Path, offset: int) -> None:
    data = bytearray(path.read_bytes())
    data[offset] ^= 16
    path.write_bytes(data)


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 1)


def spoil_header(path: Path) -> None:
    flip(path, 60)


def random_bytes(path: Path) -> None:
    path.write_bytes(b"\xff" * path.stat().st_size)


def section(path: Path, replay: Replay, index: int) -> int:
    """Where the last byte of row 5 of a section is."""
    assert replay.storage
    shape = replay.storage.store.shape
    return shape.offsets[index] + 6 * shape.layout.section_bytes[index] - 1 - 8 * (index == 0)


DAMAGES: dict[str, tuple[Callable[[Path, Replay], None], str]] = {
    "a bit of the small entries": (lambda path, replay: flip(path, section(path, replay, 0)), "checksum of records"),
    "a bit of the image": (lambda path, replay: flip(path, section(path, replay, 1)), "checksum of image"),
    "a bit of the latents": (lambda path, replay: flip(path, section(path, replay, 2) - 4), "checksum of latents"),
    "truncated": (lambda path, replay: truncate(path), "bytes, expected"),
    "empty": (lambda path, replay: os.truncate(path, 0), "has 0 bytes"),
    "missing": (lambda path, replay: path.unlink(), "is missing"),
    "header": (lambda path, replay: spoil_header(path), "damaged header"),
    "random bytes": (lambda path, replay: random_bytes(path), "damaged header"),
    "a directory": (lambda path, replay: (path.unlink(), path.mkdir()), "is not a file"),
}


@pytest.mark.covers("REP-31")
@pytest.mark.parametrize("continue_streams", [False, True])
@pytest.mark.parametrize("which", [0, 4, 11])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_named_and_left_out(tmp_path: Path, damage: str, which: int, continue_streams: bool) -> None:
    replay = filled(tmp_path / "replay")
    if which == 11 and damage.startswith("a bit"):
        pytest.skip("of the last chunk only row 0 is in use")
    description = replay.save("a")
    before = replay.state_dict()
    path = chunk_files(tmp_path / "replay")[which]
    spoil, message = DAMAGES[damage]
    spoil(path, replay)
    found = restored(tmp_path / "replay", description, continue_streams=continue_streams)
    assert message in found.warnings[0]
    assert str(path) in found.warnings[0]
    assert "are lost" in found.warnings[1]
    # Chunks alternate between the two workers; the damaged one held the positions hole .. hole + 7 of its stream.
    stream, hole = which % 2, which // 2 * 8
    expected = [(n, s) for n, s in before["items"].tolist() if n != stream or s + LENGTH < hole or s >= hole + 8]
    after = found.state_dict()
    assert [start for _, start in after["items"].tolist()] == [start for _, start in expected]
    rows = {(n, first + i): row + i for row, n, first, count in table(before) for i in range(count)}
    for row, number, first, count in table(after):
        own = stream if number > 1 else number
        for i in range(count):
            for key in ("x", "image", "deter", "stoch"):
                np.testing.assert_array_equal(
                    after[f"records/{key}"][row + i], before[f"records/{key}"][rows[own, first + i]]
                )
    # The run goes on, also right behind the hole.
    rng = np.random.default_rng(1)
    for n in range(30):
        for worker in range(WORKERS):
            found.add(record(rng, n), worker)
        ids = found.sample(rng.random(4))["ids"]
        found.write_back(ids, latents(rng, (4, LENGTH)))
    again = restored(tmp_path / "replay", found.save("b"))
    assert again.warnings == []
    assert len(again) == len(found)


def table(state) -> list[tuple[int, int, int, int]]:
    """(row of the first record, stream, first, count)"""
    row, rows = 0, []
    for number, first, count in state["streams"].tolist():
        rows.append((row, number, first, count))
        row += count
    return rows


@pytest.mark.covers("REP-31")
def test_all_chunks_may_be_lost(tmp_path: Path) -> None:
    description = filled(tmp_path).save("a")
    for path in chunk_files(tmp_path):
        path.unlink()
    found = restored(tmp_path, description, continue_streams=True)
    assert len(found) == 0
    assert len(found.warnings) == 13
    found.add(record(np.random.default_rng(0), 0), 0)
    assert found.next_stream == 3


@pytest.mark.covers("REP-30")
def test_an_older_state_replaces_a_damaged_one(tmp_path: Path) -> None:
    replay = filled(tmp_path)
    rng = np.random.default_rng(2)
    older, expected = replay.save("older"), replay.state_dict()
    for name in ("newer", "newest"):
        replay.write_back(replay.sample(rng.random(20))["ids"], latents(rng, (20, LENGTH)))
        replay.add(record(rng, 7), 0)
        newest = replay.save(name)
    flip(tmp_path / newest["file"], 2000)
    with pytest.raises(ValueError, match=newest["file"]):
        restored(tmp_path, newest)
    found = restored(tmp_path, older)
    state = found.state_dict()
    assert found.warnings == []
    assert all(np.array_equal(state[key], expected[key]) for key in expected)


def test_files_of_states_that_are_not_kept_go(tmp_path: Path) -> None:
    replay = Replay(20, LENGTH, tmp_path, **SIZES)
    rng = np.random.default_rng(0)
    for n in range(200):
        replay.add(record(rng, n), 0)
        replay.write_back(
            replay.sample(rng.random(2))["ids"] if len(replay) else np.zeros((0, 2)),
            latents(rng, (2 * (n > 2), LENGTH)),
        )
        if n % 10 == 0:
            replay.save(str(n))
            replay.keep([str(n - 10), str(n)])
    assert len(list(tmp_path.glob("saved-*"))) == len(list(tmp_path.glob("journal-*"))) == 2
    assert len(chunk_files(tmp_path)) <= (20 + LENGTH) // 8 + 2 + 20 // 8 + 1


@pytest.mark.parametrize(
    "description",
    [
        None,
        3,
        [],
        {},
        {"format": 1, "file": "x"},
        {"format": 1, "file": "../x", "crc32": 0},
        {"format": 2, "file": "x", "crc32": 0},
        {"format": 1, "file": "x", "crc32": "y"},
    ],
)
def test_what_is_no_description_is_refused(tmp_path: Path, description: object) -> None:
    with pytest.raises(ValueError, match="description"):
        Replay.restore(tmp_path, description, CAPACITY, LENGTH)  # type: ignore[arg-type]


def test_other_settings_are_refused(tmp_path: Path) -> None:
    description = filled(tmp_path).save("a")
    for settings, word in (({"deter_dtype": "float32"}, "deter_dtype"), ({"classes": 1000}, "classes")):
        with pytest.raises(ValueError, match=word):
            restored(tmp_path, description, **settings)
    with pytest.raises(ValueError, match="length"):
        Replay.restore(tmp_path, description, CAPACITY, LENGTH + 1)
    with pytest.raises(ValueError, match="erase"):
        Replay(CAPACITY, LENGTH, tmp_path)
    smaller = Replay.restore(tmp_path, description, 7, LENGTH)
    assert len(smaller) == 7


def test_a_damaged_journal_costs_only_what_it_covers(tmp_path: Path) -> None:
    replay, rng = filled(tmp_path), np.random.default_rng(0)
    description = replay.save("a")
    ids = replay.sample([0.5], online=False)["ids"]
    replay.write_back(ids, latents(rng, (1, LENGTH)))
    flip(next(tmp_path.glob("journal-*")), 25)
    found = restored(tmp_path, description)
    assert "journal" in found.warnings[0]
    assert "checksum of latents" in found.warnings[1]
    assert 0 < len(found) < len(replay)


@pytest.mark.covers("REP-32")
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_named_and_the_last_state_intact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    replay, rng = filled(tmp_path), np.random.default_rng(3)
    description, expected = replay.save("a"), replay.state_dict()

    def full(*args: object) -> None:
        raise OSError(number, os.strerror(number))

    def attempts() -> dict[str, Callable[[], object]]:
        ids = replay.sample([0.1, 0.9], online=False)["ids"]
        many = {key: np.stack([value] * 20) for key, value in record(rng, 5).items()}
        return {
            "posix_fallocate": lambda: replay.add_batch(many, [0] * 20),
            "pwrite": lambda: replay.write_back(ids, latents(rng, (2, LENGTH))),
            "fsync": lambda: replay.save("b"),
        }

    for name, attempt in attempts().items():
        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            with pytest.raises(UserError, match=f"{tmp_path} is full; the last checkpoint is intact"):
                attempt()
    assert len(list(tmp_path.glob("*.tmp"))) == 0
    items = len(replay)
    for _ in range(20):  # There is room again: the same buffer goes on.
        replay.add(record(rng, 5), 0)
    assert len(replay) == items + 20
    found = restored(tmp_path, description)
    assert found.warnings == []
    state = found.state_dict()
    assert all(np.array_equal(state[key], expected[key]) for key in expected)


def test_chunks_take_their_room_at_once(tmp_path: Path) -> None:
    replay = filled(tmp_path, 1)
    for path in chunk_files(tmp_path):
        assert replay.storage
        assert path.stat().st_blocks * 512 >= path.stat().st_size == replay.storage.store.shape.file_bytes


def test_without_the_system_call_zeros_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "posix_fallocate")
    with (tmp_path / "file").open("wb") as file:
        chunks.reserve(file.fileno(), 3_000_000)
    assert (tmp_path / "file").read_bytes() == bytes(3_000_000)


def test_a_copied_directory_restores_elsewhere(tmp_path: Path) -> None:
    replay = filled(tmp_path / "a")
    description = replay.save("a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert len(restored(tmp_path / "b", description)) == len(replay)
