"""The result of a run: what it holds, the failing inputs, and what it takes to pass."""

import copy
import io
import json
import os
import re
import shlex
import types
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from report_data import ABSENT, ADAPTER, CHECKS, ERROR, FAIL, PASS, adapter, make, settings

from conformance.case import Call, Case, Setting
from conformance.cli import main
from conformance.compare import Comparisons, Deviation
from conformance.errors import UserError
from conformance.execute import FailedCall, run_check
from conformance.expected import ExpectedFailures, read_expected
from conformance.judge import asking, judge_case
from conformance.problems import make_problem, small_config, spaces
from conformance.reports import values
from conformance.reports.reproduce import snippet
from conformance.results import read, schema, verdict
from conformance.schema import misfit, validator
from conformance.script import Script
from spec import Discrete, Image, Spaces, Vector, load_config


@pytest.fixture(scope="module")
def data() -> dict[str, Any]:
    return make()


# --- The result
# ------------------------------------------------------------------------------


def test_the_result_is_plain_and_follows_the_schema(data: dict[str, Any]) -> None:
    jsonschema.Draft202012Validator.check_schema(schema())
    jsonschema.Draft202012Validator(schema()).validate(data)
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert {name: check["status"] for name, check in data["checks"].items()} == {
        PASS: "pass",
        FAIL: "fail",
        ERROR: "error",
        ABSENT: "not offered",
    }
    assert data["verdict"] == {"passed": False, "problems": ["2 checks failed"]}
    assert (data["seed"], data["examples"]) == (3, 5)
    assert "numpy" in data["versions"]
    assert data["requirements"]["RET-1"]["chapter"] == "spec/07-returns.md"


def test_what_the_schema_does_not_allow_is_named(data: dict[str, Any]) -> None:
    expected = validator(schema())
    assert misfit(data, expected) == ""

    def spoiled(*path: str, value: Any = None, delete: bool = False) -> dict[str, Any]:
        copied = copy.deepcopy(data)
        place = copied
        for key in path[:-1]:
            place = place[key]
        if delete:
            del place[path[-1]]
        else:
            place[path[-1]] = value
        return copied

    for wrong, message in (
        (spoiled("format", value=2), "format: 1 was expected"),
        (spoiled("seed", value=1.5), "seed: 1.5 is not of type 'integer'"),
        (spoiled("seed", value=1.0), "seed: 1.0 is not of type 'integer'"),
        (spoiled("examples", value=True), "examples: True is not of type 'integer'"),
        (spoiled("dtype", value="float16"), "dtype: 'float16' is not one of"),
        (spoiled("checks", delete=True), "the whole: 'checks' is a required property"),
        (spoiled("extra", value=1), "the whole: Additional properties are not allowed ('extra' was unexpected)"),
        (spoiled("checks", FAIL, "share", value="3"), f"checks/{FAIL}/share: '3' is not of type 'number', 'null'"),
        (
            spoiled("checks", FAIL, "failure", "snippet", value=None),
            f"checks/{FAIL}/failure/snippet: None is not of type 'string'",
        ),
        (spoiled("verdict", "problems", value=["a", 1]), "verdict/problems/1: 1 is not of type 'string'"),
    ):
        assert message in misfit(wrong, expected)


