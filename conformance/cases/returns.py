"""Checks of spec/07-returns.md."""

import hypothesis.strategies as st
import numpy as np

from conformance.check import Run, check
from conformance.problems import small_config
from conformance.strategies import seeds
from reference_numpy import returns as reference

GAMMA = 1 - 1 / 333


def imagined(run: Run, seed: int, horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reward, continue and value [4, H+1], with some certain ends."""
    rng = np.random.default_rng(seed)
    reward = run.cast(rng.normal(size=(4, horizon + 1)) * 10 ** rng.uniform(-2, 3, (4, 1)))
    continue_ = run.cast(np.where(rng.random((4, horizon + 1)) < 0.2, 0, rng.random((4, horizon + 1))))
    return reward, continue_, run.cast(rng.normal(size=(4, horizon + 1)) * 10)


def replayed(run: Run, seed: int, length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reward, is_last, is_terminal and annotation [3, T]."""
    rng = np.random.default_rng(seed)
    is_last = rng.random((3, length)) < 0.3
    is_terminal = is_last & (rng.random((3, length)) < 0.5)
    return run.cast(rng.normal(size=(3, length))), is_last, is_terminal, run.cast(rng.normal(size=(3, length)) * 10)


@check("RET-1", uses=["lambda_return"], level=0)
def lambda_return_literals(run: Run) -> None:
    """With gamma = lambda = 1/2, rewards 9,1,0,2, continues 1,1,.5,1 and values 7,4,2,10 the returns are 2.28125,
    1.125, 7."""
    reward, continue_, value = np.array([[9.0, 1, 0, 2]]), np.array([[1, 1, 0.5, 1]]), np.array([[7.0, 4, 2, 10]])
    run.exact(
        "lambda_return",
        run.call("lambda_return", reward, continue_, value, 0.5, 0.5),
        np.array([[2.28125, 1.125, 7.0]]),
    )
    reward, value = np.array([[0.0, 0, 0, 1, 0]]), np.array([[2.0, 2, 2, 1, 1]])
    expected = np.array([[1.9831, 1.9885, 1.9942, 0.9970]])
    run.expect("lambda_return", (reward, np.ones((1, 5)), value, GAMMA, 0.95), expected, bound=5e-5)


@check("RET-1", uses=["lambda_return"], level=0)
def lambda_return_matches(run: Run) -> None:
    """Random rewards, continues and values, any horizon, lambda from 0 to 1."""

    @run.for_all(seed=seeds(), horizon=st.integers(1, 15), lambda_=st.sampled_from([0.0, 0.5, 0.95, 1.0]))
    def _(seed: int, horizon: int, lambda_: float) -> None:
        reward, continue_, value = imagined(run, seed, horizon)
        magnitude = reference.lambda_return(np.abs(reward), continue_, np.abs(value), GAMMA, lambda_)
        expected = reference.lambda_return(reward, continue_, value, GAMMA, lambda_)
        run.expect(
            "lambda_return", (reward, continue_, value, GAMMA, lambda_), expected, magnitude=magnitude, bound=64 * run.u
        )


@check("RET-2", uses=["lambda_return"], level=0)
def lambda_return_ignores_the_start(run: Run) -> None:
    """Reward, continue and value of the start state change nothing, not even as NaN."""
    for argument in range(3):
        arrays = [x.copy() for x in imagined(run, run.seed, 5)]
        before = run.call("lambda_return", *arrays, GAMMA, 0.95)
        arrays[argument][:, 0] = np.nan
        run.exact(f"NaN in argument {argument} at index 0", run.call("lambda_return", *arrays, GAMMA, 0.95), before)


@check("RET-7", uses=["cumulative_weights"], level=0)
def weights_literals(run: Run) -> None:
    """Weights are 1, gamma, gamma^2, ... without ends; a certain end silences all that follows; the last continue is
    not used."""
    run.expect("cumulative_weights", (np.ones((1, 4)), GAMMA), np.array([[1, GAMMA, GAMMA**2]]), bound=16 * run.u)
    continue_ = np.array([[1, 1, 0, 1, 1], [0, 1, 1, 1, 1], [0.5, 0.5, 1, 1, 0]])
    expected = np.array([[1, 0.5, 0, 0], [0, 0, 0, 0], [0.5, 0.125, 0.0625, 0.03125]])
    run.exact("cumulative_weights", run.call("cumulative_weights", continue_, 0.5), expected)
    run.exact(
        "the last continue is NaN",
        run.call("cumulative_weights", np.array([[0.5, 1, np.nan]]), 0.5),
        np.array([[0.5, 0.25]]),
    )
    run.exact(
        "a discount of 1", run.call("cumulative_weights", np.array([[0.5, 0.5, 1]]), 1.0), np.array([[0.5, 0.25]])
    )


@check("RET-7", uses=["cumulative_weights"], level=0)
def weights_match(run: Run) -> None:
    """Random continues."""

    @run.for_all(seed=seeds(), horizon=st.integers(1, 15), discount=st.sampled_from([GAMMA, 1.0]))
    def _(seed: int, horizon: int, discount: float) -> None:
        continue_ = imagined(run, seed, horizon)[1]
        run.expect(
            "cumulative_weights",
            (continue_, discount),
            reference.cumulative_weights(continue_, discount),
            bound=64 * run.u,
        )


@check("RET-8", uses=["cumulative_weights"], level=0)
def weights_refuse_discounts(run: Run) -> None:
    """A discount of 0, below 0 or above 1 is refused."""
    for discount in (0.0, -0.5, 1.5):
        run.refuses("cumulative_weights", np.ones((2, 4)), discount)


@check("RET-9", uses=["replay_lambda_return"], level=0)
def replay_return_literals(run: Run) -> None:
    """A chain without an end, one that is cut off and one that is terminal at step 2, by hand."""
    reward, annotation = np.array([[0.0, 1, 2, 0, 3]] * 3), np.array([[8.0, 4, 6, 10, 2]] * 3)
    is_last = np.zeros((3, 5), bool)
    is_terminal = np.zeros((3, 5), bool)
    is_last[1:, 2] = is_terminal[2, 2] = True
    expected = np.array([[3.09375, 4.375, 3.5, 4], [3.25, 5, 3.5, 4], [2.5, 2, 3.5, 4]])
    run.exact(
        "replay_lambda_return",
        run.call("replay_lambda_return", reward, is_last, is_terminal, annotation, 0.5, 0.5),
        expected,
    )
    one = (array[:, :1] for array in (reward, is_last, is_terminal, annotation))
    run.exact("one step has no return", run.call("replay_lambda_return", *one, 0.5, 0.5), np.zeros((3, 0)))


@check("RET-9", uses=["replay_lambda_return"], level=0)
def replay_return_matches(run: Run) -> None:
    """Random rewards, ends and annotations."""

    @run.for_all(seed=seeds(), length=st.integers(2, 20))
    def _(seed: int, length: int) -> None:
        reward, is_last, is_terminal, annotation = replayed(run, seed, length)
        magnitude = (
            reference.replay_lambda_return(np.abs(reward), is_last, is_terminal, np.abs(annotation), GAMMA, 0.95)
            + run.tiny
        )
        expected = reference.replay_lambda_return(reward, is_last, is_terminal, annotation, GAMMA, 0.95)
        arguments = (reward, is_last, is_terminal, annotation, GAMMA, 0.95)
        run.expect("replay_lambda_return", arguments, expected, magnitude=magnitude, bound=64 * run.u)


@check("RET-10", uses=["replay_lambda_return"], level=0)
def replay_return_does_not_cross_ends(run: Run) -> None:
    """Nothing at index 0 matters, and nothing after an end reaches the returns before it."""
    reward, is_last, is_terminal, annotation = replayed(run, run.seed, 8)
    is_last[:, 4], is_terminal[:, 4] = True, np.array([True, False, False])
    before = np.asarray(run.call("replay_lambda_return", reward, is_last, is_terminal, annotation, GAMMA, 0.95))
    for array, value in ((reward, 1e6), (annotation, -1e6), (is_last, True), (is_terminal, True)):
        changed = array.copy()
        changed[:, 0] = value
        changed[:, 5:] = value
        others = [changed if x is array else x for x in (reward, is_last, is_terminal, annotation)]
        after = np.asarray(run.call("replay_lambda_return", *others, GAMMA, 0.95))
        run.exact("returns up to the end", after[:, :4], before[:, :4])


@check("RET-12", uses=["percentile"], level=0)
def percentile_literals(run: Run) -> None:
    """The 5th and 95th percentile of 16, 1, 4, 2, 8 are 1.2 and 14.4; 0 and 100 are the smallest and the largest."""
    values = np.array([16.0, 1, 4, 2, 8])
    for q, expected in ((5.0, 1.2), (95.0, 14.4), (0.0, 1.0), (100.0, 16.0), (50.0, 4.0)):
        run.expect("percentile", (values, q), expected, bound=16 * run.u)
    run.exact("one value", run.call("percentile", np.array([[3.0]]), 5.0), 3.0)


@check("RET-12", uses=["percentile"], level=0)
def percentile_matches(run: Run) -> None:
    """Random values of any shape, any q."""

    @run.for_all(seed=seeds(), count=st.integers(1, 300), q=st.floats(0, 100))
    def _(seed: int, count: int, q: float) -> None:
        values = run.cast(np.random.default_rng(seed).normal(size=(count, 2)))
        run.expect(
            "percentile", (values, q), reference.percentile(values, q), magnitude=np.abs(values).max(), bound=64 * run.u
        )


@check("RET-13", uses=["percentile"], level=0)
def percentile_refuses(run: Run) -> None:
    """A NaN shows, an empty array and a q outside 0 to 100 are refused."""
    run.exact("with a NaN", run.call("percentile", np.array([1.0, np.nan, 3.0]), 5.0), np.nan)
    run.refuses("percentile", np.zeros(0), 5.0)
    for q in (-1.0, 101.0):
        run.refuses("percentile", np.ones(3), q)


@check("RET-14", "RET-15", uses=["update_return_range"], level=0)
def return_range_literals(run: Run) -> None:
    """From zero, the first update moves low and high by one hundredth of the percentiles, without debiasing."""
    config = small_config(run.profile)
    returns = np.array([[16.0, 1, 4, 2, 8]])
    run.expect("update_return_range", (0.0, 0.0, returns, config), (0.012, 0.144), bound=64 * run.u)
    run.expect(
        "update_return_range", (-1.0, 3.0, returns, config), (0.99 * -1 + 0.012, 0.99 * 3 + 0.144), bound=64 * run.u
    )


@check("RET-14", uses=["update_return_range"], level=0)
def return_range_matches(run: Run) -> None:
    """Percentiles over all returns of the batch together, decay and percentiles from the configuration."""
    config = small_config(run.profile, return_decay=0.9, return_percentile_low=10.0, return_percentile_high=80.0)
    returns = run.cast(run.rng().normal(size=(7, 3)) * 50)
    expected = reference.update_return_range(0.5, 2.0, returns, config)
    run.expect("update_return_range", (0.5, 2.0, returns, config), expected, magnitude=50.0, bound=64 * run.u)


@check("RET-16", uses=["return_scale"], level=0)
def return_scale_literals(run: Run) -> None:
    """The scale is high - low, but never below the limit; NaN shows."""
    for low, high, limit, expected in (
        (0.0, 0.5, 1.0, 1.0),
        (-2.0, 3.0, 1.0, 5.0),
        (3.0, -2.0, 1.0, 1.0),
        (0.0, 0.5, 0.25, 0.5),
    ):
        run.exact("return_scale", run.call("return_scale", low, high, limit), expected)
    run.exact("NaN", run.call("return_scale", np.nan, 1.0, 1.0), np.nan)


@check("RET-19", uses=["lambda_return", "replay_lambda_return", "cumulative_weights"], level=0)
def returns_do_not_hide_nan(run: Run) -> None:
    """A NaN in a used entry reaches every result that contains it, also behind a factor of 0."""
    reward, continue_, value = np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 4))
    value[0, 3] = np.nan
    run.exact("lambda_return", run.call("lambda_return", reward, continue_, value, 0.5, 0.5), np.full((1, 3), np.nan))
    ends = np.ones((1, 4), bool)
    run.exact(
        "replay_lambda_return",
        run.call("replay_lambda_return", reward, ends, ends, value, 0.5, 0.5),
        np.full((1, 3), np.nan),
    )
    continue_[0, 1] = np.nan
    run.exact("cumulative_weights", run.call("cumulative_weights", continue_, 0.5), np.array([[0, np.nan, np.nan]]))


