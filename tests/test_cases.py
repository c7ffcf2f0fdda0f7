"""The contract of checks: what each must be, so that judging, diagnosis, editions and vectors can rely on it."""

import dataclasses
import types
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Call, Case, Cases, Drawn, Equal, Setting, equal, exact, judged, refused, related
from conformance.check import CHECKS, Check, check, script
from conformance.compare import Comparisons, Deviation, entries
from conformance.drawing import cases
from conformance.execute import run_check, selected_checks
from conformance.interface import INTERFACE, OBJECTS
from conformance.judge import asking, judge_case
from conformance.script import Script
from reference_numpy import rssm

SETTING = Setting("float64", "paper", examples=2)
BUILT = [one for one in selected_checks("float64") if one.cases is not None]
SCRIPTS = [one for one in selected_checks("float64") if one.script is not None]


def cases_of(one: Check, setting: Setting = SETTING) -> list[Case]:
    assert one.cases is not None
    return [case for case, _ in cases(one.cases, setting)]


def same(value: Any, other: Any) -> bool:
    if isinstance(value, dict | tuple | list):
        return len(value) == len(other) and all(same(value[key], other[key]) for key in entries(value))
    if isinstance(value, np.ndarray):
        return np.array_equal(value, other, equal_nan=value.dtype.kind == "f")
    return value == other or (value != value and other != other)


@pytest.mark.parametrize("one", [pytest.param(one, id=one.name) for one in BUILT])
def test_a_check_asks_what_it_says_it_uses(one: Check) -> None:
    built = cases_of(one)
    assert frozenset().union(*(case.functions for case in built)) == set(one.uses)
    for case in built:
        assert case.demands or case.refused or case.keeps, "a case that demands nothing"
        assert case.refused is None or (len(case.calls) == 1 and not case.demands)
        for call in case.calls:
            assert len(call.arguments) == len(INTERFACE[call.function]), call.function


@pytest.mark.parametrize("one", [pytest.param(one, id=one.name) for one in BUILT])
def test_a_check_builds_the_same_cases_again(one: Check) -> None:
    first = cases_of(one)
    cases.cache_clear()
    again = cases_of(one)
    assert len(first) == len(again)
    for before, after in zip(first, again, strict=True):
        assert [call.function for call in before.calls] == [call.function for call in after.calls]
        for old, new in zip(before.calls, after.calls, strict=True):
            assert same(old.arguments, new.arguments)


def test_scripts_are_few() -> None:
    """Only what hands a result on, drives an object or counts frequencies: everything else is data."""
    driving = [one for one in SCRIPTS if set(one.uses) & set(OBJECTS)]
    drawing = [one for one in SCRIPTS if any(use.startswith("draw_") for use in one.uses)]
    others = {one.name for one in SCRIPTS} - {one.name for one in (*driving, *drawing)}
    assert len(others) <= 8, others


# ------------------------------------------------------------------------------
# Judging


def judge(function: Any, case: Case) -> Comparisons:
    comparisons = Comparisons("float64")
    judge_case(case, asking(types.SimpleNamespace(f=function)), comparisons)
    return comparisons


def test_demands_are_judged_in_their_order() -> None:
    case = judged("f", (2.0,), Equal(4.0, ("square",)), lambda c, result: c.holds("small", result["square"] < 3))
    with pytest.raises(Deviation, match="small does not hold"):
        judge(lambda x: {"square": x * x}, case)
    with pytest.raises(Deviation, match=r"f: got 2.0, expected 4.0"):
        judge(lambda x: {"square": x}, case)
    with pytest.raises(Deviation, match=r"f: the result has no part \['square'\], it is 2.0"):
        judge(lambda x: x, case)


def test_a_candidate_that_writes_into_its_arguments_changes_no_case() -> None:
    x = np.ones(3)

    def scribble(x: np.ndarray) -> np.ndarray:
        x += 1
        return x - 1

    assert judge(scribble, exact("f", (x,), np.ones(3))).compared == 3
    assert x.tolist() == [1, 1, 1]
    with pytest.raises(Deviation, match="the arguments of f after"):
        judge(scribble, dataclasses.replace(exact("f", (x,), np.ones(3)), keeps=True))


