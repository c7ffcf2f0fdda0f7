"""What the reports have in common: how a result is told in words, by chapter and by requirement."""

import dataclasses
import functools
import importlib.metadata
import itertools
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from typing import Any

from conformance.execute import NOT_IMPLEMENTED
from conformance.pages import tex
from conformance.requirements import check_label
from spec import editions

Data = Mapping[str, Any]

FAILING = ("fail", "error")
EXTREME = "fail at extremes"
STATUSES = ("pass", "fail", "error", EXTREME, "expected failure", "partly offered", "not offered", "not in edition")
"""As told: a failure may be only with extreme input, or expected; of a requirement, some checks may be offered and
others not."""
NAMED = 3  # checks that a line names
CUT = "Not all were compared with all known mistakes: the search ends after the same amount of work on every machine."
SENTENCES = 3  # requirements of a check that are told in full
LIKENESS = {
    "known": ("behaves like", "nearest known mistake:"),
    "pair": ("behaves like two mistakes at once:", "nearest known mistakes, both at once:"),
    "generated": (
        "no known mistake, but generated from the equation",
        "no known mistake; the nearest variant that is generated from an equation",
    ),
}
"""Words before the name of a mutant, by its kind: where nothing speaks against it, and where something does."""
UNMEASURED = "not measurable"
SCALE = (
    "The worst deviation, as a share of the allowed one: 100% is the limit, and 20× is twenty times as much. "
    f"{UNMEASURED.capitalize()}: an exception, NaN, a wrong shape, a condition that does not hold, or "
    f"unequal numbers that must be equal."
)


@dataclasses.dataclass(frozen=True)
class Failures:
    """The checks that failed, by name. extreme: only with extreme input. In each, those come first that a recognized
    mistake explains, and of these those with numbers that can be followed by hand."""

    ordinary: list[tuple[str, Data]]
    extreme: list[tuple[str, Data]]
    expected: list[tuple[str, Data]]

    def __str__(self) -> str:
        """4 checks fail, 11 more only with extreme input."""
        ordinary, extreme = len(self.ordinary), len(self.extreme)
        fail = f"{ordinary or extreme} {'check fails' if (ordinary or extreme) == 1 else 'checks fail'}"
        return (
            f"{fail}, {extreme} more only with extreme input"
            if ordinary and extreme
            else fail + ", only with extreme input" * (not ordinary)
        )


@dataclasses.dataclass(frozen=True)
class Chapter:
    """What was found for the requirements of one chapter. counts: of STATUSES. share: the worst, None where it has no
    size."""

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
    headings = {
        f"spec/{file.name}": file.read_text(encoding="utf-8").partition("\n")[0].partition(":")[0] for file in files
    }
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
    if failing := {told(check) for check in checks if check["status"] in FAILING}:
        return next(name for name in ("error", "fail", EXTREME, "expected failure") if name in failing)
    if entry["status"] == "not offered" and any(check["status"] == "pass" for check in checks):
        return "partly offered"
    return str(entry["status"])


def counts(data: Data) -> Counter[str]:
    """Checks by status, as told."""
    return Counter(map(told, data["checks"].values()))


def told(check: Data) -> str:
    """One of STATUSES: what the status of a check comes to."""
    if is_expected(check):
        return "expected failure"
    return EXTREME if check["extreme"] else str(check["status"])


def is_expected(check: Data) -> bool:
    return check["status"] in FAILING and check["expected_failure"] is not None


def failures(data: Data) -> Failures:
    failing = [(name, check) for name, check in data["checks"].items() if check["status"] in FAILING]
    failing.sort(key=lambda item: (not matching(data, item[0]), not item[1]["failure"].get("by_hand")))
    unexpected = [item for item in failing if not is_expected(item[1])]
    return Failures(
        ordinary=[item for item in unexpected if not item[1]["extreme"]],
        extreme=[item for item in unexpected if item[1]["extreme"]],
        expected=[item for item in failing if is_expected(item[1])],
    )


