"""Checks of spec/07-returns.md."""

from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Setting, equal, exact, refused, related
from conformance.check import check
from conformance.compare import Comparisons
from conformance.problems import small_config
from conformance.strategies import seeds
from conformance.worked import worked_cases
from reference_numpy import returns as reference

GAMMA = 1 - 1 / 333
HORIZONS, LENGTHS = st.sampled_from([1, 2, 5, 15]), st.sampled_from([2, 3, 8, 20])


def imagined(setting: Setting, seed: int, horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reward, continue and value [4, H+1], with some certain ends."""
    rng = np.random.default_rng(seed)
    reward = setting.cast(rng.normal(size=(4, horizon + 1)) * 10 ** rng.uniform(-2, 3, (4, 1)))
    continue_ = setting.cast(np.where(rng.random((4, horizon + 1)) < 0.2, 0, rng.random((4, horizon + 1))))
    return reward, continue_, setting.cast(rng.normal(size=(4, horizon + 1)) * 10)


def replayed(setting: Setting, seed: int, length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reward, is_last, is_terminal and annotation [3, T]."""
    rng = np.random.default_rng(seed)
    is_last = rng.random((3, length)) < 0.3
    is_terminal = is_last & (rng.random((3, length)) < 0.5)
    reward, annotation = rng.normal(size=(3, length)), rng.normal(size=(3, length)) * 10
    return setting.cast(reward), is_last, is_terminal, setting.cast(annotation)


@check("RET-1", uses=["lambda_return"], level=0)
def lambda_return_literals(setting: Setting) -> Cases:
    """With gamma = lambda = 1/2, rewards 9,1,0,2, continues 1,1,.5,1 and values 7,4,2,10 the returns are 2.28125,
    1.125, 7."""
    yield from worked_cases(setting, "returns", "a return by hand", "the ends of lambda")
    yield from worked_cases(setting, "returns", "arriving at a terminal state", "a single transition")
    constants = ("a return with the real constants", "the discount enters once")
    yield from worked_cases(setting, "returns", *constants, bound=64 * setting.u)


@check("RET-1", uses=["lambda_return"], level=0)
def lambda_return_matches(setting: Setting) -> Cases:
    """Random rewards, continues and values, any horizon, lambda from 0 to 1."""

    def case(seed: int, horizon: int, lambda_: float) -> Cases:
        reward, continue_, value = imagined(setting, seed, horizon)
        magnitude = reference.lambda_return(np.abs(reward), continue_, np.abs(value), GAMMA, lambda_)
        arguments = (reward, continue_, value, GAMMA, lambda_)
        expected = reference.lambda_return(*arguments)
        yield equal("lambda_return", arguments, expected, magnitude=magnitude, bound=64 * setting.u)

    yield Drawn(case, seed=seeds(), horizon=HORIZONS, lambda_=st.sampled_from([0.0, 0.5, 0.95, 1.0]))


@check("RET-2", uses=["lambda_return"], level=0)
def lambda_return_ignores_the_start(setting: Setting) -> Cases:
    """Reward, continue and value of the start state change nothing, not even as NaN."""
    arrays = imagined(setting, setting.seed, 5)
    for argument in range(3):
        spoiled = [x.copy() for x in arrays]
        spoiled[argument][:, 0] = np.nan

        def same(c: Comparisons, before: np.ndarray, after: np.ndarray, argument: int = argument) -> None:
            c.exact(f"NaN in argument {argument} at index 0", after, before)

        yield related(same, ("lambda_return", (*arrays, GAMMA, 0.95)), ("lambda_return", (*spoiled, GAMMA, 0.95)))


@check("RET-7", uses=["cumulative_weights"], level=0)
def weights_literals(setting: Setting) -> Cases:
    """Weights are 1, gamma, gamma^2, ... without ends; a certain end silences all that follows; the last continue is
    not used."""
    yield from worked_cases(setting, "returns", "weights of sixteen living states", bound=16 * setting.u)
    yield from worked_cases(setting, "returns", "weights by hand")


@check("RET-7", uses=["cumulative_weights"], level=0)
def weights_match(setting: Setting) -> Cases:
    """Random continues."""

    def case(seed: int, horizon: int, discount: float) -> Cases:
        continue_ = imagined(setting, seed, horizon)[1]
        expected = reference.cumulative_weights(continue_, discount)
        yield equal("cumulative_weights", (continue_, discount), expected, bound=64 * setting.u)

    yield Drawn(case, seed=seeds(), horizon=HORIZONS, discount=st.sampled_from([GAMMA, 1.0]))


@check("RET-8", uses=["cumulative_weights"], level=0)
def weights_refuse_discounts(setting: Setting) -> Cases:
    """A discount of 0, below 0 or above 1 is refused."""
    for discount in (0.0, -0.5, 1.5):
        yield refused("cumulative_weights", np.ones((2, 4)), discount)


@check("RET-9", uses=["replay_lambda_return"], level=0)
def replay_return_literals(setting: Setting) -> Cases:
    """A chain without an end, one that is cut off and one that is terminal at step 2, by hand."""
    yield from worked_cases(setting, "returns", "replayed returns by hand")
    yield from worked_cases(setting, "returns", "replayed returns with the real constants", bound=64 * setting.u)
    one = replayed(setting, setting.seed, 1)
    yield exact("replay_lambda_return", (*one, 0.5, 0.5), np.zeros((3, 0)), where="one step has no return")


@check("RET-9", uses=["replay_lambda_return"], level=0)
def replay_return_matches(setting: Setting) -> Cases:
    """Random rewards, ends and annotations."""

    def case(seed: int, length: int) -> Cases:
        reward, is_last, is_terminal, annotation = replayed(setting, seed, length)
        sizes = (np.abs(reward), is_last, is_terminal, np.abs(annotation), GAMMA, 0.95)
        magnitude = reference.replay_lambda_return(*sizes) + setting.tiny
        arguments = (reward, is_last, is_terminal, annotation, GAMMA, 0.95)
        expected = reference.replay_lambda_return(*arguments)
        yield equal("replay_lambda_return", arguments, expected, magnitude=magnitude, bound=64 * setting.u)

    yield Drawn(case, seed=seeds(), length=LENGTHS)


@check("RET-10", uses=["replay_lambda_return"], level=0)
def replay_return_does_not_cross_ends(setting: Setting) -> Cases:
    """Nothing at index 0 matters, and nothing after an end reaches the returns before it."""
    arrays = replayed(setting, setting.seed, 8)
    arrays[1][:, 4], arrays[2][:, 4] = True, np.array([True, False, False])

    def same(c: Comparisons, before: np.ndarray, *changed: np.ndarray) -> None:
        for after in changed:
            c.exact("returns up to the end", np.asarray(after)[:, :4], np.asarray(before)[:, :4])

    calls: list[tuple[str, tuple[Any, ...]]] = [("replay_lambda_return", (*arrays, GAMMA, 0.95))]
    for place, value in ((0, 1e6), (3, -1e6), (1, True), (2, True)):
        other = [x.copy() for x in arrays]
        other[place][:, 0] = value
        other[place][:, 5:] = value
        calls.append(("replay_lambda_return", (*other, GAMMA, 0.95)))
    yield related(same, *calls)


@check("RET-12", uses=["percentile"], level=0)
def percentile_literals(setting: Setting) -> Cases:
    """The 5th and 95th percentile of 16, 1, 4, 2, 8 are 1.2 and 14.4; 0 and 100 are the smallest and the largest."""
    yield from worked_cases(setting, "returns", "percentiles of five values", bound=16 * setting.u)
    yield from worked_cases(setting, "returns", "the percentile of one value")


@check("RET-12", uses=["percentile"], level=0)
def percentile_matches(setting: Setting) -> Cases:
    """Random values of any shape, any q."""

    def case(seed: int, count: int, q: float) -> Cases:
        values = setting.cast(np.random.default_rng(seed).normal(size=(count, 2)))
        expected, magnitude = reference.percentile(values, q), np.abs(values).max()
        yield equal("percentile", (values, q), expected, magnitude=magnitude, bound=64 * setting.u)

    yield Drawn(case, seed=seeds(), count=st.sampled_from([1, 2, 20, 300]), q=st.floats(0, 100))


@check("RET-13", uses=["percentile"], level=0)
def percentile_refuses(setting: Setting) -> Cases:
    """A NaN shows, an empty array and a q outside 0 to 100 are refused."""
    yield exact("percentile", (np.array([1.0, np.nan, 3.0]), 5.0), np.nan, where="with a NaN")
    yield refused("percentile", np.zeros(0), 5.0)
    for q in (-1.0, 101.0):
        yield refused("percentile", np.ones(3), q)


@check("RET-14", "RET-15", uses=["update_return_range"], level=0)
def return_range_literals(setting: Setting) -> Cases:
    """From zero, the first update moves low and high by one hundredth of the percentiles, without debiasing."""
    yield from worked_cases(setting, "returns", "the range after one update", bound=64 * setting.u)


@check("RET-14", uses=["update_return_range"], level=0)
def return_range_matches(setting: Setting) -> Cases:
    """Percentiles over all returns of the batch together, decay and percentiles from the configuration."""
    overrides: dict[str, Any] = {"return_decay": 0.9, "return_percentile_low": 10.0, "return_percentile_high": 80.0}
    config = small_config(setting.profile, **overrides)
    returns = setting.cast(setting.rng().normal(size=(7, 3)) * 50)
    expected = reference.update_return_range(0.5, 2.0, returns, config)
    arguments = (0.5, 2.0, returns, config)
    yield equal("update_return_range", arguments, expected, magnitude=50.0, bound=64 * setting.u)


@check("RET-16", uses=["return_scale"], level=0)
def return_scale_literals(setting: Setting) -> Cases:
    """The scale is high - low, but never below the limit; NaN shows."""
    yield from worked_cases(setting, "returns", "the scale of returns")
    yield exact("return_scale", (np.nan, 1.0, 1.0), np.nan, where="NaN")


@check("RET-19", uses=["lambda_return", "replay_lambda_return", "cumulative_weights"], level=0)
def returns_do_not_hide_nan(setting: Setting) -> Cases:
    """A NaN in a used entry reaches every result that contains it, also behind a factor of 0."""
    zeros, value, ends = np.zeros((1, 4)), np.zeros((1, 4)), np.ones((1, 4), bool)
    value[0, 3] = np.nan
    yield exact("lambda_return", (zeros, zeros, value, 0.5, 0.5), np.full((1, 3), np.nan))
    yield exact("replay_lambda_return", (zeros, ends, ends, value, 0.5, 0.5), np.full((1, 3), np.nan))
    continue_ = np.array([[0, np.nan, 0, 0]])
    yield exact("cumulative_weights", (continue_, 0.5), np.array([[0, np.nan, np.nan]]))


@check("RET-20", uses=["lambda_return", "replay_lambda_return", "cumulative_weights"], level=0)
def returns_refuse_shapes(setting: Setting) -> Cases:
    """Arrays that are not two-dimensional, differ in shape or are too short are refused."""
    good, short, flat = np.zeros((2, 4)), np.zeros((2, 1)), np.zeros(4)
    ends = np.zeros((2, 4), bool)
    for wrong in (short, flat, np.zeros((3, 4)), np.zeros((1, 4))):
        yield refused("lambda_return", wrong, good, good, 0.9, 0.9)
        yield refused("lambda_return", good, good, wrong, 0.9, 0.9)
        yield refused("replay_lambda_return", good, ends, ends, wrong, 0.9, 0.9)
    for wrong in (short, flat):
        yield refused("cumulative_weights", wrong, 0.9)


@check("RET-17", uses=["lambda_return", "cumulative_weights", "percentile"], level=0)
def returns_are_float32_or_better(setting: Setting) -> Cases:
    """Returns, weights and percentiles are more precise than bfloat16 could hold."""
    x = setting.cast([[1.0, 0.3, 0.7, 0.1]])
    arguments = (x, x, x, GAMMA, 0.95)
    yield equal("lambda_return", arguments, reference.lambda_return(*arguments), bound=64 * setting.u)
    yield equal("cumulative_weights", (x, GAMMA), reference.cumulative_weights(x, GAMMA), bound=64 * setting.u)
    yield equal("percentile", (x, 5.0), reference.percentile(x, 5.0), bound=64 * setting.u)
