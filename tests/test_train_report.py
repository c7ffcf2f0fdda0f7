"""`train report`: what stands in the page is what the runs wrote, and nothing that they wrote becomes markup."""

import base64
import hashlib
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_document import Document
from PIL import Image

from dreamer_spec.cli import main
from dreamer_spec.disk import checkpoint
from dreamer_spec.errors import UserError
from dreamer_spec.report import svg
from dreamer_spec.report.page import render
from dreamer_spec.report.results import headline, state
from dreamer_spec.report.runs import Curve, RunLog, find_logdirs, group_runs, newest_pictures, read_run
from dreamer_spec.report.series import means, over_runs, over_values, stacked, thinned

NOW = 2_000_000_000.0
NAN = float("nan")


def curve(steps: list[float], values: list[float]) -> Curve:
    return Curve(np.array(steps, float), np.array(values, float))


def make_run(path: Path, lines: list[dict[str, Any]], **about: Any) -> Path:
    """A log directory with these lines and, where something is to be known about it, a run.json."""
    path.mkdir(parents=True)
    (path / "metrics.jsonl").write_text("".join(json.dumps({"seconds": 1.0, **line}) + "\n" for line in lines))
    if about:
        base = {
            "format": 1,
            "task": "gym:X",
            "backend": "jax",
            "options": {"seed": 0, "steps": 100},
            "hyperparameters": {"units": 8},
        }
        (path / "run.json").write_text(json.dumps({**base, **about}))
    return path


def page(*paths: Path) -> str:
    return render([read_run(path) for path in find_logdirs(paths)], NOW)


# Curves


def test_means_over_stretches_of_steps() -> None:
    band = means(curve([0, 10, 30, 60, 100], [1, 3, NAN, 5, 7]), 2, 100)
    assert band.steps.tolist() == [5, 80]
    assert (band.middle.tolist(), band.low.tolist(), band.high.tolist()) == ([2, 6], [1, 5], [3, 7])
    assert band.bad.tolist() == [30]
    assert len(means(curve([1], [math.inf]), 5, 1)) == 0


def test_the_spread_over_runs_is_that_of_their_means() -> None:
    runs = [curve([0, 1, 10, 11], [0, 2, 4, 6]), curve([0, 1, 10, 11], [10, 20, 30, 50])]
    band = over_runs(runs, 2, 12)
    assert (band.steps.tolist(), band.middle.tolist()) == ([0.5, 10.5], [8, 22.5])
    assert (band.low.tolist(), band.high.tolist()) == ([1, 5], [15, 40])
    values = over_values(runs, 2, 12)
    assert (values.middle.tolist(), values.low.tolist(), values.high.tolist()) == ([8, 22.5], [0, 4], [20, 50])


def test_a_shorter_run_counts_as_far_as_it_goes() -> None:
    band = over_runs([curve([0, 10, 20], [0, 10, 20]), curve([0, 10], [2, 12])], 100, 20)
    assert dict(zip(band.steps.tolist(), band.middle.tolist(), strict=True)) == {0: 1, 10: 11, 20: 20}


def test_a_run_that_ends_a_moment_earlier_counts_to_the_end() -> None:
    """Or else the mean would jump to the other run at its last point."""
    band = over_runs([curve([0, 50, 99], [1, 1, 1]), curve([0, 50, 100], [3, 3, 3])], 50, 100)
    assert (band.steps[-1], band.middle.tolist()) == (100, [2, 2, 2, 2])


def test_nothing_is_drawn_where_no_run_is() -> None:
    """Two runs, the second begins after the end of the first."""
    runs = [curve(list(range(0, 100)), [1] * 100), curve(list(range(1000, 1100)), [3] * 100)]
    band = over_runs(runs, 20, 1100)
    assert np.isfinite(band.middle).all()
    assert not ((band.steps > 100) & (band.steps < 1000)).any()


def test_a_long_curve_is_thinned_to_its_ends() -> None:
    thin = thinned(curve(list(range(50_000)), list(range(50_000))))
    assert len(thin.steps) == 1000
    assert (thin.values[0], thin.values[-1]) == (0, 49_999)


