"""Spaces, values, records and errors of the environments behind `train`."""

import functools

import gymnasium
import numpy as np
import pytest
import train_fakes
from gymnasium import spaces as gym

from dreamer_spec.envs import ContractEnv, Environments, make_env, random_actions, translate
from dreamer_spec.errors import UserError
from reference_numpy.training_loop import derive_seed, environment_action
from spec import Discrete, Image, Vector

TWO = gym.Discrete(2)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (gym.Box(-1, 1, (3,)), Vector(3)),
        (gym.Box(-1, 1, (3, 2), np.float64), Vector(6)),
        (gym.Box(-1, 1, ()), Vector(1)),
        (gym.Box(0, 1, (4,), bool), Vector(4)),
        (gym.Box(0, 255, (128,), np.uint8), Vector(128)),
        (gym.Box(0, 255, (210, 160, 3), np.uint8), Image(64, 64, 3)),
        (gym.Box(0, 255, (84, 84, 1), np.uint8), Image(64, 64, 1)),
        (gym.Box(0, 255, (84, 84, 4), np.uint8), Image(64, 64, 4)),
        (gym.Box(0, 255, (84, 84), np.uint8), Image(64, 64, 1)),
        (gym.Discrete(5, start=3), Discrete((5,))),
        (gym.MultiDiscrete([[2, 3], [4, 5]]), Discrete((2, 3, 4, 5))),
        (gym.MultiBinary((2, 2)), Discrete((2, 2, 2, 2))),
    ],
)
@pytest.mark.covers("CON-28", "LOOP-31")
def test_observation_spaces(space: gymnasium.Space, expected: object) -> None:
    assert translate(space, TWO).spaces.observations == {"observation": expected}


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (gym.Box(-1, 1, (2, 3)), Vector(6)),
        (gym.Discrete(4, start=-1), Discrete((4,))),
        (gym.MultiDiscrete([2, 3]), Discrete((2, 3))),
    ],
)
@pytest.mark.covers("LOOP-31")
def test_action_spaces(space: gymnasium.Space, expected: object) -> None:
    assert translate(TWO, space).spaces.actions == {"action": expected}


@pytest.mark.parametrize(
    ("observation", "action", "words"),
    [
        (gym.Dict({"text": gym.Text(5)}), TWO, ["observation 'text'", "Text"]),
        (gym.Dict({"a": gym.Tuple([TWO, gym.Sequence(TWO)])}), TWO, ["observation 'a_1'", "Sequence"]),
        (gym.Dict({"a": gym.Dict({"b": TWO}), "a_b": TWO}), TWO, ["'a_b'", "rename"]),
        (gym.Dict({"a": gym.Tuple([TWO]), "a_0": TWO}), TWO, ["'a_0'", "rename"]),
        (gym.Dict({"reward": TWO}), TWO, ["'reward'", "reserved"]),
        (gym.Dict({}), TWO, ["observation 'observation'", "Dict()"]),
        (TWO, gym.Tuple([TWO, gym.Dict({})]), ["action '1'", "Dict()"]),
        (gym.Box(0, 1, (0,)), TWO, ["'observation'"]),
        (TWO, gym.Box(0, 500, (2,), np.int32), ["action 'action'", "at most 256", "Box of floats"]),
        (gym.Discrete(2**62), TWO, ["'observation'", "describe it by fewer"]),
        (TWO, gym.MultiBinary(50_000), ["action 'action'", "32,768 choices"]),
        (TWO, gym.Dict({7: TWO}), ["action '7'", "strings"]),
    ],
)
def test_unsupported_spaces_are_named(observation: gymnasium.Space, action: gymnasium.Space, words: list[str]) -> None:
    with pytest.raises(UserError) as error:
        translate(observation, action)
    assert all(word in str(error.value) for word in words), error.value


@pytest.mark.covers("LOOP-31")
def test_every_kind_of_observation_becomes_its_array() -> None:
    env = ContractEnv(train_fakes.Everything(), "t")
    observation, _ = env.reset()
    assert env.observation_space.contains(observation)
    assert observation["camera"].shape == (64, 64, 3)
    assert (observation["camera"] == 7).all()
    assert (observation["depth"] == 9).all()
    expected = {"arm_angle": [0.5], "arm_touch": [1, 0, 1], "room": [2], "items": [1, 0], "matrix": [1, 2, 3, 4]}
    assert {key: observation[key].tolist() for key in expected} == expected
    assert observation["arm_angle"].dtype == observation["matrix"].dtype == np.float32


