"""How a record becomes bytes.

A chunk file, the records that are not written yet, and a packed batch of new records are all the same thing: a list of
*sections*, each an array [records, bytes] of uint8. Section 0 holds the small entries side by side, one section follows
for every large observation, and the last one holds the latents, which alone are ever overwritten. Few long rows instead
of many short ones: a sequence is read with one copy per section.
"""

import dataclasses
import json
import math
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.options import DETER_DTYPES
from reference_numpy.shapes import require_shape

Sections = list[NDArray[np.uint8]]

TYPES: dict[str, type[np.generic]] = {
    "reward": np.float32,
    "is_first": np.bool_,
    "is_last": np.bool_,
    "is_terminal": np.bool_,
    "action": np.float32,
    "deter": np.float32,
    "stoch": np.int32,
}
VECTORS = ("action", "deter", "stoch")
LATENTS = ("deter", "stoch")
LARGE = 512  # bytes: from here on an observation has a section of its own, so that sampling does not copy it twice
_MOST_BYTES = 2**31  # of one record: nothing sensible comes near


@dataclasses.dataclass(frozen=True)
class RecordLayout:
    """The entries of a record and where their bytes are.

    entries: key -> (dtype, shape) as given to and returned by the buffer. deter_dtype: "bfloat16" or "float32", how
    `deter` is stored.
    classes: an entry of `stoch` is in [0, classes); up to 256 classes it takes one byte.
    """

    entries: dict[str, tuple[np.dtype[Any], tuple[int, ...]]]
    deter_dtype: str
    classes: int

    def __post_init__(self) -> None:
        if self.deter_dtype not in DETER_DTYPES:
            raise ValueError(f"deter_dtype is {self.deter_dtype!r}; expected one of {', '.join(DETER_DTYPES)}")
        if not 1 <= self.classes <= 2**31:
            raise ValueError(f"classes is {self.classes}; expected 1 to 2**31")
        small = [key for key in self.entries if key not in LATENTS and key not in self.large]
        fields = {key: (self.entries[key][0], self.entries[key][1]) for key in small}
        object.__setattr__(self, "rows_dtype", _packed(fields))
        deter = np.dtype(np.uint16 if self.deter_dtype == "bfloat16" else np.float32)
        stored = {
            "deter": (deter, self.entries["deter"][1]),
            "stoch": (index_type(self.classes), self.entries["stoch"][1]),
        }
        object.__setattr__(self, "latents_dtype", _packed(stored))
        object.__setattr__(self, "section_bytes", self._section_bytes())

    rows_dtype: np.dtype[Any] = dataclasses.field(init=False, repr=False, compare=False)
    latents_dtype: np.dtype[Any] = dataclasses.field(init=False, repr=False, compare=False)
    section_bytes: list[int] = dataclasses.field(init=False, repr=False, compare=False)

    @property
    def large(self) -> list[str]:
        """The observations with a section of their own, in their order."""
        return [
            key
            for key, (dtype, shape) in self.entries.items()
            if key not in TYPES and dtype.itemsize * math.prod(shape) >= LARGE
        ]

    @property
    def observations(self) -> list[str]:
        return [key for key in self.entries if key not in TYPES]

    @property
    def record_bytes(self) -> int:
        """Bytes of one stored record."""
        return sum(self.section_bytes)

    def _section_bytes(self) -> list[int]:
        large = [self.entries[key][0].itemsize * math.prod(self.entries[key][1]) for key in self.large]
        return [self.rows_dtype.itemsize, *large, self.latents_dtype.itemsize]

    def pack(self, steps: Mapping[str, Any]) -> Sections:
        """Sections of N records.

        Args:
          steps: every entry as [N, ...]. The result may share their memory: it is to be used before they change.

        Raises:
          ValueError: an entry is missing or unknown, or differs in shape or kind from the layout; a class index is out
            of range.
        """
        values = {key: np.asarray(value) for key, value in steps.items()}
        if values.keys() != self.entries.keys():
            raise ValueError(
                f"the record has the keys {sorted(values)}; expected {sorted(self.entries)} as in the first record"
            )
        count = len(values["reward"])
        for key, value in values.items():
            dtype, shape = self.entries[key]
            if value.shape != (count, *shape):
                require_shape(f"{key} of the record", value.shape[1:], *shape)
                raise ValueError(f"{key} of the record: expected {count} records, got shape {value.shape}")
            if value.dtype != dtype and not np.can_cast(value.dtype, dtype, "same_kind"):
                raise ValueError(f"{key} of the record: expected numbers of type {dtype}, got {value.dtype}")
        self.require_indices("stoch of the record", values["stoch"])
        rows = np.zeros(count, self.rows_dtype)
        for key in self.rows_dtype.names or ():
            rows[key] = values[key]
        large = [as_bytes(np.ascontiguousarray(values[key], self.entries[key][0])) for key in self.large]
        return [as_bytes(rows), *large, self.pack_latents(values["deter"], values["stoch"])]

    def require_indices(self, name: str, stoch: NDArray[Any]) -> None:
        """Raises:
        ValueError: `stoch` holds something else than class indices.
        """
        if stoch.dtype.kind not in "iu":
            raise ValueError(f"{name}: expected class indices of an integer type, got {stoch.dtype}")
        low, high = (stoch.min(), stoch.max()) if stoch.size else (0, 0)
        if low < 0 or high >= self.classes:
            raise ValueError(f"{name}: expected class indices in [0, {self.classes}), got {low} to {high}")

    def pack_latents(self, deter: NDArray[Any], stoch: NDArray[Any]) -> NDArray[np.uint8]:
        """The bytes [N, ...] of latents: deter [N, D], stoch [N, S] class indices in range."""
        latents = np.zeros(len(stoch), self.latents_dtype)
        if self.deter_dtype == "bfloat16":
            latents["deter"] = to_bfloat16(np.asarray(deter, np.float32))
        else:
            latents["deter"] = deter
        latents["stoch"] = stoch
        return as_bytes(latents)

    def unpack_latents(self, latents: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """deter [N, D] float32 and stoch [N, S] int32 of bytes [N, ...]."""
        stored = np.ascontiguousarray(latents).view(self.latents_dtype)[:, 0]
        deter = from_bfloat16(stored["deter"]) if self.deter_dtype == "bfloat16" else np.array(stored["deter"])
        return deter, stored["stoch"].astype(np.int32)

    def rows(self, section: NDArray[np.uint8]) -> NDArray[Any]:
        """Section 0, [..., bytes], as records [...] with named entries; no copy."""
        return section.view(self.rows_dtype)[..., 0]

    def to_json(self) -> dict[str, Any]:
        entries = [[key, dtype.str, list(shape)] for key, (dtype, shape) in self.entries.items()]
        return {"entries": entries, "deter_dtype": self.deter_dtype, "classes": self.classes}

    @classmethod
    def from_json(cls, data: Any) -> "RecordLayout":
        """Raises:
        ValueError: anything else than `to_json` gives.
        """
        try:
            entries = {
                str(key): (_number_type(dtype), tuple(_size(n) for n in shape)) for key, dtype, shape in data["entries"]
            }
            layout = cls(entries, str(data["deter_dtype"]), _size(data["classes"]))
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"not a layout of records: {error!r}") from error
        if layout.to_json() != json.loads(json.dumps(data)) or layout.record_bytes > _MOST_BYTES:
            raise ValueError("not a layout of records")
        _require_complete(entries)
        return layout


