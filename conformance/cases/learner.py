"""Checks of the object that trains for days: its state, its caches and the noise that it draws by itself.

A learner says which noise it draws with a seed. What it makes of that is what the functions of spec/10-agent.md say.
"""

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any

import numpy as np

from conformance.cases.agent import (
    SAMPLING_MARGIN,
    WHOLE,
    bound_of,
    loss_magnitude,
)
from conformance.cases.sampling import (
    compare_distribution,
    compare_groups,
    compare_parameters,
    drawn_config,
    require_shape,
    signs,
    tests_of,
)
from conformance.check import script
from conformance.compare import part_of
from conformance.problems import Problem, make_problem, random_observations, random_state, spaces, with_sampling_margin
from conformance.script import Script
from conformance.statistics import confidence, normal_cdf
from reference_numpy import agent as reference
from reference_numpy import behavior, networks
from spec import Config, Discrete, Spaces, parameter_table

SEEDS = 100  # tried until rounding moves no sample of a train step into another class
ROWS = 3  # environments that act
SHARED = 0.1  # of the numbers of one kind may occur elsewhere; of independent ones in float32 some 2 % do, by chance
METHODS = ("state_dict", "load_state_dict", "train_step", "initial_carry", "policy", "train_noise", "policy_noise")


def made(script: Script, problem: Problem, seed: int = 0) -> Any:
    learner = script.call("Learner", problem.spaces, problem.config, seed)
    for name in METHODS:
        script.holds(f"a learner has the method {name}", callable(getattr(learner, name, None)))
    return learner


def small_problem(script: Script) -> Problem:
    """With steps so long that one of them shows in what the agent does."""
    setting, options = script.setting, {"warmup_steps": 0, "learning_rate": 1e-2}
    return make_problem(setting.seed, setting.profile, "both", "mixed", setting.dtype, **options)


def usual_config(script: Script) -> Config:
    """The options of the other checks, which differ from those here in the optimizer alone: the gradient that is
    compiled for them serves here too."""
    return make_problem(script.setting.seed, script.setting.profile, "both", "mixed", script.setting.dtype).config


def state_of(learner: Any, problem: Problem) -> dict[str, Any]:
    return reference.unflatten_state(learner.state_dict(), parameter_table(problem.config, problem.spaces))


def as_problem(problem: Problem, state: dict[str, Any], noise: Any) -> Problem:
    return dataclasses.replace(problem, state=state, noise={name: np.asarray(x) for name, x in noise.items()})


def with_margin(learner: Any, problem: Problem, first: int, margin: float) -> tuple[int, Problem]:
    """The first seed with which no sample lies near a boundary, and the problem with its noise."""
    state, tried = state_of(learner, problem), []

    def draw(attempt: int) -> Problem:
        tried.append(first + attempt)
        return as_problem(problem, state, learner.train_noise(problem.batch, tried[-1]))

    found = with_sampling_margin(draw, margin, attempts=SEEDS)
    return tried[-1], found


def compare_step(
    script: Script,
    learner: Any,
    problem: Problem,
    first: int,
    where: str,
    config: Config,
    margin: float = SAMPLING_MARGIN,
) -> int:
    """One train step from the learner's present state against the reference; returns its seed.

    config: with which the candidate is asked for the gradient. margin: see `with_sampling_margin`.
    """
    seed, problem = with_margin(learner, problem, first, margin)
    gradients = script.call("gradients", *dataclasses.replace(problem, config=config).loss_arguments)
    metrics, latents = learner.train_step(problem.batch, seed)
    inputs = (problem.state, problem.batch, problem.noise, gradients, problem.spaces, problem.config)
    new, aux = reference.train_step(*inputs)
    size, bound = loss_magnitude(aux), bound_of(script.setting, 1e-9, 2e-3)
    for name, mean in aux["losses"].items():
        script.compare(f"{where}: loss/{name}", metrics[f"loss/{name}"], mean, magnitude=size, bound=bound)
    script.compare(f"{where}: deter", latents["deter"], aux["deter"], magnitude=1.0, bound=max(bound, 1e-6))
    script.exact(f"{where}: stoch", np.asarray(latents["stoch"]), aux["stoch"].argmax(-1))
    compare_states(script, learner, problem, new, where, bound)
    return seed


