"""The requirement ids of the chapters."""

import functools
import re
from collections.abc import Collection
from importlib import resources

_REQUIREMENT = re.compile(r"^- \*\*\[([A-Z]{2,6}-\d+)\]\*\* (.*(?:\n  .*)*)$", re.MULTILINE)
MANY = 10
"""A check of so many requirements judges them jointly: it says little of each."""


@functools.cache
def requirements() -> dict[str, str]:
    """Requirement id -> its text in one line, in the order of the chapters.

    Raises:
      ValueError: an id that two requirements share.
    """
    found: dict[str, str] = {}
    for chapter in sorted(
        path.name for path in resources.files("spec").iterdir() if re.match(r"\d\d-.*\.md$", path.name)
    ):
        text = resources.files("spec").joinpath(chapter).read_text(encoding="utf-8")
        for identifier, lines in _REQUIREMENT.findall(text):
            if identifier in found:
                raise ValueError(f"{chapter}: the requirement id {identifier} is used twice")
            found[identifier] = " ".join(lines.split())
    return found


@functools.cache
def chapter_of(requirement: str) -> str:
    """The chapter's path, such as spec/07-returns.md.

    Raises:
      ValueError: no chapter has such a requirement.
    """
    for path in sorted(resources.files("spec").iterdir(), key=lambda path: path.name):
        if re.match(r"\d\d-.*\.md$", path.name) and f"- **[{requirement}]** " in path.read_text(encoding="utf-8"):
            return f"spec/{path.name}"
    raise ValueError(f"no chapter has the requirement {requirement}")


def check_label(name: str, covered: Collection[str]) -> str:
    """The name of a check where it is listed for one of the requirements that it covers: losses.actor_matches (jointly
    with 11 others), if they are MANY."""
    return f"{name} (jointly with {len(covered) - 1} others)" if len(covered) >= MANY else name
