"""What the control groups of a container allow this process. Versions 1 and 2; nothing is said elsewhere than on
Linux."""

from collections.abc import Iterator
from pathlib import Path

ROOT, MEMBERSHIP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def quotas(root: Path = ROOT, membership: Path = MEMBERSHIP) -> list[float]:
    """Limits of CPU time, in cores."""
    result = []
    for folder, version in _groups("cpu", root, membership):
        if version == 1:
            words = [word for name in ("quota", "period") for word in _words(folder / f"cpu.cfs_{name}_us")]
        else:
            words = _words(folder / "cpu.max")
        if len(words) == 2 and all(word.isdecimal() for word in words) and int(words[1]):  # No limit: -1 or "max".
            result.append(int(words[0]) / int(words[1]))
    return result


def memory_limits(root: Path = ROOT, membership: Path = MEMBERSHIP) -> list[int]:
    """Limits of memory, in bytes. Version 1 says a huge number where there is none."""
    result = []
    for folder, version in _groups("memory", root, membership):
        words = _words(folder / ("memory.limit_in_bytes" if version == 1 else "memory.max"))
        result += [int(word) for word in words if word.isdecimal()]
    return result


def _groups(controller: str, root: Path, membership: Path) -> Iterator[tuple[Path, int]]:
    """The folders of this process's groups, each with all around it, and the version that they are of."""
    try:
        lines = membership.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return
    for line in lines:
        _, controllers, group = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = root / controller if controllers else root
        folder = top / group.strip("/")
        yield from (
            (place, 1 if controllers else 2) for place in (folder, *folder.parents) if place.is_relative_to(top)
        )


def _words(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError):
        return []
