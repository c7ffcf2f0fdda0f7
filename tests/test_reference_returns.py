"""Returns: numbers that a reader can redo by hand, most of them from spec/07-returns.md."""

import math

import numpy as np
import pytest

from reference_numpy.returns import (
    cumulative_weights,
    lambda_return,
    percentile,
    replay_lambda_return,
    return_scale,
    update_return_range,
)
from spec.config import load_config

GAMMA = 1 - 1 / 333
REWARD, CONTINUE, VALUE = [[9, 1, 0, 2]], [[1, 1, 0.5, 1]], [[7, 4, 2, 10]]


def test_lambda_return_by_hand():
    """[RET-1]: the table of the chapter, exact in binary."""
    np.testing.assert_array_equal(lambda_return(REWARD, CONTINUE, VALUE, 0.5, 0.5), [[2.28125, 1.125, 7]])


def test_lambda_return_ignores_index_0():
    """[RET-2]"""
    nothing = math.nan
    returns = lambda_return([[nothing, 1, 0, 2]], [[nothing, 1, 0.5, 1]], [[nothing, 4, 2, 10]], 0.5, 0.5)
    np.testing.assert_array_equal(returns, [[2.28125, 1.125, 7]])


def test_lambda_return_is_not_the_printed_formula():
    """[RET-1]: the second table of the chapter (D-03)."""
    returns = lambda_return([[0, 0, 0, 1, 0]], [[1] * 5], [[2, 2, 2, 1, 1]], GAMMA, 0.95)
    np.testing.assert_allclose(returns, [[1.9831, 1.9885, 1.9942, 0.9970]], atol=5e-5)


def test_lambda_0_is_one_step_and_lambda_1_is_the_discounted_sum():
    """[RET-1]"""
    np.testing.assert_array_equal(lambda_return(REWARD, CONTINUE, VALUE, 0.5, 0), [[3, 0.5, 7]])
    # 2 + 0.5 * 10 = 7; 0 + 0.25 * 7 = 1.75; 1 + 0.5 * 1.75 = 1.875.
    np.testing.assert_array_equal(lambda_return(REWARD, CONTINUE, VALUE, 0.5, 1), [[1.875, 1.75, 7]])


def test_arrival_at_a_terminal_state_counts_its_reward_and_nothing_else():
    """[RET-1]"""
    np.testing.assert_array_equal(lambda_return([[0, 3, 100]], [[1, 0, 1]], [[0, 50, 50]], 0.5, 0.5)[0, 0], 3)


def test_lambda_return_of_a_single_transition():
    """[RET-1]"""
    np.testing.assert_array_equal(
        lambda_return([[0, 1], [0, 2]], [[1, 1], [1, 0]], [[0, 8], [0, 8]], 0.5, 0.95), [[5], [2]]
    )


def test_discount_is_used_once_in_each_profile():
    """[RET-4], [RET-5]: mixing the halves would give 0.994003."""
    paper, official = load_config("paper"), load_config("official")
    assert (paper.imagined_discount, official.imagined_discount) == (GAMMA, 1.0)
    assert paper.discount == official.discount == GAMMA
    hard = lambda_return([[0, 0, 0]], [[1, 1, 1]], [[0, 0, 1]], paper.imagined_discount, 1)
    learned = lambda_return([[0, 0, 0]], [[GAMMA, GAMMA, GAMMA]], [[0, 0, 1]], official.imagined_discount, 1)
    np.testing.assert_allclose(hard, [[0.994003012, 0.996996997]], rtol=1e-9)
    np.testing.assert_allclose(learned, hard, rtol=1e-14)


def test_cumulative_weights_by_hand():
    """[RET-7]: the discount of the first factor is divided away, the last continue is not used."""
    np.testing.assert_array_equal(
        cumulative_weights([[1, 1, 0.5, math.nan], [0, 1, 1, 1]], 0.5), [[1, 0.5, 0.125], [0, 0, 0]]
    )
    np.testing.assert_array_equal(cumulative_weights([[0.5, 0.5, 0.5]], 1), [[0.5, 0.25]])


def test_cumulative_weights_of_the_two_profiles():
    """[RET-6], [RET-7]: 16 states alive, and a head that has learned the discount."""
    paper = cumulative_weights([[1.0] * 16], GAMMA)
    official = cumulative_weights([[GAMMA] * 16], 1.0)
    np.testing.assert_allclose(paper[0, [0, 1, 2, 14]], [1, 0.996997, 0.994003, 0.958769], atol=5e-7)
    np.testing.assert_allclose(official[0, [0, 1, 14]], [0.996997, 0.994003, 0.955890], atol=5e-7)
    np.testing.assert_allclose([paper.mean(), official.mean()], [0.979250, 0.976309], atol=5e-7)


@pytest.mark.parametrize("discount", [0.0, -0.5, 1.5, math.nan])
def test_cumulative_weights_refuse_a_discount(discount):
    """[RET-8]"""
    with pytest.raises(ValueError, match="discount"):
        cumulative_weights([[1, 1]], discount)


