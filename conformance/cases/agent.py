"""Checks of spec/10-agent.md: training steps, the policy step and initialization. Whole losses: cases/losses.py."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from conformance.case import Cases, Equal, Setting, equal, exactly, judged, refused, related
from conformance.check import check, script
from conformance.compare import Comparisons, part_of
from conformance.problems import (
    Problem,
    action_noise,
    make_problem,
    random_actions,
    random_carry,
    random_observations,
    random_parameters,
    small_config,
    spaces,
    uniforms,
    with_sampling_margin,
)
from conformance.script import Script
from reference_numpy import agent as reference
from spec import Discrete, Image, Parameter, Spaces, parameter_table

# Vectors, images and both; discrete, continuous and mixed actions.
COMBINATIONS = (
    ("vector", "discrete"),
    ("vector", "continuous"),
    ("image", "discrete"),
    ("image", "continuous"),
    ("both", "mixed"),
)
SAMPLING_MARGIN = 1e-4
WHOLE = ("float64", "float32")  # in bfloat16 a sample can fall into another class, after which nothing is comparable
# In float32, whose rounding moves losses by less than 1e-6; weights that are one discount off move them by 3e-5.
LOSS_BOUND = 1e-5
GROUPS = {
    "encoder": ("encoder/",),
    "core": ("rssm/embed", "rssm/hidden", "rssm/gru"),
    "posterior": ("rssm/posterior",),
    "prior": ("rssm/prior",),
    "decoder": ("decoder/",),
    "reward": ("reward/",),
    "continue": ("continue/",),
    "actor": ("actor/",),
    "critic": ("critic/",),
}


def bound_of(setting: Setting, double: float, single: float) -> float:
    return double if setting.dtype == "float64" else single


def safe_problem(seed: int, profile: str, observation: str, action: str, dtype: str) -> Problem:
    """A problem in which honest rounding moves no sample into another class, and free nats clip some time steps and not
    others."""

    def draw(attempt: int) -> Problem:
        return make_problem(1000 * seed + attempt, profile, observation, action, dtype)

    return with_sampling_margin(draw, SAMPLING_MARGIN, clips_some)


def clips_some(problem: Problem) -> bool:
    unclipped = dataclasses.replace(problem, config=dataclasses.replace(problem.config, free_nats=0.0))
    clipped_mean, mean = (reference.losses(*p.loss_arguments)[1]["losses"]["dynamics"] for p in (problem, unclipped))
    return clipped_mean > problem.config.free_nats + 0.1 and clipped_mean > mean + 0.01


class Example:
    """A problem and what the reference makes of it, each computed once, when it is first asked for.

    losses: the total and the aux. directions: see `unit_directions`. derivatives: of every loss along them.
    """

    def __init__(self, problem: Problem, seed: int) -> None:
        self.seed, self.problem = seed, problem
        self._totals: dict[str, float] = {}

    @functools.cached_property
    def losses(self) -> tuple[float, dict[str, Any]]:
        return reference.losses(*self.problem.loss_arguments)

    @functools.cached_property
    def directions(self) -> dict[str, dict[str, np.ndarray]]:
        return unit_directions(self.problem, self.seed)

    @functools.cached_property
    def derivatives(self) -> dict[str, np.ndarray]:
        columns = [self.derivatives_along(direction) for direction in self.directions.values()]
        return dict(zip(self.losses[1]["losses"], np.array(columns).T, strict=True))

    def derivatives_along(self, direction: dict[str, np.ndarray]) -> np.ndarray:
        """Of every loss, in their order. Many images bend a loss more sharply than few, by pooling."""
        step = 1e-6 if self.problem.config.batch_size > 4 else 1e-5

        def means(params: Any) -> np.ndarray:
            losses = reference.losses(params, *self.problem.loss_arguments[1:])[1]["losses"]
            return np.array(list(losses.values()))

        return np.asarray(reference.directional_derivative(means, self.problem.state["params"], direction, step))

    def total_along(self, label: str) -> float:
        """The derivative of the weighted sum along the direction of this label, computed once."""
        if label not in self._totals:
            self._totals[label] = self.total_derivative(self.directions[label])
        return self._totals[label]

    def total_derivative(self, direction: dict[str, np.ndarray]) -> float:
        """Of the weighted sum of the losses."""
        scales = [getattr(self.problem.config, f"{name.split('/')[0]}_scale") for name in self.losses[1]["losses"]]
        return float(np.dot(scales, self.derivatives_along(direction)))


@functools.lru_cache(maxsize=64)
def _example(seed: int, profile: str, observation: str, action: str, dtype: str) -> Example:
    return Example(safe_problem(seed, profile, observation, action, dtype), seed)


def example_of(setting: Setting, observation: str, action: str) -> Example:
    """What `safe_problem` draws."""
    return _example(setting.seed, setting.profile, observation, action, setting.dtype)


def problem_of(setting: Setting, observation: str, action: str) -> Problem:
    return example_of(setting, observation, action).problem


def step_of(setting: Setting, observation: str, action: str) -> Problem:
    """The same with a learning rate so high that the slow critic shows whether it follows the new critic or the old."""
    problem = problem_of(setting, observation, action)
    return dataclasses.replace(problem, config=dataclasses.replace(problem.config, learning_rate=1e-2))


def loss_magnitude(aux: dict[str, Any]) -> float:
    """Losses are means of terms of both signs: rounding is relative to the returns and losses that they are made of."""
    return max(1.0, aux["metrics"]["return_scale"], *(abs(value) for value in aux["losses"].values()))


def unit_directions(problem: Problem, seed: int) -> dict[str, dict[str, np.ndarray]]:
    """A random direction of unit length in all parameters, and one in each group alone."""
    rng = np.random.default_rng(seed)
    noise = {name: rng.normal(size=value.shape) for name, value in problem.state["params"].items()}
    groups = {"all": ("",), "all, again": ("",), **GROUPS}
    directions = {}
    for label, prefixes in groups.items():
        power = 3 if label == "all, again" else 1
        chosen = {name: value**power for name, value in noise.items() if name.startswith(prefixes)}
        length = math.sqrt(sum(float((value**2).sum()) for value in chosen.values()))
        if length:
            directions[label] = {name: value / length for name, value in chosen.items()}
    return directions


def latents_are(aux: dict[str, Any], where: str, bound: float) -> Iterator[Equal]:
    """Demands of the latents in the second result of `losses` and train steps: `stoch` to three digits."""
    yield Equal(aux["deter"], (1, "deter"), where=f"{where}deter", magnitude=1.0, bound=bound)
    yield Equal(aux["stoch"].round(3), (1, "stoch"), where=f"{where}stoch", magnitude=1.0, bound=5e-4)


@check("AGT-25", "AGT-26", "RET-9", uses=["losses"], level=2, dtypes=WHOLE)
def losses_of_short_sequences_match(setting: Setting) -> Cases:
    """Two steps have one replayed value to learn; one step has none, and its loss is 0."""
    for length in (2, 1):

        def draw(attempt: int, length: int = length) -> Problem:
            seed = 1000 * setting.seed + attempt
            return make_problem(seed, setting.profile, "vector", "discrete", setting.dtype, batch_length=length)

        problem = with_sampling_margin(draw, SAMPLING_MARGIN)
        _, aux = reference.losses(*problem.loss_arguments)
        size, bound = loss_magnitude(aux), bound_of(setting, 1e-9, LOSS_BOUND)
        demands = [Equal(aux["losses"], (1, "losses"), where=f"{length} steps", magnitude=size, bound=bound)]
        if length == 1:
            demands.append(exactly(0.0, (1, "losses", "replay_critic"), "replayed value of one step"))
        yield judged("losses", problem.loss_arguments, *demands)


def gradient_along(
    c: Comparisons, example: Example, gradients: Any, labels: list[str], bound: float, where: str = ""
) -> None:
    """The relation of the gradient of the total to the derivatives along some of an example's directions."""
    for label in labels:
        direction = example.directions[label]
        product = sum(float((np.asarray(gradients[name]) * along).sum()) for name, along in direction.items())
        total = example.total_along(label)
        # By chance a product can be nearly 0, where its error is not: the size that it has on average.
        length = math.sqrt(sum(float((np.asarray(gradients[name]) ** 2).sum()) for name in direction))
        usual = length / math.sqrt(sum(along.size for along in direction.values()))
        c.compare(f"{where}gradient along {label}", product, total, magnitude=max(usual, abs(total)), bound=bound)


