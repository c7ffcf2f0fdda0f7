"""Values as JSON and arrays: what docs/vectors.md describes, in both directions.

Arrays stand in a table beside the JSON, each once, however often it is used; so do configurations and spaces.
"""

import dataclasses
import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from conformance.process import describe
from spec import Config, Discrete, Image, Parameter, Spaces, Vector

FORMAT = 2
DTYPES = ("bool", "uint8", "int32", "int64", "float32", "float64")
KINDS = {kind.__name__.lower(): kind for kind in (Config, Discrete, Image, Parameter, Spaces, Vector)}
EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a zip archive can hold."""


class Table:
    """The arrays and the objects of one file, each under a name of its own."""

    def __init__(
        self, arrays: Mapping[str, np.ndarray] | None = None, objects: Mapping[str, Any] | None = None
    ) -> None:
        self.arrays = dict(arrays or {})
        self.objects = dict(objects or {})
        self._names: dict[bytes, str] = {}

    def encode(self, value: Any) -> Any:
        """A value in plain JSON types, its arrays and objects in the table.

        Raises:
          TypeError: it is neither numbers, text, objects of the specification, nor a collection of these.
        """
        if isinstance(value, bool | str):
            return value
        if isinstance(value, np.bool_ | np.integer | int):
            return bool(value) if isinstance(value, np.bool_) else int(value)
        if isinstance(value, float | np.floating) and math.isfinite(value):
            return float(value)
        if dataclasses.is_dataclass(value):
            return {"object": self._object(describe(value))}
        if isinstance(value, Mapping):
            return {"map": {key: self.encode(entry) for key, entry in value.items()}}
        if isinstance(value, tuple | list):
            return [self.encode(entry) for entry in value]
        return self.array(np.asarray(value))

    def array(self, array: np.ndarray) -> dict[str, Any]:
        """The reference to an array."""
        array = shortest(array)
        if array.dtype.name not in DTYPES:
            raise TypeError(f"expected one of the dtypes {', '.join(DTYPES)}, got {array.dtype}")
        key = f"{array.dtype}{array.shape}".encode() + array.tobytes()
        name = self._names.setdefault(hashlib.sha256(key).digest(), f"a{len(self.arrays)}")
        self.arrays[name] = array
        return {"array": name, "shape": list(array.shape)}

    def _object(self, described: dict[str, Any]) -> str:
        described.pop("compute_dtype", None)  # the precision is the reader's
        key = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).digest()
        name = self._names.setdefault(key, f"{described['kind']}{len(self.objects)}")
        self.objects[name] = described
        return name

    def decode(self, value: Any, dtype: str) -> Any:
        """The inverse of `encode`, with configurations that compute in `dtype`."""
        if isinstance(value, list):
            return tuple(self.decode(entry, dtype) for entry in value)
        if not isinstance(value, dict):
            return value
        if "map" in value:
            return {key: self.decode(entry, dtype) for key, entry in value["map"].items()}
        if "object" in value:
            return _restore(self.objects[value["object"]], dtype)
        array = self.arrays[value["array"]]
        return array.astype(np.float64) if array.dtype.kind == "f" else array


def shortest(array: np.ndarray) -> np.ndarray:
    """The array, real numbers as float32 where that loses nothing."""
    array = np.ascontiguousarray(array).reshape(array.shape)  # the former gives a single number an axis
    if array.dtype.kind != "f":
        return array
    with np.errstate(over="ignore"):
        narrow, wide = array.astype(np.float32), array.astype(np.float64)
    return narrow if np.array_equal(narrow.astype(np.float64), wide, equal_nan=True) else wide


def _restore(described: Any, dtype: str) -> Any:
    """Objects of the specification from their descriptions, which also hold what is derived from the fields."""
    if isinstance(described, list):
        return tuple(_restore(entry, dtype) for entry in described)
    if not isinstance(described, dict):
        return described
    if not isinstance(described.get("kind"), str):  # a key of observations may be "kind", too
        return {key: _restore(entry, dtype) for key, entry in described.items()}
    kind = KINDS[described["kind"]]
    given = {"compute_dtype": dtype, **described}
    return kind(**{field.name: _restore(given[field.name], dtype) for field in dataclasses.fields(kind)})


def to_npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Compressed; the bytes depend on the arrays alone, not on the time or the system."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", EPOCH)
            member.compress_type, member.create_system, member.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
            content = io.BytesIO()
            np.lib.format.write_array(
                content, array.astype(array.dtype.newbyteorder("<")), version=(1, 0), allow_pickle=False
            )
            archive.writestr(member, content.getvalue(), compresslevel=9)
    return file.getvalue()


def read_npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def to_json(entries: Mapping[str, Any]) -> bytes:
    """One line for each entry of the collections in it, so that differences can be read."""
    text = ",\n".join(f"{_text(name)}: {_lines(entry)}" for name, entry in entries.items())
    return f"{{\n{text}\n}}\n".encode()


def _lines(entry: Any) -> str:
    if isinstance(entry, list) and entry:
        return "[\n " + ",\n ".join(map(_text, entry)) + "\n]"
    if isinstance(entry, dict) and entry:
        return "{\n " + ",\n ".join(f"{_text(key)}: {_text(value)}" for key, value in entry.items()) + "\n}"
    return _text(entry)


def _text(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False)
