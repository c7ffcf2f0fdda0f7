"""stop_gradient: identity, recording, replaying, and what they are for: central differences with constants."""

import numpy as np
import pytest

from reference_numpy.stop_gradient import recording, replaying, stop_gradient


def test_outside_it_is_the_identity():
    np.testing.assert_array_equal(stop_gradient([1.0, -2.0]), [1.0, -2.0])


def test_recording_keeps_copies_in_order():
    x = np.array([1.0, 2.0])
    with recording() as tape:
        np.testing.assert_array_equal(stop_gradient(x), [1.0, 2.0])
        x[0] = 5.0
        stop_gradient(3.0)
    np.testing.assert_array_equal(tape[0], [1.0, 2.0])
    np.testing.assert_array_equal(tape[1], 3.0)
    assert len(tape) == 2


def test_replaying_returns_recorded_values():
    with recording() as tape:
        stop_gradient([1.0, 2.0])
        stop_gradient(3.0)
    for _ in range(2):
        with replaying(tape):
            np.testing.assert_array_equal(stop_gradient([8.0, 9.0]), [1.0, 2.0])
            assert stop_gradient(7.0) == 3.0
    assert stop_gradient(7.0) == 7.0


def test_a_replayed_value_may_be_changed_without_changing_the_tape():
    with recording() as tape:
        stop_gradient([1.0])
    with replaying(tape):
        stop_gradient([0.0])[0] = 9.0
    np.testing.assert_array_equal(tape[0], [1.0])


def test_replaying_refuses_other_calls():
    with recording() as tape:
        stop_gradient([1.0, 2.0])
    with pytest.raises(ValueError, match="recorded shape"), replaying(tape):
        stop_gradient([1.0])
    with pytest.raises(ValueError, match="more often"), replaying(tape):
        [stop_gradient([1.0, 2.0]) for _ in range(2)]
    with pytest.raises(ValueError, match="called 0 times, recorded were 1"), replaying(tape):
        pass
    assert stop_gradient(7.0) == 7.0


def test_an_error_inside_is_not_hidden_and_ends_the_replay():
    with recording() as tape:
        stop_gradient(1.0)
    with pytest.raises(ZeroDivisionError), replaying(tape):
        raise ZeroDivisionError
    assert stop_gradient(7.0) == 7.0


def test_no_nesting():
    with recording() as tape:
        with pytest.raises(ValueError, match="already"), recording():
            pass
        stop_gradient(1.0)
    assert len(tape) == 1


def test_central_difference_treats_constants_as_constants():
    def loss(x):
        return float(x * stop_gradient(x**2))  # derivative x**2, not 3 x**2

    with recording() as tape:
        assert loss(3.0) == 27.0
    values = []
    for x in (3.0 + 1e-3, 3.0 - 1e-3):
        with replaying(tape):
            values.append(loss(x))
    assert (values[0] - values[1]) / 2e-3 == pytest.approx(9.0)
