"""A Gymnasium vector environment as the contract wants it: what each of its environments would give alone.

The modes of `gymnasium.vector.AutoresetMode`, https://gymnasium.farama.org/main/api/vector/autoreset/: after the end of
an episode an environment gives its first observation in the next step (NEXT_STEP), in the same step, whose info holds
the last one (SAME_STEP), or when it is reset with a mask (DISABLED).
"""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array

from dreamer_spec.envs.adapter import ContractEnv, InvalidData
from dreamer_spec.envs.batches import differ, info_of, row, rows, rows_of
from dreamer_spec.envs.history import History
from dreamer_spec.envs.steps import Step, is_last
from dreamer_spec.errors import UserError
from dreamer_spec.translation import Translation
from reference_numpy.training_loop import derive_seed
from spec import Spaces

Form = Literal["list", "array", "one"]

FORMS: tuple[Form, ...] = get_args(Form)
REFUSALS = (TypeError, ValueError, gymnasium.error.Error)  # of a form of seeds


class ContractVector:
    """Wraps a vector environment: each of its environments is checked and translated by a `ContractEnv` of its own.

    The step after the end of an episode ignores its action and gives the first record of the next: [LOOP-11]. Where
    `reset` takes a seed for each environment and a mask, each episode has the seed of [LOOP-33]: in every mode an
    environment that has ended takes one step with the others, which nobody sees, and is reset after it: [LOOP-74].

    envs: the vector. The others: as for `ContractEnv`.

    Raises:
      UserError: an unsupported space, or a mode that is not known.
      InvalidData: from `resume` and `step`, whatever the vector returns that its spaces do not allow.
    """

    frame_skip = 1  # What a vector skips is not said anywhere; an action repeat, which would multiply it, is refused.

    def __init__(
        self,
        envs: VectorEnv[Any, Any, Any],
        task: str,
        image_size: int = 64,
        info_metrics: Sequence[str] = (),
        observations: Sequence[str] = (),
        leave_out: Sequence[str] = (),
    ) -> None:
        self.task = task
        self.count = int(envs.num_envs)
        self._envs = envs
        self._mode = _mode(envs, task)
        self._wants_info = bool(info_metrics)
        self._rows = [_Row(envs) for _ in range(self.count)]
        self._alone = [
            _Alone(env, task, index, image_size, 1, info_metrics, observations, leave_out)
            for index, env in enumerate(self._rows)
        ]
        self.translation: Translation = self._alone[0].translation
        self.spaces: Spaces = self.translation.spaces
        self._form: Form | None = None  # of the seeds that `reset` takes; None before the first
        self._masks = False  # whether it resets those of a mask, and no others
        self._over = np.zeros(self.count, bool)  # those that the last step of the vector ended, and no reset began
        self._seeds, self._episodes = [0] * self.count, [0] * self.count
        self._observation: Any = None  # the last batch
        self._last: list[Step] = []

    def resume(self, histories: Sequence[History]) -> list[Step]:
        """Begins an episode in every environment, and replays its actions, so that all come to their last ones
        together: [LOOP-34].

        Raises:
          ValueError: the environments cannot be seeded and reset one by one, and there is something to replay; or an
            episode ended before.
        """
        self._seeds = [history.seed for history in histories]
        self._episodes = [history.episode for history in histories]
        if not self._form:
            self._find_out()
        lengths = np.array([len(history.actions) for history in histories])
        longest = int(lengths.max())
        if longest and not (self._masks and (self._form != "one" or self.count == 1)):
            raise ValueError("environments of a vector that cannot be seeded one by one cannot repeat their episodes")
        begins = longest - lengths
        steps = self._reset(np.ones(self.count, bool))
        actions = np.zeros((self.count, self.spaces.action_size), np.float32)
        for time in range(longest):
            acts = begins <= time
            if any(is_last(steps[index]) for index in np.flatnonzero(acts).tolist()):
                raise ValueError("an episode ended before all of its actions were replayed: it is not deterministic")
            for index in np.flatnonzero(acts).tolist():
                actions[index] = histories[index].actions[time - begins[index]]
            steps |= self._advance(actions, acts)
            if (begins == time + 1).any():
                steps |= self._reset(begins == time + 1)
        self._last = [steps[index] for index in range(self.count)]
        return self._last

    def step(self, actions: np.ndarray) -> list[Step]:
        """actions: flat, [N, A]; where the last step ended an episode, they are ignored."""
        ended = np.array([is_last(step) for step in self._last])
        steps = self._advance(actions, ~ended)
        for index in np.flatnonzero(ended).tolist():
            self._episodes[index] += 1
        if ended.any():
            steps |= self._reset(ended) if self._masks else self._begun(self._observation, ended)
        self._last = [steps[index] for index in range(self.count)]
        return self._last

    def close(self) -> None:
        self._envs.close()

    def _advance(self, actions: np.ndarray, acts: np.ndarray) -> dict[int, Step]:
        """A step of the vector: what followed where `acts` [N] is true. The others take part in it, and nobody
        looks."""
        if self._mode is AutoresetMode.DISABLED and self._over.any():
            self._reset_vector(self._over)
        value = self._envs.step(self._batch(actions))
        if not isinstance(value, tuple) or len(value) != 5:
            raise self._invalid("step does not return (observations, rewards, terminations, truncations, infos)")
        self._observation, rewards, terminated, truncated, infos = value
        for name, column in (("rewards", rewards), ("terminations", terminated), ("truncations", truncated)):
            if np.shape(column) != (self.count,):
                raise self._invalid(f"the {name} have the shape {np.shape(column)}; expected ({self.count},)")
        self._over = np.asarray(terminated).astype(bool) | np.asarray(truncated).astype(bool)
        steps = {}
        for index in np.flatnonzero(acts).tolist():
            info = info_of(infos, index, self.count) if self._wants_info and self._over[index] else {}
            if self._over[index] and self._mode is AutoresetMode.SAME_STEP:
                observation, info = self._final(infos, index), info.get("final_info", {})
            else:
                observation = self._row(self._observation, index, self.count)
            self._rows[index].returned = observation, rewards[index], terminated[index], truncated[index], info
            steps[index] = self._alone[index].step(actions[index])
        return steps

    def _reset(self, mask: np.ndarray) -> dict[int, Step]:
        """The first steps of the episodes that begin where `mask` [N] is true."""
        return self._begun(self._reset_vector(mask, self._episode_seeds()), mask)

    def _begun(self, batch: Any, mask: np.ndarray) -> dict[int, Step]:
        """The first steps, from a batch of observations of all environments or of those of the mask."""
        steps: dict[int, Step] = {}
        whole = rows(self._envs.single_observation_space, batch) == self.count
        for place, index in enumerate(np.flatnonzero(mask).tolist()):
            count = self.count if whole else int(mask.sum())
            self._rows[index].returned = self._row(batch, index if whole else place, count), {}
            steps[index] = self._alone[index].reset()[0], 0.0, False, False, {}
        return steps

    def _reset_vector(self, mask: np.ndarray, seeds: Sequence[int] | None = None) -> Any:
        """Resets the environments of a mask [N]. Their observations, or those of all."""
        space = self._envs.single_observation_space
        others = [] if mask.all() else rows_of(space, self._observation, ~mask)
        options = None if mask.all() else {"reset_mask": mask.copy()}
        value: Any = self._envs.reset(seed=self._formed(seeds, mask), options=options)
        if not isinstance(value, tuple) or len(value) != 2:
            raise self._invalid("reset does not return (observations, infos)")
        if rows(space, value[0]) == self.count:
            if not mask.all() and differ(others, rows_of(space, value[0], ~mask)):
                raise self._invalid("a reset changed environments that are not in its reset_mask")
            self._observation = value[0]
        self._over = self._over & ~mask
        return value[0]

    def _find_out(self) -> None:
        """What `reset` takes, by trying. A whole reset must follow.

        Raises:
          UserError: its mode needs a mask, and it takes none.
        """
        seeds, everything = self._episode_seeds(), np.ones(self.count, bool)
        refusal: Exception | None = None
        for form in FORMS:
            self._form = form
            try:
                self._reset_vector(everything, seeds)
                break
            except REFUSALS as error:
                refusal = refusal or error
        else:
            self._form = None
            assert refusal is not None
            raise refusal
        self._masks = self.count == 1 or (self._needs_seeds_or_masks() and self._obeys_mask(seeds))
        if not self._masks and self._mode is not AutoresetMode.NEXT_STEP:
            raise UserError(
                f"task {self.task}: the vector environment resets in the mode {self._mode.name}, and its reset does "
                f"not obey options={{'reset_mask': ...}}; without it a first observation would be lost. Make it with "
                f"autoreset_mode NEXT_STEP, or give it a reset that obeys the mask"
            )

    def _needs_seeds_or_masks(self) -> bool:
        return self._form != "one" or self._mode is not AutoresetMode.NEXT_STEP

    def _obeys_mask(self, seeds: Sequence[int]) -> bool:
        """Whether a reset of environment 0 alone leaves the others where a step has brought them."""
        self._advance(np.zeros((self.count, self.spaces.action_size), np.float32), np.zeros(self.count, bool))
        try:
            self._reset_vector(np.arange(self.count) == 0, seeds)
        except Exception:  # It may refuse in any way.
            return False
        return True

    def _episode_seeds(self) -> list[int]:
        return [
            derive_seed(seed, "episode", episode) for seed, episode in zip(self._seeds, self._episodes, strict=True)
        ]

    def _formed(self, seeds: Sequence[int] | None, mask: np.ndarray) -> Any:
        """Gymnasium's own vectors take a list for all, ALE's an array for those of the mask, others one number."""
        if seeds is None:
            return None
        if self._form == "one":
            return seeds[0] if mask.all() else None
        return list(seeds) if self._form == "list" else np.array(seeds)[mask]

    def _batch(self, actions: np.ndarray) -> Any:
        space = self._envs.single_action_space
        empty: Any = create_empty_array(space, self.count)
        return concatenate(space, self.translation.batch_of_actions(actions), empty)

    def _row(self, batch: Any, index: int, count: int) -> Any:
        try:
            return row(self._envs.single_observation_space, batch, index, count)
        except ValueError as error:
            raise self._invalid(str(error)) from error

    def _final(self, infos: Any, index: int) -> Any:
        """The last observation of an episode, in the mode SAME_STEP: one of a batch, or of an array of observations."""
        if "final_obs" not in infos:
            raise self._invalid(
                "infos lacks the key 'final_obs', which the mode SAME_STEP has at the end of an episode"
            )
        batch = infos["final_obs"]
        return batch[index] if isinstance(batch, np.ndarray) else self._row(batch, index, self.count)

    def _invalid(self, message: str) -> InvalidData:
        return InvalidData(f"task {self.task}, the vector environment: {message}")


Adapted = ContractEnv | ContractVector


def count_of(env: Adapted) -> int | None:
    """How many environments a vector has; None for an environment."""
    return env.count if isinstance(env, ContractVector) else None


class _Row(gymnasium.Env[Any, Any]):
    """One environment of a vector. returned: what its next reset or step gives, since all of them move at once."""

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space
        self.returned: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.returned

    def step(self, action: Any) -> Any:
        return self.returned


class _Alone(ContractEnv):
    """Checks and translates what one environment of a vector has returned. Its action was translated with the
    others."""

    def _act(self, action: np.ndarray) -> Any:
        return self._env.step(action)


def _mode(envs: VectorEnv[Any, Any, Any], task: str) -> AutoresetMode:
    """[LOOP-74]

    Raises:
      UserError: it is not said.
    """
    mode = envs.metadata.get("autoreset_mode")
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(f"AutoresetMode.{one.name}" for one in AutoresetMode)
        raise UserError(
            f"task {task}: metadata['autoreset_mode'] of the vector environment is {mode!r}; expected one of {known} "
            f"(gymnasium.vector), which says when it resets: set it"
        ) from error
