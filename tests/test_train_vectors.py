"""Vector environments give the records that their environments give one by one, in every mode."""

import functools
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from test_train_restore import equal, saved
from vector_fakes import COUNT, TROUBLE

from dreamer_spec import cli, make_options
from dreamer_spec.envs import Environments, Record, env_maker, make_env, random_actions
from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.video import Film
from reference_numpy.training_loop import derive_seed

MODES = ["NextStep", "SameStep", "Disabled"]
SEEDS = [3, 4, 5]
STEPS = 80  # some twenty episodes of each environment

Make = Callable[..., Environments]


@pytest.fixture
def make() -> Iterator[Make]:
    """Environments that are closed when the test ends."""
    made: list[Environments] = []

    def environments(name: str, processes: bool = False, given: dict[str, Any] | None = None, **options: Any) -> Any:
        maker = functools.partial(
            make_env, f"vector_fakes:{name}", image_size=16, info_metrics=["fuel", "stats/*"], arguments=given
        )
        made.append(Environments(maker, COUNT, processes, **options))
        return made[-1]

    yield environments
    for envs in made:
        envs.close()


def actions(envs: Environments) -> Iterator[np.ndarray]:
    rng = np.random.default_rng(0)
    while True:
        action = random_actions(envs.spaces, rng, envs.count)
        action[:, 3:] *= 0.7  # No trouble.
        yield action


def play(envs: Environments, steps: int = STEPS) -> tuple[list[Record], list[list[dict[str, float]]]]:
    records, infos = [envs.reset(SEEDS)], [envs.info]
    for action in itertools.islice(actions(envs), steps):
        records.append(envs.step(action))
        infos.append(envs.info)
    return records, infos


def play_same(envs: Environments, action: np.ndarray) -> None:
    for _ in range(3):  # One of them may meet the end of an episode, which ignores it.
        envs.step(action)


def differ(first: list[Record], second: list[Record]) -> list[int]:
    return [
        time for time, (one, other) in enumerate(zip(first, second, strict=True)) if not equal(dict(one), dict(other))
    ]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("name", "processes"), [("sync", False), ("sync", True), ("asynchronous", False), ("asynchronous", True)]
)
@pytest.mark.covers("LOOP-11", "LOOP-33", "LOOP-74")
def test_the_records_are_those_of_single_environments(make: Make, mode: str, name: str, processes: bool) -> None:
    records, infos = play(make(name, processes, {"mode": mode}))
    expected, expected_infos = play(make("Trip"))
    assert differ(records, expected) == []
    assert infos == expected_infos
    last = np.array([record["is_last"] for record in expected])
    terminal = np.array([record["is_terminal"] for record in expected])
    assert last.sum() > 10 * COUNT
    assert 5 < terminal.sum() < last.sum() - 5
    assert len({tuple(row) for row in last.tolist()}) > COUNT, "the environments end together"
    assert any("fuel" in info and "stats/left" in info for infos_now in infos for info in infos_now)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seeds", ["array", "some"])
@pytest.mark.covers("LOOP-74")
def test_other_forms_of_seeds_and_of_what_a_reset_returns(make: Make, mode: str, seeds: str) -> None:
    records, _ = play(make("Narrow", given={"mode": mode, "seeds": seeds, "masks": True}))
    assert differ(records, play(make("Trip"))[0]) == []


@pytest.mark.parametrize("masks", [False, True])
@pytest.mark.covers("LOOP-11", "LOOP-74")
def test_without_seeds_for_each_the_vectors_own_resets_are_the_first_records(make: Make, masks: bool) -> None:
    """In the mode NEXT_STEP, with one seed at the start: what Gymnasium's own vector gives then, step by step."""
    envs = make("Narrow", given={"mode": "NextStep", "masks": masks})
    records, _ = play(envs)
    plain = make_env("vector_fakes:sync", arguments={"mode": "NextStep"})
    vector: SyncVectorEnv = plain._envs
    seed = derive_seed(SEEDS[0], "episode", 0)
    assert records[0]["place_at"].tolist() == vector.reset(seed=seed)[0]["place"]["at"].tolist()
    ended = np.zeros(COUNT, bool)
    for record, action in zip(records[1:], actions(envs), strict=False):
        observation, reward, terminated, truncated, _ = vector.step(plain._batch(action))
        assert record["place_at"].tolist() == observation["place"]["at"].tolist()
        assert record["reward"].tolist() == reward.astype(np.float32).tolist()
        assert record["is_first"].tolist() == ended.tolist()
        ended = terminated | truncated
        assert record["is_last"].tolist() == ended.tolist()
        assert record["is_terminal"].tolist() == terminated.tolist()
    assert sum(record["is_first"].sum() for record in records) > 10 * COUNT


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
@pytest.mark.parametrize("seeds", ["one", "array"])
@pytest.mark.covers("LOOP-74")
def test_a_vector_that_would_lose_a_first_observation_is_refused(make: Make, mode: str, seeds: str) -> None:
    envs = make("Narrow", given={"mode": mode, "seeds": seeds})
    with pytest.raises(UserError, match=r"does not obey options=.*reset_mask.*Make it with autoreset_mode NEXT_STEP"):
        envs.reset(SEEDS)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-34", "LOOP-74")
