"""Checkpoints that somebody has forged, with checksums that agree: refused by name, or sound."""

import dataclasses
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file
from train_fakes import FakeLearner
from train_runs import Make, content, refused, run_quietly

from dreamer_spec.disk import checkpoint, files, folders
from dreamer_spec.errors import UserError
from dreamer_spec.training import loop


def edit(
    logdir: Path, info: Callable[[dict[str, Any]], None] | None = None, loop_arrays: dict[str, Any] | None = None
) -> Path:
    """Changes the newest checkpoint, with checksums that agree."""
    [folder] = checkpoint.candidates(logdir)[:1]
    if info:
        said = json.loads((folder / "checkpoint.json").read_text())
        info(said)
        (folder / "checkpoint.json").write_text(json.dumps(said))
    if loop_arrays:
        arrays = files.read_arrays(folder / "loop.safetensors")
        for name, change in loop_arrays.items():
            arrays[name] = np.ascontiguousarray(change(arrays[name]))
        save_file(arrays, folder / "loop.safetensors")
    folders.seal(folder, checkpoint.FILES)
    return folder


def filled(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda array: np.full_like(array, value)


ARRAYS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "a shape": ("drawn/reward", lambda array: array[:, :-1]),
    "a row less": ("drawn/observation", lambda array: array[:1]),
    "a dtype": ("drawn/is_first", lambda array: array.astype(np.float32)),
    "another width": ("drawn/prev_action", lambda array: array.astype(np.float64)),
    "NaN in the batch": ("drawn/prev_action", filled(np.nan)),
    "infinite latents": ("drawn/deter", filled(np.inf)),
    "a class out of range": ("drawn/stoch", filled(2)),
    "a negative class": ("drawn/stoch", filled(-1)),
    "a negative stream": ("drawn/ids", filled(-1)),
    "scores that are NaN": ("scores/total", filled(np.nan)),
    "a negative length": ("scores/length", filled(-1)),
    "more workers": ("scores/length", lambda array: np.concatenate([array, array])),
    "a carry of another shape": ("carry/steps", lambda array: array[:1]),
    "a carry of another kind": ("carry/steps", lambda array: array.astype(np.float64)),
    "NaN among the actions": ("actions/0", filled(np.nan)),
    "actions of another size": ("actions/1", lambda array: array[:, :1]),
}


@pytest.mark.covers("LOOP-54", "REP-38")
@pytest.mark.parametrize("what", ARRAYS)
def test_arrays_that_no_run_has_are_refused_by_name(make: Make, what: str) -> None:
    loop.run(make(steps=62), FakeLearner)
    name, change = ARRAYS[what]
    edit(make().logdir, loop_arrays={name: change})
    before = content(make().logdir)
    with pytest.raises(UserError, match=f"does not fit this version: .*{name.removeprefix('drawn/')}"):
        loop.run(make(steps=90), FakeLearner)
    if what != "another width":  # Known only when the buffer is there.
        assert content(make().logdir) == before


@pytest.mark.covers("LOOP-54")
@pytest.mark.parametrize(
    ("entry", "value"),
    [
        *(("counters/records", value) for value in (-1, 61, 60.0, True, 10**18, None)),
        *(("counters/seconds", value) for value in (-1.0, float("nan"), float("inf"), "1")),
        *(("counters/more", value) for value in (1,)),
        *(
            ("replay_ratio/credit", value)
            for value in ("1e9999999", "-1", "6", "1/0", "0x1", "١", "", 3, "9" * 2000, None)
        ),
        *(("replay_ratio/step", value) for value in (0, 59, 61, 10**15, -1, "60", 60.0)),
        *(("returns", value) for value in ([float("nan")], [None], [1.0] * 1000, {})),
        *(
            ("evaluation", value)
            for value in ({"step": 0.5, "return": 1.0}, {"step": 1}, [], {"step": 1, "return": float("nan")})
        ),
        *(("metrics", value) for value in ({"x": [1.0, 0]}, {"x": [1.0]}, {"x": 1}, {"x": [1.0, 2, 3]})),
        *(("environments", value) for value in ({}, [3], [{"seed": -1, "episode": 0}], [{"seed": 0}])),
        *(("log", value) for value in (-1, 0.5, "0")),
        *(("random_return", value) for value in ("1", [], float("inf"))),
    ],
)
def test_counters_that_no_run_has_are_refused_by_name(make: Make, entry: str, value: Any) -> None:
    loop.run(make(), FakeLearner)

    def change(info: dict[str, Any]) -> None:
        *path, last = entry.split("/")
        for key in path:
            info = info[key]
        info[last] = value

    edit(make().logdir, change)
    assert entry.split("/")[0] in refused(make(steps=90))


