"""`train report`: what stands in the page is what the runs wrote, and nothing that they wrote becomes markup."""

import base64
import hashlib
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_document import Document
from PIL import Image
from report_runs import NAN, make_run, page

from dreamer_spec.cli import main
from dreamer_spec.report.runs import RunLog


def full_run(path: Path, seed: int) -> Path:
    rng = np.random.default_rng(seed)
    lines: list[dict[str, Any]] = [{"step": 0, "random/return": 5.0}]
    for step in range(10, 101, 10):
        lines.append(
            {
                "step": step,
                "episode/return": step + seed,
                "episode/length": 10,
                "train/loss/total": float(rng.normal()),
                "own": NAN,
            }
        )
        lines.append({"step": step, "time/train": 0.75, "time/other": 0.25, "evaluation/return": 2.0 * step})
    start = {
        "time": "2026-01-01T00:00:00+00:00",
        "step": 0,
        "backend": "jax",
        "device": "cpu",
        "commit": "abc",
        "versions": {"jax": "1"},
    }
    about = {
        "options": {"seed": seed, "steps": 100},
        "command": "train --backend jax --task gym:X",
        "preflight": {
            "passed": True,
            "worst": 1.5e-7,
            "summary": "networks agree",
            "comparisons": [{"name": "encoder", "requirements": ["NET-2", "NET-12"], "share": 0.0625}, 3],
        },
        "machine": {"processor": "A Processor", "cores": 2, "versions": {"jax": "1"}},
        "starts": [start, {**start, "step": 50, "versions": {"jax": "2"}}],
        "spaces": {"observations": {"image": {"kind": "image", "height": 8}}, "actions": {}},
    }
    make_run(path, lines, **about)
    (path / "predictions").mkdir()
    Image.new("RGB", (4, 4)).save(path / "predictions" / "000000000100-image.png")
    (path / "predictions" / "000000000100-image.gif").write_bytes(b"neither")
    return path


def test_the_page_holds_what_the_runs_are(tmp_path: Path) -> None:
    paths = [full_run(tmp_path / "first", 0), full_run(tmp_path / "second", 1)]
    document = Document(page(*paths))
    for text in (
        "gym:X",
        "2 seeds",
        "200 ± 0",
        "train --backend jax --task gym:X",
        "networks agree",
        "1.5e-07",
        "A Processor",
        "jax 2",
    ):
        assert text in document.text, text
    assert "encoderNET-2, NET-12passed6.25%" in document.text
    assert "not finite at step 10" in document.text
    assert "train: 75.0% on average" in document.text
    assert "image.gif is damaged" in document.text
    assert "what it means" in document.text
    assert document.count("svg") == 6, "training, evaluations, length, loss, time, own"
    image = base64.b64encode((paths[0] / "predictions" / "000000000100-image.png").read_bytes()).decode()
    assert [attributes["src"] for tag, attributes in document.elements if tag == "img"] == [
        f"data:image/png;base64,{image}"
    ] * 2


def test_the_page_needs_nothing_else_and_forbids_it(tmp_path: Path) -> None:
    text = page(full_run(tmp_path / "a", 0))
    document = Document(text)
    for tag, attributes in document.elements:
        assert tag not in ("link", "iframe", "object", "a")
        assert (attributes.get("src") or "data:").startswith("data:")
    assert "url(" not in text
    assert "@import" not in text
    [policy] = [attributes["content"] for tag, attributes in document.elements if "http-equiv" in attributes]
    [script] = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy == f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"


def test_what_a_run_says_does_not_become_markup(tmp_path: Path) -> None:
    evil = "\"'><script>alert(1)</script><img src=x onerror=alert(1)>"

    def everywhere(value: Any) -> Any:
        if isinstance(value, dict):
            return {f"{name}{evil}" if name not in KNOWN else name: everywhere(entry) for name, entry in value.items()}
        if isinstance(value, list):
            return [everywhere(entry) for entry in value]
        return evil if isinstance(value, str) else value

    KNOWN = {
        *RunLog.__dataclass_fields__,
        "format",
        "observations",
        "actions",
        "kind",
        "versions",
        "summary",
        "passed",
        "time",
    }
    plain = full_run(tmp_path / "plain", 0)
    path = full_run(tmp_path / "evil<b>", 0)
    about = everywhere(json.loads((path / "run.json").read_text()))
    about["hyperparameters"] |= {evil: evil}
    (path / "run.json").write_text(json.dumps(about))
    with (path / "metrics.jsonl").open("a") as file:
        for name in (evil, f"time/{evil}", f"train/loss/reconstruction/{evil}"):
            file.write(json.dumps({"step": 100, name: 1.0}) + "\n")
    Image.new("RGB", (4, 4)).save(path / "predictions" / "000000000100-<b onclick=x>&.png")
    harmless, document = Document(page(plain)), Document(page(path))
    assert {tag for tag, _ in document.elements} <= {"code", *(tag for tag, _ in harmless.elements)}
    assert document.count("script") == 1
    assert not [name for _, attributes in document.elements for name in attributes if name.startswith("on")]
    assert "<script>alert(1)</script>" in document.text, "it is shown as text"


