"""The command `conformance`. Each of its commands is a module of conformance/commands."""

import argparse
import importlib
import sys
from collections.abc import Sequence

from rich.console import Console

from conformance import threads  # noqa: F401
from conformance.commands import COMMANDS
from conformance.errors import UserError, say_error
from conformance.output import never_fail
from conformance.own_names import require_ours


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 when everything that was asked holds, 1 when it does not, 2 for a wrong command line, 130 after
    Ctrl-C."""
    never_fail()
    try:
        require_ours()
    except ImportError as error:
        print(f"conformance: error: {error}", file=sys.stderr)
        return 2
    parser = argparse.ArgumentParser(
        prog="conformance", description="Checks an implementation of DreamerV3 against the specification."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    modules = {name.replace("_", "-"): importlib.import_module(f"conformance.commands.{name}") for name in COMMANDS}
    for name, module in modules.items():
        help_line = str(module.__doc__).splitlines()[0]
        command = commands.add_parser(
            name, help=help_line, description=help_line, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        )
        module.add_arguments(command)
    options = parser.parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 150)
    try:
        return modules[options.command].main(console, options)
    except UserError as error:
        say_error("conformance", error)
        return 2
    except KeyboardInterrupt:
        print("conformance: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
