"""What a report shows of a failure: the most ordinary input that fails, and beside it what the requirement says."""

import dataclasses
import io
import types
from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from html_document import Document
from report_data import CHECKS, FAIL, make
from rich.console import Console

from conformance import drawing
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Cases, Drawn, Setting, exact
from conformance.check import Check
from conformance.editions import judge_twice
from conformance.execute import Result
from conformance.reports import html, markdown, summary, terminal
from conformance.strategies import adversarial_numbers
from spec import editions

PAPER = editions()["paper"]


def judged(build: Callable[[Setting], Cases], f: Callable[[Any], Any]) -> Result:
    check = Check("transforms.made_up", (), ("f",), 0, ("float64",), "", build)
    return judge_twice(check, types.SimpleNamespace(f=f), PAPER, "float64")


def argument(result: Result) -> float:
    assert result.call is not None
    return float(result.call.arguments[0][0])


def zero_of(number: float) -> Any:
    return exact("f", (np.array([number]),), np.zeros(1))


def mixed(setting: Setting) -> Cases:
    """Extreme, drawn, written down, by hand: in the order in which they are least welcome."""
    yield zero_of(np.nan)
    yield Drawn(lambda x: iter([zero_of(x)]), x=adversarial_numbers())
    yield zero_of(7.0)
    yield dataclasses.replace(zero_of(2.0), by_hand=True)


def test_the_most_ordinary_input_is_shown() -> None:
    result = judged(mixed, np.ones_like)
    assert (argument(result), result.extreme) == (2.0, False)
    assert result.call is not None
    assert result.call.by_hand
    assert argument(judged(mixed, lambda x: np.where(x == 2, 0, 1))) == 7.0
    drawn = judged(mixed, lambda x: np.where(np.isin(x, [2, 7]), 0, 1))
    assert (argument(drawn), drawn.extreme) == (0.0, False)
    gentle = judged(mixed, lambda x: np.where((np.abs(x) < 3) | (x == 7), 0, 1))
    assert (abs(argument(gentle)) <= 300, gentle.extreme) == (True, False)


def test_only_where_nothing_ordinary_fails_an_extreme_input_is_shown() -> None:
    result = judged(mixed, lambda x: np.where(np.isnan(x), 1, 0))
    assert result.extreme
    assert np.isnan(argument(result))
    huge = judged(mixed, lambda x: np.where(np.abs(x) > 1e20, 1, 0))
    assert huge.extreme
    assert abs(argument(huge)) > 1e20


def test_a_failure_with_ordinary_input_is_not_run_again() -> None:
    asked: list[float] = []
    assert judged(mixed, lambda x: asked.append(float(x[0])) or np.ones(1)).status == "fail"
    assert asked == [2.0]


def test_smaller_inputs_are_looked_for_as_often_on_every_machine() -> None:
    """However slow the candidate is: no clock decides what a report shows."""
    calls = 0

    def count(x: np.ndarray) -> np.ndarray:
        nonlocal calls
        calls += 1
        return np.where(x > 3, 1, 0)

    def build(setting: Setting) -> Cases:
        yield Drawn(lambda x: iter([zero_of(float(x))]), x=st.integers(0, 10**6))

    result = judged(build, count)
    assert argument(result) == 4.0
    assert calls <= 25 + 4 * 25 + drawing.SHRINKING + 2


@pytest.mark.parametrize("name", ["returns.lambda_return_literals", "returns.replay_return_literals"])
def test_hand_computed_numbers_are_marked(name: str) -> None:
    wrong = types.SimpleNamespace(
        lambda_return=lambda *x: 2 * NumpyAdapter().lambda_return(*x),
        replay_lambda_return=lambda *x: 2 * NumpyAdapter().replay_lambda_return(*x),
    )
    result = judge_twice(CHECKS[name], wrong, PAPER, "float64")
    assert result.call is not None
    assert result.call.by_hand
    assert "by hand" in result.message


def test_failures_with_hand_computed_numbers_come_first() -> None:
    data = make()
    assert data["checks"][FAIL]["failure"]["by_hand"]
    other = {**data["checks"][FAIL], "failure": {**data["checks"][FAIL]["failure"], "by_hand": False}}
    mixed_up = {**data, "checks": {"a": other, "b": data["checks"][FAIL]}, "diagnoses": []}
    assert [name for name, _ in summary.failures(mixed_up).ordinary] == ["b", "a"]


def test_the_sentence_of_the_requirement_stands_beside_the_input() -> None:
    data = make()
    sentence = "takes three arrays [N, H+1] with H ≥ 1 and MUST return the array [N, H]"
    console = Console(file=io.StringIO(), width=1000)
    terminal.show(console, data)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert printed.index(sentence) < printed.index("  lambda_return, called with")
    assert sentence.replace("[", "\\[").replace("]", "\\]") in markdown.render(data)
    assert "> RET-1: `lambda_return(reward, continue_, value, discount, lambda_)` takes" in markdown.render(data)
    assert sentence in Document(html.render([data])).text


def test_of_many_requirements_a_few_are_told() -> None:
    told = summary.sentences({f"A-{n}": f"[Links](x.md) and $\\gamma$ {n}" for n in range(5)})
    assert told == ["A-0: Links and γ 0", "A-1: Links and γ 1", "A-2: Links and γ 2", "and 2 more"]
