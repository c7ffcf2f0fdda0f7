"""The JAX backend as a candidate."""

import contextlib
import dataclasses
import functools
import gc
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from conformance.serve import vjp
from impl_jax import agent, behavior, distributions, layers, networks, optimizer, returns, rssm, transforms, world_model
from impl_jax.learner import Learner, select_device
from spec import Config, Spaces

CHAPTERS = (transforms, distributions, layers, rssm, networks, world_model, returns, behavior, optimizer, agent)
# Functions of layers whose first array is not of the compute dtype; other chapters take float32 or better and convert
# it themselves.
EXACT = ("truncated_normal", "dense", "mlp")
# Options of XLA, which come and go with its versions. Small calls take less time than optimizing them. But where
# rounding errors must cancel, what is judged is compiled as it is in training: they depend on what XLA fuses.
QUICK = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
OPTIMIZED = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
# From so many time steps on, the gradient of the total alone is compiled apart from those of every loss: it takes a
# tenth of the time, which for small batches is less than compiling.
LARGE = 32
CANCELLING = {module.__name__ for module in (transforms, distributions, returns)}


class JaxAdapter:
    """Offers every public function of impl_jax under its name, NumPy in and NumPy out, compiled."""

    def __init__(self, dtype: str, device: str | None) -> None:
        self.dtype = dtype
        self.exact = np.dtype("float64" if dtype == "float64" else "float32")
        self.device = select_device(device)
        self.compiled: dict[Any, Callable[..., Any]] = {}
        self.quick = False

    def __getattr__(self, name: str) -> Any:
        function = _function(name)
        narrow = self.dtype == "bfloat16" and function.__module__ == layers.__name__ and name not in EXACT
        return functools.partial(self._run, function, name, jnp.bfloat16 if narrow else None)

    def vjp(self, function: str, arguments: tuple[Any, ...], cotangents: Any) -> Any:
        def pull(cotangents: Any, *arguments: Any) -> Any:
            return vjp(_function(function), arguments, cotangents)

        return self._run(pull, ("vjp", function), None, cotangents, *arguments)

    def compile_calls(self, calls: Iterable[tuple[str, tuple[Any, ...]]]) -> None:
        """Compiles what these calls need, several at a time, and everything without the optimizations that take longer
        than small calls themselves. What a call raises is raised when it is made."""
        self.quick = True
        calls = (("gradients", inputs[:-1]) if name == "loss_derivatives" else (name, inputs) for name, inputs in calls)
        distinct = {_signature(call): call for call in calls}
        largest_first = sorted(distinct, key=lambda signature: len(str(signature)), reverse=True)

        def make(call: tuple[str, tuple[Any, ...]]) -> None:
            with contextlib.suppress(Exception):
                getattr(self, call[0])(*call[1])

        gc.disable()  # tracing makes millions of objects, few of them garbage
        try:
            with ThreadPoolExecutor(os.cpu_count()) as threads:
                list(threads.map(make, [distinct[signature] for signature in largest_first]))
        finally:
            gc.freeze()
            gc.enable()

    def exponential_bins(self, bins: int) -> np.ndarray:
        return transforms.exponential_bins(bins)

    def dense(self, params: Any, name: str, x: Any, epsilon: float) -> Any:
        return self._layers_of("dense", layers.dense, params, x, name, epsilon)

    def mlp(self, params: Any, name: str, x: Any, count: int, epsilon: float) -> Any:
        return self._layers_of("mlp", layers.mlp, params, x, name, count, epsilon)

    def _layers_of(self, key: str, function: Callable[..., Any], params: Any, x: Any, name: str, *rest: Any) -> Any:
        x = self._cast(x, jnp.bfloat16 if self.dtype == "bfloat16" else None)
        return self._run(lambda params, x: function(params, name, x, *rest), (key, name, *rest), None, params, x)

    def Learner(self, spaces: Spaces, config: Config, seed: int) -> Learner:  # noqa: N802
        return Learner(spaces, self._config(config), seed=seed, device=self.device.platform)

    def imagine(self, params: Any, carry: Any, action: Any, uniform: Any, config: Config) -> Any:
        def function(params: Any, carry: Any, action: Any, uniform: Any, config: Config) -> Any:
            return rssm.imagine(params, carry, lambda feature, t: action[:, t], uniform, config)

        return self._run(function, "imagine", None, params, carry, action, uniform, config)

    def laprop(self, gradient: Any, second_moment: Any, momentum: Any, step: int, config: Config) -> Any:
        return self._run(
            optimizer.laprop,
            "laprop",
            None,
            gradient,
            second_moment,
            momentum,
            np.asarray(step, np.int32),
            config,
        )

    def gradients(self, *inputs: Any) -> Any:
        if inputs[3]["reward"].size >= LARGE:
            return self._run(lambda *inputs: agent.gradients(*inputs)[0], "gradients of the total", None, *inputs)
        return self._gradients(*inputs)["total"]

    def loss_derivatives(self, *arguments: Any) -> dict[str, np.ndarray]:
        *inputs, directions = arguments

        def along(gradient: Any) -> np.ndarray:
            return np.array(
                [sum(np.vdot(gradient[name], change) for name, change in direction.items()) for direction in directions]
            )

        return {name: along(gradient) for name, gradient in self._gradients(*inputs).items() if name != "total"}

    def _gradients(self, *inputs: Any) -> Any:
        """Gradients of the total and of every loss by every parameter, by one compiled function."""

        def function(params: Any, *rest: Any) -> Any:
            def outputs(params: Any) -> Any:
                total, aux = agent.losses(params, *rest)
                return {"total": total, **aux["losses"]}

            values, pullback = jax.vjp(outputs, params)
            rows = jnp.eye(len(values), dtype=self.exact)  # one output after the other: [output, ...] of each parameter
            gradients = jax.lax.map(lambda row: pullback(dict(zip(values, row, strict=True)))[0], rows)
            return {name: {key: value[index] for key, value in gradients.items()} for index, name in enumerate(values)}

        return self._run(function, "gradients", None, *inputs)

    def initial_parameters(self, table: Any, uniforms: Any) -> Any:
        key = ("initial_parameters", repr(table))
        return self._run(lambda uniforms: agent.initial_parameters(table, uniforms), key, None, uniforms)

    def _run(self, function: Callable[..., Any], key: Any, first: Any, *arguments: Any) -> Any:
        """Calls a function with configuration, spaces and plain numbers as they are, and arrays as traced arguments."""
        arguments = tuple(self._config(argument) for argument in arguments)
        is_static = [isinstance(argument, str | bool | int | float | Config | Spaces) for argument in arguments]
        dynamic = [argument for argument, static in zip(arguments, is_static, strict=True) if not static]
        dynamic = [self._cast(argument, first if index == 0 else None) for index, argument in enumerate(dynamic)]

        def call(*dynamic: Any) -> Any:
            values = iter(dynamic)
            return function(
                *(argument if static else next(values) for argument, static in zip(arguments, is_static, strict=True))
            )

        call.__name__ = key if isinstance(key, str) else key[0]  # for profilers
        statics = tuple(
            repr(argument) if static else None for argument, static in zip(arguments, is_static, strict=True)
        )
        options = accepted(OPTIMIZED if function.__module__ in CANCELLING else QUICK) if self.quick else None
        compiled = self.compiled.setdefault((key, statics), jax.jit(call, compiler_options=options))
        with jax.default_device(self.device):
            return _to_numpy(compiled(*dynamic))

    def _config(self, argument: Any) -> Any:
        return dataclasses.replace(argument, compute_dtype=self.dtype) if isinstance(argument, Config) else argument

    def _cast(self, x: Any, dtype: Any = None) -> Any:
        """Real numbers in the dtype given, or in float32 or float64; other numbers as they are."""
        if isinstance(x, Mapping):
            return {name: self._cast(value, dtype) for name, value in x.items()}
        if isinstance(x, tuple | list):
            return tuple(self._cast(value, dtype) for value in x)
        if isinstance(x, jax.Array):
            return x
        array = np.asarray(x)
        if array.dtype.kind == "f":
            with np.errstate(over="ignore"):
                array = array.astype(self.exact).astype(dtype or self.exact)
        elif array.dtype.kind == "i":
            array = array.astype(np.int32)
        return jax.device_put(array, self.device)  # jnp.asarray would compile for each shape


