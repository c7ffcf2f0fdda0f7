"""Checks of spec/11-replay.md. Every entry of a record tells its position and its worker, so whatever comes out says
where it was."""

import sys
import tracemalloc
from collections.abc import Callable
from types import FrameType
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.check import script
from conformance.ledger import LATENTS, Arrays, Ledger, record
from conformance.script import Script
from conformance.strategies import seeds
from conformance.worked import worked

TYPES = {
    "x": "float32",
    "image": "uint8",
    "mode": "int64",
    "reward": "float32",
    "is_first": "bool",
    "is_last": "bool",
    "is_terminal": "bool",
    "prev_action": "float32",
    "deter": "float32",
    "stoch": "int32",
    "ids": "int64",
}
REQUIRED = ("reward", "is_first", "is_last", "is_terminal", "action", *LATENTS)


def filled(script: Script, records: int, capacity: int = 100, length: int = 2, workers: int = 1) -> Any:
    replay = script.call("Replay", capacity, length)
    for n in range(records):
        for worker in range(workers):
            replay.add(record(n, worker), worker)
    return replay


def latents(rows: int, length: int, value: float) -> Arrays:
    return {
        "deter": np.full((rows, length, 3), value, np.float32),
        "stoch": np.full((rows, length, 2), int(value) % 64, np.int32),
    }


def starts(batch: Arrays) -> list[int]:
    return np.asarray(batch["ids"])[:, 1].tolist()


def contexts(replay: Any, uniform: list[float]) -> list[float]:
    """First number of the latents where the drawn items start."""
    return np.asarray(replay.sample(uniform, online=False)["deter"])[:, 0].tolist()


def refuses(script: Script, words: tuple[str, ...], function: Callable[..., Any], *args: Any) -> None:
    """Holds if the call raises a ValueError whose message contains the words."""
    try:
        function(*args)
    except ValueError as error:
        message = str(error)
        script.holds(f"the message {message!r} names {words}", bool(message) and all(word in message for word in words))
        return
    script.holds(f"a ValueError of {function.__name__} that names {words}", False)


def compare_arrays(script: Script, where: str, actual: Any, expected: Arrays) -> None:
    script.holds(f"{where}: keys {sorted(actual)}", set(actual) == set(expected))
    for key, value in expected.items():
        script.exact(f"{where}[{key}]", actual[key], value)


