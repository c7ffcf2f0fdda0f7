"""A trained policy that runs with NumPy alone: the folder that `train export` writes, and acting from it through the
reference.

policy/
  policy.safetensors   the parameters that acting needs, float32 under their canonical names (spec/10-agent.md)
  policy.json          format, task, step, spaces and their translation, configuration, and where the policy comes from
  SHA256SUMS           checksums of the other files
"""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_spec.disk.folders import open_sealed, require_intact, write_folder
from dreamer_spec.disk.saved_agent import SavedAgent, acting_table, check_info, checked_parameters, config_from_json
from dreamer_spec.errors import UserError
from dreamer_spec.translation import Translation
from reference_numpy import agent, training_loop
from reference_numpy.shapes import require_shape
from spec import Discrete, Spaces, Vector

FORMAT = 2  # Since 2 it holds the translation: before, a caller had to know bounds, first numbers, shapes and dtypes.
PARAMETERS, DESCRIPTION = "policy.safetensors", "policy.json"


class Policy:
    """Acts in `n` environments at once, with a carry of its own for each.

    spaces: what it sees and does. translation: what the environment's values become. config: its hyperparameters. info:
    what else policy.json says: task, step, backend, action_repeat, image_size, environment, source, versions.
    """

    def __init__(self, saved: SavedAgent) -> None:
        self.spaces, self.translation, self.config, self.info = (
            saved.spaces,
            saved.translation,
            saved.config,
            saved.info,
        )
        self._parameters = {
            name: np.asarray(array, np.float64) for name, array in saved.parameters.items()
        }  # once, not in every step
        self.reset(0)

    @classmethod
    def load(cls, path: str | Path) -> "Policy":
        """The policy in a folder. Nothing in it is trusted.

        Raises:
          UserError: it is missing, damaged or of another format.
        """
        path = Path(path)
        try:
            sealed = open_sealed(path, (PARAMETERS, DESCRIPTION))
            require_intact(sealed, (PARAMETERS, DESCRIPTION))
            info = sealed.json(DESCRIPTION)
            if info.get("format") != FORMAT:
                raise ValueError(
                    f"{DESCRIPTION} has format {info.get('format')!r:.80}; this version reads format {FORMAT}"
                )
            spaces, config = Spaces.from_json(info.pop("spaces", None)), config_from_json(info.pop("config", None))
            translation = Translation.from_json(info.pop("translation", None), spaces)
            check_info(info, spaces)
            parameters = checked_parameters(sealed.arrays(PARAMETERS), acting_table(config, spaces))
        except (OSError, ValueError) as error:
            raise UserError(
                f"cannot load the policy {path}: {error!s:.500}; write it again with `train export`"
            ) from error
        return cls(SavedAgent(config, spaces, parameters, info, translation))

    def reset(self, n: int, seed: int = 0) -> None:
        """Starts in `n` environments. seed: of the noise that the steps from here on draw."""
        self._carry = {
            "deter": np.zeros((n, self.config.deter)),
            "stoch": np.zeros((n, self.config.stoch, self.config.classes)),
        }
        self._action = np.zeros((n, self.spaces.action_size))
        self._seed, self._steps = seed, 0

    def __call__(
        self, observation: Mapping[str, Any], is_first: Any, noise: Mapping[str, Any] | None = None, mode: bool = False
    ) -> np.ndarray:
        """One step of every environment: [AGT-11] to [AGT-13], [LOOP-71].

        Args:
          observation: what `observation` returns: key -> [n, ...] as in spec/00-notation.md: Vector real numbers [n,
            size], Discrete integers [n, len(classes)], Image uint8 [n, height, width, channels]. Other keys are
            ignored.
          is_first: [n] bool, where an episode starts: the row forgets what was before.
          noise: {"posterior": [n, S] uniforms, "action": [n, K] uniforms and normals} instead of drawn numbers, see
            [CON-20].
          mode: the mode of the actor instead of a sample; the latents are sampled all the same.

        Returns:
          The flat action [n, A], not clipped; `environment_action` makes of it what an environment takes.

        Raises:
          ValueError: a key is missing, a shape or dtype does not fit, or a number is out of range or not finite. Then
            nothing has changed.
        """
        rows = len(self._action)
        is_first = np.asarray(is_first)
        require_shape("is_first", is_first.shape, rows)
        if is_first.dtype != np.bool_:
            raise ValueError(f"is_first: expected the dtype bool, got {is_first.dtype}")
        observation = {key: self._observation(key, observation) for key in self.spaces.observations}
        noise = self._draw_noise() if noise is None else noise
        if set(noise) != {"posterior", "action"}:
            raise ValueError(f"noise: expected the entries posterior and action, got {sorted(noise)}")
        carry, action = agent.policy_step(
            self._parameters, self._carry, self._action, observation, is_first, noise, self.spaces, self.config, mode
        )
        if not np.isfinite(action).all():  # [LOOP-12]
            raise ValueError("the flat action holds numbers that are not finite: the parameters are probably broken")
        self._carry, self._action, self._steps = carry, action, self._steps + 1
        return action.copy()

    def observation(self, values: Sequence[Any]) -> dict[str, np.ndarray]:
        """What the policy sees of one observation of each environment, as the environment returned it: [LOOP-68].

        Returns:
          Key -> [n, ...], the arrays that the agent was trained on.

        Raises:
          ValueError: what the task's spaces do not allow; the message names the key.
        """
        rows = [self.translation.observation(value) for value in values]
        return {key: np.stack([row[key] for row in rows]) for key in self.spaces.observations}

    def environment_action(self, action: Any) -> list[Any]:
        """What each environment receives for its flat action, ready for its `step`: [LOOP-12], [LOOP-68].

        Args:
          action: [n, A].

        Raises:
          ValueError: a shape does not fit, or a number is not finite.
        """
        action = np.asarray(action)
        require_shape("action", action.shape, ..., self.spaces.action_size)
        return [self.translation.action(row) for row in action.reshape(-1, self.spaces.action_size)]

    def _observation(self, key: str, observation: Mapping[str, Any]) -> np.ndarray:
        space = self.spaces.observations[key]
        if key not in observation:
            expected = [len(self._action), *space.array_shape]
            raise ValueError(
                f"observation: missing {key!r}; expected shape {expected}, got the keys {sorted(observation)}"
            )
        value = np.asarray(observation[key])
        require_shape(f"observation {key!r}", value.shape, len(self._action), *space.array_shape)
        if not isinstance(space, Vector):
            return value
        with np.errstate(over="ignore"):
            vector = np.asarray(value, np.float32)  # [CON-24]: as the agent met it in training
        if not np.isfinite(vector).all():
            raise ValueError(
                f"observation {key!r} holds {vector[~np.isfinite(vector)][0]}; expected "
                f"finite numbers that float32 can hold"
            )
        return vector

    def _draw_noise(self) -> dict[str, np.ndarray]:
        """[CON-19], [CON-20], with the seeds of [LOOP-26]."""
        rng, rows = (
            np.random.default_rng(training_loop.derive_seed(self._seed, "policy", self._steps)),
            len(self._action),
        )
        posterior = rng.random((rows, self.config.stoch))
        parts = [
            rng.random((rows, *space.array_shape))
            if isinstance(space, Discrete)
            else rng.standard_normal((rows, space.size))
            for space in self.spaces.actions.values()
        ]
        return {"posterior": posterior, "action": np.concatenate(parts, axis=-1)}


def save(path: Path, saved: SavedAgent) -> None:
    """Writes a policy folder, complete or not at all.

    Raises:
      UserError: the path exists already, or the disk refuses.
    """
    if os.path.lexists(path):
        raise UserError(f"{path} exists already; remove it, or choose another folder for the policy")
    description = {
        "format": FORMAT,
        **saved.info,
        "spaces": saved.spaces.to_json(),
        "translation": saved.translation.to_json(),
        "config": dataclasses.asdict(saved.config),
    }
    acting = {name: saved.parameters[name] for name in acting_table(saved.config, saved.spaces)}
    write_folder(path, {PARAMETERS: acting, DESCRIPTION: description}, "policy")
