"""`train sweep FILE`: every combination of tasks, seeds and options, some at once, and one page at the end."""

import argparse
import contextlib
import shlex
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dreamer_spec.cli import Parser
from dreamer_spec.disk.logdir import hold
from dreamer_spec.errors import UserError
from dreamer_spec.report import page
from dreamer_spec.report.runs import find_logdirs, read_run
from dreamer_spec.sweeping.places import Processes, Ray
from dreamer_spec.sweeping.plan import Plan, read_plan
from dreamer_spec.sweeping.progress import last_lines, shown
from dreamer_spec.sweeping.runner import FAILED, INTERRUPTED, State, Sweep, log_of
from dreamer_spec.system.signals import stoppable
from dreamer_spec.words import counted

DESCRIPTION = """Train every combination of what a TOML file varies: tasks, seeds, backends, any option.

  train sweep control.toml
  train sweep control.toml --jobs 4
  train sweep control.toml --dry-run        what would run

The same command again continues: runs that have ended are not repeated, others go on from their
checkpoints. docs/sweeps.md says what the file holds."""


def main(arguments: Sequence[str]) -> int:
    """Runs the command. Returns the exit code: 0, 2 if a run failed, 130 after Ctrl-C.

    Raises:
      UserError: a file that is no sweep, or a log directory that cannot be written.
    """
    parser = Parser(prog="train sweep", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, metavar="FILE", help="what to run")
    parser.add_argument("--logdir", type=Path, metavar="DIR", help="in place of the file's")
    parser.add_argument("--jobs", type=int, metavar="N", help="runs at once, in place of the file's")
    parser.add_argument("--dry-run", action="store_true", help="print the commands and do nothing")
    options = parser.parse_args(arguments)
    plan = read_plan(options.file, options.logdir, options.jobs)
    if options.dry_run:
        for item in plan.items:
            print(shlex.join(["train", *item.command]))
        return 0
    return _run(plan, Console(highlight=False, markup=False))


def _run(plan: Plan, console: Console) -> int:
    with contextlib.ExitStack() as stack:
        hold(plan.logdir, stack)
        return _run_held(plan, console)


def _run_held(plan: Plan, console: Console) -> int:
    sweep = Sweep(plan, Processes(plan.jobs) if plan.ray is None else Ray(plan.ray))
    with stoppable() as signals, signals.polled(), shown(console) as show:
        code = sweep.run(signals, show)
    for state in sweep.states:
        if state.phase == FAILED:
            console.print(f"{state.item.name} failed: {_last_words(log_of(plan, state.item))}", soft_wrap=True)
    if code:
        console.print(
            f"{'interrupted' if code == INTERRUPTED else 'not all runs have ended'}; the same command continues",
            soft_wrap=True,
        )
    if path := _report(plan, sweep.states):
        console.print(f"{path}: {counted(len(plan.items), 'run')}", soft_wrap=True)
    return code


def _last_words(log: Path) -> str:
    lines = [line for line in last_lines(log) if line.strip()]
    return f"{lines[-1].decode('utf-8', 'replace').strip() if lines else 'it said nothing'} ({log})"


def _report(plan: Plan, states: list[State]) -> Path | None:
    """Writes the page about all runs; None where no run has anything to show."""
    path = plan.logdir / "report.html"
    logdirs = [state.item.options.logdir for state in states if state.item.options.logdir.exists()]
    try:
        runs = [read_run(logdir) for logdir in find_logdirs(logdirs)]
    except UserError:
        return None
    page.write(path, runs)
    return path
