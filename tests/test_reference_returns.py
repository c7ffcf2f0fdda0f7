"""Returns: exact properties and edge cases. The numbers of spec/07-returns.md are in tests/test_examples.py."""

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


def test_lambda_return_ignores_index_0():
    """[RET-2]"""
    one, two = (lambda_return([[x, 1, 0, 2]], [[x, 1, 0.5, 1]], [[x, 4, 2, 10]], 0.5, 0.5) for x in (0, math.nan))
    np.testing.assert_array_equal(one, two)


def test_discount_is_used_once_in_each_profile():
    """[RET-4], [RET-5]"""
    paper, official = load_config("paper"), load_config("official")
    assert (paper.imagined_discount, official.imagined_discount) == (GAMMA, 1.0)
    assert paper.discount == official.discount == GAMMA
    hard = lambda_return([[0, 0, 0]], [[1, 1, 1]], [[0, 0, 1]], paper.imagined_discount, 1)
    learned = lambda_return([[0, 0, 0]], [[GAMMA, GAMMA, GAMMA]], [[0, 0, 1]], official.imagined_discount, 1)
    np.testing.assert_allclose(learned, hard, rtol=1e-14)


def test_mean_weights_of_the_two_profiles():
    """[RET-6], [RET-7]: 16 states alive, and a head that has learned the discount."""
    paper = cumulative_weights([[1.0] * 16], GAMMA)
    official = cumulative_weights([[GAMMA] * 16], 1.0)
    np.testing.assert_allclose([paper.mean(), official.mean()], [0.979250, 0.976309], atol=5e-7)


@pytest.mark.parametrize("discount", [0.0, -0.5, 1.5, math.nan])
def test_cumulative_weights_refuse_a_discount(discount):
    """[RET-8]"""
    with pytest.raises(ValueError, match="discount"):
        cumulative_weights([[1, 1]], discount)


def test_flags_of_replayed_returns_are_booleans_or_numbers():
    """[RET-9]: no end, cut off, terminal."""
    is_last, is_terminal = np.zeros((3, 5)), np.zeros((3, 5))
    is_last[1:, 2] = is_terminal[2, 2] = 1
    rewards, annotations = [[0, 1, 2, 0, 3]] * 3, [[8, 4, 6, 10, 2]] * 3
    np.testing.assert_array_equal(
        replay_lambda_return(rewards, is_last, is_terminal, annotations, 0.5, 0.5),
        replay_lambda_return(rewards, is_last.astype(bool), is_terminal.astype(bool), annotations, 0.5, 0.5),
    )


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


def test_return_range_needs_69_steps_for_half():
    """[RET-15]"""
    low = high = 0.0
    for _ in range(69):
        low, high = update_return_range(
            low, high, [[0.0, 100.0]], load_config(return_percentile_low=0, return_percentile_high=100)
        )
    np.testing.assert_allclose([low, high], [0, 50.016297], rtol=1e-7)


def test_return_scale_shows_nan():
    """[RET-16]"""
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
