"""The command `train`: options in, a run out, and one line for every mistake that the user can mend."""

from dreamer_spec.system import before_numpy  # noqa: F401

# isort: split
import argparse
import importlib
import importlib.util
import os
import re
import shlex
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from conformance.errors import say_error
from conformance.output import never_fail
from dreamer_spec import arguments as keywords
from dreamer_spec.commands import COMMANDS
from dreamer_spec.errors import UserError, is_out_of_memory
from dreamer_spec.options import (
    DEFAULT_PRESET,
    EVAL_ENV,
    NONFINITE,
    PROCESSES,
    RESUME,
    TRAIN_WHEN,
    Options,
    did_you_mean,
    make_options,
    of_seeds,
    presets,
)
from dreamer_spec.replay.layout import DETER_DTYPES
from dreamer_spec.system.machine import own_version
from dreamer_spec.system.signals import stoppable
from spec import built_profiles, hyperparameters, profiles, sizes

BACKENDS = ("jax", "torch")
LONGEST, LARGEST = 1e9, 1e9  # seconds, GiB: more than anybody means, and less than the system refuses
USAGE = "train --backend {jax,torch} [options]\n       train COMMAND ... (train COMMAND --help says more)"
DESCRIPTION = """Train a DreamerV3 agent.

  train --backend jax                                            the default task, in minutes
  train --backend torch --task gym:Acrobot-v1 --size tiny        any Gymnasium id
  train --backend jax --preset dmc_proprio --task dmc:cheetah-run    the paper's protocol
  train --backend jax --task my_module:make_env --preset laptop  your own: a function that returns a gymnasium.Env

The same command again continues the run in its log directory. Commands for what it leaves there:

""" + "\n".join(f"  train {name:8}{what}" for name, what in COMMANDS.items())

GROUPS = {
    "general": "hyperparameters: batches",
    "model": "hyperparameters: networks",
    "world_model": "hyperparameters: world model learning",
    "behavior": "hyperparameters: actor and critic learning",
    "optimizer": "hyperparameters: optimizer",
    "loop": "hyperparameters: replay and environments",
}


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
    return make_options(backend, given, overrides, preset)


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
    base = presets()["base"]

    run = parser.add_argument_group("run")
    run.add_argument("--backend", choices=BACKENDS, help="which implementation trains")
    if begins:
        _add_beginning(run.add_argument)
    run.add_argument(
        "--task",
        metavar="SUITE:NAME",
        help="gym:ID, dmc:DOMAIN-TASK (vectors), dmc_vision:DOMAIN-TASK (images) or MODULE:CALLABLE",
    )
    run.add_argument(
        "--size",
        choices=list(sizes()),
        metavar="SIZE",
        help=f"model size: {', '.join(sizes())} (default {base['size']})",
    )
    run.add_argument(
        "--profile",
        choices=list(profiles()),
        metavar="PROFILE",
        help=f"{', '.join(built_profiles())} (default {base['profile']}); see docs/editions.md",
    )
    run.add_argument(
        "--steps",
        type=_whole(1),
        metavar="N",
        help=f"environment steps, with action repeat (default {base['steps']:,})",
    )
    run.add_argument("--seed", type=_whole(0), metavar="N", help="seed of everything random (default 0)")
    run.add_argument("--device", metavar="NAME", help="cpu, gpu, cuda:1, ... (default: the backend's choice)")
    run.add_argument(
        "--threads",
        type=_whole(1),
        metavar="N",
        help="that compute on the CPU (default: by backend, model size and cores; see docs/runs.md)",
    )
    run.add_argument(
        "--nonfinite",
        choices=NONFINITE,
        help=(
            "after a loss or gradient that is not finite: stop, and save what `train inspect` "
            "shows (default), or skip the update"
        ),
    )
    run.add_argument(
        "--preflight",
        action=argparse.BooleanOptionalAction,
        help="--no-preflight: skip the check of the backend before training",
    )

    run.add_argument(
        "--wandb", metavar="PROJECT", help="log to Weights & Biases too (pip install 'dreamer-spec[wandb]')"
    )

    envs = parser.add_argument_group("environments")
    envs.add_argument(
        "--env-arg",
        type=keywords.read,
        action="append",
        metavar="NAME=VALUE",
        help="keyword argument of a Gymnasium id or a CALLABLE, the value as JSON or else as text; one option for each",
    )
    envs.add_argument(
        "--time-limit",
        type=_whole(1),
        metavar="N",
        help="steps of the environment, before action repeat, that truncate an episode (default: the suite's limit)",
    )
    envs.add_argument("--action-repeat", type=_whole(1), metavar="N", help="apply each action N times (default 1)")
    envs.add_argument(
        "--image-size", type=_whole(1), metavar="N", help="side to which images are resized, in pixels (default 64)"
    )
    envs.add_argument(
        "--observations",
        type=_words,
        metavar="KEY,...",
        help="use only these keys; `*` stands for any letters (default: all)",
    )
    envs.add_argument("--leave-out", type=_words, metavar="KEY,...", help="do not use these keys of the observations")
    envs.add_argument(
        "--processes", choices=PROCESSES, help="one process per environment; auto: if its steps are slow (default)"
    )

    envs.add_argument(
        "--env-timeout",
        type=_seconds,
        metavar="SECONDS",
        help="a process that takes longer for a step is restarted (default 600)",
    )
    envs.add_argument(
        "--env-failures",
        type=_whole(0),
        metavar="N",
        help="failures of environments, per 100,000 steps, that end the run (default 10)",
    )
    envs.add_argument(
        "--restore-envs",
        action=argparse.BooleanOptionalAction,
        help="--no-restore-envs: a resumed run begins new episodes; otherwise it "
        "repeats the actions of those under way. "
        "For environments that must not or cannot repeat them",
    )

    envs.add_argument(
        "--info-metrics",
        metavar="NAME,...",
        help=(
            "numbers in the info of an episode's last step to log: is_success, or a/b for "
            "info['a']['b'], or a/* for all in it"
        ),
    )

    replay = parser.add_argument_group("replay")
    replay.add_argument(
        "--replay-memory", type=_positive, metavar="GIB", help="memory that maps the files of the buffer (default 2)"
    )
    replay.add_argument(
        "--replay-deter", choices=DETER_DTYPES, help="precision of the latents in the buffer (default bfloat16)"
    )

    schedule = parser.add_argument_group("schedule")
    schedule.add_argument(
        "--eval-every",
        type=_whole(0),
        metavar="N",
        help=f"environment steps between evaluations; 0: at the end only (default {base['eval_every']:,})",
    )
    schedule.add_argument(
        "--eval-env",
        choices=EVAL_ENV,
        help=(
            "shared: evaluations are played in the single environment of training, when "
            "its episode has ended (default own)"
        ),
    )
    schedule.add_argument(
        "--train-when",
        choices=TRAIN_WHEN,
        help=(
            "between-episodes: train steps that become due wait until the episode of the single "
            "environment has ended (default always)"
        ),
    )
    schedule.add_argument(
        "--eval-episodes", type=_whole(0), metavar="N", help="episodes of an evaluation; 0: none (default 10)"
    )
    schedule.add_argument(
        "--random-episodes",
        type=_whole(0),
        metavar="N",
        help="episodes that measure a random policy first (default 10)",
    )
    schedule.add_argument(
        "--checkpoint-every", type=_seconds, metavar="SECONDS", help="time between checkpoints (default 300)"
    )
    schedule.add_argument(
        "--keep-checkpoints", type=_whole(1), metavar="N", help="the newest ones that stay on the disk (default 2)"
    )
    schedule.add_argument(
        "--log-every", type=_seconds, metavar="SECONDS", help="time between lines of metrics (default 5)"
    )

    groups = {name: parser.add_argument_group(title) for name, title in GROUPS.items()}
    for name, entry in hyperparameters().items():
        kind, metavar = _kind(entry)
        groups[entry["group"]].add_argument(
            f"--{name.replace('_', '-')}",
            dest=name,
            type=kind,
            metavar=metavar,
            choices=entry.get("choices"),
            help=_help(name, entry),
        )


