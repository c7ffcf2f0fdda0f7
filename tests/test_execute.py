"""How checks are run on what somebody hands in."""

import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance.case import Setting
from conformance.cli import main
from conformance.execute import missing, run_check, selected_checks

CHECKS = {check.name: check for check in selected_checks("float64")}


def adapter(**functions: Any) -> types.ModuleType:
    module = types.ModuleType("adapter")
    vars(module).update(functions)
    return module


def test_only_callables_are_offered() -> None:
    """`from mine import losses` puts a module under the name of a function of the interface."""
    check = next(check for check in CHECKS.values() if "losses" in check.uses)
    mine = adapter(losses=types.ModuleType("losses"))
    assert "losses" in missing(mine, check)
    assert run_check(check, mine, Setting("float64", "paper")).status == "not offered"
    assert "losses" not in missing(adapter(losses=lambda *arguments: None), check)


def test_what_the_candidate_raises_is_a_result() -> None:
    def broken(x: np.ndarray) -> np.ndarray:
        raise KeyError("oops")

    result = run_check(CHECKS["transforms.symlog_matches"], adapter(symlog=broken), Setting("float64", "paper"))
    assert result.status == "error"
    assert "oops" in result.message


def test_a_candidate_cannot_end_the_kit() -> None:
    class Replay:
        def __init__(self, capacity: int, length: int) -> None:
            raise SystemExit(0)

    check = next(check for check in CHECKS.values() if check.uses == ("Replay",))
    assert run_check(check, adapter(Replay=Replay), Setting("float64", "paper")).status == "error"


def test_a_right_and_a_wrong_function() -> None:
    check = CHECKS["transforms.symlog_matches"]
    right = run_check(check, adapter(symlog=lambda x: np.sign(x) * np.log1p(np.abs(x))), Setting("float64", "paper"))
    assert right.status == "pass", right.message
    with np.errstate(all="ignore"):
        wrong = run_check(check, adapter(symlog=lambda x: np.sign(x) * np.log(np.abs(x))), Setting("float64", "paper"))
    assert (wrong.status, "symlog" in wrong.message) == ("fail", True)


def test_two_deviations_are_a_deviation() -> None:
    """A property that fails in two ways is a failure with the smaller case, not an error with a group of them."""

    def two_mistakes(x: np.ndarray) -> np.ndarray:
        right = np.sign(x) * np.log1p(np.abs(x))
        return right[..., None] if np.ndim(x) > 1 else right + 1

    result = run_check(
        CHECKS["transforms.symlog_matches"], adapter(symlog=two_mistakes), Setting("float64", "paper", examples=200)
    )
    assert result.status == "fail", result.message


def test_a_device_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "torch", "--device", "abacus"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("conformance: error: ")
    assert "abacus" in error
    assert error.count("\n") == 1


def test_a_candidate_is_an_implementation_a_module_or_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "helper.py").write_text(
        "import numpy as np\n\n\ndef right(x):\n    return np.sign(x) * np.log1p(np.abs(x))\n"
    )
    (tmp_path / "mine.py").write_text("from helper import right\n\n\ndef symlog(x):\n    return right(x)\n")
    only = ["--only", "symlog_matches"]
    assert main(["check", str(tmp_path / "mine.py"), *only]) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["check", "mine", *only]) == 0
    assert main(["check", "numpy", *only]) == 0
    for wrong in ("absent.py", "absent_module", "absent.module"):
        assert main(["check", wrong, *only]) == 2
        assert wrong.partition(".")[0] in capsys.readouterr().err
