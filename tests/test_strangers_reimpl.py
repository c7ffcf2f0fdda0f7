"""Whole implementations of others: what the kit finds in them, each in an environment that has it, is what was recorded."""

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from conformance.candidate import candidate
from conformance.execute import run_check, selected_checks

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "conformance" / "examples"
FINDINGS = tomllib.loads((EXAMPLES / "findings_reimpl.toml").read_text(encoding="utf-8"))
MODULES = {
    "di_engine": "ding",
    "dreamerv3": "dreamerv3",
    "rllib": "ray",
    "rssmlite": "rssmlite",
    "sheeprl": "sheeprl",
    "sheeprl_v3_5": "sheeprl",
}
FAILING = ("fail", "error")


def recorded(name: str) -> dict[str, Any]:
    return json.loads((ROOT / "docs" / "results" / f"stranger-{name}.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", MODULES)
def test_every_failure_is_explained_and_every_explanation_is_of_a_failure(name: str) -> None:
    package = {check: finding for check, finding in FINDINGS[name].items() if isinstance(finding, dict)}
    assert set(package) == {check for check, entry in recorded(name)["checks"].items() if entry["status"] in FAILING}
    for finding in package.values():
        cause = package[finding["same"]] if "same" in finding else finding
        assert cause["kind"] in ("choice", "domain", "bug")
        assert cause["what"]
        assert cause["verified"]


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_the_kit_finds_what_is_recorded(name: str) -> None:
    pytest.importorskip(MODULES[name])
    result = recorded(name)
    command = f"{sys.executable} {ROOT / 'conformance' / 'serve.py'} {EXAMPLES / f'{name}_adapter.py'}"
    with candidate(None, command, result["dtype"], None, 300) as adapter:
        if adapter.version != result["version"]:  # type: ignore[attr-defined]
            pytest.skip(f"recorded with version {result['version']}")
        found = {
            check.name: run_check(
                check, adapter, result["dtype"], result["profile"], result["seed"], result["examples"], shrink=False
            ).status
            for check in selected_checks(result["dtype"])
            if check.name in result["checks"]
        }
    assert found == {check: entry["status"] for check, entry in result["checks"].items()}


@pytest.mark.parametrize(
    ("name", "script"),
    [
        pytest.param(name, finding["script"], id=f"{name} {check}")
        for name, package in FINDINGS.items()
        for check, finding in package.items()
        if "script" in finding
    ],
)
def test_the_calculations_by_hand(name: str, script: str) -> None:
    pytest.importorskip(MODULES[name])
    exec(compile(script, f"findings_reimpl.toml, {name}", "exec"), {})
