"""`train eval CHECKPOINT`: plays episodes with the agent of a checkpoint, on either backend."""

import argparse
import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np

from dreamer_spec import arguments as keywords
from dreamer_spec.backend import Learner
from dreamer_spec.cli import BACKENDS, Parser
from dreamer_spec.disk.checkpoint import differences, open_checkpoint, space_entries
from dreamer_spec.disk.files import replacing, require_place
from dreamer_spec.disk.saved_agent import SavedAgent, agent_of
from dreamer_spec.envs import ContractEnv, Environments, Record, env_maker, try_out
from dreamer_spec.errors import UserError, writing
from dreamer_spec.monitoring.logger import Display
from dreamer_spec.monitoring.video import Film
from dreamer_spec.options import Options, names_code
from dreamer_spec.training.evaluation import Agent, Episode, play_episodes, report_failure, report_failures
from dreamer_spec.training.setup import import_learner, make_learner
from dreamer_spec.words import counted
from reference_numpy.training_loop import derive_seed

DESCRIPTION = """Play episodes with the agent of a checkpoint. It samples its actions, as in training, unless --mode is
given.

  train eval runs/CartPole-v1-jax-seed0
  train eval runs/CartPole-v1-jax-seed0/checkpoints/000000020000 --episodes 100 --backend torch --json returns.json"""


def main(arguments: Sequence[str]) -> int:
    """Runs the command. Returns the exit code.

    Raises:
      UserError: a wrong option, a checkpoint that cannot be read, an environment that does not fit it, a file that
        cannot be written.
    """
    values = _parse(arguments)
    if values.json:
        with writing(values.json):
            require_place(values.json)
    checkpoint = open_checkpoint(values.checkpoint)
    saved = agent_of(checkpoint)  # Before a learner is made: it has looked at the sizes.
    task = values.task or _task_without_code(saved)
    same = saved.info if task == saved.info["task"] else {}  # Another task has arguments of its own.
    options = Options(
        backend=values.backend or _trained_last(saved),
        task=task,
        env_arg={**same.get("env_arg", {}), **keywords.join(values.env_arg or [])},
        time_limit=values.time_limit or same.get("time_limit"),
        config=saved.config,
        logdir=checkpoint.path,
        steps=0,
        seed=derive_seed(values.seed, "separate_evaluation", 0),
        device=values.device,
        action_repeat=saved.info["action_repeat"],
        image_size=saved.info["image_size"],
        observations=tuple(saved.spaces.observations),
    )
    learner_type = import_learner(options.backend)
    film = Film(values.video) if values.video else None
    make: Callable[[int], ContractEnv] = env_maker(options, render=film is not None)
    make = film.filming(make) if film else make
    count = min(saved.config.envs, values.episodes)
    with ExitStack() as stack:
        display = stack.enter_context(Display(values.episodes))
        trial = try_out(
            make, lambda failure: report_failure(failure, display.say), options.task, options.seed, options.env_timeout
        )
        processes = trial.deserves_process and film is None
        envs = Environments(make, count, processes, options.env_timeout, options.env_failures, trial, options.task)
        stack.enter_context(closing(envs))
        if envs.spaces != saved.spaces:
            raise UserError(
                f"the task {options.task} has the spaces {envs.spaces}; the agent of "
                f"{checkpoint.path} has {saved.spaces}"
            )
        if found := differences(space_entries(saved.translation.to_json()), space_entries(envs.translation.to_json())):
            raise UserError(
                f"the task {options.task} is not the one that the agent of "
                f"{checkpoint.path} knows: {'; '.join(found[:3])}"
            )
        learner = make_learner(learner_type, options, saved.spaces)
        try:
            learner.load_state_dict(checkpoint.learner)
        except ValueError as error:
            raise UserError(f"the checkpoint {checkpoint.path} does not fit this version: {error}") from error
        episodes = play(learner, envs, values.episodes, options.seed, display, values.mode)
    summary = summarize(episodes)
    where = f"{options.backend} on {learner.device}{', by the mode' if values.mode else ''}"
    played = counted(len(episodes), "episode")
    print(f"{checkpoint.path}: {options.task}, step {saved.info['step']:,}; {played} with {where}, seed {values.seed}")
    print(sentence(summary))
    if film:
        print(film.save())
    if values.json:
        run = {
            "checkpoint": str(checkpoint.path),
            "task": options.task,
            "step": saved.info["step"],
            "trained_by": saved.info["backend"],
        }
        run |= {"env_arg": options.env_arg, "time_limit": options.time_limit}
        run |= {"backend": options.backend, "device": learner.device, "seed": values.seed, "mode": values.mode}
        lists = {
            "returns": [episode.score for episode in episodes],
            "lengths": [episode.length for episode in episodes],
        }
        with writing(values.json), replacing(values.json) as file:
            file.write((json.dumps({**run, **summary, **lists}, indent=2) + "\n").encode())
    return 0


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


