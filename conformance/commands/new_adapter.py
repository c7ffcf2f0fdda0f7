"""Write a commented skeleton of an adapter, ready to uncomment."""

import argparse
from pathlib import Path

from rich.console import Console

from conformance.errors import UserError
from conformance.skeleton import skeleton


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", nargs="?", type=Path, default=Path("my_adapter.py"), help="where to write it; never overwritten"
    )
    parser.add_argument("--short", action="store_true", help="only good first functions, and the others by name")


def main(console: Console, options: argparse.Namespace) -> int:
    try:
        with options.file.open("x", encoding="utf-8") as file:
            file.write(skeleton(options.file.name, options.short))
    except FileExistsError as error:
        raise UserError(f"{options.file} exists; give another name") from error
    except OSError as error:
        raise UserError(f"cannot write {options.file}: {error.strerror}") from error
    console.print(
        f"wrote {options.file}; uncomment what you offer, then: conformance check {options.file}",
        markup=False,
        highlight=False,
    )
    return 0
