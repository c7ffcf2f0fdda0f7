"""Training, evaluation and policies from Python, with the names and meanings of the command line: docs/python.md.

What is not light, such as Gymnasium, is imported when it is needed: a policy acts with NumPy alone.
"""

from dreamer_spec import own_packages  # noqa: F401
from dreamer_spec.system import before_numpy  # noqa: F401

# isort: split
import contextlib
import dataclasses
import functools
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dreamer_spec import options as runs
from dreamer_spec.errors import UserError
from dreamer_spec.option_table import EPISODES, EVAL_OPTIONS, RUN, checked, options_by_group
from dreamer_spec.options import Options
from spec import hyperparameters as known_hyperparameters

if TYPE_CHECKING:
    import gymnasium

    from dreamer_spec.monitoring.outcome import Mean
    from dreamer_spec.policy import Policy
    from dreamer_spec.training.separate_evaluation import Evaluation

Folder = str | os.PathLike[str]
Callback = Callable[[int, dict[str, float]], object]


@dataclasses.dataclass(frozen=True)
class Training:
    """What came of a run. `str` says it in one line.

    checkpoint: the newest, in the log directory. step: environment steps, with action repeat. finished: whether all
    steps were made and evaluated; False if the callback has stopped the run. score: mean return and its standard error
    (`score.value`, `score.error`) in the last evaluation or, without any, in the last 20 episodes of training; random:
    of the random policy. None where no episode was played.
    """

    logdir: Path
    checkpoint: Path
    step: int
    finished: bool
    score: "Mean | None"
    random: "Mean | None"

    def __str__(self) -> str:
        from dreamer_spec.monitoring.outcome import Outcome, last_words

        how = "" if self.finished else "stopped "
        return f"{how}at step {self.step:,}: {last_words(Outcome(self.score, self.random), None)}; {self.logdir}"


def make_options(
    backend: Literal["jax", "torch"],
    task: "str | Callable[..., gymnasium.Env[Any, Any]] | None" = None,
    *,
    preset: str | None = None,
    size: str | None = None,
    profile: str | None = None,
    steps: int | None = None,
    seed: int | None = None,
    logdir: Folder | None = None,
    from_: Folder | None = None,
    resume: Literal["auto", "never", "must"] | None = None,
    device: str | None = None,
    threads: int | None = None,
    nonfinite: Literal["stop", "skip"] | None = None,
    preflight: bool | None = None,
    wandb: str | None = None,
    env_arg: Mapping[str, Any] | None = None,
    time_limit: int | None = None,
    action_repeat: int | None = None,
    image_size: int | None = None,
    observations: Sequence[str] | None = None,
    leave_out: Sequence[str] | None = None,
    processes: Literal["auto", "yes", "no"] | None = None,
    env_timeout: float | None = None,
    env_failures: int | None = None,
    restore_envs: bool | None = None,
    info_metrics: Sequence[str] | None = None,
    replay_memory: float | None = None,
    replay_deter: Literal["bfloat16", "float32"] | None = None,
    eval_every: int | None = None,
    eval_env: Literal["own", "shared"] | None = None,
    train_when: Literal["always", "between-episodes"] | None = None,
    eval_episodes: int | None = None,
    random_episodes: int | None = None,
    checkpoint_every: float | None = None,
    keep_checkpoints: int | None = None,
    log_every: float | None = None,
    **hyperparameters: Any,
) -> Options:
    """The options of a run. What each one means, `train --help` says; what is None comes from the preset.

    task: SUITE:NAME as on the command line, or a function or class that makes a gymnasium.Env, called with `env_arg`
    for each environment, or a gymnasium.vector.VectorEnv of all of them. The run is then known by its name,
    `my_module:make_env`. It may be a lambda, or stand in the script itself; environments that have processes of their
    own get it by cloudpickle.
    hyperparameters: by their names in spec/hyperparameters.md, such as learning_rate=1e-4.

    Raises:
      UserError: an unknown option, or a value that no run could have; the message names the keyword.
    """
    given = dict(locals())
    given |= given.pop("hyperparameters")
    with naming_keywords():
        given["task"], make = _named(task)
        values = checked(given, chain.from_iterable(options_by_group().values()))
        changed = {name: value for name, value in values.items() if name in known_hyperparameters()}
        chosen = {name: value for name, value in values.items() if name not in changed}
        chosen["make"] = make
        return runs.assemble_options(chosen.pop("backend"), chosen, changed, chosen.pop("preset", None))