def _function(name: str) -> Callable[..., Any]:
    """A public function of impl_jax."""
    for chapter in CHAPTERS:
        function: Any = vars(chapter).get(name)
        if not name.startswith("_") and getattr(function, "__module__", None) == chapter.__name__:
            return function
    raise AttributeError(name)


def accepted(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those that this version of XLA knows."""
    return {name: value for name, value in options.items() if _is_accepted(name, value)}


@functools.cache
def _is_accepted(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options={name: value})()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def _signature(value: Any) -> Any:
    """What a compiled function depends on: names, shapes and types of arrays, and everything else as it is."""
    if isinstance(value, Mapping):
        return tuple((key, _signature(entry)) for key, entry in value.items())
    if isinstance(value, tuple | list):
        return tuple(map(_signature, value))
    return (value.shape, str(value.dtype)) if isinstance(value, np.ndarray) else repr(value)


def _to_numpy(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {name: _to_numpy(value) for name, value in x.items()}
    if isinstance(x, tuple):
        return tuple(_to_numpy(value) for value in x)
    if isinstance(x, float):
        return x
    array = np.asarray(x)
    return array if array.dtype.kind in "iu" else array.astype(np.float64)


def make_adapter(dtype: str, device: str | None) -> JaxAdapter:
    """The adapter for one compute dtype; float64 switches JAX to 64-bit numbers for the whole process."""
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)
    return JaxAdapter(dtype, device)
