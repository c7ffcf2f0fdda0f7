"""What every metric is: dreamer_spec/metrics.toml, from which docs/metrics.md and the pages are made."""

import dataclasses
import functools
import re
import tomllib
from importlib import resources


@dataclasses.dataclass(frozen=True)
class Metric:
    """name: as in metrics.jsonl, <key> standing for the key of an observation. unit: "" for a bare number. The others:
    prose."""

    name: str
    unit: str
    what: str
    healthy: str
    trouble: str


@dataclasses.dataclass(frozen=True)
class Section:
    title: str
    about: str
    metrics: tuple[Metric, ...]


@functools.cache
def sections() -> dict[str, Section]:
    """All that is known, in the order of the file."""
    table = tomllib.loads(resources.files("dreamer_spec").joinpath("metrics.toml").read_text(encoding="utf-8"))
    return {name: _section(dict(entries)) for name, entries in table.items()}


def _section(entries: dict) -> Section:
    title, about = entries.pop("title"), entries.pop("about")
    return Section(title, about, tuple(Metric(name, **entry) for name, entry in entries.items()))


@functools.cache
def _patterns() -> list[tuple[re.Pattern[str], str, Metric]]:
    """The longest names first: <key>_context_error is not the <key>_error of a longer key."""
    found = [(section, metric) for section, content in sections().items() for metric in content.metrics]
    found.sort(key=lambda entry: -len(entry[1].name))
    return [
        (re.compile(re.escape(metric.name).replace("<key>", ".+"), re.DOTALL), section, metric)
        for section, metric in found
    ]


@functools.lru_cache(maxsize=10_000)
def find(name: str) -> tuple[str, Metric] | None:
    """The section and the entry of a metric as it stands in metrics.jsonl; None if nobody has described it."""
    return next(((section, metric) for pattern, section, metric in _patterns() if pattern.fullmatch(name)), None)


def markdown() -> str:
    """The sections for docs/metrics.md."""
    return "\n".join(_section_markdown(section) for section in sections().values())


def _section_markdown(section: Section) -> str:
    lines = [f"## {section.title}", "", section.about]
    for metric in section.metrics:
        lines += ["", f"### `{metric.name}`", "", metric.what + (f" Unit: {metric.unit}." if metric.unit else "")]
        lines += ["", f"- **Healthy.** {metric.healthy}", f"- **Trouble.** {metric.trouble}"]
    return "\n".join(lines) + "\n"
