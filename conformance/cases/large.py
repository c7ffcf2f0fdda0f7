"""Checks at the size of a training batch, and where axes have equal sizes: what a small problem cannot show.

Implementations take other paths for many rows, large tensors and long sequences: chunks, fused products, padding. The
networks are as small as elsewhere, so that the reference takes a second. A batch is as large as the paper's, and B and
T are primes, T above 64: what is done in chunks has a last one that is not full.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from conformance.case import Case, Cases, Equal, Setting, equal, exactly, judged, related
from conformance.cases.agent import (
    LOSS_BOUND,
    SAMPLING_MARGIN,
    WHOLE,
    Example,
    bound_of,
    gradient_along,
    problem_of,
)
from conformance.cases.losses import demands_of
from conformance.check import check, script
from conformance.compare import Comparisons
from conformance.problems import (
    Problem,
    make_problem,
    problem_in,
    random_carry,
    random_observations,
    random_parameters,
    small_config,
)
from conformance.script import Script
from conformance.settled import settled
from reference_numpy import networks, optimizer
from spec import Discrete, Image, Spaces, Vector

RUN = {"batch_size": 17, "batch_length": 67, "imagination_horizon": 15}
HALF = RUN["batch_length"] // 2
EQUAL = dict.fromkeys(("batch_size", "batch_length", "imagination_horizon", "stoch", "classes", "blocks"), 4)
EQUAL_SPACES = Spaces(
    {"image": Image(16, 16, 4), "mode": Discrete((4, 4)), "position": Vector(4)}, {"action": Discrete((4, 4, 4, 4))}
)
# More pixels than the pieces in which image networks compute.
PICTURES, MANY = Spaces({"image": Image(64, 64, 3)}, {"action": Discrete((2,))}), 300
# A vector of parameters longer than the pieces in which optimizers update it, and tensors that cross their edges.
TENSORS = {"a": (7,), "b": (3, 50_021), "c": (131_073,), "d": (2, 3, 4), "e": (300, 500), "f": (2, 140_009)}


@functools.lru_cache(maxsize=8)
def batch_of_a_run(setting: Setting) -> Example:
    """Everything that an agent can see and do, in a batch as large as the paper's. The return range stays as it is, so
    that the gradient is the mean of those of the rows."""
    problem = make_problem(setting.seed, setting.profile, "both", "mixed", setting.dtype, **RUN, return_decay=1.0)
    return Example(settled(problem, SAMPLING_MARGIN), setting.seed)


@functools.lru_cache(maxsize=8)
def equal_sizes(setting: Setting) -> Example:
    """Rows, time steps, horizon, latents, classes, blocks, channels and actions: four of each."""
    problem = problem_in(EQUAL_SPACES, setting.seed, setting.profile, setting.dtype, **EQUAL)
    return Example(settled(problem, SAMPLING_MARGIN), setting.seed)


def row_of(problem: Problem, row: int) -> Problem:
    """One row of the batch with its noise. The configuration is that of the whole."""
    length = problem.config.batch_length
    starts = slice(row * length, (row + 1) * length)
    noise = {"posterior": problem.noise["posterior"][row : row + 1]}
    noise |= {name: problem.noise[name][starts] for name in ("prior", "action")}
    batch = {name: value[row : row + 1] for name, value in problem.batch.items()}
    return dataclasses.replace(problem, batch=batch, noise=noise)


BATCH = ("AGT-14", "AGT-26", "AGT-27", "RSSM-17", "RSSM-20", "RET-14", "LAY-2", "LAY-3", "NET-1", "CON-1", "CON-2")


@check(*BATCH, "RET-12", uses=["losses"], level=2, dtypes=WHOLE)
def losses_of_a_batch_match(setting: Setting) -> Cases:
    """Every loss, metric and latent of 17 sequences of 67 steps, with 15 imagined steps from each: 17,085 returns for
    the percentiles."""
    problem = batch_of_a_run(setting).problem
    moving = dataclasses.replace(problem, config=dataclasses.replace(problem.config, return_decay=0.9))
    example = Example(moving, setting.seed)
    demands = demands_of(example, "", bound_of(setting, 1e-9, LOSS_BOUND))
    yield judged("losses", moving.loss_arguments, *demands.values())


@check("AGT-28", "AGT-32", "CON-12", "CON-23", "LAY-2", "LAY-3", uses=["gradients"], level=2, dtypes=WHOLE)
def gradient_of_a_batch_is_that_of_its_rows(setting: Setting) -> Cases:
    """The gradient of a batch is the mean of the gradients of its rows, each asked for alone; and it is the one of the
    losses along a direction."""
    example = batch_of_a_run(setting)
    problem, bound = example.problem, bound_of(setting, 1e-9, 1e-3)
    rows = [row_of(problem, row) for row in range(problem.config.batch_size)]

    def mean_of_rows(c: Comparisons, whole: Any, *parts: Any) -> None:
        for name in problem.state["params"]:
            each = np.array([np.asarray(part[name]) for part in parts])
            size = np.abs(each).max() + 1e-30
            c.compare(f"gradient of {name}", whole[name], each.mean(0), magnitude=size, bound=bound)
        gradient_along(c, example, whole, ["all", "all, again"], bound_of(setting, 1e-5, 5e-3))

    yield related(mean_of_rows, *(("gradients", one.loss_arguments) for one in (problem, *rows)))


@check("NET-1", "NET-10", "NET-16", "CON-12", uses=["encoder", "decoder"], level=2, dtypes=WHOLE)
def many_images_match(setting: Setting) -> Cases:
    """Tokens of 300 images of 64 x 64, each for itself, and the images that the decoder makes of 300 states."""
    config = small_config(setting.profile, setting.dtype)
    rng = np.random.default_rng(setting.seed)
    params = random_parameters(rng, config, PICTURES, setting.dtype)
    observations = random_observations(rng, PICTURES, (MANY,))
    state = random_carry(rng, config, (MANY,))
    feature = setting.cast(networks.feature(state["deter"], state["stoch"]))
    bound = bound_of(setting, 1e-9, 1e-4)
    for name, inputs in (("encoder", observations), ("decoder", feature)):
        arguments = (params, inputs, PICTURES, config)
        yield equal(name, arguments, getattr(networks, name)(*arguments), magnitude="tensor", bound=bound)


@script("RSSM-13", "RSSM-17", "RSSM-19", "CON-12", uses=["observe"], level=2, dtypes=WHOLE)
def a_sequence_is_its_halves(script: Script) -> None:
    """States and logits of 67 steps are those of 33 and, from the last of their states, of 34."""
    problem = batch_of_a_run(script.setting).problem
    params, batch, bound = problem.state["params"], problem.batch, bound_of(script.setting, 1e-9, 1e-4)
    tokens = networks.encoder(params, batch, problem.spaces, problem.config)
    steps = (tokens, batch["prev_action"], batch["is_first"], problem.noise["posterior"])
    start = {"deter": batch["deter"], "stoch": np.eye(problem.config.classes)[batch["stoch"]]}

    def observed(carry: Mapping[str, Any], part: slice) -> Any:
        return script.call("observe", params, carry, *(x[:, part] for x in steps), problem.config)

    whole, first = observed(start, slice(None)), observed(start, slice(HALF))
    second = observed({name: np.asarray(first[name])[:, -1] for name in start}, slice(HALF, None))
    for name in ("deter", "stoch", "logits"):
        halves = np.concatenate([np.asarray(part[name]) for part in (first, second)], 1)
        script.compare(f"{name} of the whole", whole[name], halves, magnitude="tensor", bound=bound)


@check("AGT-15", "AGT-26", "RET-11", "RET-14", "CON-20", uses=["losses"], level=2, dtypes=WHOLE)
def losses_of_another_batch_match(setting: Setting) -> Cases:
    """Every loss, metric and latent of a batch with fewer, and with more, rows and steps than the configuration says:
    what counts is the batch."""
    problem = problem_of(setting, "vector", "discrete")
    for rows, steps in ((7, 11), (1, 3)):
        config = dataclasses.replace(problem.config, batch_size=rows, batch_length=steps)
        other = dataclasses.replace(problem, config=config)
        demands = demands_of(Example(other, setting.seed), f"{rows} x {steps}: ", bound_of(setting, 1e-9, LOSS_BOUND))
        yield judged("losses", other.loss_arguments, *demands.values())


@check(*BATCH, uses=["losses"], level=2, dtypes=WHOLE)
def losses_of_equal_sizes_match(setting: Setting) -> Cases:
    """Every loss, metric and latent where as many axes as possible have the same size, so that an exchange of two gives
    no error."""
    example = equal_sizes(setting)
    demands = demands_of(example, "", bound_of(setting, 1e-9, LOSS_BOUND))
    yield judged("losses", example.problem.loss_arguments, *demands.values())


@check("AGT-28", "AGT-32", "LAY-2", "LAY-3", uses=["gradients"], level=2, dtypes=WHOLE)
def gradient_of_equal_sizes_matches(setting: Setting) -> Cases:
    """The gradient of the total in all parameters and in every group, where axes have the same size."""
    example = equal_sizes(setting)

    def right(c: Comparisons, gradients: Any) -> None:
        gradient_along(c, example, gradients, list(example.directions), bound_of(setting, 1e-6, 5e-3))

    yield judged("gradients", example.problem.loss_arguments, right)


@check("OPT-2", "OPT-8", "OPT-15", "OPT-16", uses=["optimizer_step"], level=3)
def step_of_large_tensors_matches(setting: Setting) -> Cases:
    """Parameters and moments of tensors with up to 280,018 numbers beside one with 7, and then of smaller ones with the
    same names; every second tensor is clipped."""
    for shapes in (TENSORS, dict(zip(TENSORS, ((5,), (3, 70), (66,), (1, 2, 3, 4), (2, 2), (9,)), strict=True))):
        yield step_of(setting, shapes)


def step_of(setting: Setting, shapes: Mapping[str, tuple[int, ...]]) -> Case:
    rng, config = setting.rng(), make_problem(setting.seed, setting.profile, "vector", "discrete", setting.dtype).config
    config = dataclasses.replace(config, warmup_steps=0)

    def drawn(spread: float) -> dict[str, np.ndarray]:
        wide = dataclasses.replace(setting, dtype="float32") if setting.dtype == "bfloat16" else setting
        return {name: wide.cast(rng.normal(0, spread, shape)) for name, shape in shapes.items()}

    params, momentum, gradients = drawn(1.0), drawn(1.0), drawn(0.01)
    second = {name: np.abs(value) + 0.01 for name, value in drawn(1.0).items()}
    for name in list(shapes)[::2]:
        gradients[name] = gradients[name] * 1024
    state = {"step": 7, "second_moment": second, "momentum": momentum}
    expected, moments = optimizer.optimizer_step(params, gradients, state, config)
    bound, u = 1e-11 if setting.dtype == "float64" else 2e-5, setting.u
    moves = {name: np.abs(new - params[name]).max() + 4 * u * np.abs(new) / bound for name, new in expected.items()}
    return judged(
        "optimizer_step",
        (params, gradients, state, config),
        Equal(expected, at=(0,), where="params", magnitude=moves, bound=bound),
        exactly(8, at=(1, "step"), where="step"),
        Equal(moments["second_moment"], at=(1, "second_moment"), where="second_moment", bound=bound),
        Equal(moments["momentum"], at=(1, "momentum"), where="momentum", magnitude=1.0, bound=bound),
    )
