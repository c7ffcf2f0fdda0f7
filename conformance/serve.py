"""Offers the functions of a Python file to `conformance check --process`, over standard input and output.

    python -m conformance.serve my_adapter.py
    python serve.py my_adapter.py                 where only this file was copied

It needs NumPy and what the adapter itself imports, and nothing else of this project. What the adapter prints goes to
standard error. Nothing is unpickled and no code is received: a message holds numbers, text and arrays. The format:
protocol.schema.json, docs/adapters.md.
"""

from __future__ import annotations

import base64
import dataclasses
import difflib
import importlib.util
import json
import math
import os
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np

PROTOCOL = 1
OBJECTS = ("Learner", "Replay", "ReplayRatio", "run")  # give or take what has methods, which no message holds
DTYPES = ("bool", "uint8", "int32", "int64", "float32", "float64")


class BadMessage(Exception):
    """A message that does not follow the protocol. Not a ValueError: that is how an implementation refuses an
    argument."""


def to_numpy(value: Any) -> Any:
    """What an implementation returned, with NumPy arrays of one of DTYPES, plain numbers, tuples, and mappings with
    text as keys.

    Tensors may require gradients and lie on a device. Named tuples, dataclasses and what has items() become mappings.

    Raises:
      TypeError: there is something that is neither numbers nor a collection of them.
    """
    if value is None:
        raise TypeError("expected numbers, got None: is a `return` missing?")
    if isinstance(value, (bool, int, float)):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping) or callable(getattr(value, "items", None)):
        return {str(key): to_numpy(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(to_numpy(entry) for entry in value)
    return _to_array(value)


def _to_array(value: Any) -> np.ndarray:
    if hasattr(value, "detach"):  # PyTorch
        value = value.detach().cpu()
        value = value.double() if value.is_floating_point() else value  # NumPy has no bfloat16
    array = np.asarray(value)
    if array.dtype.name in DTYPES:
        return array
    if array.dtype.kind in "iu":
        return array.astype(np.int64)
    if array.dtype.kind == "f" or array.dtype.name.startswith(("bfloat", "float")):
        return array.astype(np.float64)
    raise TypeError(f"expected numbers, got {type(value).__name__}")


def encode(value: Any) -> Any:
    """A value in plain JSON types: arrays as {"dtype", "shape", "data"}, mappings as {"map": ...}, NaN and infinities
    as arrays."""
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float) and math.isfinite(value) and not isinstance(value, np.generic):
        return value
    if isinstance(value, Mapping):
        return {"map": {str(key): encode(entry) for key, entry in value.items()}}
    if isinstance(value, (tuple, list)):
        return [encode(entry) for entry in value]
    array = _to_array(value)
    data = array.astype(array.dtype.newbyteorder("<")).tobytes()
    return {"dtype": array.dtype.name, "shape": list(array.shape), "data": base64.b64encode(data).decode("ascii")}


def decode(value: Any) -> Any:
    """The inverse of `encode`. {"object": ...}, a configuration or spaces, becomes a namespace: config.units,
    spaces.actions["arm"].size.

    Raises:
      BadMessage: it does not follow the protocol.
    """
    if isinstance(value, list):
        return tuple(decode(entry) for entry in value)
    if not isinstance(value, dict):
        return value
    if value.keys() == {"dtype", "shape", "data"}:
        return _decode_array(**value)
    if value.keys() == {"map"} and isinstance(value["map"], dict):
        return {key: decode(entry) for key, entry in value["map"].items()}
    if value.keys() == {"object"}:
        return _namespace(value["object"])
    raise BadMessage(f"expected an array, a map or an object, got the keys {sorted(value)}")


def _decode_array(dtype: Any, shape: Any, data: Any) -> np.ndarray:
    if dtype not in DTYPES:
        raise BadMessage(f"expected one of the dtypes {', '.join(DTYPES)}, got {dtype!r}")
    if not isinstance(shape, list) or not all(type(length) is int and length >= 0 for length in shape):
        raise BadMessage(f"expected a shape of whole numbers, 0 or more, got {shape!r}")
    try:
        raw = base64.b64decode(data, validate=True)
    except (TypeError, ValueError) as error:
        raise BadMessage(f"the data of an array are not base64: {error}") from error
    kind = np.dtype(dtype).newbyteorder("<")
    if len(raw) != kind.itemsize * math.prod(shape):
        raise BadMessage(
            f"an array of {dtype} and shape {shape} takes {kind.itemsize * math.prod(shape)} bytes, got {len(raw)}"
        )
    return np.frombuffer(raw, kind).astype(dtype).reshape(shape)


def _namespace(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_namespace(entry) for entry in value)
    if not isinstance(value, dict):
        return value
    entries = {key: _namespace(entry) for key, entry in value.items()}
    return SimpleNamespace(**entries) if isinstance(entries.get("kind"), str) else entries


def answer(adapter: Any, request: Mapping[str, Any]) -> dict[str, Any]:
    """The reply to one request. Whatever the adapter raises becomes an error."""
    try:
        return {"id": request.get("id"), "result": _result(adapter, request)}
    except (ValueError, NotImplementedError) as error:
        kind, message = "ValueError" if isinstance(error, ValueError) else "NotImplementedError", str(error)
    except KeyError as error:  # a parameter is missing: its name says it
        kind, message = "KeyError", str(error.args[0] if error.args else error)
    except Exception as error:
        kind, message = type(error).__name__, traceback.format_exc(limit=-4) + missing_field(error)
    return {"id": request.get("id"), "error": {"kind": kind, "message": message}}


def missing_field(error: Exception) -> str:
    """Of an error because a configuration or spaces lack what was asked of them: the closest that they have. Of others
    nothing."""
    given = getattr(error, "obj", None) if isinstance(error, AttributeError) else None
    if not isinstance(given, SimpleNamespace) and (not dataclasses.is_dataclass(given) or isinstance(given, type)):
        return ""
    asked, fields = str(getattr(error, "name", "")), [name for name in dir(given) if not name.startswith("_")]
    close = difflib.get_close_matches(asked, fields, n=3, cutoff=0.5)
    return f"is {' or '.join(close)} meant instead of {asked}?" if close else f"there are: {', '.join(fields)}"


def _result(adapter: Any, request: Mapping[str, Any]) -> Any:
    method = request.get("method")
    if method == "start":
        if request.get("protocol") != PROTOCOL:
            raise BadMessage(f"this server speaks protocol {PROTOCOL}, not {request.get('protocol')!r}")
        getattr(adapter, "setup", lambda dtype: None)(request["dtype"])
        names = [name for name in dir(adapter) if not name.startswith("_") and callable(getattr(adapter, name))]
        names = [name for name in names if name not in OBJECTS]
        names += ["vjp"] if "convert" in names and "vjp" not in names else []
        return {
            "protocol": PROTOCOL,
            "name": adapter.__name__,
            "version": str(getattr(adapter, "__version__", "")),
            "functions": names,
        }
    if method == "edition":
        return getattr(adapter, "edition", lambda: None)()
    if method == "run":
        convert = getattr(adapter, "convert", None)
        arguments = [convert_arrays(decode(argument), convert) for argument in request["args"]]
        return encode(to_numpy(function_of(adapter, request["function"])(*arguments)))
    if method == "stop":
        return None
    raise BadMessage(f"unknown method {method!r}")


def convert_arrays(value: Any, convert: Any) -> Any:
    """The argument with `convert` applied to every array in it; None leaves all as they are."""
    if convert is None:
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        return convert(np.asarray(value))
    if isinstance(value, Mapping):
        return {key: convert_arrays(entry, convert) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(convert_arrays(entry, convert) for entry in value)
    return value


def function_of(adapter: Any, name: str) -> Any:
    """A function of the adapter; `vjp` of an adapter that has none is made from its tensors."""
    if name == "vjp" and not hasattr(adapter, "vjp"):
        return lambda function, arguments, cotangents: vjp(getattr(adapter, function), arguments, cotangents)
    return getattr(adapter, name)


def vjp(function: Any, arguments: tuple[Any, ...], cotangents: Any) -> tuple[Any, ...]:
    """What flows back into the arguments of a function that computes with tensors of PyTorch or JAX.

    Args:
      function: of the adapter.
      arguments: with tensors; those of real numbers are followed.
      cotangents: a tensor of the shape of the result, or name -> tensor for several results.

    Returns:
      The arguments, with the gradient of the sum of results times cotangents in place of each tensor that was followed,
      and 0 in place of all else.

    Raises:
      NotImplementedError: no gradient can be seen: other arrays, or results that do not hang together with them.
    """
    leaves: list[Any] = []
    replaced(arguments, leaves.append)
    library = {type(leaf).__module__.partition(".")[0] for leaf in leaves}
    if "torch" in library:
        gradients = _torch_vjp(function, arguments, leaves, cotangents)
    elif library & {"jax", "jaxlib"}:
        gradients = _jax_vjp(function, arguments, leaves, cotangents)
    else:
        raise NotImplementedError("gradients: `convert` makes tensors of neither PyTorch nor JAX")
    found = iter(gradients)
    return tuple(replaced(argument, lambda _: next(found), lambda _: 0) for argument in arguments)


def replaced(value: Any, tensor: Any, other: Any = lambda value: value) -> Any:
    """The value with `tensor` applied to every array or tensor of real numbers in it, and `other` to all else."""
    if isinstance(value, Mapping):
        return {key: replaced(entry, tensor, other) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(replaced(entry, tensor, other) for entry in value)
    is_real = "float" in str(getattr(value, "dtype", "")) and hasattr(value, "shape")
    return tensor(value) if is_real else other(value)


def _weighted(result: Any, cotangents: Any) -> Any:
    """The sum of all results times their cotangents, which have their names or their order."""
    if not isinstance(cotangents, Mapping):
        if "float" not in str(getattr(result, "dtype", "")):
            raise NotImplementedError("gradients: its results are not real numbers of a tensor")
        return (result * cotangents).sum()
    if callable(getattr(result, "items", None)):
        result = dict(result.items())
        result = [result[name] for name in cotangents]
    elif not isinstance(result, (tuple, list)) or hasattr(result, "_asdict"):
        result = [getattr(result, name) for name in cotangents]
    return sum(_weighted(part, weight) for part, weight in zip(result, cotangents.values()))  # noqa: B905 - Python 3.8


def _torch_vjp(function: Any, arguments: Any, leaves: list[Any], cotangents: Any) -> list[Any]:
    torch = sys.modules["torch"]
    leaves = [leaf.detach().requires_grad_() for leaf in leaves]
    given = iter(leaves)
    try:
        total = _weighted(function(*replaced(arguments, lambda _: next(given).clone())), cotangents)
    except RuntimeError as error:
        if "requires grad" not in str(error):
            raise
        raise NotImplementedError(f"gradients: its tensors leave PyTorch: {error}") from error
    if not getattr(total, "requires_grad", False):
        raise NotImplementedError("gradients: its results have none")
    found = torch.autograd.grad(total, leaves, allow_unused=True)
    if all(gradient is None for gradient in found):
        raise NotImplementedError("gradients: its results do not come from the tensors that it was given")
    pairs = zip(leaves, found)  # noqa: B905 - Python 3.8
    return [torch.zeros_like(leaf) if gradient is None else gradient for leaf, gradient in pairs]


def _jax_vjp(function: Any, arguments: Any, leaves: list[Any], cotangents: Any) -> list[Any]:
    jax = sys.modules["jax"]

    def total(leaves: list[Any]) -> Any:
        given = iter(leaves)
        return _weighted(function(*replaced(arguments, lambda _: next(given))), cotangents)

    try:
        return list(jax.grad(total)(leaves))
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        reason = str(error).partition("\n")[0]
        raise NotImplementedError(f"gradients: JAX cannot trace it: {reason}") from error


def serve(adapter: Any, requests: BinaryIO, replies: BinaryIO) -> None:
    """Answers one request after the other until `stop` or the end of the input."""
    for line in requests:
        request = json.loads(line)
        replies.write(json.dumps(answer(adapter, request)).encode("ascii") + b"\n")
        replies.flush()
        if request.get("method") == "stop":
            return


def load_file(path: Path) -> Any:
    """A Python file as a module. It may import its neighbours."""
    sys.path.insert(0, str(path.resolve().parent))
    specification = importlib.util.spec_from_file_location(path.stem, path)
    if specification is None or specification.loader is None:
        raise ImportError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(specification)
    sys.modules.setdefault(path.stem, module)  # where dataclasses look up the names of their annotations
    specification.loader.exec_module(module)
    return module


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python -m conformance.serve my_adapter.py")
    # Run as a file, its directory comes first on the path, where other modules may hide those of the standard library.
    if not __package__ and os.path.realpath(sys.path[0]) == os.path.dirname(os.path.realpath(__file__)):
        del sys.path[0]
    # Messages have the pipes to themselves: what anything else prints, C libraries included, goes to standard error,
    # and what anything else reads, programs that the adapter starts included, is empty.
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    serve(load_file(Path(sys.argv[1])), requests, replies)


if __name__ == "__main__":
    main()
