"""AGC and LaProp. Chapter: spec/09-optimizer.md.

`LaProp` is an ordinary `torch.optim.Optimizer`, and `clip_gradients_` works before any optimizer as
`torch.nn.utils.clip_grad_norm_` does; both can be used alone. The functions of the chapter's names return new tensors.

Training uses the functions whose names have `flat`: the parameters, their gradients and both moments each are one long
vector (see `parameters.py`), so that a step is a dozen operations instead of a dozen for each of a hundred tensors.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from impl_torch.parameters import ROW, Layout
from impl_torch.shapes import require, require_same_shape, require_shapes, wide_dtype, widen
from spec import Config

DEAD_ZONE = 1e-16  # gradients below it count as zero: their squares would leave the normal numbers of float32 [OPT-9]
# The CPU updates this many numbers at a time: the chain of operations on them then runs in the cache, where each would
# go through memory from end to end.
CHUNK = 1 << 17


def _norm(x: Tensor) -> Tensor:
    """Root of the sum of squares, without overflow of the squares. [OPT-3]"""
    peak = torch.linalg.vector_norm(x, math.inf)
    safe = torch.where(peak == 0, 1, peak)
    return peak * torch.linalg.vector_norm(x / safe)


def _clip_factor(gradient_norm: Tensor, parameter_norm: Tensor, clip: float, epsilon: float) -> Tensor:
    """What a clipped gradient is multiplied by; NaN where a norm is not finite. [OPT-1] [OPT-4] [OPT-5]"""
    threshold = clip * parameter_norm.clamp(min=epsilon)
    factor = torch.where(gradient_norm > threshold, threshold / gradient_norm, 1.0)
    return torch.where(gradient_norm.isfinite() & parameter_norm.isfinite(), factor, math.nan)


@torch.no_grad()
def adaptive_gradient_clip(gradient: Tensor, parameter: Tensor, clip: float, epsilon: float) -> Tensor:
    """The gradient, no longer than clip * max(epsilon, norm(parameter)); any shape. [OPT-1] to [OPT-5]"""
    gradient, parameter = widen(gradient), widen(parameter)  # [OPT-19]
    require_same_shape(parameter=parameter, gradient=gradient)
    return gradient * _clip_factor(_norm(gradient), _norm(parameter), clip, epsilon)


@torch.no_grad()
def clip_gradients_(parameters: Iterable[Tensor], clip: float, epsilon: float = 1e-3) -> None:
    """Adaptive gradient clipping of each parameter's `.grad`, in place."""
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad.copy_(adaptive_gradient_clip(parameter.grad, parameter, clip, epsilon))


@torch.no_grad()
def clip_flat_gradients_(
    gradients: Tensor, parameters: Tensor, layout: Layout, clip: float, epsilon: float
) -> tuple[Tensor, Tensor]:
    """The same for all tensors of a flat buffer at once, in place. [OPT-2]

    gradients, parameters [total]. Returns the norm of each tensor's gradient before clipping [P] and the factors [P].
    """
    norms, parameter_norms = (_norms(x.view(-1, ROW), layout) for x in (gradients, parameters))
    factors = _clip_factor(norms, parameter_norms, clip, epsilon)
    by_row = factors.to(gradients.dtype)[layout.owners(gradients.device)]  # [P] -> [R]: no row has two tensors
    gradients.view(-1, ROW).mul_(by_row.unsqueeze(-1))
    return norms, factors


