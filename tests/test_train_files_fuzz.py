"""Mutated checkpoints and policies: every outcome is what was written, another sound agent, or a clear error.

Half of the mutants get checksums that agree with them, as a forger's would. The mutants are loaded in a process of its
own with little memory: who believes a size before looking at it fails there. `python tests/test_train_files_fuzz.py
FIRST LAST` is that process.
"""

import collections
import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from file_mutations import mutate
from train_agents import save_checkpoint

from conformance.problems import random_observations, small_config
from dreamer_spec.disk.checkpoint import FILES, open_checkpoint
from dreamer_spec.disk.files import read_arrays, read_json
from dreamer_spec.disk.folders import seal
from dreamer_spec.disk.saved_agent import SavedAgent, agent_of
from dreamer_spec.errors import UserError
from dreamer_spec.policy import DESCRIPTION, PARAMETERS, Policy, save
from spec import Discrete, Image, Spaces, Vector

CONFIG = small_config("paper", "float32")
TASK = Spaces(
    {"position": Vector(3), "mode": Discrete((3, 2)), "image": Image(16, 16, 3)},
    {"arm": Vector(2), "buttons": Discrete((2, 3))},
)
MEMORY = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
HEADROOM = 256 * 2**20  # bytes of address space beyond those of the process before the first mutant
LONGEST = 20  # seconds for one mutant
LONGEST_MESSAGE = 1000  # characters


class TooLong(BaseException):
    """A mutant takes longer than LONGEST seconds. Not a TimeoutError: that is an OSError, which a loader takes for a
    damaged file."""


def same(one: SavedAgent, other: SavedAgent) -> bool:
    arrays = zip(one.parameters.items(), other.parameters.items(), strict=True)
    equal = all(name == other_name and a.tobytes() == b.tobytes() for (name, a), (other_name, b) in arrays)
    info = [{name: value for name, value in agent.info.items() if name != "source"} for agent in (one, other)]
    return (
        equal
        and info[0] == info[1]
        and (one.config, one.spaces, one.translation)
        == (
            other.config,
            other.spaces,
            other.translation,
        )
    )


def act(policy: Policy) -> None:
    """A few actions, which are finite or refused. Huge parameters overflow on their way there."""
    policy.reset(2)
    observation = random_observations(np.random.default_rng(0), policy.spaces, (2,))
    try:
        with np.errstate(all="ignore"):
            for first in (True, False):
                action = policy(observation, [first, True])
                assert np.isfinite(action).all()
                policy.environment_action(action)
            policy.observation([{key: value[row] for key, value in observation.items()} for row in range(2)])
    except ValueError:
        pass


def load_checkpoint(folder: Path) -> SavedAgent:
    checkpoint = open_checkpoint(folder)
    assert all(isinstance(array, np.ndarray) for array in checkpoint.loop.values())
    agent = agent_of(checkpoint)
    save(folder / "policy", agent)
    act(Policy.load(folder / "policy"))
    return agent


def load_policy(folder: Path) -> SavedAgent:
    policy = Policy.load(folder)
    act(policy)
    parameters = {name: array.astype(np.float32) for name, array in policy._parameters.items()}
    return SavedAgent(policy.config, policy.spaces, parameters, dict(policy.info), policy.translation)


@dataclasses.dataclass(frozen=True)
class Original:
    folder: Path
    names: tuple[str, ...]
    load: Callable[[Path], SavedAgent]


def originals(directory: Path) -> list[Original]:
    checkpoint = save_checkpoint(directory / "run", CONFIG, TASK, task="gym:Robot-v0", image_size=16)
    save(directory / "policy", agent_of(open_checkpoint(checkpoint)))
    return [
        Original(checkpoint, FILES, load_checkpoint),
        Original(directory / "policy", (PARAMETERS, DESCRIPTION), load_policy),
    ]


def outcome(original: Original, expected: SavedAgent, seed: int) -> tuple[str, str]:
    """Mutates a copy and loads it. Returns how it was mutated and what came of it.

    Raises:
      Whatever is neither a sound agent nor a UserError.
    """
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory(dir=MEMORY) as name:
        folder = Path(shutil.copytree(original.folder, Path(name) / original.folder.name))
        kind = mutate(folder, original.names, chance)
        forged = chance.random() < 0.7
        if forged:
            try:
                if not (folder / "SHA256SUMS").is_file():
                    os.unlink(folder / "SHA256SUMS")
                seal(folder, original.names)
            except (OSError, ValueError, UserError):
                forged = False
        try:
            agent = original.load(folder)
        except UserError as error:
            if len(str(error)) > LONGEST_MESSAGE:
                raise AssertionError(f"a message of {len(str(error))} characters") from None
            return kind, "refused"
        if same(agent, expected):
            return kind, "equal"
        assert forged, "a change that no checksum has noticed"
        return kind, "another"


