"""Train steps side by side: honest backends stay together, planted mistakes are named with their first step and
tensor."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import torch

from conformance.candidate import load_candidate
from conformance.cli import main
from conformance.errors import UserError
from conformance.lockstep import run
from conformance.lockstep.bounds import bound
from conformance.lockstep.drift import GROUPS, Tensor, beyond_one, deviations, of_the_way, share_of_others
from conformance.lockstep.report import failures, interval_ends, reduce, report
from conformance.lockstep.run import Lockstep
from conformance.lockstep.stream import PROBLEMS, BatchStream, lockstep_config
from conformance.mutants import MUTANTS, Mutant, MutantAdapter
from impl_jax import distributions as jax_distributions
from impl_torch import distributions as torch_distributions
from reference_numpy.transforms import exponential_bins
from spec import Spaces

pytestmark = pytest.mark.xdist_group("lockstep")
STEPS = 20


@pytest.fixture(scope="module")
def torch_backend() -> Any:
    return load_candidate("torch", "float64")


@pytest.fixture(scope="module")
def together() -> Lockstep:
    """All three backends on the smallest problem; the reference has PyTorch's gradients, which need not be compiled."""
    lockstep = Lockstep(
        {name: load_candidate(name, "float64") for name in ("torch", "jax", "numpy")}, "vector", "paper", "float64", 0
    )
    for _ in range(STEPS):
        lockstep.step()
    return lockstep


class Wrapped:
    """A backend with a changed train step."""

    def __init__(self, right: Any, train_step: Callable[..., Any]) -> None:
        self._right, self._train_step = right, train_step

    def __getattr__(self, name: str) -> Any:
        return getattr(self._right, name)

    def train_step(self, *arguments: Any) -> Any:
        return self._train_step(self._right.train_step, *arguments)


def exceeded(lockstep: Lockstep, steps: int) -> list[tuple[str, int, str]]:
    """(mode, step, tensor) of everything beyond its bound after some steps."""
    for _ in range(steps):
        lockstep.step()
    (modes,) = lockstep.comparisons.values()
    return [(mode, c.exceeded.step, c.exceeded.tensor.name) for mode, c in modes.items() if c.exceeded]


# Honest backends


def test_honest_backends_stay_together(together: Lockstep) -> None:
    assert failures(together) == []
    assert together.baseline == "numpy"
    for modes in together.comparisons.values():
        for comparison in modes.values():
            assert comparison.parted is None
            assert {group: len(curve) for group, curve in comparison.curves.items()} == dict.fromkeys(GROUPS, STEPS)
            assert max(comparison.curves["samples"]) == 0
            assert 0 < max(comparison.curves["encoder"]) < 1e-10, "float64 rounds, but not more than that"
            assert max(comparison.curves["actor"]) < 1e-5


def test_the_steps_do_something(together: Lockstep) -> None:
    """Everything that a state holds has moved, and nobody's is another's."""
    states = together._states
    for name, state in states.items():
        assert state["optimizer"]["step"] == STEPS
        assert 0 != state["return_range"]["low"] < state["return_range"]["high"] != 0
        for group in ("params", "slow_critic"):
            still = [key for key, value in state[group].items() if np.array_equal(value, together._start[group][key])]
            assert still == [], name
    assert not np.array_equal(states["jax"]["params"]["rssm/gru/kernel"], states["torch"]["params"]["rssm/gru/kernel"])
    slow = states["numpy"]["slow_critic"]["critic/out/kernel"]
    assert np.linalg.norm(slow) < 0.5 * np.linalg.norm(states["numpy"]["params"]["critic/out/kernel"]), (
        "the slow critic is behind"
    )


