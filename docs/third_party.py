"""What the kit says of packages of others: the tables of docs/third-party.md.

`python -m docs.third_party NAME result.json` keeps of a result of `conformance check --json` what the tables need, as
docs/results/third-party-NAME.json. Why a check fails is said by people, in conformance/examples/findings.toml.
"""

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

from conformance.editions import NOT_JUDGED
from conformance.requirements import chapter_of
from conformance.results import read

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"
FINDINGS = ROOT / "conformance" / "examples" / "findings.toml"
KINDS = {"choice": "another choice", "domain": "outside of what is promised", "bug": "a defect"}
FAILING = ("fail", "error")
MESSAGE_LENGTH = 160

Data = dict[str, Any]


def reduce(name: str, result: Data) -> Data:
    """Of a result of the kit what is kept of a package. A message is kept up to its first line; of an error the last,
    the exception."""
    offered = {
        check: entry for check, entry in result["checks"].items() if entry["status"] not in ("not offered", NOT_JUDGED)
    }
    statuses = [entry["status"] for entry in result["checks"].values()]
    return {
        "package": name,
        "version": result["implementation"]["version"],
        "date": result["date"],
        "interface": "process" if result["process"] else "module",
        **{key: result[key] for key in ("dtype", "edition", "choice", "seed", "examples", "versions")},
        "checks": {
            check: {key: entry[key] for key in ("status", "requirements", "compared", "extreme")}
            | ({"message": _brief(entry)} if entry["status"] in FAILING else {})
            for check, entry in offered.items()
        },
        "not_offered": statuses.count("not offered"),
        "not_judged": statuses.count(NOT_JUDGED),
        "diagnoses": [{key: diagnosis[key] for key in ("mutant", "explained")} for diagnosis in result["diagnoses"]],
    }


def _brief(entry: Data) -> str:
    lines = [line for line in entry["message"].splitlines() if line and not line.startswith(" ")]
    if entry["status"] == "error":
        lines = [line for line in lines if line.partition(":")[0].endswith(("Error", "Exception"))] or lines
    line = lines[0] if entry["status"] == "fail" else lines[-1]
    return line if len(line) <= MESSAGE_LENGTH else f"{line[:MESSAGE_LENGTH]}..."


def results() -> dict[str, Data]:
    """The committed results: package -> what `reduce` kept."""
    results = (json.loads(path.read_text(encoding="utf-8")) for path in sorted(RESULTS.glob("third-party-*.json")))
    return {result["package"]: result for result in results}


def findings() -> dict[str, Data]:
    """Package -> "title", "url", "offers", and for each failing check its finding."""
    return tomllib.loads(FINDINGS.read_text(encoding="utf-8"))


def failing(result: Data) -> list[str]:
    return [check for check, entry in result["checks"].items() if entry["status"] in FAILING]


def kind_of(package: Data, check: str) -> str:
    """The kind of a finding, or of the one that it is the same as."""
    finding = package[check]
    return str(package[finding["same"]]["kind"] if "same" in finding else finding["kind"])


def summary_table() -> str:
    """One line for each package."""
    rows = []
    for name, result in results().items():
        package, failed = findings()[name], failing(result)
        kinds = [kind_of(package, check) for check in failed]
        extreme = sum(result["checks"][check]["extreme"] for check in failed)
        counts = [
            len(result["checks"]),
            len(result["checks"]) - len(failed),
            extreme,
            *(kinds.count(kind) for kind in KINDS),
        ]
        setting = f"{result['dtype']}, {result['edition']}"
        rows.append(
            [f"[{package['title']}]({package['url']})", result["version"], result["date"], setting, *map(str, counts)]
        )
    return _table(
        [
            "package",
            "version",
            "checked on",
            "precision, edition",
            "checks judged",
            "passed",
            "fail at extremes only",
            *KINDS.values(),
        ],
        rows,
    )


def finding_sections() -> str:
    """A section for each package: what was offered, what passes, and why the rest does not."""
    return "\n".join(_section(findings()[name], result) for name, result in results().items())


def _section(package: Data, result: Data) -> str:
    failed = failing(result)
    lines = [
        f"### {package['title']} {result['version']}",
        "",
        f"Offered: {package['offers']}",
        "",
        _passed_by_chapter(result),
    ]
    causes = [check for check in failed if "same" not in package[check]]
    for check in causes:
        finding = package[check]
        others = [other for other in failed if package[other].get("same") == check]
        names = ", ".join(f"`{name}`" for name in (check, *others))
        requirements = ", ".join(
            sorted({id_ for name in (check, *others) for id_ in result["checks"][name]["requirements"]})
        )
        at = ", with extreme input only" if all(result["checks"][name]["extreme"] for name in (check, *others)) else ""
        lines += [
            "",
            f"**{names}** ({requirements}): {KINDS[finding['kind']]}{at}.",
            "",
            f"> {result['checks'][check]['message']}",
        ]
        lines += ["", finding["what"].strip(), "", f"Verified: {finding['verified'].strip()}"]
        if "script" in finding:
            lines += ["", "```python", finding["script"].strip(), "```"]
    return "\n".join(lines) + "\n"


def _passed_by_chapter(result: Data) -> str:
    chapters: dict[str, list[bool]] = {}
    for entry in result["checks"].values():
        chapters.setdefault(chapter_of(entry["requirements"][0]), []).append(entry["status"] == "pass")
    parts = (
        f"[{Path(chapter).stem}](../{chapter}) {sum(passed)} of {len(passed)}"
        for chapter, passed in sorted(chapters.items())
    )
    return f"Passed: {', '.join(parts)}."


def _table(header: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows)) + "\n"


def main() -> int:
    name, path = sys.argv[1:]
    kept = RESULTS / f"third-party-{name}.json"
    kept.write_text(json.dumps(reduce(name, read(Path(path))), indent=1) + "\n", encoding="utf-8")
    print(f"wrote {kept.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
