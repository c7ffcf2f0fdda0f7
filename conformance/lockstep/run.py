"""The lockstep itself: every member makes the same train steps, and after each the results are compared."""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from conformance.compare import round_to
from conformance.errors import UserError
from conformance.lockstep.bounds import bound
from conformance.lockstep.drift import GROUPS, Nested, Tensor, deviations
from conformance.lockstep.stream import PROBLEMS, Arrays, BatchStream, lockstep_config
from conformance.mutants import planted
from reference_numpy import agent, distributions
from spec import parameter_table

MODES = ("free", "one step")
# How near a uniform number may come to a threshold of its sample. Far above what the states in lockstep differ by; in
# bfloat16 a thousand samples cannot all keep away from where rounding moves the thresholds.
MARGIN = {"float64": 1e-6, "float32": 1e-5, "bfloat16": 0.0}
ATTEMPTS = 200


@dataclasses.dataclass(frozen=True)
class Exceeded:
    """The first tensor beyond its bound. step: counted from 1."""

    step: int
    tensor: Tensor
    bound: float


@dataclasses.dataclass
class Comparison:
    """One member against the baseline, either running free or from a common state at every step.

    curves: group -> deviation of its worst tensor, an entry for each step. worst: group -> (step, tensor) of the
    largest of them.
    parted: the step, counted from 1, at which a sample of a free run fell into another class; nothing is compared from
    then on.
    """

    curves: dict[str, list[float]] = dataclasses.field(default_factory=lambda: {group: [] for group in GROUPS})
    worst: dict[str, tuple[int, Tensor]] = dataclasses.field(default_factory=dict)
    exceeded: Exceeded | None = None
    parted: int | None = None

    def add(self, step: int, tensors: list[Tensor], allowed: Any) -> None:
        """allowed: tensor -> its bound."""
        for group in GROUPS:
            tensor = max((tensor for tensor in tensors if tensor.group == group), key=lambda tensor: tensor.deviation)
            self.curves[group].append(tensor.deviation)
            if group not in self.worst or tensor.deviation > self.worst[group][1].deviation:
                self.worst[group] = (step, tensor)
        if self.exceeded is None:
            beyond = (tensor for tensor in tensors if not tensor.deviation <= allowed(tensor))
            self.exceeded = next((Exceeded(step, tensor, allowed(tensor)) for tensor in beyond), None)


