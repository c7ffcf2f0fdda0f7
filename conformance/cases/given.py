"""Checks of implementations that take samples in place of noise: the functions named `..._given`.

The samples are those that the reference draws from noise, so that what is expected is what the reference computes from
that noise.
"""

import functools
from typing import Any

import numpy as np

from conformance.case import Cases, Drawn, Setting, equal, judged, related
from conformance.cases import losses
from conformance.cases.agent import STEP, WHOLE, Example, example_of, gradient_is_right, step_follows, step_of
from conformance.cases.rssm import SIZES, imagine_arguments, observe_arguments, reference_imagine
from conformance.check import check
from conformance.problems import small_config
from conformance.strategies import seeds
from reference_numpy import behavior, networks, rssm

OBSERVE = ("RSSM-8", "RSSM-9", "RSSM-13", "RSSM-14", "RSSM-15", "RSSM-17", "RSSM-18", "RSSM-19", "CON-12")
GRADIENTS = (
    *("AGT-28", "AGT-32", "CON-14", "CON-15", "RSSM-23", "RSSM-24", "RSSM-25", "NET-25"),
    *("WM-1", "WM-11", "WM-12", "WM-13", "WM-14", "WM-17", "RET-18", "BEH-5", "BEH-10", "BEH-13", "BEH-15"),
)


@check(*OBSERVE, uses=["observe_given"], level=1)
def observe_given_matches(setting: Setting) -> Cases:
    """Memories and the logits of posterior and prior along random sequences, with resets at any step of any row."""

    def case(seed: int, sizes: dict[str, Any]) -> Cases:
        config = small_config(setting.profile, setting.dtype, **sizes)
        arguments = observe_arguments(setting, seed, config)
        params, *inputs, _, _ = arguments
        states = rssm.observe(*arguments)
        prior = rssm.prior(params, states["deter"], config)
        expected = {"deter": states["deter"], "posterior": states["logits"], "prior": prior}
        yield equal("observe_given", (params, *inputs, states["stoch"], config), expected, magnitude="tensor")

    yield Drawn(case, seed=seeds(), sizes=SIZES)


@check("RSSM-2", "RSSM-8", "RSSM-20", "RSSM-21", "RSSM-22", uses=["imagine_given"], level=1)
def imagine_given_matches(setting: Setting) -> Cases:
    """Memories and prior logits of trajectories with given actions and latents; the start is unchanged."""

    def case(seed: int, sizes: dict[str, Any]) -> Cases:
        config = small_config(setting.profile, setting.dtype, **sizes)
        params, carry, action, *rest = imagine_arguments(setting, seed, config)
        states = reference_imagine(params, carry, action, *rest)
        expected = {"deter": states["deter"], "prior": rssm.prior(params, states["deter"][:, 1:], config)}
        arguments = (params, carry, action, states["stoch"][:, 1:], config)
        yield equal("imagine_given", arguments, expected, magnitude="tensor")

    yield Drawn(case, seed=seeds(), sizes=SIZES)


@functools.lru_cache(maxsize=64)
def samples_of(example: Example) -> dict[str, np.ndarray]:
    """What the reference draws from the noise of a problem, as `losses_given` takes it."""
    problem, states = example.problem, example.losses[1]
    config, params, noise = problem.config, problem.state["params"], problem.noise
    starts = config.batch_size * config.batch_length
    start = {name: states[name].reshape(starts, *states[name].shape[2:]) for name in ("deter", "stoch")}

    def policy(feature: np.ndarray, t: int) -> np.ndarray:
        outputs = networks.actor(params, feature, problem.spaces, config)
        return behavior.sample_action(outputs, noise["action"][:, t], problem.spaces, config)

    dream = rssm.imagine(params, start, policy, noise["prior"], config)
    return {"posterior": states["stoch"], "prior": dream["stoch"][:, 1:], "action": dream["action"]}


def given_arguments(example: Example) -> tuple[Any, ...]:
    """The arguments of `losses_given` and `gradients_given`."""
    params, slow_critic, return_range, batch, _, task, config = example.problem.loss_arguments
    return params, slow_critic, return_range, batch, samples_of(example), task, config


def passes(setting: Setting, *outputs: str) -> Cases:
    """As `losses.passes`, with given samples."""
    return losses.passes(setting, *outputs, ask=lambda example: ("losses_given", given_arguments(example)))


@check(*losses.RECONSTRUCTIONS, uses=["losses_given"], level=2, dtypes=WHOLE)
def reconstructions_match(setting: Setting) -> Cases:
    """The reconstruction loss of every observation key, with given samples."""
    yield from passes(setting, "reconstruction")


@check(*losses.REWARD_AND_CONTINUE, uses=["losses_given"], level=2, dtypes=WHOLE)
def reward_and_continue_match(setting: Setting) -> Cases:
    """The losses of the reward head and the continue head, with given samples."""
    yield from passes(setting, "reward", "continue")


@check(*losses.KL, uses=["losses_given"], level=2, dtypes=WHOLE)
def dynamics_and_representation_match(setting: Setting) -> Cases:
    """The two KL losses, with given samples."""
    yield from passes(setting, "dynamics", "representation")


@check(*losses.RANGE, uses=["losses_given"], level=2, dtypes=WHOLE)
def return_range_matches(setting: Setting) -> Cases:
    """The return range after a pass with given samples."""
    yield from passes(setting, "return_range")


@check(*losses.ACTOR, uses=["losses_given"], level=2, dtypes=WHOLE)
def actor_matches(setting: Setting) -> Cases:
    """The loss of the actor, with given samples."""
    yield from passes(setting, "actor")


@check(*losses.CRITIC, uses=["losses_given"], level=2, dtypes=WHOLE)
def critic_matches(setting: Setting) -> Cases:
    """The loss of the critic at imagined states, with given samples."""
    yield from passes(setting, "critic")


@check(*losses.REPLAY_CRITIC, uses=["losses_given"], level=2, dtypes=WHOLE)
def replay_critic_matches(setting: Setting) -> Cases:
    """The loss of the critic at replayed states, with given samples."""
    yield from passes(setting, "replay_critic")


@check(*losses.TOTAL, uses=["losses_given"], level=2, dtypes=WHOLE)
def total_matches(setting: Setting) -> Cases:
    """The weighted sum of all losses and their names, with given samples."""
    yield from passes(setting, "total")


@check(*GRADIENTS, uses=["gradients_given"], level=2, dtypes=WHOLE)
def gradients_given_match(setting: Setting) -> Cases:
    """The gradient of the total along random directions, in all parameters and in every group."""
    for observation, action in (("vector", "discrete"), ("both", "mixed")):
        example = example_of(setting, observation, action)
        yield judged("gradients_given", given_arguments(example), gradient_is_right(setting, observation, action))


@check(*STEP, uses=["train_step_given", "gradients_given"], level=3, dtypes=WHOLE)
def train_step_given_matches(setting: Setting) -> Cases:
    """Parameters, moments, slow critic and return range after one step with given samples."""
    for observation, action in (("vector", "discrete"), ("both", "mixed")):
        example, problem = example_of(setting, observation, action), step_of(setting, observation, action)
        inputs = (problem.state, problem.batch, samples_of(example), problem.spaces, problem.config)
        relation = step_follows(setting, f"{observation}, {action}: ", problem)
        yield related(relation, ("gradients_given", given_arguments(example)), ("train_step_given", inputs))
