"""What the kit says of our own backends: the tables of docs/results.md.

`python -m docs.backends result.json ...` keeps of results of `conformance check --json` what the tables need, as
docs/results/conformance-BACKEND-DTYPE-EDITION.json.
"""

import json
import math
import sys
from pathlib import Path
from typing import Any

from conformance.execute import FAILING
from conformance.requirements import requirements
from conformance.results import read

RESULTS = Path(__file__).resolve().parent / "results"
ORDER = ("jax", "torch", "float64", "float32", "bfloat16", "paper", "2024-12")
STATUSES = ("pass", "fail", "error", "not offered")

Data = dict[str, Any]
Key = tuple[str, str, str]


def reduce(result: Data) -> Data:
    """Of a result of the kit what is kept of a backend. Of what is not offered only the names are."""
    kept = ("status", "requirements", "compared", "share")
    checks = {
        name: {key: check[key] for key in (kept if check["status"] != "not offered" else kept[:2])}
        for name, check in result["checks"].items()
    }
    about = ("candidate", "dtype", "edition", "date", "seed", "examples", "versions")
    return {**{key: result[key] for key in about}, "checks": checks}


def runs() -> dict[Key, Data]:
    """The committed results: (candidate, dtype, edition) -> what `reduce` kept."""
    results = [json.loads(path.read_text(encoding="utf-8")) for path in RESULTS.glob("conformance-*.json")]
    keyed: dict[Key, Data] = {(run["candidate"], run["dtype"], run["edition"]): run for run in results}
    return dict(sorted(keyed.items(), key=lambda item: tuple(map(ORDER.index, item[0]))))


def summary_rows() -> list[list[str]]:
    """One line for each run: how many checks, and how near the worst number came to what is allowed."""
    rows = []
    for key, run in runs().items():
        statuses = [check["status"] for check in run["checks"].values()]
        counts = [str(statuses.count(status)) for status in STATUSES]
        numbers = sum(check.get("compared", 0) for check in run["checks"].values())
        name, worst = max(offered(run).items(), key=lambda item: share(item[1]))
        rows.append([*key, *counts, f"{numbers:,}", f"{share(worst):.0%} (`{name}`)"])
    return rows


def chapter_rows() -> tuple[list[str], list[list[str]]]:
    """The heads of the columns, and for each chapter the requirements of which all checks that are offered pass in
    float64, with the worst share of what is allowed."""
    wide = {key: run for key, run in runs().items() if key[1] == "float64"}
    prefixes = dict.fromkeys(name.split("-")[0] for name in requirements())
    rows = [[prefix, *(_cell(run, prefix) for run in wide.values())] for prefix in prefixes]
    return [f"{backend}, {edition}" for backend, _, edition in wide], rows


def _cell(run: Data, prefix: str) -> str:
    found = {name: checks for name, checks in requirements_of(run).items() if name.split("-")[0] == prefix}
    judged = {name: [check for check in checks if check["status"] != "not offered"] for name, checks in found.items()}
    judged = {name: checks for name, checks in judged.items() if checks}
    if not judged:
        return "not offered"
    passed = sum(all(check["status"] not in FAILING for check in checks) for checks in judged.values())
    return f"{passed} of {len(judged)}, {max(share(check) for checks in judged.values() for check in checks):.0%}"


def requirements_of(run: Data) -> dict[str, list[Data]]:
    """Requirement -> the checks that name it."""
    found: dict[str, list[Data]] = {}
    for check in run["checks"].values():
        for name in check["requirements"]:
            found.setdefault(name, []).append(check)
    return found


def offered(run: Data) -> dict[str, Data]:
    return {name: check for name, check in run["checks"].items() if check["status"] != "not offered"}


def share(check: Data) -> float:
    """The worst deviation as a share of what is allowed; infinite where it is not a number."""
    return math.inf if check["share"] is None else float(check["share"])


def main(paths: list[str]) -> None:
    for path in paths:
        kept = reduce(read(Path(path)))
        name = "-".join(("conformance", kept["candidate"], kept["dtype"], kept["edition"]))
        (RESULTS / f"{name}.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
