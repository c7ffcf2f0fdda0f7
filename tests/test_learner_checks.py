"""The checks of learners find what goes wrong in one: caches, state and noise."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch

import conformance.cases  # noqa: F401 - registers the checks
from conformance.adapters.torch_adapter import TorchAdapter
from conformance.case import Setting
from conformance.check import CHECKS
from conformance.execute import run_check
from impl_torch.learner import Learner
from spec import Config, Spaces

Noise = dict[str, Any]


class StaleActing(Learner):
    """Acts with the parameters of its first step."""

    def train_step(self, batch: Any, seed: int) -> Any:
        cached = self._acting
        result = super().train_step(batch, seed)
        self._acting = cached
        return result


class StaleAfterLoading(Learner):
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        cached = self._acting
        super().load_state_dict(state)
        self._acting = cached


class Forgetful(Learner):
    """Takes over everything but the momentum."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self._momentum.zero_()


class Shared(Learner):
    """Gives out its own memory."""

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), **{name: x.numpy() for name, x in self._tensors().items()}}


class SlowCriticFirst(Learner):
    def _update(self, return_range: Any) -> Any:
        self._slow_flat.lerp_(self._critic_flat, 1 - self.config.slow_critic_decay)
        before = self._slow_flat.clone()
        result = super()._update(return_range)
        self._slow_flat.copy_(before)
        return result


class RangeForgotten(Learner):
    def _update(self, return_range: Any) -> Any:
        before = self._low, self._high
        result = super()._update(return_range)
        self._low, self._high = before
        return result


class MomentsFromOne(Learner):
    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._second_moment.fill_(1.0)


def changed(change: Any) -> type[Learner]:
    class Changed(Learner):
        def _train_noise(self, shape: Any, seed: int) -> Noise:
            return dict(change(super()._train_noise(shape, seed), seed, self))

    return Changed


def as_before(noise: Noise, seed: int, learner: Any) -> Noise:
    return Learner._train_noise(learner, noise["posterior"].shape[:2], 0)


def posterior_for_the_prior(noise: Noise, seed: int, learner: Any) -> Noise:
    start = noise["posterior"].reshape(-1, 1, noise["posterior"].shape[-1])
    noise["prior"][:, :1] = start
    return noise


def one_row(noise: Noise, seed: int, learner: Any) -> Noise:
    return noise | {"posterior": noise["posterior"][:1].expand_as(noise["posterior"]).clone()}


def one_horizon(noise: Noise, seed: int, learner: Any) -> Noise:
    return noise | {"action": noise["action"][:, :1].expand_as(noise["action"]).clone()}


def opposite_rows(noise: Noise, seed: int, learner: Any) -> Noise:
    noise["prior"][1::2] = 1 - noise["prior"][::2] - 2.0**-24
    return noise


def one_latent(noise: Noise, seed: int, learner: Any) -> Noise:
    return noise | {"prior": noise["prior"][..., :1].expand_as(noise["prior"]).clone()}


class ResetsTheCarryItGets(Learner):
    def policy(self, observation: Any, is_first: np.ndarray, carry: Any, seed: int, mode: bool = False) -> Any:
        carry["deter"][torch.as_tensor(is_first)] = 0
        return super().policy(observation, is_first, carry, seed, mode)


class OneKernelForTwo(Learner):
    def state_dict(self) -> dict[str, Any]:
        state = super().state_dict()
        return {**state, "params/critic/hidden1/kernel": state["params/actor/hidden1/kernel"]}


class OptionsOfTheFirst(Learner):
    first: Config | None = None

    def __init__(self, spaces: Spaces, config: Config, **options: Any) -> None:
        type(self).first = type(self).first or config
        super().__init__(spaces, type(self).first, **options)


class CountsItsCalls(Learner):
    """Its random numbers depend on what else it was asked."""

    calls = 0

    def policy(self, *arguments: Any, **options: Any) -> Any:
        self.calls += 1
        return super().policy(*arguments, **options)

    def train_step(self, batch: Any, seed: int) -> Any:
        return super().train_step(batch, seed + self.calls)


class MomentumOfNaN(Learner):
    """Leaves out the update, and keeps what it has of the gradient."""

    def train_step(self, batch: Any, seed: int) -> Any:
        metrics, latents = super().train_step(batch, seed)
        if metrics["skipped"]:
            self._momentum += 1
        return metrics, latents


class SamplesAnyway(Learner):
    def policy(self, observation: Any, is_first: np.ndarray, carry: Any, seed: int, mode: bool = False) -> Any:
        return super().policy(observation, is_first, carry, seed)


class OldPrediction(Learner):
    """Predicts with the parameters that it had first."""

    first: Any = None

    def predict(self, *arguments: Any) -> Any:
        self.first = self.first or super().predict(*arguments)
        return self.first


class StopsForever(Learner):
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        stopped = self._stopped
        super().load_state_dict(state)
        self._stopped = stopped


MISTAKES = {
    "train_steps_match": (SlowCriticFirst, RangeForgotten, MomentsFromOne, OptionsOfTheFirst),
    "fresh_parameters_have_their_distribution": (OneKernelForTwo,),
    "acting_leaves_its_carry_as_it_was": (ResetsTheCarryItGets,),
    "acting_uses_the_newest_parameters": (StaleActing, StaleAfterLoading),
    "a_state_is_everything": (Forgetful, Shared, OldPrediction),
    "the_mode_takes_the_place_of_the_sample": (SamplesAnyway,),
    "looking_changes_nothing": (CountsItsCalls,),
    "a_step_that_is_not_finite_changes_nothing": (MomentumOfNaN, StopsForever),
    "noise_is_independent": tuple(
        map(changed, (as_before, posterior_for_the_prior, one_row, one_horizon, opposite_rows, one_latent))
    ),
}


class Candidate(TorchAdapter):
    def __init__(self, kind: type[Learner]) -> None:
        super().__init__("float32", None)
        self._kind = kind

    def Learner(self, spaces: Spaces, config: Config, seed: int) -> Learner:  # noqa: N802
        return self._kind(spaces, self._enter(config), seed=seed)


@pytest.mark.parametrize(
    ("check", "kind"),
    [
        pytest.param(check, kind, id=f"{check}-{kind.__name__}-{number}")
        for check, kinds in MISTAKES.items()
        for number, kind in enumerate((Learner, *kinds))
    ],
)
def test_mistakes_of_learners_are_found(check: str, kind: type[Learner]) -> None:
    result = run_check(CHECKS[f"learner.{check}"], Candidate(kind), Setting("float32", "paper"))
    assert result.status == ("pass" if kind is Learner else "fail"), result.message


def test_a_learner_without_a_mode_is_not_judged_by_it() -> None:
    class WithoutMode(Learner):
        def policy(self, observation: Any, is_first: Any, carry: Any, seed: int) -> Any:  # type: ignore[override]
            return super().policy(observation, is_first, carry, seed)

    check = CHECKS["learner.the_mode_takes_the_place_of_the_sample"]
    adapter = Candidate(WithoutMode)
    adapter.refuses_anyhow = True  # as somebody else's
    result = run_check(check, adapter, Setting("float32", "paper"))
    assert (result.status, "policy has no mode" in result.message) == ("not offered", True)


def test_a_learner_without_a_method_is_told_so() -> None:
    class Partly(Candidate):
        def Learner(self, spaces: Spaces, config: Config, seed: int) -> Any:  # noqa: N802
            return np.zeros(0)

    result = run_check(CHECKS["learner.a_state_is_everything"], Partly(Learner), Setting("float32", "paper"))
    assert (result.status, "state_dict" in result.message) == ("fail", True)
