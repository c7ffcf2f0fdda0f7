"""Reads a set of vectors back, and says where an implementation deviates from it."""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from conformance.compare import relative_deviation, scale_of
from conformance.errors import UserError, read_text
from conformance.vectors.format import FORMAT, Table, read_npz


@dataclasses.dataclass(frozen=True, eq=False)
class StoredCase:
    """One case of a set, and the table that its arrays and objects stand in."""

    entry: Mapping[str, Any]
    table: Table
    floor: Mapping[str, float]

    @property
    def name(self) -> str:
        return str(self.entry["name"])

    @property
    def dtypes(self) -> set[str]:
        """The dtypes that it has tolerances for; every one where the call must be refused."""
        return (
            set(self.floor)
            if "refused" in self.entry
            else {dtype for result in self.entry["results"] for dtype in result["tolerance"]}
        )

    def arguments(self, dtype: str = "float64") -> tuple[Any, ...]:
        return tuple(self.table.decode(value, dtype) for value in self.entry["arguments"].values())

    def array(self, reference: Any) -> np.ndarray:
        return np.asarray(self.table.decode(reference, "float64"))


def read_index(directory: Path) -> dict[str, Any]:
    """The index of a set.

    Raises:
      UserError: there is none, or it has another format.
    """
    try:
        index: dict[str, Any] = json.loads(read_text(directory / "index.json"))
    except (UserError, ValueError) as error:
        raise UserError(
            f"no vectors in {directory}: it has no index.json that can be read; write some with: conformance "
            f"vectors --out {directory}"
        ) from error
    if index.get("format") != FORMAT:
        raise UserError(
            f"{directory} has vectors of the format {index.get('format')!r}, expected {FORMAT}; write them again"
        )
    return index


def read_cases(directory: Path) -> Iterator[StoredCase]:
    """Every case of a set, in the order of its files."""
    index = read_index(directory)
    for name in index["files"]:
        if name.endswith(".json"):
            content = json.loads((directory / name).read_text(encoding="utf-8"))
            table = Table(read_npz(directory / name.replace(".json", ".npz")), content["objects"])
            for entry in content["cases"]:
                yield StoredCase(entry, table, index["floor"])


def deviations(case: StoredCase, adapter: object, dtype: str) -> list[str]:
    """What an adapter does other than the case says; nothing where all is right."""
    function, arguments = getattr(adapter, case.entry["function"]), case.arguments(dtype)
    if refused := case.entry.get("refused"):
        try:
            function(*arguments)
        except ValueError as error:
            return [
                f"the message {str(error)!r} does not hold {word!r}"
                for word in refused["naming"]
                if word not in str(error)
            ]
        return ["not refused"]
    actual = function(*arguments)
    found = (
        _deviation(case, result, actual, dtype) for result in case.entry["results"] if dtype in result["tolerance"]
    )
    return [message for message in found if message]


def _deviation(case: StoredCase, result: Mapping[str, Any], actual: Any, dtype: str) -> str:
    for key in result["at"]:
        actual = actual[key]
    actual, expected, scale = np.asarray(actual, np.float64), case.array(result["expected"]), result["scale"]
    where = f"{case.entry['function']}{''.join(f'[{key}]' for key in result['at'])}"
    if actual.shape != expected.shape:
        return f"{where}: expected shape {expected.shape}, got {actual.shape}"
    magnitude = None if scale == "expected" else case.table.decode(scale, dtype)
    largest = float(
        relative_deviation(actual, expected, scale_of(expected, magnitude, case.floor[dtype])).max(initial=0.0)
    )
    tolerance = result["tolerance"][dtype]
    return f"{where}: off by {largest:.3g}, allowed {tolerance:.3g}" if largest > tolerance else ""
