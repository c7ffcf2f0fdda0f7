"""Checks of spec/10-agent.md: whole losses, their gradients, and whole training steps on small problems."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np

from conformance.check import Run, check
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
from reference_numpy import agent as reference
from spec import Discrete, Image, Spaces, load_config, parameter_table

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


def bound_of(run: Run, double: float, single: float) -> float:
    return double if run.dtype == "float64" else single


@functools.lru_cache(maxsize=64)
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


def problem_of(run: Run, observation: str, action: str) -> Problem:
    return safe_problem(run.seed, run.profile, observation, action, run.dtype)


LOSS_REQUIREMENTS = (
    *(f"AGT-{n}" for n in range(14, 28)),
    *("RET-3", "RET-4", "RET-5", "RET-6", "RET-11", "RET-15", "BEH-11", "BEH-16", "BEH-17", "BEH-18"),
    *("RSSM-20", "RSSM-22", "NET-1", "WM-1", "WM-6", "WM-9", "WM-15", "WM-16"),
    *("CON-1", "CON-2", "CON-3", "CON-4", "CON-13", "CON-20", "CON-23", "CON-24"),
)


@check(*LOSS_REQUIREMENTS, uses=["losses"], level=2, dtypes=WHOLE)
def losses_match(run: Run) -> None:
    """Every loss, the total, the return range, the latents and the metrics of one pass."""
    for observation, action in COMBINATIONS:
        problem = problem_of(run, observation, action)
        total, aux = reference.losses(*problem.loss_arguments)
        actual_total, actual = run.call("losses", *problem.loss_arguments)
        where, bound = f"{observation}, {action}: ", bound_of(run, 1e-9, 2e-4)
        run.compare(where + "losses", actual["losses"], aux["losses"], magnitude=loss_magnitude(aux), bound=bound)
        run.compare(where + "total", actual_total, total, magnitude=abs(total), bound=bound)
        run.compare(
            where + "return_range", tuple(actual["return_range"]), aux["return_range"], magnitude=1.0, bound=bound
        )
        run.compare(where + "deter", actual["deter"], aux["deter"], magnitude=1.0, bound=bound)
        run.exact(where + "stoch", np.round(actual["stoch"], 3), aux["stoch"].round(3))
        metrics = {name: actual["metrics"][name] for name in aux["metrics"]}
        run.compare(where + "metrics", metrics, aux["metrics"], magnitude=loss_magnitude(aux), bound=bound)


@check("AGT-25", "AGT-26", "RET-9", uses=["losses"], level=2, dtypes=WHOLE)
def losses_of_short_sequences_match(run: Run) -> None:
    """Two steps have one replayed value to learn; one step has none, and its loss is 0."""
    for length in (2, 1):

        def draw(attempt: int, length: int = length) -> Problem:
            return make_problem(
                1000 * run.seed + attempt, run.profile, "vector", "discrete", run.dtype, batch_length=length
            )

        problem = with_sampling_margin(draw, SAMPLING_MARGIN)
        _, aux = reference.losses(*problem.loss_arguments)
        _, actual = run.call("losses", *problem.loss_arguments)
        bound = bound_of(run, 1e-9, 2e-4)
        run.compare(f"{length} steps", actual["losses"], aux["losses"], magnitude=loss_magnitude(aux), bound=bound)
        if length == 1:
            run.exact("replayed value of one step", actual["losses"]["replay_critic"], 0.0)


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
        sign = -1 if label == "all, again" else 1
        chosen = {name: value ** (3 if sign < 0 else 1) for name, value in noise.items() if name.startswith(prefixes)}
        length = math.sqrt(sum(float((value**2).sum()) for value in chosen.values()))
        if length:
            directions[label] = {name: value / length for name, value in chosen.items()}
    return directions


@functools.lru_cache(maxsize=64)
def reference_derivatives(seed: int, profile: str, observation: str, action: str, dtype: str) -> dict[str, np.ndarray]:
    problem = safe_problem(seed, profile, observation, action, dtype)
    names = list(reference.losses(*problem.loss_arguments)[1]["losses"])

    def means(params: Any) -> np.ndarray:
        return np.array(list(reference.losses(params, *problem.loss_arguments[1:])[1]["losses"].values()))

    directions = unit_directions(problem, seed).values()
    columns = [
        reference.directional_derivative(means, problem.state["params"], direction, 1e-5) for direction in directions
    ]
    return dict(zip(names, np.array(columns).T, strict=True))


# What reaches what: the table of [AGT-28].
WORLD = {"encoder", "core", "posterior"}
REACHES = {
    "reconstruction": WORLD | {"decoder"},
    "reward": WORLD | {"reward"},
    "continue": WORLD | {"continue"},
    "dynamics": WORLD | {"prior"},
    "representation": WORLD,
    "actor": {"actor"},
    "critic": {"critic"},
    "replay_critic": WORLD | {"critic"},
}
GRADIENT_REQUIREMENTS = (
    *("AGT-28", "AGT-32", "CON-14", "CON-15", "RSSM-23", "RSSM-24", "RSSM-25", "NET-25"),
    *("WM-1", "WM-11", "WM-12", "WM-13", "WM-14", "WM-17", "RET-18", "BEH-5", "BEH-10", "BEH-13", "BEH-15"),
)


@check(*GRADIENT_REQUIREMENTS, uses=["loss_derivatives"], level=2, dtypes=WHOLE)
def loss_derivatives_match(run: Run) -> None:
    """The derivative of every loss along random directions and within every group of parameters; where none may flow,
    exactly 0."""
    for observation, action in (("vector", "continuous"), ("both", "mixed")):
        problem = problem_of(run, observation, action)
        labels = list(unit_directions(problem, run.seed))
        expected = reference_derivatives(run.seed, run.profile, observation, action, run.dtype)
        actual = run.call(
            "loss_derivatives", *problem.loss_arguments, list(unit_directions(problem, run.seed).values())
        )
        bound = bound_of(run, 1e-6, 5e-3)
        for name, derivatives in expected.items():
            where = f"{observation}, {action}: derivative of {name}"
            # A derivative is a sum over parameters of both signs; central differences err by 1e-11 of the loss.
            run.compare(where, actual[name], derivatives, magnitude=np.abs(derivatives).max() + 1e-3, bound=bound)
            for label, value in zip(labels, np.asarray(actual[name]), strict=True):
                reached = label not in GROUPS or label in REACHES[name.partition("/")[0]]
                run.holds(f"{where} by the {label} parameters is {'not ' if reached else ''}0", (value != 0) == reached)


@check("AGT-32", uses=["gradients", "loss_derivatives"], level=2, dtypes=WHOLE)
def total_gradient_is_the_weighted_sum(run: Run) -> None:
    """The gradient of the total is the weighted sum of the gradients of the losses, for every parameter."""
    for observation, action in (("vector", "discrete"), ("both", "mixed")):
        problem = problem_of(run, observation, action)
        directions = unit_directions(problem, run.seed)
        expected = reference_derivatives(run.seed, run.profile, observation, action, run.dtype)
        weights = {name: getattr(problem.config, f"{name.split('/')[0]}_scale") for name in expected}
        total = sum(weights[name] * value for name, value in expected.items())
        gradients = run.call("gradients", *problem.loss_arguments)
        run.holds("one gradient for each parameter", set(gradients) == set(problem.state["params"]))
        products = [
            sum(float((gradients[name] * d).sum()) for name, d in direction.items())
            for direction in directions.values()
        ]
        where = f"{observation}, {action}: gradient along directions"
        run.compare(where, np.array(products), total, magnitude=np.abs(total).max(), bound=bound_of(run, 1e-6, 5e-3))


def compare_steps(run: Run, where: str, actual: Any, expected: Any, state: Any, bound: float) -> None:
    (new, aux), (expected_new, expected_aux) = actual, expected
    run.exact(where + "step", new["optimizer"]["step"], expected_new["optimizer"]["step"])
    for group in ("params", "slow_critic"):
        for name, value in expected_new[group].items():
            move = np.abs(value - state[group][name]).max() + run.u / bound * np.abs(value).max()
            run.compare(f"{where}{group} {name}", new[group][name], value, magnitude=max(move, 1e-12), bound=bound)
    for moment in ("second_moment", "momentum"):
        run.compare(
            where + moment,
            dict(new["optimizer"][moment]),
            expected_new["optimizer"][moment],
            magnitude="tensor",
            bound=bound,
        )
    range_ = {name: float(value) for name, value in new["return_range"].items()}
    run.compare(where + "return_range", range_, expected_new["return_range"], magnitude=1.0, bound=bound)
    run.compare(
        where + "losses", aux["losses"], expected_aux["losses"], magnitude=loss_magnitude(expected_aux), bound=bound
    )
    run.compare(where + "deter", aux["deter"], expected_aux["deter"], magnitude=1.0, bound=bound)
    run.exact(where + "stoch", np.round(aux["stoch"], 3), expected_aux["stoch"].round(3))


@check(
    "AGT-29", "AGT-30", "BEH-21", "OPT-17", "OPT-21", "CON-22", uses=["train_step", "gradients"], level=3, dtypes=WHOLE
)
def train_step_matches(run: Run) -> None:
    """Parameters, moments, slow critic, return range and latents after one step, for every kind of task."""
    for observation, action in COMBINATIONS:
        problem = problem_of(run, observation, action)
        gradients = run.call("gradients", *problem.loss_arguments)
        arguments = (problem.batch, problem.noise)
        expected = reference.train_step(problem.state, *arguments, gradients, problem.spaces, problem.config)
        actual = run.call("train_step", problem.state, *arguments, problem.spaces, problem.config)
        compare_steps(run, f"{observation}, {action}: ", actual, expected, problem.state, bound_of(run, 1e-9, 2e-3))


@check(
    "AGT-29",
    "AGT-30",
    "AGT-31",
    "BEH-21",
    "OPT-17",
    "OPT-21",
    "CON-22",
    uses=["train_step_with"],
    level=3,
    dtypes=WHOLE,
)
def train_step_with_given_gradients_matches(run: Run) -> None:
    """The same with given gradients; the arguments are as before."""
    problem = problem_of(run, "both", "mixed")
    rng = run.rng()
    gradients = {name: rng.normal(size=value.shape) for name, value in problem.state["params"].items()}
    before = {name: value.copy() for name, value in problem.state["params"].items()}
    arguments = (problem.state, problem.batch, problem.noise, gradients, problem.spaces, problem.config)
    actual = run.call("train_step_with", *arguments)
    compare_steps(run, "", actual, reference.train_step(*arguments), problem.state, bound_of(run, 1e-9, 2e-3))
    for name, value in before.items():
        run.exact(f"argument {name} after the step", problem.state["params"][name], value)


@check("AGT-31", uses=["train_step"], level=3, dtypes=WHOLE)
def train_step_keeps_its_arguments(run: Run) -> None:
    """State, batch and noise are the same arrays with the same numbers after a step."""
    problem = problem_of(run, "both", "mixed")
    arrays = {**problem.state["params"], **problem.batch, **problem.noise}
    before = {name: np.array(value) for name, value in arrays.items()}
    run.call("train_step", problem.state, problem.batch, problem.noise, problem.spaces, problem.config)
    for name, value in before.items():
        run.exact(name, arrays[name], value)


def policy_arguments(run: Run, rows: int = 4) -> tuple[Any, ...]:
    rng, task = run.rng(), spaces()
    config = small_config(run.profile, run.dtype)
    params = random_parameters(rng, config, task, run.dtype)
    noise = {"posterior": uniforms(rng, rows, config.stoch), "action": action_noise(rng, task, (rows,))}
    observation = random_observations(rng, task, (rows,))
    is_first = np.arange(rows) % 2 == 1
    return (
        params,
        random_carry(rng, config, (rows,)),
        random_actions(rng, task, (rows,)),
        observation,
        is_first,
        noise,
        task,
        config,
    )


@check("AGT-11", "AGT-12", "BEH-8", "CON-26", "CON-27", uses=["policy_step"], level=1, dtypes=WHOLE)
def policy_step_matches(run: Run) -> None:
    """Carry and sampled action of a few rows, some of them at a reset."""
    arguments = policy_arguments(run)
    carry, action = reference.policy_step(*arguments)
    run.expect("policy_step", arguments, (carry, action), magnitude=1.0, bound=bound_of(run, 1e-10, 1e-4))


@check("AGT-13", "RSSM-13", "RSSM-14", "CON-12", uses=["policy_step"], level=1)
def policy_step_resets_and_rows(run: Run) -> None:
    """Where is_first, carry and previous action change nothing, not even as NaN; and rows do not influence each
    other."""
    params, carry, prev_action, observation, is_first, noise, task, config = policy_arguments(run)
    before = run.call("policy_step", params, carry, prev_action, observation, is_first, noise, task, config)
    spoiled = {name: value.copy() for name, value in carry.items()}
    spoiled["deter"][is_first] = spoiled["stoch"][is_first] = np.nan
    spoiled_action = prev_action.copy()
    spoiled_action[is_first] = np.nan
    after = run.call("policy_step", params, spoiled, spoiled_action, observation, is_first, noise, task, config)
    for name in ("deter", "stoch"):
        run.exact(f"{name} after a reset", after[0][name], before[0][name])
    run.exact("action after a reset", after[1], before[1])
    other = {key: value.copy() for key, value in observation.items()}
    for value in other.values():
        value[0] = 0
    changed = run.call("policy_step", params, carry, prev_action, other, is_first, noise, task, config)
    run.exact("actions of the other rows", np.asarray(changed[1])[1:], np.asarray(before[1])[1:])


@check("AGT-1", "AGT-3", "AGT-4", "AGT-5", "AGT-6", uses=["initial_parameters"], level=1)
def initial_parameters_match(run: Run) -> None:
    """Every tensor of the table from the same uniforms; biases 0, scales 1; the standard deviations follow fan-in and
    outscale."""
    task, config = spaces(), load_config(run.profile, "tiny", units=64, compute_dtype=run.dtype)
    table = parameter_table(config, task)
    rng = run.rng()
    drawn = {
        name: uniforms(rng, *entry.shape) for name, entry in table.items() if entry.initializer == "truncated_normal"
    }
    expected = reference.initial_parameters(table, drawn)
    actual = run.call("initial_parameters", table, drawn)
    scale = {name: entry.outscale / math.sqrt(entry.fan_in) for name, entry in table.items()}
    bound = 1e-9 if run.dtype == "float64" else 3e-5
    run.compare(
        "initial_parameters",
        actual,
        expected,
        magnitude={name: max(value, 1e-12) for name, value in scale.items()},
        bound=bound,
    )
    for name, entry in table.items():
        if entry.initializer == "truncated_normal" and entry.outscale > 0 and np.size(actual[name]) >= 4096:
            run.compare(f"standard deviation of {name}", np.std(actual[name]), scale[name], bound=0.1)


@check("AGT-7", "AGT-8", "OPT-13", uses=["initial_state"], level=1)
def initial_state_matches(run: Run) -> None:
    """The slow critic is a copy of the critic, moments and return range are zero, the step is 0."""
    params = random_parameters(run.rng(), small_config(run.profile, run.dtype), spaces(), run.dtype)
    state = run.call("initial_state", params)
    expected = reference.initial_state(params)
    run.exact("step", state["optimizer"]["step"], 0)
    for group in ("params", "slow_critic"):
        run.compare(group, dict(state[group]), expected[group], bound=0 + run.u)
    for moment in ("second_moment", "momentum"):
        for name, value in expected["optimizer"][moment].items():
            run.exact(f"{moment} {name}", state["optimizer"][moment][name], value)
    run.exact("return_range", [state["return_range"]["low"], state["return_range"]["high"]], [0, 0])


@check("AGT-6", "NET-20", uses=["initial_parameters", "losses"], level=2, dtypes=WHOLE)
def a_fresh_agent_predicts_zero(run: Run) -> None:
    """Rewards and values of a fresh agent are exactly 0, and each cross-entropy is ln of the number of bins."""
    problem = problem_of(run, "vector", "discrete")
    table = parameter_table(problem.config, problem.spaces)
    rng = run.rng()
    drawn = {
        name: uniforms(rng, *entry.shape) for name, entry in table.items() if entry.initializer == "truncated_normal"
    }
    params = run.call("initial_parameters", table, drawn)
    slow = {name: value for name, value in params.items() if name.startswith("critic/")}
    _, aux = run.call("losses", params, slow, (0.0, 0.0), problem.batch, problem.noise, problem.spaces, problem.config)
    for name in ("reward_mean", "value_mean", "return_mean"):
        run.exact(name, aux["metrics"][name], 0.0)
    run.compare("reward loss", aux["losses"]["reward"], math.log(problem.config.bins), bound=16 * run.u)


@check("AGT-2", "NET-12", uses=["encoder"], level=1)
def images_of_other_sizes_are_refused(run: Run) -> None:
    """Sides that the encoder cannot halve are refused."""
    task = Spaces({"image": Image(24, 20, 3)}, {"action": Discrete((2,))})
    config = small_config(run.profile, run.dtype)
    run.refuses("encoder", {}, {"image": np.zeros((1, 24, 20, 3), np.uint8)}, task, config)
