"""The suites of tasks that have a protocol: what a task of each is played with, and what must be installed.

The protocols are data, spec/benchmarks.toml. A suite that `--task` names gives a run its budget, model size, replay
ratio, instances and action repeat, and its environment its keyword arguments; a preset and options win over them.
"""

import dataclasses
import sys
from collections.abc import Mapping
from typing import Any

from spec import benchmarks, hyperparameters, sizes

RUN = ("steps", "action_repeat", "image_size", "time_limit", "size")
"""What a protocol says of a run, beside hyperparameters (of which it has `envs` and `replay_ratio`)."""

EVALUATIONS = 10  # within a budget; the paper's scores are those of training episodes


@dataclasses.dataclass(frozen=True)
class Suite:
    """module: in dreamer_spec.envs.suites, whose `make` makes a task. needs: the packages to import. extra: of ours,
    which installs them; "" where pip cannot. repeats, limits: whether `make` gets the action repeat, or the time limit,
    and sees to it by itself. command: what installs the packages where no extra can."""

    module: str
    needs: tuple[str, ...]
    extra: str
    repeats: bool = False
    limits: bool = False
    command: str = ""


# Without dependencies: those that the build for Python 3.11 and 3.12 names put NumPy back to version 1, though it runs
# with version 2; those for 3.13 are 400 MB that are not needed, and an older Pillow.
_PROCGEN = (
    (("procgen_gym",), "pip install --no-deps procgen-gym==0.1.1")
    if sys.version_info >= (3, 13)
    else (("procgen", "gym3", "cffi"), "pip install --no-deps procgen-mirror==0.10.7 gym3==0.3.3 cffi pycparser")
)


SUITES: Mapping[str, Suite] = {
    "atari": Suite("atari", ("ale_py",), "atari", repeats=True, limits=True),
    "atari100k": Suite("atari", ("ale_py",), "atari", repeats=True, limits=True),
    "procgen": Suite("procgen", _PROCGEN[0], "", command=_PROCGEN[1]),
    "dmlab": Suite("dmlab", ("deepmind_lab",), "", repeats=True, limits=True),
    "dmc": Suite("dm_control", ("dm_control",), "dm-control", repeats=True, limits=True),
    "dmc_vision": Suite("dm_control", ("dm_control",), "dm-control", repeats=True, limits=True),
    "bsuite": Suite("bsuite", ("bsuite",), "bsuite"),
    "crafter": Suite("crafter", ("crafter",), "crafter", limits=True),
    "minecraft": Suite("minecraft", ("minerl",), ""),
    "minigrid": Suite("minigrid", ("minigrid",), "minigrid"),
}


def suite_of(task: str) -> str | None:
    """The suite that a task names; None for `gym:` and for modules."""
    name, separator, rest = task.partition(":")
    return name if name in SUITES and separator and rest else None


def protocol(suite: str, profile: str) -> dict[str, Any]:
    """What benchmarks.toml says of a suite, as the profile has it; {} for one that is not there."""
    entry = benchmarks().get(suite, {})
    changed = entry.get(profile, {})
    merged = {**entry, **changed, "env": {**entry.get("env", {}), **changed.get("env", {})}}
    return {name: value for name, value in merged.items() if name != "official"}


def settings(task: str, profile: str) -> dict[str, Any]:
    """What its suite gives a run of a task: names of fields of Options, "size" and "hyperparameters"; {} without a
    suite."""
    suite = suite_of(task)
    found = protocol(suite, profile) if suite else {}
    if not found:
        return {}
    if steps := _steps(found, task.partition(":")[2]):
        found |= {"steps": steps}
    run = {name: found[name] for name in (*RUN, "info_metrics") if name in found}
    if "steps" in found:
        run |= {"eval_every": found["steps"] // EVALUATIONS, "random_episodes": 1}
    chosen = {name: found[name] for name in hyperparameters() if name in found}
    return {**run, "env_arg": found["env"], "hyperparameters": chosen}


def _steps(found: Mapping[str, Any], name: str) -> int | None:
    """The budget of a configuration EXPERIMENT/NUMBER that has one in episodes: their records, resets included, if all
    are as long as they can be. None where there is no such configuration, or the protocol knows none."""
    experiment, _, number = name.partition("/")
    entry, place = found.get("experiments", {}).get(experiment), number or "0"
    if entry is None or not (place.isascii() and place.isdigit() and int(place) < entry["configurations"]):
        return None
    longest = entry["longest"]
    steps: int = longest[int(place)] if isinstance(longest, list) else longest
    return entry["episodes"] * (steps + 1)


def in_words(task: str, values: Mapping[str, Any]) -> str | None:
    """A line that says how a run plays a task of a suite, and what the paper, or our protocol of a suite that it does
    not have, has instead; None without a protocol.

    values: of the run, by the names of `settings`; keyword arguments of the environment and hyperparameters among them.
    """
    paper = settings(task, "paper")
    if not paper:
        return None
    rows = {name: paper[name] for name in RUN if name in paper} | paper["hyperparameters"] | paper["env_arg"]
    values = {**values, "size": _size(values)}
    suite = suite_of(task)
    assert suite is not None
    whose = "paper" if of_the_paper(suite) else "protocol"
    words = (
        f"{name} {show(values.get(name))}" + ("" if values.get(name) == value else f" ({whose}: {show(value)})")
        for name, value in rows.items()
    )
    return f"protocol of {suite}: {', '.join(words)}"


def _size(values: Mapping[str, Any]) -> str:
    """The model size that has these hyperparameters."""
    found = (size for size, entry in sizes().items() if all(values.get(name) == entry[name] for name in entry))
    return next(found, "of its own")


def show(value: Any) -> str:
    """A value of a protocol in words."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:,}" if isinstance(value, int) else f"{value:g}" if isinstance(value, float) else str(value)


def of_the_paper(suite: str) -> bool:
    """Whether the paper has the suite; else what benchmarks.toml says of it is ours."""
    return not benchmarks().get(suite, {}).get("ours", False)


def tasks_of(suite: str) -> list[str]:
    """The tasks of a suite's protocol; [] for a suite that lists its own."""
    return list(benchmarks().get(suite, {}).get("tasks", []))


def install(suite: str) -> str:
    """How to get what a suite needs: a command, or the page that says it."""
    extra = SUITES[suite].extra
    return f"pip install 'dreamer-spec[{extra}]'" if extra else SUITES[suite].command or "see docs/suites.md"
