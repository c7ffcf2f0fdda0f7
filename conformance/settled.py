"""Noise that draws the same samples in every precision.

A uniform number next to the boundary of a class draws one class in float64 and perhaps another in float32, and after
that nothing is comparable. In a problem as large as a training batch there are tens of thousands of them, so that no
seed avoids all boundaries. Here each number that lies too near is moved, step by step as the reference goes: what it
draws decides the states after it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from conformance.compare import round_to
from conformance.problems import Problem
from reference_numpy import behavior, networks, rssm
from reference_numpy.distributions import categorical_sample, unimix_log_probs
from spec import Config, Discrete, Spaces


def settled(problem: Problem, margin: float) -> Problem:
    """The problem with every uniform number that lies nearer than `margin` to a boundary in the middle of the likeliest
    class; with a margin of 1 all of them."""
    states, posterior = _along_the_batch(problem, margin)
    prior, action = _along_imagination(problem, states, margin)
    return dataclasses.replace(problem, noise={"posterior": posterior, "prior": prior, "action": action})


def away_from_boundaries(uniform: np.ndarray, log_probs: np.ndarray, margin: float) -> np.ndarray:
    """uniform [...], log_probs [..., C] -> [...]: numbers that draw the same class if those, or the boundaries, move by
    less than the margin, or by as much as the likeliest class allows."""
    boundaries = np.cumsum(np.exp(log_probs), -1)[..., :-1]
    near = np.abs(boundaries - uniform[..., None]).min(-1, initial=np.inf) < margin
    edges = np.insert(np.insert(boundaries, 0, 0.0, -1), log_probs.shape[-1], 1.0, -1)  # [..., C + 1]
    widest = np.diff(edges).argmax(-1)[..., None]
    middle = (np.take_along_axis(edges, widest, -1) + np.take_along_axis(edges, widest + 1, -1))[..., 0] / 2
    return np.where(near, round_to(middle, "float32"), uniform)


def _along_the_batch(problem: Problem, margin: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The posterior states as starts of imagination, [B*T, ...] each, and the noise that draws them [B, T, S]."""
    params, batch, config = problem.state["params"], problem.batch, problem.config
    tokens = networks.encoder(params, batch, problem.spaces, config)
    state = {"deter": batch["deter"], "stoch": np.eye(config.classes)[batch["stoch"]]}
    noise = np.array(problem.noise["posterior"])
    states = []
    for t in range(noise.shape[1]):
        inputs = (tokens[:, t], batch["prev_action"][:, t], batch["is_first"][:, t], noise[:, t], config)
        state, logits = rssm.observe_step(params, state, *inputs)
        log_probs = unimix_log_probs(logits, config.latent_unimix)
        noise[:, t] = away_from_boundaries(noise[:, t], log_probs, margin)
        state = {"deter": state["deter"], "stoch": categorical_sample(log_probs, noise[:, t])}
        states.append(state)
    starts = {name: np.stack([state[name] for state in states], 1) for name in state}
    return {name: x.reshape(-1, *x.shape[2:]) for name, x in starts.items()}, noise


def _along_imagination(
    problem: Problem, start: Mapping[str, np.ndarray], margin: float
) -> tuple[np.ndarray, np.ndarray]:
    """The noise of prior [N, H, S] and action [N, H, K]."""
    params, config = problem.state["params"], problem.config
    prior, action = np.array(problem.noise["prior"]), np.array(problem.noise["action"])
    deter, stoch = start["deter"], start["stoch"]
    for t in range(prior.shape[1]):
        outputs = networks.actor(params, networks.feature(deter, stoch), problem.spaces, config)
        action[:, t] = settled_action_noise(action[:, t], outputs, problem.spaces, config, margin)
        taken = behavior.sample_action(outputs, action[:, t], problem.spaces, config)
        deter = rssm.core(params, deter, stoch, taken, config)
        log_probs = unimix_log_probs(rssm.prior(params, deter, config), config.latent_unimix)
        prior[:, t] = away_from_boundaries(prior[:, t], log_probs, margin)
        stoch = categorical_sample(log_probs, prior[:, t])
    return prior, action


def settled_action_noise(
    noise: np.ndarray, outputs: Mapping[str, Any], spaces: Spaces, config: Config, margin: float
) -> np.ndarray:
    """noise [..., K] for an actor's outputs, with its uniform numbers away from boundaries."""
    noise, column = noise.copy(), 0
    for key, space in spaces.actions.items():
        if isinstance(space, Discrete):
            ends = np.cumsum(space.classes)[:-1]
            for entry, logits in enumerate(np.split(np.asarray(outputs[key]["logits"]), ends, -1)):
                log_probs = unimix_log_probs(logits, config.actor_unimix)
                uniform = noise[..., column + entry]
                noise[..., column + entry] = away_from_boundaries(uniform, log_probs, margin)
        column += space.array_shape[0]
    return noise
