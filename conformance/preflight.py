"""Preflight: is this backend right on this very configuration, these spaces, this precision and this device?

Small batch, few time steps, full-size networks: seconds for the small sizes. Networks are compared one by one on given states, so that any
precision can be judged. In float64 and float32 whole losses and their gradient are compared too; in bfloat16 a sample may honestly fall
into another class, after which nothing is comparable.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from conformance.adapter import load_adapter
from conformance.check import Deviation, Run
from conformance.problems import Problem, nudged, random_batch, random_carry, random_observations, random_parameters, train_noise
from reference_numpy import agent, networks, rssm
from spec import Config, Spaces

ROWS = 2
STEPS = 2
SAMPLING_MARGIN = 1e-5
NETWORK_BOUND = {"float64": 1e-9, "float32": 1e-3, "bfloat16": 0.1}
LOSS_BOUND = {"float64": 1e-8, "float32": 2e-3}
GRADIENT_BOUND = {"float64": 1e-5, "float32": 2e-2}


@dataclasses.dataclass(frozen=True)
class Report:
    """passed: whether training may start. worst: largest deviation, relative to the size of what deviates. summary: one line."""

    passed: bool
    worst: float
    summary: str


def preflight(backend: str, spaces: Spaces, config: Config, device: str | None = None, seed: int = 0) -> Report:
    """Compares a backend (jax, torch or numpy) with the reference."""
    return preflight_adapter(load_adapter(backend, config.compute_dtype, device), spaces, config, seed)


def preflight_adapter(adapter: object, spaces: Spaces, config: Config, seed: int = 0) -> Report:
    """Compares any adapter with the reference."""
    small = dataclasses.replace(config, batch_size=ROWS, batch_length=STEPS, imagination_horizon=STEPS)
    run = Run(adapter, config.compute_dtype, "", seed)
    worst = 0.0
    parts = [("networks", compare_networks)]
    if config.compute_dtype in LOSS_BOUND:
        parts += [("losses and gradient", compare_losses)]
    for name, part in parts:
        try:
            part(run, spaces, small)
        except Deviation as deviation:
            return Report(False, run.worst.deviation, f"{name}: {deviation}")
        worst = max(worst, run.worst.deviation)
    what = " and ".join(name for name, _ in parts)
    return Report(True, worst, f"{what} agree with the reference in {config.compute_dtype}, {run.compared:,} numbers compared")


def compare_networks(run: Run, spaces: Spaces, config: Config) -> None:
    """Encoder, one step of the recurrent model, prior, decoder and heads, each on given inputs."""
    rng = np.random.default_rng(run.seed)
    params = random_parameters(rng, config, spaces, "float32")
    observations = random_observations(rng, spaces, (ROWS,))
    carry = random_carry(rng, config, (ROWS,))
    action = random_batch(rng, config, spaces)["prev_action"][:, 0]
    tokens = networks.encoder(params, observations, spaces, config)
    deter = rssm.core(params, carry["deter"], carry["stoch"], action, config)
    feature = networks.feature(carry["deter"], carry["stoch"])
    close = functools.partial(run.expect, magnitude="tensor", bound=NETWORK_BOUND[run.dtype])
    close("encoder", (params, observations, spaces, config), tokens)
    close("core", (params, carry["deter"], carry["stoch"], action, config), deter)
    close("posterior", (params, deter, tokens, config), rssm.posterior(params, deter, tokens, config))
    close("prior", (params, deter, config), rssm.prior(params, deter, config))
    close("decoder", (params, feature, spaces, config), networks.decoder(params, feature, spaces, config))
    close("actor", (params, feature, spaces, config), networks.actor(params, feature, spaces, config))
    for head in ("reward_head", "continue_head", "critic"):
        close(head, (params, feature, config), getattr(networks, head)(params, feature, config))


def compare_losses(run: Run, spaces: Spaces, config: Config) -> None:
    """Every loss of a training step, and the derivative of the total along a random direction."""
    problem = comparable_problem(run, spaces, config)
    total, aux = agent.losses(*problem.loss_arguments)
    actual_total, actual = run.call("losses", *problem.loss_arguments)
    size = max(1.0, *(abs(loss) for loss in aux["losses"].values()))
    run.compare("losses", actual["losses"], aux["losses"], magnitude=size, bound=LOSS_BOUND[run.dtype])
    run.compare("total", actual_total, total, magnitude=max(size, abs(total)), bound=LOSS_BOUND[run.dtype])

    gradients = run.call("gradients", *problem.loss_arguments)
    length = np.sqrt(sum(float((np.asarray(gradient) ** 2).sum()) for gradient in gradients.values()))
    # Along its own gradient the derivative is the gradient's length: no direction sees more of it.
    direction = {name: np.asarray(gradient) / length for name, gradient in gradients.items()}
    others = problem.loss_arguments[1:]
    derivative = agent.directional_derivative(lambda params: agent.losses(params, *others)[0], problem.state["params"], direction, 1e-5)
    run.compare("gradient of the total", length, derivative, bound=GRADIENT_BOUND[run.dtype])


def comparable_problem(run: Run, spaces: Spaces, config: Config) -> Problem:
    """A problem in which no sample lies so near a class boundary that honest rounding could move it across."""
    rng = np.random.default_rng(run.seed)
    params = random_parameters(rng, config, spaces, "float32")
    state: dict[str, Any] = {
        "params": params,
        "slow_critic": {name: value for name, value in params.items() if name.startswith("critic/")},
        "return_range": {"low": 0.0, "high": 2.0},
    }
    for _ in range(100):
        problem = Problem(spaces, config, state, random_batch(rng, config, spaces), train_noise(rng, config, spaces))
        totals = {agent.losses(*nudged(problem, distance).loss_arguments)[0] for distance in (-SAMPLING_MARGIN, SAMPLING_MARGIN)}
        if len(totals) == 1:
            return problem
    return problem