def summarize(episodes: Sequence[Episode]) -> dict[str, float | None]:
    """The standard error is that of the mean, from the sample's standard deviation; None for one episode."""
    scores, lengths = [episode.score for episode in episodes], [episode.length for episode in episodes]
    return {
        "return": statistics.fmean(scores),
        "return_standard_error": statistics.stdev(scores) / math.sqrt(len(scores)) if len(scores) > 1 else None,
        "return_min": min(scores),
        "return_max": max(scores),
        "length": statistics.fmean(lengths),
        "length_min": min(lengths),
        "length_max": max(lengths),
    }


def sentence(summary: Mapping[str, float | None]) -> str:
    """return 187.3 ± 4.2 (min 120, max 200), length 188.3 (min 121, max 201)"""
    error = summary["return_standard_error"]
    shown = {name: f"{value:.4g}" for name, value in summary.items() if value is not None}
    spread = "" if error is None else f" ± {error:.2g}"
    return (
        f"return {shown['return']}{spread} (min {shown['return_min']}, max {shown['return_max']}), "
        f"length {shown['length']} (min {shown['length_min']}, max {shown['length_max']})"
    )


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = Parser(
        prog="train eval",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "checkpoint",
        type=Path,
        help="a log directory (its newest checkpoint), or one of the folders in its checkpoints/",
    )
    parser.add_argument("--episodes", type=int, default=10, metavar="N", help="how many (default 10)")
    parser.add_argument(
        "--backend", choices=BACKENDS, help="which implementation acts (default: the one that trained last)"
    )
    parser.add_argument("--device", metavar="NAME", help="cpu, gpu, cuda:1, ... (default: the backend's choice)")
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="of environments and actions; never those of the run (default 0)",
    )
    parser.add_argument(
        "--task",
        metavar="SUITE:NAME",
        help="play this task instead; needed where the checkpoint names a module, whose code would run",
    )
    parser.add_argument(
        "--env-arg",
        type=keywords.read,
        action="append",
        metavar="NAME=VALUE",
        help=(
            "keyword argument of the environment in place of that of training, the value as JSON or else as "
            "text; one option for each"
        ),
    )
    parser.add_argument(
        "--time-limit",
        type=int,
        metavar="N",
        help="steps of the environment that truncate an episode (default: that of training)",
    )
    parser.add_argument(
        "--mode",
        action="store_true",
        help="the most probable action instead of a sample; latents are sampled all the same",
    )
    parser.add_argument(
        "--video", type=Path, metavar="FILE", help="a film of the first episode of environment 0: FILE.gif or FILE.mp4"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the summary and every return and length")
    values = parser.parse_args(arguments)
    if values.episodes < 1 or values.seed < 0:
        parser.error(f"expected at least one episode and a seed of at least 0, got {values.episodes} and {values.seed}")
    if values.time_limit is not None and values.time_limit < 1:
        parser.error(f"--time-limit is {values.time_limit}; expected at least 1")
    return values


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