def compare_states(
    script: Script, learner: Any, before: Problem, expected: dict[str, Any], where: str, bound: float
) -> None:
    """The learner's state against an expected one: parameters relative to how far they moved, as `float32` holds
    them."""
    state, u = state_of(learner, before), 2.0**-23
    script.exact(f"{where}: step", state["optimizer"]["step"], expected["optimizer"]["step"])
    for group in ("params", "slow_critic"):
        for name, value in expected[group].items():
            moved = np.abs(value - before.state[group][name]).max() + u / bound * np.abs(value).max()
            how = {"magnitude": max(moved, 1e-12), "bound": bound}
            script.compare(f"{where}: {group}/{name}", state[group][name], value, **how)
    for at in (("optimizer", "second_moment"), ("optimizer", "momentum")):
        how = {"magnitude": "tensor", "bound": max(bound, 1e-6)}
        script.compare(f"{where}: {at[1]}", part_of(state, at), part_of(expected, at), **how)
    how = {"magnitude": 1.0, "bound": max(bound, 1e-6)}
    script.compare(f"{where}: return_range", state["return_range"], expected["return_range"], **how)


def compare_acting(script: Script, learner: Any, problem: Problem, seed: int, where: str) -> None:
    """Two steps of a few environments, the second of them with a reset, by the parameters of the present state."""
    rng, config = np.random.default_rng(seed), problem.config
    params, carry = state_of(learner, problem)["params"], learner.initial_carry(ROWS)
    expected = {"deter": np.zeros((ROWS, config.deter)), "stoch": np.zeros((ROWS, config.stoch, config.classes))}
    action = np.zeros((ROWS, problem.spaces.action_size))
    bound = bound_of(script.setting, 1e-6, 1e-3)
    for step, is_first in enumerate((np.ones(ROWS, bool), np.arange(ROWS) == 1)):
        observation = random_observations(rng, problem.spaces, (ROWS,))
        noise = {name: np.asarray(x) for name, x in learner.policy_noise(ROWS, seed + step).items()}
        taken, latents, carry = learner.policy(observation, is_first, carry, seed + step)
        inputs = (expected, action, observation, is_first, noise, problem.spaces, config)
        expected, action = reference.policy_step(params, *inputs)
        label = f"{where}, acting step {step}"
        script.compare(f"{label}: deter", latents["deter"], expected["deter"], magnitude=1.0, bound=bound)
        script.exact(f"{label}: stoch", np.asarray(latents["stoch"]), expected["stoch"].argmax(-1))
        script.compare(f"{label}: action", taken, action, magnitude=1.0, bound=bound)


@script("AGT-7", "AGT-8", "AGT-29", "AGT-30", "CON-20", uses=["Learner", "gradients"], level=3, dtypes=WHOLE)
def train_steps_match(script: Script) -> None:
    """Two train steps from a fresh state, whose moments are zero, and one of another learner with other options from
    the middle of training; each with the learner's own noise, and after each the whole state."""
    problem = small_problem(script)
    learner = made(script, problem)
    fresh = state_of(learner, problem)
    compare_states(script, learner, dataclasses.replace(problem, state=fresh), fresh_like(fresh), "fresh", 1e-6)
    config = usual_config(script)
    seed = compare_step(script, learner, problem, 1, "first train step", config)
    compare_step(script, learner, problem, seed + 1, "second train step", config)
    rng = np.random.default_rng(script.setting.seed)
    options: dict[str, Any] = {"learning_rate": 3e-3, "beta1": 0.8, "agc_clip": 0.1}
    other = dataclasses.replace(problem, config=dataclasses.replace(problem.config, **options))
    learner = made(script, other)
    learner.load_state_dict(
        reference.flatten_state(random_state(rng, other.config, other.spaces, script.setting.dtype))
    )
    compare_step(script, learner, other, seed + SEEDS, "train step from the middle", config)


def fresh_like(state: dict[str, Any]) -> dict[str, Any]:
    return reference.initial_state(state["params"])


@script("AGT-3", "AGT-4", "AGT-5", "AGT-6", "LAY-9", "LAY-10", uses=["Learner"], level=3, dtypes=WHOLE)
def fresh_parameters_have_their_distribution(script: Script) -> None:
    """Those that a learner begins with: names, shapes, zeros, ones and kernels that are drawn, each for itself."""
    task, config = spaces(), drawn_config(script)
    learner = script.call("Learner", task, config, script.setting.seed)
    state = reference.unflatten_state(learner.state_dict(), parameter_table(config, task))
    compare_parameters(script, task, config, state["params"])


@script("AGT-11", "LOOP-18", "BEH-8", uses=["Learner"], level=3, dtypes=WHOLE)
def acting_uses_the_newest_parameters(script: Script) -> None:
    """Before the first train step, after one, and after a state was loaded."""
    problem = small_problem(script)
    learner = made(script, problem)
    state = random_state(script.setting.rng(), problem.config, problem.spaces, script.setting.dtype)
    compare_acting(script, learner, problem, 10, "fresh")
    learner.load_state_dict(reference.flatten_state(state))
    compare_acting(script, learner, problem, 20, "loaded")
    learner.train_step(problem.batch, 1)
    compare_acting(script, learner, problem, 30, "trained")