def judged(data: Data) -> int:
    """How many checks were offered, and say something in the edition."""
    return sum(check["status"] not in ("not offered", "not in edition") for check in data["checks"].values())


def edition(data: Data) -> list[str]:
    """What the candidate was judged as and why, and which editions fit how well: sentences."""
    found = editions().get(data["edition"])
    title = f" ({found.title})" if found else ""
    fits = "which fits as well as any" if data["fit"] and data["fit"]["alike"] else "which fits best"
    reason = {"given": "as asked", "claimed": "as it claims", "best fit": fits}[data["choice"]]
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


def names(results: Sequence[Data], origins: Sequence[str]) -> list[str]:
    """A name for each of several results: its label, and among equal ones precision and edition, and then the
    origin."""
    found = [label(data) for data in results]
    for parts in ([f" {data['dtype']}, {data['edition']}" for data in results], [f", {origin}" for origin in origins]):
        shared = Counter(found)
        found = [name + part * (shared[name] > 1) for name, part in zip(found, parts, strict=True)]
    return found


def cause(message: str) -> str:
    """Of a traceback the exception, of another message all of it."""
    _, _, last_frame = message.rpartition('\n  File "')
    lines = last_frame.splitlines()
    return (
        "\n".join(itertools.dropwhile(lambda line: line.startswith(" "), lines[1:]))
        if message.startswith("Traceback")
        else message.rstrip()
    )


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
    return f"failed: {'; '.join(problems(data))}"


def outcome(data: Data) -> str:
    """The verdict in a few words."""
    if data["verdict"]["passed"]:
        return "Conforms in what it offers"
    extremes_alone = failures(data).extreme and not failures(data).ordinary and len(data["verdict"]["problems"]) == 1
    return "Conforms with ordinary input only" if extremes_alone else "Does not conform"


def problems(data: Data) -> list[str]:
    """What stands against the run, with the failures told apart: the verdict counts them all in its first problem."""
    found = failures(data)
    rest = data["verdict"]["problems"]
    return [str(found), *rest[1:]] if found.ordinary or found.extreme else list(rest)


def unchecked(data: Data) -> list[str]:
    """Lines, if any: the functions that are offered and that no check could use, and what is said to be not
    implemented."""
    lacking = [f"{entry['function']} (needs {', '.join(entry['needs'])})" for entry in data["unchecked"]]
    messages = (check["message"] for check in data["checks"].values() if check["status"] in ("not offered", "pass"))
    absent = dict.fromkeys(
        message.removeprefix(NOT_IMPLEMENTED).rstrip() for message in messages if message.startswith(NOT_IMPLEMENTED)
    )
    parts = {"Offered but not checked": lacking, "Not implemented, as the candidate says": absent}
    return [f"{words}: {', '.join(entries)}." for words, entries in parts.items() if entries]


def notes(data: Data) -> list[str]:
    """What is to be known of a run beside its outcome: sentences."""
    return [*edition(data), *unchecked(data), *without_gradients(data), *undiagnosed(data)]


def without_gradients(data: Data) -> list[str]:
    """A line, if any: the functions of which values alone were judged."""
    names = data["without_gradients"]
    return [f"Gradients were not looked at: {', '.join(names)}."] if names else []


def undiagnosed(data: Data) -> list[str]:
    """Lines, if any: which failures no known mistake explains, and whether all were compared."""
    if data["diagnoses"] is None:
        return ["No diagnosis was made (--no-diagnosis)."]
    failing = [name for name, check in data["checks"].items() if check["status"] in FAILING]
    left = [name for name in failing if not matching(data, name)]
    if not left:
        return []
    others = f" and {len(left) - NAMED} others" if len(left) > NAMED else ""
    lines = [f"No known mistake fits {', '.join(left[:NAMED])}{others}."]
    return lines + [CUT] * bool(data.get("diagnosis_is_cut"))


