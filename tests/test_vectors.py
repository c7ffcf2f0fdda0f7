"""Golden vectors: the shipped set is current and right, is readable without this project, and notices mistakes."""

import hashlib
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from conformance import cli
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.check import CHECKS
from conformance.compare import DTYPES, EPSILON, WIDE
from conformance.errors import UserError
from conformance.interface import INTERFACE
from conformance.mutants import MUTANTS, MutantAdapter
from conformance.our_candidates import load_adapter
from conformance.vectors import format as vector_format
from conformance.vectors.reading import StoredCase, deviations, read_cases, read_index
from conformance.vectors.recording import record
from conformance.vectors.writing import checks_to_record, package_version, write_vectors
from impl_torch import behavior, distributions, world_model

ROOT = Path(__file__).parents[1]
MINIMAL = ROOT / "conformance" / "vectors" / "minimal"
CASES = list(read_cases(MINIMAL))
REMEDY = "run: conformance vectors --out conformance/vectors/minimal"
# Closed to the reader that the document prints.
BLOCK = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        ours = ("conformance", "spec", "reference_numpy", "impl_torch", "impl_jax", "dreamer_spec")
        if name.partition(".")[0] in (*ours, "hypothesis"):
            raise ImportError(name)
sys.meta_path.insert(0, Blocked())
"""


def wrong(adapter: object, dtype: str, cases: list[StoredCase] = CASES) -> dict[str, list[str]]:
    """Case -> what is wrong, of those that the adapter offers and that have a tolerance for the dtype."""
    found = {}
    with np.errstate(all="ignore"):
        for case in cases:
            if (
                dtype in case.dtypes
                and hasattr(adapter, case.entry["function"])
                and (messages := deviations(case, adapter, dtype))
            ):
                found[case.name] = messages
    return found


def reader(*changes: tuple[str, str]) -> tuple[int, list[str]]:
    """Number of cases checked and names of the wrong ones, by the code that the document prints."""
    code = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "vectors.md").read_text(encoding="utf-8"), re.DOTALL)
    assert code is not None
    text = code.group(1)
    for right, mistake in changes:
        assert text.count(right) == 1
        text = text.replace(right, mistake)
    text = BLOCK + text + "print(json.dumps(check(Path(sys.argv[1]))))\n"
    done = subprocess.run([sys.executable, "-I", "-c", text, str(MINIMAL)], capture_output=True, text=True, check=True)
    checked, names = json.loads(done.stdout.splitlines()[-1])
    return checked, names


def test_the_document_is_enough_to_read_the_set() -> None:
    checked, names = reader()
    assert checked == sum(
        case.entry["function"] in ("symlog", "lambda_return", "twohot") and "results" in case.entry for case in CASES
    )
    assert checked >= 10
    assert names == []


@pytest.mark.parametrize(
    ("right", "mistake", "chapter"),
    [
        ("np.log1p(np.abs(x))", "np.log1p(np.abs(np.float32(x)))", "transforms"),
        ("value[:, t] + lambda_", "value[:, t - 1] + lambda_", "returns"),
        ("np.searchsorted(bins, x)", "np.searchsorted(bins, x) - 1", "transforms"),
    ],
)
def test_the_reader_notices_mistakes(right: str, mistake: str, chapter: str) -> None:
    names = reader((right, mistake))[1]
    assert names
    assert {name.partition(".")[0] for name in names} == {chapter}


def test_the_reference_is_right() -> None:
    assert wrong(NumpyAdapter(), "float64") == {}


@pytest.mark.parametrize("dtype", ["float64", "float32", "bfloat16"])
def test_pytorch_is_right(dtype: str) -> None:
    assert wrong(load_adapter("torch", dtype), dtype) == {}


def test_pytorch_is_wrong_where_it_computes_too_coarsely() -> None:
    """Tolerances of float64 are not those of float32."""
    level0 = [case for case in CASES if case.entry["level"] == 0]
    assert len(wrong(load_adapter("torch", "float32"), "float64", level0)) > 50


def test_automatic_differentiation_gives_the_gradients() -> None:
    compared = set()
    for case in CASES:
        name = case.entry["function"]
        for gradient in case.entry.get("gradients", ()):
            function = next(getattr(one, name) for one in (distributions, world_model, behavior) if hasattr(one, name))
            for dtype, tolerance in gradient["tolerance"].items():
                result, leaf = differentiable(case, function, gradient["by"], dtype)
                for key in gradient["of"]:
                    result = result[key]
                total = result.sum()
                actual = torch.autograd.grad(total, leaf, allow_unused=True)[0] if total.requires_grad else None
                actual = torch.zeros_like(leaf) if actual is None else actual
                off = np.abs(actual.double().numpy() - case.array(gradient["expected"])).max()
                assert off <= tolerance * gradient["scale"], (case.name, gradient["by"], dtype)
                compared.add((name, gradient["by"], dtype))
    assert len(compared) >= 36


def differentiable(case: StoredCase, function: Any, by: str, dtype: str) -> tuple[Any, torch.Tensor]:
    """The result of a function of impl_torch, and the argument that it can be differentiated by."""
    kind = torch.float64 if dtype == "float64" else torch.float32
    arguments = []
    for value, parameter in zip(case.arguments(dtype), inspect.signature(function).parameters.values(), strict=True):
        is_array = isinstance(value, np.ndarray) or parameter.annotation is torch.Tensor
        tensor = torch.tensor(value) if is_array else None
        arguments.append(value if tensor is None else tensor.to(kind) if tensor.is_floating_point() else tensor)
    leaf = arguments[list(case.entry["arguments"]).index(by)].requires_grad_()
    return function(*arguments), leaf


@pytest.mark.parametrize(
    "name", ["return_bootstraps_from_itself", "kl_without_stop_gradient", "momentum_before_normalization"]
)
def test_a_planted_mistake_is_noticed_where_the_set_says(name: str) -> None:
    found = wrong(MutantAdapter(MUTANTS[name]), "float64")
    assert found
    assert set(found) == {case.name for case in CASES if name in case.entry["kills"]}


def test_a_call_that_must_be_refused() -> None:
    class Lenient:
        def cumulative_weights(self, continue_: np.ndarray, discount: float) -> np.ndarray:
            return np.ones((1, 1))

    refused = [case for case in CASES if case.entry["function"] == "cumulative_weights" and "refused" in case.entry]
    assert refused
    assert all(deviations(case, Lenient(), "float64") == ["not refused"] for case in refused)


def test_the_files_are_those_of_the_index() -> None:
    index = read_index(MINIMAL)
    assert {path.name for path in MINIMAL.iterdir()} == {*index["files"], "index.json"}
    for name, about in index["files"].items():
        content = (MINIMAL / name).read_bytes()
        assert (len(content), hashlib.sha256(content).hexdigest()) == (about["bytes"], about["sha256"]), name
    assert sum(path.stat().st_size for path in MINIMAL.iterdir()) < 1_400_000
    assert [case.name for case in CASES] == [
        name for about in index["files"].values() for name in about.get("cases", ())
    ]


def test_the_set_is_current() -> None:
    """Its cases and those that it leaves out are all checks that there are, with their words and requirements; mutants
    exist."""
    index = read_index(MINIMAL)
    assert index["package"] == package_version(), REMEDY
    stated = {entry["check"]: (entry["what"], entry["requirements"]) for entry in index["left_out"]}
    stated |= {case.name.partition("/")[0]: (case.entry["what"], case.entry["requirements"]) for case in CASES}
    assert stated == {check.name: (check.summary, list(check.requirements)) for check in checks_to_record()}, REMEDY
    for case in CASES:
        assert set(case.entry["kills"]) <= set(MUTANTS), REMEDY
        assert list(case.entry["arguments"]) == list(INTERFACE[case.entry["function"]]), REMEDY


@pytest.mark.parametrize("only", ["transforms.", "returns.", "OPT-1", "WM-10"])
def test_recording_again_gives_the_same(only: str, tmp_path: Path) -> None:
    """A sample of the set, if hypothesis and NumPy draw as they did; numbers may differ in the last digits between
    machines."""
    first, again = tmp_path / "first", tmp_path / "again"
    for directory in (first, again):
        index = write_vectors(directory, "minimal", "paper", 0, only)
    assert {path.name: path.read_bytes() for path in first.iterdir()} == {
        path.name: path.read_bytes() for path in again.iterdir()
    }
    shipped = {case.name: case for case in CASES}
    if index["made_with"] != read_index(MINIMAL)["made_with"]:
        pytest.skip("the shipped set was made with other versions of hypothesis and NumPy")
    for case in read_cases(first):
        assert flat(case) == flat(shipped[case.name]), REMEDY


def flat(case: StoredCase) -> Any:
    """The entry of a case with its arrays and objects in it, without the mutants, rounded to what does not depend on
    the machine."""

    def resolved(value: Any) -> Any:
        if isinstance(value, list):
            return [resolved(entry) for entry in value]
        if not isinstance(value, dict):
            return value
        if value.keys() == {"array", "shape"}:
            return [f"{number:.9g}" for number in case.table.arrays[value["array"]].astype(float).ravel()], value[
                "shape"
            ]
        if value.keys() == {"object"}:
            return case.table.objects[value["object"]]
        return {key: resolved(entry) for key, entry in value.items()}

    entry = {key: value for key, value in case.entry.items() if key not in ("kills", "gradients")}
    return resolved(entry)


def test_what_is_made_of_the_candidates_own_results_is_no_golden_value() -> None:
    """Of a check that compares two calls with each other, nothing is recorded; of one that compares with the reference,
    all."""
    assert record(CHECKS["returns.lambda_return_ignores_the_start"], "paper", 0, 2) == []
    vectors = record(CHECKS["returns.lambda_return_literals"], "paper", 0, 2)
    exact, rounded = dict.fromkeys(DTYPES, 0.0), {dtype: 64 * EPSILON[WIDE[dtype]] for dtype in DTYPES}
    assert [vector.outputs[0].tolerance for vector in vectors] == [exact] * 5 + [rounded] * 3
    assert vectors[0].outputs[0].expected.tolist() == [[2.28125, 1.125, 7.0]]


def test_values_survive_the_files(tmp_path: Path) -> None:
    table = vector_format.Table()
    values = (
        True,
        3,
        0.1,
        "text",
        np.float64(np.nan),
        np.array([0.1, np.inf]),
        np.arange(3),
        {"a": (np.uint8([1]), -0.0)},
    )
    encoded = json.loads(json.dumps([table.encode(value) for value in values], allow_nan=False))
    (tmp_path / "x.npz").write_bytes(vector_format.to_npz(table.arrays))
    again = vector_format.Table(vector_format.read_npz(tmp_path / "x.npz"), table.objects)
    decoded = tuple(again.decode(value, "float32") for value in encoded)
    assert repr(decoded) == repr((*values[:4], np.array(np.nan), *values[5:]))
    with pytest.raises(TypeError, match="complex128"):
        table.encode(np.zeros(2, complex))


def test_only_an_older_set_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.json").write_text("mine")
    with pytest.raises(UserError, match="holds other things than vectors"):
        write_vectors(tmp_path, "minimal", "paper", 0, "TRA-3")
    assert (tmp_path / "thesis.json").read_text() == "mine"
    with pytest.raises(UserError, match="no vectors in"):
        read_index(tmp_path)
    for index in (
        '{"format": 99, "files": {}}',
        '{"routes": []}',
        "[]",
        "3",
        "no JSON",
    ):  # other programs write files of this name, too
        (tmp_path / "index.json").write_text(index)
        with pytest.raises(UserError, match="holds other things than vectors"):
            write_vectors(tmp_path, "minimal", "paper", 0, "TRA-3")
    assert (tmp_path / "thesis.json").read_text() == "mine"
    (tmp_path / "thesis.json").unlink()
    (tmp_path / "index.json").write_text('{"format": 99, "files": {"old.json": {}}}')
    (tmp_path / "old.json").write_text("{}")
    with pytest.raises(UserError, match="format 99, expected 2"):
        read_index(tmp_path)
    write_vectors(tmp_path, "minimal", "paper", 0, "TRA-3")
    assert {path.name for path in tmp_path.iterdir()} == {"index.json", "transforms.json", "transforms.npz"}


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    """It is said before the checks are recorded."""
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "vectors"):
        with pytest.raises(UserError, match=f"cannot write {place}: "):
            write_vectors(place, "minimal", "paper", 0, "TRA-3")


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["vectors", "--out", str(tmp_path / "v"), "--only", "returns.percentile", "--seed", "3"]) == 0
    assert "cases, 0.0" in capsys.readouterr().out
    assert read_index(tmp_path / "v")["seed"] == 3
    assert {case.entry["function"] for case in read_cases(tmp_path / "v")} == {"percentile"}
    assert cli.main(["vectors", "--out", str(tmp_path / "w"), "--only", "nothing of this name"]) == 2
    assert "no check matches" in capsys.readouterr().err