def test_every_kind_of_action_becomes_the_environments() -> None:
    inner = train_fakes.Everything()
    env = ContractEnv(inner, "t")
    env.reset()
    # gear (3 classes), keys_left (2 and 4 classes), move (2 numbers, beyond the bounds)
    env.step(np.float32([0, 0, 1, 0, 1, 0, 0, 1, 0, -1.5, 0.5]))
    (action,) = inner.actions
    assert action["gear"] == 1
    assert action["keys"]["left"].tolist() == [1, 2]
    assert action["move"].tolist() == [[0.0, 1.0]]


@pytest.mark.covers("LOOP-12", "CON-27")
def test_actions_agree_with_the_reference() -> None:
    low, high = np.float32([-3, 0, -np.inf, -np.inf, 0.5]), np.float32([1, 1e3, np.inf, 0.5, np.inf])
    translation = translate(
        TWO, gym.Dict({"a": gym.Discrete(3), "b": gym.Box(low, high), "c": gym.MultiDiscrete([2, 2])})
    )
    rng = np.random.default_rng(0)
    for _ in range(100):
        flat = rng.normal(size=translation.spaces.action_size).astype(np.float32)
        ours, theirs = translation.action(flat), environment_action(flat, translation.spaces, {"b": low}, {"b": high})
        assert ours["a"] == theirs["a"][0]
        assert ours["c"].tolist() == theirs["c"].tolist()
        np.testing.assert_allclose(ours["b"], theirs["b"], rtol=1e-6)