def test_shares_add_up_to_one() -> None:
    steps, shares = stacked(
        {"a": [curve([0, 10], [0.5, 0.2])], "b": [curve([0, 10], [0.5, 0.6])], "c": [curve([0], [NAN])]}, 10, 10
    )
    assert steps.tolist() == [0, 10]
    assert shares["a"].tolist() == pytest.approx([0.5, 0.25])
    assert np.sum(list(shares.values()), axis=0).tolist() == pytest.approx([1, 1])


# Charts


def test_ticks_are_round_numbers() -> None:
    assert svg.linear_ticks(0, 8000, 5) == [0, 2000, 4000, 6000, 8000]
    assert svg.linear_ticks(-0.11, 0.31, 4) == pytest.approx([-0.1, 0, 0.1, 0.2, 0.3])
    assert svg.log_ticks(2, 2000, 3) == [10, 100, 1000]
    assert [svg.tick_format([], True)(value) for value in (1e-3, 0.1, 10, 1e4, 1e6)] == [
        "0.001",
        "0.1",
        "10",
        "10,000",
        "1e+06",
    ]


@pytest.mark.parametrize(
    ("ticks", "text"),
    [
        ([0, 2000, 4000], ["0", "2,000", "4,000"]),
        ([0, 50_000, 100_000], ["0", "50k", "100k"]),
        ([0, 500_000, 1_000_000], ["0", "0.5M", "1.0M"]),
        ([0, 0.25, 0.5], ["0.00", "0.25", "0.50"]),
        ([0, 1e-5, 2e-5], ["0", "1e-05", "2e-05"]),
    ],
)
def test_numbers_at_axes(ticks: list[float], text: list[str]) -> None:
    assert [svg.tick_format(ticks, False)(value) for value in ticks] == text


def positions(chart: str) -> list[tuple[float, float]]:
    [line] = re.findall(r'class="line[^"]*" data-label="[^"]*" data-moved="0" d="M([^"]*)"', chart)
    return [tuple(map(float, point.split(","))) for point in line.split("L")]  # type: ignore[misc]


def test_a_line_lies_where_its_values_are() -> None:
    band = means(curve([0, 50, 100], [0, 5, 10]), 100, 100)
    frame = svg.Frame(200, 100, left=50, right=10, top=10, bottom=20)
    chart = svg.line_chart([svg.Series("a", 0, band)], frame, "", x_end=100, limits=(0, 10))
    (x0, low), (x1, middle), (x2, high) = positions(chart)
    assert (x0, x1, x2) == (50, 120, 190)
    assert middle == pytest.approx((low + high) / 2, abs=0.1)
    assert low > high, "up is less in SVG"
    assert "stroke-dasharray" not in chart


def test_positive_values_that_spread_far_have_a_logarithmic_axis() -> None:
    band = means(curve([0, 50, 100], [1, 10, 100]), 100, 100)
    (_, low), (_, middle), (_, high) = positions(svg.line_chart([svg.Series("a", 0, band)], svg.SMALL, "", x_end=100))
    assert middle == pytest.approx((low + high) / 2, abs=0.1)


@pytest.mark.parametrize(
    "values",
    [
        [NAN, NAN, NAN],
        [1, NAN, 2],
        [math.inf, 1, -math.inf],
        [1e308, -1e308, 0],
        [1e308, 1e-308, 1e-320],
        [1e308, 1.1e308, 1.2e308],
        [-1e308, -1e308, -1e308],
        [5e-324, 0, 0],
        [0, 0, 0],
        [-7, -7, -7],
        [1e-12, 2e-12, 1e-10],
    ],
)
def test_no_value_breaks_a_picture(values: list[float]) -> None:
    band = over_values([curve([0, 10, 20], values), curve([0, 10, 20], values[::-1])], 10, 20)
    chart = svg.line_chart([svg.Series("a", 0, band, [thinned(curve([0, 10, 20], values))])], svg.SMALL, "", x_end=20)
    assert not re.search(r"nan|inf(?!inite)", chart.replace("not finite", ""))
    assert chart.count('class="bad"') == len(set(band.bad.tolist()))
    for x, y in re.findall(r"[ML](-?[\d.]+),(-?[\d.]+)", chart):
        assert -10 <= float(x) <= 310
        assert -10 <= float(y) <= 160
    Document(chart)


# Runs


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