def gradient_is_right(setting: Setting, observation: str, action: str) -> Callable[[Comparisons, Any], None]:
    """`gradient_along` of every direction."""
    example = example_of(setting, observation, action)
    return lambda c, gradients: gradient_along(
        c, example, gradients, list(example.directions), bound_of(setting, 1e-6, 5e-3), f"{observation}, {action}: "
    )


@check("AGT-32", uses=["gradients"], level=2, dtypes=WHOLE)
def total_gradient_is_the_weighted_sum(setting: Setting) -> Cases:
    """The gradient of the total is the weighted sum of the gradients of the losses, for every parameter."""
    for observation, action in (("vector", "discrete"), ("both", "mixed")):
        problem = problem_of(setting, observation, action)

        def complete(c: Comparisons, gradients: Any, params: Any = problem.state["params"]) -> None:
            c.holds("one gradient for each parameter", set(gradients) == set(params))

        yield judged("gradients", problem.loss_arguments, complete, gradient_is_right(setting, observation, action))


def step_is(setting: Setting, where: str, expected: Any, state: Any) -> Iterator[Equal]:
    """Demands of what a train step returns: parameters and slow critic are right relative to how far they moved."""
    bound = bound_of(setting, 1e-9, 2e-3)
    new, aux = expected
    yield exactly(new["optimizer"]["step"], (0, "optimizer", "step"), f"{where}step")
    for group in ("params", "slow_critic"):
        moves = {
            name: max(np.abs(value - state[group][name]).max() + setting.u / bound * np.abs(value).max(), 1e-12)
            for name, value in new[group].items()
        }
        yield Equal(new[group], (0, group), where=f"{where}{group}", magnitude=moves, bound=bound)
    for moment in ("second_moment", "momentum"):
        at = (0, "optimizer", moment)
        yield Equal(new["optimizer"][moment], at, where=where + moment, magnitude="tensor", bound=bound)
    yield Equal(new["return_range"], (0, "return_range"), where=f"{where}return_range", magnitude=1.0, bound=bound)
    losses, size = aux["losses"], loss_magnitude(aux)
    yield Equal(losses, (1, "losses"), where=f"{where}losses", magnitude=size, bound=bound)
    yield from latents_are(aux, where, bound)


