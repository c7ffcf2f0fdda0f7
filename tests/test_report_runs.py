"""What the report reads: runs found, grouped and described, also damaged ones."""

import json
from pathlib import Path
from typing import Any

import pytest
from html_document import Document
from report_runs import NAN, NOW, make_run, page

from dreamer_spec.cli import main
from dreamer_spec.disk import checkpoint
from dreamer_spec.errors import UserError
from dreamer_spec.report.results import headline, state
from dreamer_spec.report.runs import find_logdirs, group_runs, newest_pictures, read_run


def test_runs_that_differ_in_the_seed_are_one_group(tmp_path: Path) -> None:
    runs = [
        read_run(make_run(tmp_path / "a", [{"step": 1}], options={"seed": 0, "steps": 100, "action_repeat": 1})),
        read_run(make_run(tmp_path / "b", [{"step": 1}], options={"seed": 1, "steps": 200, "action_repeat": 1})),
        read_run(
            make_run(
                tmp_path / "c", [{"step": 1}], options={"seed": 0, "steps": 100, "action_repeat": 1}, backend="torch"
            )
        ),
        read_run(
            make_run(
                tmp_path / "d", [{"step": 1}], hyperparameters={"units": 16}, changed_hyperparameters={"units": 16}
            )
        ),
        read_run(make_run(tmp_path / "e", [{"step": 1}], task="gym:Y")),
        read_run(make_run(tmp_path / "f", [{"step": 1}])),
        read_run(make_run(tmp_path / "g", [{"step": 1}])),
    ]
    groups = {
        task: [([run.logdir.name for run in group.runs], group.label, group.size) for group in found]
        for task, found in group_runs(runs).items()
    }
    assert groups["gym:X"] == [
        (["a", "b"], "jax, units 8", "2 seeds"),
        (["c"], "torch, units 8", "1 seed"),
        (["d"], "jax, units 16", "1 seed"),
    ]
    assert groups["gym:Y"] == [(["e"], "jax", "1 seed")]
    assert groups[""] == [(["f"], "f", "1 run"), (["g"], "g", "1 run")], "nothing is known, so they may be anything"


def test_an_older_run_is_known_from_its_checkpoint(tmp_path: Path) -> None:
    path = make_run(tmp_path / "old", [{"step": 3}])
    for step, seed in (("000000000005", 7), ("000000000009", 8)):
        (path / "checkpoints" / step).mkdir(parents=True)
        identity = {"task": "gym:Old", "seed": seed, "action_repeat": 2, "image_size": 64, "units": 16}
        (path / "checkpoints" / step / "checkpoint.json").write_text(
            json.dumps({"identity": identity, "backend": "torch", "spaces": {}})
        )
    (path / "checkpoints" / "000000000012.tmp").mkdir()
    run = read_run(path)
    assert (run.task, run.backend, run.seed, run.hyperparameters) == ("gym:Old", "torch", 8, {"units": 16})
    assert run.step == 9
    assert run.notes == ["run.json is missing: shown is what the newest checkpoint knows"]


def test_log_directories_are_found_below_a_directory_and_once(tmp_path: Path) -> None:
    a, b = make_run(tmp_path / "a", [{"step": 1}]), make_run(tmp_path / "b", [], task="gym:Y")
    (tmp_path / "other").mkdir()
    assert find_logdirs([tmp_path]) == [a, b]
    assert find_logdirs([b, tmp_path / "a", a]) == [b, a]


def test_paths_without_a_run_are_named_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As `runs/*` gives them: what a failed start has left, and files beside the runs."""
    make_run(tmp_path / "a", [{"step": 1}], task="t")
    (tmp_path / "typo").mkdir()
    (tmp_path / "typo" / ".lock").touch()
    (tmp_path / "notes.txt").touch()
    paths = sorted(map(str, tmp_path.iterdir()))
    assert main(["report", *paths, "--out", str(tmp_path / "page.html")]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[:-1] == [f"{tmp_path / name} holds no run and is left out" for name in ("notes.txt", "typo")]
    assert "1 run," in out[-1]


def test_the_checkpoints_of_a_run_are_no_runs(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, 9, {}, {}, {}, keep=1)
    for path in (tmp_path / "checkpoints", tmp_path / "checkpoints" / "000000000009"):
        with pytest.raises(UserError, match=f"{path} holds no run"):
            find_logdirs([path])


def test_damaged_lines_are_counted(tmp_path: Path) -> None:
    path = make_run(tmp_path / "a", [{"step": 2, "b": 1.5}, {"step": 1, "b": NAN}], task="t")
    with (path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 3, "b"')
    run = read_run(path)
    assert run.curves["b"].steps.tolist() == [1, 2]
    assert run.last("b") == 1.5
    assert run.notes == ["metrics.jsonl has 1 damaged line, which is left out"]


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        "[" * 100_000,
        '{"format": 1, "task": 3, "options": [], "starts": {"a": 1}, "machine": "x", "preflight": true}',
    ],
)
def test_a_damaged_run_json_gives_a_page(tmp_path: Path, content: str) -> None:
    path = make_run(tmp_path / "a", [{"step": 2, "episode/return": 1.5}])
    (path / "run.json").write_text(content)
    assert "unknown task" in Document(page(path)).text


def test_the_newest_pictures_of_each_key(tmp_path: Path) -> None:
    names = [
        "000000000010-a.png",
        "000000000020-a.png",
        "000000000020-a.gif",
        "000000000010-b-c.png",
        "x-a.png",
        "000000000030-a.txt",
    ]
    for name in names:
        (tmp_path / name).touch()
    found = [path.name for path in newest_pictures(tmp_path)]
    assert found == ["000000000020-a.gif", "000000000020-a.png", "000000000010-b-c.png"]


# Results


def test_headlines(tmp_path: Path) -> None:
    def groups(*lines: list[dict[str, Any]]) -> Any:
        paths = [
            make_run(tmp_path / f"{len(list(tmp_path.iterdir()))}", one, options={"seed": seed})
            for seed, one in enumerate(lines)
        ]
        [group] = group_runs([read_run(path) for path in paths])["gym:X"]
        return headline(group)

    evaluated = {"step": 9, "evaluation/return": 100.0, "evaluation/return_standard_error": 2.0}
    found = groups([evaluated])
    assert (found.value, found.error) == ("100", "± 2")
    found = groups([evaluated], [{**evaluated, "evaluation/return": 300.0}])
    assert (found.value, found.error) == ("200", "± 100"), "the error over seeds, not over episodes"
    assert found.lines[:2] == ["return, last evaluation, mean over 2 seeds", "± standard error over them"]
    found = groups([{"step": step, "episode/return": float(step)} for step in range(1, 31)])
    assert (found.value, found.lines[0]) == ("20.5", "return, mean of the last 20 training episodes")
    assert (found := groups([{"step": 1, "episode/return": NAN}])).value == "no return yet"
    assert found.error == ""


def test_the_state_of_a_run(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "a", [{"step": 25, "b": 1}], task="t"))
    assert run.written
    assert state(run, run.written + 65) == "25% of 100 steps, last line 1 min 05 s ago"
    assert state(read_run(make_run(tmp_path / "b", [{"step": 100, "b": 1}], task="t")), NOW) == "finished"
    assert state(read_run(make_run(tmp_path / "c", [], task="t")), NOW) == "0% of 100 steps, nothing logged yet"


# The page
