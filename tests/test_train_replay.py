"""The buffer of a run: what the checks of the chapter do not see."""

import gc
import os
from pathlib import Path

import numpy as np
import pytest
from replay_machine import assert_same, latents, record

from dreamer_spec.replay import Replay, erase
from dreamer_spec.replay.chunks import Shape
from dreamer_spec.replay.layout import RecordLayout, from_bfloat16, layout_of, to_bfloat16
from spec import load_config, sizes

LENGTH = 3


def filled(
    directory: Path | None = None, records: int = 30, workers: int = 1, capacity: int = 1000, **settings
) -> Replay:
    replay, rng = Replay(capacity, LENGTH, directory, **settings), np.random.default_rng(0)
    for n in range(records):
        for worker in range(workers):
            replay.add(record(rng, n), worker)
    return replay


@pytest.mark.covers("REP-19")
def test_bfloat16_is_the_nearest_one() -> None:
    exact = np.array([0.0, -0.0, 1.0, -1.5, np.inf, -np.inf, 2.0**-126, 3.0e38], np.float32)
    exact = from_bfloat16((exact.view(np.uint32) >> 16).astype(np.uint16))
    np.testing.assert_array_equal(from_bfloat16(to_bfloat16(exact)), exact)
    step = np.float32(2.0**-7)
    ties = np.array([1 + step / 2, 1 + 3 * step / 2, 1 + step / 2 + 2.0**-20, 1 + step / 2 - 2.0**-20], np.float32)
    np.testing.assert_array_equal(
        from_bfloat16(to_bfloat16(ties)), np.array([1, 1 + 2 * step, 1 + step, 1], np.float32)
    )
    bits = np.array([0x7FC00000, 0xFFC00000, 0x7F800001, 0x7FFFFFFF, 0xFFFFFFFF, 0x3F800000], np.uint32)
    np.testing.assert_array_equal(np.isnan(from_bfloat16(to_bfloat16(bits.view(np.float32)))), [True] * 5 + [False])


@pytest.mark.covers("REP-19")
@pytest.mark.parametrize("deter_dtype", ["bfloat16", "float32"])
def test_latents_come_back_at_the_stored_precision(deter_dtype: str) -> None:
    rng = np.random.default_rng(0)
    replay = Replay(100, LENGTH, deter_dtype=deter_dtype)
    values = rng.normal(size=(9, 3)).astype(np.float32)
    for n in range(9):
        replay.add({**record(rng, n), "deter": values[n]}, 0)
    stored = values if deter_dtype == "float32" else from_bfloat16(to_bfloat16(values))
    assert (deter_dtype == "float32") == np.array_equal(values, stored)
    np.testing.assert_allclose(stored, values, rtol=2.0**-8)
    np.testing.assert_array_equal(replay.state_dict()["records/deter"], stored)
    batch = replay.sample(np.arange(6) / 6, online=False)
    assert batch["deter"].dtype == np.float32
    np.testing.assert_array_equal(batch["deter"], stored[:6])


@pytest.mark.parametrize(("classes", "size"), [(2, 1), (256, 1), (257, 2), (65536, 2), (65537, 4)])
def test_indices_are_stored_in_the_narrowest_type(classes: int, size: int) -> None:
    replay, rng = Replay(100, 1, classes=classes), np.random.default_rng(0)
    largest = np.array([0, classes - 1], np.int32)
    for n in range(3):
        replay.add({**record(rng, n), "stoch": largest}, 0)
    assert replay.storage
    assert replay.storage.layout.latents_dtype["stoch"].base.itemsize == size
    np.testing.assert_array_equal(replay.sample([0.9])["stoch"], [largest])
    for wrong in (largest + 1, largest - 1, largest.astype(np.float32)):
        with pytest.raises(ValueError, match="stoch"):
            replay.add({**record(rng, 4), "stoch": wrong}, 0)
        with pytest.raises(ValueError, match="stoch"):
            replay.write_back([[0, 0]], {"deter": np.zeros((1, 1, 3)), "stoch": wrong[None, None]})
    assert len(replay) == 2


def test_nothing_that_is_returned_shares_memory_with_the_buffer() -> None:
    replay = filled(records=70, chunk_records=16, block_records=8)
    batch = replay.sample(np.arange(60) / 60, online=False)
    state = replay.state_dict()
    before = {key: np.array(value) for key, value in replay.sample(np.arange(60) / 60, online=False).items()}
    assert replay.storage
    stored = [section for number in range(5) for section in replay.storage.store.open(number).sections]
    stored += [section for stream in replay.streams.values() if stream.stage for section in stream.stage.sections]
    for array in (*batch.values(), *state.values()):
        assert not any(np.shares_memory(array, section) for section in stored)
        if array.ndim:
            array[...] = 1
    assert_same(replay.sample(np.arange(60) / 60, online=False), before)


def test_a_batch_is_filled_again() -> None:
    replay = filled(records=40, chunk_records=16, block_records=8)
    out = replay.sample([0.1, 0.2], online=False)
    arrays = dict(out)
    uniform = [0.3, 0.95]
    again = replay.sample(uniform, online=False, out=out)
    assert again is out
    assert all(out[key] is array for key, array in arrays.items())
    assert_same(out, replay.sample(uniform, online=False))
    for wrong in ({**out, "x": out["x"][:1]}, {**out, "x": out["x"].astype(np.float64)}, {**out, "y": out["x"]}):
        with pytest.raises(ValueError, match="out"):
            replay.sample(uniform, out=wrong)
    with pytest.raises(ValueError, match="contiguous"):
        replay.sample(uniform, out={**out, "x": np.asfortranarray(out["x"])})


