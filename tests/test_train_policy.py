"""A policy folder: what is in it, that NumPy is enough to run it, and that it acts as the backends do."""

import hashlib
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces as gym
from safetensors.numpy import load_file
from train_agents import random_learner_state, save_checkpoint

from conformance.adapters import jax_adapter, torch_adapter
from conformance.problems import action_noise, random_observations, small_config, uniforms
from dreamer_spec.cli import main
from dreamer_spec.envs import translate
from dreamer_spec.errors import UserError
from dreamer_spec.option_table import EVAL_OPTIONS
from dreamer_spec.policy import Policy
from reference_numpy.training_loop import derive_seed
from spec import Discrete, Image, Spaces, Vector, load_config

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = (ROOT / "docs" / "policy.md").read_text(encoding="utf-8")
CONFIG = small_config("paper", "float32")
TASK = Spaces(
    {"position": Vector(3), "mode": Discrete((3, 2)), "image": Image(16, 16, 3)},
    {"arm": Vector(2), "buttons": Discrete((2, 3))},
)
ROWS = 4


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_checkpoint(
        tmp_path_factory.mktemp("run"), CONFIG, TASK, task="gym:Robot-v0", seed=3, action_repeat=2, image_size=16
    )


@pytest.fixture(scope="module")
def folder(checkpoint: Path) -> Path:
    """checkpoints/<step> -> policy, through the command."""
    path = checkpoint.parent.parent / "policy"
    assert main(["export", str(checkpoint), f"{path}/"]) == 0
    return path


@pytest.fixture
def policy(folder: Path) -> Policy:
    policy = Policy.load(folder)
    policy.reset(ROWS)
    return policy


def observation(seed: int = 0, rows: int = ROWS) -> dict[str, np.ndarray]:
    return random_observations(np.random.default_rng(seed), TASK, (rows,))


# The folder


def test_a_policy_holds_what_acting_needs_and_nothing_else(checkpoint: Path, folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["SHA256SUMS", "policy.json", "policy.safetensors"]
    arrays, state = load_file(folder / "policy.safetensors"), random_learner_state(CONFIG, TASK, 3)
    kept = {name: array for name, array in state.items() if re.match(r"params/(encoder|rssm|actor)/(?!prior)", name)}
    assert {f"params/{name}" for name in arrays} == set(kept)
    assert {name.split("/")[0] for name in arrays} == {"encoder", "rssm", "actor"}
    assert {"encoder/image/conv0/kernel", "rssm/posterior/out/kernel", "actor/out/arm/std/bias"} <= set(arrays)
    for name, array in arrays.items():
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, kept[f"params/{name}"])


def test_a_policy_says_what_it_is_and_where_it_comes_from(checkpoint: Path, folder: Path) -> None:
    info = json.loads((folder / "policy.json").read_text())
    named = {name: info[name] for name in ("format", "task", "step", "backend", "action_repeat", "image_size")}
    assert named == {
        "format": 2,
        "task": "gym:Robot-v0",
        "step": 1000,
        "backend": "jax",
        "action_repeat": 2,
        "image_size": 16,
    }
    assert info["source"] == {"checkpoint": str(checkpoint), "seed": 3, "train_steps": 10}
    assert set(info["versions"]) == {"dreamer-spec", "python", "numpy"}
    assert info["spaces"]["actions"]["buttons"] == {"kind": "discrete", "classes": [2, 3]}
    assert info["config"]["deter"] == 16
    policy = Policy.load(folder)
    assert (policy.spaces, policy.config, policy.info["task"]) == (TASK, CONFIG, "gym:Robot-v0")
    for line in (folder / "SHA256SUMS").read_text().splitlines():
        digest, name = line.split("  ")
        assert digest == hashlib.sha256((folder / name).read_bytes()).hexdigest()


