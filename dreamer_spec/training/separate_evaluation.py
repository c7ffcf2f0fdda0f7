"""Episodes that the agent of a checkpoint plays outside of its run, on either backend: `train eval`, and `evaluate` of
dreamer_spec/api.py."""

import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_spec.backend import Learner
from dreamer_spec.disk.checkpoint import differences, open_checkpoint, space_entries
from dreamer_spec.disk.saved_agent import SavedAgent, agent_of
from dreamer_spec.envs import Adapted, Environments, Record, env_maker
from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.logger import Display
from dreamer_spec.monitoring.video import Film
from dreamer_spec.option_table import EPISODES
from dreamer_spec.options import BACKENDS, Options, names_code
from dreamer_spec.training.evaluation import Agent, Episode, play_episodes, report_failures
from dreamer_spec.training.setup import import_learner, make_learner, try_environment
from reference_numpy.training_loop import derive_seed


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Whole episodes that the agent of a checkpoint has played. `str` says return and length in one line.

    returns: of each episode, the sum of its rewards, undiscounted. lengths: in records, the reset's included.
    checkpoint: the folder of the agent. step: environment steps that it was trained for. trained_by: the backend that
    trained it last; backend and device are those that have acted. seed, mode: as they were given. env_arg, time_limit:
    of the environment.
    """

    returns: tuple[float, ...]
    lengths: tuple[int, ...]
    checkpoint: Path
    task: str
    step: int
    trained_by: str
    backend: str
    device: str
    seed: int
    mode: bool
    env_arg: Mapping[str, Any]
    time_limit: int | None

    @property
    def mean(self) -> float:
        """Of the returns."""
        return statistics.fmean(self.returns)

    @property
    def standard_error(self) -> float | None:
        """Of the mean, from the sample's standard deviation; None for one episode."""
        count = len(self.returns)
        return statistics.stdev(self.returns) / math.sqrt(count) if count > 1 else None

    def summary(self) -> dict[str, float | None]:
        """Mean, least and greatest of returns and lengths."""
        return {
            "return": self.mean,
            "return_standard_error": self.standard_error,
            "return_min": min(self.returns),
            "return_max": max(self.returns),
            "length": statistics.fmean(self.lengths),
            "length_min": min(self.lengths),
            "length_max": max(self.lengths),
        }

    def to_json(self) -> dict[str, Any]:
        """Everything, in plain JSON types."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {**fields, "checkpoint": str(self.checkpoint), **self.summary()}

    def __str__(self) -> str:
        """return 187.3 ± 4.2 (min 120, max 200), length 188.3 (min 121, max 201)"""
        error = self.standard_error
        shown = {name: f"{value:.4g}" for name, value in self.summary().items() if value is not None}
        spread = "" if error is None else f" ± {error:.2g}"
        return (
            f"return {shown['return']}{spread} (min {shown['return_min']}, max {shown['return_max']}), "
            f"length {shown['length']} (min {shown['length_min']}, max {shown['length_max']})"
        )


def evaluate_checkpoint(
    run: Path,
    *,
    episodes: int = EPISODES,
    seed: int = 0,
    mode: bool = False,
    backend: str | None = None,
    device: str | None = None,
    task: str | None = None,
    make: Callable[..., Any] | None = None,
    env_arg: Mapping[str, Any] | None = None,
    time_limit: int | None = None,
    processes: str = "auto",
    video: Path | None = None,
) -> Evaluation:
    """See `evaluate` of dreamer_spec/api.py. make: as in `Options`.

    Raises:
      UserError: a checkpoint that cannot be read, an environment that does not fit it, a film that cannot be written.
    """
    checkpoint = open_checkpoint(run)
    saved = agent_of(checkpoint)  # Before a learner is made: it has looked at the sizes.
    task = task or _task_without_code(saved)
    same = saved.info if task == saved.info["task"] else {}  # Another task has arguments of its own.
    options = Options(
        backend=backend or _trained_last(saved),
        task=task,
        make=make,
        env_arg={**same.get("env_arg", {}), **(env_arg or {})},
        time_limit=time_limit or same.get("time_limit"),
        config=saved.config,
        logdir=checkpoint.path,
        steps=0,
        seed=derive_seed(seed, "training.separate_evaluation", 0),
        device=device,
        action_repeat=saved.info["action_repeat"],
        image_size=saved.info["image_size"],
        observations=tuple(saved.spaces.observations),
        processes=processes,
    )
    learner_type = import_learner(options.backend)
    film = Film(video) if video else None
    make_env: Callable[[int], Adapted] = env_maker(options, render=film is not None)
    make_env = film.filming(make_env) if film else make_env
    with ExitStack() as stack:
        display = stack.enter_context(Display(episodes))
        trial = try_environment(options, make_env, display)
        count, own = min(saved.config.envs, episodes), trial is not None and trial.deserves_process and film is None
        envs = Environments(make_env, count, own, options.env_timeout, options.env_failures, trial, task)
        stack.enter_context(closing(envs))
        _require_same(saved, envs, f"the agent of {checkpoint.path}", f"the task {task}")
        learner = make_learner(learner_type, options, saved.spaces)
        try:
            learner.load_state_dict(checkpoint.learner)
        except ValueError as error:
            raise UserError(f"the checkpoint {checkpoint.path} does not fit this version: {error}") from error
        played = play(learner, envs, episodes, options.seed, display, mode)
        if film:
            display.say(film.save())
    return Evaluation(
        returns=tuple(episode.score for episode in played),
        lengths=tuple(episode.length for episode in played),
        checkpoint=checkpoint.path,
        task=task,
        step=saved.info["step"],
        trained_by=saved.info["backend"],
        backend=options.backend,
        device=learner.device,
        seed=seed,
        mode=mode,
        env_arg=options.env_arg,
        time_limit=options.time_limit,
    )


def play(
    learner: Learner, envs: Environments, episodes: int, seed: int, display: Display, mode: bool = False
) -> list[Episode]:
    """Whole episodes of the learner, with the seeds of a run's first evaluation. [LOOP-19], [LOOP-26], [LOOP-71]

    seed: takes the place of the run's. mode: plays the mode of the actor.

    Raises:
      UserError: an action that is not finite, or an episode that does not end.
    """
    agent, ended = Agent(learner, envs, seed, 0, mode), 0

    def act(record: Record) -> np.ndarray:
        nonlocal ended
        ended += int(record["is_last"].sum())
        display.phase("evaluation", min(ended, episodes), episodes, "episodes")
        action = np.asarray(agent(record), np.float32)
        if not np.isfinite(action).all():  # [LOOP-12]
            raise UserError(
                f"at policy step {agent.step} the action is not finite: the parameters of the checkpoint are broken"
            )
        return action

    seeds = [derive_seed(seed, "evaluation_environment", worker) for worker in range(envs.count)]
    try:
        return play_episodes(envs, act, episodes, seeds)
    finally:
        report_failures(envs, display.say)


def _require_same(saved: SavedAgent, envs: Environments, agent: str, task: str) -> None:
    """Raises:
    UserError: the environments are not such as the agent was trained in.
    """
    if envs.spaces != saved.spaces:
        raise UserError(f"{task} has the spaces {envs.spaces}; {agent} has {saved.spaces}")
    if found := differences(space_entries(saved.translation.to_json()), space_entries(envs.translation.to_json())):
        raise UserError(f"{task} is not the one that {agent} knows: {'; '.join(found[:3])}")


def _trained_last(saved: SavedAgent) -> str:
    backend: str = saved.info["backend"]
    if backend not in BACKENDS:
        raise UserError(f"the checkpoint was trained by the unknown backend {backend!r}; choose one with --backend")
    return backend


def _task_without_code(saved: SavedAgent) -> str:
    """A checkpoint may come from anywhere, so it alone does not decide which modules are imported."""
    task: str = saved.info["task"]
    if not names_code(task):
        return task
    raise UserError(
        f"the checkpoint names the task {task}, which runs code of that module; if you trust it, add --task {task}"
    )
