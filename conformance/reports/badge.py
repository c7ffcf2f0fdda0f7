"""The result as a badge: an SVG that stands in a README."""

from html import escape

from conformance.reports import summary
from conformance.reports.summary import Data

LABEL = "DreamerV3 conformance"
GREEN, YELLOW, RED, GREY = "#1a7f37", "#8a6100", "#b3123a", "#59636e"
HEIGHT, PADDING, CHARACTER = 20, 7, 6.4  # of 11 px text; the text is stretched to fit, so that any font does


def render(data: Data) -> str:
    right, color = outcome(data)
    widths = [round(len(part) * CHARACTER + 2 * PADDING) for part in (LABEL, right)]
    total = sum(widths)
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{total}" height="{HEIGHT}" role="img" '
            f'aria-label="{escape(f"{LABEL}: {right}")}">'
        ),
        f"<title>{escape(f'{LABEL}: {right}')}</title>",
        f'<clipPath id="r"><rect width="{total}" height="{HEIGHT}" rx="4"/></clipPath>',
        f'<g clip-path="url(#r)"><rect width="{widths[0]}" height="{HEIGHT}" fill="#343b45"/>'
        f'<rect x="{widths[0]}" width="{widths[1]}" height="{HEIGHT}" fill="{color}"/></g>',
        '<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">',
        _text(LABEL, PADDING, widths[0]),
        _text(right, widths[0] + PADDING, widths[1]),
        "</g></svg>",
    ]
    return "\n".join(parts) + "\n"


def outcome(data: Data) -> tuple[str, str]:
    """The words on the right, and their colour. Yellow: failures that are expected, and no other."""
    counts, offered = summary.counts(data), summary.judged(data)
    if not offered:
        return "nothing offered", GREY
    if not data["verdict"]["passed"]:
        failing = counts["fail"] + counts["error"]
        return (f"{failing} of {offered} checks fail" if failing else "failing"), RED
    expected = counts["expected failure"]
    return (
        (f"{counts['pass']} of {offered} checks", YELLOW)
        if expected
        else (f"{offered} {'check passes' if offered == 1 else 'checks pass'}", GREEN)
    )


def _text(words: str, x: float, width: float) -> str:
    return (
        f'<text x="{x}" y="14" textLength="{width - 2 * PADDING}" '
        f'lengthAdjust="spacingAndGlyphs">{escape(words)}</text>'
    )