def test_an_export_replaces_nothing(checkpoint: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main(["export", str(checkpoint), str(folder)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_an_export_is_complete_or_absent(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(path: Path) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr("dreamer_spec.disk.folders.flush", fail)
        assert main(["export", str(checkpoint), str(tmp_path / "policy")]) == 2
    assert "disk full" in capsys.readouterr().err
    assert not (tmp_path / "policy").exists()
    assert main(["export", str(checkpoint.parent.parent), str(tmp_path / "policy")]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]


# Acting

WITHOUT = ("jax", "jaxlib", "torch", "gymnasium", "optax", "hypothesis", "rich", "PIL", "matplotlib", "tensorboard")
ALONE = f"""
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {WITHOUT!r}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Missing())
import numpy as np
from dreamer_spec.policy import Policy
policy = Policy.load(sys.argv[1])
policy.reset({ROWS}, seed=5)
for step in range(2):
    given = dict(np.load(sys.argv[2]))
    raw = [{{key: value[row] for key, value in given.items()}} for row in range({ROWS})]
    action = policy(policy.observation(raw), [step == 0] * {ROWS})
    policy.environment_action(action)
assert not set({WITHOUT!r}) & set(sys.modules)
np.save(sys.argv[3], action)
"""


def test_numpy_is_enough(folder: Path, policy: Policy, tmp_path: Path) -> None:
    """A process in which the backends, Gymnasium and all else cannot be imported acts as this one does."""
    np.savez(tmp_path / "observation.npz", **observation())
    arguments = [folder, tmp_path / "observation.npz", tmp_path / "action.npy"]
    subprocess.run([sys.executable, "-c", ALONE, *map(str, arguments)], check=True, cwd=ROOT)
    policy.reset(ROWS, seed=5)
    for step in range(2):
        action = policy(observation(), [step == 0] * ROWS)
    np.testing.assert_array_equal(np.load(tmp_path / "action.npy"), action)


@pytest.mark.covers("AGT-11", "AGT-12", "AGT-13", "CON-12", "LOOP-8")
@pytest.mark.parametrize("adapter", [jax_adapter, torch_adapter], ids=["jax", "torch"])
def test_its_actions_are_those_of_the_backends(policy: Policy, adapter: Any) -> None:
    """The same noise over several steps, with resets of single rows in between: same choices, same numbers up to
    float32."""
    backend, rng = adapter.make_adapter("float32", "cpu"), np.random.default_rng(1)
    params = {
        name.removeprefix("params/"): array
        for name, array in random_learner_state(CONFIG, TASK, 3).items()
        if name.startswith("params/")
    }
    carry = {"deter": np.zeros((ROWS, CONFIG.deter)), "stoch": np.zeros((ROWS, CONFIG.stoch, CONFIG.classes))}
    expected, seen = np.zeros((ROWS, TASK.action_size)), []
    for step in range(16):
        noise = {"posterior": uniforms(rng, ROWS, CONFIG.stoch), "action": action_noise(rng, TASK, (ROWS,))}
        is_first = np.array([step == 0, step in (0, 3), step in (0, 3, 4), step == 0])
        carry, expected = backend.policy_step(params, carry, expected, observation(step), is_first, noise, TASK, CONFIG)
        action = policy(observation(step), is_first, noise)
        np.testing.assert_array_equal(action[:, 2:], expected[:, 2:])
        np.testing.assert_allclose(action[:, :2], expected[:, :2], atol=1e-4)
        seen.append(action)
    assert len(np.unique(np.concatenate(seen)[:, 2:], axis=0)) == 6, "every choice is made at least once"


def test_noise_comes_from_the_seed(policy: Policy) -> None:
    def play(seed: int) -> np.ndarray:
        policy.reset(ROWS, seed)
        return np.stack([policy(observation(), np.full(ROWS, True)) for _ in range(3)])

    one, again, other = play(1), play(1), play(2)
    np.testing.assert_array_equal(one, again)
    for actions in (one, other):
        assert len(np.unique(actions[..., 0])) == 3 * ROWS, "steps or rows share their noise"
    assert not np.isin(one[..., 0], other[..., 0]).any()


@pytest.mark.covers("CON-19", "CON-20", "CON-21")
def test_noise_is_laid_out_and_seeded_as_the_chapters_say(policy: Policy) -> None:
    policy.reset(ROWS, seed=9)
    drawn = policy(observation(), [True] * ROWS)
    rng = np.random.default_rng(derive_seed(9, "policy", 0))
    posterior, arm, buttons = rng.random((ROWS, CONFIG.stoch)), rng.standard_normal((ROWS, 2)), rng.random((ROWS, 2))
    given = policy(observation(), [True] * ROWS, {"posterior": posterior, "action": np.concatenate([arm, buttons], 1)})
    np.testing.assert_array_equal(drawn, given)


@pytest.mark.covers("CON-24")
def test_real_numbers_are_float32_as_in_training(policy: Policy) -> None:
    noise = {"posterior": np.full((ROWS, CONFIG.stoch), 0.5), "action": np.full((ROWS, 4), 0.5)}
    precise = observation() | {"position": np.full((ROWS, 3), 0.1)}
    actions = [
        policy(given, [True] * ROWS, noise)
        for given in (precise, precise | {"position": np.full((ROWS, 3), np.float32(0.1), np.float64)})
    ]
    np.testing.assert_array_equal(*actions)


def test_the_caller_may_write_into_an_action(policy: Policy, folder: Path) -> None:
    twin = Policy.load(folder)
    twin.reset(ROWS)
    policy(observation(), [True] * ROWS)[:] = 99
    twin(observation(), [True] * ROWS)
    np.testing.assert_array_equal(policy(observation(), [False] * ROWS), twin(observation(), [False] * ROWS))


@pytest.mark.covers("LOOP-12")
def test_what_the_environment_receives(policy: Policy) -> None:
    flat = [[0.5, -7.0, 0, 1, 0, 0, 1]]
    (taken,) = policy.environment_action(flat)
    assert {key: value.tolist() for key, value in taken.items()} == {"arm": [0.5, -1.0], "buttons": [1, 2]}
    with pytest.raises(ValueError, match=r"action: expected shape \[\.\.\., 7\], got \[1, 6\]"):
        policy.environment_action([flat[0][:6]])
    with pytest.raises(ValueError, match="not finite"):
        policy.environment_action([[np.nan, *flat[0][1:]]])


@pytest.mark.covers("LOOP-68")
def test_what_the_environment_returns_is_what_the_policy_sees(policy: Policy) -> None:
    raw = [{key: value[row] for key, value in observation().items()} for row in range(ROWS)]
    seen = policy.observation(raw)
    assert {key: (value.tobytes(), value.shape) for key, value in seen.items()} == {
        key: (np.asarray(value, seen[key].dtype).tobytes(), value.shape) for key, value in observation().items()
    }
    raw[1] = {**raw[1], "position": np.full(3, np.nan)}
    with pytest.raises(ValueError, match="'position' holds nan"):
        policy.observation(raw)


WRONG = [
    ({"mode": None}, r"observation: missing 'mode'; expected shape \[4, 2\], got the keys \['image', 'position'\]"),
    ({"position": np.zeros((3, 3))}, r"observation 'position': expected shape \[4, 3\], got \[3, 3\]"),
    ({"position": np.zeros(3)}, r"observation 'position': expected shape \[4, 3\], got \[3\]"),
    ({"position": np.full((4, 3), np.nan)}, "observation 'position' holds nan; expected finite numbers"),
    ({"position": np.full((4, 3), 1e39)}, "observation 'position' holds inf; expected finite numbers"),
    ({"mode": np.zeros((4, 2))}, r"observations\['mode'\]: expected an integer dtype, got float64"),
    ({"mode": np.full((4, 2), 2)}, r"observations\['mode'\], entry 1: expected values in 0 .. 1, got 2"),
    ({"image": np.zeros((4, 16, 16, 3))}, r"observations\['image'\]: expected dtype uint8, got float64"),
    (
        {"image": np.zeros((4, 16, 32, 3), np.uint8)},
        r"observation 'image': expected shape \[4, 16, 16, 3\], got \[4, 16, 32, 3\]",
    ),
]


@pytest.mark.covers("CON-8")
@pytest.mark.parametrize(("change", "message"), WRONG)
def test_a_wrong_observation_is_named_and_changes_nothing(
    policy: Policy, folder: Path, change: dict[str, Any], message: str
) -> None:
    wrong = {key: value for key, value in (observation() | change).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        policy(wrong, [True] * ROWS)
    fresh = Policy.load(folder)
    fresh.reset(ROWS)
    np.testing.assert_array_equal(policy(observation(), [True] * ROWS), fresh(observation(), [True] * ROWS))


@pytest.mark.parametrize(
    ("is_first", "noise", "message"),
    [
        ([True] * 3, None, r"is_first: expected shape \[4\], got \[3\]"),
        ([1, 0, 0, 0], None, "is_first: expected the dtype bool, got int64"),
        (
            [True] * 4,
            {"posterior": np.zeros((4, 2)), "action": np.zeros((4, 4))},
            r"noise\['posterior'\]: expected shape \[4, 3\]",
        ),
        (
            [True] * 4,
            {"posterior": np.zeros((4, 3)), "action": np.zeros((4, 7))},
            r"noise\['action'\]: expected shape \[4, 4\]",
        ),
        (
            [True] * 4,
            {"posterior": np.zeros((4, 3))},
            r"noise: expected the entries posterior and action, got \['posterior'\]",
        ),
    ],
)
def test_a_wrong_call_is_named(policy: Policy, is_first: Any, noise: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        policy(observation(), is_first, noise)


def test_a_policy_that_was_not_reset_has_no_rows(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"is_first: expected shape \[0\], got \[1\]"):
        Policy.load(folder)(observation(0, 1), [True])


def test_what_is_no_policy_is_named(folder: Path, checkpoint: Path, tmp_path: Path) -> None:
    for path in (tmp_path / "nothing", checkpoint):
        with pytest.raises(UserError, match=re.escape(f"cannot load the policy {path}")):
            Policy.load(path)


# The document


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL)


@pytest.fixture
def cartpole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the document's commands are typed: the run that it speaks of has been trained, a little."""
    config = load_config(
        "paper", "tiny", compute_dtype="float32", deter=16, units=8, stoch=3, classes=5, bins=31, envs=4
    )
    task = Spaces({"observation": Vector(4)}, {"action": Discrete((2,))})
    save_checkpoint(tmp_path / "runs" / "CartPole-v1-jax-seed0", config, task, task="gym:CartPole-v1")
    monkeypatch.chdir(tmp_path)
    return tmp_path


ONLY = (
    "numpy",
    "safetensors",
    "gymnasium",
    *("typing_extensions", "farama_notifications", "cloudpickle"),
)  # Gymnasium's own needs
OURS = ("dreamer_spec", "spec", "reference_numpy", "conformance")  # which has `UserError`
WITHOUT_THE_REST = f"""
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in {(*ONLY, *OURS)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
"""


def robot_policy(folder: Path, side: int) -> None:
    """A policy for the robot of the document's example, with images of this side."""
    config = load_config("paper", "tiny", compute_dtype="float32")
    seen = {
        "camera": gym.Box(0, 255, (64, 64, 3), np.uint8),
        "joints": gym.Box(-np.pi, np.pi, (5,)),
        "tool": gym.Discrete(3),
    }
    task = translate(gym.Dict(seen), gym.Dict({"torque": gym.Box(-2, 2, (5,)), "grip": gym.Discrete(2)}), side)
    run = save_checkpoint(folder / "run", config, task.spaces, translation=task, task="gym:Robot-v0", image_size=side)
    assert main(["export", str(run), str(folder / "policy")]) == 0


def run_alone(example: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    environment = {"PYTHONPATH": str(ROOT), "PATH": ""}
    command = [sys.executable, "-c", WITHOUT_THE_REST + example]
    return subprocess.run(command, check=False, capture_output=True, text=True, env=environment, cwd=folder)


@pytest.mark.parametrize("side", [64, 32])
def test_the_example_of_the_document_runs_with_numpy_and_gymnasium_alone(tmp_path: Path, side: int) -> None:
    """Images of another size are resized as well."""
    (example,) = blocks("python")
    robot_policy(tmp_path, side)
    done = run_alone(example, tmp_path)
    assert not done.stderr
    score = re.fullmatch(r"return (\d+)\n", done.stdout)
    assert score
    assert 0 <= int(score[1]) <= 20


def test_the_commands_of_the_document_run(cartpole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    commands = [shlex.split(line) for block in blocks("sh") for line in block.splitlines()]
    assert [command[:2] for command in commands] == [["train", "eval"], ["train", "eval"], ["train", "export"]]
    for command in commands:
        assert main(command[1:]) == 0
    out = capsys.readouterr().out
    assert (
        len(
            re.findall(
                r"^return [\d.]+ ± [\d.]+ \(min \d+, max \d+\), length [\d.]+ \(min \d+, max \d+\)$", out, re.MULTILINE
            )
        )
        == 2
    )
    assert len(json.loads((cartpole / "returns.json").read_text())["returns"]) == 100
    assert Policy.load("policy").info["task"] == "gym:CartPole-v1"


def test_the_document_names_every_option_of_eval() -> None:
    options = {option.flag for option in EVAL_OPTIONS} | {"--json"}
    section = DOCUMENT[DOCUMENT.index("## Evaluate") : DOCUMENT.index("## Export")]
    assert options == set(re.findall(r"`(--[a-z-]+)", section))
