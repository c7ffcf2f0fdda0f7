"""The worked numbers of the chapters, where each number stands once: examples/<chapter>.toml.

A file is a list of examples, each a call of one function with numbers that a reader can redo by hand:

  ["a return by hand"]
  requirements = ["RET-1"]
  function = "lambda_return"           # of the interface, conformance/adapter.py
  with.reward = [[9, 1, 0, 2]]         # its arguments, by name
  with.discount = "1 - 1/333"          # a formula, where digits would say less
  gives = [[2.28125, 1.125, 7]]
  precision = "exact"
  text = "The return of state 0 is {gives[0][0]}."

`precision` says how near a result must be: "exact", in every bit; "printed", half a unit of the last digit that is
written (whole numbers and formulas: 1e-12 of the number); a number, relative; or a table of these, for the parts of a
result. Several calls share a table: `cases` lists what each adds or has otherwise, its `gives` included. `calls` lists
calls of one object in their order, each by its `method`, with its arguments in their order. Both may have a `precision`
of their own.

An array is written as a list, or as a table with its `shape`: all `values` in row-major order, or one row that is
repeated, or `others`, the number that fills it, and single entries, `127 = 0.5` or `"1, 1" = 1`. Arrays hold float64
or booleans, unless the table names a `dtype`. In a result the entries that are not written are not part of the example.
Of a result that is a mapping or has several parts, `gives` names some.

An argument that is a table with a `function` is what that function gives. `config` holds the hyperparameters that
matter, `spaces` strings such as "Discrete(2, 3)". In `params`, `others = 0` stands for all that are not named.

`text` is the example as the chapter prints it, see docs/examples.py.
"""

import ast
import dataclasses
import functools
import math
import operator
import re
import tomllib
from collections.abc import Callable, Mapping
from decimal import Decimal
from importlib import resources
from typing import Any

import numpy as np

from spec.spaces import Discrete, Image, Spaces, Vector

CHAPTERS = (
    *("notation", "transforms", "distributions", "layers", "rssm", "networks", "world_model", "returns"),
    *("behavior", "optimizer", "agent", "replay", "training_loop"),
)
SURELY = 1e-12  # of a number, where "printed" says nothing about its digits


@dataclasses.dataclass(frozen=True)
class Call:
    """An argument that is what another function of the interface gives."""

    function: str
    arguments: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Case:
    """One call.

    method: what is called of an object; "" for a function. arguments: by name; arrays are NumPy arrays, `config` is a
    mapping of hyperparameters, `spaces` are Spaces. expected: numbers, arrays, or mappings of these; None where the
    example says nothing. bound: how far a result may lie from it, absolute, of the same structure; infinite for entries
    that are not part of the example. written: the arguments and `gives` as the file has them.
    """

    method: str
    arguments: Mapping[str, Any]
    expected: Any
    bound: Any
    written: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Example:
    """One entry of a file.

    arguments: what the cases share; written: the same as the file has it. calls: whether the cases are calls of one
    object, which is made with `arguments`, in their order.
    """

    chapter: str
    name: str
    requirements: tuple[str, ...]
    function: str
    text: str
    arguments: Mapping[str, Any]
    written: Mapping[str, Any]
    cases: tuple[Case, ...]
    calls: bool


@functools.cache
def examples(chapter: str) -> dict[str, Example]:
    """The examples of a chapter by name, in the order of its file.

    Raises:
      ValueError: there is no such chapter, or an entry cannot be read; the message names it.
    """
    if chapter not in CHAPTERS:
        raise ValueError(f"unknown chapter {chapter!r}; known: {', '.join(CHAPTERS)}")
    text = resources.files("spec").joinpath("examples", f"{chapter}.toml").read_text(encoding="utf-8")
    return {name: read(chapter, name, entry) for name, entry in tomllib.loads(text, parse_float=Decimal).items()}


KEYS = ("requirements", "function", "with", "gives", "cases", "calls", "precision", "text")


def read(chapter: str, name: str, entry: Mapping[str, Any]) -> Example:
    """One entry of a file.

    Raises:
      ValueError: it cannot be read; the message names it.
    """
    try:
        _check_keys(entry)
        arguments, calls = entry.get("with", {}), "calls" in entry
        several = entry.get("calls") or entry.get("cases") or [{"gives": entry["gives"]}]
        cases = [_case({} if calls else arguments, case, entry["precision"]) for case in several]
        given = {key: _argument(key, value) for key, value in arguments.items()}
    except ValueError as error:
        raise ValueError(f"spec/examples/{chapter}.toml: {name!r}: {error}") from error
    requirements, function, text = tuple(entry["requirements"]), entry["function"], entry["text"]
    return Example(chapter, name, requirements, function, text, given, arguments, tuple(cases), calls)


def _check_keys(entry: Mapping[str, Any]) -> None:
    if unknown := entry.keys() - set(KEYS):
        raise ValueError(f"unknown keys: {', '.join(sorted(unknown))}; known: {', '.join(KEYS)}")
    if missing := {"requirements", "function", "precision", "text"} - entry.keys():
        raise ValueError(f"missing keys: {', '.join(sorted(missing))}")
    if len({"gives", "cases", "calls"} & entry.keys()) != 1:
        raise ValueError("expected one of gives, cases and calls")
    if not all("gives" in case for case in entry.get("cases", [])):
        raise ValueError("each of the cases needs its gives")


