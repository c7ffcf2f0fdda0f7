"""What training talks to: one agent and its optimizer on one device. Interface: dreamer_spec/backend.py."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from impl_torch.agent import gradients, initial_parameters, policy_step
from impl_torch.optimizer import clip_flat_gradients_, flat_step_, learning_rate
from impl_torch.parameters import Layout, Parameters
from impl_torch.rssm import freeze
from impl_torch.shapes import compute_dtype, require, require_shapes, wide_dtype
from impl_torch.world_model import open_loop
from spec import Config, Discrete, Spaces, parameter_table

Arrays = Mapping[str, np.ndarray]


class Learner:
    """One agent.

    All of its state lies in a few flat buffers that a train step changes in place (`parameters.py` says why): its
    memory is taken once, and the mappings of names to tensors are views that are made once.

    seed: of the initial parameters. nonfinite: "stop" or "skip", [LOOP-40] to [LOOP-42]. threads: that compute on the
    CPU, in the whole process; None leaves them as they are.

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
        self._nonfinite, self._stopped = nonfinite, False
        self.spaces, self.config = spaces, config
        self._device = select_device(device)
        self.device = str(self._device)
        if threads:
            torch.set_num_threads(threads)
        if self._device.type == "cuda":
            # [LAY-1]: TensorFloat-32 is not float32. Convolutions would use it unasked.
            torch.set_float32_matmul_precision("highest")
            torch.backends.cudnn.allow_tf32 = False
        self._dtype = wide_dtype(config)
        table = parameter_table(config, spaces)
        kernels = {name: entry.shape for name, entry in table.items() if entry.initializer == "truncated_normal"}
        generator = self._generator(seed)
        self.parameters = Parameters(
            initial_parameters(table, {name: self._uniform(generator, *shape) for name, shape in kernels.items()})
        )
        self._flat, self._layout = self.parameters.flat, self.parameters.layout
        self._critic_layout = Layout({name: entry.shape for name, entry in table.items() if name.startswith("critic/")})
        self._critic_flat = self._flat[-self._critic_layout.total :]  # the critic is the last of the table
        self._slow_flat = self._critic_flat.clone()
        self._slow_critic = self._critic_layout.views(self._slow_flat)
        self._second_moment, self._momentum, self._gradient = (torch.zeros_like(self._flat) for _ in range(3))
        self._step = 0  # updates that were made
        self._low, self._high = torch.zeros((2,), dtype=self._dtype, device=self._device).unbind()
        # The parameters as the policy uses them, with kernels in the compute dtype; until the next train step.
        self._acting: Mapping[str, Tensor] | None = None

    def initial_carry(self, envs: int) -> dict[str, Tensor]:
        """All zeros: {"deter" [N, D], "stoch" [N, S, C], "action" [N, A]}. [CON-5]"""
        c = self.config
        shapes = {"deter": (c.deter,), "stoch": (c.stoch, c.classes)}
        carry = {
            name: torch.zeros(envs, *shape, dtype=compute_dtype(c), device=self._device)
            for name, shape in shapes.items()
        }
        return carry | {"action": torch.zeros(envs, self.spaces.action_size, dtype=self._dtype, device=self._device)}

    def save_carry(self, carry: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
        """A carry as arrays, exactly: what is bfloat16 becomes float32."""
        return {name: (x.float() if x.dtype == torch.bfloat16 else x).numpy(force=True) for name, x in carry.items()}

    def load_carry(self, arrays: Arrays) -> dict[str, Tensor]:
        """The inverse of `save_carry`. [CON-5]"""
        zeros = self.initial_carry(len(arrays["action"]))
        return {name: torch.tensor(arrays[name]).to(x) for name, x in zeros.items()}

    def memory(self) -> int | None:
        """Bytes in use on the accelerator; None without one."""
        return torch.cuda.memory_allocated(self._device) if self._device.type == "cuda" else None

    @torch.no_grad()
    def policy(
        self, observation: Arrays, is_first: np.ndarray, carry: Mapping[str, Tensor], seed: int, mode: bool = False
    ) -> tuple[np.ndarray, Arrays, dict[str, Tensor]]:
        """One acting step of N environments with the noise of a seed: (action [N, A], latents, carry). [AGT-11]

        observation {key: [N, ...]}, is_first [N]; mode: the action is the mode of the actor, [LOOP-71].
        The latents {"deter" [N, D], "stoch" [N, S] class indices} may still be on their way.
        """
        noise = self._policy_noise(len(is_first), seed)
        if self._acting is None:
            self._acting = freeze(self.parameters.mapping(), self.config)
        inputs = {key: self._to_device(observation[key]) for key in self.spaces.observations}
        state, action = policy_step(
            self._acting,
            carry,
            carry["action"],
            inputs,
            self._to_device(is_first),
            noise,
            self.spaces,
            self.config,
            mode,
        )
        taken = _to_host(action.float())  # on its way before the latents, which nobody waits for here
        latents = {"deter": _to_host(state["deter"].float()), "stoch": _to_host(state["stoch"].argmax(-1))}
        return np.asarray(taken), latents, state | {"action": action}

    def train_step(self, batch: Arrays, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """One gradient step on a replay batch, with the noise of a seed: metrics by name, latents to write back.

        [AGT-29] [AGT-30] [LOOP-40] to [LOOP-42]
        """
        _, metrics, factors, aux = self._differentiate(batch, seed)
        with torch.no_grad():
            # Read on the host: with a GPU, its queue runs empty here once a step. An update that is chosen on the
            # device would have to write every buffer again.
            finite = bool(torch.stack([metrics["loss/total"].double(), metrics["gradient_norm"]]).isfinite().all())
            applied = finite and not self._stopped
            self._stopped = self._nonfinite == "stop" and not applied
            metrics |= {
                "update_norm": self._update(aux["return_range"]) if applied else self._flat.new_zeros(()),
                "clip_fraction": (factors < 1).double().mean(),
                "skipped": self._flat.new_full((), float(not applied)),
            }
            # One array, one copy: every number by itself would be a copy, and a wait, of its own.
            values = _to_host(torch.stack([value.double() for value in metrics.values()]))
            latents = {"deter": _to_host(aux["deter"].float()), "stoch": _to_host(aux["stoch"].argmax(-1))}
        return {name: _Element(values, index) for index, name in enumerate(metrics)}, latents

    def gradients(self, batch: Arrays, seed: int) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Metrics and gradients by name, as a train step would compute them now. Changes nothing. [LOOP-44]"""
        by_name, metrics, _, _ = self._differentiate(batch, seed)
        numbers = {name: float(x) for name, x in metrics.items()}
        return numbers, {name: x.cpu().numpy().copy() for name, x in by_name.items()}

    @torch.no_grad()
    def predict(
        self, observation: Arrays, prev_action: np.ndarray, is_first: np.ndarray, context: int, seed: int
    ) -> dict[str, np.ndarray]:
        """The open-loop prediction of recorded sequences, with the noise of a seed. [WM-20] to [WM-24]

        observation {key: [B, T, ...]}, prev_action [B, T, A], is_first [B, T].
        """
        generator, (B, T) = self._generator(seed), np.shape(is_first)
        noise = {
            "posterior": self._uniform(generator, B, max(0, context), self.config.stoch),
            "prior": self._uniform(generator, B, max(0, T - context), self.config.stoch),
        }
        inputs = {key: self._to_device(observation[key]) for key in self.spaces.observations if key in observation}
        actions, starts = self._to_device(prev_action), self._to_device(is_first)
        predictions = open_loop(
            self.parameters.mapping(), inputs, actions, starts, context, noise, self.spaces, self.config
        )
        return {key: value.cpu().numpy() for key, value in predictions.items()}

    def train_noise(self, batch: Arrays, seed: int) -> dict[str, np.ndarray]:
        """The random numbers of `train_step` with this seed: posterior [B, T, S], prior [B*T, H, S], action [B*T, H,
        K]. [CON-20]"""
        return {name: x.cpu().numpy() for name, x in self._train_noise(np.shape(batch["reward"]), seed).items()}

    def policy_noise(self, envs: int, seed: int) -> dict[str, np.ndarray]:
        """The random numbers of `policy` with this seed: posterior [N, S], action [N, K]. [CON-19]"""
        return {name: x.cpu().numpy() for name, x in self._policy_noise(envs, seed).items()}

    def state_dict(self) -> dict[str, np.ndarray]:
        """The training state under its canonical names, as copies. [AGT-8] [AGT-9]"""
        state = {name: x.detach().cpu().numpy().copy() for name, x in self._tensors().items()}
        return state | {"optimizer/step": np.asarray(self._step, np.int64)}

    @torch.no_grad()
    def load_state_dict(self, state: Arrays) -> None:
        """The inverse of `state_dict`. [AGT-10]

        Raises:
          ValueError: a missing or unknown name, or a wrong shape; nothing is changed then.
        """
        tensors = self._tensors()
        shapes = {name: tuple(x.shape) for name, x in tensors.items()}
        require_shapes("training state", state, shapes | {"optimizer/step": ()})
        for flat in (self._flat, self._second_moment, self._momentum, self._slow_flat):
            flat.zero_()  # the gaps between the tensors too
        for name, x in tensors.items():
            x.copy_(torch.tensor(np.asarray(state[name])))
        self._step = int(state["optimizer/step"])
        self._acting = None
        self._stopped = False

    def _differentiate(
        self, batch: Arrays, seed: int
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor, dict[str, Any]]:
        """(gradients, metrics, factors of the clipping [P], aux); leaves the clipped gradients in `_gradient`."""
        config = self.config
        inputs = {name: self._to_device(x) for name, x in batch.items()}
        noise, return_range = self._train_noise(inputs["reward"].shape, seed), (self._low, self._high)
        by_name, total, aux = gradients(
            self.parameters.mapping(), self._slow_critic, return_range, inputs, noise, self.spaces, config
        )
        with torch.no_grad():
            # Autograd gives each parameter a gradient of its own; from here on they are one vector.
            self._layout.pack(by_name.values(), out=self._gradient)
            norms, factors = clip_flat_gradients_(
                self._gradient, self._flat, self._layout, config.agc_clip, config.agc_epsilon
            )
            metrics = {
                "loss/total": total,
                **{f"loss/{name}": value for name, value in aux["losses"].items()},
                **aux["metrics"],
                "return_low": aux["return_range"][0],
                "return_high": aux["return_range"][1],
                "gradient_norm": torch.linalg.vector_norm(norms),
            }
        return by_name, metrics, factors, aux

    def _update(self, return_range: tuple[Tensor, Tensor]) -> Tensor:
        """The whole training state takes the step of the clipped gradients; the norm of the parameters' movement."""
        config = self.config
        flat_step_(self._flat, self._gradient, self._second_moment, self._momentum, self._step, config)
        self._slow_flat.lerp_(self._critic_flat, 1 - config.slow_critic_decay)  # after the step: [BEH-21]
        self._low, self._high = return_range
        self._acting = None
        # The update is the momentum times this number, and the momentum is still there.
        rate = learning_rate(self._step, config)
        self._step += 1
        return torch.linalg.vector_norm(self._momentum) * (rate / (1 - config.beta1**self._step))

    def _tensors(self) -> dict[str, Tensor]:
        """The training state under canonical names, but for the step; to write to a tensor is to change the state."""
        trees = {
            "params/": self._layout.views(self._flat),
            "slow_critic/": self._slow_critic,
            "optimizer/second_moment/": self._layout.views(self._second_moment),
            "optimizer/momentum/": self._layout.views(self._momentum),
            "return_range/": {"low": self._low, "high": self._high},
        }
        return {prefix + name: x for prefix, tree in trees.items() for name, x in tree.items()}

    def _to_device(self, x: np.ndarray) -> Tensor:
        tensor = torch.as_tensor(np.ascontiguousarray(x))
        if self._device.type == "cuda":
            return tensor.pin_memory().to(self._device, non_blocking=True)  # from pageable memory it would wait
        return tensor

    def _generator(self, seed: int) -> torch.Generator:
        return torch.Generator(self._device).manual_seed(seed)

    def _uniform(self, generator: torch.Generator, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=self._dtype, device=self._device)

    def _action_noise(self, generator: torch.Generator, *leading: int) -> Tensor:
        """[..., K]: normals for a Vector, uniforms for a Discrete. [CON-19]"""
        where: dict[str, Any] = {"generator": generator, "dtype": self._dtype, "device": self._device}
        parts = []
        for space in self.spaces.actions.values():
            draw = torch.rand if isinstance(space, Discrete) else torch.randn
            parts.append(draw(*leading, *space.array_shape, **where))
        return torch.cat(parts, -1)

    def _policy_noise(self, envs: int, seed: int) -> dict[str, Tensor]:
        generator = self._generator(seed)
        return {
            "posterior": self._uniform(generator, envs, self.config.stoch),
            "action": self._action_noise(generator, envs),
        }

    def _train_noise(self, shape: tuple[int, ...], seed: int) -> dict[str, Tensor]:
        """All random numbers of a step, drawn on the device before its loops, which draw none. [CON-20]"""
        generator = self._generator(seed)
        (B, T), H, S = shape, self.config.imagination_horizon, self.config.stoch
        return {
            "posterior": self._uniform(generator, B, T, S),
            "prior": self._uniform(generator, B * T, H, S),
            "action": self._action_noise(generator, B * T, H),
        }


def select_device(device: str | None) -> torch.device:
    """The device of that name: "cpu", "gpu" or "cuda", "cuda:1", ...; None takes a GPU if there is one.

    Raises:
      ValueError: an unknown device, or a GPU that PyTorch cannot use.
    """
    if device is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    match = re.fullmatch(r"(cpu)|(?:gpu|cuda)(?::([0-9]+))?", device)
    if match is None:
        raise ValueError(f"unknown device {device!r}; expected cpu, gpu, cuda, gpu:<number> or cuda:<number>")
    kind, index = match[1] or "cuda", match[2]
    if kind == "cuda" and int(index or 0) >= torch.cuda.device_count():
        for_cpus = torch.version.cuda is None and torch.version.hip is None
        build = "a build for CPUs only" if for_cpus else f"{torch.cuda.device_count()} GPUs"
        raise ValueError(
            f"device {device!r} is not there: PyTorch {torch.__version__} has {build}; "
            "use --device cpu or install a build for GPUs"
        )
    return torch.device(kind, int(index)) if index else torch.device(kind)


class _Copying:
    """An array on its way from the accelerator; `np.asarray` waits for it."""

    def __init__(self, x: Tensor) -> None:
        self._host = torch.empty(x.shape, dtype=x.dtype, pin_memory=True).copy_(x, non_blocking=True)
        # Of the stream that copies: without one, an event belongs to the current device, which may be another.
        self._done = torch.cuda.current_stream(x.device).record_event()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        self._done.synchronize()
        return np.array(self._host.numpy(), dtype=dtype, copy=copy)


class _Element:
    """One number of an array that may still be on its way."""

    def __init__(self, array: Any, index: int) -> None:
        self._array, self._index = array, index

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(np.asarray(self._array)[self._index], np.float64 if dtype is None else dtype)

    def __float__(self) -> float:
        return float(np.asarray(self._array)[self._index])


def _to_host(x: Tensor) -> Any:
    return _Copying(x) if x.device.type == "cuda" else x.numpy()