class Packed(NamedTuple):
    """Records that are ready to be added."""

    layout: RecordLayout
    sections: Sections


def layout_of(step: Mapping[str, Any], deter_dtype: str, classes: int) -> RecordLayout:
    """The layout of the first record.

    Raises:
      ValueError: an entry is missing, has another number of dimensions, or is no array of numbers.
    """
    values = {key: np.asarray(value) for key, value in step.items()}
    _require_complete(values)
    for key in TYPES:
        require_shape(f"{key} of the record", values[key].shape, *("n",) * (key in VECTORS))
    for key, value in values.items():
        if value.dtype.kind not in "biuf":
            raise ValueError(f"{key} of the record: expected numbers, got {value.dtype}")
    floats = {key: np.float32 for key, value in values.items() if value.dtype.kind == "f"}
    dtypes = {
        key: np.dtype(TYPES.get(key, floats.get(key, value.dtype))).newbyteorder("=") for key, value in values.items()
    }
    return RecordLayout({key: (dtypes[key], value.shape) for key, value in values.items()}, deter_dtype, classes)


def index_type(classes: int) -> np.dtype[Any]:
    """The narrowest type that holds an index below `classes`."""
    return np.dtype(np.uint8 if classes <= 2**8 else np.uint16 if classes <= 2**16 else np.int32)


def to_bfloat16(x: NDArray[np.float32]) -> NDArray[np.uint16]:
    """The upper halves of the nearest bfloat16, ties to even; NaN stays NaN."""
    bits = np.ascontiguousarray(x).view(np.uint32)
    rounded = bits >> 16
    rounded &= 1
    rounded += 0x7FFF
    rounded += bits
    upper = rounded.view(np.uint16)[..., sys.byteorder == "little" :: 2]
    with np.errstate(all="ignore"):
        suspicious = not np.isfinite(
            x.sum()
        )  # A NaN could round to an infinity or wrap around; looking at each would cost as much again.
    return np.where(np.isnan(x), np.uint16(0x7FC0), upper) if suspicious else upper


def from_bfloat16(upper: NDArray[np.uint16]) -> NDArray[np.float32]:
    return (upper.astype(np.uint32) << 16).view(np.float32)


def as_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """[N, ...] as [N, bytes], without a copy; the array must be contiguous."""
    return array.view(np.uint8).reshape(len(array), -1) if array.ndim else array.reshape(1).view(np.uint8)[None]


def _packed(fields: Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]]) -> np.dtype[Any]:
    """Entries side by side, the widest types first so that all are aligned."""
    ordered = sorted(fields.items(), key=lambda field: -field[1][0].itemsize)
    return np.dtype([(key, dtype, shape) for key, (dtype, shape) in ordered], align=True)


def _require_complete(entries: Mapping[str, Any]) -> None:
    missing = [key for key in TYPES if key not in entries]
    if missing or len(entries) == len(TYPES):
        raise ValueError(f"the record lacks {', '.join(missing) or 'an observation'}")


def _number_type(name: Any) -> np.dtype[Any]:
    dtype = np.dtype(str(name))
    if dtype.kind not in "biuf" or dtype.itemsize > 8 or dtype.str != name:
        raise ValueError(f"not a layout of records: {name!r} is no type of numbers")
    return dtype


def _size(n: Any) -> int:
    if not isinstance(n, int) or isinstance(n, bool) or not 0 <= n <= _MOST_BYTES:
        raise ValueError(f"not a layout of records: {n!r} is no size")
    return n
