"""Requirement ids are read from the marks of tests, and a mark that cannot be read is an error."""

import sys
from pathlib import Path

import pytest

from conformance import coverage as module
from conformance.cli import main
from conformance.coverage import covering_tests

MARKED = """
import pytest

@pytest.mark.covers("LOOP-1", "CON-2")
@pytest.mark.parametrize("x", [1])
def test_both(x): ...

@pytest.mark.slow
def test_none(): ...

class TestGroup:
    @pytest.mark.covers("LOOP-1")
    def test_inside(self): ...

@pytest.mark.covers("LOOP-9")
def helper(): ...
"""


def test_marks_are_found(tmp_path: Path) -> None:
    (tmp_path / "test_a.py").write_text(MARKED)
    (tmp_path / "helpers.py").write_text(MARKED)
    assert covering_tests(tmp_path) == {
        "LOOP-1": ["test_a.test_both", "test_a.test_inside"],
        "CON-2": ["test_a.test_both"],
    }
    assert covering_tests(tmp_path / "absent") == {}


@pytest.mark.parametrize("arguments", ["", "LOOP", "*IDS", "'LOOP-1', 2", "name='LOOP-1'"])
def test_marks_must_be_written_out(tmp_path: Path, arguments: str) -> None:
    (tmp_path / "test_a.py").write_text(f"import pytest\n\n@pytest.mark.covers({arguments})\ndef test_it(): ...\n")
    with pytest.raises(ValueError, match=r"test_a.py:\d+: pytest.mark.covers"):
        covering_tests(tmp_path)


def test_an_installed_package(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a backend and without tests nothing is wrong; the command says what it did not look at."""
    monkeypatch.setitem(sys.modules, "jax", None)
    monkeypatch.delitem(sys.modules, "conformance.adapters.jax_adapter", raising=False)
    for name in [name for name in sys.modules if name.partition(".")[0] == "impl_jax"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(module, "covering_tests", lambda: {})
    assert main(["coverage"]) == 0
    out = capsys.readouterr().out
    assert "not installed, so not looked at: jax" in out
    assert "no tests here" in out
    table, problems = module.coverage()
    assert problems == []
    assert set(table["RET-3"]) == {"numpy", "torch"}
    assert set(table["REP-3"]) == set(table["LOOP-12"]) == {"numpy", "trainer"}


def test_a_mistake_of_ours_is_not_a_missing_library(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(implementation: str) -> object:
        raise ModuleNotFoundError("No module named 'impl_jax.layer'", name="impl_jax.layer")

    monkeypatch.setattr(module, "load_adapter", broken)
    with pytest.raises(ModuleNotFoundError):
        module.installed_adapters()


def test_the_checks_of_a_requirement_are_listed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "800")
    assert main(["coverage"]) == 0
    out = capsys.readouterr().out
    assert "losses.return_range_matches (jointly with 11 others)" in out
    assert "│ distributions.normal_literals, distributions.normal_matches " in out
