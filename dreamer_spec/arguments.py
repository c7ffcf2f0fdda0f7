"""Keyword arguments of an environment as words of a command line, NAME=VALUE: the value as JSON, and as text where it
is none."""

import argparse
import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

from dreamer_spec.errors import UserError


def read(text: str) -> tuple[str, Any]:
    """map_name=8x8 -> "map_name", "8x8"; size=3 -> "size", 3

    Raises:
      argparse.ArgumentTypeError: no name that Python takes, or a value that no file could hold.
    """
    name, separator, value = text.partition("=")
    if not separator or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r:.80} is not NAME=VALUE, where NAME is a name of Python")
    try:
        parsed = _parse(value)
        json.dumps(parsed, ensure_ascii=False).encode("utf-8")  # Half a surrogate pair could not be saved.
    except (OverflowError, UnicodeEncodeError) as error:
        raise argparse.ArgumentTypeError(f"the value of {name} cannot be saved: {error}") from error
    return name, parsed


def join(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Raises:
    UserError: a name twice.
    """
    arguments: dict[str, Any] = {}
    for name, value in pairs:
        if name in arguments:
            raise UserError(f"--env-arg {name} was given twice: {arguments[name]!r} and {value!r}")
        arguments[name] = value
    return arguments


def write(arguments: Mapping[str, Any]) -> list[str]:
    """What `read` reads: [NAME=VALUE, ...]."""
    return [f"{name}={value if _is_plain(value) else json.dumps(value)}" for name, value in arguments.items()]


def checked(arguments: Any) -> dict[str, Any]:
    """Keyword arguments that were given as values of Python.

    Raises:
      TypeError, ValueError, OverflowError: they are none, or files would hold others.
    """
    check(arguments)
    text = json.dumps(arguments, ensure_ascii=False)
    text.encode("utf-8")  # Half a surrogate pair could not be saved.
    if _parse(text) != arguments:
        raise ValueError("JSON has no such values")
    return dict(arguments)


def check(arguments: Any) -> None:
    """Raises:
    ValueError: not keyword arguments.
    """
    if not isinstance(arguments, dict) or not all(isinstance(name, str) and name.isidentifier() for name in arguments):
        raise ValueError(f"expected keyword arguments of an environment, got {arguments!r:.80}")


def _parse(value: str) -> Any:
    try:
        return json.loads(value, parse_int=_int64, parse_float=_finite, parse_constant=_no_json)
    except (ValueError, RecursionError):
        return value


def _is_plain(value: Any) -> bool:
    """Whether a value is a text that stands for itself."""
    try:
        return isinstance(value, str) and _parse(value) is value
    except OverflowError:
        return False


def _int64(text: str) -> int:
    value = int(text) if len(text) < 30 else 2**63
    if not -(2**63) <= value < 2**63:
        raise OverflowError(f"{text:.40} is not a number of 64 bits")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise OverflowError(f"{text:.40} is not a number of 64 bits")
    return value


def _no_json(text: str) -> NoReturn:
    raise ValueError(f"{text} is not JSON")
