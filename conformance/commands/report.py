"""Join the results of several runs in one HTML page."""

import argparse
from pathlib import Path

from rich.console import Console

from conformance.reports import html
from conformance.results import read, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "results", nargs="+", type=Path, metavar="RESULT.json", help="what `conformance check --json` has written"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("conformance.html"), metavar="FILE", help="where to write the page"
    )


def main(console: Console, options: argparse.Namespace) -> int:
    write_text(
        options.out, html.render([read(path) for path in options.results], [str(path) for path in options.results])
    )
    console.print(f"wrote {options.out}", markup=False, highlight=False)
    return 0