class Lockstep:
    """Members side by side on one problem.

    members: name -> adapter; the reference is the baseline if it takes part, and else the first. A member without
    `train_step` is given the gradients of the first that has them, and needs `train_step_with`.

    Raises:
      UserError: fewer than two members, or one that cannot make a train step.
    """

    def __init__(self, members: Mapping[str, object], problem: str, profile: str, dtype: str, seed: int) -> None:
        if len(members) < 2:
            raise UserError(f"lockstep compares at least two different backends, got {', '.join(members) or 'none'}")
        self.dtype = dtype
        self.task, self.config = PROBLEMS[problem], lockstep_config(profile, dtype)
        self.members = dict(members)
        self.supplier = next(
            (adapter for adapter in members.values() if callable(getattr(adapter, "gradients", None))), None
        )
        for name, adapter in members.items():
            if not callable(getattr(adapter, "train_step", None)):
                if not callable(getattr(adapter, "train_step_with", None)):
                    raise UserError(f"{name} offers neither train_step nor train_step_with; see conformance/adapter.py")
                if self.supplier is None:
                    raise UserError(
                        f"{name} has no gradients of its own, and no other backend offers any; "
                        f"add one that does, such as jax"
                    )
        self.baseline = "numpy" if "numpy" in members else next(iter(members))
        self.others = [name for name in members if name != self.baseline]
        self.comparisons = {name: {mode: Comparison() for mode in MODES} for name in self.others}
        self.steps = self.redrawn = 0
        self._stream = BatchStream(seed, self.task, self.config)
        self._start = self._fresh_state(seed)
        self._states: dict[str, Nested] = dict.fromkeys(members, self._start)

    def step(self) -> None:
        """One train step of everybody, from the own state and from the baseline's."""
        batch = self._stream.batch(self.steps)
        common = self._states[self.baseline]
        noise, samples = self._noise(common, batch)
        expected = self._advance(self.baseline, common, batch, noise)
        self.steps += 1
        for name in self.others:
            one, free = self.comparisons[name]["one step"], self.comparisons[name]["free"]
            self._compare(one, name, self._advance(name, common, batch, noise), expected, common, 1)
            if free.parted is None:
                own = self._states[name]
                if any(
                    not np.array_equal(a, b) for a, b in zip(self._samples(own, batch, noise)[0], samples, strict=True)
                ):
                    free.parted = self.steps
                    continue
                actual = self._advance(name, own, batch, noise)
                self._compare(free, name, actual, expected, self._start, self.steps)
                if free.curves["samples"][-1]:
                    free.parted = self.steps
                self._states[name] = actual[0]
        self._states[self.baseline] = expected[0]
        self._stream.store(expected[1]["deter"], expected[1]["stoch"])

    def _compare(
        self, comparison: Comparison, name: str, actual: Any, expected: Any, origin: Nested, together: int
    ) -> None:
        with _complete(name):
            tensors = list(deviations(actual, expected, origin))
        comparison.add(self.steps, tensors, lambda tensor: bound(tensor, together, self.dtype))

    def _advance(self, name: str, state: Nested, batch: Arrays, noise: Arrays) -> tuple[Nested, Nested]:
        adapter: Any = self.members[name]
        inputs = copy.deepcopy((state, batch, noise))  # a member that writes into them changes nobody else's step
        if callable(getattr(adapter, "train_step", None)):
            new, aux = adapter.train_step(*inputs, self.task, self.config)
        else:
            supplier: Any = self.supplier
            gradients = supplier.gradients(*self._loss_arguments(*copy.deepcopy(inputs)))
            new, aux = adapter.train_step_with(*inputs, gradients, self.task, self.config)
        with _complete(name):
            return _plain(new), {key: aux[key] for key in ("losses", "deter", "stoch")}

    def _noise(self, state: Nested, batch: Arrays) -> tuple[Arrays, list[np.ndarray]]:
        """Noise with which no sample at this state lies near a threshold, and the samples."""
        for _ in range(ATTEMPTS):
            noise = self._stream.noise()
            samples, margin = self._samples(state, batch, noise)
            if margin >= MARGIN[self.dtype]:
                return noise, samples
            self.redrawn += 1
        raise UserError(
            f"step {self.steps + 1}: no noise of {ATTEMPTS} keeps every sample "
            f"{MARGIN[self.dtype]:g} away from the next class; "
            f"does the state of {self.baseline} hold numbers that are not finite?"
        )

    def _samples(self, state: Nested, batch: Arrays, noise: Arrays) -> tuple[list[np.ndarray], float]:
        """Every categorical sample that the reference draws at a state, imagined ones as well, and the smallest
        distance of a uniform number from a threshold."""
        samples: list[np.ndarray] = []
        margins = [math.inf]
        right = distributions.categorical_sample

        def record(log_probs: Any, uniform: Any) -> Any:
            thresholds = np.cumsum(np.exp(log_probs), -1)[..., :-1]
            margins.append(float(np.min(np.abs(thresholds - np.asarray(uniform)[..., None]), initial=math.inf)))
            samples.append(right(log_probs, uniform))
            return samples[-1]

        with planted({"distributions.categorical_sample": record}):
            agent.losses(*self._loss_arguments(state, batch, noise))
        return samples, min(margins)

    def _loss_arguments(self, state: Nested, batch: Arrays, noise: Arrays) -> tuple[Any, ...]:
        return_range = (state["return_range"]["low"], state["return_range"]["high"])
        return state["params"], state["slow_critic"], return_range, batch, noise, self.task, self.config

    def _fresh_state(self, seed: int) -> Nested:
        """The beginning of a run: reward and critic predict 0, moments are 0."""
        rng, table = np.random.default_rng([seed, 1]), parameter_table(self.config, self.task)
        uniforms = {
            name: rng.random(entry.shape) for name, entry in table.items() if entry.initializer == "truncated_normal"
        }
        params = agent.initial_parameters(table, uniforms)
        stored = "float64" if self.dtype == "float64" else "float32"
        return agent.initial_state({name: round_to(value, stored) for name, value in params.items()})


@contextlib.contextmanager
def _complete(name: str) -> Iterator[None]:
    """Raises UserError where a member's result lacks something."""
    try:
        yield
    except KeyError as error:
        raise UserError(
            f"{name}: the result of a train step lacks {error}; [AGT] in spec/10-agent.md says what belongs there"
        ) from error


def _plain(state: Nested) -> Nested:
    """The state with the count of updates and the return range as plain numbers, whatever the backend holds them in."""
    optimizer = state["optimizer"]
    return {
        "params": state["params"],
        "slow_critic": state["slow_critic"],
        "optimizer": {**{key: optimizer[key] for key in ("second_moment", "momentum")}, "step": int(optimizer["step"])},
        "return_range": {end: float(state["return_range"][end]) for end in ("low", "high")},
    }
