"""What third-party functions return, in the form that the checks compare: only where it can mean one thing."""

import abc
import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from conformance.adapter import Adapter, Array
from conformance.errors import UserError
from conformance.interface import INTERFACE, OBJECTS, RESULTS
from spec import Config

MAPPINGS = frozenset(
    name
    for name in INTERFACE
    if str(inspect.signature(getattr(Adapter, name)).return_annotation).startswith("collections.abc.Mapping")
)
"""Functions whose result is a mapping."""

TAKE_ARRAYS = {
    name: tuple(
        parameter.annotation is Array for parameter in inspect.signature(getattr(Adapter, name)).parameters.values()
    )[1:]
    for name in INTERFACE
}
"""Every function -> for each of its arguments, whether it is an array. A single number then comes as an array without
axes."""

LATENTS = ("stoch", "logits", "posterior", "prior")
"""Where latents stand in a result: under these keys, or as the whole result of functions with these names."""
HOLD_LATENTS = (
    *("observe", "observe_given", "imagine", "imagine_given", "policy_step"),
    *("losses", "losses_given", "train_step", "train_step_with", "train_step_given"),
)


class ForeignAdapter(abc.ABC):
    """An adapter that somebody else wrote. Subclasses say what is offered and how it is called, and give results of
    `to_numpy`."""

    refuses_anyhow = True
    """What must be refused may end in an exception of any kind: nobody told its authors which."""

    @abc.abstractmethod
    def offers(self, name: str) -> bool:
        """Whether the implementation has a function of this name."""

    @abc.abstractmethod
    def call(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """The result of one of its functions."""

    @abc.abstractmethod
    def edition(self) -> str | None:
        """The edition that the implementation claims.

        Raises:
          UserError: it claims something that is no name.
        """

    def __getattr__(self, name: str) -> Any:
        if name not in INTERFACE or not self.offers(name):
            raise AttributeError(name)

        def function(*arguments: Any) -> Any:
            kinds = zip(arguments, TAKE_ARRAYS[name], strict=False)  # whether the number fits is the candidate's to say
            arguments = tuple(
                np.asarray(value) if is_array and np.isscalar(value) else value for value, is_array in kinds
            )
            result = self.call(name, arguments)
            return result if name in (*OBJECTS, "vjp") else arranged(name, arguments, result)

        return function


def as_edition(claim: Any) -> str | None:
    """What an implementation returned as its edition.

    Raises:
      UserError: it is neither a name nor None.
    """
    if claim is not None and not isinstance(claim, str):
        raise UserError(f"edition: expected a name or nothing, got {claim!r:.80}")
    return claim


def arranged(name: str, arguments: Sequence[Any], result: Any) -> Any:
    """The result of a function of the interface as its checks expect it.

    Several results may come as a tuple or by their names (RESULTS). Latents may be flat [..., S * C], samples may be
    class indices.

    Raises:
      TypeError: it is of another kind: a mapping for an array, a tuple of other length, other names.
    """
    if name in RESULTS:
        result = _in_order(name, RESULTS[name], result)
    elif name in MAPPINGS:
        if not isinstance(result, Mapping):
            raise TypeError(f"{name}: expected a dict of arrays, got {_kind(result)}")
    elif isinstance(result, Mapping):
        raise TypeError(f"{name}: expected one array, got {_kind(result)}: return the entry that is meant")
    elif isinstance(result, tuple):
        try:
            result = np.asarray(result)
        except ValueError as error:  # not one of ours: a ValueError says that an argument is refused
            raise TypeError(f"{name}: expected one array, got a tuple of parts that do not stack") from error

    config = next((argument for argument in arguments if isinstance(argument, Config)), None)
    if name == "categorical_sample":
        return _onehot(result, np.shape(arguments[0]))
    if name == "draw_categorical":
        return _onehot(result, (len(result), *np.shape(arguments[0])))
    if config is not None and name in LATENTS:
        return _latents(result, config)
    if config is not None and name in HOLD_LATENTS:
        return (
            tuple(_hold_latents(part, config) for part in result)
            if isinstance(result, tuple)
            else _hold_latents(result, config)
        )
    return result


def _in_order(name: str, names: tuple[str, ...], result: Any) -> tuple[Any, ...]:
    if isinstance(result, Mapping) and set(result) == set(names):
        return tuple(result[key] for key in names)
    if isinstance(result, tuple) and len(result) == len(names):
        return result
    raise TypeError(f"{name}: expected a tuple ({', '.join(names)}) or a dict with these keys, got {_kind(result)}")


def _hold_latents(result: Any, config: Config) -> Any:
    if not isinstance(result, Mapping):
        return result
    return {key: _latents(value, config) if key in LATENTS else value for key, value in result.items()}


def _latents(value: Any, config: Config) -> np.ndarray:
    """[..., S, C] from itself, from one flat axis, or from class indices [..., S]."""
    array, sizes = np.asarray(value), (config.stoch, config.classes)
    if array.shape[-2:] == sizes:
        return array
    if array.shape[-1:] == (config.stoch * config.classes,):
        return array.reshape(*array.shape[:-1], *sizes)
    return _onehot(array, (*array.shape, config.classes))


def _onehot(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """One-hots of the given shape from themselves, or from whole numbers without the last axis."""
    array = np.asarray(value)
    if array.dtype.kind not in "iu" or array.shape != shape[:-1]:
        return array
    if array.size and not 0 <= array.min() <= array.max() < shape[-1]:
        raise TypeError(f"expected class indices in 0 .. {shape[-1] - 1}, got {array.min()} .. {array.max()}")
    return np.asarray(array[..., None] == np.arange(shape[-1]), np.float64)


def _kind(result: Any) -> str:
    if isinstance(result, Mapping):
        return f"a dict with the keys {', '.join(map(repr, result))}"
    if isinstance(result, tuple):
        return f"a tuple of {len(result)}"
    return f"one array of shape {list(np.shape(result))}"