def test_precisions_below_float64_are_shown_and_not_judged() -> None:
    """The same backend in float32 and in float64: a float32 is some 1e-7, and an update only a small part of a
    number."""
    members = {"single": load_candidate("torch", "float32"), "double": load_candidate("torch", "float64")}
    lockstep = Lockstep(members, "vector", "paper", "float32", 0)
    assert exceeded(lockstep, 3) == []
    curves = lockstep.comparisons["double"]["one step"].curves
    assert 1e-9 < max(curves["latents"]) < 1e-5
    for group in ("encoder", "rssm", "critic"):
        assert 1e-7 < max(curves[group]) < 1e-1, group
    assert failures(lockstep) == []


@pytest.mark.covers("DIS-15", "TRA-11")
@pytest.mark.parametrize("backend", ["jax", "torch"])
@pytest.mark.parametrize("rows", [1, 7, 32, 160])
def test_mirrored_logits_have_mean_zero(backend: str, rows: int) -> None:
    """Compiled, too. Probabilities of mirrored logits that differ in the last bit once made a third of a gradient
    noise."""
    half = np.random.default_rng(0).normal(size=(rows, 127))
    logits = np.concatenate([half, np.zeros((rows, 1)), half[:, ::-1]], -1).astype(np.float32)
    bins = exponential_bins(255)
    if backend == "jax":
        mean = np.asarray(jax.jit(lambda x: jax_distributions.symexp_twohot_mean(x, bins))(logits))
    else:
        mean = torch_distributions.symexp_twohot_mean(torch.tensor(logits), torch.tensor(bins)).numpy()
    np.testing.assert_array_equal(mean, np.zeros(rows))


# Mistakes


SLIGHT = dataclasses.replace(
    MUTANTS["slow_critic_decay_swapped"],
    name="slight",
    edits={
        "behavior.update_slow_critic": {
            "decay * old + (1 - decay) * new": "(decay + 1e-4) * old + (1 - decay - 1e-4) * new"
        }
    },
)


