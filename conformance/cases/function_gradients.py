"""Gradients of single functions: what flows back into their arguments, and what must not.

Expected are differences of the reference, in which constants of the gradient stay as they are. An implementation that
offers no whole losses shows here whether its stop-gradients are where they belong.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from conformance.case import Call, Case, Cases, Related, Setting
from conformance.cases.agent import WHOLE, bound_of
from conformance.check import check
from conformance.compare import Comparisons, entries
from conformance.interface import RESULTS
from conformance.problems import random_actions, small_config, spaces
from reference_numpy import behavior, distributions, layers, world_model
from reference_numpy.agent import directional_derivative
from reference_numpy.transforms import exponential_bins
from spec import Spaces, Vector

DIRECTIONS = 4
STEP = 1e-6

Moving = dict[str, np.ndarray]


def reals(value: Any, name: str) -> Moving:
    """The arrays of real numbers of a nested value, by path; none for an argument without a name."""
    if isinstance(value, dict | tuple):
        return {path: array for key in entries(value) for path, array in reals(value[key], f"{name} {key}").items()}
    return {name: value} if name and isinstance(value, np.ndarray) and value.dtype.kind == "f" else {}


def moved(value: Any, name: str, arrays: Moving) -> Any:
    """The nested value with other arrays at their paths."""
    if isinstance(value, dict):
        return {key: moved(entry, f"{name} {key}", arrays) for key, entry in value.items()}
    return arrays.get(name, value)


def all_reals(values: tuple[Any, ...], names: tuple[str, ...]) -> Moving:
    """Those of several arguments; arguments after the last name are not looked at."""
    return {path: x for value, name in zip(values, names, strict=False) for path, x in reals(value, name).items()}


def pulled_back(
    setting: Setting,
    function: Callable[..., Any],
    names: tuple[str, ...],
    *arguments: Any,
    called: str = "",
) -> Case:
    """What flows back into the first arguments, which have names. called: the function of the interface, if not that of
    the same name."""
    rng, called = setting.rng(), called or function.__name__
    arguments = tuple(setting.cast(x) if isinstance(x, np.ndarray) and x.dtype.kind == "f" else x for x in arguments)
    cotangents = tuple(setting.cast(rng.normal(size=np.shape(result))) for result in as_tuple(function(*arguments)))

    def total(arrays: Moving) -> Any:
        shifted = [moved(value, name, arrays) for value, name in zip(arguments, names, strict=False)]
        results = as_tuple(function(*shifted, *arguments[len(names) :]))
        return sum(np.sum(weight * result) for weight, result in zip(cotangents, results, strict=True))

    start = all_reals(arguments, names)
    along = {name: directions(rng, name, array) for name, array in start.items()}
    expected = {
        name: np.array([directional_derivative(total, start, {name: way}, STEP) for way in ways])
        for name, ways in along.items()
    }
    size = max(float(np.sqrt(np.mean(derivatives**2))) for derivatives in expected.values())

    def same(c: Comparisons, gradients: Any) -> None:
        found = all_reals(gradients, names)
        for name, derivatives in expected.items():
            products = (along[name] * found.get(name, 0.0)).reshape(DIRECTIONS, -1).sum(-1)
            bound = bound_of(setting, 1e-6, 1e-3)
            c.compare(f"gradient of {called} by {name}", products, derivatives, magnitude=size, bound=bound)

    weights = dict(zip(RESULTS[called], cotangents, strict=True)) if called in RESULTS else cotangents[0]
    return Case((Call("vjp", (called, arguments, weights)),), (Related(same),))


def directions(rng: np.random.Generator, name: str, start: np.ndarray) -> np.ndarray:
    """[DIRECTIONS, ...]: random ones; log-probabilities stay normalized along them."""
    noise = rng.normal(size=(DIRECTIONS, *start.shape))
    return noise - np.sum(np.exp(start) * noise, -1, keepdims=True) if name.startswith("log_probs") else noise


def as_tuple(results: Any) -> tuple[Any, ...]:
    return results if isinstance(results, tuple) else (results,)


def normal(setting: Setting, *shape: int, scale: float = 1.0, seed: int = 0) -> np.ndarray:
    return np.random.default_rng([setting.seed, seed]).normal(0, scale, shape)


def log_probs(setting: Setting, *shape: int, seed: int = 0) -> np.ndarray:
    return distributions.unimix_log_probs(normal(setting, *shape, seed=seed), 0.01)


@check("DIS-5", uses=["unimix_log_probs", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_mixture(setting: Setting) -> Cases:
    """Log-probabilities of a mixture by the logits."""
    yield pulled_back(setting, distributions.unimix_log_probs, ("logits",), normal(setting, 3, 5, scale=2), 0.1)


@check("DIS-2", "DIS-9", uses=["straight_through", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_a_straight_through_sample(setting: Setting) -> Cases:
    """It is that of the probabilities, and none of it reaches the sample."""
    sample = np.eye(5)[[1, 4, 2]]
    names = ("log_probs", "sample")
    yield pulled_back(setting, distributions.straight_through, names, log_probs(setting, 3, 5), sample)


@check("DIS-9", "RSSM-12", uses=["draw_categorical", "vjp"], level=1, dtypes=WHOLE)
def gradient_of_the_own_sampler(setting: Setting) -> Cases:
    """Samples of the implementation's own generator pass the gradient of the mixed probabilities, whatever was drawn: a
    relaxed sample passes another one."""

    def probabilities(logits: np.ndarray, unimix: float, seed: int, n: int) -> np.ndarray:
        return np.broadcast_to(np.exp(distributions.unimix_log_probs(logits, unimix)), (n, *logits.shape))

    arguments = (normal(setting, 3, 5, scale=2), 0.01, setting.seed, 64)
    yield pulled_back(setting, probabilities, ("logits",), *arguments, called="draw_categorical")


@check("DIS-2", "DIS-21", uses=["normal_log_prob", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_a_normal_density(setting: Setting) -> Cases:
    """It reaches mean and standard deviation, and not the value, in which it would cancel."""
    mean, value, std = normal(setting, 4, 3), normal(setting, 4, 3, seed=1), 0.5 + normal(setting, 4, 3, seed=2) ** 2
    yield pulled_back(setting, distributions.normal_log_prob, ("mean", "std", "value"), mean, std, value)


@check("DIS-10", uses=["categorical_log_prob", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_a_categorical_density(setting: Setting) -> Cases:
    """The logarithm of the drawn class alone."""
    arguments = (log_probs(setting, 3, 5), np.eye(5)[[1, 4, 2]])
    yield pulled_back(setting, distributions.categorical_log_prob, ("log_probs",), *arguments)


@check("DIS-11", uses=["categorical_entropy", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_entropy(setting: Setting) -> Cases:
    """Through the logarithm and through the probability before it."""
    yield pulled_back(setting, distributions.categorical_entropy, ("log_probs",), log_probs(setting, 3, 5))


@check("DIS-12", uses=["categorical_kl", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_divergence(setting: Setting) -> Cases:
    """It reaches both distributions."""
    arguments = (log_probs(setting, 3, 5), log_probs(setting, 3, 5, seed=1))
    yield pulled_back(setting, distributions.categorical_kl, ("log_probs_p", "log_probs_q"), *arguments)


@check("DIS-14", uses=["symexp_twohot_loss", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_twohot_loss(setting: Setting) -> Cases:
    """Softmax minus two-hot weights."""
    logits, target = normal(setting, 4, 31, scale=2), normal(setting, 4, scale=20, seed=1)
    yield pulled_back(setting, distributions.symexp_twohot_loss, ("logits",), logits, target, exponential_bins(31))


@check("DIS-17", uses=["bernoulli_loss", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_bernoulli_loss(setting: Setting) -> Cases:
    """Sigmoid minus target."""
    target = np.array([0.0, 1.0, 1 - 1 / 333, 0.5])
    yield pulled_back(setting, distributions.bernoulli_loss, ("logit",), normal(setting, 4, scale=3), target)


@check("DIS-24", uses=["symlog_mse_loss", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_vector_loss(setting: Setting) -> Cases:
    """The prediction minus symlog of the target, times twice the scale."""
    arguments = (normal(setting, 4, 3), normal(setting, 4, 3, scale=20, seed=1), 0.5)
    yield pulled_back(setting, distributions.symlog_mse_loss, ("prediction",), *arguments)


@check("LAY-4", uses=["rms_norm", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_norm(setting: Setting) -> Cases:
    """Through the mean square too, and into the scale."""
    for leading in ((4,), ()):
        arguments = (normal(setting, *leading, 6), 1 + normal(setting, 6, scale=0.2, seed=1), 1e-2)
        yield pulled_back(setting, layers.rms_norm, ("x", "scale"), *arguments)


@check("WM-12", "WM-14", uses=["kl_losses", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_kl_losses(setting: Setting) -> Cases:
    """The dynamics loss reaches the prior alone, the representation loss the posterior alone, and neither where free
    nats clip."""
    config = small_config(setting.profile, setting.dtype, free_nats=1.0)
    shape = (6, config.stoch, config.classes)
    spread = np.array([0.1, 0.1, 1, 1, 3, 3])[:, None, None]
    arguments = (spread * normal(setting, *shape), spread * normal(setting, *shape, seed=1), config)
    yield pulled_back(setting, world_model.kl_losses, ("posterior_logits", "prior_logits"), *arguments)


@check("BEH-5", uses=["action_log_prob", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_policys_density(setting: Setting) -> Cases:
    """It reaches the actor's outputs, and not the action."""
    task, outputs, config = policy(setting)
    action = random_actions(np.random.default_rng(setting.seed), task, (4,))
    yield pulled_back(setting, behavior.action_log_prob, ("outputs", "action"), outputs, action, task, config)


