"""Train several backends side by side from the same state, data and noise, and show how far they drift apart."""

import argparse
import math
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from conformance.candidate import load_candidate
from conformance.compare import DTYPES
from conformance.errors import UserError
from conformance.lockstep.bounds import bound
from conformance.lockstep.drift import GROUPS
from conformance.lockstep.plot import draw, figure_class
from conformance.lockstep.report import failures, report
from conformance.lockstep.run import MODES, Comparison, Lockstep
from conformance.lockstep.stream import PROBLEMS
from conformance.results import versions, write
from spec import built_profiles


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--backends",
        default="jax,torch,numpy",
        help="two or more of jax, torch, numpy, and adapters of your own: modules or .py files",
    )
    parser.add_argument("--steps", type=int, default=1000, help="train steps")
    parser.add_argument(
        "--problems", default=",".join(PROBLEMS), help="vector has discrete actions, image continuous ones"
    )
    parser.add_argument(
        "--dtype", choices=DTYPES, default="float64", help="precision of the backends; float64 has a bound"
    )
    parser.add_argument("--profile", choices=built_profiles(), default="paper", help="profile of the configuration")
    parser.add_argument("--seed", type=int, default=0, help="seed of parameters, data and noise")
    parser.add_argument(
        "--out", type=Path, default=None, metavar="FOLDER", help="write numbers and pictures to this folder, too"
    )


def main(console: Console, options: argparse.Namespace) -> int:
    if options.steps < 1:
        raise UserError(f"--steps: expected 1 or more, got {options.steps}")
    problems = options.problems.split(",")
    if unknown := [problem for problem in problems if problem not in PROBLEMS]:
        raise UserError(f"--problems: there is no {unknown[0]!r}; known: {', '.join(PROBLEMS)}")
    if options.out:
        figure_class()
        _make_folder(options.out)
    members = {name: load_candidate(name, options.dtype) for name in options.backends.split(",") if name}
    locksteps = {
        problem: Lockstep(members, problem, options.profile, options.dtype, options.seed) for problem in problems
    }
    begin = time.monotonic()
    try:
        _run(console, locksteps, options.steps)
    except KeyboardInterrupt:
        console.print("interrupted; what there is:")
    finished = all(lockstep.steps == options.steps for lockstep in locksteps.values())
    lines = [f"{problem}, {line}" for problem, lockstep in locksteps.items() for line in failures(lockstep)]
    for problem, lockstep in locksteps.items():
        _print(console, problem, lockstep)
    if options.out:
        _write(options, locksteps, time.monotonic() - begin)
    for line in lines:
        console.print(f"[bold red]beyond the bound:[/] {line}", highlight=False)
    if options.dtype != "float64":
        console.print(f"{options.dtype} has no bound: these numbers judge nobody")
    elif finished and not lines:
        console.print(f"every tensor stayed within its bound for {options.steps} steps")
    return 0 if finished and not lines else 1


def _make_folder(path: Path) -> None:
    """Before the run, which may take minutes."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def _run(console: Console, locksteps: dict[str, Lockstep], steps: int) -> None:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        for problem, lockstep in locksteps.items():
            task = progress.add_task(problem, total=steps)
            known: set[str] = set()
            for _ in range(steps):
                lockstep.step()
                progress.advance(task)
                for line in failures(lockstep):
                    if line not in known:
                        progress.console.print(f"{problem}, {line}", style="bold red", highlight=False)
                    known.add(line)


def _print(console: Console, problem: str, lockstep: Lockstep) -> None:
    for name, modes in lockstep.comparisons.items():
        parted = modes["free"].parted
        end = f"the samples part at step {parted}" if parted else "the samples never part"
        title = f"{problem}: {name} against {lockstep.baseline}, {lockstep.dtype}, {lockstep.steps} steps; {end}"
        table = Table(title=title, title_justify="left")
        for column in ("group", "worst, running free", "in", "worst, one step", "in"):
            table.add_column(column, overflow="fold")
        for group in GROUPS:
            table.add_row(group, *(cell for mode in MODES for cell in _cells(modes[mode], mode, group, lockstep.dtype)))
        console.print(table)


def _cells(comparison: Comparison, mode: str, group: str, dtype: str) -> tuple[str, str]:
    """The deviation, its share of the allowed one, and its step; the tensor."""
    if group not in comparison.worst:
        return "", ""
    step, tensor = comparison.worst[group]
    if tensor.deviation == 0:
        return "0", ""
    allowed = bound(tensor, step if mode == "free" else 1, dtype)
    share = f", {tensor.deviation / allowed:.2%} of allowed" if 0 < allowed < math.inf else ""
    return f"{tensor.deviation:.1e}{share}, step {step}", tensor.name


def _write(options: argparse.Namespace, locksteps: dict[str, Lockstep], seconds: float) -> None:
    found = {problem: report(lockstep) for problem, lockstep in locksteps.items() if lockstep.steps}
    settings: dict[str, Any] = {name: getattr(options, name) for name in ("backends", "dtype", "profile", "seed")}
    steps = {problem: lockstep.steps for problem, lockstep in locksteps.items()}
    stem = f"lockstep-{options.dtype}"
    write(
        options.out / f"{stem}.json",
        {**settings, "steps": steps, "seconds": round(seconds), "versions": versions(), "problems": found},
    )
    for problem, entry in found.items():
        title = f"Lockstep, problem {problem}, {options.dtype}, profile {options.profile}, seed {options.seed}"
        draw(options.out / f"{stem}-{problem}.png", entry, title, options.dtype == "float64")
