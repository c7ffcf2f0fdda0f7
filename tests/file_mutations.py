"""Mutations of files: of their bytes, of JSON, of the header of a safetensors file, and of a folder of files."""

import copy
import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# Mutations of the bytes of a file


def flip_bit(data: bytearray, chance: random.Random) -> None:
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def overwrite(data: bytearray, chance: random.Random) -> None:
    where = chance.randrange(len(data))
    data[where : where + 8] = chance.randbytes(8)


def zero(data: bytearray, chance: random.Random) -> None:
    where = chance.randrange(len(data))
    data[where : where + 64] = bytes(len(data[where : where + 64]))


def cut(data: bytearray, chance: random.Random) -> None:
    del data[chance.randrange(len(data)) :]


def grow(data: bytearray, chance: random.Random) -> None:
    data += chance.randbytes(chance.randrange(1, 100))


def reverse(data: bytearray, chance: random.Random) -> None:
    where = chance.randrange(len(data))
    data[where:] = data[where:][::-1]


def hostile_number(data: bytearray, chance: random.Random) -> None:
    """A NaN, an infinity or a huge number among the parameters, or a wrong length of the header."""
    where = chance.choice([0, 4, 4 * chance.randrange(len(data) // 4)])
    data[where : where + 4] = np.float32(chance.choice([np.nan, np.inf, -3e38, 1e-45])).tobytes()


BYTES: list[Callable[[bytearray, random.Random], None]] = [
    flip_bit,
    overwrite,
    zero,
    cut,
    grow,
    reverse,
    hostile_number,
]

# Mutations of JSON: of a description, or of the header of a safetensors file

HOSTILE: list[Any] = [
    *(
        None,
        True,
        False,
        -1,
        0,
        1,
        2,
        7,
        2**31,
        2**53,
        2**63 - 1,
        2**64,
        10**400,
        0.5,
        -0.0,
        1e308,
        float("nan"),
        float("inf"),
    ),
    *(
        "",
        "x",
        "x" * 100_000,
        "\ud800",
        "../../etc/passwd",
        "vector",
        "image",
        [],
        {},
        [0],
        [2**40, 2**40],
        [1] * 70,
        {"kind": "image"},
    ),
    *("F64", "BF16", "F8_E4M3", "BOOL", "C64", [0, 2**60], [0, 0], [[[[[[]]]]]], [-1, 4], ["a"], [2] * 5000),
]


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) in a tree of JSON."""
    found: list[tuple[Any, Any]] = []
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in entries:
        found += [(value, key), *places(entry)]
    return found


def edit(tree: Any, chance: random.Random) -> str:
    """The text of a tree of JSON after an edit or two."""
    for _ in range(chance.randrange(1, 3)):
        found = places(tree)
        if not found:
            break
        container, key = chance.choice(found)
        kind = chance.choice(["value", "value", "value", "number", "missing", "rename", "exchange"])
        if kind == "missing":
            del container[key]
        elif kind == "rename" and isinstance(container, dict):
            container[chance.choice(["", "x", "params/", "../x", "\u0000"])] = container.pop(key)
        elif kind == "exchange":
            other, other_key = chance.choice(found)
            container[key], other[other_key] = other[other_key], container[key]
            if cyclic(tree):
                return "{}"
        elif kind == "number" and type(container[key]) is int:
            container[key] = max(0, container[key] + chance.choice([-1, 1, 4, 100])) * chance.choice([1, 1, 2, 10**9])
        else:
            container[key] = copy.deepcopy(chance.choice(HOSTILE))
    text = json.dumps(tree, allow_nan=True)
    kind = chance.randrange(12)
    if kind == 0:  # a name twice
        entry = text[1 : text.find(",")]
        text = f"{{{entry},{text[1:]}"
    elif kind == 1:  # deep
        text = text.replace("[", "[" * chance.choice([100, 100_000]), 1)
    elif kind == 2:
        text = chance.choice(
            ["", "null", "[]", "3", '"x"', "{" * 50_000, '{"a":' * 50_000, "[" * 500_000, " " * (2**20 + 1), "\ufeff{}"]
        )
    return text


def cyclic(tree: Any) -> bool:
    try:
        json.dumps(tree)
    except (ValueError, RecursionError):
        return True
    return False


def relabel(header: dict[str, Any], chance: random.Random) -> str:
    """A header that the format allows and that says something else of one array or two."""
    one, other = chance.sample(sorted(header), 2)
    entry = header[one]
    kind = chance.choice(["dtype", "dtype", "shape", "exchange", "flatten", "empty", "axes"])
    if kind == "dtype":
        entry["dtype"] = chance.choice(
            ["I32", "U32", "F16", "BF16", "F64", "C64", "F8_E4M3", "F8_E5M2", "F4", "BOOL", "I8"]
        )
        size = {"F16": 2, "BF16": 2, "F64": 8, "C64": 8, "F4": 0.5, "I32": 4, "U32": 4}.get(entry["dtype"], 1)
        first, last = entry["data_offsets"]
        entry["shape"] = [int((last - first) / size)]
    elif kind == "shape":
        entry["shape"] = entry["shape"][::-1]
    elif kind == "exchange":
        header[one], header[other] = header[other], header[one]
    elif kind == "flatten":
        entry["shape"] = [int(np.prod(entry["shape"]))]
    elif kind == "empty":
        sides = chance.choice([[0], [0, 2**40], [2**63, 0], [0] * 40])
        header[chance.choice(["params/x", "x", one + "/x"])] = {"dtype": "F32", "shape": sides, "data_offsets": [0, 0]}
    else:
        entry["shape"] += [1] * chance.choice([1, 40, 100])
    return json.dumps(header)


def edit_header(data: bytes, chance: random.Random) -> bytes:
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    if chance.random() < 0.5:
        text = relabel(header, chance).encode()
        return len(text).to_bytes(8, "little") + text + data[8 + length :]
    text = edit(header, chance).encode("utf-8", "surrogatepass")
    said = chance.choice([len(text)] * 8 + [0, len(text) - 1, len(text) + 1, 2**27, 2**40, 2**63])
    return said.to_bytes(8, "little") + text + data[8 + length :]


# Mutations of a folder


def mutate(folder: Path, names: tuple[str, ...], chance: random.Random) -> str:
    """Spoils one file or two of a folder. Returns how."""
    kinds = ["bytes", "json", "json", "header", "header", "swap", "missing", "irregular", "copy"]
    kind = chance.choice(kinds)
    if kind == "swap":
        one, other = (folder / name for name in chance.sample([*names, "SHA256SUMS"], 2))
        content = one.read_bytes()
        one.write_bytes(other.read_bytes())
        other.write_bytes(content)
    elif kind == "copy":
        one, other = chance.sample(names, 2)
        shutil.copyfile(folder / one, folder / other)
    elif kind in ("missing", "irregular"):
        path = folder / chance.choice([*names, "SHA256SUMS"])
        path.unlink()
        if kind == "irregular":
            chance.choice(
                [
                    path.mkdir,
                    lambda: os.mkfifo(path),
                    lambda: path.symlink_to("/dev/zero"),
                    lambda: path.symlink_to(path),
                ]
            )()
    elif kind == "json":
        path = next(folder / name for name in names if name.endswith(".json"))
        path.write_bytes(edit(json.loads(path.read_text()), chance).encode("utf-8", "surrogatepass"))
    elif kind == "header":
        path = folder / chance.choice([name for name in names if name.endswith(".safetensors")])
        path.write_bytes(edit_header(path.read_bytes(), chance))
    else:
        for _ in range(chance.randrange(1, 3)):
            path = folder / chance.choice([*names, "SHA256SUMS"])
            data = bytearray(path.read_bytes())
            if data:
                chance.choice(BYTES)(data, chance)
            path.write_bytes(data)
    return kind
