"""The buffer of a run against the naive one, and mistakes in it that the comparison catches."""

import pytest

from tests.replay_machine import run_machine


def test_the_buffer_is_the_naive_one() -> None:
    run_machine(examples=60)


@pytest.mark.slow
def test_the_buffer_is_the_naive_one_in_many_histories() -> None:
    run_machine(examples=3000, steps=80)
