"""The typed configuration and the benchmark protocols, filled from the TOML files beside this one.

A configuration is made in this order, later values winning: the value of the profile `paper` (hyperparameters.toml),
the values of the chosen profile (profiles.toml) and of the chosen model size (sizes.toml), explicit overrides.
"""

import dataclasses
import functools
import tomllib
from importlib import resources
from typing import Any


@dataclasses.dataclass(frozen=True)
class Config:
    """Every hyperparameter of the algorithm. What each one means, and where it comes from, is in hyperparameters.toml.

    Raises:
      ValueError: a value that no run could mean, with its name, the value and what was expected.
    """

    batch_size: int
    batch_length: int
    compute_dtype: str

    units: int
    deter: int
    stoch: int
    classes: int
    cnn_depth: int
    blocks: int
    cnn_sampling: str
    cnn_multipliers: tuple[int, ...]
    cnn_outer: bool
    encoder_layers: int
    decoder_layers: int
    posterior_layers: int
    prior_layers: int
    reward_layers: int
    continue_layers: int
    actor_layers: int
    critic_layers: int
    norm_epsilon: float
    bins: int
    latent_unimix: float
    actor_unimix: float
    actor_min_std: float
    actor_max_std: float
    actor_outscale: float
    reward_outscale: float
    critic_outscale: float

    reconstruction_scale: float
    reward_scale: float
    continue_scale: float
    dynamics_scale: float
    representation_scale: float
    free_nats: float
    vector_loss_scale: float
    continue_target: str

    imagination_horizon: int
    discount_horizon: float
    return_lambda: float
    start_continue: str
    actor_scale: float
    critic_scale: float
    replay_critic_scale: float
    slow_critic_scale: float
    slow_critic_decay: float
    entropy_scale: float
    return_percentile_low: float
    return_percentile_high: float
    return_decay: float
    return_limit: float

    learning_rate: float
    warmup_steps: int
    agc_clip: float
    agc_epsilon: float
    beta1: float
    beta2: float
    laprop_epsilon: float

    replay_capacity: int
    replay_ratio: float
    envs: int

    @property
    def discount(self) -> float:
        """gamma = 1 - 1 / discount_horizon (D-05)."""
        return 1.0 - 1.0 / self.discount_horizon

    @property
    def imagined_discount(self) -> float:
        """What multiplies a continue prediction in imagination: gamma, or 1 where the head has learned it (D-06)."""
        return self.discount if self.continue_target == "hard" else 1.0

    @property
    def halvings(self) -> int:
        """How often the image encoder halves each side."""
        return len(self.cnn_multipliers) - int(self.cnn_outer)

    @property
    def feature_size(self) -> int:
        """Length of the model state [h, z] that the heads read."""
        return self.deter + self.stoch * self.classes

    def __post_init__(self) -> None:
        for name, entry in hyperparameters().items():
            _check_value(name, getattr(self, name), entry)
        _require(self.deter % self.blocks == 0, "deter", self.deter, f"a multiple of blocks = {self.blocks}")
        stem = self.cnn_multipliers[-1] * self.cnn_depth
        divisible = f"last multiplier x cnn_depth a multiple of blocks = {self.blocks}"
        _require(stem % self.blocks == 0, "cnn_depth", self.cnn_depth, divisible)
        _require(self.bins % 2 == 1 and self.bins >= 3, "bins", self.bins, "an odd number of at least 3")
        _require(self.discount_horizon > 1, "discount_horizon", self.discount_horizon, "more than 1")
        _require(self.actor_min_std > 0, "actor_min_std", self.actor_min_std, "more than 0")
        _require(
            self.actor_max_std >= self.actor_min_std, "actor_max_std", self.actor_max_std, "at least actor_min_std"
        )
        _require(self.return_limit > 0, "return_limit", self.return_limit, "more than 0")
        _require(
            self.return_percentile_low <= self.return_percentile_high <= 100,
            "return_percentile_high",
            self.return_percentile_high,
            "between return_percentile_low and 100",
        )
        for name in ("latent_unimix", "actor_unimix", "return_lambda", "slow_critic_decay", "return_decay"):
            _require(getattr(self, name) <= 1, name, getattr(self, name), "between 0 and 1")
        for name in ("beta1", "beta2"):
            _require(getattr(self, name) < 1, name, getattr(self, name), "at least 0 and less than 1")


def _require(condition: bool, name: str, value: object, expected: str) -> None:
    if not condition:
        raise ValueError(f"hyperparameter {name} is {value!r}; expected {expected}")


_MAY_BE_ZERO = ("warmup_steps",)


def _check_value(name: str, value: object, entry: dict[str, Any]) -> None:
    default = entry["value"]
    if "choices" in entry:
        _require(value in entry["choices"], name, value, "one of " + ", ".join(entry["choices"]))
    elif isinstance(default, bool):
        _require(isinstance(value, bool), name, value, "true or false")
    elif isinstance(default, list):
        valid = isinstance(value, tuple) and len(value) >= 2 and all(isinstance(x, int) and x > 0 for x in value)
        _require(valid, name, value, "at least two whole numbers above 0")
    elif isinstance(default, int):
        least, expected = (0, "a whole number, 0 or more") if name in _MAY_BE_ZERO else (1, "a whole number above 0")
        _require(isinstance(value, int) and not isinstance(value, bool) and value >= least, name, value, expected)
    else:
        _require(isinstance(value, float) and 0 <= value < float("inf"), name, value, "a finite number, 0 or more")


def load_config(profile: str = "paper", size: str = "200m", **overrides: Any) -> Config:
    """The configuration of a profile and a model size, with overrides by name.

    Raises:
      ValueError: an unknown profile, size or hyperparameter, or an invalid value; the message lists what is known.
    """
    _known(profile, profiles(), "profile")
    _known(size, sizes(), "size")
    values = {name: entry["value"] for name, entry in hyperparameters().items()}
    for name in overrides:
        _known(name, values, "hyperparameter")
    values |= profiles()[profile] | sizes()[size] | overrides
    return Config(**{name: _convert(value, hyperparameters()[name]["value"]) for name, value in values.items()})


def _convert(value: Any, default: Any) -> Any:
    """Lists become tuples, whole numbers become floats where the default is one: TOML and shells write 1 for 1.0."""
    if isinstance(value, list):
        return tuple(value)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value


def _known(name: str, known: Any, kind: str) -> None:
    if name not in known:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(known)}")


def _read(filename: str) -> dict[str, Any]:
    return tomllib.loads(resources.files("spec").joinpath(filename).read_text(encoding="utf-8"))


@functools.cache
def hyperparameters() -> dict[str, dict[str, Any]]:
    """Name -> {value, help, source, group, and where they apply symbol and choices}."""
    groups = _read("hyperparameters.toml")
    return {name: {**entry, "group": group} for group, entries in groups.items() for name, entry in entries.items()}


@functools.cache
def profiles() -> dict[str, dict[str, Any]]:
    """Profile name -> what it changes against `paper`."""
    return _read("profiles.toml")


@functools.cache
def sizes() -> dict[str, dict[str, Any]]:
    """Size name -> the hyperparameters that it sets."""
    return _read("sizes.toml")


@functools.cache
def benchmarks() -> dict[str, dict[str, Any]]:
    """Suite -> its protocol as the paper has it; the entry `official` holds what that profile changes."""
    return _read("benchmarks.toml")
