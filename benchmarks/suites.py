"""Steps per second of a suite's environments: `python -m benchmarks.suites atari --envs 1 16 --seconds 10`.

Random actions through `dreamer_spec.envs.Environments` with the suite's protocol, as a run plays it: one environment in
this process, several in a process each. Beside it, where `BARE` knows how, the package alone. A step is one of the
agent: action repeat is in it, and so are the resets. Seconds of the processor are those of this process, so that other
load on the machine counts little; not for environments in processes of their own.
"""

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dreamer_spec.cli import parse
from dreamer_spec.envs import Environments, env_maker, random_actions
from dreamer_spec.errors import UserError
from dreamer_spec.suites import SUITES, tasks_of
from dreamer_spec.system.machine import describe

WARM_UP, RESETS = 10, 5  # steps that are not counted; resets of which the median is told

Step = Callable[[], object]


def rates(step: Step, envs: int, seconds: float) -> tuple[float, float]:
    """Steps of all environments together, per second of the clock and of the processor."""
    for _ in range(WARM_UP):
        step()
    steps, start, cpu = 0, time.perf_counter(), time.process_time()
    while (passed := time.perf_counter() - start) < seconds:
        step()
        steps += envs
    return steps / passed, steps / (time.process_time() - cpu)


def measure(task: str, envs: int, seconds: float) -> str:
    """A row for the environments of a run."""
    options = parse(["--backend", "jax", "--task", task])
    rng, processes = np.random.default_rng(0), envs > 1
    several = Environments(env_maker(options), envs, processes, task=task)
    try:
        several.reset(range(envs))
        made = np.array([random_actions(several.spaces, rng, envs) for _ in range(1000)])
        wall, cpu = rates(lambda: several.step(made[rng.integers(len(made))]), envs, seconds)
        times = []
        for repeat in range(RESETS):
            start = time.perf_counter()
            several.reset(range(repeat, repeat + envs))
            times.append(time.perf_counter() - start)
    finally:
        several.close()
    return row(f"{task}, {'processes' if processes else 'in process'}", envs, wall, None if processes else cpu, times)


def row(what: str, envs: int, wall: float, cpu: float | None, resets: list[float]) -> str:
    reset = f"{1000 * np.median(resets):.1f}" if resets else ""
    return f"| {what} | {envs} | {wall:,.0f} | {'' if cpu is None else f'{cpu:,.0f}'} | {reset} |"


# The packages alone: the name of a task and a number of environments -> one step of all of them, with random actions.
# A step of dm_control is two of the package's, as the protocol repeats actions.


def ale(game: str, envs: int) -> Step:
    """One emulator and the screen after each fourth frame, neither pooled nor resized."""
    import ale_py
    from ale_py.env import AtariEnv

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    return of_gymnasium(AtariEnv(game, frameskip=4, full_action_space=True))


def minigrid(name: str, envs: int) -> Step:
    """Its own picture of what the agent sees, 56 x 56."""
    import gymnasium
    from minigrid.wrappers import RGBImgPartialObsWrapper

    return of_gymnasium(RGBImgPartialObsWrapper(gymnasium.make(name)))


def of_gymnasium(env: Any) -> Step:
    env.reset(seed=0)

    def step() -> None:
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset()

    return step


def crafter(name: str, envs: int) -> Step:
    import crafter as package

    env, rng = package.Env(), np.random.default_rng(0)
    env.reset()

    def step() -> None:
        if env.step(rng.integers(env.action_space.n))[2]:
            env.reset()

    return step


def bsuite(name: str, envs: int) -> Step:
    import bsuite as package

    env, rng = package.load_from_id(name if "/" in name else f"{name}/0"), np.random.default_rng(0)
    env.reset()
    return lambda: env.step(rng.integers(env.action_spec().num_values))  # It resets by itself.


def dmc(name: str, envs: int) -> Step:
    _, advance = of_dm_control(name)
    return lambda: (advance(), advance())


def dmc_vision(name: str, envs: int) -> Step:
    env, advance = of_dm_control(name)
    return lambda: (advance(), advance(), env.physics.render(64, 64, camera_id=0))


def of_dm_control(name: str) -> tuple[Any, Step]:
    from dm_control import suite

    env, rng = suite.load(*name.split("-")), np.random.default_rng(0)
    spec = env.action_spec()
    env.reset()
    return env, lambda: env.step(rng.uniform(spec.minimum, spec.maximum))  # It resets by itself.


def ale_vector(game: str, envs: int) -> Step:
    """The vectorized emulator of the package, in threads: it pools and resizes by itself."""
    import ale_py

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    env = ale_py.AtariVectorEnv(
        game,
        envs,
        img_height=96,
        img_width=96,
        stack_num=1,
        repeat_action_probability=0.25,
        full_action_space=True,
        noop_max=0,
        use_fire_reset=False,
        reward_clipping=False,
    )
    env.reset(seed=0)
    return lambda: env.step(env.action_space.sample())


BARE: Mapping[str, Mapping[str, Callable[[str, int], Step]]] = {
    **{suite: {"ale_py.env.AtariEnv": ale, "ale_py.AtariVectorEnv": ale_vector} for suite in ("atari", "atari100k")},
    "bsuite": {"bsuite": bsuite},
    "crafter": {"crafter.Env": crafter},
    "minigrid": {"minigrid": minigrid},
    "dmc": {"dm_control": dmc},
    "dmc_vision": {"dm_control": dmc_vision},
}
VECTORS = (ale_vector,)  # those that are several environments


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("--task", default=None, metavar="NAME", help="of the suite; its first one")
    parser.add_argument("--envs", nargs="+", type=int, default=[1, 16])
    parser.add_argument("--seconds", type=float, default=10.0, help="for each row")
    options: Any = parser.parse_args(arguments)
    name = options.task or next(iter(tasks_of(options.suite)), None)
    if name is None:
        parser.error(f"{options.suite} has no list of tasks: --task NAME")
    print(describe())
    print("| what | environments | steps/s | steps per second of the processor | ms per reset of all |")
    print("| --- | --- | --- | --- | --- |")
    try:
        for envs in options.envs:
            print(measure(f"{options.suite}:{name}", envs, options.seconds), flush=True)
            for label, bare in BARE.get(options.suite, {}).items():
                if envs == 1 or bare in VECTORS:
                    wall, cpu = rates(bare(name, envs), envs, options.seconds)
                    print(row(f"{label}, alone", envs, wall, cpu, []), flush=True)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
