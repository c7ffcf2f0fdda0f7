"""The worked numbers of the chapters (spec/examples) as calls, for checks and tests.

In a check, a case for each example, with the rounding that it allows:

  yield from worked_cases(setting, "returns", "a return by hand", "the ends of lambda")  # equal in every bit
  yield from worked_cases(setting, "returns", "a return with the real constants", bound=64 * setting.u)

The names are those of spec/examples/returns.toml. An example that lists several cases comes as several. What else is to
be done with them starts from `worked`; without names, it gives all of the chapter, in their order. An example of an
object has `calls` in place of a result:

  for case in worked("training_loop", "no drift"):
      made = script.call(case.function, *case.arguments)
      for call in case.calls:
          actual = (getattr(made, call.function) if call.function else made)(*call.arguments)
          if call.expected is not None:
              script.compare(call.name, actual, call.expected, magnitude=1.0, bound=0.0)

Arguments are in the order of the interface: NumPy arrays of float64, booleans, or the dtype that the file names, not
rounded to the dtype of a setting; mappings of these; Spaces and Config.
"""

import copy
import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from conformance.adapter import Adapter, Array
from conformance.case import Cases, Setting, equal
from conformance.compare import WIDE, round_to
from conformance.interface import INTERFACE, RESULTS
from conformance.our_candidates import load_adapter
from conformance.problems import small_config
from spec import Spaces, Vector, parameter_table
from spec.worked import Call, Case, Example, examples


@dataclasses.dataclass(frozen=True)
class Worked:
    """One call with its result.

    name: "returns: a return by hand", with the number of the case where there are several. function: its name in the
    interface; the name of a method, or "" for the object itself, in `calls`. arguments: by position; those of the
    constructor where `calls` holds the calls of the object in their order. expected: an array, number, mapping or
    tuple; what the example leaves open is the reference's; None where there is nothing to compare. bound: of the same
    structure, how far a result may lie from it in float64, absolute: 0 where every bit must agree.
    """

    name: str
    function: str
    arguments: tuple[Any, ...]
    expected: Any = None
    bound: Any = None
    calls: tuple["Worked", ...] = ()


def worked(chapter: str, *names: str, profile: str = "paper", dtype: str = "float64") -> tuple[Worked, ...]:
    """The cases of the named examples of a chapter, or all of them.

    profile: of the hyperparameters that an example does not set; none of them matters. dtype: of the configuration.

    Raises:
      ValueError: the chapter has no such example; the message lists those that it has.
    """
    known = examples(chapter)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"{chapter} has no example {unknown[0]!r}; known: {', '.join(known)}")
    return tuple(case for name in names or known for case in _cases(known[name], profile, dtype))


# Arguments that are float32 or better in every compute dtype.
WIDE_ARGUMENTS = ("bins", "uniform", "noise", "normal")


def worked_cases(setting: Setting, chapter: str, *names: str, floor: float = 0.0, bound: float = 0.0) -> Cases:
    """A case for each case of the named examples. The arguments are rounded to what the candidate can hold, and the
    result is what the reference makes of these, with all its digits: tests compare it with those that are written.

    bound: the deviation that is allowed, relative to each number, or to `floor` where the number is smaller; without
    it, results are equal in every bit but the sign of zero.
    """
    for case in worked(chapter, *names, profile=setting.profile, dtype=setting.dtype):
        arguments = tuple(map(functools.partial(_held, setting), INTERFACE[case.function], case.arguments))
        expected = getattr(_reference(), case.function)(*copy.deepcopy(arguments))
        where = f"{case.function}, {case.name.partition(': ')[2]}"
        magnitude = _combine(lambda value: np.maximum(np.abs(value), floor), expected) if bound else 1.0
        made = equal(case.function, arguments, expected, where=where, magnitude=magnitude, bound=bound)
        yield dataclasses.replace(made, by_hand=True)


def _held(setting: Setting, name: str, value: Any) -> Any:
    """An argument as the candidate can hold it."""
    if isinstance(value, Mapping):
        return {key: _held(setting, name, entry) for key, entry in value.items()}
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
        return value
    if name in ("observation", "observations"):
        return value.astype(np.float32)
    return round_to(value, WIDE[setting.dtype]) if name in WIDE_ARGUMENTS else setting.cast(value)


def _cases(example: Example, profile: str, dtype: str) -> list[Worked]:
    name = f"{example.chapter}: {example.name}"
    if example.calls:
        return [_object(example, name)]
    numbered = [name] if len(example.cases) == 1 else [f"{name}, {n}" for n, _ in enumerate(example.cases, 1)]
    return [
        _case(title, example.function, case, profile, dtype)
        for title, case in zip(numbered, example.cases, strict=True)
    ]


