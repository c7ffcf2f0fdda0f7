"""Planted mistakes: wrong versions of reference functions, each a mistake that people really make.

A mutant replaces functions of the reference by name. `MutantAdapter` is the reference with these replacements, in effect only while the
candidate is called, so that a check compares the mutant with the unharmed reference. A check that catches no mutant checks nothing.
"""

import contextlib
import dataclasses
import importlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.check import Check
from conformance.execute import Result, run_check
from reference_numpy import behavior, distributions, layers, optimizer, returns, rssm, transforms, world_model
from reference_numpy.stop_gradient import stop_gradient
from spec import Vector

Function = Callable[..., Any]


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One mistake. replacements: "row.function" -> the wrong function."""

    name: str
    explanation: str
    replacements: Mapping[str, Function]


MUTANTS: dict[str, Mutant] = {}


def mutant(explanation: str, *targets: str) -> Callable[[Function], Function]:
    """Registers the decorated function, under its name, as a wrong version of the targets."""

    def register(function: Function) -> Function:
        MUTANTS[function.__name__] = Mutant(function.__name__, explanation, dict.fromkeys(targets, function))
        return function

    return register


@contextlib.contextmanager
def planted(mutant: Mutant) -> Iterator[None]:
    """While this context lasts, the reference uses the wrong functions, wherever it had imported the right ones."""
    undo: list[tuple[Any, str, Any]] = []
    rows = [module for name, module in list(sys.modules.items()) if name.startswith("reference_numpy")]
    try:
        for target, replacement in mutant.replacements.items():
            row, name = target.split(".")
            original = getattr(importlib.import_module(f"reference_numpy.{row}"), name)
            for module in rows:
                if vars(module).get(name) is original:
                    undo.append((module, name, original))
                    setattr(module, name, replacement)
        yield
    finally:
        for module, name, original in undo:
            setattr(module, name, original)


class MutantAdapter:
    """The reference with a mistake: an adapter."""

    def __init__(self, mutant: Mutant) -> None:
        self._mutant = mutant
        self._reference = NumpyAdapter()

    def __getattr__(self, name: str) -> Any:
        getattr(self._reference, name)  # what the reference does not offer, its mutants do not either

        def call(*arguments: Any) -> Any:
            with planted(self._mutant):
                return getattr(self._reference, name)(*arguments)

        return call


def caught_by(mutant: Mutant, checks: Iterable[Check], examples: int = 5) -> dict[str, list[str]]:
    """The names of the checks that find a deviation ("fail") and of those in which the mutant raises ("error").

    A check says something about a mutant only if the reference passes it: see `sound`.
    """
    found: dict[str, list[str]] = {"fail": [], "error": []}
    for check in checks:
        status = run_check(check, MutantAdapter(mutant), "float64", "paper", examples=examples).status
        if status in found:
            found[status].append(check.name)
    return found


def sound(checks: Iterable[Check], examples: int = 5) -> tuple[list[Check], list[Result]]:
    """The checks that the reference without a mistake passes, and the results of those that it does not: they would catch anything."""
    results = [run_check(check, NumpyAdapter(), "float64", "paper", examples=examples) for check in checks]
    broken = [result for result in results if result.status in ("fail", "error")]
    return [result.check for result in results if result.status == "pass"], broken


# --- Returns ---------------------------------------------------------------------------------------------------------------------------

_lambda_return = returns.lambda_return
_replay_lambda_return = returns.replay_lambda_return


def _recursion(reward: Any, continue_: Any, value: Any, end: Any, discount: float, lambda_: float) -> Any:
    """R_t = reward_t + discount * continue_t * ((1 - lambda) value_t + lambda R_{t+1}) with the arrays as they are given."""
    result = [np.asarray(end)]
    for t in reversed(range(reward.shape[1])):
        result.append(reward[:, t] + discount * continue_[:, t] * ((1 - lambda_) * value[:, t] + lambda_ * result[-1]))
    return np.stack(result[:0:-1], 1)


@mutant("lambda-return as printed: every step bootstraps from its own value", "returns.lambda_return")
def return_bootstraps_from_itself(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    return _recursion(reward[:, :-1], continue_[:, :-1], value[:, :-1], value[:, -1], discount, lambda_)


@mutant("lambda-return with the reward and the continue of the state that is left, as in DreamerV2", "returns.lambda_return")
def return_aligned_like_v2(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    return _recursion(reward[:, :-1], continue_[:, :-1], value[:, 1:], value[:, -1], discount, lambda_)


@mutant("lambda-return that bootstraps two states ahead", "returns.lambda_return")
def return_looks_two_ahead(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    late = np.concatenate([value[:, 2:], value[:, -1:]], 1)
    return _recursion(reward[:, 1:], continue_[:, 1:], late, value[:, -1], discount, lambda_)


@mutant("lambda-return without the discount", "returns.lambda_return")
def return_without_discount(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    return _lambda_return(reward, continue_, value, 1.0, lambda_)


@mutant("lambda-return that ignores the continue predictions", "returns.lambda_return")
def return_without_continue(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    return _lambda_return(reward, np.ones_like(continue_), value, discount, lambda_)


@mutant("lambda-return with the most likely continue flag in place of its probability", "returns.lambda_return")
def return_with_continue_mode(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    return _lambda_return(reward, np.where(np.isnan(continue_), np.nan, np.asarray(continue_) > 0.5), value, discount, lambda_)


@mutant("lambda-return with lambda and 1 - lambda swapped", "returns.lambda_return")
def return_with_lambda_swapped(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    return _lambda_return(reward, continue_, value, discount, 1 - lambda_)


@mutant("a time limit in replay is treated as a termination", "returns.replay_lambda_return")
def truncation_is_termination(reward: Any, is_last: Any, is_terminal: Any, annotation: Any, discount: float, lambda_: float) -> Any:
    return _replay_lambda_return(reward, is_last, is_last, annotation, discount, lambda_)


@mutant("replayed returns run on across the end of an episode", "returns.replay_lambda_return")
def return_crosses_episodes(reward: Any, is_last: Any, is_terminal: Any, annotation: Any, discount: float, lambda_: float) -> Any:
    return _replay_lambda_return(reward, np.zeros_like(is_last), is_terminal, annotation, discount, lambda_)


@mutant("the weights leave out the continue of the start state", "returns.cumulative_weights")
def weights_without_the_root(continue_: Any, discount: float) -> Any:
    factors = np.concatenate([np.ones_like(continue_[:, :1]), discount * continue_[:, 1:-1]], 1)
    return np.cumprod(factors, 1)


@mutant("the return range is not smoothed", "returns.update_return_range")
def return_range_without_average(low: Any, high: Any, values: Any, config: Any) -> Any:
    return returns.percentile(values, config.return_percentile_low), returns.percentile(values, config.return_percentile_high)


# --- Transforms and distributions ------------------------------------------------------------------------------------------------------

_twohot = transforms.twohot
_sample = distributions.categorical_sample


@mutant("two-hot weights are interpolated in symlog space, as in the first edition", "transforms.twohot")
def twohot_in_symlog_space(x: Any, bins: Any) -> Any:
    return _twohot(transforms.symlog(x), transforms.symlog(bins))


@mutant("two-hot weights of the lower and the upper bin are swapped", "transforms.twohot")
def twohot_with_weights_swapped(x: Any, bins: Any) -> Any:
    weights = _twohot(x, bins)
    nonzero = weights != 0
    return np.where(nonzero & (nonzero.sum(-1, keepdims=True) == 2), 1 - weights, weights)


@mutant("two-hot takes the nearest bin", "transforms.twohot")
def twohot_is_onehot(x: Any, bins: Any) -> Any:
    weights = _twohot(x, bins)
    return np.where(np.isnan(weights), np.nan, np.eye(len(bins))[np.argmax(weights, -1)])


@mutant("the mean over the bins is summed from left to right", "transforms.ordered_expectation")
def expectation_from_left_to_right(probs: Any, bins: Any) -> Any:
    total = np.float32(0)
    for index in range(len(bins)):
        total = np.float32(total + np.float32(probs[..., index]) * np.float32(bins[index]))
    return total


@mutant("straight-through gradients through the logits in place of the probabilities", "distributions.straight_through")
def straight_through_logits(log_probs: Any, sample: Any) -> Any:
    return stop_gradient(sample) + (np.asarray(log_probs) - stop_gradient(log_probs))


@mutant("no straight-through gradient: samples are constants", "distributions.straight_through")
def no_straight_through(log_probs: Any, sample: Any) -> Any:
    return stop_gradient(sample) + 0 * stop_gradient(log_probs)


@mutant("no uniform mixture in the latents and the actor", "distributions.unimix_log_probs")
def no_unimix(logits: Any, unimix: float) -> Any:
    shifted = np.asarray(logits) - np.max(logits, -1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(-1, keepdims=True))


# --- World model -----------------------------------------------------------------------------------------------------------------------


_world_model_losses = world_model.world_model_losses


def _kl(posterior: Any, prior: Any) -> Any:
    return distributions.categorical_kl(posterior, prior)


def _kl_losses(posterior_logits: Any, prior_logits: Any, config: Any, dynamics: Function, representation: Function) -> Any:
    posterior = distributions.unimix_log_probs(posterior_logits, config.latent_unimix)
    prior = distributions.unimix_log_probs(prior_logits, config.latent_unimix)
    return dynamics(posterior, prior), representation(posterior, prior)


def _clipped(reduce: Function, stop_posterior: bool) -> Function:
    """The right loss but for how the KL of the latents is reduced and clipped."""

    def loss(posterior: Any, prior: Any) -> Any:
        kl = _kl(stop_gradient(posterior), prior) if stop_posterior else _kl(posterior, stop_gradient(prior))
        return reduce(kl)

    return loss


@mutant("free nats for each latent in place of their sum", "world_model.kl_losses")
def free_nats_per_latent(posterior_logits: Any, prior_logits: Any, config: Any) -> Any:
    def reduce(kl: Any) -> Any:
        return np.maximum(config.free_nats, kl).sum(-1)

    return _kl_losses(posterior_logits, prior_logits, config, _clipped(reduce, True), _clipped(reduce, False))


@mutant("the KL is averaged over the latents in place of summed", "world_model.kl_losses")
def kl_mean_over_latents(posterior_logits: Any, prior_logits: Any, config: Any) -> Any:
    def reduce(kl: Any) -> Any:
        return np.maximum(config.free_nats, kl.mean(-1))

    return _kl_losses(posterior_logits, prior_logits, config, _clipped(reduce, True), _clipped(reduce, False))


@mutant("free nats after the mean over the batch", "world_model.kl_losses")
def free_nats_after_the_mean(posterior_logits: Any, prior_logits: Any, config: Any) -> Any:
    def reduce(kl: Any) -> Any:
        total = kl.sum(-1)
        return np.broadcast_to(np.maximum(config.free_nats, total.mean()), total.shape)

    return _kl_losses(posterior_logits, prior_logits, config, _clipped(reduce, True), _clipped(reduce, False))


@mutant("the KL runs from prior to posterior", "world_model.kl_losses")
def kl_reversed(posterior_logits: Any, prior_logits: Any, config: Any) -> Any:
    def loss(stop_posterior: bool) -> Function:
        def reversed_kl(posterior: Any, prior: Any) -> Any:
            kl = _kl(prior, stop_gradient(posterior)) if stop_posterior else _kl(stop_gradient(prior), posterior)
            return np.maximum(config.free_nats, kl.sum(-1))

        return reversed_kl

    return _kl_losses(posterior_logits, prior_logits, config, loss(True), loss(False))


@mutant("stop-gradient missing: dynamics and representation loss both train both sides", "world_model.kl_losses")
def kl_without_stop_gradient(posterior_logits: Any, prior_logits: Any, config: Any) -> Any:
    def loss(posterior: Any, prior: Any) -> Any:
        return np.maximum(config.free_nats, _kl(posterior, prior).sum(-1))

    return _kl_losses(posterior_logits, prior_logits, config, loss, loss)


@mutant("stop-gradients of the dynamics and the representation loss swapped", "world_model.kl_losses")
def kl_stop_gradients_swapped(posterior_logits: Any, prior_logits: Any, config: Any) -> Any:
    def reduce(kl: Any) -> Any:
        return np.maximum(config.free_nats, kl.sum(-1))

    return _kl_losses(posterior_logits, prior_logits, config, _clipped(reduce, False), _clipped(reduce, True))


@mutant("the continue head is trained on is_last, so that a time limit counts as an end", "world_model.world_model_losses")
def continue_trained_on_is_last(params: Any, batch: Any, states: Any, spaces: Any, config: Any) -> Any:
    return _world_model_losses(params, {**batch, "is_terminal": batch["is_last"]}, states, spaces, config)


_open_loop = world_model.open_loop


def _with_context(context: int, arguments: tuple[Any, ...]) -> Any:
    """The right prediction with another number of context steps, from the same uniforms."""
    params, observation, prev_action, is_first, _, noise, spaces, config = arguments
    uniform = np.concatenate([noise["posterior"], noise["prior"]], 1)
    noise = {"posterior": uniform[:, :context], "prior": uniform[:, context:]}
    return _open_loop(params, observation, prev_action, is_first, context, noise, spaces, config)


@mutant("open loop that goes on looking at the observations", "world_model.open_loop")
def open_loop_sees_everything(*arguments: Any) -> Any:
    return _with_context(np.shape(arguments[3])[1] - 1, arguments)


@mutant("open loop with a context one step too long", "world_model.open_loop")
def open_loop_context_off_by_one(*arguments: Any) -> Any:
    return _with_context(min(arguments[4] + 1, np.shape(arguments[3])[1] - 1), arguments)


@mutant("open loop with the action taken after each observation", "world_model.open_loop")
def open_loop_actions_shifted(params: Any, observation: Any, prev_action: Any, *others: Any) -> Any:
    return _open_loop(params, observation, np.roll(prev_action, -1, axis=1), *others)


@mutant("open loop without resets after the context", "world_model.open_loop")
def open_loop_without_resets(params: Any, observation: Any, prev_action: Any, is_first: Any, context: int, *others: Any) -> Any:
    is_first = np.asarray(is_first) & (np.arange(np.shape(is_first)[1]) < context)
    return _open_loop(params, observation, prev_action, is_first, context, *others)


@mutant("open loop that leaves vectors in symlog space", "world_model.open_loop")
def open_loop_in_symlog_space(*arguments: Any) -> Any:
    vectors = {key for key, space in arguments[6].observations.items() if isinstance(space, Vector)}
    return {key: transforms.symlog(value) if key in vectors else value for key, value in _open_loop(*arguments).items()}


# --- Recurrent model -------------------------------------------------------------------------------------------------------------------

_observe_step = rssm.observe_step
_block_linear = layers.block_linear


@mutant("resets inside a sequence are ignored", "rssm.observe_step")
def resets_ignored(params: Any, carry: Any, tokens: Any, prev_action: Any, is_first: Any, uniform: Any, config: Any) -> Any:
    return _observe_step(params, carry, tokens, prev_action, np.zeros_like(is_first), uniform, config)


@mutant("a reset keeps the previous action", "rssm.observe_step")
def reset_keeps_the_action(params: Any, carry: Any, tokens: Any, prev_action: Any, is_first: Any, uniform: Any, config: Any) -> Any:
    mask = 1.0 - np.asarray(is_first, float)
    carry = {name: value * mask.reshape(-1, *[1] * (np.ndim(value) - 1)) for name, value in carry.items()}
    return _observe_step(params, carry, tokens, prev_action, np.zeros_like(is_first), uniform, config)


@mutant("the blocks of a block-linear layer are interleaved", "layers.block_linear")
def blocks_interleaved(x: Any, kernel: Any, bias: Any) -> Any:
    blocks, inputs, _ = np.shape(kernel)
    mixed = np.moveaxis(np.reshape(x, (*np.shape(x)[:-1], inputs, blocks)), -1, -2).reshape(np.shape(x))
    return _block_linear(mixed, kernel, bias)


# --- Behavior --------------------------------------------------------------------------------------------------------------------------

_action_log_prob = behavior.action_log_prob


@mutant("the entropy is minimized, as the paper's sign reads", "behavior.actor_loss")
def entropy_sign(log_prob: Any, entropy: Any, values: Any, value: Any, weight: Any, scale: Any, config: Any) -> Any:
    advantage = stop_gradient((np.asarray(values) - value) / scale)
    return -stop_gradient(weight) * (advantage * np.asarray(log_prob) - config.entropy_scale * np.asarray(entropy))


@mutant("the return normalization is not used", "behavior.actor_loss")
def advantage_not_normalized(log_prob: Any, entropy: Any, values: Any, value: Any, weight: Any, scale: Any, config: Any) -> Any:
    advantage = stop_gradient(np.asarray(values) - value)
    return -stop_gradient(weight) * (advantage * np.asarray(log_prob) + config.entropy_scale * np.asarray(entropy))


@mutant("the imagined losses are not weighted", "behavior.actor_loss")
def actor_loss_without_weights(log_prob: Any, entropy: Any, values: Any, value: Any, weight: Any, scale: Any, config: Any) -> Any:
    advantage = stop_gradient((np.asarray(values) - value) / scale)
    return -stop_gradient(np.ones_like(weight)) * (advantage * np.asarray(log_prob) + config.entropy_scale * np.asarray(entropy))


@mutant("stop-gradient missing: the critic's target follows the critic", "behavior.critic_loss")
def slow_target_follows_the_critic(logits: Any, slow_logits: Any, values: Any, weight: Any, config: Any) -> Any:
    bins = transforms.exponential_bins(config.bins)
    own_mean = distributions.symexp_twohot_mean(logits, bins)
    towards_return = distributions.symexp_twohot_loss(logits, stop_gradient(values), bins)
    return stop_gradient(weight) * (towards_return + config.slow_critic_scale * distributions.symexp_twohot_loss(logits, own_mean, bins))


@mutant("the last step of an episode learns a value in replay", "behavior.replay_critic_loss")
def replay_critic_without_mask(logits: Any, slow_logits: Any, values: Any, is_last: Any, config: Any) -> Any:
    return behavior.critic_loss(logits, slow_logits, values, np.ones(np.shape(is_last)), config)


@mutant("stop-gradient missing: the score of a normal policy moves with its own mean", "behavior.action_log_prob")
def score_without_detached_action(outputs: Any, action: Any, spaces: Any, config: Any) -> Any:
    total = _action_log_prob(outputs, action, spaces, config)
    for entry in outputs.values():
        if "mean" in entry:
            mean, std = distributions.bounded_normal(entry["mean"], entry["std"], config.actor_min_std, config.actor_max_std)
            total = total + (np.asarray(mean) / std - stop_gradient(np.asarray(mean) / std)).sum(-1)
    return total


@mutant("the slow critic moves by its decay in place of 1 - decay", "behavior.update_slow_critic")
def slow_critic_decay_swapped(slow: Any, critic: Any, decay: float) -> Any:
    return {name: (1 - decay) * np.asarray(value) + decay * np.asarray(critic[name]) for name, value in slow.items()}


# --- Optimizer -------------------------------------------------------------------------------------------------------------------------

_clip = optimizer.adaptive_gradient_clip
_laprop = optimizer.laprop
_optimizer_step = optimizer.optimizer_step


@mutant("clipping by unit: one norm for each output", "optimizer.adaptive_gradient_clip")
def clip_by_unit(gradient: Any, parameter: Any, clip: float, epsilon: float) -> Any:
    gradient, parameter = np.asarray(gradient, float), np.asarray(parameter, float)
    if gradient.ndim < 2:
        return _clip(gradient, parameter, clip, epsilon)
    columns = [_clip(gradient[..., i], parameter[..., i], clip, epsilon) for i in range(gradient.shape[-1])]
    return np.stack(columns, -1)


@mutant("clipping by the global norm", "optimizer.optimizer_step")
def clip_by_global_norm(params: Any, gradients: Any, state: Any, config: Any) -> Any:
    norm = np.sqrt(sum(float((np.asarray(g) ** 2).sum()) for g in gradients.values()))
    scaled = {name: np.asarray(g) * min(1.0, 1.0 / norm) for name, g in gradients.items()}
    return _optimizer_step(params, scaled, state, dataclasses.replace(config, agc_clip=1e30))


@mutant("clipping without the smallest parameter norm", "optimizer.adaptive_gradient_clip")
def clip_without_floor(gradient: Any, parameter: Any, clip: float, epsilon: float) -> Any:
    return _clip(gradient, parameter, clip, 0.0)


@mutant("momentum before normalization: Adam", "optimizer.laprop")
def momentum_before_normalization(gradient: Any, second_moment: Any, momentum: Any, step: int, config: Any) -> Any:
    gradient = np.asarray(gradient, float)
    momentum = config.beta1 * np.asarray(momentum) + (1 - config.beta1) * gradient
    second_moment = config.beta2 * np.asarray(second_moment) + (1 - config.beta2) * gradient**2
    root = np.sqrt(second_moment / (1 - config.beta2 ** (step + 1))) + config.laprop_epsilon
    return momentum / (1 - config.beta1 ** (step + 1)) / root, second_moment, momentum


@mutant("no bias correction of the second moment", "optimizer.laprop")
def no_bias_correction(gradient: Any, second_moment: Any, momentum: Any, step: int, config: Any) -> Any:
    return _laprop(gradient, second_moment, momentum, 10**6, config)


@mutant("warmup counts from 1: the first update moves", "optimizer.learning_rate")
def warmup_starts_at_one(step: int, config: Any) -> float:
    return config.learning_rate * (min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0)


@mutant("the slow critic follows the old critic: it is updated before the step", "optimizer.optimizer_step")
def optimizer_returns_old_critic(params: Any, gradients: Any, state: Any, config: Any) -> Any:
    new, new_state = _optimizer_step(params, gradients, state, config)
    return {name: np.asarray(params[name]) if name.startswith("critic/") else value for name, value in new.items()}, new_state
