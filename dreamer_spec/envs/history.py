"""What an episode has been so far: enough to come back to its last record in another process, [LOOP-34]."""

import dataclasses
from collections.abc import Mapping

import numpy as np

LONGEST = 108_000  # actions of an episode that are kept: memory must not grow without bound


@dataclasses.dataclass(frozen=True)
class History:
    """An episode up to a record. seed: of its worker. episode: its number under this seed. actions: those it was given,
    [t, A] float32."""

    seed: int
    episode: int
    actions: np.ndarray

    def to_json(self) -> dict[str, int]:
        """All but the actions."""
        return {"seed": self.seed, "episode": self.episode}

    @classmethod
    def from_json(cls, entry: Mapping[str, int], actions: np.ndarray) -> "History":
        return cls(entry["seed"], entry["episode"], actions)


class OngoingEpisode:
    """An episode of one worker while it goes on. Begins before the last record of a history, which `add` then adds.

    records: how many it has. is_last: whether its last record ended it.
    """

    def __init__(self, history: History) -> None:
        self.seed, self.number = history.seed, history.episode
        self.records, self.is_last = len(history.actions), False
        self._action_size = history.actions.shape[1]
        self._actions = bytearray(history.actions[:-1].astype(np.float32).tobytes())

    def add(self, action: np.ndarray, is_last: bool) -> None:
        """Another record. The action [A] float32 led to it, unless it is the first."""
        if self.records > LONGEST:
            self._actions.clear()
        elif self.records:
            self._actions += action.tobytes()
        self.records += 1
        self.is_last = is_last

    def next(self) -> "OngoingEpisode":
        """The one that follows under the same seed."""
        return OngoingEpisode(History(self.seed, self.number + 1, np.zeros((0, self._action_size), np.float32)))

    def history(self) -> History | None:
        """None where the episode has no record yet, or more actions than are kept."""
        if not 0 < self.records <= LONGEST + 1:
            return None
        return History(
            self.seed, self.number, np.frombuffer(bytes(self._actions), np.float32).reshape(-1, self._action_size)
        )
