"""run.json: the command in it gives the same run, and a resumed run goes on in it."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from conformance.preflight import Agreement, Report
from dreamer_spec.cli import build_parser, parse
from dreamer_spec.disk.about import command_line, nearest, read_about, write_about
from dreamer_spec.errors import UserError
from dreamer_spec.options import Options, assemble_options, presets
from dreamer_spec.system.machine import describe
from spec import Discrete, Spaces, Vector, hyperparameters, load_config

SPACES = Spaces({"observation": Vector(4)}, {"action": Discrete((2,))})


def write(options: Options, resumed_at: int | None = None) -> dict[str, Any]:
    report = Report(True, 1e-7, "all agree", [Agreement("encoder", ["NET-2"], 0.25)], {"networks": 0.5})
    return write_about(options, spaces=SPACES, device="cpu", parameters=123, preflight=report, resumed_at=resumed_at)


@pytest.mark.parametrize("preset", [name for name in presets() if name != "base"])
def test_the_command_of_every_preset_gives_its_options(preset: str, tmp_path: Path) -> None:
    task = {} if "task" in presets()[preset] else {"task": "my_module:make_env"}
    options = assemble_options("jax", {"logdir": tmp_path / "a b", **task}, {}, preset)
    words = command_line(options)
    assert "--preset" not in words
    assert parse(words[1:]) == options


def test_the_command_gives_every_option() -> None:
    """Every option of `train` is given a value that it does not have by itself, so one that the command forgets fails
    here."""
    plain = assemble_options("jax", {"task": "my module:make_env"}, {})
    words = [
        "--task",
        "my module:make_env",
        "--learning-rate",
        "3e-5",
        "--cnn-multipliers",
        "2,2,4,4",
        "--cnn-outer",
        "false",
    ]
    for action in build_parser()._actions:
        if action.dest in ("help", "version", "preset", "task", "seeds") or action.dest in hyperparameters():
            continue
        words.append(action.option_strings[-1])  # --no-preflight of --preflight
        if action.nargs != 0:
            seven = "n=7" if action.dest == "env_arg" else "7"
            unusual = [choice for choice in action.choices or [seven] if choice != getattr(plain, action.dest, "12m")]
            words.append(unusual[-1])
    options = parse(words)
    same = [
        field.name
        for field in dataclasses.fields(options)
        if getattr(options, field.name) == getattr(plain, field.name)
    ]
    assert same == ["task", "make"]  # A callable that only a script has; its command names it by its task.
    assert parse(command_line(options)[1:]) == options


def test_profile_and_size_are_found_again() -> None:
    assert nearest(load_config("official", "50m")) == ("official", "50m", {})
    assert nearest(load_config("paper", "tiny", learning_rate=1e-3, envs=2)) == (
        "paper",
        "tiny",
        {"learning_rate": 1e-3, "envs": 2},
    )


def test_run_json_says_everything(tmp_path: Path) -> None:
    options = assemble_options("jax", {"logdir": tmp_path, "seed": 5}, {})
    about = write(options)
    assert json.loads((tmp_path / "run.json").read_text()) == about == read_about(tmp_path)
    assert (about["task"], about["profile"], about["size"], about["parameters"]) == (
        "gym:CartPole-v1",
        "paper",
        "tiny",
        123,
    )
    assert about["options"]["seed"] == 5
    assert about["hyperparameters"]["batch_length"] == 32
    assert about["changed_hyperparameters"]["batch_length"] == 32
    comparison = {"name": "encoder", "requirements": ["NET-2"], "share": 0.25}
    found = {"passed": True, "worst": 1e-7, "summary": "all agree", "comparisons": [comparison]}
    assert about["preflight"] == {**found, "seconds": {"networks": 0.5}}
    assert about["spaces"]["actions"] == {"action": {"kind": "discrete", "classes": [2]}}
    assert {"processor", "cores", "memory_gib", "system", "accelerator", "python", "versions", "commit"} <= about[
        "machine"
    ].keys()
    assert about["machine"]["versions"]["numpy"]
    assert [start["step"] for start in about["starts"]] == [0]
    assert not list(tmp_path.glob("*.tmp"))


def test_a_resumed_run_appends_its_start(tmp_path: Path) -> None:
    options = assemble_options("jax", {"logdir": tmp_path}, {})
    first = write(options)
    second = write(dataclasses.replace(options, backend="torch", steps=30_000), 1234)
    assert second["id"] == first["id"]
    assert [(start["step"], start["backend"]) for start in second["starts"]] == [(0, "jax"), (1234, "torch")]
    assert (second["backend"], second["options"]["steps"]) == ("torch", 30_000)
    new = write(options)
    assert new["id"] != first["id"]
    assert len(new["starts"]) == 1


@pytest.mark.parametrize(
    "content", ["", "[]", '{"format": 99}', "[" * 100_000, '{"format": 1}', '{"format": 1, "id": 2, "starts": 3}']
)
def test_a_damaged_run_json_does_not_stop_a_resume(tmp_path: Path, content: str) -> None:
    (tmp_path / "run.json").write_text(content)
    assert (read_about(tmp_path) is None) is ('"format": 1' not in content)
    assert len(write(assemble_options("jax", {"logdir": tmp_path}, {}), 10)["starts"]) == 1
    if '"format": 1' not in content:
        assert (tmp_path / "run.json.damaged").read_text() == content


def test_run_json_is_complete_or_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = assemble_options("jax", {"logdir": tmp_path}, {})
    first = write(options)

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(UserError, match=r"cannot write .*run.json: No space left"):
        write(options, 10)
    assert read_about(tmp_path) == first


def test_the_commit_is_that_of_this_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not that of the repository in which a user happens to stand."""
    here = describe()["commit"]
    monkeypatch.chdir(tmp_path)
    assert describe()["commit"] == here
    monkeypatch.setattr("dreamer_spec.system.machine.ROOT", tmp_path)
    assert describe()["commit"] is None
