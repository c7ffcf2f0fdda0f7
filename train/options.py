"""What a run is: its options, made of [base], a preset and the command line, later ones winning."""

import dataclasses
import functools
import re
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from spec import Config, built_profiles, load_config
from train.errors import UserError

DEFAULT_PRESET = "cartpole"
RESUME = ("auto", "never", "must")
PROCESSES = ("auto", "yes", "no")
NONFINITE = ("stop", "skip")


@dataclasses.dataclass(frozen=True)
class Options:
    """Everything that a run depends on, beside the code.

    steps and eval_every are environment steps: records times action_repeat. checkpoint_every, log_every and env_timeout are seconds.
    replay_memory is in GiB. time_limit is in frames, before action repeat: [LOOP-28]. observations, leave_out: keys or patterns of keys;
    all are used where `observations` is empty. env_args: keyword arguments of what makes the environment, in plain JSON types.
    """

    backend: str
    task: str
    config: Config
    logdir: Path
    steps: int
    seed: int = 0
    device: str | None = None
    action_repeat: int = 1
    image_size: int = 64
    observations: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    env_args: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    time_limit: int | None = None
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
    keep_checkpoints: int = 2
    nonfinite: str = "stop"
    wandb: str | None = None
    replay_memory: float = 2.0
    replay_deter: str = "bfloat16"
    preflight: bool = True

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must agree in to be continued. The backend is not in it: either continues what the other began."""
        task = ("task", "action_repeat", "image_size", "observations", "leave_out", "env_args", "time_limit")
        values = {name: getattr(self, name) for name in (*task, "seed", "replay_deter")} | dataclasses.asdict(self.config)
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


@functools.cache
def presets() -> dict[str, dict[str, Any]]:
    """Name -> settings of presets.toml, [base] included."""
    return tomllib.loads(resources.files("train").joinpath("presets.toml").read_text(encoding="utf-8"))


def make_options(backend: str, given: Mapping[str, Any], hyperparameters: Mapping[str, Any], preset: str | None = None) -> Options:
    """The options of a run: `given` by name of the fields of Options, plus "profile" and "size"; hyperparameters by their names.

    Raises:
      UserError: an unknown preset, profile, size or hyperparameter, a profile that is not for training, or a value that no run could have.
    """
    known = [name for name in presets() if name != "base"]
    if preset is not None and preset not in known:
        raise UserError(f"unknown preset {preset!r}; known: {', '.join(known)}")
    if preset is None and "task" not in given:
        preset = DEFAULT_PRESET
    chosen = presets()[preset] if preset else {}
    settings = {**presets()["base"], **chosen, **given}
    overrides = {**chosen.get("hyperparameters", {}), **hyperparameters}
    profile = settings.pop("profile")
    try:
        config = load_config(profile, settings.pop("size"), **overrides)
    except ValueError as error:
        raise UserError(str(error)) from error
    if profile not in built_profiles():
        raise UserError(
            f"the profile {profile} is for `conformance check` only: the networks and optimizers of that edition are not built here; "
            f"train with one of {', '.join(built_profiles())}"
        )
    settings = {name: value for name, value in settings.items() if name not in ("help", "hyperparameters")}
    settings.setdefault("logdir", default_logdir(settings["task"], backend, settings.get("seed", 0)))
    return Options(backend=backend, config=config, **settings)


def default_logdir(task: str, backend: str, seed: int) -> Path:
    """runs/<task>-<backend>-seed<k>, the task without its suite and without characters that file systems dislike."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", task.removeprefix("gym:").replace(":", "-"))
    return Path("runs") / f"{name}-{backend}-seed{seed}"
