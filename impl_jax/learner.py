"""The backend behind the interface of training: one agent and its optimizer on one device."""

import dataclasses
import functools
import math
import os
import re
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from impl_jax import agent, world_model
from impl_jax.optimizer import norm
from impl_jax.shapes import compute_dtype, require, require_keys, require_shapes, wide_dtype
from spec import Config, Discrete, Spaces, parameter_table

Arrays = Mapping[str, np.ndarray]


class Learner:
    """An agent on one device.

    Each of its methods is one compiled program, noise and metrics included: a call costs one launch, whatever the
    number of parameters, and nothing but inputs and results crosses to the host.

    seed: of the initial parameters. device: see `select_device`. nonfinite: "stop" or "skip", [LOOP-40] to [LOOP-42].
    threads: that compute on the CPU, in the whole process; counts only before JAX has begun to use a device. None
    leaves them as they are.

    Raises:
      ValueError: a device that is unknown or not there, or another word for `nonfinite`.
    """

    def __init__(
        self,
        spaces: Spaces,
        config: Config,
        *,
        seed: int,
        device: str | None = None,
        nonfinite: str = "stop",
        threads: int | None = None,
    ) -> None:
        require(nonfinite in ("stop", "skip"), "nonfinite", "'stop' or 'skip'", nonfinite)
        if config.compute_dtype == "float64":
            jax.config.update("jax_enable_x64", True)
        self.spaces, self.config, self._nonfinite = spaces, config, nonfinite
        self._programs = _programs(_Static(spaces, config))
        if threads:
            # XLA has no other way to say it, and looks when it makes the client of the CPU.
            os.environ["NPROC"] = str(threads)
        self._device = select_device(device)
        self.device = ":".join([self._device.platform, *(device or "").split(":")[1:]])
        with jax.default_device(self._device):
            state = self._programs.initial_state(np.uint32(seed))
        self._state = jax.device_put(state, self._device)
        self._stopped = self._flag(False)  # on the device: no train step waits for the one before
        flags = ("reward", "is_first", "is_last", "is_terminal")
        self._batch_keys = (*spaces.observations, *flags, "prev_action", "deter", "stoch")

    def initial_carry(self, envs: int) -> Any:
        """The carry of `envs` environments before their first step. [CON-5]"""
        dtype, config = compute_dtype(self.config), self.config
        shapes = {"deter": (envs, config.deter), "stoch": (envs, config.stoch, config.classes)}
        carry = {key: jnp.zeros(shape, dtype) for key, shape in shapes.items()}
        carry["action"] = jnp.zeros((envs, self.spaces.action_size), wide_dtype(config))
        return jax.device_put(carry, self._device)

    def save_carry(self, carry: Any) -> dict[str, np.ndarray]:
        """A carry as arrays, exactly: what is bfloat16 becomes float32."""
        return {
            key: np.asarray(value.astype(jnp.float32) if value.dtype == jnp.bfloat16 else value)
            for key, value in carry.items()
        }

    def load_carry(self, arrays: Arrays) -> Any:
        """The inverse of `save_carry`. [CON-5]"""
        zeros = self.initial_carry(len(arrays["action"]))
        carry = {key: jnp.asarray(arrays[key], value.dtype) for key, value in zeros.items()}
        return jax.device_put(carry, self._device)

    def memory(self) -> int | None:
        """Bytes in use on the accelerator; None without one."""
        statistics = None if self._device.platform == "cpu" else self._device.memory_stats()
        return statistics and statistics.get("bytes_in_use")

    def policy(
        self, observation: Arrays, is_first: np.ndarray, carry: Any, seed: int, mode: bool = False
    ) -> tuple[np.ndarray, Arrays, Any]:
        """One acting step of N environments. [AGT-11]

        observation: key -> [N, ...]; is_first [N]; seed: of the random numbers; mode: the action is the mode of the
        actor, [LOOP-71]. Returns the flat action [N, A], the latents {"deter" [N, D], "stoch" [N, S] class indices},
        which may still be computing, and the new carry.
        """
        inputs = {key: np.asarray(observation[key]) for key in self.spaces.observations if key in observation}
        inputs = jax.device_put((inputs, np.asarray(is_first, bool)), self._device)
        carry, latents = self._programs.policy(self._state["params"], carry, *inputs, np.uint32(seed), mode=mode)
        return np.asarray(carry["action"]), latents, carry

    def train_step(self, batch: Arrays, seed: int) -> tuple[Mapping[str, Any], Arrays]:
        """One gradient step with the random numbers of a seed. [AGT-29], [AGT-30], [LOOP-40] to [LOOP-42]

        Returns metrics by name and the latents to write back, which may still be computing.
        """
        inputs = self._inputs(batch)
        self._state, skipped, metrics, latents = self._programs.train(
            self._state, self._stopped, inputs, np.uint32(seed)
        )
        if self._nonfinite == "stop":
            self._stopped = skipped
        return {name: _Element(metrics.values, index) for index, name in enumerate(metrics.names)}, latents

    def gradients(self, batch: Arrays, seed: int) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Metrics and gradients by name, as a train step would compute them now. Changes nothing. [LOOP-44]"""
        metrics, gradients = self._programs.gradients(self._state, self._inputs(batch), np.uint32(seed))
        numbers = dict(zip(metrics.names, np.asarray(metrics.values).tolist(), strict=True))
        return numbers, {name: np.array(gradient) for name, gradient in gradients.items()}

    def predict(
        self, observation: Arrays, prev_action: np.ndarray, is_first: np.ndarray, context: int, seed: int
    ) -> dict[str, np.ndarray]:
        """The open-loop prediction of recorded sequences, with the noise of a seed. [WM-20] to [WM-24]

        observation {key: [B, T, ...]}, prev_action [B, T, A], is_first [B, T].
        """
        observed = {key: np.asarray(observation[key]) for key in self.spaces.observations if key in observation}
        arrays = (observed, np.asarray(prev_action), np.asarray(is_first, bool))
        inputs, prev_action, is_first = jax.device_put(arrays, self._device)
        predictions = self._programs.predict(
            self._state["params"], inputs, prev_action, is_first, context, np.uint32(seed)
        )
        return {key: np.asarray(value) for key, value in predictions.items()}

    def train_noise(self, batch: Arrays, seed: int) -> dict[str, np.ndarray]:
        """The random numbers of `train_step` with this seed: posterior [B, T, S], prior [B*T, H, S], action [B*T, H,
        K]. [CON-20]"""
        with jax.default_device(self._device):
            noise = self._programs.train_noise(np.shape(batch["is_first"]), np.uint32(seed))
        return {name: np.asarray(x) for name, x in noise.items()}

    def policy_noise(self, envs: int, seed: int) -> dict[str, np.ndarray]:
        """The random numbers of `policy` with this seed: posterior [N, S], action [N, K]. [CON-19]"""
        with jax.default_device(self._device):
            noise = self._programs.policy_noise(envs, np.uint32(seed))
        return {name: np.asarray(x) for name, x in noise.items()}

    def state_dict(self) -> dict[str, np.ndarray]:
        """The training state under its canonical names. [AGT-8], [AGT-9]"""
        state = {name: np.array(value) for name, value in _flatten(self._state).items()}
        return state | {"optimizer/step": state["optimizer/step"].astype(np.int64)}

    def load_state_dict(self, state: Arrays) -> None:
        """Takes over a training state. [AGT-10]

        Raises:
          ValueError: a missing or unknown name, or a wrong shape; nothing is changed then.
        """
        current = _flatten(self._state)
        require_shapes("training state", state, {name: value.shape for name, value in current.items()})
        # Copies, because the next train step reuses the memory of the state.
        new = {name: np.array(state[name], value.dtype) for name, value in current.items()}
        self._state = jax.device_put(_unflatten(new), self._device)
        self._stopped = self._flag(False)

    def _flag(self, value: bool) -> jax.Array:
        return jax.device_put(np.asarray(value), self._device)

    def _inputs(self, batch: Arrays) -> dict[str, jax.Array]:
        require_keys("batch", batch, self._batch_keys)
        return jax.device_put({key: batch[key] for key in self._batch_keys}, self._device)


@functools.partial(jax.tree_util.register_dataclass, data_fields=["values"], meta_fields=["names"])
@dataclasses.dataclass(frozen=True)
class _Metrics:
    """Numbers in one array, which comes to the host in one copy."""

    names: tuple[str, ...]
    values: jax.Array


class _Element:
    """One number of an array that may still be computing."""

    def __init__(self, array: jax.Array, index: int) -> None:
        self._array, self._index = array, index

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(np.asarray(self._array)[self._index], dtype)

    def __float__(self) -> float:
        return float(np.asarray(self._array)[self._index])


class _Static:
    """Spaces and configuration as one hashable argument."""

    def __init__(self, spaces: Spaces, config: Config) -> None:
        self.spaces, self.config = spaces, config

    def __hash__(self) -> int:
        return hash(repr((self.spaces, self.config)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Static) and repr((self.spaces, self.config)) == repr((other.spaces, other.config))


@functools.lru_cache(maxsize=4)
def _programs(static: _Static) -> "_Programs":
    """Shared by the learners of a process that differ in their state alone, so that each is compiled once."""
    return _Programs(static.spaces, static.config)


class _Programs:
    """The compiled functions of agents with these spaces and this configuration."""

    def __init__(self, spaces: Spaces, config: Config) -> None:
        self.spaces, self.config = spaces, config
        self.initial_state = jax.jit(self._initial_state)
        self.policy = jax.jit(self._policy, static_argnames="mode")
        self.train = jax.jit(self._train, donate_argnums=0)  # the new state takes the memory of the old one
        self.gradients = jax.jit(self._gradients)
        self.predict = jax.jit(self._predict, static_argnums=4)
        self.train_noise = jax.jit(self._train_noise, static_argnums=0)
        self.policy_noise = jax.jit(self._policy_noise, static_argnums=0)

    def _initial_state(self, seed: jax.Array) -> dict[str, Any]:
        table = parameter_table(self.config, self.spaces)
        kernels = {name: entry.shape for name, entry in table.items() if entry.initializer == "truncated_normal"}
        # One draw for all kernels, cut up: every draw of its own would be compiled by itself.
        ends = np.cumsum([math.prod(shape) for shape in kernels.values()])
        numbers = jax.random.uniform(jax.random.key(seed), (int(ends[-1]),), wide_dtype(self.config))
        pieces = zip(kernels.items(), jnp.split(numbers, ends[:-1]), strict=True)
        uniforms = {name: piece.reshape(shape) for (name, shape), piece in pieces}
        return agent.initial_state(agent.initial_parameters(table, uniforms))

    def _policy(
        self, params: Any, carry: Any, observation: Any, is_first: jax.Array, seed: jax.Array, *, mode: bool
    ) -> tuple[Any, Any]:
        noise = self._policy_noise(len(is_first), seed)
        latents = {"deter": carry["deter"], "stoch": carry["stoch"]}
        latents, action = agent.policy_step(
            params, latents, carry["action"], observation, is_first, noise, self.spaces, self.config, mode
        )
        return latents | {"action": action}, self._stored(latents)

    def _train(self, state: Any, stopped: jax.Array, batch: Any, seed: jax.Array) -> tuple[Any, jax.Array, Any, Any]:
        new, aux = agent.train_step(
            state, batch, self._train_noise(batch["is_first"].shape, seed), self.spaces, self.config
        )
        metrics = {f"loss/{name}": mean for name, mean in aux["losses"].items()} | aux["metrics"]
        # Chosen on the device, so that the host waits for no train step before it starts the next.
        finite = jnp.isfinite(metrics["loss/total"]) & jnp.isfinite(metrics["gradient_norm"])
        applied = finite & ~stopped
        state = jax.tree.map(lambda after, before: jnp.where(applied, after, before), new, state)
        metrics |= {"update_norm": jnp.where(applied, metrics["update_norm"], 0.0), "skipped": ~applied}
        return state, ~applied, self._packed(metrics), self._stored(aux)

    def _gradients(self, state: Any, batch: Any, seed: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        return_range = (state["return_range"]["low"], state["return_range"]["high"])
        noise = self._train_noise(batch["is_first"].shape, seed)
        gradients, total, aux = agent.gradients(
            state["params"], state["slow_critic"], return_range, batch, noise, self.spaces, self.config
        )
        low, high = aux["return_range"]
        metrics = {f"loss/{name}": mean for name, mean in aux["losses"].items()} | aux["metrics"]
        metrics |= {"loss/total": total, "return_low": low, "return_high": high}
        metrics["gradient_norm"] = norm(jnp.stack([norm(gradient) for gradient in gradients.values()]))
        return self._packed(metrics), gradients

    def _policy_noise(self, envs: int, seed: jax.Array) -> dict[str, jax.Array]:
        return _noise(seed, {"posterior": (envs, self.config.stoch)}, (envs,), self.spaces, self.config)

    def _train_noise(self, shape: tuple[int, ...], seed: jax.Array) -> dict[str, jax.Array]:
        """All random numbers of a step, drawn before its loops, which draw none. [CON-20]"""
        B, T = shape
        N, H, S = B * T, self.config.imagination_horizon, self.config.stoch
        uniforms = {"posterior": (B, T, S), "prior": (N, H, S)}
        return _noise(seed, uniforms, (N, H), self.spaces, self.config)

    def _packed(self, metrics: Mapping[str, jax.Array]) -> "_Metrics":
        dtype = wide_dtype(self.config)
        return _Metrics(tuple(metrics), jnp.stack([value.astype(dtype) for value in metrics.values()]))

    def _predict(
        self, params: Any, observation: Any, prev_action: jax.Array, is_first: jax.Array, context: int, seed: jax.Array
    ) -> dict[str, jax.Array]:
        (B, T), key = is_first.shape, jax.random.key(seed)
        shapes = {
            "posterior": (B, max(0, context), self.config.stoch),
            "prior": (B, max(0, T - context), self.config.stoch),
        }
        dtype = wide_dtype(self.config)
        noise = {
            name: jax.random.uniform(jax.random.fold_in(key, i), shape, dtype)
            for i, (name, shape) in enumerate(shapes.items())
        }
        return world_model.open_loop(
            params, observation, prev_action, is_first, context, noise, self.spaces, self.config
        )

    def _stored(self, states: Any) -> dict[str, jax.Array]:
        """Latents as the replay buffer keeps them."""
        return {
            "deter": states["deter"].astype(jnp.float32),
            "stoch": jnp.argmax(states["stoch"], -1).astype(jnp.int32),
        }


def select_device(name: str | None) -> jax.Device:
    """The device of that name: "cpu", "gpu" or "cuda", "cuda:1", ...; None takes the best that JAX finds.

    Raises:
      ValueError: an unknown device, or one that this installation of JAX does not have.
    """
    if name is None:
        return jax.devices()[0]
    match = re.fullmatch(r"(cpu)|(gpu|cuda)(?::([0-9]+))?", name)
    if match is None:
        raise ValueError(f"unknown device {name!r}; expected cpu, gpu, cuda, gpu:<number> or cuda:<number>")
    try:
        devices = jax.devices(match[1] or match[2])
    except RuntimeError as error:
        raise ValueError(
            f"JAX finds no device {name!r} here, only {jax.default_backend()!r}; install jax[cuda12] for a GPU"
        ) from error
    index = int(match[3] or 0)
    if index >= len(devices):
        raise ValueError(f"JAX finds no device {name!r} here: there are {len(devices)} GPUs, counted from 0")
    return devices[index]


def _noise(
    seed: jax.Array, uniforms: Mapping[str, tuple[int, ...]], leading: tuple[int, ...], spaces: Spaces, config: Config
) -> dict[str, jax.Array]:
    """Uniforms of the given shapes, and "action" [*leading, K]: normals for a Vector, uniforms for a Discrete.

    Every array has a key of its own, counted from the seed's. [CON-19] to [CON-21]
    """
    key, dtype = jax.random.key(seed), wide_dtype(config)
    noise = {
        name: jax.random.uniform(jax.random.fold_in(key, i), shape, dtype)
        for i, (name, shape) in enumerate(uniforms.items())
    }
    parts = []
    for index, space in enumerate(spaces.actions.values(), len(uniforms)):
        draw = jax.random.uniform if isinstance(space, Discrete) else jax.random.normal
        parts.append(draw(jax.random.fold_in(key, index), (*leading, *space.array_shape), dtype))
    return noise | {"action": jnp.concatenate(parts, -1)}


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, jax.Array]:
    """Nested mappings as one, with names joined by "/"."""
    flat: dict[str, jax.Array] = {}
    for name, value in tree.items():
        flat |= _flatten(value, f"{prefix}{name}/") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def _unflatten(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The training state from its canonical names: parameter names keep their slashes. [AGT-9]"""
    state: dict[str, Any] = {
        "params": {},
        "slow_critic": {},
        "optimizer": {"second_moment": {}, "momentum": {}},
        "return_range": {},
    }
    for name, value in flat.items():
        group, rest = name.split("/", 1)
        if group == "optimizer" and rest != "step":
            moment, rest = rest.split("/", 1)
            state[group][moment][rest] = value
        else:
            state[group][rest] = value
    return state
