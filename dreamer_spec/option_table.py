"""The options of a run as a table: what each is called, which values it takes, and what it means.

The command line (dreamer_spec/cli.py) and `make_options` (dreamer_spec/api.py) both read it. Defaults are written
elsewhere, once: in `Options`, dreamer_spec/presets.toml and spec/hyperparameters.toml.
"""

import argparse
import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from dreamer_spec import arguments as keywords
from dreamer_spec.errors import UserError
from dreamer_spec.kinds import (
    FLAG,
    GIB,
    NAMES,
    SECONDS,
    SEEDS,
    SWITCH,
    WORDS,
    Kind,
    choice,
    of_default,
    path,
    text,
    whole,
)
from dreamer_spec.options import (
    BACKENDS,
    DEFAULT_PRESET,
    DETER_DTYPES,
    EVAL_ENV,
    NONFINITE,
    PROCESSES,
    RESUME,
    TRAIN_WHEN,
    default_logdir,
    defaults,
    did_you_mean,
    presets,
)
from spec import built_profiles, hyperparameters, profiles, sizes

ENV_ARG = Kind(
    "keyword arguments, their values numbers, texts, lists and dicts as JSON has them",
    "NAME=VALUE",
    keywords.checked,
    keywords.read,
)
LOGDIR = path("a folder", "DIR")
RUN = path("a run or a checkpoint", "RUN")


@dataclasses.dataclass(frozen=True)
class Option:
    """meaning: for `--help`, without the default. default: in words, where it is no value. begins: whether only a run
    that begins has it, and none that `train resume` continues."""

    name: str
    kind: Kind
    meaning: str
    default: str | None = None
    begins: bool = False

    @property
    def flag(self) -> str:
        """from_ -> --from"""
        return f"--{self.name.rstrip('_').replace('_', '-')}"

    @property
    def help(self) -> str:
        """Meaning and default."""
        value = defaults().get(self.name)
        if self.default is None and (value is None or isinstance(value, bool) or value == ()):
            return self.meaning
        return f"{self.meaning} (default{f': {self.default}' if self.default else f' {show(value)}'})"

    @property
    def settings(self) -> dict[str, Any]:
        """How argparse reads it. Nothing has a default there: what is not given comes from the preset."""
        common = {"dest": self.name, "help": self.help.replace("%", "%%")}
        if self.kind is FLAG:
            return {**common, "action": argparse.BooleanOptionalAction}
        if self.kind is SWITCH:
            return {**common, "action": "store_true", "default": None}
        if self.kind is ENV_ARG:
            return {**common, "type": keywords.read, "action": "append", "metavar": self.kind.metavar}
        return {**common, "type": self.kind.of_text, "metavar": self.kind.metavar, "choices": self.kind.choices}


