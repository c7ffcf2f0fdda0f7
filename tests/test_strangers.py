"""The adapters for packages of others: the checks pass and fail as docs/strangers.md says, for the reasons that it gives."""

from pathlib import Path
from typing import Any

import pytest

from conformance.candidate import candidate
from conformance.execute import run_check, selected_checks
from docs.strangers import KINDS, failing, findings, reduce, strangers

EXAMPLES = Path(__file__).resolve().parent.parent / "conformance" / "examples"
SLOW = {"equinox", "haiku"}  # JAX compiles each layer of each shape
BESIDE_US = [
    pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
    for name, result in strangers().items()
    if result["door"] == "module"
]
SCRIPTS = [
    pytest.param(package, finding["script"], id=f"{package} {check}")
    for package, entries in findings().items()
    for check, finding in entries.items()
    if "script" in finding
]


def recorded_version(name: str) -> str:
    """The version that the results were recorded with, which is installed; skips the test if it is not."""
    version = strangers()[name]["version"]
    installed = getattr(pytest.importorskip(name), "__version__", "")
    if installed != version:
        pytest.skip(f"recorded with {name} {version}, installed is {installed}")
    return version


@pytest.mark.parametrize("name", BESIDE_US)
def test_the_kit_finds_what_is_recorded(name: str) -> None:
    version, result = recorded_version(name), strangers()[name]
    path = str(EXAMPLES / f"{name}_adapter.py")
    with candidate(path, None, result["dtype"], None, 60) as adapter:
        assert adapter.version == version
        statuses = {
            check.name: run_check(
                check, adapter, result["dtype"], result["profile"], result["seed"], result["examples"], shrink=False
            ).status
            for check in selected_checks(result["dtype"])
        }
    assert {name: status for name, status in statuses.items() if status != "not offered"} == {
        name: entry["status"] for name, entry in result["checks"].items()
    }


@pytest.mark.parametrize("name", strangers())
def test_every_failure_is_explained_and_every_explanation_is_of_a_failure(name: str) -> None:
    package = dict(findings()[name])
    assert all(package.pop(key) for key in ("title", "url", "offers"))
    assert set(package) == set(failing(strangers()[name]))
    for finding in package.values():
        if "same" in finding:
            assert set(finding) == {"same"}
            assert "same" not in package[finding["same"]]
        else:
            assert finding["kind"] in KINDS
            assert finding["what"]
            assert finding["verified"]


@pytest.mark.parametrize(("package", "script"), SCRIPTS)
def test_the_calculations_by_hand(package: str, script: str) -> None:
    recorded_version(package)
    exec(compile(script, f"findings.toml, {package}", "exec"), {})


def test_a_result_is_reduced_to_what_is_shown() -> None:
    passed: dict[str, Any] = {"status": "pass", "requirements": ["TRA-3"], "compared": 7, "message": "", "level": 0}
    error = "Traceback (most recent call last):\n  File x\nTypeError: no\n--------------------\nFor simplicity, JAX has removed frames."
    result = {
        **{"date": "2026-01-31", "process": False, "dtype": "float64", "profile": "paper", "seed": 0, "examples": 25, "versions": {}},
        "implementation": {"name": "their_adapter", "version": "1.2", "edition": None},
        "checks": {
            "good": passed,
            "bad": passed | {"status": "fail", "message": "got 1, expected 2\nFailing test case"},
            "raised": passed | {"status": "error", "message": error},
            "missing": passed | {"status": "not offered", "message": "the adapter does not offer symlog"},
        },
        "diagnoses": [{"mutant": "m", "explained": ["bad"], "fix": "f"}],
    }
    kept = reduce("theirs", result)
    assert kept["checks"] == {
        "good": {"status": "pass", "requirements": ["TRA-3"], "compared": 7},
        "bad": {"status": "fail", "requirements": ["TRA-3"], "compared": 7, "message": "got 1, expected 2"},
        "raised": {"status": "error", "requirements": ["TRA-3"], "compared": 7, "message": "TypeError: no"},
    }
    assert (kept["package"], kept["version"], kept["door"], kept["not_offered"]) == ("theirs", "1.2", "module", 1)
    assert kept["diagnoses"] == [{"mutant": "m", "explained": ["bad"]}]