def _case(name: str, function: str, case: Case, profile: str, dtype: str) -> Worked:
    try:
        arguments = _in_order(function, case.arguments, profile, dtype)
        reference = getattr(_reference(), function)(*copy.deepcopy(arguments))
        return Worked(name, function, arguments, *_whole(function, case, reference))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from error


def _object(example: Example, name: str) -> Worked:
    """The object's calls, what the example leaves open filled in by the reference's object."""
    arguments = tuple(example.arguments[key] for key in INTERFACE[example.function])
    made = getattr(_reference(), example.function)(*arguments)
    calls = []
    for n, case in enumerate(example.cases, 1):
        given = tuple(map(_entries_as_arrays, copy.deepcopy(tuple(case.arguments.values()))))
        result = (getattr(made, case.method) if case.method else made)(*copy.deepcopy(given))
        expected, bound = (None, None) if case.expected is None else _whole(case.method, case, result)
        calls.append(Worked(f"{name}, {n}", case.method, given, expected, bound))
    return Worked(name, example.function, arguments, calls=tuple(calls))


def _entries_as_arrays(value: Any) -> Any:
    """Records hold arrays, also where the file has a single number."""
    return {key: np.asarray(entry) for key, entry in value.items()} if isinstance(value, Mapping) else value


@functools.cache
def _reference() -> Any:
    return load_adapter("numpy")


def _in_order(function: str, given: Mapping[str, Any], profile: str, dtype: str) -> tuple[Any, ...]:
    """The arguments by position, configuration and parameters made, those that another function gives computed."""
    arguments = {name: copy.deepcopy(value) for name, value in given.items()}
    for name, value in given.items():
        if isinstance(value, Call):
            inner = _in_order(value.function, value.arguments, profile, dtype)
            arguments[name] = getattr(_reference(), value.function)(*inner)
    if "config" in INTERFACE[function]:
        arguments["config"] = small_config(profile, dtype, **arguments.get("config", {}))
    for group in ("params", "slow_critic"):
        if "others" in arguments.get(group, {}):
            arguments[group] = _all_parameters(arguments, group)
    kinds = getattr(Adapter, function).__annotations__
    return tuple(
        np.asarray(arguments[name]) if kinds[name] is Array else arguments[name] for name in INTERFACE[function]
    )


def _all_parameters(arguments: Mapping[str, Any], group: str) -> dict[str, np.ndarray]:
    """Every parameter of the table, with one number wherever the example names none."""
    named = dict(arguments[group])
    others = named.pop("others")
    task = arguments.get("spaces") or Spaces({"x": Vector(1)}, {"a": Vector(np.shape(arguments["action"])[-1])})
    table = parameter_table(arguments["config"], task)
    return {
        name: named.get(name, np.full(entry.shape, float(others)))
        for name, entry in table.items()
        if group == "params" or name.startswith("critic/")
    }


def _whole(function: str, case: Case, reference: Any) -> tuple[Any, Any]:
    """What is expected and the bound: the example's where it says something, else the reference's and 0."""
    if function not in RESULTS:
        return _filled(case.expected, case.bound, reference)
    named = dict(zip(RESULTS[function], reference, strict=True))
    expected, bound = _filled(case.expected, case.bound, named)
    return tuple(expected[name] for name in named), tuple(bound[name] for name in named)


def _filled(expected: Any, bound: Any, reference: Any) -> tuple[Any, Any]:
    if isinstance(reference, Mapping):
        if unknown := set(expected) - set(reference):
            raise ValueError(f"the result has no {', '.join(unknown)}; it has {', '.join(reference)}")
        parts = {
            key: _filled(expected[key], bound[key], value) if key in expected else (value, _combine(_nothing, value))
            for key, value in reference.items()
        }
        return {key: part[0] for key, part in parts.items()}, {key: part[1] for key, part in parts.items()}
    if np.shape(expected) != np.shape(reference):
        raise ValueError(f"the result has the shape {np.shape(reference)}, the example {np.shape(expected)}")
    left_open = np.isinf(bound)
    return np.where(left_open, reference, expected), np.where(left_open, 0.0, bound)


def _nothing(value: Any) -> np.ndarray:
    return np.zeros(np.shape(value))


def _combine(function: Any, first: Any, *others: Any) -> Any:
    """The function of corresponding numbers and arrays of nested results."""
    if isinstance(first, Mapping):
        return {key: _combine(function, first[key], *(other[key] for other in others)) for key in first}
    if isinstance(first, tuple):
        return tuple(_combine(function, *parts) for parts in zip(first, *others, strict=True))
    return function(first, *others)