def _case(common: Mapping[str, Any], case: Mapping[str, Any], precision: Any) -> Case:
    written = _merged(common, case)
    arguments = {key: value for key, value in written.items() if key not in ("gives", "method", "precision")}
    expected, bound = None, None
    if "gives" in written:
        expected, bound = _result(written["gives"], written.get("precision", precision))
    return Case(
        written.get("method", ""),
        {key: _argument(key, value) for key, value in arguments.items()},
        expected,
        bound,
        written,
    )


def _merged(common: Mapping[str, Any], case: Mapping[str, Any]) -> dict[str, Any]:
    """What a case adds to a mapping that the cases share, such as `config`, or has in its place."""
    merged = {**common, **case}
    for key in common.keys() & case.keys():
        if isinstance(common[key], dict) and not _is_array(common[key]) and isinstance(case[key], dict):
            merged[key] = {**common[key], **case[key]}
    return merged


def _argument(name: str, written: Any) -> Any:
    if name == "config":
        return {key: _scalar(value) if not isinstance(value, list) else tuple(value) for key, value in written.items()}
    if name == "spaces":
        sides = (written.get(side, {}) for side in ("observations", "actions"))
        return Spaces(*({key: _space(text) for key, text in side.items()} for side in sides))
    if isinstance(written, dict) and not _is_array(written):
        entries = {key: _argument(key, value) for key, value in written.items()}
        return Call(entries.pop("function"), entries) if "function" in entries else entries
    if isinstance(written, str) and written.isidentifier():
        return written
    return _array(written, number) if isinstance(written, list | dict) else _scalar(written)


def _result(written: Any, precision: Any) -> tuple[Any, Any]:
    """What is expected, and how far a result may lie from it."""
    if isinstance(written, dict) and not _is_array(written):
        finer = precision if isinstance(precision, dict) else dict.fromkeys(written, precision)
        parts = {key: _result(value, finer[key]) for key, value in written.items()}
        return {key: part[0] for key, part in parts.items()}, {key: part[1] for key, part in parts.items()}
    if not isinstance(written, list | dict):
        return number(written), allowed(written, precision)
    return _array(written, number), _array(written, lambda value: allowed(value, precision), unwritten=math.inf)


def allowed(written: Any, precision: Any) -> float:
    """How far a result may lie from a number, absolute."""
    if precision == "exact" or not math.isfinite(number(written)):
        return 0.0
    if precision == "printed" and isinstance(written, Decimal):
        return 0.5 * 10.0 ** int(written.as_tuple().exponent)
    return float(SURELY if precision == "printed" else precision) * abs(number(written))


def _is_array(written: Mapping[str, Any]) -> bool:
    return "shape" in written


def _array(written: Any, leaf: Callable[[Any], Any], unwritten: float = math.nan) -> Any:
    """Lists and tables as arrays, their numbers as `leaf` reads them."""
    if isinstance(written, list):
        array = np.array([_array(value, leaf, unwritten) for value in written])
        return array if array.dtype == bool else array.astype(np.float64)
    if not isinstance(written, dict):
        return leaf(written)
    array = np.full(written["shape"], unwritten)
    if "values" in written:
        values = _array(written["values"], leaf, unwritten)
        array[...] = values.reshape(array.shape) if values.size == array.size else values
    if "others" in written:
        array[...] = leaf(written["others"])
    for key, value in written.items():
        if re.fullmatch(r"\d+(, \d+)*", key):
            array[tuple(map(int, key.split(", ")))] = leaf(value)
    return array.astype(written.get("dtype", np.float64))


def _scalar(written: Any) -> Any:
    """Whole numbers and booleans as they are, names as text."""
    if isinstance(written, bool | int) or (isinstance(written, str) and written.isidentifier()):
        return written
    return number(written)


def number(written: Any) -> float:
    """A number of a file: as digits, or as a formula such as "1 - 1/333" or "ln(8)"."""
    if not isinstance(written, str):
        return written if isinstance(written, bool) else float(written)
    try:
        return _evaluate(ast.parse(written, mode="eval").body)
    except (SyntaxError, KeyError, TypeError, ArithmeticError) as error:
        raise ValueError(f"expected a number or a formula, got {written!r}") from error


def _sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


FUNCTIONS: dict[str, Callable[[float], float]] = {
    **{"ln": math.log, "exp": math.exp, "sqrt": math.sqrt, "tanh": math.tanh, "artanh": math.atanh},
    "sigmoid": _sigmoid,
}
CONSTANTS = {"e": math.e, "pi": math.pi}
OPERATORS: dict[type, Callable[..., float]] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv},
    **{ast.Pow: operator.pow, ast.USub: operator.neg},
}


def _evaluate(node: ast.AST) -> float:
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.Name(id=name):
            return CONSTANTS[name]
        case ast.BinOp(left=left, op=op, right=right):
            return OPERATORS[type(op)](_evaluate(left), _evaluate(right))
        case ast.UnaryOp(op=op, operand=operand):
            return OPERATORS[type(op)](_evaluate(operand))
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]):
            return FUNCTIONS[name](_evaluate(argument))
    raise KeyError(ast.dump(node))


def _space(text: str) -> Any:
    """A space as Python would make it: "Vector(2)", "Discrete(2, 3)", "Image(64, 64, 3)"."""
    if not (found := re.fullmatch(r"(Vector|Discrete|Image)\((\d+(?:, \d+)*)\)", text)):
        raise ValueError(f"expected a space such as Vector(2), got {text!r}")
    kind, numbers = found[1], [int(size) for size in found[2].split(", ")]
    return Discrete(tuple(numbers)) if kind == "Discrete" else {"Vector": Vector, "Image": Image}[kind](*numbers)
