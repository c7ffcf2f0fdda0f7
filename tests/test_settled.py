"""Noise that draws the same samples in every precision."""

import numpy as np
import pytest

from conformance.problems import make_problem, nudged
from conformance.settled import away_from_boundaries, settled
from reference_numpy import agent


def test_numbers_near_a_boundary_go_into_the_likeliest_class() -> None:
    """Boundaries at 0.25 and 0.75: the class between them is the likeliest, and 0.5 its middle."""
    log_probs = np.log(np.tile([0.25, 0.5, 0.25], (5, 1)))
    uniform = np.array([0.1, 0.24, 0.26, 0.6, 0.749])
    np.testing.assert_array_equal(away_from_boundaries(uniform, log_probs, 0.02), [0.1, 0.5, 0.5, 0.6, 0.5])
    np.testing.assert_array_equal(away_from_boundaries(uniform, log_probs, 1.0), [0.5] * 5)


def test_one_class_has_no_boundary() -> None:
    np.testing.assert_array_equal(away_from_boundaries(np.array([0.0]), np.zeros((1, 1)), 1e-3), [0.0])


@pytest.mark.parametrize("action", ["discrete", "continuous", "mixed"])
def test_no_sample_changes_within_the_margin(action: str) -> None:
    problem = make_problem(0, "paper", "both", action, batch_size=4, batch_length=16, imagination_horizon=9)
    margin = 2e-3
    moved = settled(problem, margin)
    totals = {agent.losses(*nudged(moved, by).loss_arguments)[0] for by in (-0.99 * margin, 0.0, 0.99 * margin)}
    assert len(totals) == 1
    before = {agent.losses(*nudged(problem, by).loss_arguments)[0] for by in (-0.99 * margin, 0.0, 0.99 * margin)}
    assert len(before) > 1, "a problem that needs it"
    assert 0 < np.mean(moved.noise["prior"] != problem.noise["prior"]) < 0.1
