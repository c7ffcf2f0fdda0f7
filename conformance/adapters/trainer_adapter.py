"""The trainer as a candidate: what `train` runs of the chapters on replay and the training loop.

Nothing is computed here. Functions are those that the modules of the trainer call, looked up there at each call; what
has another form in the trainer has its arguments and its result brought into that of the interface.
"""

import contextlib
import functools
import io
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np

from conformance.running.interface import RunEnvironment, RunLearner, RunOptions
from dreamer_spec.envs import vector
from dreamer_spec.options import Options
from dreamer_spec.training import loop, setup
from dreamer_spec.translation import Entry, Translation
from spec import Config, Discrete, Image, Spaces, Vector

CALLED_BY = {"ReplayRatio": setup, "can_train": loop, "derive_seed": loop, "step_flags": vector}
"""Function of the interface that the trainer calls as it is -> the module that calls it."""


class TrainerAdapter:
    """Offers the parts of a run that are functions of their arguments, and the run as a whole."""

    def __getattr__(self, name: str) -> Any:
        if name not in CALLED_BY:
            raise AttributeError(name)
        return getattr(CALLED_BY[name], name)

    def Replay(self, capacity: int, length: int) -> Any:  # noqa: N802
        """Latents in float32, as with `--replay-deter float32`: the checks compare them bit by bit."""
        return setup.Replay(capacity, length, deter_dtype="float32")

    def make_record(
        self,
        observation: Mapping[str, Any],
        reward: float,
        flags: Mapping[str, bool],
        action: Any,
        deter: Any,
        stoch: Any,
    ) -> dict[str, np.ndarray]:
        """The record of one worker: what the environments give, and what is stored of it.

        stoch: one-hot [S, C]; a run gets the latents from its backend as class indices [S] already.
        """
        latents = {"deter": np.asarray(deter)[None], "stoch": np.argmax(stoch, axis=-1)[None]}
        record = loop.stored(vector.observed([observation], [reward], [flags]), np.asarray(action)[None], latents)
        return {key: value[0] for key, value in record.items()}

    def environment_action(
        self, action: Any, spaces: Spaces, low: Mapping[str, Any], high: Mapping[str, Any]
    ) -> dict[str, np.ndarray]:
        """What a task receives whose actions are a Dict of float64 and int64 arrays with these bounds: of each flat
        action [..., A] what `Translation.action` makes of it."""
        entries = {
            key: Entry((key,), (space.size,), "float64", tuple(low[key]), tuple(high[key]))
            if isinstance(space, Vector)
            else Entry((key,), (len(space.classes),), "int64", (0,))
            for key, space in spaces.actions.items()
        }
        translation = Translation(spaces, {}, entries)
        action = np.asarray(action)
        leading = action.shape[:-1]
        received = [translation.action(action[place]) for place in np.ndindex(leading)]
        return {key: np.reshape([one[key] for one in received], (*leading, -1)) for key in spaces.actions}

    def run(
        self,
        environment: Callable[[], RunEnvironment],
        learner: Callable[[Spaces, Config, int], RunLearner],
        options: RunOptions,
    ) -> dict[str, list[Any]]:
        """`train` with environments in its own process; what it prints is not shown.

        Raises:
          UserError: whatever ends the run early.
        """
        lines: list[dict[str, float]] = []
        wrapped = type("Wrapped", (_Backend,), {"learner": staticmethod(learner)})
        with contextlib.redirect_stdout(io.StringIO()):
            loop.run(
                _options(options, functools.partial(_Task, environment)),
                wrapped,
                lambda step, metrics: lines.append(metrics),
            )
        return {
            "episodes": [
                (line["episode/return"], line["episode/length"]) for line in lines if "episode/return" in line
            ],
            "evaluations": [line["evaluation/return"] for line in lines if "evaluation/return" in line],
        }


def _options(options: RunOptions, make: Callable[[], gymnasium.Env[Any, Any]]) -> Options:
    """As `train` has them by default, but for what the kit asks for. Nothing depends on time: a checkpoint is
    written at the end only."""
    return Options(
        backend="torch",
        task="the kit's",
        make=make,
        config=options.config,
        logdir=options.directory,
        from_=options.begin_with,
        seed=options.seed,
        steps=options.steps * options.action_repeat,
        action_repeat=options.action_repeat,
        eval_every=options.evaluate_every * options.action_repeat,
        eval_episodes=options.evaluation_episodes if options.evaluate_every else 0,
        eval_env="shared" if options.shared_environment else "own",
        nonfinite=options.nonfinite,
        random_episodes=options.random_episodes,
        checkpoint_every=float("inf"),
        log_every=float("inf"),
        processes="no",
        preflight=False,
    )


class _Task(gymnasium.Env[Any, Any]):
    """An environment of the kit with the spaces of Gymnasium."""

    def __init__(self, environment: Callable[[], RunEnvironment]) -> None:
        self._env = environment()
        spaces, low, high = self._env.spaces, self._env.low, self._env.high
        unbounded = dict.fromkeys(spaces.observations, (-np.inf, np.inf))
        self.observation_space = _gymnasium_space(spaces.observations, unbounded)
        self.action_space = _gymnasium_space(spaces.actions, {key: (low[key], high[key]) for key in low})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self._env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        return self._env.step(action)

    def close(self) -> None:
        self._env.close()


def _gymnasium_space(spaces: Mapping[str, Any], bounds: Mapping[str, tuple[Any, Any]]) -> gymnasium.spaces.Dict:
    return gymnasium.spaces.Dict(
        {
            key: gymnasium.spaces.MultiDiscrete(list(space.classes))
            if isinstance(space, Discrete)
            else gymnasium.spaces.Box(*bounds[key], (space.size,), np.float32)
            for key, space in spaces.items()
        }
    )


class _Backend:
    """A learner of the kit with what else the trainer asks of a backend: see dreamer_spec/backend.py."""

    learner: Callable[[Spaces, Config, int], RunLearner]
    device = "cpu"

    def __init__(self, spaces: Spaces, config: Config, *, seed: int, **_: Any) -> None:
        self._spaces = spaces
        self._learner = type(self).learner(spaces, config, seed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._learner, name)

    def memory(self) -> int | None:
        return None

    def gradients(self, batch: Any, seed: int) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """For the account of a step that was skipped."""
        return {}, {}

    def predict(
        self, observation: Any, prev_action: Any, is_first: np.ndarray, context: int, seed: int
    ) -> dict[str, np.ndarray]:
        """For the pictures of an evaluation: nothing is foreseen. The kit's environments have no images."""
        spaces = self._spaces.observations.items()
        sizes = {key: (space.encoded_size,) for key, space in spaces if not isinstance(space, Image)}
        scalars: dict[str, tuple[int, ...]] = {"reward": (), "continue_": ()}
        return {key: np.zeros((*is_first.shape, *size)) for key, size in {**sizes, **scalars}.items()}


def make_adapter(dtype: str, device: str | None) -> TrainerAdapter:
    """Raises:
    ValueError: a precision other than float64, or a device other than the CPU: the trainer leaves both to its backend.
    """
    if dtype != "float64" or device not in (None, "cpu"):
        asked = f"--dtype {dtype}" if dtype != "float64" else f"--device {device}"
        raise ValueError(
            f"the trainer has no {asked}: what is checked of it computes in float64 on the CPU, and precision and "
            "device are the backend's; check jax or torch"
        )
    return TrainerAdapter()
