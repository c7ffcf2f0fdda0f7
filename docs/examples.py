"""Prints the worked numbers of a chapter: spec/examples/<chapter>.toml as Markdown.

The text of an example has its numbers in braces, by the names of the file: `{discount}`, `{gives[0][2]}`,
`{gives[mean]}`. Of several cases each name is the list over the cases. Behind a colon stands how to print them:
`{gives:.6f}` rounds, `{reward[0]:row}` makes the cells of a table row, `{gives[0]:row bold .4f}` does all of it.
Without, numbers are printed as they are written. Braces of a formula are doubled.
"""

import re
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

from spec.worked import Example, examples, number


class Printed:
    """A value of an example, for `str.format`."""

    def __init__(self, written: Any) -> None:
        self._written = written

    def __getitem__(self, key: str | int) -> "Printed":
        if isinstance(self._written, list) and isinstance(key, str):  # one part of the result of each case
            return Printed([entry[key] for entry in self._written])
        return Printed(self._written[str(key) if isinstance(self._written, Mapping) else key])

    def __format__(self, spec: str) -> str:
        words = spec.split()
        digits = next((word for word in words if word.startswith(".")), "")
        if "row" not in words:
            return _text(self._written, digits)
        around = "**" if "bold" in words else ""
        return " | ".join(f"{around}{_text(cell, digits)}{around}" for cell in self._written)


def _text(written: Any, digits: str) -> str:
    if isinstance(written, list):
        return "[" + ", ".join(_text(entry, digits) for entry in written) + "]"
    if isinstance(written, bool):
        return str(written).lower()
    if isinstance(written, str):
        return format(number(written), digits) if digits else written
    if isinstance(written, Decimal) and not written.is_finite():
        return str(float(written)).replace("nan", "NaN")
    if digits and isinstance(written, Decimal):
        return format(written, digits)
    return re.sub(r"\.0$", "", str(written)).replace("E+", "e").replace("E", "e")


def markdown(argument: str) -> str:
    """The examples of `chapter`, or those of `chapter; name; name`, a paragraph or more each.

    Raises:
      ValueError: there is no such example, or its text names what it does not have.
    """
    chapter, *names = (part.strip() for part in argument.split(";"))
    known = examples(chapter)
    if unknown := set(names) - set(known):
        raise ValueError(f"{chapter} has no example named {', '.join(sorted(unknown))}; known: {', '.join(known)}")
    return "\n\n".join(paragraph(known[name]) for name in names or known) + "\n"


def paragraph(example: Example) -> str:
    """Title, function, requirements and text."""
    title = re.sub("^.", lambda first: first[0].upper(), example.name)
    cited = ", ".join(f"[{requirement}]" for requirement in example.requirements)
    try:
        text = example.text.strip().format(**_values(example))
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(
            f"{example.chapter}: {example.name!r}: a placeholder of its text has no number: {error}"
        ) from error
    blank = "\n" if text.startswith(("|", "-")) else ""
    return f"**{title}** (`{example.function}`, {cited}).\n{blank}{text}"


def _values(example: Example) -> dict[str, Printed]:
    """The names of a text: what the cases share, and lists of that in which they differ."""
    cases = [{**example.written, **case.written} for case in example.cases]
    if len(cases) == 1:
        return {name: Printed(value) for name, value in cases[0].items()}
    names = dict.fromkeys(name for case in cases for name in case)
    lists = {name: [case.get(name) for case in cases] for name in names}
    shared = {name for name in example.written if all(value == lists[name][0] for value in lists[name])}
    return {name: Printed(values[0] if name in shared else values) for name, values in lists.items()}
