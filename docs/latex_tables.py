r"""Reads the tables of scores in the LaTeX source of the paper: cells as text, nothing guessed.

A table is what stands between \begin{mytabular} and \end{mytabular}; its name is the \label that follows. What the
paper's markup does to a cell is done here too: \textbf and \clap only dress it, \o is a blank as wide as a digit,
\llap{--} is the minus sign of a number. Any other command is an error.
"""

import dataclasses
import re
from collections.abc import Collection

MISSING = "---"
_DRESS = re.compile(r"\\(?:textbf|clap|rlap)\{([^{}]*)\}")
_RULES = re.compile(r"\\(?:toprule|bottomrule)")


@dataclasses.dataclass(frozen=True)
class LatexTable:
    r"""parts: what lies between the \midrule lines, each a list of rows of cells. caption: what follows, up to the
    label."""

    label: str
    parts: list[list[list[str]]]
    caption: str


def read_tables(source: str, labels: Collection[str]) -> dict[str, LatexTable]:
    """The tables of these labels. Others, such as those of hyperparameters, are not looked at.

    Raises:
      ValueError: a table that is not there, that has no end, rows of different lengths, or a command that is not
        understood.
    """
    text = re.sub(r"(?<!\\)%.*", "", source)
    tables: dict[str, LatexTable] = {}
    for begin in re.finditer(r"\\begin\{mytabular\}", text):
        body_at = _after_group(text, text.index("{", begin.end()))
        end = text.find(r"\end{mytabular}", body_at)
        label = re.search(r"\\label\{([^}]*)\}", text[end:]) if end >= 0 else None
        if label is None:
            raise ValueError(f"the table at character {begin.start():,} has no end or no label")
        caption = text[end + len(r"\end{mytabular}") : end + label.start()]
        if (name := label.group(1)) in labels:
            tables[name] = LatexTable(name, _parts(text[body_at:end], name), caption)
    if missing := set(labels) - set(tables):
        raise ValueError(f"the source has no table {', '.join(sorted(missing))}")
    return tables


def _after_group(text: str, opening: int) -> int:
    """The place behind the brace that closes the one at `opening`."""
    depth = 0
    for index in range(opening, len(text)):
        depth += {"{": 1, "}": -1}.get(text[index], 0)
        if depth == 0:
            return index + 1
    raise ValueError(f"the brace at character {opening:,} is not closed")


def _parts(body: str, label: str) -> list[list[list[str]]]:
    parts = [_rows(part) for part in _RULES.sub("", body).split(r"\midrule")]
    lengths = {len(row) for part in parts for row in part}
    if len(lengths) != 1:
        raise ValueError(f"{label}: the rows have {sorted(lengths)} cells; expected one number")
    return parts


def _rows(part: str) -> list[list[str]]:
    lines = (line for line in part.split(r"\\") if line.strip())
    return [[cell_text(cell) for cell in re.split(r"(?<!\\)&", line)] for line in lines]


def cell_text(cell: str) -> str:
    r"""\textbf{\o\o56835} -> 56835, \o\llap{--}19 -> -19, \o--- -> ---

    Raises:
      ValueError: a command that is not understood.
    """
    text = re.sub(r"\\o(?![a-zA-Z])", "", cell).replace(r"\llap{--}", "-").replace(r"\newline", " ")
    while (undressed := _DRESS.sub(r"\1", text)) != text:
        text = undressed
    text = " ".join(text.replace(r"\%", "%").split())
    if re.search(r"[\\{}$]", text):
        raise ValueError(f"the cell {cell.strip()!r} holds markup that is not understood")
    return text


def number(cell: str) -> str:
    """The digits of a cell as they are printed, without separators of thousands; nothing for a missing entry.

    Raises:
      ValueError: not a number.
    """
    if cell == MISSING:
        return ""
    digits = re.sub(r"(?<=\d),(?=\d{3}(?!\d))", "", cell)
    if not re.fullmatch(r"-?\d+(\.\d+)?", digits):
        raise ValueError(f"{cell!r} is not a number")
    return digits