def test_relations_get_one_result_for_each_call() -> None:
    case = related(lambda c, one, two: c.exact("twice", two, 2 * one), ("f", (1.0,)), ("f", (2.0,)))
    assert judge(lambda x: x, case).compared == 1
    with pytest.raises(Deviation, match=r"twice: got 5\.0, expected 4\.0"):
        judge(lambda x: x * x + 1, case)


def test_refusals() -> None:
    def refuse(x: float) -> None:
        raise ValueError(f"x must be positive, got {x}")

    judge(refuse, refused("f", -1.0, naming=["x"]))
    with pytest.raises(Deviation, match="names 'y'"):
        judge(refuse, refused("f", -1.0, naming=["y"]))
    with pytest.raises(Deviation, match=r"f must raise a ValueError for \(-1.0,\), and returned 3"):
        judge(lambda x: 3, refused("f", -1.0))
    with pytest.raises(ZeroDivisionError):
        judge(lambda x: 1 / 0, refused("f", -1.0))
    comparisons = Comparisons("float64")
    judge_case(refused("f", 0.0), asking(types.SimpleNamespace(f=lambda x: 1 / x)), comparisons, any_error=True)
    assert comparisons.compared == 1


def test_drawn_values_are_made_smaller() -> None:
    def build(setting: Setting) -> Cases:
        def case(n: int) -> Cases:
            yield equal("f", (n,), float(n))

        yield Drawn(case, n=st.integers(0, 10_000))

    one = Check("chapter.one", (), ("f",), 0, ("float64",), "", build)
    result = run_check(one, types.SimpleNamespace(f=lambda n: min(n, 17)), Setting("float64", "paper", examples=50))
    assert result.status == "fail"
    assert result.call is not None
    assert result.call.arguments == (18,)
    assert "got 17.0, expected 18.0" in result.message


def test_ordinary_cases_are_those_without_extreme_input() -> None:
    def build(setting: Setting) -> Cases:
        yield equal("f", (np.array([1.0]),), np.array([1.0]))
        yield equal("f", (np.array([np.nan]),), np.array([np.nan]))
        yield refused("f", np.zeros(0))

    assert len(cases(build, SETTING)) == 3
    assert len(cases(build, SETTING, True)) == 1


def test_a_check_yields_and_a_script_does_not() -> None:
    def yields(setting: Setting) -> Cases:
        yield Case((Call("f", ()),))

    def runs(script: Script) -> None:
        pass

    with pytest.raises(TypeError, match="@check takes a function that yields cases"):
        check("X-1", uses=["f"], level=0)(runs)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="@script one that does not"):
        script("X-1", uses=["f"], level=0)(yields)  # type: ignore[arg-type]
    assert not any("test_cases" in name for name in CHECKS)


def test_a_long_sequence_that_loses_its_memory_is_seen() -> None:
    class Forgets(NumpyAdapter):
        """In sequences of more than 64 steps, from the 65th on."""

        def observe(self, params: Any, carry: Any, *rest: Any) -> Any:
            *steps, config = rest
            parts = [slice(0, 64), *([slice(64, None)] if steps[0].shape[1] > 64 else [])]
            starts = [carry, {name: np.zeros_like(value) for name, value in carry.items()}]
            done = [
                rssm.observe(params, start, *(x[:, part] for x in steps), config)
                for start, part in zip(starts, parts, strict=False)
            ]
            return {name: np.concatenate([part[name] for part in done], 1) for name in done[0]}

    check = CHECKS["large.a_sequence_is_its_halves"]
    for adapter, status in ((NumpyAdapter(), "pass"), (Forgets(), "fail")):
        assert run_check(check, adapter, Setting("float64", "paper")).status == status