@pytest.mark.covers("REP-34")
def test_mapped_memory_stays_under_the_limit() -> None:
    replay = filled(records=1, capacity=10**6, chunk_records=64, block_records=16)
    assert replay.storage
    size = replay.storage.store.shape.file_bytes
    limit = 4 * size
    replay = filled(records=2600, workers=1, capacity=10**6, chunk_records=64, block_records=16, memory_limit=limit)
    assert replay.storage
    files = list(replay.directory.glob("chunk-*"))
    assert sum(path.stat().st_size for path in files) > 10 * limit
    rng, most = np.random.default_rng(0), 0
    for _ in range(60):
        ids = replay.sample(rng.random(8))["ids"]
        replay.write_back(ids, latents(rng, (8, LENGTH)))
        most = max(most, mapped_bytes(replay.directory))
        assert replay.storage.store.mapped_bytes <= limit
    assert 0 < most <= limit


def mapped_bytes(directory: Path) -> int:
    """Bytes of files in a directory that this process has mapped, as the system says."""
    gc.collect()
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("this system does not say what is mapped")
    lines = [line.split() for line in maps.read_text(encoding="utf-8").splitlines() if str(directory) in line]
    return sum(int(line[0].split("-")[1], 16) - int(line[0].split("-")[0], 16) for line in lines)


def test_files_of_evicted_records_are_used_again() -> None:
    replay = filled(records=400, capacity=40, chunk_records=16, block_records=8)
    assert len(list(replay.directory.glob("chunk-*"))) <= 5
    open_files = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
    for _ in range(400):
        replay.add(record(np.random.default_rng(0), 0), 0)
    if open_files:
        assert len(os.listdir("/proc/self/fd")) <= open_files + 2


def test_a_temporary_directory_goes_with_its_buffer() -> None:
    replay = filled(records=3)
    directory = replay.directory
    assert directory.is_dir()
    del replay
    gc.collect()
    assert not directory.exists()


def test_erasing_deletes_only_the_buffer(tmp_path: Path) -> None:
    replay = filled(tmp_path)
    replay.save("a")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="erase"):
        Replay(10, LENGTH, tmp_path)
    erase(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    Replay(10, LENGTH, tmp_path)


@pytest.mark.parametrize(
    "settings",
    [
        {"deter_dtype": "float16"},
        {"classes": 0},
        {"chunk_records": 10},
        {"chunk_records": 0, "block_records": 1},
        {"block_records": 0},
    ],
)
def test_bad_settings_are_refused(settings: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        filled(records=1, **settings)


def test_a_state_of_other_records_replaces_the_content(tmp_path: Path) -> None:
    replay = filled(tmp_path)
    description = replay.save("a")
    before = replay.state_dict()
    state = {**before, "records/x": np.zeros((30, 5), np.float32)}
    replay.load_state_dict(state)
    assert replay.sample([0.5])["x"].shape == (1, LENGTH, 5)
    assert_same(Replay.restore(tmp_path, description, 1000, LENGTH).state_dict(), before)


def test_a_restored_queue_forgets_what_a_smaller_buffer_has_no_room_for(tmp_path: Path) -> None:
    description = filled(tmp_path, records=20).save("a")
    smaller = Replay.restore(tmp_path, description, 4, LENGTH, continue_streams=True)
    assert smaller.sample([0.0] * 2)["ids"].tolist() == [[0, 13], [0, 13]]
    assert smaller.sample([0.0])["ids"].tolist() == [[0, 13]]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: None,
        lambda data: {},
        lambda data: {**data, "entries": []},
        lambda data: {**data, "entries": [*data["entries"], ["y", "<f4", [2**40]]]},
        lambda data: {**data, "entries": [*data["entries"], ["y", "<f4", [2**30, 2**30]]]},
        lambda data: {**data, "entries": [*data["entries"], ["y", "|O", [1]]]},
        lambda data: {**data, "entries": [*data["entries"], ["y", "<f4", [-1]]]},
        lambda data: {**data, "classes": "many"},
        lambda data: {**data, "deter_dtype": "float64"},
    ],
)
def test_what_is_no_layout_is_refused(spoil) -> None:
    layout = layout_of(record(np.random.default_rng(0), 0), "bfloat16", 32)
    assert RecordLayout.from_json(layout.to_json()) == layout
    with pytest.raises(ValueError, match=r"layout|lacks|deter_dtype"):
        RecordLayout.from_json(spoil(layout.to_json()))


def test_bytes_of_a_step_are_those_of_the_chapter() -> None:
    chapter = (Path(__file__).parent.parent / "spec" / "11-replay.md").read_text(encoding="utf-8")
    for size in sizes():
        config = load_config("paper", size)
        bare = {
            key: value for key, value in record(np.random.default_rng(0), 0).items() if key not in ("deter", "stoch")
        }
        step = {**bare, "deter": np.zeros(config.deter, np.float32), "stoch": np.zeros(config.stoch, np.int32)}
        half, full = (
            layout_of(step, dtype, config.classes).latents_dtype.itemsize for dtype in ("bfloat16", "float32")
        )
        one_hot = 4 * config.deter + 4 * config.stoch * config.classes
        row = f"| {size} | {config.deter:,} | {config.stoch} × {config.classes} | {half:,} | {full:,} | {one_hot:,} |"
        assert row in chapter


def test_a_shape_knows_its_file() -> None:
    layout = layout_of(record(np.random.default_rng(0), 0), "bfloat16", 32)
    shape = Shape(layout, 64)
    assert shape.offsets[0] == shape.header_bytes
    assert all(offset % 4096 == 0 for offset in (*shape.offsets, shape.file_bytes))
    assert len(shape.header(2**62)) == shape.header_bytes
