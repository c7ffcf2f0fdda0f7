"""Checks of implementations that take samples in place of noise: the functions named `..._given`.

The samples are those that the reference draws from noise, so that what is expected is what the reference computes from
that noise.
"""

from typing import Any

import numpy as np

from conformance.cases.agent import (
    COMBINATIONS,
    GRADIENT_REQUIREMENTS,
    LOSS_REQUIREMENTS,
    WHOLE,
    bound_of,
    compare_steps,
    loss_magnitude,
    problem_of,
    reference_derivatives,
    unit_directions,
)
from conformance.cases.rssm import SIZES, imagine_arguments, observe_arguments, reference_imagine
from conformance.check import Run, check
from conformance.problems import Problem, small_config
from conformance.strategies import seeds
from reference_numpy import agent, behavior, networks, rssm

OBSERVE = ("RSSM-8", "RSSM-9", "RSSM-13", "RSSM-14", "RSSM-15", "RSSM-17", "RSSM-18", "RSSM-19", "CON-12")


@check(*OBSERVE, uses=["observe_given"], level=1)
def observe_given_matches(run: Run) -> None:
    """Memories and the logits of posterior and prior along random sequences, with resets at any step of any row."""

    @run.for_all(seed=seeds(), sizes=SIZES)
    def _(seed: int, sizes: dict[str, Any]) -> None:
        config = small_config(run.profile, run.dtype, **sizes)
        arguments = observe_arguments(run, seed, config)
        params, *inputs, _, _ = arguments
        states = rssm.observe(*arguments)
        expected = {
            "deter": states["deter"],
            "posterior": states["logits"],
            "prior": rssm.prior(params, states["deter"], config),
        }
        run.expect("observe_given", (params, *inputs, states["stoch"], config), expected, magnitude="tensor")


@check("RSSM-2", "RSSM-8", "RSSM-20", "RSSM-21", "RSSM-22", uses=["imagine_given"], level=1)
def imagine_given_matches(run: Run) -> None:
    """Memories and prior logits of trajectories with given actions and latents; the start is unchanged."""

    @run.for_all(seed=seeds(), sizes=SIZES)
    def _(seed: int, sizes: dict[str, Any]) -> None:
        config = small_config(run.profile, run.dtype, **sizes)
        params, carry, action, *rest = imagine_arguments(run, seed, config)
        states = reference_imagine(params, carry, action, *rest)
        expected = {"deter": states["deter"], "prior": rssm.prior(params, states["deter"][:, 1:], config)}
        run.expect(
            "imagine_given", (params, carry, action, states["stoch"][:, 1:], config), expected, magnitude="tensor"
        )


@check(*LOSS_REQUIREMENTS, uses=["losses_given"], level=2, dtypes=WHOLE)
def losses_given_match(run: Run) -> None:
    """Every loss, the total and the return range of one pass with given samples."""
    for observation, action in COMBINATIONS:
        problem = problem_of(run, observation, action)
        total, aux = agent.losses(*problem.loss_arguments)
        actual_total, actual = run.call("losses_given", *given_arguments(problem))
        where, bound = f"{observation}, {action}: ", bound_of(run, 1e-9, 2e-4)
        run.compare(where + "losses", actual["losses"], aux["losses"], magnitude=loss_magnitude(aux), bound=bound)
        run.compare(where + "total", actual_total, total, magnitude=abs(total), bound=bound)
        run.compare(
            where + "return_range", tuple(actual["return_range"]), aux["return_range"], magnitude=1.0, bound=bound
        )


@check(*GRADIENT_REQUIREMENTS, uses=["gradients_given"], level=2, dtypes=WHOLE)
def gradients_given_match(run: Run) -> None:
    """The gradient of the total along random directions, in all parameters and in every group."""
    for observation, action in (("vector", "discrete"), ("both", "mixed")):
        problem = problem_of(run, observation, action)
        derivatives = reference_derivatives(run.seed, run.profile, observation, action, run.dtype)
        total = sum(
            getattr(problem.config, f"{name.split('/')[0]}_scale") * value for name, value in derivatives.items()
        )
        gradients = run.call("gradients_given", *given_arguments(problem))
        directions = unit_directions(problem, run.seed).values()
        products = [
            sum(float((np.asarray(gradients[name]) * along).sum()) for name, along in direction.items())
            for direction in directions
        ]
        where = f"{observation}, {action}: gradient along directions"
        run.compare(where, np.array(products), total, magnitude=np.abs(total).max(), bound=bound_of(run, 1e-6, 5e-3))


@check(
    "AGT-29",
    "AGT-30",
    "BEH-21",
    "OPT-17",
    "OPT-21",
    uses=["train_step_given", "gradients_given"],
    level=3,
    dtypes=WHOLE,
)
def train_step_given_matches(run: Run) -> None:
    """Parameters, moments, slow critic and return range after one step with given samples."""
    for observation, action in (("vector", "discrete"), ("both", "mixed")):
        problem = problem_of(run, observation, action)
        gradients = run.call("gradients_given", *given_arguments(problem))
        expected = agent.train_step(
            problem.state, problem.batch, problem.noise, gradients, problem.spaces, problem.config
        )
        actual = run.call(
            "train_step_given", problem.state, problem.batch, samples_of(problem), problem.spaces, problem.config
        )
        compare_steps(run, f"{observation}, {action}: ", actual, expected, problem.state, bound_of(run, 1e-9, 2e-3))


def given_arguments(problem: Problem) -> tuple[Any, ...]:
    """The arguments of `losses_given` and `gradients_given`."""
    params, slow_critic, return_range, batch, _, task, config = problem.loss_arguments
    return params, slow_critic, return_range, batch, samples_of(problem), task, config


def samples_of(problem: Problem) -> dict[str, np.ndarray]:
    """What the reference draws from the noise of a problem, as `losses_given` takes it."""
    config, params, noise = problem.config, problem.state["params"], problem.noise
    states = agent.losses(*problem.loss_arguments)[1]
    starts = config.batch_size * config.batch_length
    start = {name: states[name].reshape(starts, *states[name].shape[2:]) for name in ("deter", "stoch")}

    def policy(feature: np.ndarray, t: int) -> np.ndarray:
        outputs = networks.actor(params, feature, problem.spaces, config)
        return behavior.sample_action(outputs, noise["action"][:, t], problem.spaces, config)

    dream = rssm.imagine(params, start, policy, noise["prior"], config)
    return {"posterior": states["stoch"], "prior": dream["stoch"][:, 1:], "action": dream["action"]}