def _norms(rows: Tensor, layout: Layout) -> Tensor:
    """Norm of each tensor [P], float64, from the rows of a flat buffer [R, ROW].

    It is the norm of the norms of its rows, and those are folded into rows again until one number is left for each.
    """
    pieces = rows.split(CHUNK // ROW) if rows.device.type == "cpu" else [rows]
    norms = torch.cat([_row_norms(piece) for piece in pieces])  # [R]
    for size, places in layout.folds(rows.device):
        norms = _row_norms(norms.new_zeros(size).index_copy_(0, places, norms).view(-1, ROW))  # [size / ROW]
    return norms


def _row_norms(rows: Tensor) -> Tensor:
    """Norm of each row [R], float64: the squares are those of numbers up to 1, which cannot overflow. [OPT-3]"""
    peaks = rows.abs().amax(1, keepdim=True)  # PyTorch's infinity norm takes twenty times as long
    norms = torch.linalg.vector_norm(rows / torch.where(peaks == 0, 1, peaks), dim=1, keepdim=True)
    return (peaks.double() * norms.double()).squeeze(1)


def learning_rate(step: int, config: Config) -> float:
    """After `step` updates: the constant rate, or a linear rise to it over warmup_steps from exactly 0. [OPT-6]"""
    if config.warmup_steps == 0:
        return config.learning_rate
    return config.learning_rate * min(1.0, step / config.warmup_steps)


def _correction(beta: float, step: int) -> float:
    """1 - beta^t for t = step + 1, in float64, without the cancellation of forming the power first. [OPT-11]"""
    return -math.expm1((step + 1) * math.log(beta)) if beta else 1.0


def _require_betas(beta1: float, beta2: float) -> None:
    """At 1 the bias correction would be 0/0. [OPT-14]"""
    for name, beta in (("beta1", beta1), ("beta2", beta2)):
        require(0 <= beta < 1, name, "at least 0 and below 1", beta)


def _laprop_(
    tensors: tuple[Tensor, Tensor, Tensor, Tensor], step: int, betas: tuple[float, float], epsilon: float, rate: float
) -> None:
    """Updates both moments in place and subtracts rate * update from `out`; all of one shape. [OPT-8] to [OPT-12]

    tensors: gradient g, second moment v, momentum m, out. In place and with one scratch tensor:

        v = beta2 v + (1 - beta2) g²,  m = beta1 m + (1 - beta1) g / (sqrt(v / c2) + epsilon),  out -= rate m / c1

    where c is 1 - beta^(step + 1). The corrections are numbers of the host: nothing here waits for a device.
    """
    gradient, second_moment, momentum, out = tensors
    beta1, beta2 = betas
    first, second = _correction(beta1, step), _correction(beta2, step)  # c1, c2
    gradient = gradient.masked_fill(gradient.abs() < DEAD_ZONE, 0)
    second_moment.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    size = torch.div(second_moment, second).sqrt_().add_(epsilon)  # of recent gradients; then, as scratch, g / size
    # Where the gradient is 0 its share is 0, not 0/0: [OPT-10].
    momentum.mul_(beta1).add_(torch.div(gradient, size, out=size).masked_fill_(gradient == 0, 0), alpha=1 - beta1)
    out.add_(momentum, alpha=-rate / first)


@torch.no_grad()
def laprop(
    gradient: Tensor, second_moment: Tensor, momentum: Tensor, step: int, config: Config
) -> tuple[Tensor, Tensor, Tensor]:
    """(update, new second moment, new momentum), without learning rate and sign; any shape. [OPT-8] to [OPT-14]"""
    _require_betas(config.beta1, config.beta2)
    require_same_shape(gradient=gradient, second_moment=second_moment, momentum=momentum)
    second_moment, momentum, update = second_moment.clone(), momentum.clone(), torch.zeros_like(momentum)
    tensors, betas = (gradient, second_moment, momentum, update), (config.beta1, config.beta2)
    _laprop_(tensors, step, betas, config.laprop_epsilon, -1.0)  # 0 - (-1) * update
    return update, second_moment, momentum


class LaProp(torch.optim.Optimizer):
    """LaProp: RMSProp's normalization first, momentum afterwards. [OPT-8] to [OPT-16] [OPT-20]

    Per parameter the state is "step" (int), "second_moment" and "momentum", in float32 or better also for narrower
    parameters. [OPT-19] No weight decay, and no clipping: see `clip_gradients_`.

    Raises:
      ValueError: a beta outside [0, 1).
    """

    def __init__(
        self, params: Any, lr: float = 4e-5, betas: tuple[float, float] = (0.9, 0.99), eps: float = 1e-20
    ) -> None:
        _require_betas(*betas)
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One update of every parameter that has a gradient. closure: computes the loss again, with gradients."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._update(parameter, parameter.grad, group)
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As that of any optimizer, which would round the moments to the dtype of the parameters."""
        super().load_state_dict(state_dict)
        saved = (
            state_dict["state"].get(index, {}) for group in state_dict["param_groups"] for index in group["params"]
        )
        parameters = (parameter for group in self.param_groups for parameter in group["params"])
        for parameter, state in zip(parameters, saved, strict=True):
            for name in {"second_moment", "momentum"} & set(state):
                self.state[parameter][name] = state[name].detach().clone().to(parameter.device)

    def _update(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[parameter]
        if not state:
            dtype = torch.promote_types(parameter.dtype, torch.float32)
            state |= {
                "step": 0,
                **{name: torch.zeros_like(parameter, dtype=dtype) for name in ("second_moment", "momentum")},
            }
        tensors = (gradient.to(state["momentum"].dtype), state["second_moment"], state["momentum"], parameter)
        _laprop_in_chunks_(tensors, state["step"], group["betas"], group["eps"], group["lr"])
        state["step"] += 1


def _laprop_in_chunks_(
    tensors: tuple[Tensor, Tensor, Tensor, Tensor], step: int, betas: tuple[float, float], epsilon: float, rate: float
) -> None:
    """`_laprop_`, on the CPU a piece of the tensors at a time where they lie in memory as vectors do."""
    chunks: Iterable[Any] = [tensors]
    if tensors[-1].device.type == "cpu" and all(x.is_contiguous() for x in tensors):
        chunks = zip(*(x.view(-1).split(CHUNK) for x in tensors), strict=True)
    for chunk in chunks:
        _laprop_(chunk, step, betas, epsilon, rate)


@torch.no_grad()
def optimizer_step(
    params: Mapping[str, Tensor], gradients: Mapping[str, Tensor], state: Mapping[str, Any], config: Config
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Clips, normalizes and steps every tensor; returns new params and a new state. [OPT-15] to [OPT-21]

    state: {"step": int, "second_moment": {name: tensor}, "momentum": {name: tensor}}.
    """
    trees = {"gradients": gradients, "second_moment": state["second_moment"], "momentum": state["momentum"]}
    shapes = {name: tuple(x.shape) for name, x in params.items()}
    for what, tree in trees.items():
        require_shapes(what, tree, shapes)
    layout, dtype, step = Layout(shapes), wide_dtype(config), int(state["step"])
    flat, gradient, second_moment, momentum = (
        layout.pack(tree[name].to(dtype) for name in params) for tree in (params, *trees.values())
    )
    clip_flat_gradients_(gradient, flat, layout, config.agc_clip, config.agc_epsilon)
    flat_step_(flat, gradient, second_moment, momentum, step, config)
    moments = {"second_moment": layout.views(second_moment), "momentum": layout.views(momentum)}
    return layout.views(flat), {"step": step + 1, **moments}


@torch.no_grad()
def flat_step_(
    flat: Tensor, gradient: Tensor, second_moment: Tensor, momentum: Tensor, step: int, config: Config
) -> None:
    """One update of a flat buffer and its moments [total], in place, by a gradient that `clip_flat_gradients_` has
    clipped; `step` updates were made before."""
    _require_betas(config.beta1, config.beta2)
    tensors, betas = (gradient, second_moment, momentum, flat), (config.beta1, config.beta2)
    _laprop_in_chunks_(tensors, step, betas, config.laprop_epsilon, learning_rate(step, config))
