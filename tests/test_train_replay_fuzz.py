"""Mutated files: every outcome is a content that was there, or a clear error."""

import json
import random
import shutil
import tempfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from replay_machine import latents, record

from dreamer_spec.errors import UserError
from dreamer_spec.replay import Replay

CAPACITY, LENGTH = 60, 3
MEMORY = Path("/dev/shm") if Path("/dev/shm").is_dir() else None


def saved(directory: Path) -> tuple[dict, dict[tuple[int, float], np.ndarray]]:
    """A description, and every record by what its observation says."""
    replay, rng = Replay(CAPACITY, LENGTH, directory, chunk_records=8, block_records=4), np.random.default_rng(0)
    for n in range(50):
        for worker in range(2):
            replay.add(record(rng, n), worker)
    description = replay.save("a")
    batch = replay.sample(np.arange(CAPACITY) / CAPACITY, online=False)
    known = {key_of(batch, row): batch["image"][row] for row in range(CAPACITY)}
    for _ in range(5):
        replay.write_back(replay.sample(rng.random(4))["ids"], latents(rng, (4, LENGTH)))
        replay.add(record(rng, 0), 0)
    return description, known


def key_of(batch: dict[str, np.ndarray], row: int) -> tuple:
    return (*batch["x"][row].ravel().tolist(), *batch["deter"][row].tolist())


def mutate(path: Path, chance: random.Random) -> None:
    data = bytearray(path.read_bytes())
    kind = chance.choice(["bit", "bytes", "cut", "grow", "swap", "missing", "zeros"])
    where = chance.randrange(len(data)) if data else 0
    if kind == "missing":
        path.unlink()
        return
    if kind == "bit" and data:
        data[where] ^= 1 << chance.randrange(8)
    elif kind == "bytes":
        data[where : where + 8] = chance.randbytes(8)
    elif kind == "cut":
        del data[where:]
    elif kind == "grow":
        data += chance.randbytes(chance.randrange(1, 100))
    elif kind == "swap":
        data[where:] = data[where:][::-1]
    else:
        data[where : where + 64] = bytes(len(data[where : where + 64]))
    path.write_bytes(data)


def outcome(original: Path, description: dict, known: dict, seed: int) -> str:
    """Mutates one to three files of a copy, restores it, and compares whatever comes back."""
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory(dir=MEMORY) as name:
        directory = Path(shutil.copytree(original, Path(name) / "replay"))
        files = sorted(directory.iterdir())
        for path in chance.sample(files, chance.randrange(1, 4)):
            mutate(path, chance)
        index = directory / description["file"]
        crafted = chance.random() < 0.5 and index.exists()
        if crafted:  # Even an index whose checksum agrees is not trusted.
            mutate_text(index, chance)
            if index.exists():
                description = {**description, "crc32": zlib.crc32(index.read_bytes())}
        try:
            replay = Replay.restore(directory, description, CAPACITY, LENGTH, continue_streams=chance.random() < 0.5)
        except (ValueError, UserError):
            return "refused"
        if len(replay) and not crafted:
            batch = replay.sample((np.arange(len(replay)) + 0.5) / len(replay), online=False)
            for row in range(len(replay)):
                np.testing.assert_array_equal(batch["image"][row], known[key_of(batch, row)])
        return "damaged" if replay.warnings else "whole"


def mutate_text(path: Path, chance: random.Random) -> None:
    """Other numbers in the header of a safetensors file or in its arrays."""
    data = bytearray(path.read_bytes())
    digits = [place for place, byte in enumerate(data[:1500]) if 48 <= byte < 58]
    for place in chance.sample(digits, min(len(digits), chance.randrange(3))):
        data[place] = 48 + chance.randrange(10)
    for _ in range(chance.randrange(3)):
        if len(data) > 8:
            data[chance.randrange(len(data) // 2, len(data))] = chance.choice([0, 1, 127, 255])
    path.write_bytes(data)


def run(directory: Path, seeds: range) -> dict[str, int]:
    description, known = saved(directory)
    counts = dict.fromkeys(("whole", "damaged", "refused"), 0)
    for seed in seeds:
        counts[outcome(directory, json.loads(json.dumps(description)), known, seed)] += 1
    return counts


@pytest.mark.covers("REP-31")
def test_mutated_files_are_refused_or_left_out(tmp_path: Path) -> None:
    counts = run(tmp_path / "replay", range(200))
    assert min(counts.values()) > 0, counts


@pytest.mark.slow
def test_ten_thousand_mutations(tmp_path: Path) -> None:
    counts = run(tmp_path / "replay", range(1000, 11_000))
    assert min(counts.values()) > 0, counts
