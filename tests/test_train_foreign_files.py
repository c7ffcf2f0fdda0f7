"""What others have put into a log directory, what is away for a moment, and what cannot be read: nothing of it is
changed."""

import errno
import os
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from train_agents import save_checkpoint
from train_fakes import FakeLearner
from train_runs import Make, content, refused, run_quietly

from conformance.problems import small_config
from dreamer_spec.cli import main
from dreamer_spec.disk import checkpoint
from dreamer_spec.disk.files import Unreadable
from dreamer_spec.errors import UserError
from dreamer_spec.training import loop
from spec import Spaces, Vector

CONFIG = small_config("paper", "float32")
TASK = Spaces({"position": Vector(3)}, {"arm": Vector(2)})


# No checkpoint, and yet something

NAMES = [
    *("metrics.jsonl", "run.json", "curve.png", "replay/chunk-0000000000.bin", "replay/saved-0000000001.safetensors"),
    *(
        "checkpoints/000000000060/x",
        "predictions/000000000001-x.png",
        "nonfinite/000000000001/x",
        "replay/journal-0000000001.bin",
    ),
]
HARMLESS = [
    *(
        "notes.txt",
        "replay/chunk-²³.bin",
        "replay/chunk-0000000001.bin.bak",
        "replay/saved-mine.txt",
        "checkpoints/best/weights.bin",
    ),
    *(
        "checkpoints/000000000060.mine",
        "predictions/mine.png",
        "run.tmp",
        "metrics.jsonl.tmp",
        ".hydra/config.yaml",
        "slurm-1.out",
    ),
    *(
        "checkpoints/000000000060.tmp",
        "replay/saved-0000000001.tmp",
        "nonfinite/000000000001.tmp",
        "policy.tmp/x",
        "replay/mine/x",
    ),
]


def put(directory: Path, name: str, data: bytes) -> None:
    path = directory / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


@pytest.mark.covers("LOOP-51")
@pytest.mark.parametrize("name", NAMES)
def test_files_under_the_names_of_a_run_are_refused_by_name(make: Make, name: str) -> None:
    data = b"dreamer-spec replay chunk" if "chunk" in name else b'{"step": 1}\n'
    put(make().logdir, name, data)
    message = refused(make())
    assert name.removesuffix("/x") in message
    assert "choose another --logdir" in message


@pytest.mark.covers("LOOP-51")
@pytest.mark.parametrize("how", ["moved", "emptied"])
def test_a_run_whose_checkpoints_are_gone_is_not_begun_again(make: Make, how: str) -> None:
    loop.run(make(), FakeLearner)
    folder = make().logdir / "checkpoints"
    if how == "moved":
        folder.rename(make().logdir.parent / "moved")
    else:
        shutil.rmtree(folder)
        folder.mkdir()
    message = refused(make(steps=90))
    assert "metrics.jsonl" in message
    assert f"Move them back into {folder}" in message
    if how == "moved":
        (make().logdir.parent / "moved").rename(folder)
        assert run_quietly(make(steps=90)).counters.records == 90


@pytest.mark.covers("LOOP-51")
def test_what_a_run_left_that_had_no_checkpoint_is_replaced(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: Any) -> None:
        raise SystemError

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", killed)
        with pytest.raises(SystemError):
            loop.run(make(), FakeLearner)
    assert (make().logdir / "metrics.jsonl").exists()
    assert list((make().logdir / "replay").glob("saved-*"))
    assert loop.run(make(), FakeLearner)


@pytest.mark.covers("LOOP-52", "REP-36")
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    before=st.dictionaries(st.sampled_from([*NAMES, *HARMLESS]), st.binary(max_size=40), max_size=4),
    between=st.dictionaries(st.sampled_from(HARMLESS), st.binary(max_size=40), max_size=6),
)
def test_files_of_others_stay_as_they_are(
    make: Make, tmp_path_factory: pytest.TempPathFactory, before: dict[str, bytes], between: dict[str, bytes]
) -> None:
    """Whether a run is refused, begins, goes on, removes its old checkpoints or is exported."""
    logdir = tmp_path_factory.mktemp("run")
    foreign = dict(before)
    for name, data in before.items():
        put(logdir, name, data)
    runs = 0
    for steps in (20, 30, 40, 50):
        try:
            loop.run(make(logdir=logdir, steps=steps, keep_checkpoints=1), FakeLearner)
        except UserError:
            is_refused = True
        else:
            is_refused, runs = False, runs + 1
        assert is_refused is bool(set(before) & set(NAMES))
        assert {name: (logdir / name).read_bytes() for name in foreign} == foreign
        if steps == 20:
            for name, data in between.items():
                put(logdir, name, data)
            if runs:
                put(logdir, "checkpoints/000000000020/notes.txt", b"the best one")
                foreign["checkpoints/000000000020/notes.txt"] = b"the best one"
            foreign |= between
    assert runs in (0, 4)


