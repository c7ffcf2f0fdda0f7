"""The buffer of a run against the naive one, and mistakes in it that the comparison catches."""

import pytest
from replay_machine import run_machine
from replay_mistakes import MISTAKES, Mistake


def test_the_buffer_is_the_naive_one() -> None:
    run_machine(examples=60)


@pytest.mark.slow
def test_the_buffer_is_the_naive_one_in_many_histories() -> None:
    run_machine(examples=1000, steps=80)


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.explanation.replace(" ", "_"))
def test_the_mistake_is_caught(mistake: Mistake, monkeypatch: pytest.MonkeyPatch) -> None:
    mistake.plant(monkeypatch)
    try:
        run_machine(examples=1000, shrink=False)
    except Exception:
        return
    pytest.fail(f"the machine did not notice: {mistake.explanation}")
