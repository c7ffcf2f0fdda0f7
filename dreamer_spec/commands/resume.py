"""`train resume RUN`: continues a run with the options that it was started with, which run.json holds, but for those
given here."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dreamer_spec.cli import Formatter, Parser, add_options, build_parser, options_of
from dreamer_spec.disk.about import read_about
from dreamer_spec.disk.checkpoint import candidates
from dreamer_spec.errors import UserError
from dreamer_spec.options import Options, names_code

DESCRIPTION = """Continue a run from its newest checkpoint, with the options that it was started with.

  train resume runs/CartPole-v1-jax-seed0
  train resume runs/CartPole-v1-jax-seed0 --steps 40000 --learning-rate 1e-4

Options that are given here take the place of the run's own. What may change half way: --steps, how it is evaluated,
logged and saved, processes, the backend, the replay ratio, and the hyperparameters of world model learning, actor and
critic learning, and optimizer. run.json records every change. Log directory and seed are the run's. A task that is a
module of your own must be repeated with --task: it names code that would run."""


def main(arguments: Sequence[str]) -> int:
    """Runs the command. Returns the exit code.

    Raises:
      UserError: there is no run, or it cannot be continued with these options.
    """
    values = _parse(arguments)
    options = _options(values.pop("run"), {name: value for name, value in values.items() if value is not None})
    from dreamer_spec.training import loop

    return 0 if loop.run(options) else 130


def _parse(arguments: Sequence[str]) -> dict[str, Any]:
    usage = "train resume RUN [options]"
    parser = Parser(
        prog="train resume", description=DESCRIPTION, formatter_class=Formatter, usage=usage, allow_abbrev=False
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="its log directory")
    add_options(parser, begins=False)
    return vars(parser.parse_args(arguments))


def _options(run: Path, given: Mapping[str, Any]) -> Options:
    """Those in RUN/run.json, those given here winning. Nothing in the file is trusted: its command is read as if it had
    been typed."""
    about = read_about(run)
    command = about.get("command") if about else None
    if not isinstance(command, str):
        if run.parent.name == "checkpoints":
            raise UserError(f"{run} is a checkpoint; a run is continued from its log directory, {run.parent.parent}")
        raise UserError(
            f"{run} has no run.json that says how the run was started; expected the log directory of a run. To "
            f"continue one without it, "
            f"give all its options: train --backend ... --logdir {run}"
        )
    options = options_of({**_saved(run, command), **given, "logdir": run, "resume": "must"})
    if not candidates(run):
        raise UserError(
            f"{run} holds no checkpoint, so there is nothing to continue; the command that begins it: {command}"
        )
    if "task" not in given and names_code(options.task):
        raise UserError(
            f"{run} names the task {options.task}, which runs code of that module; if you "
            f"trust it, add --task {options.task}"
        )
    return options


def _saved(run: Path, command: str) -> dict[str, Any]:
    """What the parser reads of a run's own command."""
    try:
        values = vars(build_parser().parse_args(shlex.split(command)[1:]))
        if values.pop("seeds") is not None or values["backend"] is None:
            raise ValueError("it does not begin one run")
    except (UserError, ValueError, SystemExit) as error:  # A command may ask for help.
        raise UserError(f"the command in {run / 'run.json'} cannot be continued, {command!r:.200}: {error}") from error
    return values