@pytest.mark.parametrize(
    ("is_last", "is_terminal", "expected"),
    [
        ([0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [3.09375, 4.375, 3.5, 4]),
        ([0, 0, 1, 0, 0], [0, 0, 0, 0, 0], [3.25, 5, 3.5, 4]),
        ([0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [2.5, 2, 3.5, 4]),
    ],
)
def test_replay_lambda_return_by_hand(is_last, is_terminal, expected):
    """[RET-9]: no end, cut off, terminal; flags as numbers and as booleans."""
    rewards, annotations = [[0, 1, 2, 0, 3]], [[8, 4, 6, 10, 2]]
    np.testing.assert_array_equal(
        replay_lambda_return(rewards, [is_last], [is_terminal], annotations, 0.5, 0.5), [expected]
    )
    flags = np.array([is_last], bool), np.array([is_terminal], bool)
    np.testing.assert_array_equal(replay_lambda_return(rewards, *flags, annotations, 0.5, 0.5), [expected])


@pytest.mark.parametrize(
    ("is_last", "is_terminal", "expected"),
    [
        ([0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [12.6859, 11.8117, 10.8887, 10.9700]),
        ([0, 0, 1, 0, 0], [0, 0, 0, 0, 0], [11.8887, 10.9700, 10.8887, 10.9700]),
        ([0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [2.4456, 1.0000, 10.8887, 10.9700]),
    ],
)
def test_replay_lambda_return_with_the_real_constants(is_last, is_terminal, expected):
    """[RET-9] (D-55)"""
    returns = replay_lambda_return([[0, 1, 1, 0, 1]], [is_last], [is_terminal], [[10] * 5], GAMMA, 0.95)
    np.testing.assert_allclose(returns, [expected], atol=5e-5)


def test_an_end_hides_the_next_episode():
    """[RET-10]: neither what comes after an end nor anything at index 0 changes the returns before it."""
    last = [[0, 0, 1, 0, 0]]
    one = replay_lambda_return([[0, 1, 2, 0, 3]], last, np.zeros((1, 5)), [[8, 4, 6, 10, 2]], 0.5, 0.5)
    two = replay_lambda_return(
        [[7, 1, 2, 50, -3]], [[1, 0, 1, 1, 0]], [[1, 0, 0, 1, 0]], [[9, 4, 6, -10, 20]], 0.5, 0.5
    )
    np.testing.assert_array_equal(one[:, :2], two[:, :2])


def test_a_single_replayed_step_has_no_return():
    """[RET-9]"""
    assert replay_lambda_return([[1.0]], [[0]], [[0]], [[3.0]], 0.5, 0.5).shape == (1, 0)


def test_percentile_by_hand():
    """[RET-12]"""
    values = [16, 1, 4, 2, 8]
    np.testing.assert_allclose([percentile(values, 5), percentile(values, 95)], [1.2, 14.4], rtol=1e-14)
    assert [percentile(values, q) for q in (0, 25, 50, 75, 100)] == [1, 2, 4, 8, 16]
    assert percentile([[3.0]], 95) == 3


def test_percentile_of_a_full_batch():
    """[RET-12]: 0 .. 15359 stand at their own positions."""
    np.testing.assert_allclose(percentile(np.arange(15360).reshape(1024, 15), 5), 767.95, rtol=1e-13)


def test_percentile_edge_cases():
    """[RET-13]"""
    assert math.isnan(percentile([1, math.nan, 2], 50))
    with pytest.raises(ValueError, match="values"):
        percentile([], 50)
    with pytest.raises(ValueError, match="q"):
        percentile([1.0], 101)


def test_update_return_range_by_hand():
    """[RET-14], [RET-15]: from zero, not debiased."""
    config = load_config()
    low, high = update_return_range(0, 0, [[16, 1, 4, 2, 8]], config)
    np.testing.assert_allclose([low, high], [0.012, 0.144], rtol=1e-12)
    low, high = update_return_range(-10, 20, [[16, 1, 4, 2, 8]], config)
    np.testing.assert_allclose([low, high], [-9.888, 19.944], rtol=1e-12)


def test_return_range_needs_69_steps_for_half():
    """[RET-15]"""
    low = high = 0.0
    for _ in range(69):
        low, high = update_return_range(
            low, high, [[0.0, 100.0]], load_config(return_percentile_low=0, return_percentile_high=100)
        )
    np.testing.assert_allclose([low, high], [0, 50.016297], rtol=1e-7)


def test_return_scale():
    """[RET-16]"""
    assert return_scale(0.012, 0.144, 1.0) == 1
    assert return_scale(-1.5, 4.5, 1.0) == 6
    assert return_scale(0, 0.4, 0.25) == 0.4
    assert return_scale(5, 1, 1.0) == 1
    assert math.isnan(return_scale(math.nan, 1, 1.0))


def test_nan_is_not_repaired():
    """[RET-19]: also not where it is multiplied by zero."""
    returns = lambda_return([[0, 1, 1]], [[1, 0, 1]], [[0, math.nan, 1]], 0.5, 0.5)
    np.testing.assert_array_equal(returns, [[math.nan, 1.5]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lambda_return([1, 2], [1, 2], [1, 2], 0.5, 0.5), r"reward.*\[2\]"),
        (lambda: lambda_return([[1]], [[1]], [[1]], 0.5, 0.5), r"reward.*at least 2"),
        (lambda: lambda_return([[1, 2]], [[1, 2], [1, 2]], [[1, 2]], 0.5, 0.5), r"continue_.*\[1, 2\].*\[2, 2\]"),
        (lambda: lambda_return([[1, 2]], [[1, 2]], [[1, 2, 3]], 0.5, 0.5), "value"),
        (lambda: replay_lambda_return([[1, 2]], [[0]], [[0, 0]], [[1, 2]], 0.5, 0.5), "is_last"),
        (lambda: replay_lambda_return([[1, 2]], [[0, 0]], [0, 0], [[1, 2]], 0.5, 0.5), "is_terminal"),
        (lambda: replay_lambda_return([[1, 2]], [[0, 0]], [[0, 0]], [[1]], 0.5, 0.5), "annotation"),
        (lambda: cumulative_weights([[1]], 0.5), "continue_"),
    ],
)
def test_wrong_shapes_are_named(call, message):
    """[RET-20]"""
    with pytest.raises(ValueError, match=message):
        call()