def test_what_follows_a_restore_is_what_would_have_followed(make: Make, mode: str, processes: bool) -> None:
    envs = make("sync", given={"mode": mode})
    records, histories, played = [envs.reset(SEEDS)], [envs.histories()], []
    for action in itertools.islice(actions(envs), 40):
        played.append(action)
        records.append(envs.step(action))
        histories.append(envs.histories())
    moments = [
        0,
        5,
        next(time for time, record in enumerate(records) if record["is_last"].any()),
        next(time for time, record in enumerate(records) if time and record["is_first"].any()),
    ]
    again = make("sync", processes, {"mode": mode})
    for moment in moments:
        record = again.restore([saved(history) for history in histories[moment]])
        assert record is not None
        assert equal(dict(record), dict(records[moment])), moment
        for action, expected in zip(played[moment:], records[moment + 1 :], strict=True):
            assert equal(dict(again.step(action)), dict(expected)), moment
        assert [history.actions.tolist() for history in again.histories()] == [
            history.actions.tolist() for history in histories[-1]
        ]


@pytest.mark.covers("LOOP-34", "LOOP-74")
def test_a_vector_that_cannot_repeat_episodes_is_restarted(make: Make) -> None:
    envs = make("Narrow", given={"mode": "NextStep"})
    play(envs, 5)
    again = make("Narrow", given={"mode": "NextStep"})
    assert again.restore(envs.histories()) is None
    assert again.reset(SEEDS)["is_first"].all()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("trouble", list(TROUBLE))
@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-32", "LOOP-74")
def test_a_vector_that_fails_is_restarted_as_a_whole(make: Make, mode: str, trouble: str, processes: bool) -> None:
    envs = make("sync", processes, {"mode": mode}, failures_allowed=1)
    play(envs, 10)
    bad = np.zeros((COUNT, envs.spaces.action_size), np.float32)
    bad[1, 3] = TROUBLE[trouble] + 0.05
    record = envs.step(bad)
    while not envs.failures:  # The action was for the end of an episode.
        record = envs.step(bad)
    assert record["is_first"].all()
    assert not record["reward"].any()
    (failure,) = envs.take_failures()
    assert failure.who == "the vector of 3 environments"
    assert failure.kind == {"raise": "error", "nan": "invalid data"}[trouble]
    assert {"raise": "the road ends", "nan": "environment 1"}[trouble] in failure.message
    fresh = make("sync", given={"mode": mode})
    expected = fresh.reset([derive_seed(seed, "restart", 0) for seed in SEEDS])
    assert equal(dict(record), dict(expected))
    calm = next(actions(envs))
    assert equal(dict(envs.step(calm)), dict(fresh.step(calm)))
    with pytest.raises(UserError, match="failed 2 times within"):
        play_same(envs, bad)


@pytest.mark.covers("LOOP-32", "LOOP-74")
def test_a_vector_whose_process_ends_is_restarted(make: Make) -> None:
    envs = make("Leaving", True)
    envs.reset(SEEDS)
    records = [envs.step(action) for action in itertools.islice(actions(envs), 4)]
    assert [record["is_first"].all() for record in records].count(True) == 1
    assert [failure.kind for failure in envs.take_failures()] == ["crash"]


@pytest.mark.covers("LOOP-31", "LOOP-74")
def test_columns_of_another_length_are_a_failure(make: Make) -> None:
    envs = make("short")
    play(envs, 12)
    assert {failure.kind for failure in envs.take_failures()} == {"invalid data"}
    with pytest.raises(UserError, match=r"the rewards have the shape \(2,\); expected \(3,\)"):
        play(make("short", failures_allowed=0), 12)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.covers("LOOP-66", "LOOP-74")
