import numpy as np
import pytest

from reference_numpy.replay import Replay

FLAGS = ("is_first", "is_last", "is_terminal")


def record(n: int, worker: int = 0, **changes):
    """A record whose every entry tells its position: observation n, action 10 n, latents (n, 1000 + n) and n % 7."""
    values = {
        "x": np.array([n, worker], np.float32),
        "image": np.full((2, 2, 1), n % 256, np.uint8),
        "reward": np.float32(0.5 * n),
        "is_first": n == 0,
        "is_last": False,
        "is_terminal": False,
        "action": np.array([10.0 * n], np.float32),
        "deter": np.array([n, 1000 + n], np.float32),
        "stoch": np.array([n % 7], np.int64),
    }
    return values | changes


def filled(steps: int, capacity: int = 100, length: int = 2, workers: int = 1) -> Replay:
    replay = Replay(capacity, length)
    for n in range(steps):
        for worker in range(workers):
            replay.add(record(n, worker), worker)
    return replay


def latents(rows: int, length: int, value: float = 5.0):
    return {"deter": np.full((rows, length, 2), value, np.float32), "stoch": np.full((rows, length, 1), 6)}


def test_batch_has_exactly_the_entries_and_types_of_the_chapter():
    batch = filled(5).sample([0.0, 0.3, 0.9])
    types = {key: (array.dtype.name, array.shape) for key, array in batch.items()}
    assert types == {
        "x": ("float32", (3, 2, 2)),
        "image": ("uint8", (3, 2, 2, 2, 1)),
        "reward": ("float32", (3, 2)),
        "is_first": ("bool", (3, 2)),
        "is_last": ("bool", (3, 2)),
        "is_terminal": ("bool", (3, 2)),
        "prev_action": ("float32", (3, 2, 1)),
        "deter": ("float32", (3, 2)),
        "stoch": ("int32", (3, 1)),
        "ids": ("int64", (3, 2)),
    }


def test_items_appear_with_their_last_record():
    replay = Replay(100, 3)
    sizes = []
    for n in range(6):
        replay.add(record(n), 0)
        sizes.append(len(replay))
    assert sizes == [0, 0, 0, 1, 2, 3]
    assert len(filled(6, length=3, workers=2)) == 6


def test_online_queue_starts_at_1_and_tiles_time():
    replay = Replay(1000, 64)
    served = []
    for n in range(200):
        replay.add(record(n), 0)
        if len(replay):
            start = int(replay.sample([0.0])["ids"][0, 1])
            if start > 0:  # an empty queue gives item 0, the oldest
                served.append((n, start))
    assert served == [(65, 1), (130, 66), (195, 131)]
    assert filled(200, capacity=1000, length=64).sample([0.0] * 4)["ids"][:, 1].tolist() == [1, 66, 131, 0]


def test_queue_is_one_for_all_workers_and_rows_mix():
    replay = filled(7, length=2, workers=2)  # queued when records 3 and 6 are added, worker 0 before worker 1
    batch = replay.sample([0.99] * 5)
    assert batch["ids"].tolist() == [[0, 1], [1, 1], [0, 4], [1, 4], [1, 4]]
    assert batch["x"][:, 0, 1].tolist() == [0, 1, 0, 1, 1]


def test_online_false_leaves_the_queue_alone():
    replay = filled(4)
    assert replay.sample([0.0], online=False)["ids"].tolist() == [[0, 0]]
    assert replay.sample([0.0])["ids"].tolist() == [[0, 1]]
    assert replay.sample([0.0])["ids"].tolist() == [[0, 0]]


def test_evicted_queue_entries_are_dropped():
    replay = filled(9, capacity=2)  # items 5 and 6; queued were 1, 4
    assert replay.sample([0.0])["ids"].tolist() == [[0, 5]]
    replay = filled(10, capacity=2)  # items 6 and 7; queued were 1, 4, 7
    assert replay.sample([0.0])["ids"].tolist() == [[0, 7]]


