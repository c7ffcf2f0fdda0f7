"""Requirement ids are read from the marks of tests, and a mark that cannot be read is an error."""

from pathlib import Path

import pytest

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
    assert covering_tests(tmp_path) == {"LOOP-1": ["test_a.test_both", "test_a.test_inside"], "CON-2": ["test_a.test_both"]}
    assert covering_tests(tmp_path / "absent") == {}


@pytest.mark.parametrize("arguments", ["", "LOOP", "*IDS", "'LOOP-1', 2", "name='LOOP-1'"])
def test_marks_must_be_written_out(tmp_path: Path, arguments: str) -> None:
    (tmp_path / "test_a.py").write_text(f"import pytest\n\n@pytest.mark.covers({arguments})\ndef test_it(): ...\n")
    with pytest.raises(ValueError, match=r"test_a.py:\d+: pytest.mark.covers"):
        covering_tests(tmp_path)
