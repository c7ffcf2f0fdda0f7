"""Small problems for the checks: spaces, configurations, parameters, batches and noise, drawn from a seed.

They are small but nothing in them is degenerate: sides, sizes and channel counts differ from each other, every
parameter is random (the reward and critic outputs too, which start at zero in training), episodes begin, end and are
cut inside the sequences. No image is halved below 3 pixels a side.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from conformance.compare import round_to
from reference_numpy import agent
from spec import Config, Discrete, Image, Spaces, Vector, load_config, parameter_table

OBSERVATIONS: dict[str, dict[str, Vector | Discrete | Image]] = {
    "vector": {"position": Vector(3), "mode": Discrete((3, 2))},
    "image": {"image": Image(12, 16, 3)},
    "both": {"position": Vector(3), "mode": Discrete((3, 2)), "image": Image(12, 16, 3), "depth": Image(12, 16, 1)},
}
ACTIONS: dict[str, dict[str, Vector | Discrete]] = {
    "discrete": {"action": Discrete((4,))},
    "continuous": {"action": Vector(3)},
    "mixed": {"arm": Vector(2), "buttons": Discrete((2, 3))},
}
# Choices of every option that changes what is computed, other than those of the profiles.
OPTIONS: dict[str, tuple[Any, ...]] = {
    **{"units": (8, 12), "deter": (16, 24), "stoch": (2, 3), "classes": (4, 6), "blocks": (1, 2, 4), "bins": (15, 41)},
    **{"cnn_sampling": ("strided", "pooled"), "cnn_outer": (True, False), "cnn_depth": (4, 8)},
    "cnn_multipliers": ((1, 2), (2, 1, 3)),
    **{f"{part}_layers": (1, 2, 3) for part in ("encoder", "decoder", "posterior", "prior", "reward")},
    **{f"{part}_layers": (1, 2, 3) for part in ("continue", "actor", "critic")},
    **{"norm_epsilon": (1e-5, 1e-2), "latent_unimix": (0.0, 0.3), "actor_unimix": (0.0, 0.3)},
    **{"actor_min_std": (0.05, 0.5), "actor_max_std": (1.0, 2.5), "vector_loss_scale": (0.5, 1.0)},
    **{"free_nats": (0.0, 0.5, 2.0), "continue_target": ("hard", "discounted"), "discount_horizon": (5.0, 1000.0)},
    **{"start_continue": ("true", "predicted"), "return_lambda": (0.0, 0.6, 1.0), "entropy_scale": (0.0, 0.1)},
    **{"slow_critic_scale": (0.0, 0.5), "return_limit": (0.1, 3.0), "return_decay": (0.0, 0.5, 1.0)},
    **{"return_percentile_low": (0.0, 30.0), "return_percentile_high": (60.0, 100.0)},
    **{f"{name}_scale": (0.3, 2.0) for name in ("reconstruction", "reward", "continue", "dynamics")},
    **{f"{name}_scale": (0.3, 2.0) for name in ("representation", "actor", "critic", "replay_critic")},
}
OBSERVED: tuple[dict[str, Vector | Discrete | Image], ...] = (
    {"image": Image(24, 32, 3)},
    {"mode": Discrete((3, 2)), "position": Vector(3)},
    {"depth": Image(32, 24, 1), "image": Image(32, 24, 3)},
    {"board": Discrete((2, 4)), "depth": Image(24, 24, 2), "place": Vector(1), "speed": Vector(2)},
)
ACTING: tuple[dict[str, Vector | Discrete], ...] = (
    {"action": Discrete((5,))},
    {"arm": Vector(2), "buttons": Discrete((2, 3)), "leg": Vector(1)},
    {"action": Vector(3)},
    {"action": Discrete((3, 2, 4))},
)
SMALL = {
    "units": 8,
    "deter": 16,
    "stoch": 3,
    "classes": 5,
    "cnn_depth": 2,
    "bins": 31,
    "batch_size": 2,
    "batch_length": 5,
    "imagination_horizon": 3,
    "free_nats": 2.0,
    "warmup_steps": 10,
}


@dataclasses.dataclass(frozen=True)
class Problem:
    """Everything that a training step takes."""

    spaces: Spaces
    config: Config
    state: dict[str, Any]
    batch: dict[str, np.ndarray]
    noise: dict[str, np.ndarray]

    @property
    def loss_arguments(self) -> tuple[Any, ...]:
        """The arguments of `losses` and `gradients`."""
        state = self.state
        return_range = (state["return_range"]["low"], state["return_range"]["high"])
        return state["params"], state["slow_critic"], return_range, self.batch, self.noise, self.spaces, self.config


def spaces(observation: str = "both", action: str = "mixed") -> Spaces:
    return Spaces(OBSERVATIONS[observation], ACTIONS[action])


def small_config(profile: str, dtype: str = "float64", **overrides: Any) -> Config:
    """A configuration of the profile, with sizes that the reference computes in milliseconds. Images are halved twice,
    unless the convolutions are given: implementations refuse maps with sides below 3."""
    config = load_config(profile, "tiny", compute_dtype=dtype, **{**SMALL, **overrides})
    if {"cnn_outer", "cnn_multipliers"} & overrides.keys():
        return config
    return dataclasses.replace(config, cnn_multipliers=(1, 2, 4) if config.cnn_outer else (2, 4))


def random_parameters(
    rng: np.random.Generator, config: Config, task: Spaces, dtype: str = "float64"
) -> dict[str, np.ndarray]:
    """Every entry of the table, none of them zero or one.

    The latents' logits are spread out, so that some KL divergences lie above the free nats and some below. Rewards and
    values lean towards the bins around zero, so that returns are of the size of real ones and not of the outermost
    bins.
    """
    params = {}
    for name, entry in parameter_table(config, task).items():
        if entry.initializer == "truncated_normal":
            spread = 3.0 if name in ("rssm/posterior/out/kernel", "rssm/prior/out/kernel") else 1.0
            value = rng.normal(0.0, spread / math.sqrt(entry.fan_in), entry.shape)
        else:
            value = rng.normal(float(entry.initializer == "ones"), 0.2, entry.shape)
        if name in ("reward/out/bias", "critic/out/bias"):
            value -= 1.5 * np.abs(np.arange(config.bins) - config.bins // 2)
        params[name] = round_to(value, "float32" if dtype == "bfloat16" else dtype)
    return params


def random_observations(rng: np.random.Generator, task: Spaces, leading: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Observations with the given leading axes; vectors are float32 numbers of several magnitudes."""
    observations: dict[str, np.ndarray] = {}
    for key, space in task.observations.items():
        shape = (*leading, *space.array_shape)
        if isinstance(space, Vector):
            observations[key] = (rng.normal(size=shape) * 10 ** rng.uniform(-2, 2, shape)).astype(np.float32)
        elif isinstance(space, Discrete):
            observations[key] = rng.integers(0, space.classes, shape)
        else:
            observations[key] = rng.integers(0, 256, shape).astype(np.uint8)
    return observations