def test_uniform_index():
    replay = filled(12, capacity=10)
    uniforms = [0.0, 0.0999, 0.1, 0.55, 0.9999999999999999]
    assert replay.sample(uniforms, online=False)["ids"][:, 1].tolist() == [0, 0, 1, 5, 9]
    replay = filled(15, capacity=10)  # the ring has turned: items 3 to 12
    assert replay.sample(uniforms, online=False)["ids"][:, 1].tolist() == [3, 3, 4, 8, 12]


def test_an_abandoned_episode_changes_no_stored_flag():
    replay = Replay(10, 3)
    firsts, lasts = [False, False, True, False, True], [False, False, False, True, False]
    for n in range(5):
        replay.add(record(n, is_first=firsts[n], is_last=lasts[n], is_terminal=lasts[n]), 0)
    replay.sample([0.0, 0.9], online=False)
    # in another window the same record is last again only through its neighbour
    assert replay.state_dict()["records/is_last"].tolist() == lasts


def test_nothing_aliases_storage():
    replay = Replay(10, 2)
    given = [record(n) for n in range(3)]
    for step in given:
        replay.add(step, 0)
    for step in given:
        for value in step.values():
            if isinstance(value, np.ndarray):
                value[...] = 77
    first = replay.sample([0.0])
    for array in first.values():
        array[...] = 1
    state = replay.state_dict()
    for array in state.values():
        array[...] = 1
    again = replay.sample([0.0])
    assert again["x"][0, :, 0].tolist() == [1, 2]
    assert again["prev_action"][0, :, 0].tolist() == [0, 10]
    assert again["deter"].tolist() == [[0, 1000]]
    assert not again["is_first"].any()
    fresh = latents(1, 2)
    replay.write_back(again["ids"], fresh)
    fresh["deter"][...] = 99
    assert replay.state_dict()["records/deter"][:, 0].tolist() == [0, 5, 5]


def test_write_back_ignores_evicted_records_one_by_one():
    replay = filled(5, capacity=3, length=3)
    ids = replay.sample([0.0], online=False)["ids"]
    assert ids.tolist() == [[0, 0]]
    for n in range(5, 7):
        replay.add(record(n), 0)
    # items 1, 2, 3 remain: records 1.. are held
    replay.write_back(ids, latents(1, 3))
    state = replay.state_dict()
    assert state["streams"].tolist() == [[0, 1, 6]]
    assert state["records/deter"][:, 0].tolist() == [5, 5, 5, 4, 5, 6]
    replay.write_back(np.array([[9, 0], [0, -50]]), latents(2, 3, 8.0))
    assert state.keys() == replay.state_dict().keys()
    assert replay.state_dict()["records/deter"][:, 0].tolist() == [5, 5, 5, 4, 5, 6]


def test_save_and_load():
    replay = filled(6, capacity=5, workers=2)
    replay.sample([0.0] * 2)
    state = replay.state_dict()
    assert all(isinstance(array, np.ndarray) and array.dtype != object for array in state.values())
    assert state["items"].tolist() == [[1, 1], [0, 2], [1, 2], [0, 3], [1, 3]]
    loaded = Replay(5, 2)
    loaded.load_state_dict(state)
    uniforms = [0.0, 0.25, 0.5, 0.7, 0.9]
    before, after = replay.sample(uniforms, online=False), loaded.sample(uniforms)  # the loaded queue is empty
    for key in before:
        np.testing.assert_array_equal(before[key], after[key])
    # streams are closed: two records of a worker make no item, the third one makes the item of a new stream
    for n, expected in ((6, 5), (7, 5), (8, 5)):
        loaded.add(record(n), 0)
        assert len(loaded) == expected
    assert loaded.state_dict()["items"].tolist() == [[0, 2], [1, 2], [0, 3], [1, 3], [2, 0]]
    assert len(replay) == 5


