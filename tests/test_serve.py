"""The server of the process interface for Python: it answers requests with the functions of an adapter file."""

import ast
import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from conformance import process
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.execute import Result, missing, run_check, selected_checks
from conformance.interface import OBJECTS
from conformance.problems import small_config
from conformance.process import CandidateError, ProcessAdapter
from conformance.serve import BadMessage, decode, to_numpy

ROOT = Path(__file__).resolve().parent.parent
CHECKS = {check.name: check for check in selected_checks("float64")}


def result_of(adapter: object) -> Result:
    return run_check(CHECKS["transforms.symlog_matches"], adapter, Setting("float64", "paper", examples=2))


ADAPTER = """
import subprocess
import numpy as np
print("hello from the import")
__version__ = "1.5"


def setup(dtype):
    assert dtype == "float64"


def edition():
    return "paper"


def symlog(x):
    print("a print in the middle")
    assert subprocess.run(["cat"], capture_output=True).stdout == b"", "requests are read by the server alone"
    return np.sign(x) * np.log1p(np.abs(x))


def lambda_return(reward, continue_, value, discount, lambda_):
    raise ValueError("reward: not like this")


def exponential_bins(bins):
    return [][bins]


def kl_losses(posterior_logits, prior_logits, config):
    return {"dynamics": config.free_nats + np.zeros(2), "representation": np.full(2, config.imagined_discount)}
"""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ProcessAdapter]:
    """The server as it is used where this project is not: one copied file, no packages of ours on the path."""
    shutil.copy(ROOT / "conformance" / "serve.py", tmp_path / "serve.py")
    (tmp_path / "mine.py").write_text(ADAPTER, encoding="utf-8")
    adapter = ProcessAdapter(
        shlex.join([sys.executable, "-I", str(tmp_path / "serve.py"), str(tmp_path / "mine.py")]), "float64", 60.0
    )
    yield adapter
    adapter.close()


def test_neighbours_of_the_server_hide_no_standard_module(tmp_path: Path) -> None:
    there = tmp_path / "there"
    there.mkdir()
    shutil.copy(ROOT / "conformance" / "serve.py", there / "serve.py")
    (there / "statistics.py").write_text("mean = None", encoding="utf-8")
    (tmp_path / "mine.py").write_text(
        "import statistics\n\n\ndef symlog(x):\n    return statistics.mean([1, 2, 6]) * x", encoding="utf-8"
    )
    adapter = ProcessAdapter(
        shlex.join([sys.executable, str(there / "serve.py"), str(tmp_path / "mine.py")]), "float64", 60.0
    )
    assert adapter.symlog(np.ones(2)).tolist() == [3.0, 3.0]
    adapter.close()


def test_a_missing_parameter_is_named(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def symlog(x):\n    return {}['reward/out/bias']", encoding="utf-8")
    adapter = ProcessAdapter(
        shlex.join([sys.executable, "-m", "conformance.serve", str(tmp_path / "mine.py")]), "float64", 60.0
    )
    with pytest.raises(KeyError, match=r"^'reward/out/bias'$"):
        adapter.symlog(np.ones(2))
    adapter.close()


def test_a_field_that_a_configuration_lacks_is_answered_with_those_that_are_near(tmp_path: Path) -> None:
    source = "def kl_losses(posterior_logits, prior_logits, config):\n    return config.free_bits"
    (tmp_path / "mine.py").write_text(source, encoding="utf-8")
    adapter = ProcessAdapter(
        shlex.join([sys.executable, "-m", "conformance.serve", str(tmp_path / "mine.py")]), "float64", 60.0
    )
    with pytest.raises(CandidateError, match=r"(?s)AttributeError.*is free_nats meant instead of free_bits\?$"):
        adapter.kl_losses(np.ones(2), np.ones(2), small_config("paper"))
    adapter.close()


def test_what_is_not_implemented_is_not_offered(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "def symlog(x):\n    raise NotImplementedError('negative numbers')", encoding="utf-8"
    )
    adapter = ProcessAdapter(
        shlex.join([sys.executable, "-m", "conformance.serve", str(tmp_path / "mine.py")]), "float64", 60.0
    )
    result = run_check(CHECKS["transforms.symlog_matches"], adapter, Setting("float64", "paper"))
    assert (result.status, result.message) == ("not offered", "not implemented: symlog (negative numbers)")
    adapter.close()


def test_the_server_alone(server: ProcessAdapter) -> None:
    assert (server.name, server.version, server.edition()) == ("mine", "1.5", "paper")
    assert result_of(server).status == "pass"
    config = small_config("paper")
    dynamics, representation = server.kl_losses(np.zeros(2), np.zeros(2), config)
    assert dynamics.tolist() == [2.0, 2.0]
    assert representation[0] == config.imagined_discount
    with pytest.raises(ValueError, match=r"^reward: not like this$"):
        server.lambda_return(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), 0.9, 0.9)
    with pytest.raises(CandidateError, match=r"return \[\]\[bins\](?s:.*)IndexError: list index out of range"):
        server.exponential_bins(5)