def run(seeds: range) -> dict[str, Any]:
    """Counts of outcomes by kind of mutation, the greatest growth of memory in MiB, and the time in seconds."""
    import resource

    def too_long(*_: Any) -> None:
        raise TooLong(f"longer than {LONGEST} seconds")

    signal.signal(signal.SIGALRM, too_long)
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    with tempfile.TemporaryDirectory(dir=MEMORY) as name:
        chosen = originals(Path(name))
        expected = [
            original.load(Path(shutil.copytree(original.folder, Path(name) / f"copy{n}")))
            for n, original in enumerate(chosen)
        ]
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + HEADROOM, used + HEADROOM))
        resident, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
        for seed in seeds:
            signal.alarm(LONGEST)
            try:
                kind, result = outcome(chosen[seed % 2], expected[seed % 2], seed)
            except BaseException as error:
                raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}") from error
            counts[kind][result] += 1
        signal.alarm(0)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - resident) / 1024
    return {"counts": counts, "grown": grown, "seconds": time.monotonic() - start}


def mutants(first: int, last: int) -> collections.Counter[str]:
    command = [sys.executable, __file__, str(first), str(last)]
    root = str(Path(__file__).resolve().parent.parent)
    environment = {**os.environ, "PYTHONPATH": root, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-4000:]
    result = json.loads(done.stdout)
    total: collections.Counter[str] = sum(
        (collections.Counter(counts) for counts in result["counts"].values()), collections.Counter()
    )
    assert total.total() == last - first
    assert result["grown"] < 128, result
    return total


def safetensors_file(header: str, data: bytes = b"") -> bytes:
    return len(header).to_bytes(8, "little") + header.encode() + data


def array(dtype: str, shape: list[int], length: int) -> str:
    return f'"a": {{"dtype": "{dtype}", "shape": {shape}, "data_offsets": [0, {length}]}}'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            safetensors_file(f"{{{array('F32', [1], 4)}, {array('I32', [1], 4)}}}", b"1234"),
            "the name 'a' occurs more than once",
        ),
        (safetensors_file(f"{{{array('BF16', [2], 4)}}}", b"1234"), "'a' has the dtype BF16; expected one of F64, F32"),
        (safetensors_file(f"{{{array('F8_E4M3', [4], 4)}}}", b"1234"), "'a' has the dtype F8_E4M3"),
        (safetensors_file(f"{{{array('F32', [0, 2**62], 0)}}}"), "'a' has the shape .* expected at most 8 axes"),
        (safetensors_file(f"{{{array('F32', [1] * 70, 4)}}}", b"1234"), "'a' has the shape .* expected at most 8 axes"),
        (safetensors_file(f"{{{array('F32', [2**40], 2**42)}}}", b"1234"), "file not fully covered"),
        (
            safetensors_file(" " * 2**20 + "{}"),
            "the header says that it is 1,048,578 bytes long; expected at most 1,048,576",
        ),
        ((2**62).to_bytes(8, "little") + b"{}", "the header says that it is 4,611,686,018,427,387,904 bytes long"),
        (safetensors_file('{"a":' * 10_000), "recursion"),
        (b"", "header"),
    ],
)
def test_what_safetensors_would_let_through_is_refused(content: bytes, message: str, tmp_path: Path) -> None:
    """Its parser checks sizes, but not dtypes that NumPy lacks, sides that no array has, names that occur twice, and
    long headers."""
    path = tmp_path / "file.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_arrays(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "b": {"c": 1, "c": 1}}', "the name 'c' occurs more than once"),
        ("[" * 100_000, "recursion"),
        ("[]", "holds a list; expected an object"),
        ('{"a": 9223372036854775808}', "9223372036854775808 is not a number of 64 bits"),
        ('{"a": "\\ud800"}', "surrogates not allowed"),
        (" " * 2**20 + "{}", "longer than 1,048,576 bytes"),
    ],
)
def test_json_that_is_not_plain_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_json(path)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes in folders")
@pytest.mark.parametrize("read", [read_json, read_arrays])
def test_a_pipe_is_not_waited_for(read: Callable[[Path], Any], tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe is not a file"):
        read(tmp_path / "pipe")


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does")
def test_mutated_files_are_refused_or_sound() -> None:
    assert set(mutants(0, 300)) == {"refused", "equal", "another"}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does")
def test_ten_thousand_mutations() -> None:
    assert set(mutants(1000, 11_000)) == {"refused", "equal", "another"}


if __name__ == "__main__":
    print(json.dumps(run(range(int(sys.argv[1]), int(sys.argv[2])))))
