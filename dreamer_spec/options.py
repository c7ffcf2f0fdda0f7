"""What a run is: its options, made of [base], the suite of its task, a preset and the command line, later ones
winning."""

import dataclasses
import difflib
import functools
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from dreamer_spec import suites
from dreamer_spec.errors import UserError
from spec import Config, built_profiles, hyperparameters, load_config

BACKENDS = ("jax", "torch")
DEFAULT_PRESET = "cartpole"
RESUME = ("auto", "never", "must")
PROCESSES = ("auto", "yes", "no")
NONFINITE = ("stop", "skip")
CHANGEABLE_GROUPS = ("world_model", "behavior", "optimizer")  # of spec/hyperparameters.toml: [LOOP-70]
TRAIN_WHEN = ("always", "between-episodes")
EVAL_ENV = ("own", "shared")
DETER_DTYPES = ("bfloat16", "float32")  # of the latents in the buffer


@dataclasses.dataclass(frozen=True)
class Options:
    """Everything that a run depends on, beside the code.

    task: what names the environment. make: what makes it, where a script has given the callable itself; then the task
    is its name.
    steps and eval_every are environment steps: records times action_repeat. checkpoint_every, log_every and env_timeout
    are seconds. replay_memory is in GiB. env_arg: keyword arguments of the environment. time_limit: in frames, that is
    before action repeat. observations, leave_out: keys or patterns of keys that the agent gets and does not get, all
    where `observations` is empty. from_: a log directory or a checkpoint, whose parameters a new run begins with.
    """

    backend: str
    task: str
    config: Config
    logdir: Path
    steps: int
    make: Callable[..., Any] | None = None
    from_: Path | None = None
    seed: int = 0
    device: str | None = None
    threads: int | None = None
    env_arg: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    time_limit: int | None = None
    action_repeat: int = 1
    image_size: int = 64
    observations: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    eval_every: int = 0
    eval_episodes: int = 10
    random_episodes: int = 10
    checkpoint_every: float = 300.0
    log_every: float = 5.0
    resume: str = "auto"
    processes: str = "auto"
    env_timeout: float = 600.0
    env_failures: int = 10
    restore_envs: bool = True
    info_metrics: str | None = None
    train_when: str = "always"
    eval_env: str = "own"
    keep_checkpoints: int = 2
    nonfinite: str = "stop"
    wandb: str | None = None
    replay_memory: float = 2.0
    replay_deter: str = "bfloat16"
    preflight: bool = True

    def identity(self) -> dict[str, Any]:
        """What was learned depends on, the backend aside: either continues what the other began. See `may_change`."""
        task = ("task", "time_limit", "action_repeat", "image_size", "observations", "leave_out")
        values = {name: getattr(self, name) for name in (*task, "seed", "replay_deter")} | dataclasses.asdict(
            self.config
        )
        values["env_arg"] = dict(self.env_arg) or None
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """; did you mean report? Empty if nothing that is known looks like it."""
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]}?" if close else ""


@functools.cache
def may_change() -> frozenset[str]:
    """The hyperparameters that may have another value when a run is continued: [LOOP-70]. Every other entry of
    `identity` must stay."""
    entries = hyperparameters().items()
    return frozenset({name for name, entry in entries if entry["group"] in CHANGEABLE_GROUPS} | {"replay_ratio"})


@functools.cache
def presets() -> dict[str, dict[str, Any]]:
    """Name -> settings of presets.toml, [base] included."""
    return tomllib.loads(resources.files("dreamer_spec").joinpath("presets.toml").read_text(encoding="utf-8"))


def defaults() -> dict[str, Any]:
    """What a run has that names neither a preset nor the option: name of a field of Options, "profile" or "size" ->
    value."""
    fields = {field.name: field.default for field in dataclasses.fields(Options)}
    return {**{name: value for name, value in fields.items() if value is not dataclasses.MISSING}, **presets()["base"]}


def assemble_options(
    backend: str, given: Mapping[str, Any], changed: Mapping[str, Any], preset: str | None = None
) -> Options:
    """The options of a run: `given` by name of the fields of Options, plus "profile" and "size"; `changed`
    hyperparameters by their names.

    Raises:
      UserError: an unknown preset, profile, size or hyperparameter, a profile that is not for training, or a value that
        no run could have.
    """
    known = [name for name in presets() if name != "base"]
    if preset is not None and preset not in known:
        raise UserError(f"unknown preset {preset!r}{did_you_mean(preset, known)}; known: {', '.join(known)}")
    if preset is None and "task" not in given:
        preset = DEFAULT_PRESET
    chosen = presets()[preset] if preset else {}
    settings = {**presets()["base"], **chosen, **given}
    if "task" not in settings:
        raise UserError(f"the preset {preset} is for any task: name yours, --task MODULE:CALLABLE or SUITE:NAME")
    profile = settings["profile"]
    of_suite = suites.settings(settings["task"], profile)
    settings = {**presets()["base"], **of_suite, **chosen, **given}
    settings["env_arg"] = {**of_suite.get("env_arg", {}), **settings.get("env_arg", {})}
    overrides = {**of_suite.get("hyperparameters", {}), **chosen.get("hyperparameters", {}), **changed}
    del settings["profile"]
    try:
        config = load_config(profile, settings.pop("size"), **overrides)
    except ValueError as error:
        raise UserError(str(error)) from error
    if profile not in built_profiles():
        raise UserError(
            f"the profile {profile} is for `conformance check` only: the networks and optimizers of that "
            f"edition are not built here; "
            f"train with one of {', '.join(built_profiles())}"
        )
    settings = {name: value for name, value in settings.items() if name not in ("help", "hyperparameters")}
    settings.setdefault("logdir", default_logdir(settings["task"], backend, settings.get("seed", 0)))
    return Options(backend=backend, config=config, **settings)


def default_logdir(task: str, backend: str, seed: int | str) -> Path:
    """runs/<task>-<backend>-seed<k>, the task without its suite and without characters that file systems dislike."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", task.removeprefix("gym:").replace(":", "-"))
    return Path("runs") / f"{name}-{backend}-seed{seed}"


def of_seeds(options: Options, seeds: Sequence[int], logdir_given: bool) -> list[Options]:
    """The options of each seed: in runs/TASK-BACKEND-seedN, or in seedN below the log directory that was given."""
    runs = []
    for seed in seeds:
        logdir = options.logdir / f"seed{seed}" if logdir_given else default_logdir(options.task, options.backend, seed)
        runs.append(dataclasses.replace(options, seed=seed, logdir=logdir))
    return runs


def names_code(task: str) -> bool:
    """Whether a task is a module of somebody, whose code would run, and not one of a suite."""
    suite, _, name = task.partition(":")
    return suite not in ("gym", *suites.SUITES) or ":" in name
