"""The data of a lockstep: a small process that can be learned, as B streams that run on from batch to batch.

A wheel is turned by pushes. What is seen tells its angle and speed, the reward is highest where the angle is 0, and the
rows of a batch end both ways: a wheel that is too fast breaks (terminal), and any episode may run out of time (not
terminal). Whoever pushes gets more skilful over the steps of training, so that rewards, episode lengths and returns
move as they do in a run.
"""

import math
from typing import Any

import numpy as np

from conformance.problems import action_noise, uniforms
from spec import Config, Discrete, Image, Spaces, Vector, load_config

BROKEN = 1.0  # radians a step
BONUS_ANGLE = 0.3  # radians
TIME_LIMIT = (12, 40)  # steps
SKILL_STEPS = 400  # train steps until the pushes are as good as they get
SKILL = 0.6
PROBLEMS = {
    "vector": Spaces({"position": Vector(3), "mode": Discrete((3, 2))}, {"action": Discrete((4,))}),
    "image": Spaces({"image": Image(16, 32, 3)}, {"action": Vector(3)}),
}
# All else is the profile's, the optimizer and its warmup as well.
SIZES: dict[str, Any] = {
    "units": 16,
    "deter": 32,
    "stoch": 6,
    "classes": 6,
    "cnn_depth": 2,
    "batch_size": 4,
    "batch_length": 8,
    "imagination_horizon": 5,
}

Arrays = dict[str, np.ndarray]


def lockstep_config(profile: str, dtype: str) -> Config:
    """The profile's numbers, but for sizes that a step of the reference takes some ten milliseconds with."""
    return load_config(profile, "tiny", compute_dtype=dtype, **SIZES)


class BatchStream:
    """Batches of a replay whose sequences follow on each other. Everything is a function of the seed and of the calls
    made."""

    def __init__(self, seed: int, spaces: Spaces, config: Config) -> None:
        self._rng = np.random.default_rng(seed)
        self._spaces, self._config = spaces, config
        rows = config.batch_size
        self._angle, self._speed, self._left = np.zeros(rows), np.zeros(rows), np.zeros(rows, int)
        self._ended = np.ones(rows, bool)
        self._action = np.zeros((rows, spaces.action_size))
        self._latents: Arrays = {
            "deter": np.zeros((rows, config.deter), np.float32),
            "stoch": np.zeros((rows, config.stoch), int),
        }

    def batch(self, step: int) -> Arrays:
        """The next T records of every row: keys, shapes and types of a replay batch."""
        records = [self._record(min(1.0, step / SKILL_STEPS) * SKILL) for _ in range(self._config.batch_length)]
        return {name: np.stack([record[name] for record in records], 1) for name in records[0]} | self._latents

    def store(self, deter: np.ndarray, stoch: np.ndarray) -> None:
        """Latents [B, T, ...] of the batch before; the last of them are the context of the next, as replay would give
        them."""
        self._latents = {"deter": deter[:, -1].astype(np.float32), "stoch": stoch[:, -1].argmax(-1)}

    def noise(self) -> Arrays:
        """Noise of one train step; every call gives other numbers."""
        config, rng = self._config, self._rng
        starts, horizon = config.batch_size * config.batch_length, config.imagination_horizon
        return {
            "posterior": uniforms(rng, config.batch_size, config.batch_length, config.stoch),
            "prior": uniforms(rng, starts, horizon, config.stoch),
            "action": action_noise(rng, self._spaces, (starts, horizon)),
        }

    def _record(self, skill: float) -> Arrays:
        """One step of every wheel: it is pushed, unless its episode has ended and a new one begins."""
        rng, first = self._rng, self._ended
        rows = len(first)
        self._speed = np.where(first, rng.normal(0, 0.3, rows), 0.95 * self._speed + 0.5 * self._push(self._action))
        self._angle = np.where(first, rng.uniform(-math.pi, math.pi, rows), self._angle + self._speed)
        self._angle = (self._angle + math.pi) % (2 * math.pi) - math.pi
        self._left = np.where(first, rng.integers(*TIME_LIMIT, rows), self._left - 1)
        broken = ~first & (np.abs(self._speed) > BROKEN)
        reward = 10.0 * np.cos(self._angle) + 100.0 * (np.abs(self._angle) < BONUS_ANGLE) - 200.0 * broken
        self._ended = broken | (self._left <= 0)
        record = {
            **self._observation(),
            "reward": np.where(first, 0.0, reward).astype(np.float32),
            "is_first": first,
            "is_last": self._ended,
            "is_terminal": broken,
            "prev_action": self._action.astype(np.float32),
        }
        self._action = self._choose(skill)
        return record

    def _observation(self) -> Arrays:
        rows, observation = len(self._angle), {}
        for key, space in self._spaces.observations.items():
            if isinstance(space, Discrete):
                sector = (
                    ((self._angle + math.pi) / (2 * math.pi) * space.classes[0])
                    .astype(int)
                    .clip(0, space.classes[0] - 1)
                )
                observation[key] = np.stack([sector, (self._speed > 0).astype(int)], -1)
            elif key == "image":
                observation[key] = self._picture(space.array_shape)
            else:
                observation[key] = np.stack([np.cos(self._angle), np.sin(self._angle), 10 * self._speed], -1).astype(
                    np.float32
                )
            assert observation[key].shape == (rows, *space.array_shape)
        return observation

    def _picture(self, shape: tuple[int, ...]) -> np.ndarray:
        """A spot on the rim of the wheel, whose colours tell the speed, on a faint gradient."""
        height, width, channels = shape
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        away = (x - 0.7 * np.sin(self._angle)[:, None, None]) ** 2 + (y + 0.7 * np.cos(self._angle)[:, None, None]) ** 2
        colour = 0.5 + 0.5 * np.tanh(self._speed[:, None] * np.linspace(-1, 1, channels))
        light = 0.8 * np.exp(-8 * away)[..., None] * colour[:, None, None, :] + 0.1 * (1 + y[..., None])
        return (255 * light.clip(0, 1)).astype(np.uint8)

    def _push(self, action: np.ndarray) -> np.ndarray:
        """[B] in -1 to 1, of a flat action of one entry."""
        (space,) = self._spaces.actions.values()
        if isinstance(space, Discrete):
            return np.linspace(-1, 1, space.classes[0])[action.argmax(-1)]
        return action.mean(-1).clip(-1, 1)

    def _choose(self, skill: float) -> np.ndarray:
        """Flat actions: at random, or with the given probability those that turn the angle towards 0."""
        rng, rows = self._rng, len(self._angle)
        wanted = (-0.5 * self._angle - self._speed).clip(-1, 1)
        skilled = rng.random(rows) < skill
        (space,) = self._spaces.actions.values()
        if isinstance(space, Discrete):
            classes = space.classes[0]
            nearest = np.round((wanted + 1) / 2 * (classes - 1)).astype(int)
            return np.eye(classes)[np.where(skilled, nearest, rng.integers(0, classes, rows))]
        return np.where(
            skilled[:, None],
            wanted[:, None] + 0.1 * rng.normal(size=(rows, space.size)),
            rng.normal(size=(rows, space.size)),
        )
