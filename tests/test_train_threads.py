"""Threads: as many as the cores that a process may use, one for small models, and one in each environment's process."""

import functools
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import train_fakes
from train_fakes import FakeLearner
from train_runs import Make

from dreamer_spec.envs import ContractEnv
from dreamer_spec.system import cgroups, threads
from dreamer_spec.training import loop
from spec import Image, Spaces, Vector, load_config

VECTORS = Spaces({"observation": Vector(3)}, {"action": Vector(1)})
IMAGES = Spaces({"observation": Image(16, 16, 3)}, {"action": Vector(1)})


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*threads.VARIABLES.values(), "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(threads, "usable_cores", lambda: 6)


def chosen(backend: str, size: str, spaces: Spaces = VECTORS, wanted: int | None = None) -> int:
    return threads.choose(backend, load_config("paper", size), spaces, wanted)


@pytest.mark.parametrize(
    ("backend", "size", "spaces", "expected"),
    [
        ("torch", "tiny", VECTORS, 1),
        ("torch", "tiny", IMAGES, 5),
        ("torch", "1m", VECTORS, 5),
        ("jax", "tiny", VECTORS, 6),
        ("jax", "12m", IMAGES, 6),
    ],
)
def test_the_default_suits_model_and_cores(backend: str, size: str, spaces: Spaces, expected: int) -> None:
    assert chosen(backend, size, spaces) == expected


@pytest.mark.parametrize(("backend", "variable"), threads.VARIABLES.items())
def test_the_option_wins_over_the_environment_and_that_over_the_default(
    backend: str, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, "3")
    assert chosen(backend, "1m") == 3
    assert chosen(backend, "1m", wanted=2) == 2
    monkeypatch.setenv(variable, "many")
    assert chosen(backend, "1m") in (5, 6)


def test_a_single_core_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "usable_cores", lambda: 1)
    assert chosen("torch", "12m") == chosen("jax", "12m") == 1


def test_waiting_threads_soon_sleep_unless_the_user_has_decided(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    threads.spin_briefly()
    assert "GOMP_SPINCOUNT" not in os.environ
    monkeypatch.delenv("OMP_WAIT_POLICY")
    threads.spin_briefly()
    assert os.environ["GOMP_SPINCOUNT"] == "10000"
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    threads.spin_briefly()
    assert os.environ["GOMP_SPINCOUNT"] == "7"


def place(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("membership", "files", "expected"),
    [
        ("0::/\n", {}, 8),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 8),
        ("0::/\n", {"cpu.max": "350000 100000\n"}, 3),
        (
            "0::/pod/box\n",
            {"pod/box/cpu.max": "600000 100000\n", "pod/cpu.max": "250000 100000\n", "cpu.max": "max 100000\n"},
            2,
        ),
        ("0::/pod/box\n", {"cpu.max": "50000 100000\n"}, 1),
        (
            "3:cpuset:/\n1:cpu,cpuacct:/box\n0::/\n",
            {"cpu/box/cpu.cfs_quota_us": "400000\n", "cpu/box/cpu.cfs_period_us": "100000\n"},
            4,
        ),
        ("1:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ("0::/\n", {"cpu.max": "nonsense\n"}, 8),
    ],
)
def test_the_cores_of_a_container_are_those_of_its_quota(
    membership: str, files: dict[str, str], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # the real function
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    monkeypatch.setattr(os, "process_cpu_count", lambda: 8, raising=False)
    place(tmp_path / "cgroup", files)
    place(tmp_path, {"membership": membership})
    monkeypatch.setattr(
        cgroups, "quotas", functools.partial(cgroups.quotas, tmp_path / "cgroup", tmp_path / "membership")
    )
    assert threads.usable_cores() == expected


@pytest.mark.parametrize(
    ("membership", "files", "expected"),
    [
        ("0::/box\n", {"box/memory.max": "1073741824\n", "memory.max": "max\n"}, [2**30]),
        ("4:memory:/box\n0::/\n", {"memory/box/memory.limit_in_bytes": "2147483648\n"}, [2**31]),
        ("4:memory:/../box\n", {}, []),
    ],
)
def test_the_memory_of_a_container_is_that_of_its_limit(
    membership: str, files: dict[str, str], expected: list[int], tmp_path: Path
) -> None:
    place(tmp_path / "cgroup", files)
    place(tmp_path, {"membership": membership})
    assert cgroups.memory_limits(tmp_path / "cgroup", tmp_path / "membership") == expected
    assert cgroups.memory_limits(tmp_path / "nothing", tmp_path / "nowhere") == []


USED = {
    "torch": "import torch; print(torch.get_num_threads())",
    # JAX does not say how many: the threads of its pool are counted.
    "jax": "import pathlib; names = [f.read_text() for f in pathlib.Path('/proc/self/task').glob('*/comm')]; "
    "print(sum('Eigen' in name for name in names))",
}
LEARN = """
import sys
from spec import Spaces, Vector, load_config
from dreamer_spec.system import threads
from dreamer_spec.backend import learner_class
threads.spin_briefly()
Learner = learner_class(sys.argv[1])
spaces = Spaces({"x": Vector(3)}, {"a": Vector(1)})
Learner(spaces, load_config("paper", "tiny"), seed=0, device="cpu", threads=int(sys.argv[2]))
"""


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("backend", list(USED))
def test_a_backend_computes_with_so_many_threads(backend: str, count: int) -> None:
    command = [sys.executable, "-c", LEARN + USED[backend], backend, str(count)]
    result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parent.parent)
    assert int(result.stdout) >= 1
    assert int(result.stdout) == count


@pytest.mark.parametrize(
    ("given", "expected"), [({}, lambda cores: max(1, cores - 1)), ({"OPENBLAS_NUM_THREADS": "5"}, lambda cores: 5)]
)
def test_the_command_limits_numpy_before_it_is_imported(given: dict[str, str], expected: Callable[[int], int]) -> None:
    """Preflight took 42 s instead of 6 s on busy cores."""
    code = """
import sys
class Watching:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            import os
            print(os.environ.get("OPENBLAS_NUM_THREADS"))
sys.meta_path.insert(0, Watching())
import dreamer_spec.cli, numpy, dreamer_spec.system.threads
print(dreamer_spec.system.threads.usable_cores())
"""
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"} | given
    root = Path(__file__).parent.parent
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment, cwd=root
    )
    said, cores = map(int, result.stdout.split())
    assert said == expected(cores)


class Telling(train_fakes.Counting):
    """Shows how many threads its process is allowed to use for linear algebra."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.float32(
            [int(os.environ.get("OPENBLAS_NUM_THREADS", -1)), multiprocessing.parent_process() is not None]
        ), {}


def make_telling(index: int) -> ContractEnv:
    return ContractEnv(Telling(), "telling", index)


@pytest.mark.skipif(sys.platform == "win32", reason="worker processes are not forks of a server there")
def test_an_environment_has_one_thread_in_its_process() -> None:
    command = [
        sys.executable,
        "-c",
        "import test_train_threads as t\nfrom dreamer_spec.envs import Environments\nenvs = "
        "Environments(t.make_telling, 1, True)\n"
        "print(envs.reset([0])['observation'].tolist())\nenvs.close()",
    ]
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parent.parent)])
    result = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert result.stdout.strip() == "[[1.0, 1.0]]"


def test_the_start_line_says_the_threads(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    loop.run(make(threads=2), FakeLearner)
    assert "jax on cpu, 2 threads, 3,481 parameters" in capsys.readouterr().out