def test_a_fourth_channel_is_not_opacity() -> None:
    """Pillow would mix the colours of neighbours by their fourth channel."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (32, 32, 4), np.uint8)
    resize = translate(gym.Box(0, 255, (32, 32, 4), np.uint8), TWO, image_size=16).observation
    opaque, transparent = image.copy(), image.copy()
    opaque[..., 3], transparent[..., 3] = 255, 0
    first, second = resize(opaque)["observation"], resize(transparent)["observation"]
    assert (first[..., :3] == second[..., :3]).all()
    assert np.ptp(first[..., 0]) > 0


@pytest.mark.parametrize(("height", "width", "channels"), [(210, 160, 3), (100, 31, 1), (20, 30, 4), (64, 90, 3)])
@pytest.mark.covers("LOOP-30")
def test_images_are_resized_bilinearly(height: int, width: int, channels: int) -> None:
    """Down and up, in every channel: a triangle around each output pixel's centre, as wide as two pixels of the coarser
    image."""

    def weights(old: int, new: int) -> np.ndarray:
        distance = np.arange(old) + 0.5 - (np.arange(new)[:, None] + 0.5) * old / new
        triangle = np.maximum(0, 1 - np.abs(distance) / max(1, old / new))
        return triangle / triangle.sum(1, keepdims=True)

    image = np.random.default_rng(0).integers(0, 256, (height, width, channels), np.uint8)
    resized = translate(gym.Box(0, 255, image.shape, np.uint8), TWO).observation(image)["observation"]
    exact = np.einsum("yi,xj,ijc->yxc", weights(height, 64), weights(width, 64), image.astype(float))
    assert resized.dtype == np.uint8
    assert np.abs(resized - exact).max() < 1.5


@pytest.mark.covers("LOOP-30")
def test_an_image_of_the_right_size_is_only_copied() -> None:
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    adapted = translate(gym.Box(0, 255, (64, 64, 3), np.uint8), TWO).observation(image)["observation"]
    assert (adapted == image).all()
    image[:] = 0
    assert adapted.any(), "it must be a copy"


# Records


def _records_of(envs: Environments, steps: int) -> list[dict[str, np.ndarray]]:
    return [envs.reset([0, 1]), *(envs.step(np.zeros((2, 2), np.float32)) for _ in range(steps))]


def _records(processes: bool, steps: int = 11, action_repeat: int = 1) -> list[dict[str, np.ndarray]]:
    make = functools.partial(make_env, "train_fakes:Counting", action_repeat=action_repeat)
    envs = Environments(make, 2, processes)
    try:
        return _records_of(envs, steps)
    finally:
        envs.close()


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-2", "LOOP-7", "LOOP-10", "LOOP-11", "LOOP-29", "CON-9", "CON-10", "CON-11")
def test_each_observation_is_one_record(processes: bool) -> None:
    """Two episodes and the start of a third; the first terminates, the second is truncated. Nothing is lost, nothing
    comes twice."""
    stream = [{key: value[1] for key, value in record.items()} for record in _records(processes)]
    assert [tuple(record["observation"]) for record in stream] == [(e, t) for e in (0, 1) for t in range(5)] + [
        (2, 0),
        (2, 1),
    ]
    assert [record["reward"] for record in stream] == [0, 1, 2, 3, 4, 0, 11, 12, 13, 14, 0, 21]
    assert [t for t, record in enumerate(stream) if record["is_first"]] == [0, 5, 10]
    assert [t for t, record in enumerate(stream) if record["is_last"]] == [4, 9]
    assert [t for t, record in enumerate(stream) if record["is_terminal"]] == [4]
    assert stream[0]["reward"].dtype == np.float32


@pytest.mark.covers("LOOP-5", "LOOP-27")
def test_action_repeat_sums_rewards_and_stops_at_the_end() -> None:
    stream = [{key: value[0] for key, value in record.items()} for record in _records(False, steps=4, action_repeat=3)]
    assert [record["observation"][1] for record in stream] == [0, 3, 4, 0, 3]
    assert [record["reward"] for record in stream] == [0, 1 + 2 + 3, 4, 0, 11 + 12 + 13]
    assert [record["is_last"] for record in stream] == [False, False, True, False, False]


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-27", "LOOP-29")
def test_action_repeat_is_the_same_in_every_episode(processes: bool) -> None:
    """The first episode terminates, the second is truncated, both in the middle of a repetition; a third begins."""
    stream = [
        {key: value[1] for key, value in record.items()} for record in _records(processes, steps=7, action_repeat=3)
    ]
    assert [tuple(record["observation"]) for record in stream] == [(e, t) for e in (0, 1) for t in (0, 3, 4)] + [
        (2, 0),
        (2, 3),
    ]
    assert [record["reward"] for record in stream] == [0, 6, 4, 0, 36, 14, 0, 66]
    assert [t for t, record in enumerate(stream) if record["is_first"]] == [0, 3, 6]
    assert [t for t, record in enumerate(stream) if record["is_last"]] == [2, 5]
    assert [t for t, record in enumerate(stream) if record["is_terminal"]] == [2]


def _limited(
    inner: type[train_fakes.Counting], limit: int, action_repeat: int, steps: int
) -> list[dict[str, np.ndarray]]:
    envs = Environments(
        lambda index: ContractEnv(
            gymnasium.wrappers.TimeLimit(inner(), limit), "t", index, action_repeat=action_repeat
        ),
        1,
        False,
    )
    return [envs.reset([0]), *(envs.step(np.zeros((1, 2), np.float32)) for _ in range(steps))]


@pytest.mark.parametrize(
    ("action_repeat", "times"), [(1, [0, 1, 2, 3, 4, 5]), (2, [0, 2, 4, 5]), (3, [0, 3, 5]), (9, [0, 5])]
)
@pytest.mark.covers("LOOP-28")
def test_a_time_limit_counts_frames_and_truncates(action_repeat: int, times: list[int]) -> None:
    records = _limited(train_fakes.Endless, limit=5, action_repeat=action_repeat, steps=2 * len(times) - 1)
    assert [record["observation"][0, 1] for record in records] == 2 * times
    assert [record["is_last"][0] for record in records] == 2 * [time == 5 for time in times]
    assert not any(record["is_terminal"][0] for record in records)


@pytest.mark.covers("LOOP-28", "LOOP-10")
def test_an_end_at_the_time_limit_is_terminal() -> None:
    records = _limited(train_fakes.Counting, limit=train_fakes.EPISODE, action_repeat=1, steps=9)
    assert [t for t, record in enumerate(records) if record["is_last"][0]] == [4, 9]
    assert [t for t, record in enumerate(records) if record["is_terminal"][0]] == [4], (
        "the second episode is only truncated"
    )


@pytest.mark.covers("LOOP-29", "LOOP-33")
def test_every_reset_gets_a_seed_of_its_own() -> None:
    """With one seed at each reset every episode would be the same, with none an episode could not be repeated."""
    resets: list[tuple[int, int | None]] = []

    class Diary(train_fakes.Counting):
        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
            resets.append((self._time, seed))
            return super().reset(seed=seed)

    envs = Environments(lambda index: ContractEnv(Diary(), "t", index), 2, False)
    envs.reset([5, 783237557])
    for _ in range(2 * (train_fakes.EPISODE + 1)):
        envs.step(np.zeros((2, 2), np.float32))
    assert resets[1:4:2] == [(0, 1184808864), (4, 1149401728)], "the worked numbers of the chapter"
    begun = [(0, 5, 0), (0, 783237557, 0), (4, 5, 1), (4, 783237557, 1), (4, 5, 2), (4, 783237557, 2)]
    assert resets == [(time, derive_seed(seed, "episode", episode)) for time, seed, episode in begun]


@pytest.mark.parametrize("processes", [False, True])
def test_records_and_actions_share_no_memory_with_the_environment(processes: bool) -> None:
    envs = Environments(functools.partial(make_env, "train_fakes:Counting"), 2, processes)
    try:
        record = envs.reset([0, 1])
        before = {key: value.copy() for key, value in record.items()}
        action = np.full((2, 2), 0.5, np.float32)
        envs.step(action)
        assert all((record[key] == before[key]).all() for key in record)
        assert (action == 0.5).all()
        record["observation"][:] = -1
        record["is_last"][:] = True
        assert envs.step(action)["observation"].tolist() == [[0, 2], [0, 2]]
    finally:
        envs.close()


def test_an_adapted_observation_is_a_copy() -> None:
    """Of every kind: the environment goes on writing into the arrays that it handed out."""
    inner = train_fakes.Everything()
    shared = inner.observation()
    shared["arm"]["angle"] = np.zeros((), np.float32)
    inner.observation = lambda: shared  # type: ignore[method-assign]
    first, _ = ContractEnv(inner, "t").reset()
    before = {key: value.copy() for key, value in first.items()}
    for value in (
        shared["camera"],
        shared["depth"],
        shared["arm"]["angle"],
        shared["arm"]["touch"],
        shared["items"],
        shared["matrix"],
    ):
        value[...] = 1
    assert all((first[key] == before[key]).all() for key in first)
    counting = ContractEnv(train_fakes.Counting(), "t")
    vector, _ = counting.reset()
    counting.step(np.zeros(2, np.float32))
    assert vector["observation"].tolist() == [0, 0]


@pytest.mark.covers("LOOP-24")
def test_seeds_decide_what_happens() -> None:
    def first(seeds: list[int]) -> list[list[float]]:
        envs = Environments(functools.partial(make_env, "gym:CartPole-v1"), 2, False)
        actions = np.eye(2, dtype=np.float32)
        envs.reset(seeds)
        return [row.tolist() for _ in range(60) for row in envs.step(actions)["observation"]]

    assert first([1, 2]) == first([1, 2])
    assert first([1, 2]) != first([1, 3])


@pytest.mark.covers("LOOP-10", "LOOP-28", "CON-11")
def test_a_time_limit_of_gymnasium_is_no_termination() -> None:
    envs = Environments(functools.partial(make_env, "gym:Pendulum-v1"), 1, False)
    envs.reset([0])
    records = [envs.step(np.zeros((1, 1), np.float32)) for _ in range(200)]
    assert [bool(record["is_last"][0]) for record in records] == [False] * 199 + [True]
    assert not any(record["is_terminal"][0] for record in records)


def test_random_actions_are_legal_and_cover_the_choices() -> None:
    spaces = ContractEnv(train_fakes.Everything(), "t").spaces
    actions = random_actions(spaces, np.random.default_rng(0), 200)
    assert actions.shape == (200, spaces.action_size)
    assert actions.dtype == np.float32
    assert (actions[:, :3].sum(axis=0) > 30).all()
    assert (actions[:, :3].sum(axis=1) == 1).all()
    assert (np.abs(actions[:, -2:]) <= 1).all()
    assert len(np.unique(actions[:, -2:], axis=0)) == 200, "each worker draws its own"


@pytest.mark.covers("LOOP-28")
def test_dm_control_from_vectors() -> None:
    pytest.importorskip("dm_control")
    env = make_env("dmc:cartpole-balance", action_repeat=2)
    assert env.spaces.observations == {"position": Vector(3), "velocity": Vector(2)}
    first, again = env.reset(seed=3)[0], env.reset(seed=3)[0]
    assert all((first[key] == again[key]).all() for key in first)
    steps = 0
    truncated = terminated = False
    while not (terminated or truncated):
        _, reward, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
        steps += 1
    assert (steps, terminated, truncated) == (500, False, True)
    assert 0 < reward <= 2
    with pytest.raises(UserError, match="known: cartpole-balance"):
        make_env("dmc:cartpole-fly")


@pytest.mark.covers("LOOP-27")
def test_every_repeat_gets_the_same_action() -> None:
    """`Counting` writes into the actions that it is given."""
    inner = train_fakes.Counting()
    env = ContractEnv(inner, "t", action_repeat=3)
    env.reset()
    env.step(np.float32([0.0, 0.5]))
    assert [action.tolist() for action in inner.actions] == [[5, 0.5]] * 3
