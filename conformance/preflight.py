"""Preflight: is this backend right on this very configuration, these spaces, this precision and this device?

Networks of full size are compared one by one on given states, so that any precision can be judged. In float64 and
float32 follow whole losses and their gradient, of a few time steps and of a batch as large as the run's, and a train
step of the learner. In bfloat16 a sample may honestly fall into another class, after which nothing is comparable; there
follows the gradient of every tensor, beside the same backend's in float32, where every sample is far from others.
"""

import dataclasses
import functools
import math
import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from conformance.case import Setting
from conformance.compare import Comparisons, Deviation, Worst
from conformance.judge import asking
from conformance.our_candidates import load_adapter
from conformance.problems import (
    Problem,
    random_batch,
    random_carry,
    random_observations,
    random_parameters,
    random_state,
    train_noise,
)
from conformance.script import Script
from conformance.settled import settled
from reference_numpy import agent, networks, rssm
from spec import Config, Spaces, parameter_table

ROWS = 2
STEPS = 2
# Of a batch as large as the run's: imagined steps, which are as many as they are in the small one; multiplications and
# additions that the reference may take for it, and time steps that it has in any case.
HORIZON = 2
OPERATIONS = 2e10
LEAST_STEPS = 512
SAMPLING_MARGIN = 1e-5
# Far smaller than in the checks: a random network for images bends sharply, and here float64 loses 1e-8 of a derivative
# at most.
DIFFERENCE_STEP = 1e-6
# In float32 about ten times and more what PyTorch deviates in sizes up to 50m (networks 2e-6, losses 3e-7, gradients
# 1e-5), and well below what TF32 does to networks (5e-4): products of rounded operands, [LAY-1] forbids them.
NETWORK_BOUND = {"float64": 1e-9, "float32": 2e-5, "bfloat16": 0.1}
LOSS_BOUND = {"float64": 1e-8, "float32": 1e-5}
GRADIENT_BOUND = {"float64": 1e-5, "float32": 2e-4}
# Of the length of a gradient in float32, or of this share of the whole one where it is shorter.
# PyTorch deviates by 0.32 of it in the layers of 2 to 8 channels that the size tiny has for images, by 0.04 in 1m.
NARROW_BOUND, LEAST_LENGTH = 0.45, 1e-3

Compared = Iterator[
    tuple[str, Callable[..., object]]
]  # what has just been compared, and the function of the reference that says it


@dataclasses.dataclass(frozen=True)
class Agreement:
    """What agreed. requirements: those that its function in the reference names. share: worst deviation as a share of
    the allowed one."""

    name: str
    requirements: list[str]
    share: float


@dataclasses.dataclass(frozen=True)
class Report:
    """passed: whether training may start. worst: largest deviation, relative to the size of what deviates. summary: one
    line.

    comparisons: what agreed, up to the first deviation. seconds: that each part took.
    """

    passed: bool
    worst: float
    summary: str
    comparisons: list[Agreement]
    seconds: dict[str, float]


def _silent(what: str) -> None:
    pass


def preflight(
    backend: str,
    spaces: Spaces,
    config: Config,
    device: str | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = _silent,
) -> Report:
    """Compares a backend (jax, torch or numpy) with the reference. progress: is told what has been found to agree."""
    wide = load_adapter(backend, "float32", device) if config.compute_dtype == "bfloat16" else None
    return preflight_adapter(load_adapter(backend, config.compute_dtype, device), spaces, config, seed, progress, wide)


def preflight_adapter(
    adapter: object,
    spaces: Spaces,
    config: Config,
    seed: int = 0,
    progress: Callable[[str], None] = _silent,
    wide: Any = None,
) -> Report:
    """Compares any adapter with the reference. progress: see `preflight`. wide: in bfloat16 the same in float32, for
    the gradient."""
    small = dataclasses.replace(config, batch_size=ROWS, batch_length=STEPS, imagination_horizon=STEPS)
    comparisons = Comparisons(config.compute_dtype)
    script = Script(Setting(config.compute_dtype, "", seed), asking(adapter), comparisons)
    worst, agreed = 0.0, list[Agreement]()
    parts = [("networks", compare_networks, small)]
    if config.compute_dtype in LOSS_BOUND:
        parts += [("losses and gradient", compare_losses, small), ("learner", compare_learner, small)]
        parts += [("batch", compare_batch, config)]
    elif wide is not None:
        parts += [("gradient", functools.partial(compare_with_float32, wide), config)]
    seconds = dict[str, float]()  # of what the adapter offers
    for name, part, sizes in parts:
        before, began = len(agreed), time.perf_counter()
        try:
            for what, function in part(script, adapter, spaces, sizes):
                agreed.append(
                    Agreement(what, re.findall(r"\[([A-Z]+-\d+)\]", function.__doc__ or ""), comparisons.worst.share)
                )
                worst, comparisons.worst = max(worst, comparisons.worst.deviation), Worst()
                progress(what)
        except Deviation as deviation:
            return Report(False, comparisons.worst.deviation, f"{name}: {deviation}", agreed, seconds)
        if len(agreed) > before:
            seconds[name] = round(time.perf_counter() - began, 2)
    compared = f"{comparisons.compared:,} numbers compared"
    summary = f"{', '.join(seconds)} agree with the reference in {config.compute_dtype}, {compared}"
    return Report(True, worst, summary, agreed, seconds)