@script("AGT-13", "RSSM-13", uses=["Learner"], level=3)
def acting_leaves_its_carry_as_it_was(script: Script) -> None:
    """A step that resets a row of a carry changes nothing of what another step makes of the same carry."""
    problem = small_problem(script)
    learner = made(script, problem)
    carry, goes_on, reset = learner.initial_carry(ROWS), np.zeros(ROWS, bool), np.arange(ROWS) == 1
    observation = random_observations(np.random.default_rng(1), problem.spaces, (ROWS,))
    for seed, flags in enumerate((~goes_on, goes_on, goes_on)):  # a fresh agent's memory is still 0 after the first
        carry = learner.policy(observation, flags, carry, seed)[2]
    before, other, after = (learner.policy(observation, flags, carry, 3) for flags in (goes_on, reset, goes_on))
    script.holds("a reset shows in the memory", np.any(np.asarray(other[1]["deter"]) != np.asarray(before[1]["deter"])))
    for index, name in enumerate(("action", "latents")):
        script.compare(f"{name} of the same step again", after[index], before[index], magnitude=1.0, bound=0.0)


@script("AGT-8", "AGT-9", "AGT-10", uses=["Learner"], level=3)
def a_state_is_everything(script: Script) -> None:
    """A learner that takes over a state goes on as the one that it is from, bit for bit, whatever it did before, and
    predicts the same, if it has a `predict`; and what was given out stays as it was."""
    problem = small_problem(script)
    one, other = made(script, problem), made(script, problem, 1)
    for seed in (5, 6, 7):  # more updates than the state that it takes over has
        other.train_step(problem.batch, seed)
    predicted(other, problem)
    for seed in (1, 2):
        one.train_step(problem.batch, seed)
    kept = one.state_dict()
    given = {name: np.array(value) for name, value in kept.items()}
    other.load_state_dict(kept)
    script.compare("predictions", predicted(other, problem), predicted(one, problem), magnitude=1.0, bound=0.0)
    for learner in (one, other):
        learner.train_step(problem.batch, 3)
    after = one.state_dict()
    script.compare("the state that was given out, after another step", kept, given, magnitude=1.0, bound=0.0)
    script.compare("the state after one more step", other.state_dict(), after, magnitude=1.0, bound=0.0)
    moved = [name for name in given if not np.array_equal(after[name], given[name])]
    for part in ("params/", "slow_critic/", "optimizer/second_moment/", "optimizer/momentum/", "return_range/"):
        script.holds(f"a train step changes {part}...", any(name.startswith(part) for name in moved))


def predicted(learner: Any, problem: Problem) -> dict[str, np.ndarray]:
    """The open-loop prediction of the batch after its first step; {} where the learner has none."""
    if not callable(getattr(learner, "predict", None)):
        return {}
    batch = problem.batch
    observation = {key: batch[key] for key in problem.spaces.observations}
    found = learner.predict(observation, batch["prev_action"], batch["is_first"], 1, 4)
    return {name: np.asarray(value) for name, value in found.items()}


@script("LOOP-71", uses=["Learner"], level=3, dtypes=WHOLE)
def the_mode_takes_the_place_of_the_sample(script: Script) -> None:
    """Of a learner whose `policy` has a `mode`: the mean of each number and the first most probable class, after the
    same sampled latents."""
    problem = small_problem(script)
    learner = made(script, problem)
    if "mode" not in inspect.signature(learner.policy).parameters:
        raise NotImplementedError("policy has no mode")
    state = random_state(script.setting.rng(), problem.config, problem.spaces, script.setting.dtype)
    learner.load_state_dict(reference.flatten_state(state))
    observation = random_observations(np.random.default_rng(1), problem.spaces, (ROWS,))
    first = np.ones(ROWS, bool)
    _, latents, _ = learner.policy(observation, first, learner.initial_carry(ROWS), 3)
    action, same, _ = learner.policy(observation, first, learner.initial_carry(ROWS), 3, mode=True)
    script.compare("latents", same, latents, magnitude=1.0, bound=0.0)
    stoch = np.eye(problem.config.classes)[np.asarray(latents["stoch"])]
    feature = networks.feature(np.asarray(latents["deter"], np.float64), stoch)
    expected = behavior.mode_action(
        networks.actor(state["params"], feature, problem.spaces, problem.config), problem.spaces, problem.config
    )
    script.compare("action", action, expected, magnitude=1.0, bound=bound_of(script.setting, 1e-6, 1e-3))


@script("LOOP-18", "LOOP-25", uses=["Learner"], level=3)
def looking_changes_nothing(script: Script) -> None:
    """A learner that acts, and that shows its noise and its state, trains on like one that does not, bit for bit."""
    problem = small_problem(script)
    quiet, asked = made(script, problem), made(script, problem)
    observation = random_observations(np.random.default_rng(1), problem.spaces, (ROWS,))
    carry, is_first = asked.initial_carry(ROWS), np.ones(ROWS, bool)
    for seed in (1, 2):
        for learner in (quiet, asked):
            learner.train_step(problem.batch, seed)
        carry = asked.policy(observation, is_first, carry, seed)[2]
        asked.policy(observation, ~is_first, carry, 7)
        asked.policy_noise(ROWS, 8), asked.train_noise(problem.batch, 9), asked.state_dict()
    script.compare("the state", asked.state_dict(), quiet.state_dict(), magnitude=1.0, bound=0.0)


