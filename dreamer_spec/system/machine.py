"""What machine and which software a run or a measurement had."""

import importlib.metadata
import os
import platform
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path

PACKAGES = (
    *("dreamer-spec", "numpy", "jax", "jaxlib", "optax", "torch", "gymnasium"),
    *("dm-control", "mujoco", "ale-py", "box2d", "safetensors", "tensorboard", "wandb"),
)
ROOT = Path(__file__).resolve().parents[2]


def describe() -> dict[str, object]:
    """Processor, cores, memory, accelerator, operating system, versions and the commit, in plain JSON types."""
    memory = physical_memory()
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": None if memory is None else round(memory / 2**30, 1),
        "accelerator": accelerator(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": versions(PACKAGES),
        "commit": _commit(),
        "date": time.strftime("%Y-%m-%d"),
    }


def physical_memory() -> int | None:
    """Bytes; None where the system does not say (Windows)."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def accelerator() -> str | None:
    """Name, memory and driver of the first NVIDIA device."""
    command = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    return (_output(command) or "").partition("\n")[0] or None


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Of those that are installed."""
    return {name: version for name in packages if (version := _version(name))}


def own_version() -> str:
    """Of dreamer-spec; unknown where it was not installed."""
    return _version("dreamer-spec") or "unknown"


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Of this code, if it runs from a clone; an installed package may lie inside a repository of somebody else."""
    return _output(["git", "-C", str(ROOT), "describe", "--always", "--dirty"]) if (ROOT / ".git").exists() else None


def _output(command: list[str]) -> str | None:
    """What a program prints, or None if it is not there or fails."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None
