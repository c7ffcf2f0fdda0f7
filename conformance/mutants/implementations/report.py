"""`conformance mutants --implementations`: every mutant with what noticed it, and how many of each kind."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from conformance.errors import UserError
from conformance.mutants.implementations import CATALOGUES, KINDS, Patch, catalogue_of, patches
from conformance.mutants.implementations.trial import Outcome, trials
from conformance.results import versions, write

COLUMNS = ("mutants", "check", "preflight", "test", "survived", "equivalent", "no device")


def chosen(names: Sequence[str]) -> list[Patch]:
    """The mutants with these names, kinds, files or catalogues; all for no name.

    Raises:
      UserError: a name that none has.
    """
    found = {name: [patch for patch in patches().values() if name in _labels(patch)] for name in names}
    for name, those in found.items():
        if not those:
            raise UserError(
                f"no mutant of the implementations has the name, kind or file {name!r}; kinds are {', '.join(KINDS)}; "
                f"catalogues are {', '.join(CATALOGUES)}"
            )
    wanted = {patch.name for those in found.values() for patch in those}
    return [patch for patch in patches().values() if not names or patch.name in wanted]


def _labels(patch: Patch) -> tuple[str, ...]:
    return patch.name, patch.kind, patch.file, catalogue_of(patch.name)


def main(console: Console, names: Sequence[str], json: Path | None) -> int:
    """Returns 1 if a mutant survived that is not argued to be equivalent, or if one is caught that is."""
    asked = chosen(names)
    report: dict[str, dict[str, Any]] = {}
    with console.status("planting") as status:
        for number, (patch, outcome) in enumerate(trials(asked), 1):
            report[patch.name] = entry = to_json(patch, outcome)
            words = f"[bold red]{entry['words']}[/]" if is_bad(entry) else entry["words"]
            line = f"{patch.kind:16} {patch.name:48} {words} ({outcome.seconds:.0f} s)"
            console.print(line, highlight=False, soft_wrap=True)
            status.update(f"{number}/{len(asked)}")
            if json:  # after each: a night may be too short
                write(json, {"versions": versions(), "mutants": report})
    console.print(_table(report))
    bad = [name for name, entry in report.items() if is_bad(entry)]
    console.print(f"{len(report)} mutants, {len(bad)} not as they should be: {', '.join(bad) or 'none'}")
    return 1 if bad else 0


def to_json(patch: Patch, outcome: Outcome) -> dict[str, Any]:
    """A mutant and what noticed it, in plain JSON types."""
    return {
        "kind": patch.kind,
        "file": patch.file,
        "explanation": patch.explanation,
        "equivalent": patch.equivalent,
        "by": outcome.by,
        "name": outcome.name,
        "dtype": outcome.dtype,
        "how": outcome.how,
        "seconds": outcome.seconds,
        "words": outcome.words,
    }


def column_of(entry: Mapping[str, Any]) -> str:
    """Which of COLUMNS counts a mutant."""
    if entry["by"] is None:
        return "equivalent" if entry["equivalent"] else "survived"
    return str(entry["by"])


def is_bad(entry: Mapping[str, Any]) -> bool:
    caught = entry["by"] in ("check", "preflight", "test")
    return column_of(entry) == "survived" or (caught and bool(entry["equivalent"]))


def counts(report: Mapping[str, Mapping[str, Any]]) -> dict[str, list[int]]:
    """Kind, and "all" -> how many, in the order of COLUMNS."""
    rows = {kind: [entry for entry in report.values() if entry["kind"] == kind] for kind in KINDS}
    rows = {kind: entries for kind, entries in rows.items() if entries} | {"all": list(report.values())}
    return {
        kind: [len(entries), *(sum(column_of(entry) == column for entry in entries) for column in COLUMNS[1:])]
        for kind, entries in rows.items()
    }


def _table(report: Mapping[str, Mapping[str, Any]]) -> Table:
    view = Table()
    view.add_column("kind")
    for column in COLUMNS:
        view.add_column(column, justify="right")
    for kind, row in counts(report).items():
        view.add_row(kind, *map(str, row))
    return view
