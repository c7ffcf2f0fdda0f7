"""The replay buffer of a run: spec/11-replay.md for millions of records, on the disk, and able to come back after anything."""

from train.replay.buffer import Replay
from train.replay.prefetch import Prefetcher
from train.replay.saves import erase, set_aside

__all__ = ["Prefetcher", "Replay", "erase", "set_aside"]