def test_only_results_are_read(data: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    assert read(path) == data
    for text, message in (
        ("{", "is not JSON"),
        ("[1]", "the whole: .1. is not of type 'object'"),
        ('{"format": 1}', "the whole: 'date' is a required property"),
        ("[" * 100_000, "is not JSON"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(UserError, match=message):
            read(path)
    with pytest.raises(UserError, match="cannot read"):
        read(tmp_path / "absent.json")


# --- Failing inputs
# ------------------------------------------------------------------------------


def test_the_failing_call_is_told_in_full(data: dict[str, Any]) -> None:
    failure = data["checks"][FAIL]["failure"]
    assert failure["function"] == "lambda_return"
    assert [(value["name"], value["type"], value["text"]) for value in failure["arguments"]] == [
        ("reward", "float64 [1, 4]", "[[9.0, 1.0, 0.0, 2.0]]"),
        ("continue_", "float64 [1, 4]", "[[1.0, 1.0, 0.5, 1.0]]"),
        ("value", "float64 [1, 4]", "[[7.0, 4.0, 2.0, 10.0]]"),
        ("discount", "float", "0.5"),
        ("lambda_", "float", "0.5"),
    ]
    assert failure["expected"]["text"] == "[[2.28125, 1.125, 7.0]]"
    assert failure["got"]["text"].endswith(", 5.0]]")
    assert data["checks"][ERROR]["failure"]["function"] == "rms_norm"
    assert data["checks"][ERROR]["failure"]["got"] is None
    assert data["checks"][PASS]["failure"] is None


def test_the_failing_call_is_the_smallest_case() -> None:
    """Of a property that fails everywhere above 100, the case that hypothesis ends with, and not one of those on the
    way."""
    source = (
        "import numpy as np\ndef symlog(x):\n    return np.where(np.abs(x) > 100, 0, np.sign(x) * np.log1p(np.abs(x)))"
    )
    result = run_check(CHECKS[PASS], adapter(source), Setting("float64", "paper", examples=100))
    assert result.call is not None
    assert result.call.got is not None
    assert result.call.expected is not None
    assert result.call.index is not None
    assert result.call.got[result.call.index] == 0
    assert repr(float(result.call.expected[result.call.index])) in result.message


def test_a_candidate_that_writes_into_its_arguments_hides_nothing() -> None:
    def careless(x: np.ndarray) -> np.ndarray:
        x[...] = 7
        return x

    adapter, comparisons = types.SimpleNamespace(symlog=careless), Comparisons("float64")
    arguments = (np.array([1.0, 2.0]),)
    judge_case(Case((Call("symlog", arguments),)), asking(adapter), comparisons)
    assert arguments[0].tolist() == [1, 2]
    kept = Case((Call("symlog", arguments),), keeps=True)
    with pytest.raises(Deviation, match="the arguments of symlog after the call does not hold"):
        judge_case(kept, asking(adapter), comparisons)
    script = Script(Setting("float64", "paper"), asking(adapter), comparisons)
    script.call("symlog", np.array([1.0, 2.0]))
    assert comparisons.call is not None
    assert comparisons.call.arguments[0].tolist() == [1, 2]
    large = np.zeros(2**17)  # of a full-size network in the preflight: not kept twice
    script.call("symlog", large)
    assert comparisons.call.arguments[0] is large


def test_the_command_and_the_snippet_repeat_the_failure(
    data: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(ADAPTER, encoding="utf-8")
    failure = data["checks"][FAIL]["failure"]
    program, *words = shlex.split(failure["command"])
    assert program == "conformance"
    assert main([*words, "--json", "again.json"]) == 1
    assert read(Path("again.json"))["checks"] == {FAIL: data["checks"][FAIL]}
    printed = io.StringIO()
    with redirect_stdout(printed):
        exec(failure["snippet"], {})
    got = [float(word) for word in re.findall(r"[\d.]+", printed.getvalue())]
    assert got == [float(word) for word in re.findall(r"[\d.]+", failure["got"]["text"])]
    assert got != [2.28125, 1.125, 7.0]


def test_large_calls_are_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "def core(params, deter, stoch, action, config):\n    return deter + 0.5\n", encoding="utf-8"
    )
    assert main(["check", "mine.py", "--only", "core_matches", "--examples", "3", "--json", "r.json"]) == 1
    failure = read(Path("r.json"))["checks"]["rssm.core_matches"]["failure"]
    assert failure["arguments"][0]["type"].endswith("numbers")
    assert "rssm/gru/kernel" in failure["arguments"][0]["text"]
    assert failure["arguments"][-1]["text"].startswith("load_config('paper', 'tiny', ")
    printed = io.StringIO()
    with redirect_stdout(printed):
        exec(failure["snippet"], {})
    assert "core[" in printed.getvalue()


def test_source_makes_the_value_again() -> None:
    config, task = small_config("official", "float32"), spaces()
    known = {
        "np": np,
        **{"load_config": load_config, "Spaces": Spaces, "Vector": Vector, "Discrete": Discrete, "Image": Image},
    }
    for whole in (config, task, {"a": (1, 2.5, True, None, "x")}, (1,), []):
        assert eval(values.source(whole), known) == whole
    for array in (
        np.array([[np.nan, -np.inf], [-0.0, 1e-310]]),
        np.float32([0.1, 1e30]),
        np.zeros((0, 3), np.uint8),
        np.array(3.0),
        np.array([True]),
        np.arange(3, dtype=np.int32),
        np.float32(0.1),
    ):
        again = eval(values.source(array), known)
        assert np.asarray(again).dtype == np.asarray(array).dtype
        np.testing.assert_array_equal(again, array)
        np.testing.assert_array_equal(np.signbit(again), np.signbit(array))


def test_large_arrays_show_the_worst_element_and_its_neighbours() -> None:
    array = np.arange(300.0).reshape(3, 100)
    (entry,) = values.shown("got", array, (1, 50))
    assert entry == {
        "name": "got",
        "type": "float64 [3, 100]",
        "text": "the worst element, at [1, 50]: 150.0\n[1, 48:53] = [148.0, 149.0, 150.0, 151.0, 152.0]",
        "whole": False,
    }
    array[0, 1] = np.nan
    (entry,) = values.shown("x", array)
    assert entry["text"] == "from 0.0 to 299.0, 1 not finite\nthe first: 0.0, np.nan, 2.0, 3.0, 4.0, ..."
    assert [entry["name"] for entry in values.shown("carry", {"deter": array, "stoch": (array, 1)})] == [
        "carry[deter]",
        "carry[stoch][0]",
        "carry[stoch][1]",
    ]
    problem = make_problem(0, "paper", "vector", "discrete")
    assert len(values.shown("params", problem.state["params"])) == 1


def test_a_process_and_an_object_have_snippets() -> None:
    asked = settings(candidate="./their server", process=True)
    assert "ProcessAdapter('./their server', 'float64'" in snippet(PASS, FailedCall("symlog", (np.ones(2),)), asked)
    made = snippet("replay.any", FailedCall("Replay", (10, 2)), settings())
    assert "judge_twice(CHECKS['replay.any'], adapter, find_edition('paper'), 'float64', seed=3, examples=5)" in made
    assert "adapter.Replay" not in made
    compile(made, "snippet", "exec")


# --- What it takes to pass
# ------------------------------------------------------------------------------


def run(tmp_path: Path, source: str, *options: str) -> int:
    (tmp_path / "mine.py").write_text(source, encoding="utf-8")
    return main(["check", str(tmp_path / "mine.py"), "--examples", "2", *options])


def test_exit_codes(tmp_path: Path) -> None:
    right = ["--only", PASS]
    assert run(tmp_path, ADAPTER, *right) == 0
    assert run(tmp_path, ADAPTER, "--only", FAIL) == 1
    assert run(tmp_path, ADAPTER, "--only", ERROR) == 1
    assert run(tmp_path, "", *right) == 1  # nothing offered
    assert run(tmp_path, "", *right, "--at-least", "0") == 0
    assert run(tmp_path, ADAPTER, *right, "--at-least", "2") == 1
    assert run(tmp_path, ADAPTER, "--only", "no such check") == 2
    assert run(tmp_path, ADAPTER, *right, "--json", str(tmp_path / "mine.py" / "x.json")) == 2


def test_expected_failures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "expect.toml"
    expect = ["--expect", str(file)]

    file.write_text(f'{FAIL} = "as the paper prints it"\n', encoding="utf-8")  # a bare key: the dot makes a table
    assert run(tmp_path, ADAPTER, "--only", FAIL, *expect) == 1  # nothing passes
    assert run(tmp_path, ADAPTER, "--only", FAIL, *expect, "--at-least", "0") == 0
    assert "fails as expected: as the paper prints it" in capsys.readouterr().out
    assert run(tmp_path, ADAPTER, "--only", PASS, *expect) == 0
    assert "was not run" in capsys.readouterr().out

    text = 'RET-1 = "as the paper prints it"\nRET-17 = "the same"\n"layers.rms_norm_literals" = "later"\n'
    file.write_text(text, encoding="utf-8")
    assert run(tmp_path, ADAPTER, "--only", "RET-1", *expect, "--at-least", "0") == 0
    assert run(tmp_path, ADAPTER, "--only", ERROR, *expect, "--at-least", "0") == 0

    file.write_text(f'"{PASS}" = "not mended yet"\n', encoding="utf-8")
    assert run(tmp_path, ADAPTER, "--only", PASS, *expect) == 1
    assert "failed: transforms.symlog_matches passes, and is expected to fail" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('RET-1000 = "x"', "no check and no requirement is named RET-1000; is RET-1"),
        ("RET-1 = 3", "RET-1: expected a reason as text, got 3"),
        ('RET-1 = " "', "RET-1: expected a reason"),
        ("RET-1", "expect.toml: "),
    ],
)
def test_expectations_that_cannot_be_read(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "expect.toml").write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=re.escape(message)):
        read_expected(tmp_path / "expect.toml")


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for read_it in (read, read_expected):
        with pytest.raises(UserError, match=r"cannot read .*pipe: it is no file"):
            read_it(tmp_path / "pipe")