def show(value: Any) -> str:
    """A default as a command line writes it, but for the commas in thousands."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return ",".join(map(str, value))
    if isinstance(value, float):
        return f"{value:g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _presets() -> str:
    return "; ".join(f"{name}: {preset['help']}" for name, preset in presets().items() if name != "base")


RUN_OPTIONS = {
    "run": (
        Option("backend", choice(BACKENDS), "which implementation trains"),
        Option(
            "preset",
            text("NAME"),
            f"named settings, which other options override. {_presets()}",
            f"{DEFAULT_PRESET} if no task is given",
            begins=True,
        ),
        Option(
            "seeds",
            SEEDS,
            "several runs, one after the other: 0-4 or 0,2,5; with --logdir, in DIR/seedN",
            begins=True,
        ),
        Option(
            "logdir",
            LOGDIR,
            "metrics, checkpoint and picture",
            str(default_logdir("TASK", "BACKEND", "N")),
            begins=True,
        ),
        Option("from_", RUN, "a new run begins with the parameters of this one, or of a checkpoint", begins=True),
        Option(
            "resume",
            choice(RESUME),
            "auto: continue the run in the log directory if there is one; never, must: or else an error",
            begins=True,
        ),
        Option(
            "task",
            text("SUITE:NAME"),
            "a task of a suite, played by its protocol (`train tasks` lists them), gym:ID or MODULE:CALLABLE",
        ),
        Option("size", choice(sizes(), "SIZE"), f"model size: {', '.join(sizes())}"),
        Option("profile", choice(profiles(), "PROFILE"), f"{', '.join(built_profiles())}; see docs/editions.md"),
        Option("steps", whole(1), "environment steps, with action repeat"),
        Option("seed", whole(0), "seed of everything random"),
        Option("device", text("NAME"), "cpu, gpu, cuda:1, ...", "the backend's choice"),
        Option("threads", whole(1), "that compute on the CPU", "by backend, model size and cores; see docs/runs.md"),
        Option(
            "nonfinite",
            choice(NONFINITE),
            "after a loss or gradient that is not finite: stop, and save what `train inspect` shows, or skip the "
            "update",
        ),
        Option("preflight", FLAG, "--no-preflight: skip the check of the backend before training"),
        Option("wandb", text("PROJECT"), "log to Weights & Biases too (pip install 'dreamer-spec[wandb]')"),
    ),
    "environments": (
        Option(
            "env_arg",
            ENV_ARG,
            "keyword argument of a Gymnasium id or a CALLABLE, the value as JSON or else as text; one option for each",
        ),
        Option(
            "time_limit",
            whole(1),
            "steps of the environment, before action repeat, that truncate an episode",
            "the suite's limit",
        ),
        Option("action_repeat", whole(1), "apply each action N times"),
        Option("image_size", whole(1), "side to which images are resized, in pixels"),
        Option("observations", WORDS, "use only these keys; `*` stands for any letters", "all"),
        Option("leave_out", WORDS, "do not use these keys of the observations"),
        Option("processes", choice(PROCESSES), "one process per environment; auto: if its steps are slow"),
        Option("env_timeout", SECONDS, "a process that takes longer for a step is restarted"),
        Option("env_failures", whole(0), "failures of environments, per 100,000 steps, that end the run"),
        Option(
            "restore_envs",
            FLAG,
            "--no-restore-envs: a resumed run begins new episodes; otherwise it repeats the actions of those under "
            "way. For environments that must not or cannot repeat them",
        ),
        Option(
            "info_metrics",
            NAMES,
            "numbers in the info of an episode's last step to log: is_success, or a/b for info['a']['b'], or a/* for "
            "all in it",
        ),
    ),
    "replay": (
        Option("replay_memory", GIB, "memory that maps the files of the buffer"),
        Option("replay_deter", choice(DETER_DTYPES), "precision of the latents in the buffer"),
    ),
    "schedule": (
        Option("eval_every", whole(0), "environment steps between evaluations; 0: at the end only"),
        Option(
            "eval_env",
            choice(EVAL_ENV),
            "shared: evaluations are played in the single environment of training, when its episode has ended",
        ),
        Option(
            "train_when",
            choice(TRAIN_WHEN),
            "between-episodes: train steps that become due wait until the episode of the single environment has ended",
        ),
        Option("eval_episodes", whole(0), "episodes of an evaluation; 0: none"),
        Option("random_episodes", whole(0), "episodes that measure a random policy first"),
        Option("checkpoint_every", SECONDS, "time between checkpoints"),
        Option("keep_checkpoints", whole(1), "the newest ones that stay on the disk"),
        Option("log_every", SECONDS, "time between lines of metrics"),
    ),
}

EPISODES = 10
EVAL_OPTIONS = (  # of `train eval`
    Option("episodes", whole(1), "how many", str(EPISODES)),
    Option("backend", choice(BACKENDS), "which implementation acts", "the one that trained last"),
    Option("device", text("NAME"), "cpu, gpu, cuda:1, ...", "the backend's choice"),
    Option("seed", whole(0), "of environments and actions; never those of the run"),
    Option(
        "task",
        text("SUITE:NAME"),
        "play this task instead; needed where the checkpoint names a module, whose code would run",
    ),
    Option(
        "env_arg",
        ENV_ARG,
        "keyword argument of the environment in place of that of training, the value as JSON or else as text; one "
        "option for each",
    ),
    Option("time_limit", whole(1), "steps of the environment that truncate an episode", "that of training"),
    Option("processes", choice(PROCESSES), "one process per environment; auto: if its steps are slow"),
    Option("mode", SWITCH, "the most probable action instead of a sample; latents are sampled all the same"),
    Option(
        "video",
        path("a file", "FILE"),
        "a film of the first episode of environment 0: FILE.gif or FILE.mp4",
    ),
)

HYPERPARAMETER_GROUPS = {  # of spec/hyperparameters.toml
    "general": "hyperparameters: batches",
    "model": "hyperparameters: networks",
    "world_model": "hyperparameters: world model learning",
    "behavior": "hyperparameters: actor and critic learning",
    "optimizer": "hyperparameters: optimizer",
    "loop": "hyperparameters: replay and environments",
}


def options_by_group() -> dict[str, tuple[Option, ...]]:
    """Title -> options, as `--help` shows them."""
    entries = hyperparameters().items()
    return RUN_OPTIONS | {
        title: tuple(_hyperparameter(name, entry) for name, entry in entries if entry["group"] == group)
        for group, title in HYPERPARAMETER_GROUPS.items()
    }


def checked(given: Mapping[str, Any], options: Iterable[Option]) -> dict[str, Any]:
    """Values of Python by name, each as its option has it; None is left out, which stands for not given.

    Raises:
      UserError: a value of another kind, or a name that is no option's.
    """
    known = {option.name: option.kind for option in options}
    for name in given:
        if name not in known:
            raise UserError(f"unknown option {name}{did_you_mean(name, known)}")
    return {name: known[name].of_value(name, value) for name, value in given.items() if value is not None}


def _hyperparameter(name: str, entry: Mapping[str, Any]) -> Option:
    symbol = f", {entry['symbol']}" if "symbol" in entry else ""
    kind = choice(entry["choices"], "NAME") if "choices" in entry else of_default(entry["value"])
    return Option(name, kind, f"{entry['help']}{symbol}{_default(name, entry)}")


def _default(name: str, entry: Mapping[str, Any]) -> str:
    default = "by --size" if any(name in size for size in sizes().values()) else show(entry["value"])
    others = [
        f"; {profile}: {show(profiles()[profile][name])}" for profile in built_profiles() if name in profiles()[profile]
    ]
    return f" (default {default}{''.join(others)})"
