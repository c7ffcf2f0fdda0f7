"""Instructions as numbers, as DMLab's are (D-100), by a suite's [SUITE.text] in spec/benchmarks.toml."""

import functools
import re
import zlib
from collections.abc import Sequence

import gymnasium
import numpy as np

from spec import benchmarks


def space(suite: str) -> gymnasium.spaces.Box:
    """Of what `encode` returns."""
    entry = benchmarks()[suite]["text"]
    return gymnasium.spaces.Box(-np.inf, np.inf, (entry["slots"] * entry["size"],), np.float32)


def encode(suite: str, text: str) -> np.ndarray:
    """An instruction as numbers [slots * size] in float32; tokens beyond the slots are dropped."""
    entry = benchmarks()[suite]["text"]
    found = [bucket(suite, token) for token in tokens(suite, text)][: entry["slots"]]
    table = _table(entry["seed"], entry["buckets"], entry["size"])
    return table[found + [0] * (entry["slots"] - len(found))].reshape(-1)


def tokens(suite: str, text: str) -> Sequence[str]:
    """Words of letters and underscores, and what stands between words and spaces."""
    found: list[str] = re.findall(benchmarks()[suite]["text"]["tokens"], text.lower())
    return found


def bucket(suite: str, token: str) -> int:
    count: int = benchmarks()[suite]["text"]["buckets"]
    return zlib.crc32(token.encode()) % count


@functools.cache
def _table(seed: int, buckets: int, size: int) -> np.ndarray:
    """[buckets, size]"""
    return np.random.default_rng(seed).normal(size=(buckets, size)).astype(np.float32)
