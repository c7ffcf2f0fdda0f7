"""The PyTorch backend as a candidate."""

import dataclasses
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch

from conformance.serve import vjp
from impl_torch import (
    agent,
    behavior,
    distributions,
    layers,
    networks,
    optimizer,
    returns,
    rssm,
    transforms,
    world_model,
)
from impl_torch.learner import Learner, select_device
from impl_torch.shapes import DTYPES
from spec import Config, Spaces

CHAPTERS = (transforms, distributions, layers, rssm, networks, world_model, returns, behavior, optimizer, agent)
ARRAYS = (torch.Tensor, transforms.Bins)
# What has no configuration to say in which precision it computes takes it from its first argument.
NARROW = (layers,)


class TorchAdapter:
    """Offers every public function of impl_torch under its name, with NumPy arrays in and float64 NumPy arrays out."""

    def __init__(self, dtype: str, device: str | None) -> None:
        self._dtype = dtype
        self._device = select_device(device)
        self._wide = torch.float64 if dtype == "float64" else torch.float32
        if self._device.type == "cuda":
            torch.set_float32_matmul_precision("highest")
            torch.backends.cudnn.allow_tf32 = False

    def __getattr__(self, name: str) -> Any:
        function, narrow = _function(name)
        return self._wrap(function, narrow)

    def vjp(self, function: str, arguments: tuple[Any, ...], cotangents: Any) -> Any:
        with_tensors = self._with_tensors(*_function(function))
        return _leave(vjp(with_tensors, self._enter(arguments), self._enter(cotangents)))

    def Learner(self, spaces: Spaces, config: Config, seed: int) -> Learner:  # noqa: N802
        return Learner(spaces, self._enter(config), seed=seed, device=self._device.type)

    def imagine(self, params: Any, carry: Any, action: np.ndarray, uniform: np.ndarray, config: Config) -> Any:
        actions = self._enter(action)
        return self._wrap(rssm.imagine)(params, carry, lambda feature, t: actions[:, t], uniform, config)

    def losses(self, *arguments: Any) -> Any:
        return self._wrap(agent.losses)(*_with_pair(arguments))

    def gradients(self, *arguments: Any) -> Any:
        return self._wrap(agent.gradients)(*_with_pair(arguments))[0]

    def loss_derivatives(self, *arguments: Any) -> dict[str, np.ndarray]:
        *problem, directions = arguments
        params, *rest = (self._enter(x) for x in _with_pair(tuple(problem)))
        params = {name: x.requires_grad_() for name, x in params.items()}
        _, aux = agent.losses(params, *rest)
        derivatives = {}
        for name, loss in aux["losses"].items():
            by_leaf = torch.autograd.grad(loss, list(params.values()), retain_graph=True, materialize_grads=True)
            by_name = dict(zip(params, map(_leave, by_leaf), strict=True))
            derivatives[name] = np.array(
                [sum(np.sum(by_name[key] * np.asarray(x)) for key, x in along.items()) for along in directions]
            )
        return derivatives

    def _wrap(self, function: Callable[..., Any], narrow: bool = False) -> Callable[..., Any]:
        with_tensors = self._with_tensors(function, narrow)
        return lambda *arguments: _leave(with_tensors(*arguments))

    def _with_tensors(self, function: Callable[..., Any], narrow: bool) -> Callable[..., Any]:
        """The function with arrays or tensors in and tensors out."""
        wanted = [parameter.annotation for parameter in inspect.signature(function).parameters.values()]

        def call(*arguments: Any) -> Any:
            # A single number is an array where the function wants one. What has a default, the interface may not know.
            arrays = (
                np.asarray(x) if np.isscalar(x) and kind in ARRAYS else x
                for x, kind in zip(arguments, wanted, strict=False)
            )
            converted = [self._enter(x) for x in arrays]
            if narrow and isinstance(converted[0], torch.Tensor) and converted[0].is_floating_point():
                converted[0] = converted[0].to(DTYPES[self._dtype])
            if function in (layers.dense, layers.mlp):
                converted[2] = converted[2].to(DTYPES[self._dtype])
            kept = [x.detach().clone() for x in _tensors(converted)]
            result = function(*converted)
            for before, x in zip(kept, _tensors(converted), strict=True):
                if not torch.equal(before.nan_to_num(), x.nan_to_num()):
                    raise RuntimeError(f"{function.__name__} wrote into an argument of shape {list(x.shape)}")
            return result

        return call

    def _enter(self, x: Any) -> Any:
        if isinstance(x, Config):
            return dataclasses.replace(x, compute_dtype=self._dtype)
        if isinstance(x, Mapping):
            return {key: self._enter(value) for key, value in x.items()}
        if isinstance(x, tuple):
            return tuple(self._enter(value) for value in x)
        if isinstance(x, np.ndarray):
            tensor = torch.tensor(x, device=self._device)
            return tensor.to(self._wide) if tensor.is_floating_point() else tensor
        return x


def _function(name: str) -> tuple[Callable[..., Any], bool]:
    """A public function of impl_torch, and whether its first argument has the compute dtype."""
    for chapter in CHAPTERS:
        function: Any = vars(chapter).get(name)
        if not name.startswith("_") and getattr(function, "__module__", None) == chapter.__name__:
            return function, chapter in NARROW and name != "truncated_normal"
    raise AttributeError(name)


def _tensors(x: Any) -> Iterator[torch.Tensor]:
    """The tensors of a nested value."""
    if isinstance(x, torch.Tensor):
        yield x
    elif isinstance(x, Mapping | tuple | list):
        for entry in x.values() if isinstance(x, Mapping) else x:
            yield from _tensors(entry)


def _with_pair(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """`losses` takes the return range as a pair; the state holds it as a mapping."""
    params, slow_critic, return_range, *rest = arguments
    pair = (return_range["low"], return_range["high"]) if isinstance(return_range, Mapping) else return_range
    return params, slow_critic, tuple(np.asarray(end) for end in pair), *rest


def _leave(x: Any) -> Any:
    if isinstance(x, torch.Tensor):
        return x.detach().to("cpu", torch.float64).numpy()
    if isinstance(x, Mapping):
        return {key: _leave(value) for key, value in x.items()}
    if isinstance(x, tuple):
        return tuple(_leave(value) for value in x)
    return x


def make_adapter(dtype: str, device: str | None) -> TorchAdapter:
    return TorchAdapter(dtype, device)