def follows(problem: Problem, demands: Callable[[Any], Iterable[Equal]]) -> Callable[[Comparisons, Any, Any], None]:
    """The relation of a train step to the candidate's own gradients. demands: of the step, made of the reference's."""

    def relation(c: Comparisons, gradients: Any, actual: Any) -> None:
        inputs = (problem.state, problem.batch, problem.noise, gradients, problem.spaces, problem.config)
        for demand in demands(reference.train_step(*inputs)):
            how = {"magnitude": demand.magnitude, "bound": demand.bound}
            c.compare(demand.where, part_of(actual, demand.at), demand.expected, **how)

    return relation


def step_follows(setting: Setting, where: str, problem: Problem) -> Callable[[Comparisons, Any, Any], None]:
    return follows(problem, lambda expected: step_is(setting, where, expected, problem.state))


STEP = ("AGT-29", "AGT-30", "BEH-21", "OPT-17", "OPT-21")


@check(*STEP, "CON-22", uses=["train_step", "gradients"], level=3, dtypes=WHOLE)
def train_step_matches(setting: Setting) -> Cases:
    """Parameters, moments, slow critic, return range and latents after one step, for every kind of task."""
    for observation, action in COMBINATIONS:
        problem = step_of(setting, observation, action)
        inputs = (problem.state, problem.batch, problem.noise, problem.spaces, problem.config)
        relation = step_follows(setting, f"{observation}, {action}: ", problem)
        yield related(relation, ("gradients", problem.loss_arguments), ("train_step", inputs))