def test_a_training_state_that_is_not_finite_is_refused(make: Make) -> None:
    loop.run(make(), FakeLearner)
    [folder] = checkpoint.candidates(make().logdir)
    state = files.read_arrays(folder / "learner.safetensors")
    state["params/w"][0, 0] = np.nan
    save_file(state, folder / "learner.safetensors")
    folders.seal(folder, checkpoint.FILES)
    assert "params/w holds numbers that are not finite" in refused(make(steps=90))


@pytest.mark.parametrize(("name", "value"), [("optimizer/second_moment/w", -1.0), ("optimizer/step", -5)])
def test_an_optimizer_that_no_run_has_is_refused(make: Make, name: str, value: float) -> None:
    loop.run(make(), FakeLearner)
    [folder] = checkpoint.candidates(make().logdir)
    state = files.read_arrays(folder / "learner.safetensors")
    state[name] = np.full_like(state.get(name, np.zeros((2, 3), np.float32)), value)
    save_file(state, folder / "learner.safetensors")
    folders.seal(folder, checkpoint.FILES)
    assert f"{name} holds numbers below 0" in refused(make(steps=90))


def junk(rng: random.Random, depth: int = 0) -> Any:
    kinds = [None, True, -1, 0.5, 2**62, 10**400, 1e300, float("nan"), "", "x" * 3, "1/0", [], {}]
    return (
        rng.choice(kinds)
        if depth > 1 or rng.random() < 0.7
        else [junk(rng, depth + 1)]
        if rng.random() < 0.5
        else {"x": junk(rng, depth + 1)}
    )


def forge(info: Any, rng: random.Random) -> None:
    """Replaces, removes or adds one value somewhere in a tree of JSON."""
    node, key = {"": info}, ""
    while isinstance(node[key], dict | list) and node[key] and rng.random() < 0.8:
        node = node[key]
        key = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
    if rng.random() < 0.2 and key != "":
        del node[key]
    else:
        node[key] = junk(rng)


def test_forged_descriptions_are_refused_or_sound(make: Make, tmp_path: Path) -> None:
    """With right checksums, as a forger would write them. Whatever a description says: an agent that trains on, or one
    line."""
    options = make(task="gym:CartPole-v1", steps=40, eval_every=20, eval_episodes=1)
    loop.run(options, FakeLearner)
    folder = "checkpoints/000000000040"
    description = json.loads((options.logdir / folder / "checkpoint.json").read_text())
    rng, outcomes = random.Random(0), []
    for number in range(120):
        logdir = tmp_path / str(number)
        shutil.copytree(options.logdir, logdir)
        forged = json.loads(json.dumps(description))
        forge(forged, rng)
        (logdir / folder / "checkpoint.json").write_text(json.dumps(forged))
        folders.seal(logdir / folder, checkpoint.FILES)
        try:
            run_quietly(dataclasses.replace(options, logdir=logdir, steps=44))
            outcomes.append("sound")
        except UserError:
            outcomes.append("refused")
        shutil.rmtree(logdir)
    assert outcomes.count("refused") > 60
    assert outcomes.count("sound") > 10