def test_the_server_needs_only_numpy() -> None:
    source = ast.parse((ROOT / "conformance" / "serve.py").read_text(encoding="utf-8"), feature_version=(3, 8))
    imported = {
        name.name.partition(".")[0] for node in ast.walk(source) if isinstance(node, ast.Import) for name in node.names
    }
    imported |= {str(node.module).partition(".")[0] for node in ast.walk(source) if isinstance(node, ast.ImportFrom)}
    assert imported - set(sys.stdlib_module_names) == {"numpy"}
    assert "pickle" not in imported
    code = (
        "import sys, conformance.serve; print({'hypothesis', 'rich', 'spec', 'conformance.compare'} & set(sys.modules))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        == "set()\n"
    )


def test_the_server_as_a_module(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import numpy as np\nfrom neighbour import symlog\n", encoding="utf-8")
    (tmp_path / "neighbour.py").write_text(
        "import numpy as np\n\n\ndef symlog(x):\n    return np.arcsinh(x)\n", encoding="utf-8"
    )
    line = shlex.join([sys.executable, "-m", "conformance.serve", str(tmp_path / "mine.py")])
    adapter = ProcessAdapter(line, "float64", 60.0)
    assert result_of(adapter).status == "fail"
    adapter.close()


@pytest.mark.parametrize(
    "message",
    [
        {"dtype": "object", "shape": [1], "data": ""},
        {"dtype": "float64", "shape": [-1], "data": ""},
        {"dtype": "float64", "shape": [True], "data": "AAAAAAAA8D8="},
        {"dtype": "float64", "shape": 3, "data": ""},
        {"dtype": "float64", "shape": [1], "data": "no base64!"},
        {"dtype": "float64", "shape": [1], "data": 5},
        {"map": {}, "more": 1},
        {"pickle": "gASVBQAAAA=="},
        {"map": 3},
    ],
)
def test_bad_values_are_refused(message: dict[str, Any]) -> None:
    with pytest.raises(BadMessage):
        decode(message)


def test_other_dtypes_are_converted() -> None:
    assert to_numpy(np.float16([0.5])).dtype == np.float64
    assert to_numpy(np.array([3], np.uint16)).dtype == np.int64
    for wrong in (None, "text", np.array(["text"]), np.array([1j]), [1.0, None], object()):
        with pytest.raises(TypeError, match="expected numbers"):
            to_numpy(wrong)


@pytest.mark.slow
def test_every_check_works_through_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference in a process passes all checks but those of objects with methods, and every request of these is
    valid."""
    schema = json.loads((ROOT / "conformance" / "protocol.schema.json").read_text(encoding="utf-8"))
    validator = jsonschema.Draft202012Validator({"$ref": "#/$defs/request", "$defs": schema["$defs"]})
    send, requests = process.Connection.send, 0

    def validated(connection: process.Connection, message: Any) -> None:
        nonlocal requests
        requests += 1
        validator.validate(message)
        send(connection, message)

    monkeypatch.setattr(process.Connection, "send", validated)
    adapter = ProcessAdapter(
        shlex.join([sys.executable, "-m", "conformance.serve", str(Path(__file__).parent / "reference_adapter.py")]),
        "float64",
        60.0,
    )
    results = [run_check(check, adapter, Setting("float64", "paper", examples=1)) for check in CHECKS.values()]
    adapter.close()
    assert [result.message for result in results if result.status in ("fail", "error")] == []
    reference = NumpyAdapter()
    asked = {
        check.name for check in CHECKS.values() if not missing(reference, check) and not set(check.uses) & set(OBJECTS)
    }
    assert {result.check.name for result in results if result.status == "pass"} == asked
    assert requests > len(asked)
