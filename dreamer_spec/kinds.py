"""Kinds of values that an option can have, as text of a command line and as value of Python, and what is said of
others."""

import argparse
import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

from dreamer_spec.errors import UserError

LONGEST, LARGEST = 1e9, 1e9  # seconds, GiB: more than anybody means, and less than the system refuses
MOST_SEEDS = 1000
WRONG = (TypeError, ValueError, OverflowError)


@dataclasses.dataclass(frozen=True)
class Kind:
    """expected: such a value, in words. metavar: what `--help` calls it. choices: all that there are, if they are
    few.

    take: the value that `Options` holds for a value of Python; raises one of WRONG where it is of another kind. read:
    the value of Python that a text stands for.
    """

    expected: str
    metavar: str | None
    take: Callable[[Any], Any]
    read: Callable[[str], Any] = str
    choices: tuple[str, ...] | None = None

    def of_text(self, text: str) -> Any:
        """For argparse.

        Raises:
          argparse.ArgumentTypeError: the text stands for no such value.
        """
        try:
            return self.take(self.read(text))
        except WRONG:
            raise argparse.ArgumentTypeError(f"{text!r} is not {self.expected}") from None

    def of_value(self, name: str, value: Any) -> Any:
        """Raises:
        UserError: the value of that name is of another kind.
        """
        try:
            return self.take(value)
        except WRONG:
            raise UserError(f"{name} is {value!r:.200}; expected {self.expected}") from None


def whole(least: int | None = None) -> Kind:
    def take(value: Any) -> int:
        number = _real(value)
        _require(number.is_integer() and abs(number) < 2**53 and (least is None or number >= least))
        return int(number)

    return Kind(f"a whole number{'' if least is None else f' of at least {least}'}", "N", take, float)


def real(expected: str, metavar: str, fits: Callable[[float], bool] = lambda value: True) -> Kind:
    def take(value: Any) -> float:
        number = _real(value)
        _require(fits(number))
        return number

    return Kind(expected, metavar, take, float)


def choice(names: Iterable[str], metavar: str | None = None) -> Kind:
    known = tuple(names)

    def take(value: Any) -> str:
        _require(value in known)
        return str(value)

    return Kind(f"one of {', '.join(known)}", metavar, take, choices=known)


def text(metavar: str) -> Kind:
    return Kind("a text", metavar, _text)


def path(expected: str, metavar: str) -> Kind:
    def take(value: Any) -> Path:
        _require(os.fspath(value) != "")
        return Path(value)

    return Kind(f"{expected}, whose name is not empty", metavar, take)


def of_default(value: Any) -> Kind:
    """The kind of a hyperparameter with that default. Its range is checked by spec/config.py."""
    if isinstance(value, bool):
        return BOOLEAN
    if isinstance(value, list):
        return WHOLE_NUMBERS
    return whole() if isinstance(value, int) else NUMBER


def _require(condition: bool) -> None:
    if not condition:
        raise ValueError


def _real(value: Any) -> float:
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError
    return float(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value


def _boolean(value: Any) -> bool:
    if type(value).__name__ not in ("bool", "bool_"):  # Python's or NumPy's
        raise TypeError
    return bool(value)


def _words(value: Any) -> tuple[str, ...]:
    parts = value.split(",") if isinstance(value, str) else value
    words = tuple(_text(word) for word in parts if word)
    _require(words != ())
    return words


def _names(value: Any) -> str:
    return value if isinstance(value, str) else ",".join(_words(value))


def _whole_numbers(value: Any) -> list[int]:
    _require(isinstance(value, Sequence) and not isinstance(value, str))
    return [whole().take(number) for number in value]


def _seeds(value: Any) -> list[int]:
    """0-2,5 -> [0, 1, 2, 5]"""
    seeds: list[int] = []
    for part in _text(value).split(","):
        ends = re.fullmatch(r"([0-9]{1,15})(?:-([0-9]{1,15}))?", part.strip())
        first, last = (int(ends[1]), int(ends[2] or ends[1])) if ends else (0, -1)
        _require(first <= last < first + MOST_SEEDS)
        seeds += range(first, last + 1)
    _require(len(set(seeds)) == len(seeds))
    return seeds


NUMBER = real("a number", "X")
SECONDS = real(f"a time in seconds, from 0 to {LONGEST:g}", "SECONDS", lambda value: 0 <= value <= LONGEST)
GIB = real(f"a number above 0 and up to {LARGEST:g}", "GIB", lambda value: 0 < value <= LARGEST)
BOOLEAN = Kind(
    "true or false", "true|false", _boolean, lambda text: {"true": True, "false": False}.get(text.lower(), text)
)
FLAG = dataclasses.replace(BOOLEAN, metavar=None)  # --name or --no-name
SWITCH = dataclasses.replace(BOOLEAN, metavar="")  # --name or nothing
WORDS = Kind("a list of keys, at least one", "KEY,...", _words)
NAMES = Kind("a list of names", "NAME,...", _names)
WHOLE_NUMBERS = Kind(
    "a list of whole numbers", "N,N,...", _whole_numbers, lambda text: [float(part) for part in text.split(",")]
)
SEEDS = Kind(f"a list of different seeds such as 0-4 or 0,2,5, of at most {MOST_SEEDS:,}", "N-M,...", _seeds)
