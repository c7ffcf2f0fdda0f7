"""What the reports have in common: how a result is told in words, by chapter and by requirement."""

import dataclasses
import functools
import importlib.metadata
from collections import Counter
from collections.abc import Iterator, Mapping
from importlib import resources
from typing import Any

from spec import editions

Data = Mapping[str, Any]

FAILING = ("fail", "error")
STATUSES = ("pass", "fail", "error", "expected failure", "partly offered", "not offered", "not in edition")
"""Of a requirement, as told: a failure may be expected, and some of its checks may be offered and others not."""


@dataclasses.dataclass(frozen=True)
class Chapter:
    """What was found for the requirements of one chapter. counts: of STATUSES. share: the worst, None where it has no size."""

    path: str
    requirements: tuple[str, ...]
    counts: Counter[str]
    share: float | None
    where: str

    @property
    def title(self) -> str:
        return title(self.path)


def title(path: str) -> str:
    """The heading of a chapter: 07 Returns, of spec/07-returns.md. Of what is no chapter, the path."""
    return _titles().get(path, path)


@functools.cache
def _titles() -> dict[str, str]:
    files = [file for file in resources.files("spec").iterdir() if file.name.endswith(".md")]
    headings = {f"spec/{file.name}": file.read_text(encoding="utf-8").partition("\n")[0].partition(":")[0] for file in files}
    return {path: heading.lstrip("# ").replace(" · ", " ") for path, heading in headings.items()}


def chapters(data: Data) -> list[Chapter]:
    """In the order of the book."""
    by_path: dict[str, list[str]] = {}
    for name, entry in data["requirements"].items():
        by_path.setdefault(entry["chapter"], []).append(name)
    return [_chapter(data, path, names) for path, names in sorted(by_path.items())]


def _chapter(data: Data, path: str, names: list[str]) -> Chapter:
    entries = [data["requirements"][name] for name in names]
    worst = max(entries, key=lambda entry: float("inf") if entry["share"] is None else entry["share"])
    return Chapter(path, tuple(names), Counter(status(data, name) for name in names), worst["share"], worst["where"])


def status(data: Data, requirement: str) -> str:
    """One of STATUSES."""
    entry = data["requirements"][requirement]
    checks = [data["checks"][name] for name in entry["checks"] if name in data["checks"]]
    if entry["status"] in FAILING and all(check["expected_failure"] for check in checks if check["status"] in FAILING):
        return "expected failure"
    if entry["status"] == "not offered" and any(check["status"] == "pass" for check in checks):
        return "partly offered"
    return str(entry["status"])


def counts(data: Data) -> Counter[str]:
    """Checks by status; a failure that is expected counts as such."""
    return Counter("expected failure" if is_expected(check) else check["status"] for check in data["checks"].values())


def is_expected(check: Data) -> bool:
    return check["status"] in FAILING and check["expected_failure"] is not None


def failures(data: Data) -> Iterator[tuple[str, Data]]:
    """The checks that failed; those that nobody expected come first."""
    failing = [(name, check) for name, check in data["checks"].items() if check["status"] in FAILING]
    yield from sorted(failing, key=lambda item: is_expected(item[1]))


def judged(data: Data) -> int:
    """How many checks were offered, and say something in the edition."""
    return sum(check["status"] not in ("not offered", "not in edition") for check in data["checks"].values())


def edition(data: Data) -> list[str]:
    """What the candidate was judged as and why, and which editions fit how well: sentences."""
    found = editions().get(data["edition"])
    title = f" ({found.title})" if found else ""
    reason = {"given": "as asked", "claimed": "as it claims", "best fit": "which fits best"}[data["choice"]]
    if data["choice"] == "given" and (claimed := data["implementation"]["edition"]) not in (None, data["edition"]):
        reason += f"; it claims {claimed}"
    lines = [f"Judged as the edition {data['edition']}{title}, {reason}."]
    if (fit := data["fit"]) is None:
        return lines
    counts = (f"{entry['edition']} {entry['passed']} of {entry['judged']}" for entry in fit["editions"])
    lines.append(f"Of the checks that tell editions apart pass: {', '.join(counts)}.")
    if fit["better"]:
        lines.append(f"The edition {fit['better']} fits better.")
    if fit["alike"]:
        lines.append(f"Nothing that is offered tells {data['edition']} from {' or '.join(fit['alike'])}.")
    return lines


def label(data: Data) -> str:
    """Name and version of the implementation."""
    return f"{data['implementation']['name']} {data['implementation']['version']}".strip()


def settings(data: Data) -> str:
    """What the cases were drawn with, and by which kit: enough to draw them again."""
    kit = data["versions"].get("dreamer-spec")
    parts = [data["dtype"], f"on {data['device']}" if data["device"] else "", f"edition {data['edition']}"]
    parts += [f"seed {data['seed']}", f"{data['examples']} examples", f"only {data['only']!r}" if data["only"] else ""]
    return ", ".join(filter(None, [*parts, f"dreamer-spec {kit}" if kit else "dreamer-spec, not installed"]))


def headline(data: Data) -> str:
    """The outcome in a line."""
    number, total = judged(data), len(data["checks"])
    if data["verdict"]["passed"]:
        return f"passed: conforms in what it offers, {number} of {total} checks"
    return f"failed: {'; '.join(data['verdict']['problems'])}"


def tally(data: Data) -> str:
    """Checks by status, in words."""
    found = counts(data)
    numbers = sum(check["compared"] for check in data["checks"].values())
    parts = [f"{found[name]} {name}" for name in STATUSES if found[name]]
    return f"{len(data['checks'])} checks, {numbers:,} numbers compared: {', '.join(parts)}"


def percent(share: float | None) -> str:
    """A share of what is allowed; factors above 10, and nothing where it has no size."""
    if share is None:
        return "no number"
    if share > 10:
        return f"{share:.0f}×" if share < 1e4 else f"{share:.0e}×".replace("e+", "e")
    return f"{share:.0%}"


def values(failure: Data) -> list[Data]:
    """Arguments, and what came of them."""
    return [*failure["arguments"], *(failure[name] for name in ("got", "expected") if failure[name])]


def matching(data: Data, check: str) -> list[Data]:
    """The diagnoses that explain a check."""
    return [diagnosis for diagnosis in data["diagnoses"] if check in diagnosis["explained"]]


@functools.cache
def repository() -> str:
    """The web address of the repository, as the installed package states it; "" if it states none."""
    try:
        addresses = importlib.metadata.metadata("dreamer-spec").get_all("Project-URL") or []
    except importlib.metadata.PackageNotFoundError:
        return ""
    named = dict(address.split(", ", 1) for address in addresses)
    return next((url.rstrip("/") for name, url in named.items() if name.lower() in ("repository", "source", "homepage")), "")


def address(path: str) -> str:
    """Of a file of the repository on the web; "" if the repository has none."""
    return f"{repository()}/blob/main/{path}" if repository().startswith("https://") else ""