def test_a_requirement_passes_unexpectedly_only_as_a_whole() -> None:
    results = [
        run_check(CHECKS[name], adapter(), Setting("float64", "paper", examples=2))
        for name in (FAIL, "returns.lambda_return_matches", PASS)
    ]
    assert ExpectedFailures({"RET-1": "x"}).outcome("RET-1", results) == "fail"
    assert ExpectedFailures({"RET-1": "x"}).outcome("RET-1", results[2:]) == "not run"
    assert verdict(settings(), results, ExpectedFailures({"RET-1": "x"})) == {"passed": True, "problems": []}
    assert verdict(settings(), results[2:], ExpectedFailures({"TRA-3": "x"}))["problems"] == [
        "TRA-3 passes, and is expected to fail"
    ]


# --- Reproducible
# ------------------------------------------------------------------------------


class Listening:
    """Notes every array that it is asked about."""

    def __init__(self) -> None:
        self.heard: list[bytes] = []

    def symlog(self, x: np.ndarray) -> np.ndarray:
        self.heard.append(np.asarray(x).tobytes())
        return np.asarray(np.sign(x) * np.log1p(np.abs(x)))


def test_the_same_seed_gives_the_same_cases() -> None:
    def heard(seed: int) -> list[bytes]:
        listening = Listening()
        assert run_check(CHECKS[PASS], listening, Setting("float64", "paper", seed, examples=10)).status == "pass"
        return listening.heard

    assert heard(1) == heard(1)
    assert heard(1) != heard(2)
