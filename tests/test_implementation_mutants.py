"""The mistakes that are planted in the backends, the learners and the trainer: each fits its file, and is noticed."""

import collections
import contextlib
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from conformance import cli
from conformance.errors import UserError
from conformance.mutants.implementations import KINDS, Patch, catalogues, patches, trial
from conformance.mutants.implementations.judging import REACHED_FROM, reaching, require_copy
from conformance.mutants.implementations.planting import planted
from conformance.mutants.implementations.report import chosen, column_of, counts, is_bad, to_json
from conformance.mutants.implementations.trial import Outcome, Trials

ROOT = Path(__file__).resolve().parent.parent
PATCHES = patches()
SAMPLE = ("hidden_norm_block_by_block", "logits_are_class_major", "hoisted_action_forgets_the_reset")


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("compiled")


@pytest.mark.parametrize("name", PATCHES)
def test_a_mistake_fits_its_file(name: str) -> None:
    patch = PATCHES[name]
    source = (ROOT / patch.file).read_text(encoding="utf-8")
    assert patch.old in source, "the source has changed: say the mistake in its new words"
    wrong = patch.apply(source)
    assert wrong != source
    compile(wrong, patch.file, "exec")
    assert patch.explanation.endswith("."), name
    assert not patch.equivalent or patch.equivalent.endswith("."), name
    for arguments in patch.tests:
        assert (ROOT / shlex.split(arguments)[0]).is_file(), arguments


def test_the_catalogue_is_complete() -> None:
    assert len(PATCHES) >= 80
    assert sum(len(those) for those in catalogues().values()) == len(PATCHES), "a name is there twice"
    kinds = collections.Counter(patch.kind for patch in PATCHES.values())
    assert kinds.keys() == KINDS.keys()
    assert min(kinds.values()) >= 4, kinds
    for name, those in catalogues().items():
        packages = {patch.file.partition("/")[0] for patch in those.values()}
        one_package = {"torch": {"impl_torch"}, "jax": {"impl_jax"}, "trainer": {"dreamer_spec"}}
        assert packages <= one_package.get(name, {"impl_torch", "impl_jax", "dreamer_spec"})
        in_learners = {patch.file.endswith("learner.py") for patch in those.values()}
        assert name == "thirty" or in_learners == {name == "learners"}


def test_a_mistake_that_does_not_fit_is_an_error() -> None:
    patch = Patch("wrong", "loop", "impl_torch/scan.py", "nothing of this kind", "", "None.")
    with pytest.raises(ValueError, match=r"mutant wrong: impl_torch/scan\.py holds 0 times 'nothing of this kind'"):
        patch.apply("source")


def test_every_file_has_checks_that_reach_it() -> None:
    for patch in PATCHES.values():
        assert reaching(patch.file, "float64"), patch.file
    assert reaching("impl_torch/returns.py", "float32")[0].name.startswith("returns.")
    assert {path.stem for path in (ROOT / "impl_torch").glob("[a-z]*.py")} <= REACHED_FROM.keys()
    assert {path.stem for path in (ROOT / "impl_jax").glob("[a-z]*.py")} <= REACHED_FROM.keys()


def test_the_copy_alone_has_the_mistake() -> None:
    patch = PATCHES["annotation_is_time_major"]
    before = (ROOT / patch.file).read_text(encoding="utf-8")
    with planted(patch) as copy:
        assert (copy / patch.file).read_text(encoding="utf-8") == patch.apply(before)
        assert not list((copy / "impl_torch" / "__pycache__").glob("agent.*")), (
            "compiled before the mistake was planted"
        )
    assert not copy.exists()
    assert (ROOT / patch.file).read_text(encoding="utf-8") == before


def test_what_is_judged_must_be_the_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RuntimeError, match="not in the copy"):
        require_copy()


def test_names_kinds_files_and_catalogues_are_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    assert [patch.name for patch in chosen(["annotation_is_time_major"])] == ["annotation_is_time_major"]
    assert {patch.kind for patch in chosen(["loop", "state"])} == {"loop", "state"}
    assert {patch.file for patch in chosen(["impl_torch/scan.py"])} == {"impl_torch/scan.py"}
    assert {patch.candidate for patch in chosen(["trainer"])} == {"trainer"}
    assert chosen([]) == list(PATCHES.values())
    with pytest.raises(UserError, match="'nothing'; kinds are wrong_axis"):
        chosen(["nothing"])
    assert cli.main(["mutants", "--implementations", "nothing"]) == 2
    assert "no mutant of the implementations" in capsys.readouterr().err


def test_outcomes_are_counted_by_kind() -> None:
    equivalent = next(patch for patch in PATCHES.values() if patch.equivalent)
    loop, state = (next(patch for patch in PATCHES.values() if patch.kind == kind) for kind in ("loop", "state"))
    caught = Outcome("check", "rssm.core_matches", "float32", "fail")
    assert caught.words == "check rssm.core_matches in float32"
    report = {
        "a": to_json(loop, caught),
        "b": to_json(loop, Outcome()),
        "c": to_json(state, Outcome("test", "tests/test_learners.py::test_a_fresh_state", None, "fail")),
        "d": to_json(state, Outcome("no device", "cuda")),
    }
    assert counts(report) == {
        "state": [2, 0, 0, 1, 0, 0, 1],
        "loop": [2, 1, 0, 0, 1, 0, 0],
        "all": [4, 1, 0, 1, 1, 0, 1],
    }
    assert [is_bad(entry) for entry in report.values()] == [False, True, False, False]
    assert column_of(to_json(equivalent, Outcome())) == "equivalent"
    assert is_bad(to_json(equivalent, caught)), "what is argued to be equivalent must not be noticed"


def test_a_process_that_ends_without_the_mistake_too_notices_nothing(
    compiled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever ends it: its answer counts only where the right implementation gives one."""
    patch = next(patch for patch in PATCHES.values() if patch.candidate == "torch" and not patch.tests)
    ended = Outcome("check", "(the process got signal 6)", "float32", "signal")

    right_too = False
    planted_at: list[Path] = []

    def answer(asked: Patch, request: dict[str, object], root: Path, compiled: Path) -> Outcome:
        return ended if right_too or root == planted_at[0] else Outcome()

    original = trial.planted

    @contextlib.contextmanager
    def noted(asked: Patch | None) -> Iterator[Path]:
        with original(asked) as root:
            if asked:
                planted_at[:] = [root]
            yield root

    monkeypatch.setattr(trial, "_answer", answer)
    monkeypatch.setattr(trial, "planted", noted)
    assert Trials().judge(patch, compiled).by == "check"
    right_too = True
    assert Trials().judge(patch, compiled).by is None


@pytest.mark.parametrize("name", SAMPLE)
def test_the_mistake_is_noticed(name: str, compiled: Path) -> None:
    outcome = Trials(confirm=False, examples=2).judge(PATCHES[name], compiled)
    assert (outcome.by, outcome.how) == ("check", "fail"), outcome


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PATCHES if name not in SAMPLE])
def test_every_mistake_is_noticed(name: str, compiled: Path) -> None:
    patch = PATCHES[name]
    outcome = Trials(confirm=False).judge(patch, compiled)
    if outcome.by == "no device":
        pytest.skip(f"needs {outcome.name}")
    assert outcome.is_caught != bool(patch.equivalent), outcome
