"""The checks of a running loop pass a small one that is written otherwise than ours, and find what goes wrong in it."""

from typing import Any

import pytest
from loop_mistakes import MISTAKES
from small_loop import Candidate, SmallLoop

import conformance.cases  # noqa: F401 - registers the checks
from conformance.case import Setting
from conformance.check import CHECKS
from conformance.execute import run_check

NAMES = [name for name in CHECKS if name.startswith(("running_loop.", "going_on."))]
SETTING = Setting("float64", "paper")


@pytest.mark.parametrize("name", NAMES)
def test_a_right_loop_passes(name: str) -> None:
    result = run_check(CHECKS[name], Candidate(), SETTING)
    assert result.status == "pass", result.message


@pytest.mark.parametrize(
    ("name", "loop"),
    [
        pytest.param(name, loop, id=f"{name}-{number}-{loop.__name__}")
        for name, loops in MISTAKES.items()
        for number, loop in enumerate(loops)
    ],
)
def test_mistakes_of_loops_are_found(name: str, loop: type[SmallLoop]) -> None:
    result = run_check(CHECKS[name], Candidate(loop), SETTING, shrink=False)
    assert result.status == "fail", result.message


def test_every_check_can_fail() -> None:
    assert set(MISTAKES) == set(NAMES)


def test_what_a_loop_lacks_is_not_judged() -> None:
    """The rest is: here of a loop without evaluation."""

    class Poor(Candidate):
        def run(self, environment: Any, learner: Any, options: Any) -> None:
            if options.evaluate_every:
                raise NotImplementedError("evaluation")
            super().run(environment, learner, options)

    evaluating = [name for name in NAMES if "evaluation" in name]
    results = {name: run_check(CHECKS[name], Poor(), SETTING) for name in (*evaluating, *NAMES[-3:])}
    assert {name: result.status for name, result in results.items()} == {
        **dict.fromkeys(evaluating, "not offered"),
        **dict.fromkeys(NAMES[-3:], "pass"),
    }
    assert {results[name].message for name in evaluating} == {"not implemented: run (evaluation)"}