@check("BEH-7", uses=["action_entropy", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_policys_entropy(setting: Setting) -> Cases:
    """It reaches the actor's outputs."""
    task, outputs, config = policy(setting)
    yield pulled_back(setting, behavior.action_entropy, ("outputs",), outputs, task, config)


def policy(setting: Setting) -> tuple[Spaces, dict[str, dict[str, np.ndarray]], Any]:
    """Spaces, raw outputs [4, ...] of the actor, and a configuration."""
    task = spaces()
    outputs = {
        key: {"mean": normal(setting, 4, space.size), "std": normal(setting, 4, space.size, seed=1)}
        if isinstance(space, Vector)
        else {"logits": normal(setting, 4, space.encoded_size)}
        for key, space in task.actions.items()
    }
    cast = {key: {name: setting.cast(x) for name, x in parts.items()} for key, parts in outputs.items()}
    return task, cast, small_config(setting.profile, setting.dtype)


@check("BEH-10", uses=["actor_loss", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_actor_loss(setting: Setting) -> Cases:
    """It reaches log-probability and entropy; returns, values, weights and scale are constants."""
    config = small_config(setting.profile, setting.dtype, entropy_scale=0.1)
    log_prob, entropy, returns, value = (normal(setting, 4, 3, seed=seed) for seed in range(4))
    weight = np.random.default_rng(setting.seed).random((4, 3))
    names = ("log_prob", "entropy", "returns", "value", "weight", "scale")
    arguments = (log_prob, entropy, returns, value, weight, np.array(2.0), config)
    yield pulled_back(setting, behavior.actor_loss, names, *arguments)


@check("BEH-13", uses=["critic_loss", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_critic_loss(setting: Setting) -> Cases:
    """It reaches the critic's logits; those of the slow critic, returns and weights are constants."""
    config = small_config(setting.profile, setting.dtype)
    logits, slow = (normal(setting, 4, 3, config.bins, seed=seed) for seed in range(2))
    returns, weight = normal(setting, 4, 3, scale=5, seed=2), np.random.default_rng(setting.seed).random((4, 3))
    names = ("logits", "slow_logits", "returns", "weight")
    yield pulled_back(setting, behavior.critic_loss, names, logits, slow, returns, weight, config)


@check("BEH-15", uses=["replay_critic_loss", "vjp"], level=0, dtypes=WHOLE)
def gradient_of_the_replayed_critic_loss(setting: Setting) -> Cases:
    """It reaches the critic's logits; those of the slow critic and the returns are constants."""
    config = small_config(setting.profile, setting.dtype)
    logits, slow = (normal(setting, 2, 4, config.bins, seed=seed) for seed in range(2))
    is_last = np.random.default_rng(setting.seed).random((2, 4)) < 0.3
    names = ("logits", "slow_logits", "returns")
    arguments = (logits, slow, normal(setting, 2, 4, scale=5, seed=2), is_last, config)
    yield pulled_back(setting, behavior.replay_critic_loss, names, *arguments)
