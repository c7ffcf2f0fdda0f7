"""List every requirement and what covers it; fails if one is not covered."""

import argparse
import textwrap

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from conformance.check import CHECKS
from conformance.coverage import coverage
from conformance.our_candidates import OUR_CANDIDATES
from conformance.requirements import check_label, requirements


def add_arguments(parser: argparse.ArgumentParser) -> None:
    del parser


def main(console: Console, options: argparse.Namespace) -> int:
    del options
    table, problems = coverage()
    view = Table()
    columns = (*OUR_CANDIDATES, "tests")
    for column in ("requirement", *columns, "text"):
        view.add_column(column, min_width=len(column))
    for requirement, covering in table.items():
        counts = (str(len(covering[column])) if column in covering else "-" for column in columns)
        text = textwrap.shorten(requirements()[requirement], 80, placeholder=" ...")
        names = dict.fromkeys(name for column in OUR_CANDIDATES for name in covering.get(column, ()))
        labels = [check_label(name, CHECKS[name].requirements) for name in names]
        view.add_row(requirement, *counts, escape("\n".join(filter(None, [text, ", ".join(labels)]))))
    console.print(view)
    for problem in problems:
        console.print(f"[bold red]{problem}")
    there = {column for covering in table.values() for column in covering}
    if absent := [column for column in OUR_CANDIDATES if column not in there]:
        console.print(f"not installed, so not looked at: {', '.join(absent)}")
    if "tests" not in there:
        unchecked = sum(not any(covering.values()) for covering in table.values())
        console.print(
            f"no tests here (an installed package has none): {unchecked} requirements "
            f"that no check covers are left to them"
        )
    console.print(f"{len(table)} requirements, {len(problems)} problems")
    return 1 if problems or not table else 0