def test_a_vector_of_one_can_be_lent(mode: str) -> None:
    records = []
    for name, given in (("sync", {"mode": mode, "count": 1}), ("Trip", None)):
        envs = Environments(
            functools.partial(make_env, f"vector_fakes:{name}", image_size=16, arguments=given), 1, False
        )
        envs.reset(SEEDS[:1])
        envs.step(next(actions(envs)))
        with envs.lend():
            envs.reset([9])
            envs.step(next(actions(envs)))
        records.append([envs.next_episodes(), *(envs.step(action) for action in itertools.islice(actions(envs), 20))])
        envs.close()
    assert differ(*records) == []


def test_a_vector_is_not_filmed(tmp_path: Path) -> None:
    film = Film(tmp_path / "film.gif")
    filmed = film.filming(functools.partial(make_env, "vector_fakes:sized", num_envs=2))
    with pytest.raises(UserError, match="vector_fakes:sized is a vector environment, which cannot be filmed"):
        filmed(0)


def test_a_vector_must_say_when_it_resets() -> None:
    with pytest.raises(UserError, match=r"metadata\['autoreset_mode'\] of the vector environment is None; expected"):
        make_env("vector_fakes:silent")


@pytest.mark.parametrize("given", [{"action_repeat": 2}, {"time_limit": 9}])
def test_what_wraps_single_environments_is_refused(given: dict[str, int]) -> None:
    with pytest.raises(UserError, match=r"leave out --.* and apply it inside the vector"):
        make_env("vector_fakes:sync", arguments={"mode": "NextStep"}, **given)


def test_a_callable_with_num_envs_gets_the_number(make: Make) -> None:
    envs = Environments(env_maker(make_options("jax", "vector_fakes:sized", envs=5, processes="no")), 5, False)
    assert (envs.count, envs.is_vector) == (5, True)
    assert envs.reset([1, 2, 3, 4, 5])["reward"].shape == (5,)
    envs.close()


def test_another_number_of_environments_is_refused_with_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--task", "vector_fakes:sync", "--env-arg", "mode=NextStep", "--logdir", str(tmp_path / "run")]
    code = cli.main(["--backend", "torch", *options, "--envs", "4", "--processes", "no", "--no-preflight"])
    assert code != 0
    error = capsys.readouterr().err
    assert "is a vector of 3 environments, and this run is to have 4: add --envs 3" in error
    assert "Traceback" not in error


@pytest.mark.parametrize("mode", MODES[:2])
@pytest.mark.covers("LOOP-74")
def test_the_vector_of_ale_is_that_of_its_single_games(mode: str) -> None:
    pytest.importorskip("ale_py")
    given = {"game": "pong", "max_num_frames_per_episode": 120, "img_height": 64, "img_width": 64, "noop_max": 5}

    def records_of(numbers: list[int], **more: str) -> list[Record]:
        maker = functools.partial(make_env, "ale_py:AtariVectorEnv", arguments={**given, **more}, num_envs=len(numbers))
        envs = Environments(maker, len(numbers), False)
        rng = np.random.default_rng(0)
        records = [envs.reset([SEEDS[number] for number in numbers])]
        for _ in range(70):
            records.append(envs.step(random_actions(envs.spaces, rng, COUNT)[numbers]))
        envs.close()
        return records

    together = records_of([0, 1, 2], autoreset_mode=mode)
    for number in range(COUNT):
        alone = records_of([number])
        assert differ([{key: value[[number]] for key, value in record.items()} for record in together], alone) == []
    assert sum(record["is_last"].sum() for record in together) >= 2 * COUNT


@pytest.mark.covers("LOOP-11")
def test_envpool_gives_first_and_last_records() -> None:
    pytest.importorskip("envpool")
    given = {"task_id": "CartPole-v1", "num_envs": COUNT, "seed": 7}
    envs = Environments(functools.partial(make_env, "envpool:make_gymnasium", arguments=given), COUNT, False)
    records, _ = play(envs, 150)
    first, last = (np.stack([record[key] for record in records]) for key in ("is_first", "is_last"))
    assert first[0].all()
    assert first[1:].tolist() == last[:-1].tolist()
    assert last.sum() > COUNT
    positions = np.stack([record["observation"] for record in records])
    assert np.abs(positions[first]).max() <= 0.05, "CartPole begins within this"
    assert np.abs(positions[last & np.stack([record["is_terminal"] for record in records])][:, 2]).min() > 0.2
    envs.close()
