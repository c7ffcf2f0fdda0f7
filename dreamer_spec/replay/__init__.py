"""The replay buffer of a run: spec/11-replay.md for millions of records, on the disk, and able to come back after
anything."""

from dreamer_spec.replay.buffer import Replay
from dreamer_spec.replay.prefetch import Prefetcher
from dreamer_spec.replay.saves import erase, set_aside

__all__ = ["Prefetcher", "Replay", "erase", "set_aside"]