def random_actions(rng: np.random.Generator, task: Spaces, leading: tuple[int, ...]) -> np.ndarray:
    """Flat actions: one-hots, and real numbers some of which lie outside [-1, 1]."""
    parts = []
    for space in task.actions.values():
        if isinstance(space, Discrete):
            parts += [np.eye(classes)[rng.integers(0, classes, leading)] for classes in space.classes]
        else:
            parts.append(round_to(rng.normal(size=(*leading, space.size)), "bfloat16"))
    return np.concatenate(parts, -1)


def random_carry(rng: np.random.Generator, config: Config, leading: tuple[int, ...]) -> dict[str, np.ndarray]:
    """h in (-1, 1) and one-hot z."""
    stoch = np.eye(config.classes)[rng.integers(0, config.classes, (*leading, config.stoch))]
    return {"deter": round_to(np.tanh(rng.normal(size=(*leading, config.deter))), "bfloat16"), "stoch": stoch}


def random_batch(rng: np.random.Generator, config: Config, task: Spaces) -> dict[str, np.ndarray]:
    """A replay batch. Row 0 holds a termination followed by a reset, row 1 a truncation, and the last row ends in a
    terminal step."""
    B, T = config.batch_size, config.batch_length
    is_last = np.zeros((B, T), bool)
    is_terminal = np.zeros((B, T), bool)
    is_first = np.zeros((B, T), bool)
    is_last[0, T // 2] = is_terminal[0, T // 2] = is_last[1 % B, T // 3] = is_last[-1, -1] = is_terminal[-1, -1] = True
    is_first[:, 1:] = is_last[:, :-1]
    carry = random_carry(rng, config, (B,))
    reward = np.where(is_first, 0, rng.normal(size=(B, T)) * 10 ** rng.uniform(-1, 2, (B, T)))
    return {
        **random_observations(rng, task, (B, T)),
        "reward": reward.astype(np.float32),
        "is_first": is_first,
        "is_last": is_last,
        "is_terminal": is_terminal,
        "prev_action": random_actions(rng, task, (B, T)).astype(np.float32),
        "deter": carry["deter"].astype(np.float32),
        "stoch": carry["stoch"].argmax(-1),
    }


def action_noise(rng: np.random.Generator, task: Spaces, leading: tuple[int, ...]) -> np.ndarray:
    """[..., K]: normals for real numbers, uniforms for categoricals, in the order of the keys."""
    parts = []
    for space in task.actions.values():
        shape = (*leading, *space.array_shape)
        parts.append(rng.random(shape) if isinstance(space, Discrete) else rng.normal(size=shape))
    return round_to(np.concatenate(parts, -1), "float32")


def uniforms(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Uniforms in [0, 1) that every dtype of the noise can hold."""
    return rng.integers(0, 2**23, shape) / 2.0**23


def train_noise(rng: np.random.Generator, config: Config, task: Spaces) -> dict[str, np.ndarray]:
    B, T, H, S = config.batch_size, config.batch_length, config.imagination_horizon, config.stoch
    return {
        "posterior": uniforms(rng, B, T, S),
        "prior": uniforms(rng, B * T, H, S),
        "action": action_noise(rng, task, (B * T, H)),
    }


def random_state(rng: np.random.Generator, config: Config, task: Spaces, dtype: str = "float64") -> dict[str, Any]:
    """A training state in the middle of training: moments, a slow critic and a return range of their own, ten updates
    made."""
    stored = "float32" if dtype == "bfloat16" else dtype
    params = random_parameters(rng, config, task, dtype)
    return {
        "params": params,
        "slow_critic": {
            name: round_to(value + rng.normal(0, 0.05, value.shape), stored)
            for name, value in params.items()
            if name.startswith("critic/")
        },
        "optimizer": {
            "step": 10,
            "second_moment": {
                name: round_to(rng.uniform(0.01, 1, value.shape), stored) for name, value in params.items()
            },
            "momentum": {name: round_to(rng.normal(0, 1, value.shape), stored) for name, value in params.items()},
        },
        "return_range": {"low": -0.75, "high": 1.5},
    }


def make_problem(
    seed: int, profile: str, observation: str, action: str, dtype: str = "float64", **overrides: Any
) -> Problem:
    return problem_in(spaces(observation, action), seed, profile, dtype, **overrides)


def problem_in(task: Spaces, seed: int, profile: str, dtype: str = "float64", **overrides: Any) -> Problem:
    """A training step in the middle of training, with the spaces of a task."""
    rng, config = np.random.default_rng(seed), small_config(profile, dtype, **overrides)
    return Problem(
        task,
        config,
        random_state(rng, config, task, dtype),
        random_batch(rng, config, task),
        train_noise(rng, config, task),
    )


def unusual_problem(seed: int, number: int, profile: str, dtype: str) -> Problem:
    """The one of a number among those of a seed: every kind of observation and of action occurs among any four numbers,
    and every option is drawn."""
    rng = np.random.default_rng([seed, number])
    task = Spaces(OBSERVED[(seed + number) % len(OBSERVED)], ACTING[(2 * seed + number) % len(ACTING)])
    overrides = {name: choices[rng.integers(len(choices))] for name, choices in OPTIONS.items()}
    last = overrides["cnn_multipliers"][-1] * overrides["cnn_depth"]
    if last % overrides["blocks"] or overrides["deter"] % overrides["blocks"]:
        overrides["blocks"] = 1
    return problem_in(task, int(rng.integers(2**31)), profile, dtype, **overrides)


def nudged(problem: Problem, distance: float) -> Problem:
    """The problem with all its uniform numbers moved by a distance; normal numbers stay."""
    is_uniform = [
        isinstance(space, Discrete) for space in problem.spaces.actions.values() for _ in range(space.array_shape[0])
    ]
    shift = {"posterior": distance, "prior": distance, "action": distance * np.array(is_uniform)}
    noise = {name: value + shift[name] for name, value in problem.noise.items()}
    return dataclasses.replace(problem, noise=noise)


def with_sampling_margin(
    draw: Callable[[int], Problem],
    margin: float,
    accept: Callable[[Problem], bool] = lambda problem: True,
    attempts: int = 1000,
) -> Problem:
    """The first of draw(0), draw(1), ... that is accepted, and in which honest rounding moves no sample into another
    class.

    It is so when moving every uniform number by the margin, to both sides, changes the total of the reference in no
    bit.

    Raises:
      RuntimeError: none of that many attempts gives such a problem.
    """
    for attempt in range(attempts):
        problem = draw(attempt)
        if not accept(problem):
            continue
        below, above = (agent.losses(*nudged(problem, distance).loss_arguments)[0] for distance in (-margin, margin))
        if below == above and math.isfinite(below):
            return problem
    raise RuntimeError(f"none of {attempts} problems keeps every sample {margin:g} away from the next class")