def test_a_long_run_gives_a_small_page(tmp_path: Path) -> None:
    lines = [
        {"step": step, "episode/return": step % 97, **{f"train/m{index}": step % 89 for index in range(10)}}
        for step in range(20_000)
    ]
    assert len(page(make_run(tmp_path / "a", lines))) < 150_000


def test_runs_of_several_tasks_each_have_their_curves(tmp_path: Path) -> None:
    first, second = (
        full_run(tmp_path / "a", 0),
        make_run(tmp_path / "b", [{"step": 1, "episode/return": 1.0}], task="dmc:y"),
    )
    text = Document(page(first, second, make_run(tmp_path / "c", []))).text
    assert "Returns: gym:X" in text
    assert "Returns: dmc:y" in text
    assert "Nothing has been logged yet." in text


def test_more_groups_than_colours(tmp_path: Path) -> None:
    for units in range(10):
        make_run(
            tmp_path / f"{units}",
            [{"step": 1, "a": 1.0}, {"step": 2, "a": 2.0}],
            hyperparameters={"units": units},
            changed_hyperparameters={"units": units},
        )
    text = page(tmp_path)
    assert text.count('class="line c1"') == 1
    assert text.count('class="line c1 dashed"') == 1


def test_what_is_no_file_is_noted_and_not_waited_for(tmp_path: Path) -> None:
    """A pipe never ends, and neither does a device."""
    path = full_run(tmp_path / "a", 0)
    (path / "metrics.jsonl").unlink()
    os.mkfifo(path / "metrics.jsonl")
    os.mkfifo(path / "predictions" / "000000009999-pipe.png")
    text = Document(page(path)).text
    assert "there are no metrics: metrics.jsonl is not a file" in text
    assert "000000009999-pipe.png cannot be read: 000000009999-pipe.png is not a file" in text
    (path / "metrics.jsonl").unlink()
    (path / "metrics.jsonl").mkdir()
    assert "metrics.jsonl is not a file" in Document(page(path)).text


def test_not_every_one_of_very_many_metrics_is_drawn(tmp_path: Path) -> None:
    many = {f"m{index}": 1.0 for index in range(90_000)} | {
        f"train/loss/reconstruction/k{index}": 1.0 for index in range(1000)
    }
    content = page(make_run(tmp_path / "a", [{"step": 1, **many}, {"step": 2, **many}]))
    text = Document(content).text
    assert "89,800 more metrics of this section are not drawn." in text
    assert len(content) < 2_000_000


def test_a_name_that_is_no_text_is_shown_as_far_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/r\xffn"))
    full_run(path, 0)
    assert main(["report", str(path), "--out", str(tmp_path / "all.html")]) == 0
    assert "r?n" in (tmp_path / "all.html").read_text(encoding="utf-8")


# The command


def test_the_command_writes_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    full_run(tmp_path / "runs" / "a", 0)
    out = tmp_path / "all.html"
    assert main(["report", str(tmp_path / "runs"), "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith(f"{out}: 1 run, ")
    assert out.read_text().startswith("<!doctype html>")
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["all.html"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["report"], "required: LOGDIR"),
        (["report", "{}/missing"], "missing is not there; expected a log directory"),
        (["report", "{}"], "holds no run: neither metrics.jsonl nor run.json"),
        (["report", "{}/run", "--out", "{}/no/page.html"], "there is no folder"),
        (["report", "{}/run", "--out", "{}/run"], "Is a directory; choose another file with --out"),
        (["report", "{}/missing", "--out", "."], "cannot write .: Is a directory"),
        (["report", "{}/missing", "--out", ""], "cannot write .: Is a directory"),
    ],
)
def test_mistakes_have_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    if "--out" in arguments:
        make_run(tmp_path / "run", [])
    assert main([argument.format(tmp_path) for argument in arguments]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("train: error: ")
    assert message in line