@check(*STEP, "AGT-31", "CON-22", uses=["train_step_with"], level=3, dtypes=WHOLE)
def train_step_with_given_gradients_matches(setting: Setting) -> Cases:
    """The same with given gradients; the arguments are as before."""
    problem, rng = step_of(setting, "both", "mixed"), setting.rng()
    gradients = {name: rng.normal(size=value.shape) for name, value in problem.state["params"].items()}
    arguments = (problem.state, problem.batch, problem.noise, gradients, problem.spaces, problem.config)
    demands = step_is(setting, "", reference.train_step(*arguments), problem.state)
    yield judged("train_step_with", arguments, *demands, keeps=True)


@check("AGT-31", uses=["train_step"], level=3, dtypes=WHOLE)
def train_step_keeps_its_arguments(setting: Setting) -> Cases:
    """State, batch and noise are the same arrays with the same numbers after a step."""
    problem = problem_of(setting, "both", "mixed")
    inputs = (problem.state, problem.batch, problem.noise, problem.spaces, problem.config)
    yield judged("train_step", inputs, keeps=True)


def policy_arguments(setting: Setting, rows: int = 4) -> tuple[Any, ...]:
    rng, task = setting.rng(), spaces()
    config = small_config(setting.profile, setting.dtype)
    params = random_parameters(rng, config, task, setting.dtype)
    noise = {"posterior": uniforms(rng, rows, config.stoch), "action": action_noise(rng, task, (rows,))}
    observation = random_observations(rng, task, (rows,))
    is_first = np.arange(rows) % 2 == 1
    carry, prev_action = random_carry(rng, config, (rows,)), random_actions(rng, task, (rows,))
    return params, carry, prev_action, observation, is_first, noise, task, config


@check("AGT-11", "AGT-12", "BEH-8", "CON-26", "CON-27", uses=["policy_step"], level=1, dtypes=WHOLE)
def policy_step_matches(setting: Setting) -> Cases:
    """Carry and sampled action of a few rows, some of them at a reset."""
    arguments, bound = policy_arguments(setting), bound_of(setting, 1e-10, 1e-4)
    yield equal("policy_step", arguments, reference.policy_step(*arguments), magnitude=1.0, bound=bound)


@check("AGT-13", "RSSM-13", "RSSM-14", "CON-12", uses=["policy_step"], level=1)
def policy_step_resets_and_rows(setting: Setting) -> Cases:
    """Where is_first, carry and previous action change nothing, not even as NaN; and rows do not influence each
    other."""
    params, carry, prev_action, observation, is_first, *rest = policy_arguments(setting)
    spoiled, spoiled_action = {name: value.copy() for name, value in carry.items()}, prev_action.copy()
    spoiled["deter"][is_first] = spoiled["stoch"][is_first] = spoiled_action[is_first] = np.nan
    other = {key: value.copy() for key, value in observation.items()}
    for value in other.values():
        value[0] = 0

    def same(c: Comparisons, before: Any, after: Any, changed: Any) -> None:
        for name in ("deter", "stoch"):
            c.exact(f"{name} after a reset", after[0][name], before[0][name])
        c.exact("action after a reset", after[1], before[1])
        c.exact("actions of the other rows", np.asarray(changed[1])[1:], np.asarray(before[1])[1:])

    inputs = (carry, prev_action, observation), (spoiled, spoiled_action, observation), (carry, prev_action, other)
    yield related(same, *(("policy_step", (params, *changing, is_first, *rest)) for changing in inputs))


