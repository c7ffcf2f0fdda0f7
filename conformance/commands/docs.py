"""List the pages of documentation, docs/*.md and the chapters spec/*.md, with the files that hold them here."""

import argparse

from rich.console import Console

from conformance.documents import pages


def add_arguments(parser: argparse.ArgumentParser) -> None:
    del parser


def main(console: Console, options: argparse.Namespace) -> int:
    del options
    found = pages()
    for name, path in found.items():
        console.print(f"{name:{max(map(len, found))}}  {path}", markup=False, highlight=False, soft_wrap=True)
    return 0
