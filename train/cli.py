"""The command `train`: options in, a run out, and one line for every mistake that the user can mend."""

import argparse
import importlib
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from spec import built_profiles, hyperparameters, profiles, sizes
from train.commands import COMMANDS
from train.errors import UserError
from train.options import DEFAULT_PRESET, NONFINITE, PROCESSES, RESUME, Options, make_options, presets
from train.replay.layout import DETER_DTYPES

DESCRIPTION = """Train a DreamerV3 agent.

  train --backend jax                                            the default task, in minutes
  train --backend torch --task gym:Acrobot-v1 --size tiny        any Gymnasium id
  train --backend jax --preset dmc_proprio --task dmc:cheetah-run    the paper's protocol
  train --backend jax --task my_module:make_env                  your own: a function that returns a gymnasium.Env

The same command again continues the run in its log directory."""

GROUPS = {
    "general": "hyperparameters: batches",
    "model": "hyperparameters: networks",
    "world_model": "hyperparameters: world model learning",
    "behavior": "hyperparameters: actor and critic learning",
    "optimizer": "hyperparameters: optimizer",
    "loop": "hyperparameters: replay and environments",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command. Returns the exit code: 0, or 2 after a UserError, or 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments and arguments[0] in COMMANDS:
            command = importlib.import_module(f"train.commands.{arguments[0]}")
            return command.main(arguments[1:])
        options = parse(arguments)
        if sys.platform == "win32":
            raise UserError("training does not run on Windows, whose files the replay buffer cannot use; it runs there in WSL 2")
        from train import loop  # Only now: `--help` and mistakes in options shall not wait for Gymnasium.

        return 0 if loop.run(options) else 130
    except UserError as error:
        if error.details:
            print(error.details.rstrip(), file=sys.stderr)
        print(f"train: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def parse(arguments: Sequence[str]) -> Options:
    """The options of a command line.

    Raises:
      UserError: an unknown option, or a value that is not of its kind.
    """
    values = vars(build_parser().parse_args([_with_dashes(argument) for argument in arguments]))
    given = {name: value for name, value in values.items() if value is not None}
    if "env_args" in given:
        given["env_args"] = dict(given["env_args"])
    backend, preset = given.pop("backend"), given.pop("preset", None)
    overrides = {name: given.pop(name) for name in hyperparameters() if name in given}
    return make_options(backend, given, overrides, preset)


class Parser(argparse.ArgumentParser):
    """Mistakes are UserErrors."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=120)


def build_parser() -> argparse.ArgumentParser:
    """Every option without a default: what is not given comes from the preset, see train/options.py."""
    parser = Parser(
        prog="train", description=DESCRIPTION, formatter_class=_Formatter, usage="train --backend {jax,torch} [options]", allow_abbrev=False
    )
    base = presets()["base"]

    run = parser.add_argument_group("run")
    run.add_argument("--backend", choices=["jax", "torch"], required=True, help="which implementation trains")
    run.add_argument("--preset", metavar="NAME", help=_preset_help())
    run.add_argument(
        "--task", metavar="SUITE:NAME", help="gym:ID, dmc:DOMAIN-TASK (vectors), dmc_vision:DOMAIN-TASK (images) or MODULE:CALLABLE"
    )
    run.add_argument("--size", choices=list(sizes()), metavar="SIZE", help=f"model size: {', '.join(sizes())} (default {base['size']})")
    run.add_argument(
        "--profile",
        choices=list(profiles()),
        metavar="PROFILE",
        help=f"{', '.join(built_profiles())} (default {base['profile']}); see docs/editions.md",
    )
    run.add_argument("--steps", type=_whole(1), metavar="N", help=f"environment steps, with action repeat (default {base['steps']:,})")
    run.add_argument("--seed", type=_whole(0), metavar="N", help="seed of everything random (default 0)")
    run.add_argument("--logdir", type=Path, metavar="DIR", help="metrics, checkpoint and picture (default runs/TASK-BACKEND-seedN)")
    run.add_argument("--device", metavar="NAME", help="cpu, gpu, cuda:1, ... (default: the backend's choice)")
    run.add_argument(
        "--resume",
        choices=RESUME,
        help="auto: continue the run in the log directory if there is one (default); never, must: or else an error",
    )
    run.add_argument(
        "--nonfinite",
        choices=NONFINITE,
        help="after a loss or gradient that is not finite: stop, and save what `train inspect` shows (default), or skip the update",
    )
    run.add_argument(
        "--no-preflight", dest="preflight", action="store_false", default=None, help="skip the check of the backend before training"
    )

    run.add_argument("--wandb", metavar="PROJECT", help="log to Weights & Biases too (pip install 'dreamer-spec[wandb]')")

    envs = parser.add_argument_group("environments")
    envs.add_argument("--action-repeat", type=_whole(1), metavar="N", help="apply each action N times (default 1)")
    envs.add_argument("--image-size", type=_whole(1), metavar="N", help="side to which images are resized, in pixels (default 64)")
    envs.add_argument(
        "--observations", type=_words, metavar="KEY,...", help="use only these keys; `*` stands for any letters (default: all)"
    )
    envs.add_argument("--leave-out", type=_words, metavar="KEY,...", help="do not use these keys of the observations")
    envs.add_argument(
        "--env-arg",
        dest="env_args",
        action="append",
        type=_assignment,
        metavar="NAME=VALUE",
        help="a keyword argument of gymnasium.make, the suite's task or your function; VALUE is read as JSON if it can be; may be repeated",
    )
    envs.add_argument(
        "--time-limit",
        type=_whole(1),
        metavar="N",
        help="end episodes after N frames, counted before action repeat; takes the place of a Gymnasium id's own limit",
    )
    envs.add_argument("--processes", choices=PROCESSES, help="one process per environment; auto: if its steps are slow (default)")

    envs.add_argument(
        "--env-timeout", type=_seconds, metavar="SECONDS", help="a process that takes longer for a step is made anew (default 600)"
    )
    envs.add_argument(
        "--env-failures", type=_whole(0), metavar="N", help="environments made anew, per 100,000 steps, that end the run (default 10)"
    )
    envs.add_argument(
        "--no-restore-envs",
        dest="restore_envs",
        action="store_false",
        default=None,
        help="a resumed run begins new episodes; otherwise it repeats the actions of those under way, and continues exactly. "
        "For environments that must not or cannot repeat them",
    )

    replay = parser.add_argument_group("replay")
    replay.add_argument("--replay-memory", type=_positive, metavar="GIB", help="memory that maps the files of the buffer (default 2)")
    replay.add_argument("--replay-deter", choices=DETER_DTYPES, help="precision of the latents in the buffer (default bfloat16)")

    schedule = parser.add_argument_group("schedule")
    schedule.add_argument(
        "--eval-every",
        type=_whole(0),
        metavar="N",
        help=f"environment steps between evaluations; 0: at the end only (default {base['eval_every']:,})",
    )
    schedule.add_argument("--eval-episodes", type=_whole(0), metavar="N", help="episodes of an evaluation; 0: none (default 10)")
    schedule.add_argument("--random-episodes", type=_whole(0), metavar="N", help="episodes that measure a random policy first (default 10)")
    schedule.add_argument("--checkpoint-every", type=_seconds, metavar="SECONDS", help="time between checkpoints (default 300)")
    schedule.add_argument("--keep-checkpoints", type=_whole(1), metavar="N", help="the newest ones that stay on the disk (default 2)")
    schedule.add_argument("--log-every", type=_seconds, metavar="SECONDS", help="time between lines of metrics (default 5)")

    groups = {name: parser.add_argument_group(title) for name, title in GROUPS.items()}
    for name, entry in hyperparameters().items():
        kind, metavar = _kind(entry)
        groups[entry["group"]].add_argument(
            f"--{name.replace('_', '-')}", dest=name, type=kind, metavar=metavar, choices=entry.get("choices"), help=_help(name, entry)
        )
    return parser


def _with_dashes(argument: str) -> str:
    """--batch_size=8 -> --batch-size=8."""
    if not argument.startswith("--"):
        return argument
    name, separator, value = argument.partition("=")
    return name.replace("_", "-") + separator + value


def _preset_help() -> str:
    entries = "; ".join(f"{name}: {preset['help']}" for name, preset in presets().items() if name != "base")
    return f"named settings, which other options override (default: {DEFAULT_PRESET} if no task is given). {entries}"


def _help(name: str, entry: dict[str, Any]) -> str:
    default = "by --size" if any(name in size for size in sizes().values()) else _show(entry["value"])
    others = "".join(f"; {profile}: {_show(profiles()[profile][name])}" for profile in built_profiles() if name in profiles()[profile])
    symbol = f", {entry['symbol']}" if "symbol" in entry else ""
    return f"{entry['help']}{symbol} (default {default}{others})".replace("%", "%%")


def _show(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return ",".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _kind(entry: dict[str, Any]) -> tuple[Callable[[str], Any], str]:
    """How the value of a hyperparameter is read, and what `--help` calls it. Its range is checked by spec/config.py."""
    value = entry["value"]
    if "choices" in entry:
        return str, "NAME"
    if isinstance(value, bool):
        return _boolean, "true|false"
    if isinstance(value, list):
        return _numbers, "N,N,..."
    return (_whole(), "N") if isinstance(value, int) else (_real, "X")


def _whole(least: int | None = None) -> Callable[[str], int]:
    def convert(text: str) -> int:
        try:
            number = float(text)
            value = int(number) if number.is_integer() and abs(number) < 2**53 else None
        except (ValueError, OverflowError):
            value = None
        if value is None or (least is not None and value < least):
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number{'' if least is None else f' of at least {least}'}")
        return value

    return convert


def _real(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def _seconds(text: str) -> float:
    value = _real(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time in seconds")
    return value


def _positive(text: str) -> float:
    value = _real(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def _boolean(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither true nor false")
    return text.lower() == "true"


def _words(text: str) -> tuple[str, ...]:
    return tuple(word for word in text.split(",") if word)


def _assignment(text: str) -> tuple[str, Any]:
    """is_slippery=false -> ("is_slippery", False)"""
    name, separator, value = text.partition("=")
    if not separator or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    try:
        return name, json.loads(value, parse_constant=str)
    except ValueError:
        return name, value


def _numbers(text: str) -> list[int]:
    return [_whole()(part) for part in text.split(",")]


if __name__ == "__main__":
    sys.exit(main())