def compare_networks(script: Script, adapter: object, spaces: Spaces, config: Config) -> Compared:
    """Encoder, one step of the recurrent model, prior, decoder and heads, each on given inputs."""
    rng = np.random.default_rng(script.setting.seed)
    params = random_parameters(rng, config, spaces, "float32")
    observations = random_observations(rng, spaces, (ROWS,))
    carry = random_carry(rng, config, (ROWS,))
    action = random_batch(rng, config, spaces)["prev_action"][:, 0]
    tokens = networks.encoder(params, observations, spaces, config)
    deter = rssm.core(params, carry["deter"], carry["stoch"], action, config)
    feature = networks.feature(carry["deter"], carry["stoch"])
    calls: list[tuple[Callable[..., object], tuple[Any, ...], object]] = [
        (networks.encoder, (params, observations, spaces, config), tokens),
        (rssm.core, (params, carry["deter"], carry["stoch"], action, config), deter),
        (rssm.posterior, (params, deter, tokens, config), rssm.posterior(params, deter, tokens, config)),
        (rssm.prior, (params, deter, config), rssm.prior(params, deter, config)),
        (networks.decoder, (params, feature, spaces, config), networks.decoder(params, feature, spaces, config)),
        (networks.actor, (params, feature, spaces, config), networks.actor(params, feature, spaces, config)),
    ]
    for head in (networks.reward_head, networks.continue_head, networks.critic):
        calls.append((head, (params, feature, config), head(params, feature, config)))
    for function, arguments, expected in calls:
        script.expect(
            function.__name__, arguments, expected, magnitude="tensor", bound=NETWORK_BOUND[script.setting.dtype]
        )
        yield function.__name__, function


def compare_losses(script: Script, adapter: object, spaces: Spaces, config: Config) -> Compared:
    """Every loss of a training step, and the derivative of the total along random directions, where the candidate has
    gradients."""
    problem = comparable_problem(script.setting.seed, spaces, config)
    along = dict(directions(problem.state["params"], script.setting.seed))
    yield from compare_problem(script, adapter, problem, along)


def compare_batch(script: Script, adapter: object, spaces: Spaces, config: Config) -> Compared:
    """The same of a batch as long as the run's, with as many rows of it as the reference takes seconds for, along one
    direction: implementations compute many rows, images and steps in other ways than few."""
    if not callable(getattr(adapter, "gradients", None)):
        return
    problem = settled(random_problem(script.setting.seed, spaces, batch_for_reference(spaces, config)), SAMPLING_MARGIN)
    label, direction = next(directions(problem.state["params"], script.setting.seed))
    for what, function in compare_problem(script, adapter, problem, {label: direction}):
        yield what + _of_batch(problem), function


def batch_for_reference(spaces: Spaces, config: Config) -> Config:
    """The run's configuration with as much of its batch as the reference takes seconds for."""
    horizon = min(HORIZON, config.imagination_horizon)
    return dataclasses.replace(config, batch_size=rows_of_batch(spaces, config), imagination_horizon=horizon)


def _of_batch(problem: Problem) -> str:
    return f" of {problem.config.batch_size} x {problem.config.batch_length} steps"


def compare_with_float32(wide: Any, script: Script, adapter: object, spaces: Spaces, config: Config) -> Compared:
    """The gradient of every tensor, of such a batch: its length and its angle are those in float32."""
    if not callable(getattr(adapter, "gradients", None)):
        return
    problem = settled(random_problem(script.setting.seed, spaces, batch_for_reference(spaces, config)), 1.0)
    arguments = problem.loss_arguments
    narrow, right = script.call("gradients", *arguments), wide.gradients(*arguments)
    least = LEAST_LENGTH * np.sqrt(sum(float((np.asarray(x, np.float64) ** 2).sum()) for x in right.values()))
    for name in problem.state["params"]:
        expected = np.asarray(right[name], np.float64)
        distance = float(np.linalg.norm(np.asarray(narrow[name], np.float64) - expected))
        length = max(float(np.linalg.norm(expected)), least)
        script.compare(f"gradient of {name}", distance / length, 0.0, magnitude=1.0, bound=NARROW_BOUND)
    yield f"gradient of every tensor{_of_batch(problem)}, as in float32", agent.losses