@script(*(f"REP-{n}" for n in range(1, 27) if n not in (6, 13)), uses=["Replay"], level=0)
def histories_match_the_definition(script: Script) -> None:
    """Whatever is added, drawn, written back, saved and loaded by several workers in any order follows from the list of
    all records."""

    @script.for_all(
        seed=seeds(), length=st.integers(1, 4), capacity=st.sampled_from([1, 2, 7, 20]), workers=st.integers(1, 3)
    )
    def _(seed: int, length: int, capacity: int, workers: int) -> None:
        rng = np.random.default_rng(seed)
        replay, ledger, drawn = script.call("Replay", capacity, length), Ledger(length), [np.zeros((1, 2), np.int64)]
        for n in range(80):
            worker = int(rng.integers(workers)) * 7
            flags = {name: np.array(rng.random() < 0.2) for name in ("is_first", "is_last", "is_terminal")}
            step = record(n, worker, **flags)
            replay.add(step, worker)
            ledger.add(step, worker, capacity)
            script.exact("len", len(replay), len(ledger.items))
            if len(replay) and rng.random() < 0.4:
                uniform, online = rng.random(3), bool(rng.random() < 0.7)
                batch = replay.sample(uniform, online=online)
                compare_arrays(script, "sample", batch, ledger.batch(ledger.choose(uniform, online)))
                drawn.append(np.array(batch["ids"]))
            if rng.random() < 0.3:
                ids = drawn[int(rng.integers(len(drawn)))]
                fresh: Arrays = {
                    "deter": rng.random((len(ids), length, 3), np.float32),
                    "stoch": rng.integers(0, 64, (len(ids), length, 2)),
                }
                replay.write_back(ids, fresh)
                ledger.write_back(ids, fresh)
            if n in (25, 60):
                state = replay.state_dict()
                expected = ledger.state()
                script.holds("the records of a state", set(expected) <= set(state))
                compare_arrays(script, "state", {key: state[key] for key in expected}, expected)
                capacity = max(1, capacity - n // 20)
                replay = script.call("Replay", capacity, length)
                replay.load_state_dict(state)
                ledger.restart(capacity)
                script.exact("len after loading", len(replay), len(ledger.items))


def by_hand(script: Script, name: str) -> Any:
    """Makes the calls of a worked example, and returns its buffer."""
    (example,) = worked("replay", name)
    replay = script.call("Replay", *example.arguments)
    for call in example.calls:
        result = getattr(replay, call.function)(*call.arguments)
        if call.expected is not None:
            script.compare(f"Replay, {call.name}", result, call.expected, magnitude=1.0, bound=0.0)
    return replay


BY_HAND = ("REP-2", "REP-4", "REP-5", "REP-7", "REP-8", "REP-12", "REP-14", "REP-15", "REP-18", "REP-20", "REP-22")


@script(*BY_HAND, uses=["Replay"], level=0)
def a_small_buffer_by_hand(script: Script) -> None:
    """T = 2, capacity 3, records 0 to 5: row 0 comes from the queue, row 1 is drawn, and record 3 keeps the latents of
    row 1."""
    by_hand(script, "a small buffer")


@script("REP-14", "REP-19", uses=["Replay"], level=0)
def entries_and_types_of_a_batch(script: Script) -> None:
    """A batch has exactly the entries of the chapter in their types; observations keep theirs, and deter keeps every
    bit of float32."""
    replay = filled(script, 9, length=3)
    batch = replay.sample([0.0, 0.3, 0.9, 0.2])
    script.holds(f"the entries {sorted(batch)}", set(batch) == set(TYPES))
    for key, dtype in TYPES.items():
        script.holds(f"{key} has the type {dtype}, got {batch[key].dtype}", batch[key].dtype == dtype)
    shapes = {
        "image": (4, 3, 2, 3, 1),
        "mode": (4, 3, 1),
        "prev_action": (4, 3, 2),
        "deter": (4, 3),
        "stoch": (4, 2),
        "ids": (4, 2),
    }
    for key, shape in shapes.items():
        script.holds(f"{key} has the shape {shape}, got {batch[key].shape}", batch[key].shape == shape)
    script.exact("deter", batch["deter"][:, 2], 1 / (np.array(starts(batch)) + 1).astype(np.float32))


@script("REP-7", "REP-8", "REP-9", uses=["Replay"], level=0)
def the_queue_of_the_paper(script: Script) -> None:
    """With T = 64 the entries arrive with records 65, 130, 195 and start at 1, 66, 131: nothing is missed but record
    0."""
    replay, served = script.call("Replay", 1000, 64), []
    for n in range(200):
        replay.add(record(n), 0)
        start = starts(replay.sample([0.0]))[0] if len(replay) else 0
        if start:  # an empty queue gives the oldest item, 0
            served.append((n, start))
    script.exact("record that was added, start that was served", served, [(65, 1), (130, 66), (195, 131)])
    together = filled(script, 200, capacity=1000, length=64)
    script.exact("starts of one batch", starts(together.sample([0.0] * 5)), [1, 66, 131, 0, 0])
    script.exact("the oldest item is served, too", starts(filled(script, 6, capacity=3).sample([0.99])), [1])
    script.exact("evicted entries are dropped", starts(filled(script, 9, capacity=2).sample([0.0])), [5])
    script.exact("and the next one serves the row", starts(filled(script, 10, capacity=2).sample([0.0, 0.0])), [7, 6])


@script("REP-1", "REP-8", "REP-10", "REP-11", "REP-12", uses=["Replay"], level=0)
def one_queue_for_all_workers(script: Script) -> None:
    """Entries of two workers are served in the order in which they were queued; rows after them use the uniforms at
    their own place."""
    replay = filled(script, 7, workers=2)  # queued with records 3 and 6
    script.exact("offline", replay.sample([0.0, 0.99], online=False)["ids"], [[0, 0], [1, 4]])
    batch = replay.sample([0.99, 0.99, 0.0, 0.0, 0.15, 0.99])
    script.exact("online", batch["ids"], [[0, 1], [1, 1], [0, 4], [1, 4], [1, 0], [1, 4]])
    script.exact("workers", batch["x"][:, 0, 1], [0, 1, 0, 1, 1, 1])


@script("REP-12", uses=["Replay"], level=0)
def uniform_numbers_choose_items(script: Script) -> None:
    """Number u chooses item floor(u n) of n in float64, counted from the oldest, also when many items have been
    removed."""
    uniform = [0.0, 0.0999, 0.1, 0.5 - 2.0**-40, 0.5, 0.55, float(np.nextafter(1, 0))]
    for records, oldest in ((12, 0), (15, 3), (33, 21)):
        expected = oldest + np.array([0, 0, 1, 4, 5, 5, 9])
        chosen = starts(filled(script, records, capacity=10).sample(uniform, online=False))
        script.exact(f"after {records} records", chosen, expected)


@script("REP-15", "REP-16", "REP-17", uses=["Replay"], level=0)
def flags_inside_a_sequence(script: Script) -> None:
    """An abandoned episode ends where the next one begins, except at the last position; nothing else is changed or
    masked."""
    by_hand(script, "an abandoned episode")
    replay = by_hand(script, "ends inside a sequence")
    script.exact("stored is_last", replay.state_dict()["records/is_last"], [False, False, False, True, False])


@script("REP-6", "REP-23", uses=["Replay"], level=0)
def nothing_shares_memory(script: Script) -> None:
    """Writing into what was given to add, write_back or load_state_dict, or came from sample or state_dict, changes
    nothing."""

    def spoil(arrays: Any) -> None:
        for array in arrays.values():
            if np.ndim(array) and array.flags.writeable:
                array[...] = 1

    replay, given = script.call("Replay", 10, 2), [record(n) for n in range(4)]
    for step in given:
        replay.add(step, 0)
        spoil(step)
    before = {key: np.array(value) for key, value in replay.sample([0.0, 0.9], online=False).items()}
    script.exact("x after the arrays given to add were overwritten", before["x"][:, :, 0], [[1, 2], [2, 3]])
    spoil(replay.sample([0.0, 0.9], online=False))
    spoil(replay.state_dict())
    compare_arrays(script, "after batch and state were overwritten", replay.sample([0.0, 0.9], online=False), before)
    fresh = latents(2, 2, 5.0)
    replay.write_back(before["ids"], fresh)
    spoil(fresh)
    script.exact("latents after those written back were overwritten", contexts(replay, [0.0, 0.9]), [0, 5])
    loaded, state = script.call("Replay", 10, 2), replay.state_dict()
    loaded.load_state_dict(state)
    spoil(state)
    script.exact("x after the loaded state was overwritten", loaded.sample([0.0, 0.9])["x"][:, :, 0], [[1, 2], [2, 3]])
    script.exact("the queue after state_dict", starts(replay.sample([0.0])), [1])


@script("REP-5", "REP-20", "REP-21", uses=["Replay"], level=0)
def write_back_to_evicted_records(script: Script) -> None:
    """Positions that are gone are skipped one by one, streams that are gone or never were altogether; the context is
    not touched."""
    replay = filled(script, 5, capacity=3, length=3)
    ids = replay.sample([0.0], online=False)["ids"]
    script.exact("ids", ids, [[0, 0]])
    for n in (5, 6, 7):
        replay.add(record(n), 0)  # items 2, 3, 4: records 0 and 1 are gone
    replay.write_back(ids, latents(1, 3, 55.0))
    script.exact("latents of records 2 to 7", replay.state_dict()["records/deter"][:, 0], [55, 55, 4, 5, 6, 7])
    replay.write_back(np.array([[9, 0], [0, 3]]), latents(2, 3, 8.0))
    script.exact("latents of records 2 to 7, again", replay.state_dict()["records/deter"][:, 0], [55, 55, 8, 8, 8, 7])
    script.exact("stoch", replay.state_dict()["records/stoch"][:, 0], [55, 55, 8, 8, 8, 7])


@script("REP-23", "REP-24", "REP-25", uses=["Replay"], level=0)
def saving_and_loading(script: Script) -> None:
    """The state is plain arrays with the records that belong to items; loading replaces everything and begins new
    streams."""
    replay = filled(script, 6, capacity=5, workers=2)
    replay.add(record(0, 2), 2)  # stream 2 has no item
    state = replay.state_dict()
    script.holds(
        "every entry is an array of numbers",
        [isinstance(x, np.ndarray) and x.dtype.kind in "biuf" for x in state.values()],
    )
    for key, value in {
        "length": 2,
        "next_stream": 3,
        "streams": [[0, 2, 4], [1, 1, 5]],
        "items": [[1, 1], [0, 2], [1, 2], [0, 3], [1, 3]],
    }.items():
        script.exact(key, state[key], value)
        script.holds(f"{key} is int64", state[key].dtype == np.int64)
    script.exact(
        "records", state["records/x"], [[2, 0], [3, 0], [4, 0], [5, 0], [1, 1], [2, 1], [3, 1], [4, 1], [5, 1]]
    )
    loaded = filled(script, 9, capacity=5)  # with items, open streams and a queue of its own
    loaded.load_state_dict({key: np.array(value) for key, value in state.items()})
    uniform = [0.0, 0.25, 0.5, 0.7, 0.9]
    compare_arrays(script, "a batch of the loaded buffer", loaded.sample(uniform), replay.sample(uniform, online=False))
    for n, worker in ((6, 0), (7, 0), (6, 1), (8, 0)):
        loaded.add(record(n, worker), worker)
    script.exact("items", loaded.state_dict()["items"], [[0, 2], [1, 2], [0, 3], [1, 3], [3, 0]])
    script.exact("saving changes nothing", starts(replay.sample([0.0])), [1])
    empty = script.call("Replay", 2, 2)
    empty.load_state_dict(script.call("Replay", 2, 2).state_dict())
    script.exact("an empty state", len(empty), 0)


@script("REP-26", uses=["Replay"], level=0)
def loading_into_other_buffers(script: Script) -> None:
    """Another length is refused; a smaller capacity keeps the newest items."""
    state = filled(script, 8).state_dict()
    loaded = script.call("Replay", 2, 2)
    loaded.load_state_dict(state)
    script.exact("ids", loaded.sample([0.0, 0.5])["ids"], [[0, 4], [0, 5]])
    refuses(script, ("length",), script.call("Replay", 2, 3).load_state_dict, state)


@script("REP-13", uses=["Replay"], level=0)
def an_empty_buffer_gives_nothing(script: Script) -> None:
    """Sampling without an item raises an error."""
    refuses(script, (), filled(script, 2).sample, [0.0])
    refuses(script, (), filled(script, 2).sample, [0.0], False)


@script("REP-27", uses=["Replay"], level=0)
def bad_records_are_refused(script: Script) -> None:
    """Missing and unknown keys and other shapes are refused with a message that names them, and leave no trace."""
    for capacity, length in ((0, 1), (1, 0), (-5, 3), (3, -5)):
        script.refuses("Replay", capacity, length)
    for key in REQUIRED:
        without = {name: value for name, value in record(0).items() if name != key}
        refuses(script, (key,), script.call("Replay", 5, 1).add, without, 0)
    blind = {name: value for name, value in record(0).items() if name in REQUIRED}
    refuses(script, ("observation",), script.call("Replay", 5, 1).add, blind, 0)
    replay = filled(script, 2)
    for key in ("x", *REQUIRED):
        without = {name: value for name, value in record(2).items() if name != key}
        refuses(script, (key,), replay.add, without, 0)
    refuses(script, ("extra",), replay.add, record(2, extra=np.zeros(1)), 0)
    shapes = {"x": (7,), "action": (7,), "image": (2, 7, 1), "reward": (7,), "deter": (7, 1)}
    for key, shape in shapes.items():
        wrong = np.zeros(shape, np.uint8 if key == "image" else np.float32)
        refuses(script, (key, "7"), replay.add, {**record(2), key: wrong}, 0)
    replay.add(record(2), 0)
    script.exact("x of the records that were accepted", replay.sample([0.0])["x"][..., 0], [[1, 2]])


def effort(function: Callable[..., Any], *args: Any) -> tuple[int, int]:
    """What 40 calls cost, counted and not timed: lines of Python that ran in all, and the memory that the most modest
    call took."""
    lines, taken, before = 0, [], sys.gettrace()

    def count(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal lines
        lines += event == "line"
        return count

    tracemalloc.start()
    sys.settrace(count)
    try:
        for _ in range(40):
            start = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            function(*args)
            taken.append(tracemalloc.get_traced_memory()[1] - start)
    finally:
        sys.settrace(before)
        tracemalloc.stop()
    return lines, min(taken)


@script("REP-28", uses=["Replay"], level=0)
def effort_does_not_grow_with_the_buffer(script: Script) -> None:
    """Adding and drawing run no more code and copy no more with 10 000 items, growing or full, than with 200, within a
    factor of 2.

    What a loop inside of compiled code costs is not seen.
    """
    step, efforts = record(0), []
    for capacity, records in ((200, 210), (10_000, 10_010), (20_000, 10_010)):
        replay = script.call("Replay", capacity, 2)
        for _ in range(records):
            replay.add(step, 0)
        efforts.append((effort(replay.add, step, 0), effort(replay.sample, [0.3, 0.9], False)))
    for index, where in enumerate(("add", "sample")):
        for unit, (small, full, growing) in zip(
            ("lines", "bytes"), zip(*(entry[index] for entry in efforts), strict=True), strict=True
        ):
            message = f"{where}: {small} {unit} with 200 items, with 10 000 {full} when full and {growing} before"
            script.holds(message, max(full, growing) <= 2 * small + 100)


@script("REP-5", uses=["Replay"], level=0)
def evicted_records_free_their_memory(script: Script) -> None:
    """A full buffer does not grow: 200 more records of 20 kB take the room of at most 20."""
    replay = script.call("Replay", 8, 2)

    def add(records: range) -> int:
        for n in records:
            replay.add(record(n, image=np.zeros((100, 200, 1), np.uint8)), 0)
            if len(replay):
                replay.sample([0.5])
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = add(range(50))
        growth = add(range(50, 250)) - before
    finally:
        tracemalloc.stop()
    script.holds(f"growth of {growth} bytes", growth <= 20 * 20_000)
