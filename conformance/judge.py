"""Judging: a candidate is asked what the cases ask, and its answers are compared."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from conformance.case import Call, Case, Equal, Refused, Setting
from conformance.compare import Comparisons, is_extreme
from conformance.drawing import Example, cases, one_by_one, smallest

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
    candidate that is somebody else's program may refuse with any exception, and may say of some cases that it lacks
    what they ask for: the others count.
    """
    for case, example in sorted(cases(build, setting, ordinary), key=_how_special):
        comparisons.drawn = example is not None
        _judge(case, example if shrink else None, setting, ask, comparisons, any_error)


def judge_ordinary_cases(
    build: Callable[[Setting], Any], setting: Setting, ask: Ask, comparisons: Comparisons, any_error: bool = False
) -> None:
    """Judges the ordinary cases of a check in their order, each as soon as it is built: for many cases of which one of
    the first will deviate. Drawn values that deviate are made smaller. Call it within `ordinary_numbers`."""
    for case, example in one_by_one(build, setting):
        comparisons.drawn = example is not None
        if not case.is_extreme:
            _judge(case, example, setting, ask, comparisons, any_error)


def _how_special(item: tuple[Case, Example | None]) -> tuple[bool, bool, bool]:
    case, example = item
    return case.is_extreme, example is not None, not case.by_hand


def _judge(
    case: Case, example: Example | None, setting: Setting, ask: Ask, comparisons: Comparisons, any_error: bool
) -> None:
    """Judges a case. One that deviates gives way to those of a smaller example, as ordinary, where it is of one."""
    try:
        judge_case(case, ask, comparisons, any_error)
    except NotImplementedError as error:
        if not any_error:
            raise
        function = comparisons.call.function if comparisons.call else case.calls[0].function
        comparisons.left_out.append(function + (f" ({error})" if str(error) else ""))
    except Exception:
        if example is not None:
            any_case = case.is_extreme

            def judge_again(case: Case) -> None:
                if any_case or not case.is_extreme:
                    judge_case(case, ask, comparisons, any_error)

            smallest(example, setting, judge_again)
        raise


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