def rows_of_batch(spaces: Spaces, config: Config) -> int:
    """How many rows of the run's batch are compared. With images, which take the reference most of its time, the
    least."""
    weights = sum(math.prod(entry.shape) for entry in parameter_table(config, spaces).values())
    affordable = OPERATIONS / (weights * config.batch_length * (1 + HORIZON))
    least = math.ceil(LEAST_STEPS / config.batch_length)
    return min(config.batch_size, least if spaces.images else max(least, int(affordable)))


def compare_learner(script: Script, adapter: object, spaces: Spaces, config: Config) -> Compared:
    """A train step of the learner from the middle of training, its whole state after it, and acting with the new
    parameters."""
    if not callable(getattr(adapter, "Learner", None)):
        return
    from conformance.cases import learner as checks  # with all other checks, which takes a moment

    problem = random_problem(script.setting.seed, spaces, config)
    state = random_state(np.random.default_rng(script.setting.seed), config, spaces, "float32")
    learner = checks.made(script, problem)
    learner.load_state_dict(agent.flatten_state(state))
    seed = checks.compare_step(script, learner, problem, 1, "train step", config, SAMPLING_MARGIN)
    yield "train step of the learner", agent.train_step
    checks.compare_acting(script, learner, problem, seed + 1, "after the train step")
    yield "policy step of the learner", agent.policy_step


def compare_problem(
    script: Script, adapter: object, problem: Problem, along: dict[str, dict[str, np.ndarray]]
) -> Compared:
    """Every loss, and the derivative of the total along directions."""
    dtype = script.setting.dtype
    total, aux = agent.losses(*problem.loss_arguments)
    actual_total, actual = script.call("losses", *problem.loss_arguments)
    size = max(1.0, *(abs(loss) for loss in aux["losses"].values()))
    script.compare("losses", actual["losses"], aux["losses"], magnitude=size, bound=LOSS_BOUND[dtype])
    yield "losses", agent.losses
    script.compare("total", actual_total, total, magnitude=max(size, abs(total)), bound=LOSS_BOUND[dtype])
    yield "total loss", agent.losses

    if not callable(getattr(adapter, "gradients", None)):
        return  # the reference itself
    gradients = script.call("gradients", *problem.loss_arguments)
    params, *others = problem.loss_arguments
    weights = np.array([getattr(problem.config, f"{name.partition('/')[0]}_scale") for name in aux["losses"]])

    def losses(point: Any) -> np.ndarray:
        return np.array(list(agent.losses(point, *others)[1]["losses"].values()))

    for label, direction in along.items():
        # Loss by loss, so that what a direction does not reach cancels without rounding.
        derivative = agent.directional_derivative(losses, params, direction, DIFFERENCE_STEP) @ weights
        product = sum(float((np.asarray(gradients[name]) * along).sum()) for name, along in direction.items())
        # The size of such a product on average: by chance a product can be nearly 0, and its error is not.
        usual = np.sqrt(sum(float((np.asarray(gradients[name]) ** 2).mean()) for name in direction))
        name, size = f"gradient along {label}", max(usual, abs(derivative))
        script.compare(name, product, derivative, magnitude=size, bound=GRADIENT_BOUND[dtype])
        yield name, agent.directional_derivative


def directions(params: dict[str, np.ndarray], seed: int) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """A random direction in all parameters, and one in each part of the agent (the first part of the names) alone.

    What each tensor contributes has length 1, or a large kernel would hide a bias that has no gradient.
    """
    rng = np.random.default_rng(seed)
    parts = dict.fromkeys(name.partition("/")[0] for name in params)
    for label, prefix in {"all parameters": "", **{part: f"{part}/" for part in parts}}.items():
        noise = {name: rng.normal(size=value.shape) for name, value in params.items() if name.startswith(prefix)}
        yield label, {name: value / np.linalg.norm(value) for name, value in noise.items()}


def random_problem(seed: int, spaces: Spaces, config: Config) -> Problem:
    """A train step at random parameters."""
    rng = np.random.default_rng(seed)
    params = random_parameters(rng, config, spaces, "float32")
    state = {
        "params": params,
        "slow_critic": {name: value for name, value in params.items() if name.startswith("critic/")},
        "return_range": {"low": 0.0, "high": 2.0},
    }
    return Problem(spaces, config, state, random_batch(rng, config, spaces), train_noise(rng, config, spaces))


def comparable_problem(seed: int, spaces: Spaces, config: Config) -> Problem:
    """A problem in which no sample lies so near a class boundary that honest rounding could move it across."""
    return settled(random_problem(seed, spaces, config), SAMPLING_MARGIN)
