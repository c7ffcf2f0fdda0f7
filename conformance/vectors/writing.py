"""Writes a set of vectors."""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np

from conformance.check import Check
from conformance.compare import DTYPES, EPSILON, SMALLEST_NORMAL, WIDE
from conformance.errors import UserError
from conformance.execute import selected_checks
from conformance.interface import INTERFACE
from conformance.requirements import chapter_of
from conformance.vectors.format import FORMAT, Table, shortest, to_json, to_npz
from conformance.vectors.gradients import gradients
from conformance.vectors.killing import kills
from conformance.vectors.reading import StoredCase
from conformance.vectors.recording import Output, Vector, along_one_direction, record

FLOOR = {dtype: SMALLEST_NORMAL[WIDE[dtype]] / EPSILON[WIDE[dtype]] for dtype in DTYPES}
"""The smallest scale of a tolerance: transforms, returns and losses are computed in float32 or better."""


@dataclasses.dataclass(frozen=True)
class Size:
    """How much of what the checks do a set holds.

    examples: drawn for each property. results, refused: the most cases of each kind for one function of a check. large,
    bytes: of cases with more than `large` bytes of arrays there is one at most, with a result, and none with more than
    `bytes`, or `whole` for WHOLE.
    """

    examples: int
    results: int
    refused: int
    large: int
    bytes: int
    whole: int


SETS = {"minimal": Size(2, 2, 1, 600, 8_000, 45_000), "full": Size(25, 10_000, 10_000, 2**40, 2**40, 2**40)}
WHOLE = (
    *("losses.", "given.", "agent.policy_step_matches", "networks.decoder_matches"),
    *("world_model.open_loop_matches", "rssm.observe_matches"),
)
"""How the names of checks begin that are of so much at once that their smallest case is large."""


def write_vectors(
    directory: Path, size: str, profile: str, seed: int, only: str, progress: Callable[[str], None] = lambda name: None
) -> dict[str, Any]:
    """Writes a set and returns its index. The same arguments and versions give the same bytes.

    Raises:
      UserError: no check matches `only`; or the directory holds something else, or cannot be written.
    """
    checks = checks_to_record(only)
    if not checks:
        raise UserError(f"no check matches --only {only!r}")
    with _writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
        old = _of_older_set(directory)
    files: dict[str, bytes] = {}
    names: dict[str, list[str]] = {}
    left_out: list[dict[str, Any]] = []
    for chapter in sorted({_chapter(check) for check in checks}):
        table, cases = Table(), []
        for check in (check for check in checks if _chapter(check) == chapter):
            progress(check.name)
            recorded = record(check, profile, seed, SETS[size].examples)
            vectors = list(selected(recorded, SETS[size]))
            cases += [entry for vector in vectors if (entry := describe_case(vector, table)) is not None]
            if not vectors:
                why = "large: in the full set" if recorded else "no golden value"
                left_out.append(
                    {"check": check.name, "requirements": list(check.requirements), "what": check.summary, "why": why}
                )
        if cases:
            files[f"{chapter}.json"], files[f"{chapter}.npz"] = (
                to_json({"objects": table.objects, "cases": cases}),
                to_npz(table.arrays),
            )
            names[f"{chapter}.json"] = [case["name"] for case in cases]
    index = {
        "format": FORMAT,
        "package": package_version(),
        "made_with": {"numpy": np.__version__, "hypothesis": hypothesis.__version__},
        "set": size,
        "profile": profile,
        "seed": seed,
        "floor": FLOOR,
        "files": {
            name: _about(content) | ({"cases": names[name]} if name in names else {}) for name, content in files.items()
        },
        "left_out": left_out,
    }
    with _writing(directory):
        for path in old:
            path.unlink()
        for name, content in {**files, "index.json": to_json(index)}.items():
            (directory / name).write_bytes(content)
    return index


def checks_to_record(only: str = "") -> list[Check]:
    """The checks of every dtype whose name or requirement ids contain `only`, in the order of their names."""
    return sorted(
        {check.name: check for dtype in DTYPES for check in selected_checks(dtype, only)}.values(),
        key=lambda check: check.name,
    )


