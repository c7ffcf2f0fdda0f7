"""`train tasks [SUITE]`: the suites, what must be installed for each, and the protocol and tasks of one."""

import argparse
import importlib.util
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from dreamer_spec.cli import Parser
from dreamer_spec.errors import UserError
from dreamer_spec.options import did_you_mean
from dreamer_spec.suites import SUITES, install, of_the_paper, protocol, show, tasks_of
from spec import benchmarks, built_profiles

DESCRIPTION = """List the suites of tasks that `--task SUITE:NAME` names, or the protocol and the tasks of one.

  train tasks
  train tasks atari100k"""

BESIDE = ("env", "tasks", "others", "ours")


def main(arguments: Sequence[str]) -> int:
    """Runs the command.

    Raises:
      UserError: no such suite.
    """
    parser = Parser(prog="train tasks", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", nargs="?", metavar="SUITE", help="one of them: its protocol and its tasks")
    suite = parser.parse_args(arguments).suite
    console = Console(highlight=False, markup=False)
    if suite is None:
        console.print(_suites())
        console.print("Any other task: gym:ID, or your own function, MODULE:CALLABLE (docs/environments.md).")
    elif suite not in SUITES:
        raise UserError(f"unknown suite {suite!r}{did_you_mean(suite, SUITES)}; known: {', '.join(SUITES)}")
    else:
        _show(console, suite)
    return 0


def _suites() -> Table:
    view = Table(box=box.SIMPLE)
    for column in ("suite", "what it is", "tasks", "budget", "install"):
        view.add_column(column, justify="right" if column in ("tasks", "budget") else "left", overflow="fold")
    for suite in SUITES:
        found, tasks = benchmarks().get(suite, {}), tasks_of(suite)
        budget = f"{found['steps']:,}" if "steps" in found else ""
        title = found.get("title", "") + ("" if of_the_paper(suite) else " (not in the paper)")
        view.add_row(suite, title, str(len(tasks) or ""), budget, _installed(suite))
    return view


def _installed(suite: str) -> str:
    missing = [package for package in SUITES[suite].needs if importlib.util.find_spec(package) is None]
    return install(suite) if missing else "installed"


def _show(console: Console, suite: str) -> None:
    view = Table(box=box.SIMPLE)
    view.add_column("")
    profiles = built_profiles()
    for profile in profiles:
        view.add_column(profile)
    entries = [_flat(protocol(suite, profile)) for profile in profiles]
    for name in dict.fromkeys(name for entry in entries for name in entry):
        view.add_row(name, *(show(entry.get(name, "")) for entry in entries))
    console.print(view)
    console.print(f"{_installed(suite)}; `--env-arg NAME=VALUE` changes what begins with env.")
    if not of_the_paper(suite):
        console.print("The paper does not have this suite: the protocol is ours, whatever the profile.")
    for task in tasks_of(suite):
        console.print(f"{suite}:{task}{_configurations(suite, task)}")
    if others := benchmarks().get(suite, {}).get("others"):
        console.print(f"and {others}")


def _configurations(suite: str, task: str) -> str:
    """/0 to /19, 10,000 episodes each; empty where a task is one."""
    entry = benchmarks().get(suite, {}).get("experiments", {}).get(task)
    return f"/0 to /{entry['configurations'] - 1}, {entry['episodes']:,} episodes each" if entry else ""


def _flat(found: dict[str, object]) -> dict[str, object]:
    """{"env": {"noops": 0}} -> {"env.noops": 0}, without lists, tables and what is said beside the table."""
    arguments = found.get("env")
    assert arguments is None or isinstance(arguments, dict)
    plain = {name: value for name, value in found.items() if name not in BESIDE and not isinstance(value, dict | list)}
    return plain | {f"env.{name}": value for name, value in (arguments or {}).items()}