def tally(data: Data) -> str:
    """Checks by status, in words."""
    found = counts(data)
    numbers = sum(check["compared"] for check in data["checks"].values())
    parts = [f"{found[name]} {name}" for name in STATUSES if found[name]]
    return f"{len(data['checks'])} checks, {numbers:,} numbers compared: {', '.join(parts)}"


def percent(share: float | None) -> str:
    """A share of what is allowed; factors above 10, and words where it has no size: SCALE explains them."""
    if share is None:
        return UNMEASURED
    if share > 10:
        return f"{share:.0f}×" if share < 1e4 else f"{share:.0e}×".replace("e+", "e")
    return f"{share:.0%}"


def values(failure: Data) -> list[Data]:
    """Arguments, and what came of them."""
    return [*failure["arguments"], *(failure[name] for name in ("got", "expected") if failure[name])]


def chapters_of(data: Data, check: Data) -> list[str]:
    """The paths of the chapters whose requirements a check covers."""
    known = data["requirements"]
    return sorted({known[name]["chapter"] for name in check["requirements"] if name in known})


def demands(data: Data, check: Data) -> list[str]:
    """`sentences` of the requirements of a check, as the result has them."""
    known = data["requirements"]
    return sentences({name: known[name]["text"] for name in check["requirements"] if name in known})


def sentences(texts: Mapping[str, str]) -> list[str]:
    """What requirements say, by their ids, in Markdown without links and formulas: of many, the first few."""
    found = [f"{name}: {tex.plain(text)}" for name, text in texts.items()]
    return found[:SENTENCES] + [f"and {len(found) - SENTENCES} more"] * (len(found) > SENTENCES)


def checks_of(data: Data, requirement: str, statuses: Collection[str] = STATUSES) -> list[str]:
    """The checks of a requirement that were run and came to one of these statuses, each with its label."""
    names = data["requirements"].get(requirement, {"checks": []})["checks"]
    found = {name: data["checks"][name] for name in names if name in data["checks"]}
    return [check_label(name, check["requirements"]) for name, check in found.items() if told(check) in statuses]


def diagnoses(data: Data) -> list[Data]:
    """The mistakes recognized."""
    return list(data["diagnoses"] or ())


def likeness(diagnosis: Data) -> tuple[str, str]:
    """How a mistake is introduced, and its name: "" of one that is nobody's, but generated from an equation."""
    is_refuted = bool(diagnosis.get("refuted_by"))
    kind = diagnosis.get("kind", "known")
    words = LIKENESS[kind][is_refuted]
    return words, "" if kind == "generated" else diagnosis["mutant"]


def introduction(diagnosis: Data) -> str:
    """`likeness` in one."""
    return " ".join(filter(None, likeness(diagnosis)))


def objection(data: Data, diagnosis: Data) -> str:
    """What speaks against a mutant, if anything does."""
    if not (name := diagnosis.get("refuted_by")):
        return ""
    fails = name in data["checks"] and data["checks"][name]["status"] in FAILING
    return f"but it has other numbers in {name}" if fails else f"but it would fail {name}, which passes"


def matching(data: Data, check: str) -> list[Data]:
    """The diagnoses that explain a check."""
    return [diagnosis for diagnosis in diagnoses(data) if check in diagnosis["explained"]]


@functools.cache
def repository() -> str:
    """The web address of the repository, as the installed package states it; "" if it states none."""
    try:
        addresses = importlib.metadata.metadata("dreamer-spec").get_all("Project-URL") or []
    except importlib.metadata.PackageNotFoundError:
        return ""
    named = dict(address.split(", ", 1) for address in addresses)
    return next(
        (url.rstrip("/") for name, url in named.items() if name.lower() in ("repository", "source", "homepage")), ""
    )


def address(path: str) -> str:
    """Of a file of the repository on the web; "" if the repository has none."""
    return f"{repository()}/blob/main/{path}" if repository().startswith("https://") else ""