def _add_beginning(add: Callable[..., Any]) -> None:
    """Which run: its preset, seeds, log directory and first parameters."""
    add("--preset", metavar="NAME", help=_preset_help())
    add(
        "--seeds",
        type=_seeds,
        metavar="N-M,...",
        help="several runs, one after the other: 0-4 or 0,2,5; with --logdir, in DIR/seedN",
    )
    add(
        "--logdir",
        type=_folder,
        metavar="DIR",
        help="metrics, checkpoint and picture (default runs/TASK-BACKEND-seedN)",
    )
    add(
        "--from",
        dest="from_",
        type=Path,
        metavar="RUN",
        help="a new run begins with the parameters of this one, or of a checkpoint",
    )
    add(
        "--resume",
        choices=RESUME,
        help="auto: continue the run in the log directory if there is one (default); never, must: or else an error",
    )


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
    others = "".join(
        f"; {profile}: {_show(profiles()[profile][name])}"
        for profile in built_profiles()
        if name in profiles()[profile]
    )
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
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a whole number{'' if least is None else f' of at least {least}'}"
            )
        return value

    return convert


def _real(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def _seconds(text: str) -> float:
    value = _real(text)
    if not 0 <= value <= LONGEST:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time in seconds, from 0 to {LONGEST:g}")
    return value


def _positive(text: str) -> float:
    value = _real(text)
    if not 0 < value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and up to {LARGEST:g}")
    return value


def _boolean(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither true nor false")
    return text.lower() == "true"


def _words(text: str) -> tuple[str, ...]:
    words = tuple(word for word in text.split(",") if word)
    if not words:
        raise argparse.ArgumentTypeError(f"{text!r} names no key")
    return words


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("the name of the folder is empty")
    return Path(text)


def _numbers(text: str) -> list[int]:
    return [_whole()(part) for part in text.split(",")]


def _seeds(text: str) -> list[int]:
    """0-2,5 -> [0, 1, 2, 5]"""
    seeds: list[int] = []
    for part in text.split(","):
        ends = re.fullmatch(r"([0-9]{1,15})(?:-([0-9]{1,15}))?", part.strip())
        first, last = (int(ends[1]), int(ends[2] or ends[1])) if ends else (0, -1)
        if not first <= last < first + 1000:
            raise argparse.ArgumentTypeError(f"{text!r} is no list of seeds such as 0-4 or 0,2,5, of at most 1,000")
        seeds += range(first, last + 1)
    if len(set(seeds)) < len(seeds):
        raise argparse.ArgumentTypeError(f"{text!r} names a seed twice")
    return seeds


if __name__ == "__main__":
    sys.exit(main())
