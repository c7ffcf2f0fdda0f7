"""What `train inspect` prints about an incident or a checkpoint, and what it refuses."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dreamer_spec.cli import main
from dreamer_spec.commands import inspect
from dreamer_spec.disk import checkpoint
from dreamer_spec.disk.incidents import save_incident
from dreamer_spec.options import assemble_options
from spec import Config, Discrete, Spaces, Vector

SPACES = Spaces({"position": Vector(2)}, {"action": Discrete((2,))})
NAN, INF = float("nan"), float("inf")


class Broken:
    """A learner that has what a test wants it to have."""

    device = "cpu"

    def __init__(self, state: dict[str, Any], gradients: dict[str, Any], metrics: dict[str, float]) -> None:
        self.state = {name: np.array(value, np.float32) for name, value in state.items()}
        self.given = {name: np.array(value, np.float32) for name, value in gradients.items()}
        self.metrics = metrics

    def state_dict(self) -> dict[str, np.ndarray]:
        return self.state

    def gradients(self, batch: Any, seed: int) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        return self.metrics, self.given


STATE = {
    "params/actor/out/kernel": [0.5, -0.25],
    "params/actor/out/bias": [0.0],
    "params/rssm/gru/kernel": [[1.5]],
    "return_range/low": 0.0,
}
GRADIENTS = {"actor/out/kernel": [1.0, 2.0], "actor/out/bias": [1.0], "rssm/gru/kernel": [[1.0]]}
METRICS = {"loss/total": 1.0, "loss/reward": 0.5, "gradient_norm": 2.0}
BATCH = {"position": np.float32([[[1, 2], [-3, 4]]]), "reward": np.float32([[0, 1]]), "stoch": np.array([[3, 1]])}


def incident(
    logdir: Path,
    *,
    state: dict[str, Any] | None = None,
    gradients: dict[str, Any] | None = None,
    metrics: dict[str, float] | None = None,
    repeated: dict[str, float] | None = None,
    batch: dict[str, np.ndarray] | None = None,
    **identity: Any,
) -> Path:
    """An incident in which nothing is wrong but what is given."""
    options = assemble_options("jax", {"task": "gym:CartPole-v1", "size": "tiny"}, identity)
    measured = METRICS | (metrics or {})
    learner = Broken(
        STATE | (state or {}), GRADIENTS | (gradients or {}), measured if repeated is None else METRICS | repeated
    )
    info = {
        "train_step": 41,
        "step": 1300,
        "backend": "jax",
        "identity": options.identity(),
        "spaces": SPACES.to_json(),
        "metrics": measured,
    }
    return save_incident(logdir, learner, BATCH | (batch or {}), 5, info)  # type: ignore[arg-type]


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What the command prints, without regard to line ends."""
    capsys.readouterr()
    assert main(["inspect", *map(str, arguments)]) == 0
    return " ".join(capsys.readouterr().out.split())


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main(["inspect", *map(str, arguments)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    return lines[0]


def test_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = incident(
        tmp_path,
        batch={"reward": np.float32([[0, INF]])},
        gradients={"actor/out/kernel": [NAN, -INF], "rssm/gru/kernel": [[NAN]]},
        metrics={"loss/reward": INF, "loss/total": NAN, "gradient_norm": NAN},
    )
    out = printed(capsys, path)
    assert str(path) in out
    for words in (
        "gym:CartPole-v1, train step 41 (step 1300), jax on cpu; python 3.",
        "It began in the batch: reward[0, 1] ",
        "Metrics not finite: loss/total nan, loss/reward inf, gradient_norm nan ",
        "Gradients not finite: actor 1 of 2, rssm 1 of 1 ",
        "Usual cause: what environments return is checked",
        "batch reward 1 inf 2 0 gradient actor/out/kernel 1 NaN, 1 -inf 2 gradient rssm/gru/kernel 1 NaN 1 ",
        "position 1 × 2 × 2 -3 4 2.739 0 reward 1 × 2 0 0 0 50.00% stoch 1 × 2 1 3 2.236 0 ",
        "rssm/gru/kernel 1.5 1.5 actor/out/kernel 0.5 0.3953 actor/out/bias 0 0",
    ):
        assert words in out, words


@pytest.mark.parametrize(
    ("wrong", "began", "cause"),
    [
        (
            {"batch": {"position": np.float32([[[1, 2], [NAN, 4]]])}, "state": {"params/actor/out/bias": [NAN]}},
            "position[0, 1, 0]",
            "memory",
        ),
        (
            {"state": {"optimizer/momentum/actor/out/bias": [INF]}},
            "the training state: optimizer/momentum/actor/out/bias",
            "older checkpoint",
        ),
        (
            {"metrics": {"loss/reward": NAN, "loss/total": NAN}},
            "finite parameters: loss/reward",
            "a smaller --learning-rate, or --nonfinite",
        ),
        (
            {"metrics": {"loss/reward": NAN, "loss/total": NAN}, "compute_dtype": "bfloat16"},
            "loss/reward",
            "--compute-dtype float32",
        ),
        (
            {"gradients": {"actor/out/bias": [NAN]}, "metrics": {"gradient_norm": NAN}},
            "the gradients, on the way back",
            "smaller",
        ),
        (
            {
                "gradients": {"actor/out/bias": [NAN]},
                "metrics": {"gradient_norm": NAN},
                "state": {"params/actor/out/bias": [2e4]},
            },
            "the gradients",
            "parameters have grown, actor/out/bias to 2e+04",
        ),
        (
            {"metrics": {"loss/reward": INF}, "batch": {"reward": np.float32([[0, -1e30]])}},
            "losses",
            "reward reaches 1e+30",
        ),
        ({"metrics": {"gradient_norm": INF}}, "sums: the total loss or the norm of finite gradients", "smaller"),
        ({"metrics": {"gradient_norm": NAN}, "repeated": {}}, "nothing that could be repeated", "not deterministic"),
    ],
)
def test_where_it_began(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: dict[str, Any], began: str, cause: str
) -> None:
    out = printed(capsys, incident(tmp_path, **wrong))
    assert began in out.split("It began in")[1].split("Metrics not finite")[0]
    assert cause in out.split("Usual cause:")[1].split("Batch")[0]


def test_a_log_directory_shows_its_newest_incident(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = incident(tmp_path, metrics={"loss/total": NAN})
    path.rename(path.with_name("000000000007"))
    newest = incident(tmp_path, metrics={"loss/total": NAN})
    (tmp_path / "nonfinite" / "000000000099.tmp").mkdir()
    assert printed(capsys, tmp_path).startswith(str(newest))


def test_a_long_list_is_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = printed(capsys, incident(tmp_path, gradients={f"actor/hidden{n}/kernel": [NAN] for n in range(20)}))
    assert "actor/hidden11/kernel" in out
    assert "actor/hidden12/kernel" not in out
    assert "and 8 more" in out


def test_a_rerun_that_gives_something_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = incident(
        tmp_path, gradients={"actor/out/bias": [NAN]}, metrics={"gradient_norm": NAN, "loss/total": NAN}, batch_size=3
    )
    given: list[Any] = []

    class Repeating(Broken):
        def __init__(self, spaces: Spaces, config: Config, *, seed: int, device: str | None) -> None:
            super().__init__(STATE, GRADIENTS | {"actor/out/kernel": [NAN, 1]}, METRICS | {"gradient_norm": NAN})
            given.extend([spaces, config.batch_size, device])

        def load_state_dict(self, state: Any) -> None:
            given.append(set(state))

        def gradients(self, batch: Any, seed: int) -> Any:
            given.extend([set(batch), seed])
            return super().gradients(batch, seed)

    table = {name: SimpleNamespace(shape=np.shape(value)) for name, value in GRADIENTS.items()}
    monkeypatch.setattr(inspect, "parameter_table", lambda config, spaces: table)
    monkeypatch.setattr(inspect, "learner_class", lambda backend: Repeating)
    assert main(["inspect", str(path), "--rerun", "--device", "cuda:1"]) == 1
    assert given == [SPACES, 3, "cuda:1", set(STATE), set(BATCH), 5]
    out = " ".join(capsys.readouterr().out.split())
    assert out.endswith(
        "Rerun on cpu: other metrics and gradients are not finite. Only before: actor/out/bias, loss/total; "
        "only now: actor/out/kernel"
    )


def test_a_log_directory_stands_for_its_last_incident(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.json").write_text("{}")
    assert f"{tmp_path} holds no incident" in refused(capsys, tmp_path)
    path = incident(tmp_path, metrics={"loss/total": NAN})
    checkpoint.save(tmp_path, 4000, {}, {}, {}, keep=1)
    assert printed(capsys, tmp_path).startswith(f"{path} gym:CartPole-v1, train step 41 ")


def test_checkpoints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = {
        **STATE,
        "optimizer/momentum/actor/out/bias": [NAN],
        "optimizer/momentum/rssm/gru/kernel": [2.0],
        "slow_critic/critic/out": [-3],
    }
    arrays = {name: np.array(value, np.float32) for name, value in state.items()}
    path = checkpoint.save(tmp_path, 4000, arrays, {}, {"counters": {"records": 4000, "train_steps": 77}}, keep=1)
    out = printed(capsys, path)
    for words in (
        f"{path} records 4000, train steps 77 1 of 7 tensors hold numbers that are not finite",
        "state optimizer/momentum/actor/out/bias 1 NaN 1",
        (
            "optimizer/momentum 2 2 2 2 50.00% params/actor 3 -0.25 0.5 0.3227 0 params/rssm 1 1.5 1.5 1.5 0 "
            "return_range/low 1 0 0 0 0"
        ),
        "slow_critic 1 -3 -3 3 0",
        "rssm/gru/kernel 1.5 1.5",
    ):
        assert words in out, words
    assert "is a checkpoint; --rerun needs an incident" in refused(capsys, path, "--rerun")
    healthy = printed(capsys, tmp_path)
    assert healthy == f"{tmp_path}: no train step has met a number that is not finite. The newest checkpoint: {out}"
    assert f"{tmp_path} holds no incident" in refused(capsys, tmp_path, "--rerun")
    (path / "learner.safetensors").write_bytes(b"x" * 20)
    assert f"the checkpoint {path} is damaged: " in refused(capsys, path)
    (path / "checkpoint.json").unlink()
    assert f"the checkpoint {path} is damaged: " in refused(capsys, path)


def test_what_is_neither(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"there is no folder {tmp_path}/absent; expected a log directory" in refused(capsys, tmp_path / "absent")
    assert f"{tmp_path} holds no incident" in refused(capsys, tmp_path)
    (tmp_path / "nonfinite" / "000000000001").mkdir(parents=True)
    assert "is damaged: " in refused(capsys, tmp_path)
    assert "unknown option --nothing" in refused(capsys, tmp_path, "--nothing")
    assert "required: PATH" in refused(capsys)


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        ("spaces", {"observations": {}}, "spaces: expected"),
        ("identity", {}, "cannot be repeated: "),
        ("backend", "theano", "unknown backend 'theano'"),
        (None, None, "the parameters are not those of the configuration"),
    ],
)
def test_incidents_that_cannot_be_repeated(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    entry: str | None,
    value: Any,
    words: str,
) -> None:
    path = incident(tmp_path, metrics={"loss/total": NAN})
    if entry:
        content = json.loads((path / "incident.json").read_text())
        (path / "incident.json").write_text(json.dumps({**content, entry: value}))
        monkeypatch.setattr("dreamer_spec.disk.incidents.require_intact", lambda folder, names: None)
    assert words in refused(capsys, path, "--rerun")