@pytest.mark.covers("LOOP-52")
@pytest.mark.parametrize("name", [".lock", "metrics.jsonl", "run.json"])
def test_links_are_not_followed(make: Make, tmp_path: Path, name: str) -> None:
    target = tmp_path / "target"
    target.write_text("precious")
    make().logdir.mkdir()
    (make().logdir / name).symlink_to(target)
    refused(make())
    assert target.read_text() == "precious"
    (make().logdir / name).unlink()
    loop.run(make(), FakeLearner)
    (make().logdir / name).unlink()
    (make().logdir / name).symlink_to(target)
    if name == "run.json":  # The link is replaced.
        loop.run(make(steps=90), FakeLearner)
    else:
        assert name in refused(make(steps=90))
    assert target.read_text() == "precious"


def test_a_lock_of_another_program_is_left_alone(make: Make) -> None:
    put(make().logdir, ".lock", b"pid 7")
    assert ".lock is not the lock of a run" in refused(make())
    assert (make().logdir / ".lock").read_bytes() == b"pid 7"


@pytest.mark.covers("LOOP-52")
def test_an_export_and_a_report_spare_their_neighbours(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "run", CONFIG, TASK, task="gym:Robot-v0")
    for name in ("policy.tmp/mine.txt", "report.html.tmp", ".report.html.tmp"):
        put(tmp_path, name, b"mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    assert main(["export", str(tmp_path / "run"), str(tmp_path / "policy")]) == 0
    assert main(["export", str(tmp_path / "run"), str(tmp_path / "link")]) == 2
    put(tmp_path / "run", "metrics.jsonl", b'{"step": 1, "a": 2}\n')
    assert main(["report", str(tmp_path / "run"), "--out", str(tmp_path / "report.html")]) == 0
    for name in ("policy.tmp/mine.txt", "report.html.tmp", ".report.html.tmp"):
        assert (tmp_path / name).read_bytes() == b"mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *(".report.html.tmp", "link", "policy", "policy.tmp", "report.html", "report.html.tmp", "run")
    ]


# Away, or not to be read


@pytest.mark.covers("LOOP-50", "REP-35")
@pytest.mark.parametrize(
    "left", ["nothing", "an empty folder", "a file of somebody else", "a file", "a link to nowhere"]
)
def test_a_buffer_that_is_away_changes_nothing(make: Make, left: str) -> None:
    """As with a disk that is not mounted."""
    loop.run(make(), FakeLearner)
    replay, away = make().logdir / "replay", make().logdir.parent / "away"
    replay.rename(away)
    {
        "nothing": lambda: None,
        "an empty folder": replay.mkdir,
        "a file of somebody else": lambda: put(replay, "chunk-²³.bin", b"mine"),
        "a file": replay.touch,
        "a link to nowhere": lambda: replay.symlink_to(make().logdir.parent / "nowhere"),
    }[left]()
    message = refused(make(steps=90))
    assert str(replay) in message
    assert not list((make().logdir / "checkpoints").glob("*.damaged*"))
    if replay.is_symlink() or replay.is_file():
        replay.unlink()
    elif replay.exists():
        shutil.rmtree(replay)
    away.rename(replay)
    assert run_quietly(make(steps=90)).counters.records == 90


