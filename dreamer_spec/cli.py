"""The command `train`: options in, a run out, and one line for every mistake that the user can mend."""

import sys

from dreamer_spec.system import before_numpy  # noqa: F401

try:
    from dreamer_spec import own_packages  # noqa: F401
except ImportError as error:
    print(f"train: error: {error}", file=sys.stderr)
    sys.exit(2)

# isort: split
import argparse
import importlib
import importlib.util
import os
import re
import shlex
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from conformance.errors import say_error
from conformance.output import never_fail
from dreamer_spec import arguments as keywords
from dreamer_spec.commands import COMMANDS
from dreamer_spec.errors import UserError, is_out_of_memory
from dreamer_spec.option_table import options_by_group
from dreamer_spec.options import BACKENDS, Options, assemble_options, did_you_mean, of_seeds
from dreamer_spec.system.machine import own_version
from dreamer_spec.system.signals import stoppable
from spec import hyperparameters

USAGE = "train --backend {jax,torch} [options]\n       train COMMAND ... (train COMMAND --help says more)"
DESCRIPTION = """Train a DreamerV3 agent.

  train --backend jax                                            the default task, in minutes
  train --backend torch --task gym:Acrobot-v1 --size tiny        any Gymnasium id
  train --backend jax --task dmc:cheetah-run                     the paper's protocol; `train tasks` lists suites
  train --backend jax --task my_module:make_env --preset laptop  your own: a function that returns a gymnasium.Env

The same command again continues the run in its log directory. Commands for what it leaves there:

""" + "\n".join(f"  train {name:8}{what}" for name, what in COMMANDS.items())


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command. Returns the exit code: 0, or 2 after a UserError, or 130 after Ctrl-C or another signal."""
    never_fail()
    try:
        with stoppable():
            return _run(sys.argv[1:] if arguments is None else arguments)
    except UserError as error:
        say_error("train", error)
        return 2
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        remedy = "use a smaller --size, --batch-size, --image-size or --replay-memory, or fewer --envs"
        print(
            f"train: error: there is not enough memory: {' '.join(str(error).split())[:300]}; {remedy}", file=sys.stderr
        )
        return 2
    except KeyboardInterrupt as error:
        print(f"train: interrupted {error}".rstrip(), file=sys.stderr)
        return 130


def command() -> None:
    """The process of the command `train`. It ends when `main` does, whatever threads an environment has left behind."""
    code = main()
    left = [
        thread.name for thread in threading.enumerate() if thread is not threading.main_thread() and not thread.daemon
    ]
    if left:
        print(f"train: ending without {', '.join(left)}, which somebody's code has left running", file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _run(arguments: Sequence[str]) -> int:
    if arguments and not arguments[0].startswith("-"):
        name = arguments[0]
        if name not in COMMANDS:
            raise UserError(f"unknown command {name!r}{did_you_mean(name, COMMANDS)} (see train --help)")
        return importlib.import_module(f"dreamer_spec.commands.{name}").main(arguments[1:])
    runs = parse_runs(arguments)
    from dreamer_spec.training import (
        loop,
        seeds,
    )  # Only now: `--help` and mistakes in options shall not wait for Gymnasium.

    if len(runs) > 1:
        return seeds.run_all(runs, loop.run)
    return 0 if loop.run(runs[0]) else 130


def parse(arguments: Sequence[str]) -> Options:
    """The options of a command line that is one run.

    Raises:
      UserError: as `parse_runs`.
    """
    (options,) = parse_runs(arguments)
    return options


def parse_runs(arguments: Sequence[str]) -> list[Options]:
    """The options of a command line, one of each seed.

    Raises:
      UserError: no backend, an unknown option, or a value that is not of its kind.
    """
    values = vars(build_parser().parse_args(arguments))
    if values["backend"] is None:
        backend = next((name for name in BACKENDS if importlib.util.find_spec(name)), BACKENDS[0])
        what = "trains with these options" if arguments else "trains the default task"
        raise UserError(
            "--backend is missing, which says what trains: jax or torch. "
            f"`{shlex.join(['train', '--backend', backend, *arguments])}` {what}; `train "
            f"--help` lists commands and options"
        )
    seeds, single = values.pop("seeds"), values["seed"]
    if seeds is None:
        return [options_of(values)]
    if single is not None:
        raise UserError(f"--seed {single} and --seeds were given: one of them is enough")
    return of_seeds(options_of(values), seeds, values["logdir"] is not None)


def options_of(values: Mapping[str, Any]) -> Options:
    """The options of what the parser of `build_parser` has read: None for what was not given.

    Raises:
      UserError: a value that no run could have.
    """
    given = {name: value for name, value in values.items() if value is not None}
    if "env_arg" in given:
        given["env_arg"] = keywords.join(given["env_arg"])
    backend, preset = given.pop("backend"), given.pop("preset", None)
    overrides = {name: given.pop(name) for name in hyperparameters() if name in given}
    return assemble_options(backend, given, overrides, preset)


class Parser(argparse.ArgumentParser):
    """Mistakes are UserErrors. An option may be written with _ for -."""

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        arguments = [_with_dashes(argument) for argument in (sys.argv[1:] if args is None else args)]
        values, unknown = self.parse_known_args(arguments, namespace)
        if unknown:
            name = unknown[0].partition("=")[0]
            known = re.findall(r"(?<![\w-])--[a-z0-9-]+", self.format_help())
            self.error(
                f"unknown option {name}{did_you_mean(name, known)}" if name.startswith("-") else f"unexpected {name!r}"
            )
        return values

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


class Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=120)


def build_parser() -> argparse.ArgumentParser:
    """Every option without a default: what is not given comes from the preset, see dreamer_spec/options.py."""
    parser = Parser(prog="train", description=DESCRIPTION, formatter_class=Formatter, usage=USAGE, allow_abbrev=False)
    parser.epilog = "Where the pages docs/*.md are: conformance docs"
    parser.add_argument("--version", action="version", version=f"dreamer-spec {own_version()}")
    add_options(parser)
    return parser


def add_options(parser: argparse.ArgumentParser, begins: bool = True) -> None:
    """The options of a run. begins: those too with which `train` begins one, and which a run that `train resume`
    continues has already."""
    for title, options in options_by_group().items():
        group = parser.add_argument_group(title)
        for option in options:
            if begins or not option.begins:
                group.add_argument(option.flag, **option.settings)


def _with_dashes(argument: str) -> str:
    """--batch_size=8 -> --batch-size=8."""
    if not argument.startswith("--"):
        return argument
    name, separator, value = argument.partition("=")
    return name.replace("_", "-") + separator + value


if __name__ == "__main__":
    sys.exit(main())
