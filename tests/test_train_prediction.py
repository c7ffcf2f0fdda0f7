"""Open-loop predictions: what the learners predict, what is recorded of an evaluation, and the pictures and numbers
that come of it."""

import functools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from train_fakes import FakeLearner
from train_runs import Make, run_quietly

from conformance.problems import random_actions, random_observations, random_parameters, small_config, spaces
from dreamer_spec.backend import Learner, learner_class
from dreamer_spec.envs import Environments, make_env
from dreamer_spec.monitoring.logger import Logger
from dreamer_spec.monitoring.pictures import draw_predictions, prune_pictures
from dreamer_spec.monitoring.prediction import CONTEXT, ROWS, STEPS, SequenceRecorder, predict, prediction_errors
from dreamer_spec.training.evaluation import play
from reference_numpy.world_model import open_loop
from spec import Discrete, Image, Spaces, Vector

ACTIONS = {"action": Discrete((2,))}
Arrays = dict[str, np.ndarray]


# --- The learners
# ------------------------------------------------------------------------------

TASK = spaces("vector", "mixed")
CONFIG = small_config("paper", "float32", latent_unimix=0.0)
LENGTH, SEEN = 6, 2


def recorded() -> tuple[Arrays, np.ndarray, np.ndarray]:
    """Observations, previous actions, is_first; row 1 restarts at step 4."""
    rng = np.random.default_rng(0)
    is_first = np.zeros((2, LENGTH), bool)
    is_first[:, 0] = is_first[1, 4] = True
    return (
        random_observations(rng, TASK, (2, LENGTH)),
        random_actions(rng, TASK, (2, LENGTH)).astype(np.float32),
        is_first,
    )


@functools.cache
def learner(backend: str) -> Learner:
    """One for all tests: compiling takes long."""
    return learner_class(backend)(TASK, CONFIG, seed=0, device="cpu")


def with_parameters(backend: str, certain: bool) -> Learner:
    """The learner with random parameters; where it is certain, every latent is the same class, whatever is drawn."""
    params = random_parameters(np.random.default_rng(1), CONFIG, TASK, "float32")
    if certain:
        params |= {
            f"rssm/{name}/out/bias": np.tile([0.0, 0, 1000, 0, 0], CONFIG.stoch) for name in ("posterior", "prior")
        }
    state = learner(backend).state_dict() | {
        f"params/{name}": value.astype(np.float32) for name, value in params.items()
    }
    learner(backend).load_state_dict(state)
    return learner(backend)


