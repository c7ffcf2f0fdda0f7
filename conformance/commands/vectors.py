"""Write golden vectors, inputs and right results in files, for implementations in any language."""

import argparse
from pathlib import Path

from rich.console import Console

from conformance.vectors.writing import SETS, write_vectors
from spec import built_profiles


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="where to write them; an older set there is replaced"
    )
    parser.add_argument(
        "--set", choices=tuple(SETS), default="minimal", help="how much: under 1 MB, or all that the checks draw"
    )
    parser.add_argument("--profile", choices=built_profiles(), default="paper", help="profile of the configurations")
    parser.add_argument("--seed", type=int, default=0, help="seed of the drawn cases")
    parser.add_argument("--only", default="", help="only checks whose name or requirement id contains this")


def main(console: Console, options: argparse.Namespace) -> int:
    with console.status("recording") as status:
        index = write_vectors(options.out, options.set, options.profile, options.seed, options.only, status.update)
    cases = sum(len(entry.get("cases", ())) for entry in index["files"].values())
    size = sum(entry["bytes"] for entry in index["files"].values())
    console.print(
        f"{cases} cases, {size / 1e6:.2f} MB in {options.out}; the format: docs/vectors.md",
        markup=False,
        highlight=False,
    )
    console.print(f"{len(index['left_out'])} checks give no vector; index.json says in words what they ask, and why")
    return 0
