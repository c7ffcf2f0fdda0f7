"""The skeleton of an adapter: what it describes, and that it is whole."""

import inspect
import re
from pathlib import Path
from typing import Any

import pytest

from conformance.case import Setting
from conformance.cli import main
from conformance.execute import run_check, selected_checks
from conformance.interface import CONFIG_FIELDS, INTERFACE
from conformance.our_candidates import load_adapter
from conformance.problems import small_config
from conformance.skeleton import FIRST, HOOKS, functions_by_chapter, skeleton
from spec import Config


def test_the_skeleton_offers_nothing_and_uncommented_everything() -> None:
    source = skeleton("mine.py")
    empty: dict[str, Any] = {}
    exec(source, empty)
    assert not [name for name in empty if name in INTERFACE]
    full: dict[str, Any] = {}
    exec(re.sub(r"^#(?! ---) ?", "", source, flags=re.MULTILINE), full)
    assert {name for name in full if callable(full[name])} == {*INTERFACE, *HOOKS}
    for name, arguments in INTERFACE.items():
        assert tuple(inspect.signature(full[name]).parameters) == arguments
        assert len(str(full[name].__doc__)) > 20, name
        assert not re.search(r"\[[A-Z]{2,5}-\d+\]|Implements", full[name].__doc__), name


def test_a_short_skeleton_has_the_first_functions_and_names_the_others() -> None:
    source = skeleton("mine.py", short=True)
    body, others = source.split("what else can be offered")
    assert set(re.findall(r"^# def (\w+)", source, re.MULTILINE)) == {*FIRST, *HOOKS}
    assert set(FIRST) <= set(INTERFACE)
    assert {name for name in INTERFACE if re.search(rf"\b{name}\b", others)} == set(INTERFACE) - set(FIRST)
    assert len(source.splitlines()) < 250
    assert "--- networks" not in body


SIZES = {"stoch", "classes", "deter", "feature_size", "bins"}


def test_the_skeleton_names_what_a_function_reads_of_the_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    reads: dict[str, set[str]] = {name: set() for name in CONFIG_FIELDS}
    current: list[str] = []
    known = {name for name in dir(small_config("paper")) if not name.startswith("_")}

    def noted(config: Config, name: str) -> Any:
        if current and name in known:
            reads[current[-1]].add(name)
        return object.__getattribute__(config, name)

    class Noting:
        def __getattr__(self, name: str) -> Any:
            function = getattr(load_adapter("numpy"), name)

            def called(*arguments: Any) -> Any:
                current.append(name)
                try:
                    return function(*arguments)
                finally:
                    current.pop()

            return called if name in CONFIG_FIELDS else function

    monkeypatch.setattr(Config, "__getattribute__", noted)
    for check in selected_checks("float64"):
        if set(check.uses) & set(CONFIG_FIELDS):
            run_check(check, Noting(), Setting("float64", "paper", examples=1), shrink=False)
    for name, fields in CONFIG_FIELDS.items():
        assert set(fields) <= reads[name], name
        assert reads[name] - set(fields) <= SIZES | {"discount_horizon"}, name
    assert "config: free_nats, latent_unimix.\n" in skeleton("mine.py")


def test_the_skeleton_is_grouped_by_chapter() -> None:
    chapters = functions_by_chapter()
    assert [name for functions in chapters.values() for name in functions] == list(INTERFACE)
    assert chapters["returns"][0] == "lambda_return"
    assert chapters["rssm"][-2:] == ["observe_given", "imagine_given"]
    assert {"gradients", "train_step_given", "draw_parameters"} < set(chapters["agent"])
    assert chapters["training_loop"][-2:] == ["derive_seed", "run"]
    assert "# --- returns: spec/07-returns.md ---" in skeleton("mine.py")


def test_new_adapter(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new-adapter"]) == 0
    assert main(["new-adapter"]) == 2
    assert "my_adapter.py exists; give another name" in capsys.readouterr().err
    assert main(["new-adapter", "absent/mine.py"]) == 2
    assert "cannot write absent/mine.py" in capsys.readouterr().err
    assert (tmp_path / "my_adapter.py").read_text(encoding="utf-8") == skeleton("my_adapter.py")
    assert main(["new-adapter", "first.py", "--short"]) == 0
    assert (tmp_path / "first.py").read_text(encoding="utf-8") == skeleton("first.py", short=True)
    assert main(["check", "my_adapter.py", "--only", "symlog"]) == 1  # nothing passes, as nothing is offered
    assert "not offered" in capsys.readouterr().out
