"""A loss or a gradient that is not finite: what the learners do about it, and the incident that is saved."""

import dataclasses
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance.problems import random_batch, random_state, small_config, spaces
from dreamer_spec.backend import Learner, learner_class
from dreamer_spec.commands import inspect
from dreamer_spec.disk.incidents import (
    Tally,
    load_incident,
    newest_incident,
    offending,
    save_incident,
    stop_error,
    tally,
)
from dreamer_spec.errors import UserError
from reference_numpy import agent, optimizer
from spec import parameter_table

TASK = spaces("vector", "discrete")
LAYERS = {
    f"{part}_layers": 1
    for part in ("encoder", "decoder", "posterior", "prior", "reward", "continue", "actor", "critic")
}
CONFIG = small_config("paper", "float32", **LAYERS)

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module", params=["jax", "torch"])
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def stopping(backend: str) -> Learner:
    return learner_class(backend)(TASK, CONFIG, seed=0, device="cpu")


@pytest.fixture(scope="module")
def skipping(backend: str) -> Learner:
    return learner_class(backend)(TASK, CONFIG, seed=0, device="cpu", nonfinite="skip")


def state() -> Arrays:
    """The middle of training: no number is zero or one."""
    return agent.flatten_state(random_state(np.random.default_rng(5), CONFIG, TASK, "float32"))


def batch(seed: int, **spoiled: float) -> Arrays:
    """A batch; spoiled: entry -> its last number."""
    arrays = random_batch(np.random.default_rng(seed), CONFIG, TASK)
    for name, value in spoiled.items():
        arrays[name].flat[-1] = value
    return arrays


def steep() -> Arrays:
    """A state of finite losses and infinite gradients: what the reward head normalizes is 0, and any change of it
    counts 10³⁸ fold."""
    arrays = state()
    for name in ("kernel", "bias"):
        arrays[f"params/reward/hidden0/{name}"][...] = 0
    arrays["params/reward/hidden0/scale"][...] = 1e38
    return arrays


def train(learner: Learner, inputs: Arrays, seed: int = 3) -> dict[str, float]:
    return {name: float(value) for name, value in learner.train_step(inputs, seed)[0].items()}


