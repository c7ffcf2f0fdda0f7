"""The task descriptions of `spec`."""

import pytest

from reference_numpy.replay import Replay
from spec import Discrete, Spaces, Vector

RESERVED = [
    "reward",
    "continue_",
    "is_first",
    "is_last",
    "is_terminal",
    "action",
    "prev_action",
    "deter",
    "stoch",
    "ids",
]


@pytest.mark.parametrize("key", RESERVED)
def test_observations_cannot_have_the_keys_of_records_and_batches(key: str) -> None:
    with pytest.raises(ValueError, match=f"'{key}' is reserved"):
        Spaces({key: Vector(2), "x": Vector(1)}, {"a": Discrete((2,))})
    assert Spaces({"x": Vector(1)}, {key: Discrete((2,))}).actions, "actions have no keys of their own in a record"


def test_every_key_of_a_batch_is_reserved_or_an_observation() -> None:
    replay = Replay(capacity=4, length=1)
    record = {
        "x": 0.0,
        "reward": 0.0,
        "is_first": False,
        "is_last": False,
        "is_terminal": False,
        "action": [0.0],
        "deter": [0.0],
        "stoch": [0],
    }
    for _ in range(2):
        replay.add(record, worker=0)
    assert set(replay.sample([0.0])) <= {*RESERVED, "x"}
    assert set(record) <= {*RESERVED, "x"}