@pytest.mark.parametrize(
    ("mutant", "profile", "step", "tensor"),
    [
        (SLIGHT, "paper", 1, "slow_critic/critic/out/kernel"),
        (MUTANTS["no_correction_of_the_second_moment"], "paper", 1, "optimizer/momentum/"),
        (MUTANTS["slow_critic_updated_before_the_step"], "paper", 1, "slow_critic/"),
        (MUTANTS["warmup_starts_at_one"], "official", 1, "params/"),
        (MUTANTS["return_range_not_smoothed"], "paper", 2, "return_range"),
        (MUTANTS["free_nats_for_each_latent"], "paper", 1, "loss dynamics"),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_a_mistake_of_the_reference_is_named(
    torch_backend: Any, mutant: Mutant, profile: str, step: int, tensor: str
) -> None:
    """The reference's losses and optimizer are judged with given gradients."""
    lockstep = Lockstep({"torch": torch_backend, "mutant": MutantAdapter(mutant)}, "vector", profile, "float64", 0)
    found = exceeded(lockstep, step)
    assert [(mode, at) for mode, at, _ in found] == [("free", step), ("one step", step)]
    assert all(name.startswith(tensor) for _, _, name in found), found
    assert f"step {step}, {found[0][2]} deviates" in failures(lockstep)[0]


def test_a_mistake_that_begins_late_is_named_when_it_begins(torch_backend: Any) -> None:
    def late(right: Any, state: Any, batch: Any, noise: Any, task: Any, config: Any) -> Any:
        wrong = dataclasses.replace(config, return_lambda=0.9501)
        return right(state, batch, noise, task, wrong if state["optimizer"]["step"] >= 3 else config)

    lockstep = Lockstep(
        {"numpy": load_candidate("numpy", "float64"), "late": Wrapped(torch_backend, late)},
        "vector",
        "paper",
        "float64",
        0,
    )
    assert [(mode, step) for mode, step, _ in exceeded(lockstep, 5)] == [("free", 4), ("one step", 4)]


def test_a_gradient_that_is_not_a_number_is_beyond_every_bound(torch_backend: Any) -> None:
    def broken(right: Any, *arguments: Any) -> Any:
        state, aux = right(*arguments)
        return {**state, "params": {**state["params"], "actor/hidden0/scale": np.full(16, np.nan)}}, aux

    lockstep = Lockstep(
        {"torch": torch_backend, "broken": Wrapped(torch_backend, broken)}, "vector", "paper", "float64", 0
    )
    assert exceeded(lockstep, 1) == [(mode, 1, "params/actor/hidden0/scale") for mode in ("free", "one step")]
    assert report(lockstep)["comparisons"]["broken"]["free"]["exceeded"]["deviation"] is None


def test_samples_that_part_end_the_free_run(torch_backend: Any) -> None:
    """A state that has drifted this far draws other samples; one step from a common state goes on."""

    def drifting(right: Any, *arguments: Any) -> Any:
        state, aux = right(*arguments)
        return {**state, "params": {name: 1.5 * value for name, value in state["params"].items()}}, aux

    lockstep = Lockstep(
        {"torch": torch_backend, "drifting": Wrapped(torch_backend, drifting)}, "vector", "paper", "float64", 0
    )
    exceeded(lockstep, 3)
    modes = lockstep.comparisons["drifting"]
    assert modes["free"].parted == 2
    assert [len(modes[mode].curves["actor"]) for mode in run.MODES] == [1, 3]
    modes["free"].exceeded = None
    assert any("falls into another class" in line for line in failures(lockstep))


def test_noise_keeps_its_distance_from_the_thresholds(torch_backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(run.MARGIN, "float64", 1e-4)
    lockstep = Lockstep({"torch": torch_backend, "same": torch_backend}, "vector", "paper", "float64", 0)
    batch = lockstep._stream.batch(0)
    margins = [
        lockstep._samples(lockstep._start, batch, lockstep._noise(lockstep._start, batch)[0])[1] for _ in range(3)
    ]
    assert min(margins) >= 1e-4
    assert lockstep.redrawn > 0
    monkeypatch.setitem(run.MARGIN, "float64", 0.5)
    monkeypatch.setattr(run, "ATTEMPTS", 3)
    with pytest.raises(UserError, match=r"step 1: no noise of 3 keeps every sample 0\.5 away .* state of torch"):
        lockstep._noise(lockstep._start, batch)


# Parts


def test_deviation_is_relative_to_the_way() -> None:
    assert of_the_way([1.0, 2.5], [1.0, 3.0], [1.0, 1.0]) == 0.25
    assert of_the_way([1.0], [1.0], [1.0]) == 0
    assert of_the_way([2.0 + 2e-9], [2.0], [2.0]) == pytest.approx(1e-3), "at least a millionth of the number"
    assert of_the_way([1e-30], [0.0], [0.0]) == math.inf
    assert of_the_way([np.nan], [1.0], [0.0]) == math.inf
    assert of_the_way([1.0], [1.0, 1.0], [0.0, 0.0]) == math.inf
    assert share_of_others([[1, 0], [0, 1]], [[1, 0], [1, 0]]) == 0.5
    assert share_of_others([0, 1], [[1, 0], [1, 0]]) == math.inf
    assert beyond_one([0.5, 0.0], [0.25, 0.0]) == 0.25
    assert beyond_one([12.0], [10.0]) == 0.2
    assert beyond_one(np.nan, 1.0) == math.inf


def test_bounds() -> None:
    assert bound(Tensor("second moments", "actor", "", 0), 1, "float64") == pytest.approx(1.01e-5)
    assert bound(Tensor("losses", "replay_critic", "", 0), 100, "float64") == pytest.approx(2e-6)
    assert bound(Tensor("rssm", "rssm", "", 0), 1000, "float64") == pytest.approx(1.1e-7)
    assert bound(Tensor("samples", "rssm", "", 0), 1000, "float64") == 0
    assert bound(Tensor("rssm", "rssm", "", 0), 1, "float32") == math.inf


def test_a_curve_keeps_its_peaks() -> None:
    ends = interval_ends(1000)
    assert (ends[0], ends[-1], len(ends) <= 48) == (1, 1000, True)
    curve = [0.0] * 1000
    curve[700] = 3.0
    assert max(reduce(curve, ends)) == 3.0
    assert reduce([1.0, 5.0, 2.0], [1, 3, 9]) == [1.0, 5.0]
    assert interval_ends(0) == []


def test_a_result_that_lacks_something_is_an_error(torch_backend: Any) -> None:
    def poor(right: Any, *arguments: Any) -> Any:
        state, aux = right(*arguments)
        return state, {name: value for name, value in aux.items() if name != "deter"}

    lockstep = Lockstep({"torch": torch_backend, "poor": Wrapped(torch_backend, poor)}, "vector", "paper", "float64", 0)
    with pytest.raises(UserError, match="poor: the result of a train step lacks 'deter'"):
        lockstep.step()
    lockstep = Lockstep({"poor": Wrapped(torch_backend, poor), "torch": torch_backend}, "vector", "paper", "float64", 0)
    with pytest.raises(UserError, match="poor: the result of a train step lacks 'deter'"):
        lockstep.step()


def test_a_member_that_writes_into_its_arguments_changes_nobody_elses_step(torch_backend: Any) -> None:
    def writing(right: Any, state: Any, batch: Any, noise: Any, *rest: Any) -> Any:
        result = right(state, batch, noise, *rest)
        for array in (*state["params"].values(), *state["slow_critic"].values(), *noise.values(), batch["reward"]):
            array[...] = 0
        return result

    members = {"torch": torch_backend, "writing": Wrapped(torch_backend, writing), "same": torch_backend}
    lockstep = Lockstep(members, "vector", "paper", "float64", 0)
    for _ in range(2):
        lockstep.step()
    assert failures(lockstep) == []
    assert max(lockstep.comparisons["same"]["one step"].worst["rssm"][1].deviation, 0.0) == 0


@pytest.mark.parametrize("task", list(PROBLEMS.values()), ids=list(PROBLEMS))
def test_the_stream_holds_all_that_a_batch_can(task: Spaces) -> None:
    config = lockstep_config("paper", "float64")
    one, other = (BatchStream(3, task, config) for _ in range(2))
    batches = [one.batch(8 * number) for number in range(60)]
    again = [other.batch(8 * number) for number in range(60)]
    assert all(np.array_equal(a[name], b[name]) for a, b in zip(batches, again, strict=True) for name in a)
    flat = {
        name: np.concatenate([batch[name] for batch in batches], 1)
        for name in batches[0]
        if name not in ("deter", "stoch")
    }
    first, last, terminal = flat["is_first"], flat["is_last"], flat["is_terminal"]
    np.testing.assert_array_equal(first[:, 1:], last[:, :-1])
    assert first[:, 0].all()
    assert 5 < terminal.sum() < last.sum() - 5, "both ends"
    assert not (terminal & ~last).any()
    assert not flat["reward"][first].any()
    assert flat["reward"].min() < -100
    assert flat["reward"].max() > 100
    early, late = flat["reward"][:, :240].mean(), flat["reward"][:, 240:].mean()
    assert late > early + 5, "the skill grows"
    assert np.array_equal(batches[0]["deter"], np.zeros((4, 32)))
    for key, space in task.observations.items():
        assert flat[key].std(axis=1).min(axis=0).max() > 0, f"{key} of shape {space.array_shape} never changes"


def test_latents_are_the_context_of_the_next_batch() -> None:
    task, config = PROBLEMS["vector"], lockstep_config("paper", "float64")
    stream, rng = BatchStream(0, task, config), np.random.default_rng(0)
    deter, stoch = rng.normal(size=(4, 8, 32)), np.eye(6)[rng.integers(0, 6, (4, 8, 6))]
    stream.store(deter, stoch)
    batch = stream.batch(0)
    np.testing.assert_array_equal(batch["deter"], deter[:, -1].astype(np.float32))
    np.testing.assert_array_equal(np.eye(6)[batch["stoch"]], stoch[:, -1])


def test_every_group_has_tensors(together: Lockstep) -> None:
    state = together._states["numpy"]
    aux = {"stoch": np.zeros((4, 8, 6, 6)), "deter": np.zeros((4, 8, 32)), "losses": {"reward": 1.0}}
    assert (
        tuple(dict.fromkeys(tensor.group for tensor in deviations((state, aux), (state, aux), together._start)))
        == GROUPS
    )


# The command


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--backends", "numpy"], "at least two different backends, got numpy"),
        (["--backends", "numpy,numpy"], "at least two"),
        (["--steps", "0"], "--steps: expected 1 or more, got 0"),
        (["--problems", "sound"], "'sound'; known: vector, image"),
        (["--backends", "numpy,no_such_module"], "no_such_module"),
        (["--out", f"{__file__}/below/a/file"], "below/a/file: Not a directory"),
    ],
)
def test_wrong_command_lines(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lockstep", *arguments]) == 2
    assert words in capsys.readouterr().err


ADAPTER = """
from conformance.candidate import load_candidate
_right = load_candidate("torch", "float64")

def train_step(state, *arguments):
    new, aux = _right.train_step(state, *arguments)
    momentum = {**new["optimizer"]["momentum"]}
    momentum["rssm/gru/bias"] = momentum["rssm/gru/bias"] * 1.0001
    return {**new, "optimizer": {**new["optimizer"], "momentum": momentum}}, aux
"""


def test_a_file_of_somebodys_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "their_adapter.py"
    path.write_text(ADAPTER, encoding="utf-8")
    arguments = ["--backends", f"torch,{path}", "--problems", "vector", "--steps", "2", "--out", str(tmp_path / "out")]
    assert main(["lockstep", *arguments]) == 1
    out = capsys.readouterr().out
    assert "step 1, optimizer/momentum/rssm/gru/bias deviates 1.0e-04" in " ".join(out.split())
    found = json.loads((tmp_path / "out" / "lockstep-float64.json").read_text(encoding="utf-8"))
    comparison = found["problems"]["vector"]["comparisons"][str(path)]["one step"]
    assert comparison["exceeded"] == {"step": 1, "tensor": "optimizer/momentum/rssm/gru/bias", "deviation": 1e-4}
    assert comparison["curves"]["samples"] == [0, 0]
    assert (tmp_path / "out" / "lockstep-float64-vector.png").read_bytes().startswith(b"\x89PNG")


def test_an_interrupted_run_prints_what_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step = Lockstep.step

    def interrupted(self: Lockstep) -> None:
        if self.steps == 2:
            raise KeyboardInterrupt
        step(self)

    monkeypatch.setattr(Lockstep, "step", interrupted)
    assert main(["lockstep", "--backends", "torch,numpy", "--steps", "5", "--out", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "interrupted" in out
    assert "vector: torch against numpy, float64, 2 steps" in out
    found = json.loads((tmp_path / "lockstep-float64.json").read_text(encoding="utf-8"))
    assert found["steps"] == {"vector": 2, "image": 0}
    assert list(found["problems"]) == ["vector"]


def test_gradients_must_come_from_somewhere() -> None:
    reference = load_candidate("numpy", "float64")
    with pytest.raises(UserError, match="has no gradients of its own"):
        Lockstep({"numpy": reference, "mutant": MutantAdapter(SLIGHT)}, "vector", "paper", "float64", 0)
    with pytest.raises(UserError, match="nothing offers neither train_step nor train_step_with"):
        Lockstep({"nothing": object(), "numpy": reference}, "vector", "paper", "float64", 0)
