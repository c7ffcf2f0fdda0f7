"""The result as a badge: an SVG that stands in a README."""

from conformance import pages
from conformance.reports import summary
from conformance.reports.summary import Data

LABEL = "DreamerV3 conformance"
GREEN, YELLOW, RED, GREY = "#1a7f37", "#8a6100", "#b3123a", "#59636e"
PADDING, CHARACTER = 7, 6.4  # of 11 px text; the text is stretched to fit, so that any font does


def render(data: Data) -> str:
    words, color = outcome(data)
    widths = [round(len(part) * CHARACTER + 2 * PADDING) for part in (LABEL, words)]
    return pages.render(__package__, "badge.svg", label=LABEL, words=words, color=color, widths=widths, padding=PADDING)


def outcome(data: Data) -> tuple[str, str]:
    """The words on the right, and their colour. Yellow: failures that are expected, and no other."""
    counts, offered = summary.counts(data), summary.judged(data)
    if not offered:
        return "nothing offered", GREY
    if not data["verdict"]["passed"]:
        failing = counts["fail"] + counts["error"]
        return (f"{failing} of {offered} checks fail" if failing else "failing"), RED
    if counts["expected failure"]:
        return f"{counts['pass']} of {offered} checks", YELLOW
    return f"{offered} {'check passes' if offered == 1 else 'checks pass'}", GREEN
