"""Judging: a candidate is asked what the cases ask, and its answers are compared."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from conformance.case import Call, Case, Drawn, Equal, Refused, Setting
from conformance.compare import Comparisons, is_extreme
from conformance.drawing import built, cases, run_examples

COPIED = 2**16  # numbers of an array up to which arguments are kept as they were

Ask = Callable[[Call, Equal | Refused | None], Any]
"""Makes a call and returns or raises what comes of it. It is told what is demanded of the whole result, if one demand
says it."""


def asking(adapter: object) -> Ask:
    """The adapter's own answers."""
    return lambda call, demand: getattr(adapter, call.function)(*call.arguments)


def standing_in(ask: Ask, stand_in: object) -> Ask:
    """As `ask`, but another adapter answers where the input is extreme: a deviation is then one with ordinary input."""

    def answer(call: Call, demand: Equal | Refused | None) -> Any:
        extreme = is_extreme(call.arguments) and hasattr(stand_in, call.function)
        return getattr(stand_in, call.function)(*call.arguments) if extreme else ask(call, demand)

    return answer


def judge_cases(
    build: Callable[[Setting], Any],
    setting: Setting,
    ask: Ask,
    comparisons: Comparisons,
    *,
    ordinary: bool = False,
    shrink: bool = True,
    any_error: bool = False,
) -> None:
    """Judges the cases of a check up to the first deviation, the most ordinary first: examples of the chapter, others
    that are written down, drawn ones, and those with extreme input.

    ordinary: leaves the last out. shrink: makes drawn values smaller that deviate, which takes longer. any_error: a
    candidate that is somebody else's program may refuse with any exception.
    """
    for case, drawn in sorted(cases(build, setting, ordinary), key=_how_special):
        comparisons.drawn = drawn is not None
        try:
            judge_case(case, ask, comparisons, any_error)
        except NotImplementedError:
            raise
        except Exception:
            if drawn is not None and shrink:
                judge_drawn(drawn, setting, ask, comparisons, any_error)
            raise


def _how_special(item: tuple[Case, Drawn | None]) -> tuple[bool, bool, bool]:
    case, drawn = item
    return case.is_extreme, drawn is not None, not case.by_hand


def judge_ordinary_cases(
    build: Callable[[Setting], Any], setting: Setting, ask: Ask, comparisons: Comparisons, any_error: bool = False
) -> None:
    """Judges the ordinary cases of a check in their order, each as soon as it is built: for many cases of which one of
    the first will deviate. Drawn values that deviate are made smaller. Call it within `ordinary_numbers`."""
    for item in build(setting):
        comparisons.drawn = isinstance(item, Drawn)
        if isinstance(item, Drawn):
            judge_drawn(item, setting, ask, comparisons, any_error, ordinary=True)
        elif not item.is_extreme:
            judge_case(item, ask, comparisons, any_error)


def judge_drawn(
    drawn: Drawn,
    setting: Setting,
    ask: Ask,
    comparisons: Comparisons,
    any_error: bool = False,
    ordinary: bool = False,
) -> None:
    """Draws and judges; raises what the smallest example raises that hypothesis finds. ordinary: leaves cases with
    extreme input out."""

    def judge_all(**values: Any) -> None:
        for case in built(drawn, values):
            if not (ordinary and case.is_extreme):
                judge_case(case, ask, comparisons, any_error)

    run_examples(judge_all, drawn.strategies, setting, shrink=True)


def judge_case(case: Case, ask: Ask, comparisons: Comparisons, any_error: bool = False) -> None:
    """Raises `Deviation` unless all demands are met, or what the candidate raises."""
    comparisons.case = case
    if case.refused is not None:
        judge_refusal(case.calls[0], case.refused, ask, comparisons, any_error)
        return
    results = []
    for index, call in enumerate(case.calls):
        comparisons.call, given = call, copied(call.arguments, everything=True)
        results.append(ask(Call(call.function, given), case.whole(index)))
        if case.keeps:
            comparisons.unchanged(f"the arguments of {call.function} after the call", given, call.arguments)
    for demand in case.demands:
        demand.judge(comparisons, case, results)


def judge_refusal(call: Call, demand: Refused, ask: Ask, comparisons: Comparisons, any_error: bool) -> None:
    """Raises `Deviation` unless the call raises a ValueError whose message holds the words."""
    comparisons.call = call
    comparisons.compared += 1
    function = call.function
    try:
        result = ask(Call(function, copied(call.arguments, everything=True)), demand)
    except Exception as error:
        if any_error:
            return
        if not isinstance(error, ValueError):
            raise
        comparisons.holds(f"the error message of {function}", bool(str(error)))
        for word in demand.naming:
            comparisons.holds(
                f"the error message of {function} names {word!r} ({_brief(str(error))})", word in str(error)
            )
        return
    what = f"{function} must raise a ValueError for {_brief(call.arguments)}, and returned {_brief(result)}"
    comparisons.fail(function, what)


def copied(value: Any, everything: bool = False) -> Any:
    """The value with copies of its arrays, so that a candidate that writes into them hides nothing.

    everything: also of those of full-size networks, which otherwise stay as they are.
    """
    if isinstance(value, np.ndarray):
        return value.copy() if everything or value.size <= COPIED else value
    if isinstance(value, Mapping):
        return {key: copied(entry, everything) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(copied(entry, everything) for entry in value)
    return value


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 120 else text[:117] + "..."