def drawn_for(setting: Setting, table: dict[str, Parameter]) -> dict[str, np.ndarray]:
    """Uniform numbers for every entry of the table that is drawn."""
    rng = setting.rng()
    return {name: uniforms(rng, *entry.shape) for name, entry in table.items() if _is_drawn(entry)}


def _is_drawn(entry: Parameter) -> bool:
    return entry.initializer == "truncated_normal"


@check("AGT-1", "AGT-3", "AGT-4", "AGT-5", "AGT-6", uses=["initial_parameters"], level=1)
def initial_parameters_match(setting: Setting) -> Cases:
    """Every tensor of the table from the same uniforms; biases 0, scales 1; the standard deviations follow fan-in and
    outscale."""
    table = parameter_table(small_config(setting.profile, setting.dtype, units=64, deter=128), spaces())
    drawn = drawn_for(setting, table)
    scale = {name: entry.outscale / math.sqrt(entry.fan_in) for name, entry in table.items()}

    def spread(c: Comparisons, actual: Any) -> None:
        for name, entry in table.items():
            if _is_drawn(entry) and entry.outscale > 0 and np.size(actual[name]) >= 4096:
                c.compare(f"standard deviation of {name}", np.std(actual[name]), scale[name], bound=0.1)

    magnitude = {name: max(value, 1e-12) for name, value in scale.items()}
    bound = 1e-9 if setting.dtype == "float64" else 3e-5
    expected = reference.initial_parameters(table, drawn)
    yield judged("initial_parameters", (table, drawn), Equal(expected, magnitude=magnitude, bound=bound), spread)


@check("AGT-7", "AGT-8", "OPT-13", uses=["initial_state"], level=1)
def initial_state_matches(setting: Setting) -> Cases:
    """The slow critic is a copy of the critic, moments and return range are zero, the step is 0."""
    params = random_parameters(setting.rng(), small_config(setting.profile, setting.dtype), spaces(), setting.dtype)
    expected = reference.initial_state(params)
    yield judged(
        "initial_state",
        (params,),
        exactly(0, ("optimizer", "step"), "step"),
        *(Equal(expected[group], (group,), where=group, bound=setting.u) for group in ("params", "slow_critic")),
        *(
            exactly(expected["optimizer"][moment], ("optimizer", moment), moment)
            for moment in ("second_moment", "momentum")
        ),
        exactly({"low": 0.0, "high": 0.0}, ("return_range",), "return_range"),
    )


@script("AGT-6", "NET-20", uses=["initial_parameters", "losses"], level=2, dtypes=WHOLE)
def a_fresh_agent_predicts_zero(script: Script) -> None:
    """Rewards and values of a fresh agent are exactly 0, and each cross-entropy is ln of the number of bins."""
    problem = problem_of(script.setting, "vector", "discrete")
    table = parameter_table(problem.config, problem.spaces)
    params = script.call("initial_parameters", table, drawn_for(script.setting, table))
    slow = {name: value for name, value in params.items() if name.startswith("critic/")}
    arguments = (params, slow, (0.0, 0.0), problem.batch, problem.noise, problem.spaces, problem.config)
    _, aux = script.call("losses", *arguments)
    for name in ("reward_mean", "value_mean", "return_mean"):
        script.exact(name, aux["metrics"][name], 0.0)
    bound = 16 * script.setting.u
    script.compare("reward loss", aux["losses"]["reward"], math.log(problem.config.bins), bound=bound)


@check("AGT-2", "NET-12", uses=["encoder"], level=1)
def images_of_other_sizes_are_refused(setting: Setting) -> Cases:
    """Sides that the encoder cannot halve are refused."""
    task = Spaces({"image": Image(12, 18, 3)}, {"action": Discrete((2,))})
    config = small_config(setting.profile, setting.dtype)
    yield refused("encoder", {}, {"image": np.zeros((1, 12, 18, 3), np.uint8)}, task, config)