def selected(vectors: Iterable[Vector], size: Size) -> Iterator[Vector]:
    """The vectors of one check that a set of this size holds."""
    taken: Counter[tuple[str, bool]] = Counter()
    large: set[str] = set()
    for vector in vectors:
        most = size.whole if vector.check.name.startswith(WHOLE) else size.bytes
        if vector.function == "loss_derivatives" and weight(vector) > most:
            vector = along_one_direction(vector)
        refused, bytes_ = vector.refused is not None, weight(vector)
        allowed = size.large if refused or vector.function in large else most
        if taken[vector.function, refused] < (size.refused if refused else size.results) and bytes_ <= allowed:
            taken[vector.function, refused] += 1
            if bytes_ > size.large:
                large.add(vector.function)
            yield vector


def describe_case(vector: Vector, table: Table) -> dict[str, Any] | None:
    """The entry of a vector in the JSON file of its chapter, its arrays in the table; None if it has an argument that
    JSON cannot write."""
    check = vector.check
    try:
        arguments = {
            name: table.encode(value) for name, value in zip(INTERFACE[vector.function], vector.arguments, strict=True)
        }
    except TypeError:
        return None
    entry: dict[str, Any] = {
        "name": vector.name,
        "what": check.summary,
        "function": vector.function,
        "requirements": list(check.requirements),
        "chapter": chapter_of(check.requirements[0]),
        "level": check.level,
        "arguments": arguments,
    }
    if vector.refused is not None:
        entry["refused"] = {"error": "ValueError", "naming": list(vector.refused)}
    else:
        entry["results"] = [_describe_output(output, table) for output in vector.outputs]
        entry["gradients"] = [
            {
                "of": list(gradient.of),
                "by": gradient.by,
                "expected": table.array(gradient.expected),
                "scale": gradient.scale,
                "tolerance": dict(gradient.tolerance),
            }
            for gradient in gradients(vector)
        ]
    entry["kills"] = kills(StoredCase(entry, table, FLOOR))
    return entry


def _describe_output(output: Output, table: Table) -> dict[str, Any]:
    scale = output.scale
    described = "expected" if scale is None else float(scale.flat[0]) if _constant(scale) else table.array(scale)
    return {
        "at": list(output.path),
        "expected": table.array(output.expected),
        "scale": described,
        "tolerance": dict(output.tolerance),
    }


def _constant(scale: np.ndarray) -> bool:
    return bool(scale.size and np.all(scale == scale.flat[0]))


def _about(content: bytes) -> dict[str, Any]:
    return {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}


@contextlib.contextmanager
def _writing(directory: Path) -> Iterator[None]:
    """Raises UserError where the directory cannot be written."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write {directory}: {error.strerror}") from error


def _of_older_set(directory: Path) -> list[Path]:
    """The files of the set that the directory holds.

    Raises:
      UserError: it holds something else.
    """
    there = list(directory.iterdir())
    if there and not {path.name for path in there} <= _named_in_index(directory):
        raise UserError(f"{directory} holds other things than vectors; give an empty or a new directory")
    return there


def _named_in_index(directory: Path) -> set[str]:
    """index.json and the files that it names; none where it is no index of vectors."""
    try:
        return {"index.json", *json.loads((directory / "index.json").read_text(encoding="utf-8"))["files"]}
    except (OSError, ValueError, TypeError, KeyError):
        return set()


def _chapter(check: Check) -> str:
    return check.name.partition(".")[0]


def weight(vector: Vector) -> int:
    """Bytes of the arrays of a vector, as they are stored but for compression."""
    return _bytes((vector.arguments, tuple(output.expected for output in vector.outputs)))


def _bytes(value: Any) -> int:
    if isinstance(value, dict):
        return sum(map(_bytes, value.values()))
    return (
        sum(map(_bytes, value))
        if isinstance(value, tuple)
        else shortest(value).nbytes
        if isinstance(value, np.ndarray)
        else 0
    )


def package_version() -> str:
    """Of the installed package, or of the checkout that this is."""
    try:
        return importlib.metadata.version("dreamer-spec")
    except importlib.metadata.PackageNotFoundError:
        return str(
            tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"][
                "version"
            ]
        )
