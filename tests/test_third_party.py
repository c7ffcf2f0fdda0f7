"""The adapters for packages of others: the checks pass and fail as docs/third-party.md says, for the reasons that it
gives."""

import sys
from pathlib import Path
from typing import Any

import pytest

from conformance.candidate import candidate
from conformance.editions import judge
from conformance.execute import Result, selected_checks
from docs.third_party import FAILING, KINDS, failing, findings, reduce, results
from spec import editions

SERVE = Path(__file__).resolve().parent.parent / "conformance" / "serve.py"
EXAMPLES = SERVE.parent / "examples"
MODULES = {  # the others are called as their packages
    **{"di_engine": "ding", "rllib": "ray", "sheeprl_v3_5": "sheeprl"},
    **{"dreamerv3_2026": "embodied", "dreamerv3_torch": "exploration", "r2dreamer": "rssm"},
}
FEW = 10  # cases of a property
NOT_JUDGED = ("not offered", "not in edition")
SLOW = {"equinox", "haiku"}  # JAX compiles each layer of each shape
BESIDE_US = [
    pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
    for name, result in results().items()
    if result["interface"] == "module"
]
ALONE = [name for name, result in results().items() if result["interface"] == "process"]
SCRIPTS = [
    pytest.param(package, finding["script"], id=f"{package} {check}")
    for package, entries in findings().items()
    for check, finding in entries.items()
    if "script" in finding
]


def recorded_version(name: str) -> str:
    """The version that the results were recorded with, which is installed; skips the test if it is not."""
    version = results()[name]["version"]
    installed = getattr(pytest.importorskip(MODULES.get(name, name)), "__version__", "")
    if installed != version:
        pytest.skip(f"recorded with {name} {version}, installed is {installed}")
    return version


def run_checks(adapter: object, result: dict[str, Any], names: set[str], examples: int) -> list[Result]:
    """The checks of these names, judged as they were recorded but for the number of drawn cases."""
    edition, checks = editions()[result["edition"]], selected_checks(result["dtype"])
    settings = (result["dtype"], result["seed"], examples, False)
    return [judge(check, adapter, edition, *settings) for check in checks if check.name in names]


def failing_checks(adapter: object, result: dict[str, Any], names: set[str], examples: int) -> set[str]:
    return {run.check.name for run in run_checks(adapter, result, names, examples) if run.status in FAILING}


@pytest.mark.parametrize("name", BESIDE_US)
def test_the_kit_finds_what_is_recorded(name: str) -> None:
    """What fails in a few cases has failed in those of the record, which are more of the same; what has failed there
    and not here fails in as many."""
    version, result = recorded_version(name), results()[name]
    recorded = set(failing(result))
    with candidate(str(EXAMPLES / f"{name}_adapter.py"), None, result["dtype"], None, 60) as adapter:
        assert adapter.version == version
        everything = {check.name for check in selected_checks(result["dtype"])}
        ran = run_checks(adapter, result, everything, FEW)
        assert {one.check.name for one in ran if one.status not in NOT_JUDGED} == set(result["checks"])
        found = {one.check.name for one in ran if one.status in FAILING}
        assert found <= recorded
        assert failing_checks(adapter, result, recorded - found, result["examples"]) == recorded - found


@pytest.mark.slow
@pytest.mark.parametrize("name", ALONE)
def test_the_kit_finds_what_is_recorded_through_a_process(name: str) -> None:
    """Each of these needs an environment of its own, with this project beside it: docs/third-party.md says which."""
    pytest.importorskip(MODULES.get(name, name))
    result = results()[name]
    with candidate(
        None, f"{sys.executable} {SERVE} {EXAMPLES / f'{name}_adapter.py'}", result["dtype"], None, 300
    ) as adapter:
        if adapter.version != result["version"]:
            pytest.skip(f"recorded with {name} {result['version']}, installed is {adapter.version}")
        found = run_checks(adapter, result, set(result["checks"]), result["examples"])
    # The record has the smallest case that fails, which may raise where the first one gives a wrong number.
    assert {run.check.name: run.status in FAILING for run in found} == {
        check: entry["status"] in FAILING for check, entry in result["checks"].items()
    }


@pytest.mark.parametrize("name", results())
def test_every_failure_is_explained_and_every_explanation_is_of_a_failure(name: str) -> None:
    package = dict(findings()[name])
    assert all(package.pop(key) for key in ("title", "url", "offers"))
    assert set(package) == set(failing(results()[name]))
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
    passed: dict[str, Any] = {
        "status": "pass",
        "requirements": ["TRA-3"],
        "compared": 7,
        "message": "",
        "level": 0,
        "extreme": False,
    }
    error = (
        "Traceback (most recent call last):\n  File x\nTypeError: "
        "no\n--------------------\nFor simplicity, JAX has removed frames."
    )
    result = {
        **{
            "date": "2026-01-31",
            "process": False,
            "dtype": "float64",
            "edition": "2023",
            "choice": "claimed",
            "seed": 0,
            "examples": 25,
        },
        "versions": {},
        "implementation": {"name": "their_adapter", "version": "1.2", "edition": None},
        "checks": {
            "good": passed,
            "bad": passed | {"status": "fail", "message": "got 1, expected 2\nFailing test case"},
            "raised": passed | {"status": "error", "message": error},
            "missing": passed | {"status": "not offered", "message": "the adapter does not offer symlog"},
            "other": passed
            | {"status": "not in edition", "message": "2023 has OPT-8 otherwise, which is not modelled here"},
        },
        "diagnoses": [{"mutant": "m", "explained": ["bad"], "fix": "f"}],
    }
    kept = reduce("theirs", result)
    assert kept["checks"] == {
        "good": {"status": "pass", "requirements": ["TRA-3"], "compared": 7, "extreme": False},
        "bad": {
            "status": "fail",
            "requirements": ["TRA-3"],
            "compared": 7,
            "extreme": False,
            "message": "got 1, expected 2",
        },
        "raised": {
            "status": "error",
            "requirements": ["TRA-3"],
            "compared": 7,
            "extreme": False,
            "message": "TypeError: no",
        },
    }
    assert (kept["package"], kept["version"], kept["interface"]) == ("theirs", "1.2", "module")
    assert (kept["not_offered"], kept["not_judged"]) == (1, 1)
    assert kept["diagnoses"] == [{"mutant": "m", "explained": ["bad"]}]
