"""The few building blocks of the page."""

from collections.abc import Sequence
from html import escape


def cell(text: str, kind: str = "") -> str:
    return f'<td class="{kind}">{escape(text)}</td>' if kind else f"<td>{escape(text)}</td>"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """header: plain text. rows: cells. numbers: the columns that are set to the right."""
    cells = (
        f"<th{' class=number' if index in numbers else ''}>{escape(name)}</th>" for index, name in enumerate(header)
    )
    head = f"<thead><tr>{''.join(cells)}</tr></thead>" if header else ""
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    return f'<div class="scroll"><table>{head}<tbody>{body}</tbody></table></div>'


def details(summary: str, content: str, kind: str = "", is_open: bool = False) -> str:
    """summary: plain text. content: markup."""
    attributes = (f' class="{kind}"' if kind else "") + (" open" if is_open else "")
    return f"<details{attributes}><summary>{escape(summary)}</summary>{content}</details>"


def breakable(name: str) -> str:
    """The name of a metric, which may go on in a new line after a slash or an underscore."""
    return escape(name).replace("/", "/<wbr>").replace("_", "_<wbr>")


def swatch(color: int) -> str:
    return f'<span class="swatch c{color % 8}"></span>'