def test_closed_streams_vanish_with_their_last_item():
    loaded = Replay(4, 2)
    loaded.load_state_dict(filled(6, capacity=4).state_dict())
    for n in range(6):
        loaded.add(record(n), 3)
    state = loaded.state_dict()
    assert state["streams"].tolist() == [[1, 0, 6]]
    assert len(loaded._streams) == 1
    loaded.write_back(np.array([[0, 1]]), latents(1, 2))


def test_loading_into_a_smaller_buffer_keeps_the_newest():
    loaded = Replay(2, 2)
    loaded.load_state_dict(filled(8).state_dict())
    assert loaded.sample([0.0, 0.5])["ids"].tolist() == [[0, 4], [0, 5]]
    with pytest.raises(ValueError, match="length"):
        Replay(2, 3).load_state_dict(filled(8).state_dict())


def test_empty_state_round_trip():
    loaded = Replay(2, 2)
    loaded.load_state_dict(Replay(2, 2).state_dict())
    loaded.load_state_dict(filled(2).state_dict())
    assert len(loaded) == 0
    loaded.add(record(0), 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": np.zeros(3, np.float32)}, "x of the record"),
        ({"extra": 1.0}, "extra"),
        ({"image": np.zeros((2, 2, 1))}, "image"),
        ({"reward": np.zeros(1)}, "reward"),
    ],
)
def test_bad_records(changes, message):
    replay = filled(1)
    with pytest.raises(ValueError, match=message):
        replay.add(record(1, **changes), 0)
    assert len(replay._streams[0].records) == 1


def test_bad_calls():
    for capacity, length in ((0, 1), (1, 0)):
        with pytest.raises(ValueError, match="capacity"):
            Replay(capacity, length)
    incomplete = record(0)
    del incomplete["deter"]
    with pytest.raises(ValueError, match="deter"):
        Replay(1, 1).add(incomplete, 0)
    with pytest.raises(ValueError, match="sample"):
        filled(2).sample([0.0])
    for uniform in ([1.0], [-0.1], [float("nan")], []):
        with pytest.raises(ValueError, match="uniform"):
            filled(3).sample(uniform)
    with pytest.raises(ValueError, match="latents"):
        filled(3).write_back([[0, 0]], latents(1, 3))


def test_against_a_naive_definition():
    """Random records of three workers; everything held and drawn must follow from the list of all records."""
    random = np.random.default_rng(0)
    replay, length, capacity = Replay(20, 3), 3, 20
    streams, items, queue, order = {}, [], [], {}
    for _ in range(300):
        worker = int(random.integers(3))
        stream = streams.setdefault(worker, [])
        order.setdefault(worker, len(order))
        first, last = random.random() < 0.2, random.random() < 0.2
        step = record(len(stream), worker, is_first=first, is_last=last)
        replay.add(step, worker)
        stream.append(step)
        if len(stream) > length:
            items.append((worker, len(stream) - 1 - length))
            if (len(stream) - 1) % (length + 1) == 0:
                queue.append(items[-1])
        items = items[-capacity:]
        assert len(replay) == len(items)
        if items and random.random() < 0.3:
            uniform = random.random(2)
            expected = []
            for u in uniform:
                queue = [item for item in queue if item in items]
                expected.append(queue.pop(0) if queue else items[int(u * len(items))])
            batch = replay.sample(uniform)
            assert batch["ids"].tolist() == [[order[w], start] for w, start in expected]
            for row, (w, start) in enumerate(expected):
                window = streams[w][start : start + length + 1]
                assert batch["x"][row].tolist() == [step["x"].tolist() for step in window[1:]]
                assert batch["prev_action"][row, :, 0].tolist() == [step["action"][0] for step in window[:-1]]
                lasts = [step["is_last"] for step in window]
                for t in range(length):
                    lasts[t] = lasts[t] or window[t + 1]["is_first"]
                assert batch["is_last"][row].tolist() == lasts[1:]
    held = sum(len(stream.records) for stream in replay._streams.values())
    assert held <= capacity + 3 * length