def assert_same(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> None:
    """Equal bit by bit, NaN included."""
    assert set(a) == set(b)
    assert [name for name in a if a[name].dtype != b[name].dtype or a[name].tobytes() != b[name].tobytes()] == []


# The learners


@pytest.mark.covers("LOOP-40")
@pytest.mark.parametrize("problem", ["reward", "observation", "latents", "gradient"])
def test_an_update_that_is_not_finite_is_not_made(skipping: Learner, problem: str) -> None:
    inputs = {
        "reward": batch(0, reward=np.inf),
        "observation": batch(0, position=-np.inf),
        "latents": batch(0, deter=np.nan),
        "gradient": batch(0),
    }[problem]
    skipping.load_state_dict(steep() if problem == "gradient" else state())
    before = skipping.state_dict()
    metrics = train(skipping, inputs)
    assert_same(skipping.state_dict(), before)
    assert (metrics["skipped"], metrics["update_norm"]) == (1, 0)
    assert not np.isfinite(metrics["gradient_norm"])
    assert np.isfinite(metrics["loss/total"]) == (problem == "gradient")
    if problem == "reward":
        assert np.isnan(metrics["loss/replay_critic"])
        assert np.isfinite(metrics["loss/dynamics"])


@pytest.mark.covers("LOOP-40")
def test_a_finite_update_is_made(stopping: Learner) -> None:
    stopping.load_state_dict(state())
    metrics, after = train(stopping, batch(0)), stopping.state_dict()
    assert metrics["skipped"] == 0
    assert metrics["update_norm"] > 0
    assert after["optimizer/step"] == state()["optimizer/step"] + 1
    assert [name for name, value in state().items() if np.array_equal(value, after[name])] == []


@pytest.mark.covers("LOOP-41")
def test_after_a_stop_nothing_changes_until_a_state_is_loaded(stopping: Learner) -> None:
    stopping.load_state_dict(state())
    train(stopping, batch(0))
    expected = stopping.state_dict()
    stopping.load_state_dict(state())
    train(stopping, batch(1, reward=np.nan))
    for seed in (0, 2):
        metrics = train(stopping, batch(seed))
        assert (metrics["skipped"], metrics["update_norm"]) == (1, 0)
        assert np.isfinite(metrics["loss/total"])
    assert_same(stopping.state_dict(), state())
    stopping.load_state_dict(state())
    assert train(stopping, batch(0))["skipped"] == 0
    assert_same(stopping.state_dict(), expected)


@pytest.mark.covers("LOOP-42")
def test_skipping_goes_on_as_if_the_step_had_not_been(skipping: Learner) -> None:
    results = []
    for spoiled in (True, False):
        skipping.load_state_dict(state())
        skipped = [train(skipping, batch(0), 0)["skipped"]]
        if spoiled:
            skipped += [
                train(skipping, batch(1, reward=np.inf), 1)["skipped"],
                train(skipping, batch(1, deter=np.inf), 2)["skipped"],
            ]
        skipped.append(train(skipping, batch(2), 3)["skipped"])
        assert skipped == ([0, 1, 1, 0] if spoiled else [0, 0])
        results.append(skipping.state_dict())
    assert_same(*results)
    assert results[0]["optimizer/step"] == state()["optimizer/step"] + 2


@pytest.mark.covers("LOOP-44")
def test_gradients_are_those_of_the_train_step(stopping: Learner) -> None:
    """The reference's optimizer makes of them what the train step made."""
    stopping.load_state_dict(state())
    metrics, gradients = stopping.gradients(batch(0), 7)
    assert_same(stopping.state_dict(), state())
    assert {name: array.shape for name, array in gradients.items()} == {
        name: entry.shape for name, entry in parameter_table(CONFIG, TASK).items()
    }
    trained = train(stopping, batch(0), 7)
    assert set(trained) - set(metrics) == {"update_norm", "clip_fraction", "skipped"}
    for name, value in metrics.items():
        np.testing.assert_allclose(value, trained[name], rtol=1e-5, atol=1e-6, err_msg=name)
    before = agent.unflatten_state(state(), parameter_table(CONFIG, TASK))
    params, moments = optimizer.optimizer_step(before["params"], gradients, before["optimizer"], CONFIG)
    after = stopping.state_dict()
    for name, gradient in gradients.items():
        np.testing.assert_allclose(after[f"params/{name}"], params[name], rtol=1e-5, atol=1e-7, err_msg=name)
        made = after[f"optimizer/momentum/{name}"] - state()[f"optimizer/momentum/{name}"] * CONFIG.beta1
        expected = moments["momentum"][name] - state()[f"optimizer/momentum/{name}"] * CONFIG.beta1
        np.testing.assert_allclose(made, expected, rtol=1e-3, atol=1e-6, err_msg=name)
        assert np.abs(gradient).max() > 0, name


def test_another_word_for_what_to_do_is_refused(backend: str) -> None:
    with pytest.raises(ValueError, match=r"nonfinite: expected 'stop' or 'skip', got '?Skip"):
        learner_class(backend)(TASK, CONFIG, seed=0, device="cpu", nonfinite="Skip")


# The incident


def info(backend: str, metrics: Mapping[str, Any]) -> dict[str, Any]:
    identity = {"task": "gym:CartPole-v1", **dataclasses.asdict(CONFIG)}
    return {
        "train_step": 41,
        "step": 1300,
        "backend": backend,
        "identity": identity,
        "spaces": TASK.to_json(),
        "metrics": metrics,
    }


@pytest.fixture
def found(stopping: Learner, backend: str, tmp_path: Path) -> Path:
    """The incident of a reward that is infinite."""
    stopping.load_state_dict(state())
    metrics, _ = stopping.train_step(batch(0, reward=np.inf), 9)
    return save_incident(tmp_path / "run", stopping, batch(0, reward=np.inf), 9, info(backend, metrics))


@pytest.mark.covers("LOOP-44")
def test_an_incident_comes_back_as_it_was_and_repeats(
    stopping: Learner, backend: str, found: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert found == newest_incident(found.parent.parent)
    assert found.name == "000000000041"
    assert [path.name for path in found.parent.iterdir()] == [found.name]
    incident = load_incident(found)
    assert_same(incident.state, state())
    assert_same(incident.batch, batch(0, reward=np.inf))
    assert [incident.info[name] for name in ("train_step", "step", "seed", "backend", "device")] == [
        41,
        1300,
        9,
        backend,
        "cpu",
    ]
    assert incident.info["versions"].keys() >= {"python", "numpy", backend}
    assert np.isnan([incident.metrics["loss/replay_critic"], incident.metrics["loss/total"]]).all()
    assert [one for one in incident.tallies if one.kind != "gradient"] == [
        Tally("batch", "reward", 10, 0, 1, 0, incident.tallies[0].largest)
    ]
    _, gradients = stopping.gradients(incident.batch, 9)
    named = {one.name for one in incident.tallies if one.kind == "gradient"}
    assert named == {name for name, array in gradients.items() if not np.isfinite(array).all()}
    assert "critic/out/kernel" in named
    assert "actor/hidden0/kernel" not in named
    assert inspect.main([str(found), "--rerun", "--device", "cpu"]) == 0
    assert f"Rerun on cpu: the same {3 + len(named)} metrics and gradients are not finite" in capsys.readouterr().out


def test_an_incident_replaces_an_older_one_of_the_same_step(stopping: Learner, backend: str, found: Path) -> None:
    stopping.load_state_dict(state())
    (found.parent / "000000000041.tmp").mkdir(exist_ok=True)  # Somebody else's.
    path = save_incident(found.parent.parent, stopping, batch(1), 2, info(backend, {"loss/total": 1.0}))
    assert path == found
    assert load_incident(found).info["seed"] == 2
    assert sorted(one.name for one in path.parent.iterdir()) == [path.name, "000000000041.tmp"]


def test_a_disk_that_refuses(stopping: Learner, backend: str, tmp_path: Path) -> None:
    (tmp_path / "nonfinite").touch()
    with pytest.raises(UserError, match=r"cannot write .*nonfinite/000000000041"):
        save_incident(tmp_path, stopping, batch(0), 2, info(backend, {}))


@pytest.mark.covers("LOOP-41")
def test_what_a_run_ends_with_names_the_incident() -> None:
    metrics = {
        "loss/total": np.nan,
        "loss/reward": 1.0,
        "loss/actor": np.inf,
        "gradient_norm": np.nan,
        "return_scale": -np.inf,
    }
    words = str(stop_error(Path("runs/x/nonfinite/000000000041"), info("jax", metrics)))
    assert "train step 41 (step 1300), not finite: loss/total, loss/actor, gradient_norm and 1 more." in words
    assert "`train inspect runs/x/nonfinite/000000000041`" in words
    assert "--nonfinite skip" in words


def test_tallies() -> None:
    array = np.array([[np.nan, np.inf], [-np.inf, -7.5], [np.nan, 2]], np.float32)
    assert tally("state", "x", array) == Tally("state", "x", 6, 2, 1, 1, 7.5)
    assert tally("state", "x", np.full(2, np.nan)) == Tally("state", "x", 2, 2, 0, 0, None)
    assert tally("batch", "image", np.array([3, 255], np.uint8)).largest == 255
    assert [one.name for one in offending("batch", {"a": array, "b": np.ones(2), "c": np.array([True])})] == ["a"]


def damage(path: Path, how: str) -> None:
    if how == "missing":
        path.unlink()
    elif how == "truncated":
        path.write_bytes(path.read_bytes()[:-5])
    else:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    learner = learner_class("torch")(TASK, CONFIG, seed=0, device="cpu")
    return save_incident(tmp_path_factory.mktemp("run"), learner, batch(0), 9, info("torch", {"loss/total": np.nan}))


@pytest.mark.parametrize("how", ["missing", "truncated", "flipped"])
@pytest.mark.parametrize("file", ["learner.safetensors", "batch.safetensors", "incident.json", "SHA256SUMS"])
def test_damaged_incidents_are_refused_by_name(intact: Path, tmp_path: Path, file: str, how: str) -> None:
    copy = Path(shutil.copytree(intact, tmp_path / "nonfinite" / "000000000041"))
    damage(copy / file, how)
    with pytest.raises(UserError, match=f"the incident {copy} is damaged: "):
        load_incident(copy)
    with pytest.raises(UserError, match=f"the incident {copy} is damaged: "):
        inspect.main([str(copy)])


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        ("format", 7, "format 7; this version reads format 1"),
        ("seed", -1, "seed: -1 is less than the minimum of 0"),
        ("step", "many", "step: 'many' is not of type 'integer'"),
        ("identity", [], "identity: \\[\\] is not of type 'object'"),
        ("metrics", {"loss/total": "big"}, "metrics/loss/total: 'big' is not"),
        ("tensors", [{"kind": "gradient", "name": "x"}], "tensors/0: 'elements' is a required property"),
    ],
)
def test_incidents_that_say_something_else_are_refused(
    intact: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entry: str, value: Any, words: str
) -> None:
    copy = Path(shutil.copytree(intact, tmp_path / "incident"))
    content = json.loads((copy / "incident.json").read_text())
    (copy / "incident.json").write_text(json.dumps({**content, entry: value}))
    monkeypatch.setattr("dreamer_spec.disk.incidents.require_intact", lambda folder, names: None)
    with pytest.raises(UserError, match=words):
        load_incident(copy)
