"""Every metric that a run writes is documented, and what is documented is written."""

import re
from pathlib import Path

import pytest

from dreamer_spec.monitoring.logger import iterate_metrics
from dreamer_spec.options import assemble_options
from dreamer_spec.report.catalogue import find, markdown, sections
from dreamer_spec.training import loop

SPECIAL = {"memory/device", "episode/info/<key>", "evaluation/info/<key>"}  # with an accelerator, with --info-metrics

TINY = {
    **{"batch_size": 2, "batch_length": 3, "units": 8, "deter": 8, "blocks": 1, "stoch": 2, "classes": 2, "bins": 5},
    **{
        f"{part}_layers": 1
        for part in ("encoder", "decoder", "posterior", "prior", "reward", "continue", "actor", "critic")
    },
    **{"imagination_horizon": 2, "envs": 1, "replay_ratio": 6, "replay_capacity": 100},
}


def emitted(backend: str, logdir: Path) -> set[str]:
    given = {
        "task": "gym:CartPole-v1",
        "logdir": logdir,
        "steps": 60,
        "eval_every": 30,
        "eval_episodes": 2,
        "random_episodes": 2,
    }
    settings = {**given, "size": "tiny", "preflight": False, "log_every": 0.0, "checkpoint_every": 0.0, "device": "cpu"}
    assert loop.run(assemble_options(backend, settings, TINY))
    lines = [line for line in iterate_metrics(logdir / "metrics.jsonl") if line is not None]
    return {name for line in lines for name in line} - {"step", "seconds"}


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    return {backend: emitted(backend, tmp_path_factory.mktemp(backend)) for backend in ("jax", "torch")}


def test_what_a_run_writes_is_documented(names: dict[str, set[str]]) -> None:
    assert [name for name in sorted(names["jax"] | names["torch"]) if find(name) is None] == []


def test_what_is_documented_is_written(names: dict[str, set[str]]) -> None:
    for backend, found in names.items():
        written = {entry[1].name for name in found if (entry := find(name))}
        documented = {metric.name for section in sections().values() for metric in section.metrics}
        assert documented - written - SPECIAL == set(), backend


def test_both_backends_write_the_same(names: dict[str, set[str]]) -> None:
    assert names["jax"] == names["torch"]


def test_names_are_found_as_they_are_documented() -> None:
    for name, section in sections().items():
        for metric in section.metrics:
            assert find(metric.name.replace("<key>", "front/camera")) == (name, metric), metric.name
            assert all((metric.what, metric.healthy, metric.trouble))
            assert f"### `{metric.name}`" in markdown()
    assert find("train/loss/dynamics/more") is None
    assert find("train/loss") is None


def test_metrics_that_a_text_names_exist() -> None:
    """A name in backquotes with a prefix of ours is a documented metric."""
    prefixes = "train|episode|evaluation|speed|time|replay|memory|environments|prediction|random"
    for section in sections().values():
        for metric in section.metrics:
            for text in (section.about, metric.what, metric.healthy, metric.trouble):
                for name in re.findall(rf"`((?:{prefixes})/[^`]+)`", text):
                    assert name == "time/..." or find(name), f"{metric.name} speaks of {name}"