@script("LOOP-40", "LOOP-41", uses=["Learner"], level=3)
def a_step_that_is_not_finite_changes_nothing(script: Script) -> None:
    """A NaN among the rewards of the batch leaves the whole state as it was and is counted. Of the steps that follow
    all are made or, by a learner that stops, none until it takes over a state."""
    problem = small_problem(script)
    learner = made(script, problem)
    learner.train_step(problem.batch, 1)
    before = {name: np.array(value) for name, value in learner.state_dict().items()}
    reward = np.array(problem.batch["reward"])
    reward[-1, -1] = np.nan
    metrics, _ = learner.train_step({**problem.batch, "reward": reward}, 2)
    script.exact("skipped", float(metrics["skipped"]), 1.0)
    script.compare("the state after it", learner.state_dict(), before, magnitude=1.0, bound=0.0)
    skipped = [float(learner.train_step(problem.batch, seed)[0]["skipped"]) for seed in (3, 4, 5)]
    script.holds("of the steps that follow all are made or none", len(set(skipped)) == 1)
    learner.load_state_dict(before)
    metrics, _ = learner.train_step(problem.batch, 6)
    script.exact("skipped, of a step with finite numbers", float(metrics["skipped"]), 0.0)
    after = learner.state_dict()
    script.holds("it goes on", any(not np.array_equal(after[name], value) for name, value in before.items()))


def numbers_of(noise: dict[str, np.ndarray], task: Spaces) -> Iterator[tuple[str, np.ndarray, bool]]:
    """Each kind of number of a train step's noise, and whether it is uniform."""
    yield "posterior", noise["posterior"], True
    yield "prior", noise["prior"], True
    column = 0
    for key, space in task.actions.items():
        size = space.array_shape[0]
        yield f"action {key}", noise["action"][..., column : column + size], isinstance(space, Discrete)
        column += size


@script("CON-19", "CON-20", "CON-21", "LOOP-25", uses=["Learner"], level=3)
def noise_is_independent(script: Script) -> None:
    """The noise of two train steps: shapes, distributions, neighbours along every axis, and no number twice."""
    sizes = {"batch_size": 16, "batch_length": 32, "imagination_horizon": 15}
    setting, task = script.setting, spaces("vector", "mixed")
    problem = make_problem(setting.seed, setting.profile, "vector", "mixed", setting.dtype, **sizes)
    config = problem.config
    # The batch is not the configured one: what counts is the batch.
    learner = made(script, dataclasses.replace(problem, config=dataclasses.replace(config, batch_size=7)))
    starts = config.batch_size * config.batch_length
    shapes = {
        "posterior": (config.batch_size, config.batch_length, config.stoch),
        "prior": (starts, config.imagination_horizon, config.stoch),
        "action": (starts, config.imagination_horizon, task.action_noise_size),
    }
    found: dict[str, tuple[np.ndarray, bool]] = {}
    for seed in (1000 * setting.seed + 1, 1000 * setting.seed + 2):
        noise = {name: np.asarray(x, np.float64) for name, x in learner.train_noise(problem.batch, seed).items()}
        for name, shape in shapes.items():
            require_shape(script, f"noise of {name}", noise[name], shape)
        for label, numbers, uniform in numbers_of(noise, task):
            found[f"{label}, seed {seed}"] = numbers, uniform
    level = confidence(len(found) * (1 + 3 * tests_of([2, 2])))
    for label, (numbers, uniform) in found.items():
        cdf = (lambda x: np.clip(x, 0, 1)) if uniform else normal_cdf
        compare_distribution(script, label, numbers.ravel(), cdf, level)
        sign = numbers - 0.5 if uniform else numbers
        for axis in range(numbers.ndim):
            if numbers.shape[axis] > 1:
                pair = (np.delete(sign, -1, axis).ravel(), np.delete(sign, 0, axis).ravel())
                groups = dict(zip(("here", "next"), map(signs, pair), strict=True))
                compare_groups(script, f"{label}, neighbours along axis {axis}: ", groups, level)
    for label, (numbers, _) in found.items():
        others = np.concatenate([x.ravel() for name, (x, _) in found.items() if name != label])
        script.holds(f"{label}: numbers that occur elsewhere too", np.isin(numbers, others).mean() < SHARED)
        script.holds(f"{label}: numbers that occur twice", len(np.unique(numbers)) > (1 - SHARED) * numbers.size)