@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_a_learner_predicts_what_the_reference_predicts(backend: str) -> None:
    observation, prev_action, is_first = recorded()
    before = with_parameters(backend, certain=True).state_dict()
    predicted = learner(backend).predict(observation, prev_action, is_first, SEEN, seed=3)
    params = {name.removeprefix("params/"): value for name, value in before.items() if name.startswith("params/")}
    noise = {
        "posterior": np.full((2, SEEN, CONFIG.stoch), 0.5),
        "prior": np.full((2, LENGTH - SEEN, CONFIG.stoch), 0.5),
    }
    expected = open_loop(params, observation, prev_action, is_first, SEEN, noise, TASK, CONFIG)
    assert set(predicted) == {"mode", "position", "reward", "continue_"}
    for key, value in predicted.items():
        assert type(value) is np.ndarray
        assert value.dtype == np.float32
        np.testing.assert_allclose(value, expected[key], rtol=1e-3, atol=1e-4 * np.abs(expected[key]).max())
    after = learner(backend).state_dict()
    assert all(np.array_equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_a_learner_draws_from_the_seed(backend: str) -> None:
    made = with_parameters(backend, certain=False)
    one, same, other = (made.predict(*recorded(), SEEN, seed)["position"] for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    for steps in (slice(SEEN), slice(SEEN, None)):
        assert not np.array_equal(one[:, steps], other[:, steps])


@pytest.mark.parametrize("backend", ["jax", "torch"])
@pytest.mark.parametrize("context", [0, LENGTH, LENGTH + 1])
def test_a_learner_refuses_a_context_that_leaves_nothing(backend: str, context: int) -> None:
    with pytest.raises(ValueError, match="context"):
        learner(backend).predict(*recorded(), context, seed=0)


# --- Recording and predicting
# ------------------------------------------------------------------------------


def test_an_evaluation_is_recorded_from_its_start() -> None:
    """Episodes of 5 records, one after the other: [episode, t] is what `Counting` shows, in memory that it uses again
    and again."""
    envs = Environments(functools.partial(make_env, "train_fakes:Counting"), ROWS + 2, False)
    recorder, calls = SequenceRecorder(), 0

    def act(record: Arrays) -> np.ndarray:
        nonlocal calls
        action = np.full((envs.count, 2), calls, np.float32)
        calls += 1
        recorder.add(record, action)
        return action

    play(envs, act, 12 * envs.count, list(range(envs.count)))
    envs.close()
    sequences = recorder.sequences()
    assert calls > STEPS
    assert sequences is not None
    assert {name: value.shape for name, value in sequences.items()} == {
        "observation": (6, 50, 2),
        "action": (6, 50, 2),
        **dict.fromkeys(("reward", "is_first", "is_last", "is_terminal"), (6, 50)),
    }
    np.testing.assert_array_equal(sequences["observation"][2, :, 1], np.tile(np.arange(5), 10))
    np.testing.assert_array_equal(sequences["is_first"][2], np.tile([True, False, False, False, False], 10))
    np.testing.assert_array_equal(sequences["action"][2, :, 0], np.arange(50))


@pytest.mark.parametrize(("steps", "enough"), [(0, False), (CONTEXT, False), (CONTEXT + 1, True)])
def test_too_little_is_no_sequence(steps: int, enough: bool) -> None:
    recorder = SequenceRecorder()
    for _ in range(steps):
        recorder.add({"x": np.zeros((1, 2)), "is_first": np.zeros(1, bool)}, np.zeros((1, 1)))
    assert (recorder.sequences() is not None) is enough


@pytest.mark.parametrize("steps", [CONTEXT + 1, STEPS])
def test_the_action_before_each_observation_is_given_and_the_length_never_changes(steps: int) -> None:
    task = Spaces({"x": Vector(1)}, {"action": Vector(1)})
    made = FakeLearner(task, CONFIG, seed=0)
    FakeLearner.diary, FakeLearner.seeds = [], []
    action = np.arange(1, steps + 1, dtype=np.float32).reshape(1, steps, 1)
    sequences = {
        "x": 10 * action,
        "action": action,
        "is_first": np.arange(steps)[None] == 0,
        "reward": np.zeros((1, steps)),
    }
    predicted = predict(made, task, sequences, seed=7)
    assert FakeLearner.seeds == [("predict", 7)]
    ((_, given),) = FakeLearner.diary
    assert {name: value.shape[:2] for name, value in given.items()} == dict.fromkeys(
        ("x", "prev_action", "is_first"), (1, STEPS)
    )
    np.testing.assert_array_equal(given["prev_action"][0, :steps, 0], np.arange(steps))
    np.testing.assert_array_equal(given["x"][0, :steps, 0], 10 * np.arange(1, steps + 1))
    np.testing.assert_array_equal(given["is_first"][0, :steps], sequences["is_first"][0])
    np.testing.assert_array_equal(predicted["reward"], np.arange(steps)[None])


# --- Numbers
# ------------------------------------------------------------------------------


def sequences_of(task: Spaces, steps: int, rows: int = 2) -> tuple[Arrays, Arrays]:
    """Truth and a prediction that is right: all images black, all numbers 0, all classes 0."""
    truth: Arrays = {
        **{name: np.zeros((rows, steps), bool) for name in ("is_first", "is_terminal")},
        "reward": np.zeros((rows, steps), np.float32),
    }
    predicted: Arrays = {"reward": np.zeros((rows, steps), np.float32), "continue_": np.ones((rows, steps), np.float32)}
    for key, space in task.observations.items():
        shape = (rows, steps, *space.array_shape)
        truth[key] = np.zeros(shape, {Image: np.uint8, Vector: np.float32, Discrete: np.int32}[type(space)])
        predicted[key] = np.zeros(shape, np.float32)
        if isinstance(space, Discrete):
            predicted[key] = np.tile(
                np.concatenate([np.eye(classes)[0] for classes in space.classes]).astype(np.float32), (rows, steps, 1)
            )
    truth["is_first"][:, 0] = True
    return truth, predicted


MIXED = Spaces({"view": Image(2, 2, 1), "x": Vector(2), "kind": Discrete((2, 3))}, ACTIONS)


def test_errors_literals() -> None:
    """Half the brightness off is 0.25, e - 1 for 0 is 1 in symlog space, a quarter for the true class leaves 0.75."""
    truth, predicted = sequences_of(MIXED, 4, rows=1)
    assert set(prediction_errors(MIXED, truth, predicted, 2).values()) == {0.0}
    truth["view"][:, 0], predicted["view"][:, 0] = 255, 0.5  # in the context: mean of 0.25 and 0
    predicted["view"][:, 2, 0] = 0.5  # half of the pixels of one predicted step of two
    predicted["x"][:, 3] = [np.e - 1, 0]
    truth["kind"][:, 1] = [1, 2]
    predicted["kind"][:, 1] = [0.5, 0.5, 0.75, 0, 0.25]  # 0.5 and 0.75 are missing
    truth["reward"][:, 3] = 1 - np.e
    expected = {
        "prediction/view_error": 0.0625,
        "prediction/view_context_error": 0.125,
        "prediction/x_error": 0.25,
        "prediction/x_context_error": 0.0,
        "prediction/kind_error": 0.0,
        "prediction/kind_context_error": 0.3125,
        "prediction/reward_error": 0.5,
        "prediction/reward_context_error": 0.0,
    }
    assert prediction_errors(MIXED, truth, predicted, 2) == pytest.approx(expected, abs=1e-6)


def test_the_next_episode_is_not_counted() -> None:
    task = Spaces({"x": Vector(1)}, ACTIONS)
    truth, predicted = sequences_of(task, 5)
    truth["is_first"][0, 3] = True
    predicted["x"][0, 3:] = 1e9
    predicted["x"][1, 4] = np.e - 1
    errors = prediction_errors(task, truth, predicted, 2)
    assert errors["prediction/x_error"] == pytest.approx(1 / 4)  # one of the steps 2 of row 0, and 2 to 4 of row 1
    truth["is_first"][:, 2] = True
    assert set(prediction_errors(task, truth, predicted, 2)) == {
        "prediction/x_context_error",
        "prediction/reward_context_error",
    }


# --- Pictures
# ------------------------------------------------------------------------------


def frames_of(path: Path) -> np.ndarray:
    """[frames, height, width, 3]"""
    with Pillow.open(path) as animation:
        frames = []
        for index in range(animation.n_frames):
            animation.seek(index)
            frames.append(np.asarray(animation.convert("RGB"), int))
    return np.stack(frames)


BLUE, ORANGE, GRAY = (0x25, 0x63, 0xEB), (0xEA, 0x58, 0x0C), (0x6B, 0x72, 0x80)


@pytest.mark.parametrize(
    ("channels", "pixel", "shown"), [(1, [200], 200), (3, [250, 120, 10], None), (4, [250, 120, 10, 77], None)]
)
def test_an_animation_shows_truth_prediction_and_error(
    tmp_path: Path, channels: int, pixel: list[int], shown: int | None
) -> None:
    """64 pixels of image, 3 of border, 6 of white: row by row below the words, one column for each sequence."""
    task = Spaces({"camera": Image(64, 64, channels)}, ACTIONS)
    truth, predicted = sequences_of(task, 8)
    truth["camera"][:] = pixel
    predicted["camera"][:, 2:] = 1.0
    predicted["camera"][:, :2] = np.array(pixel) / 255
    truth["is_first"][1, 5] = True
    paths = draw_predictions(tmp_path / "predictions", 6000, task, truth, predicted, context=2)
    assert {name: path.name for name, path in paths.items()} == {
        "camera": "000000006000-camera.gif",
        "camera-strip": "000000006000-camera-strip.png",
        "signals": "000000006000-signals.png",
    }
    assert sorted(path.name for path in (tmp_path / "predictions").iterdir()) == sorted(
        path.name for path in paths.values()
    )
    frames = frames_of(paths["camera"])
    assert frames.shape[0] == 8
    left, top, tile = 52, 24, 64 + 6 + 6
    colour = np.full(3, shown) if shown else np.array(pixel[:3])
    for column in (0, 1):
        x = left + column * tile
        borders = [tuple(frame[top + 1, x + 30]) for frame in frames]
        wanted = [BLUE] * 2 + [ORANGE] * 6 if column == 0 else [BLUE] * 2 + [ORANGE] * 3 + [GRAY] * 3
        assert np.abs(np.array(borders) - wanted).max() < 12
        middles = frames[:, [top + row * tile + 35 for row in range(3)], x + 35]
        assert np.abs(middles[:, 0] - colour).max() < 8
        assert np.abs(middles[:2, 1] - colour).max() < 8
        assert np.abs(middles[2:, 1] - 255).max() < 8
        assert np.abs(middles[:2, 2] - 127.5).max() < 8
        assert np.abs(middles[2:, 2] - (255 + 255 - colour) / 2).max() < 8


def coloured(path: Path, colour: tuple[int, int, int]) -> int:
    """How many pixels have nearly this colour."""
    with Pillow.open(path) as picture:
        return int((np.abs(np.asarray(picture.convert("RGB"), int) - colour).max(axis=-1) < 10).sum())


def test_a_strip_has_borders_in_the_colours_of_what_they_are(tmp_path: Path) -> None:
    """The sequences whose episode goes on for longest are shown: rows 0 and 2 here, and the new episode of row 1 is
    not."""
    task = Spaces({"a": Image(16, 24, 3), "b": Image(16, 24, 1)}, ACTIONS)
    truth, predicted = sequences_of(task, STEPS, rows=3)
    truth["is_first"][1, 20] = True
    paths = draw_predictions(tmp_path, 1, task, truth, predicted)
    assert set(paths) == {"a", "a-strip", "b", "b-strip", "signals"}
    for name in ("a-strip", "b-strip"):
        blue, orange = coloured(paths[name], BLUE), coloured(paths[name], ORANGE)
        assert 0.3 < blue / orange < 0.45  # 3 frames seen, 8 predicted
        assert coloured(paths[name], GRAY) < blue / 10
    short = {
        name: {key: value[1:2, :30] for key, value in arrays.items()}
        for name, arrays in (("truth", truth), ("model", predicted))
    }
    paths = draw_predictions(tmp_path, 2, task, short["truth"], short["model"])
    assert coloured(paths["a-strip"], GRAY) > coloured(paths["a-strip"], BLUE) / 3


@pytest.mark.parametrize(
    "task",
    [
        Spaces({"observation": Vector(4)}, ACTIONS),
        Spaces({"room": Discrete((5,))}, ACTIONS),
        Spaces({"x": Vector(30), "kind": Discrete((2, 3)), "view": Image(8, 8, 2)}, {"a": Vector(3)}),
    ],
    ids=["cartpole", "discrete", "mixed"],
)
def test_signals_of_every_kind_are_drawn(tmp_path: Path, task: Spaces) -> None:
    """Also of the shortest sequence, with infinities, and where an episode ends within the context."""
    truth, predicted = sequences_of(task, CONTEXT + 1, rows=1)
    truth["is_first"][0, 2] = True
    for key, space in task.observations.items():
        if isinstance(space, Vector):
            predicted[key][0, -1] = np.inf
    path = draw_predictions(tmp_path, 0, task, truth, predicted)["signals"]
    assert coloured(path, ORANGE) > 50
    assert coloured(path, BLUE) > 50


def test_a_right_prediction_of_a_signal_hides_the_truth_and_a_wrong_one_does_not(tmp_path: Path) -> None:
    task = Spaces({"x": Vector(1)}, ACTIONS)
    truth, predicted = sequences_of(task, STEPS, rows=1)
    for name in ("x", "reward"):
        truth[name] += np.sin(np.arange(STEPS)).reshape((1, STEPS, 1)[: truth[name].ndim])
        predicted[name] = truth[name].copy()
    right = coloured(draw_predictions(tmp_path, 0, task, truth, predicted)["signals"], (0x1F, 0x29, 0x37))
    predicted["x"] = -truth["x"]
    predicted["reward"] = -truth["reward"]
    wrong = coloured(draw_predictions(tmp_path, 1, task, truth, predicted)["signals"], (0x1F, 0x29, 0x37))
    assert wrong > 1.3 * right


def test_tensorboard_shows_the_animation(tmp_path: Path) -> None:
    task = Spaces({"camera": Image(8, 8, 3)}, ACTIONS)
    path = draw_predictions(tmp_path / "predictions", 40, task, *sequences_of(task, 8))["camera"]
    (tmp_path / "events").mkdir()
    logger = Logger(tmp_path / "events")
    logger.picture("prediction/camera", path, 40)
    logger.close()
    events = EventAccumulator(str(tmp_path / "events"))
    events.Reload()
    (event,) = events.Images("prediction/camera")
    with Pillow.open(path) as picture:
        assert (event.step, event.width, event.height) == (40, *picture.size)
    assert event.encoded_image_string == path.read_bytes()


def test_the_pictures_of_the_newest_evaluations_stay(tmp_path: Path) -> None:
    """Later ones than the evaluation's own are left from before a resume. What is not ours stays."""
    for step in range(0, 1400, 100):
        (tmp_path / f"{step:012d}-signals.png").touch()
        (tmp_path / f"{step:012d}-camera.gif").touch()
    (tmp_path / "notes-of-mine.png").touch()
    prune_pictures(tmp_path, 1200)
    assert sorted(path.name for path in tmp_path.glob("*.gif")) == [
        f"{step:012d}-camera.gif" for step in range(300, 1300, 100)
    ]
    assert sorted(path.name for path in tmp_path.glob("*.png"))[::10] == [
        "000000000300-signals.png",
        "notes-of-mine.png",
    ]


def test_a_run_keeps_the_pictures_of_its_newest_evaluations(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dreamer_spec.monitoring.pictures.KEPT", 2)
    logdir = run_quietly(make(task="gym:CartPole-v1", steps=70, eval_every=20, eval_episodes=1)).options.logdir
    assert sorted(path.name for path in (logdir / "predictions").iterdir()) == [
        "000000000040-signals.png",
        "000000000060-signals.png",
    ]