def train(options: Options, callback: Callback | None = None) -> Training:
    """Trains, or continues the run that is in `options.logdir`.

    callback: called with step and metrics each time a line of metrics is written, with the names of docs/metrics.md. If
    it returns False, the run is saved and ends. What it raises ends the run at once, with the checkpoints that it has.

    A signal such as Ctrl-C saves the run too, and is raised when that is done: a script does not go on with its next
    line as if all were well. The second one ends the process. In a thread that is not the main one, signals are none of
    this function's business. Afterwards they are handled as they were before.

    Raises:
      UserError: whatever the user can mend.
      KeyboardInterrupt: a signal has come, SIGTERM included. The text says where the run is saved.
    """
    from dreamer_spec.disk import checkpoint
    from dreamer_spec.monitoring.outcome import read_outcome
    from dreamer_spec.system.signals import Stopped, stoppable
    from dreamer_spec.training import loop

    try:
        with naming_keywords(), stoppable() as signals:
            finished = loop.run(options, watch=callback)
            newest = checkpoint.candidates(options.logdir)[0]
            if signals.received:
                raise Stopped(f"the run is saved in {newest}; the same options continue it")
            outcome = read_outcome(options.logdir)
    except Stopped as error:  # Python ends a script as a shell expects only where it is no kind of KeyboardInterrupt.
        raise KeyboardInterrupt(*error.args) from None
    return Training(options.logdir, newest, int(newest.name), finished, outcome.score, outcome.random)


def evaluate(
    run: Folder,
    episodes: int = EPISODES,
    *,
    mode: bool = False,
    seed: int = 0,
    backend: Literal["jax", "torch"] | None = None,
    device: str | None = None,
    task: "str | Callable[..., gymnasium.Env[Any, Any]] | None" = None,
    env_arg: Mapping[str, Any] | None = None,
    time_limit: int | None = None,
    processes: Literal["auto", "yes", "no"] = "auto",
    video: Folder | None = None,
) -> "Evaluation":
    """Plays whole episodes with an agent, on either backend.

    run: a log directory, which stands for its newest checkpoint, or one of the folders in its checkpoints/.
    mode: the mode of the actor instead of a sample ([LOOP-71]). seed: of environments and actions; never those of the
    run. task, env_arg, time_limit: in place of those of training. The task is needed where it was a callable or names a
    module: a checkpoint alone does not decide whose code runs. video: FILE.gif or FILE.mp4.

    Raises:
      UserError: a checkpoint that cannot be read, an environment that does not fit it, a wrong option.
    """
    given = dict(locals())
    with naming_keywords():
        folder = RUN.of_value("run", given.pop("run"))
        given["task"], make = _named(task)
        values = checked(given, EVAL_OPTIONS)
        from dreamer_spec.training.separate_evaluation import evaluate_checkpoint

        return evaluate_checkpoint(folder, make=make, **values)


def load_policy(path: Folder) -> "Policy":
    """The policy of a folder that `train export` wrote, or of a run or a checkpoint. It acts with NumPy alone:
    docs/policy.md.

    Raises:
      UserError: it is missing, damaged or of another format.
    """
    from dreamer_spec.disk.checkpoint import open_checkpoint
    from dreamer_spec.disk.saved_agent import acting_table, agent_of
    from dreamer_spec.policy import DESCRIPTION, Policy

    path = Path(path)
    if (path / DESCRIPTION).exists() or not path.exists():
        return Policy.load(path)
    saved = agent_of(open_checkpoint(path))
    acting = {name: saved.parameters[name] for name in acting_table(saved.config, saved.spaces)}
    return Policy(dataclasses.replace(saved, parameters=acting))


@contextlib.contextmanager
def naming_keywords() -> Iterator[None]:
    """Messages of the command name its options: --env-timeout becomes env_timeout, --no-preflight preflight=False."""
    try:
        yield
    except UserError as error:
        error.args = (_FLAG.sub(_keyword, str(error)),)
        raise


_FLAG = re.compile(r"(?<![\w-])--(no-)?([a-z]+(?:-[a-z]+)*)")


def _keyword(flag: re.Match[str]) -> str:
    options = chain(EVAL_OPTIONS, *options_by_group().values())
    name = {option.flag: option.name for option in options}.get(f"--{flag[2]}")
    if name is None:
        return flag[0]
    return f"{name}=False" if flag[1] else name


def _named(task: Any) -> tuple[str | None, Callable[..., Any] | None]:
    """A task's name, and the callable if it is one. What a script defines bears the script's name, as if it were
    imported from there; that name means it too, for the import would run the script again."""
    if task is None:
        return None, None
    if isinstance(task, str):
        module, _, name = task.partition(":")
        if module != _script():
            return task, None
        if not callable(found := getattr(sys.modules["__main__"], name, None)):
            raise UserError(f"task is {task!r}, and this script has no function {name}; give the function itself")
        return task, found
    if not callable(task):
        raise UserError(
            f"task is {task!r:.200}; expected SUITE:NAME, or a function or class that makes a gymnasium.Env"
        )
    inner = task
    while isinstance(inner, functools.partial):
        inner = inner.func
    module, name = inner.__module__, getattr(inner, "__qualname__", type(inner).__qualname__)
    return f"{_script() if module == '__main__' else module}:{name}", task


def _script() -> str:
    """The name under which the main module could be imported, if it is a script."""
    main = sys.modules["__main__"]
    return main.__spec__.name if main.__spec__ else Path(getattr(main, "__file__", "__main__")).stem