def test_a_buffer_that_is_lost_for_good_can_be_given_up(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    """As the error says: with an empty file in the place of the saved state."""
    loop.run(make(), FakeLearner)
    shutil.rmtree(make().logdir / "replay")
    (make().logdir / "replay").mkdir()
    name = refused(make(steps=90)).partition("make an empty file ")[2].partition(":")[0]
    Path(name).touch()
    assert run_quietly(make(steps=90)).counters.records == 90
    assert "continuing at step 60" in capsys.readouterr().out


UNREADABLE = [
    *(
        "checkpoints/000000000060/checkpoint.json",
        "checkpoints/000000000060/learner.safetensors",
        "checkpoints/000000000060/SHA256SUMS",
    ),
    *("replay/saved-", "replay/chunk-", "replay/journal-", "run.json"),
]


@pytest.mark.covers("LOOP-50", "REP-35")
@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ENOTDIR, errno.ESTALE])
@pytest.mark.parametrize("name", UNREADABLE)
def test_what_cannot_be_read_changes_nothing(
    make: Make, monkeypatch: pytest.MonkeyPatch, name: str, number: int
) -> None:
    loop.run(make(steps=40), FakeLearner)
    loop.run(make(), FakeLearner)
    before = content(make().logdir)
    with monkeypatch.context() as patch:
        real = os.open

        def fail(path: Any, flags: int, *arguments: Any, **keywords: Any) -> int:
            if str(make().logdir / name) in os.fspath(path) and not flags & (os.O_WRONLY | os.O_RDWR):
                raise OSError(number, os.strerror(number))
            return real(path, flags, *arguments, **keywords)

        patch.setattr(os, "open", fail)
        with pytest.raises(
            Unreadable, match=f"cannot read {make().logdir / name}.*{os.strerror(number)}.*Nothing was changed"
        ):
            loop.run(make(steps=90), FakeLearner)
    after = content(make().logdir)
    assert after == before, [key for key in {**after, **before} if after.get(key) != before.get(key)]
    assert run_quietly(make(steps=90)).counters.records == 90


@pytest.mark.covers("LOOP-50")
@pytest.mark.parametrize("folder", ["checkpoints", "checkpoints/000000000060"])
def test_a_folder_that_cannot_be_looked_into_is_not_an_empty_one(
    make: Make, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    loop.run(make(), FakeLearner)
    before = content(make().logdir)
    with monkeypatch.context() as patch:
        real = os.listdir

        def fail(path: Any) -> list[str]:
            if os.fspath(path) == str(make().logdir / folder):
                raise PermissionError(errno.EACCES, "Permission denied")
            return real(path)

        patch.setattr(os, "listdir", fail)
        with pytest.raises(Unreadable, match=f"cannot read {make().logdir / folder}: Permission denied"):
            loop.run(make(steps=90), FakeLearner)
    assert content(make().logdir) == before


# Read while it is replaced


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_not_damaged(tmp_path: Path) -> None:
    """A run saves as often as it can, and keeps one."""
    state = {"params/w": np.zeros(1000, np.float32)}
    steps, ended = iter(range(1, 10**6)), threading.Event()
    checkpoint.save(tmp_path, 0, state, {}, {}, keep=1)

    def saving() -> None:
        while not ended.is_set():
            step = next(steps)
            checkpoint.save(tmp_path, step // 3, state | {"step": np.array(step)}, {}, {"step": step}, keep=1)

    thread = threading.Thread(target=saving)
    thread.start()
    try:
        seen = [0]
        while seen[-1] < 60:
            assert thread.is_alive()
            found = checkpoint.open_checkpoint(tmp_path)
            seen.append(found.info.get("step", 0))
            assert int(found.learner.get("step", 0)) == seen[-1], "of one checkpoint, although it may be gone by now"
    finally:
        ended.set()
        thread.join()
    assert seen == sorted(seen)
    assert not list(tmp_path.glob("checkpoints/*.damaged*"))


def test_what_has_the_name_of_a_checkpoint_stays_as_it_is(make: Make, tmp_path: Path) -> None:
    loop.run(make(), FakeLearner)
    (tmp_path / "mine").mkdir()
    link = make().logdir / "checkpoints" / "000000000090"
    link.symlink_to(tmp_path / "mine")
    with pytest.raises(UserError, match=r"000000000090 is no checkpoint, and one must be written there: move it away"):
        loop.run(make(steps=90), FakeLearner)
    assert link.is_symlink()


def test_a_log_directory_that_is_no_text_is_refused(make: Make) -> None:
    logdir = Path(os.fsdecode(os.fsencode(make().logdir) + b"\xff"))
    with pytest.raises(UserError, match="is not UTF-8; choose another with --logdir"):
        loop.run(make(logdir=logdir), FakeLearner)
    assert not logdir.exists()