@check("RET-20", uses=["lambda_return", "replay_lambda_return", "cumulative_weights"], level=0)
def returns_refuse_shapes(run: Run) -> None:
    """Arrays that are not two-dimensional, differ in shape or are too short are refused."""
    good, short, flat = np.zeros((2, 4)), np.zeros((2, 1)), np.zeros(4)
    ends = np.zeros((2, 4), bool)
    for wrong in (short, flat, np.zeros((3, 4)), np.zeros((1, 4))):
        run.refuses("lambda_return", wrong, good, good, 0.9, 0.9)
        run.refuses("lambda_return", good, good, wrong, 0.9, 0.9)
        run.refuses("replay_lambda_return", good, ends, ends, wrong, 0.9, 0.9)
    for wrong in (short, flat):
        run.refuses("cumulative_weights", wrong, 0.9)


@check("RET-17", uses=["lambda_return", "cumulative_weights", "percentile"], level=0)
def returns_are_float32_or_better(run: Run) -> None:
    """Returns, weights and percentiles are more precise than bfloat16 could hold."""
    x = run.cast([[1.0, 0.3, 0.7, 0.1]])
    run.expect("lambda_return", (x, x, x, GAMMA, 0.95), reference.lambda_return(x, x, x, GAMMA, 0.95), bound=64 * run.u)
    run.expect("cumulative_weights", (x, GAMMA), reference.cumulative_weights(x, GAMMA), bound=64 * run.u)
    run.expect("percentile", (x, 5.0), reference.percentile(x, 5.0), bound=64 * run.u)
