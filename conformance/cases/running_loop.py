"""Checks of a whole running loop: what it records, when it trains, what it draws, and which seeds it uses.

The candidate runs with environments and a learner of the kit, which keep a diary (conformance/running). Where
spec/12-training-loop.md leaves something open, such as a pipeline that is one train step late, whatever it allows
passes. Evaluation and what goes on after an interruption are in going_on.py.
"""

from typing import Any

import numpy as np

from conformance.check import script
from conformance.compare import round_to
from conformance.running.diary import Act, Diary, Train
from conformance.running.environment import HIGH, LOW, SPACES, World, key_of
from conformance.running.expected import StoredLatents, batch_row, draws, train_steps_by_act
from conformance.running.learner import mark_in
from conformance.running.playing import STEPS, config_of, runs_of
from conformance.running.records import Place, Record, records_of, streams_of
from conformance.script import Script
from reference_numpy.training_loop import environment_action
from spec import Config

ENDLESS = World(longest=10**6)


@script("LOOP-2", "LOOP-5", "LOOP-7", "LOOP-10", "LOOP-11", "LOOP-29", "CON-11", uses=["run"], level=0)
def every_observation_acts_once_in_its_order(script: Script) -> None:
    """All that the environments give goes through the policy step, reset and last observations included; is_first is
    set for resets alone, and these follow ends alone."""
    with runs_of(script) as runs:
        diary = runs.play("run", config_of(script))
    rows = [(key, act.is_first[row]) for act in diary.acts for row, key in enumerate(act.keys)]
    script.exact("records", len(rows), STEPS)
    acted = {key for key, _ in rows}
    for environment in {frame.environment for frame in diary.frames if frame.key in acted}:
        frames = [frame for frame in diary.frames if frame.environment == environment]
        own = [row for row in rows if row[0] in {frame.key for frame in frames}]
        where = f"environment {environment}"
        script.holds(f"{where}: the last answer alone may not have been seen", len(frames) - len(own) in (0, 1))
        script.exact(f"{where}: the order of its observations", [key for key, _ in own], _keys(frames[: len(own)]))
        script.exact(
            f"{where}: is_first", [first for _, first in own], [frame.is_reset for frame in frames[: len(own)]]
        )
        ended = [True, *(frame.terminated or frame.truncated for frame in frames[:-1])]
        script.exact(f"{where}: resets", [frame.is_reset for frame in frames], ended)
    given = {frame.key: frame.observation for frame in diary.frames}
    for act in diary.acts:
        for key, seen in act.observation.items():
            script.exact(f"{key} of a policy step", seen, np.stack([given[place][key] for place in act.keys]))


def _keys(frames: Any) -> list[Any]:
    return [frame.key for frame in frames]


@script("LOOP-3", "LOOP-7", "LOOP-8", uses=["run"], level=0)
def each_worker_goes_on_with_its_own_carry(script: Script) -> None:
    """But for resets, the policy step gets the row of the carry that it returned for this worker the time before, with
    episodes that end together and apart, and of one worker that never ends its own."""
    with runs_of(script) as runs:
        diaries = [runs.play("short", config_of(script)), runs.play("endless", config_of(script), ENDLESS)]
    for diary in diaries:
        compare_carries(script, diary, diary.acts)


def compare_carries(script: Script, diary: Diary, acts: list[Act]) -> None:
    """Of each environment, but for resets, where the policy step does not look at it."""
    environments = {frame.key: frame.environment for frame in diary.frames}
    carried: dict[int, int] = {}
    for number, act in enumerate(acts):
        for row, key in enumerate(act.keys):
            if not act.is_first[row]:
                where = f"the carry of environment {environments[key]} in policy step {number}"
                script.exact(where, act.carry[row], carried[environments[key]])
            carried[environments[key]] = int(act.carried[row])
    script.holds("episodes had more than one record", not all(act.is_first.all() for act in acts))


@script("LOOP-6", "LOOP-12", "CON-27", uses=["run"], level=0)
def environments_get_the_action_of_their_own_row(script: Script) -> None:
    """From the first record on an environment gets what the policy step chose, clipped and in its own units: numbers in
    a range, a number without bounds, and a choice by its index."""
    with runs_of(script) as runs:
        diary = runs.play("run", config_of(script))
    compare_actions(script, diary, records_of(script, diary))


def compare_actions(script: Script, diary: Diary, records: list[Record]) -> None:
    flat = {record.frame.key: record.action for record in records}
    latest: dict[int, np.ndarray] = {}
    script.holds("no environment is stepped after an end", not any(frame.after_end for frame in diary.frames))
    for frame in diary.frames:
        if frame.action is not None and frame.environment in latest:
            expected = environment_action(latest[frame.environment], SPACES, LOW, HIGH)
            where = f"the action of environment {frame.environment}"
            script.holds(f"{where} has the keys {sorted(expected)}", set(frame.action) == set(expected))
            for key, value in expected.items():
                script.compare(f"{where}: {key}", frame.action[key], value, magnitude=10.0, bound=1e-6)
        if frame.key in flat:
            latest[frame.environment] = flat[frame.key]
    script.holds("environments were stepped", script.comparisons.compared > 0)


RECORDED = ("LOOP-2", "LOOP-3", "LOOP-9", "LOOP-10", "LOOP-11", "CON-9", "CON-10", "CON-11")
SAMPLED = ("REP-2", "REP-14", "REP-15", "REP-16", "REP-17")


@script(*RECORDED, *SAMPLED, uses=["run"], level=0)
def batches_hold_what_happened(script: Script) -> None:
    """Each row is a piece of one worker's stream with what came with each observation: no reward at a reset, flags, the
    actions as they were sampled, and none after an end."""
    with runs_of(script) as runs:
        config = config_of(script)
        compare_batches(script, runs.play("run", config), config)


def compare_batches(script: Script, diary: Diary, config: Config) -> list[Record]:
    """Every entry of every batch but the latents. Returns the records."""
    records = records_of(script, diary)
    streams = streams_of(records)
    script.holds("there were train steps", diary.trains)
    for number, rows in enumerate(places_of(script, diary, records)):
        batch = diary.trains[number].batch
        for row, places in enumerate(rows):
            worker, first = places[0]
            where = f"train step {number}, row {row}"
            contiguous = [(worker, first + step) for step in range(config.batch_length)]
            script.exact(f"{where}: worker and position", places, contiguous)
            script.holds(f"{where} has a record before it", first > 0)
            for key, expected in batch_row(streams[worker], first - 1, config.batch_length).items():
                script.exact(f"{where}: {key}", batch[key][row], expected)
    return records


def places_of(script: Script, diary: Diary, records: list[Record]) -> list[list[list[Place]]]:
    """The places [B][T] of the trained positions of every batch."""
    places = {record.frame.key: record.place for record in records}
    found = []
    for number, train in enumerate(diary.trains):
        keys = [[key_of(place) for place in row] for row in train.batch["place"]]
        script.holds(f"train step {number} has recorded observations", [key in places for row in keys for key in row])
        found.append([[places[key] for key in row] for row in keys])
    return found


LATENTS = ("LOOP-3", "LOOP-17", "REP-19", "REP-20", "REP-22")


@script(*LATENTS, uses=["run"], level=0)
def latents_are_written_back_in_time(script: Script) -> None:
    """A sequence begins with the latents of the policy step for that observation, or with those of the last train step
    that had it, the one before this at the latest; in float32 or in the nearest bfloat16."""
    with runs_of(script) as runs:
        # One worker with more records than any block, chunk or page that a buffer may have, and many train steps.
        config = config_of(script, envs=1, replay_ratio=12.0, replay_capacity=100)
        compare_latents(script, runs.play("run", config, steps=200))


def compare_latents(script: Script, diary: Diary) -> None:
    records = records_of(script, diary)
    stored, renewed = StoredLatents(streams_of(records)), 0
    fresh = {record.latents for record in records}
    for number, rows in enumerate(places_of(script, diary, records)):
        train = diary.trains[number]
        for row, places in enumerate(rows):
            worker, first = places[0]
            deter, stoch = train.batch["deter"][row], train.batch["stoch"][row]
            where, got = f"train step {number}, row {row}", mark_in(deter)
            allowed = stored.allowed((worker, first - 1), number)
            made_by = "another call" if got in diary.latents else "no call"
            script.holds(f"{where}: the latents of its context (these are of {made_by})", got in allowed)
            expected = diary.latents[got]
            script.holds(
                f"{where}: deter", any(np.array_equal(deter, as_stored) for as_stored in stored_as(expected[0]))
            )
            script.exact(f"{where}: stoch", stoch, expected[1])
            renewed += got not in fresh
        if not train.skipped:
            stored.write_back(rows, train.latents, number)
    script.holds("some latents came from train steps", renewed > 0)


def stored_as(deter: np.ndarray) -> tuple[np.ndarray, ...]:
    return deter, round_to(deter, "bfloat16")


COUNTED = ("LOOP-4", "LOOP-5", "LOOP-13", "LOOP-14", "LOOP-15", "LOOP-16")


@script(*COUNTED, uses=["run"], level=0)
def train_steps_are_counted_exactly(script: Script) -> None:
    """Between two policy steps there are as many as the replay ratio says, from the first record on that makes enough
    sequences: with several ratios and workers, none with ratio 0, and no more where actions are repeated."""
    runs = ((0.7, 1, 1), (7.3, 2, 1), (6.0, 3, 1), (32.0, 2, 1), (0.0, 2, 1), (6.0, 2, 3))
    with runs_of(script) as place:
        for number, (ratio, workers, repeat) in enumerate(runs):
            config = config_of(script, envs=workers, replay_ratio=ratio)
            diary = place.play(str(number), config, steps=42, action_repeat=repeat)
            compare_train_steps(
                script, diary, config, f"ratio {ratio:g}, {workers} workers, action repeat {repeat}", 42
            )


def compare_train_steps(script: Script, diary: Diary, config: Config, where: str, steps: int) -> None:
    """Those between each policy step and the next, and the number of records."""
    records = records_of(script, diary)
    script.exact(f"{where}: records", len(records), steps)
    script.exact(f"{where}: train steps", train_steps_made(diary), train_steps_by_act(records, config))


def train_steps_made(diary: Diary) -> list[int]:
    """How many train steps follow each policy step."""
    made: list[int] = []
    for event in diary.events:
        if isinstance(event, Act):
            made.append(0)
        elif isinstance(event, Train):
            made[-1] += 1
    return made


@script("LOOP-5", "LOOP-9", "LOOP-12", "LOOP-27", uses=["run"], level=0)
def actions_are_repeated(script: Script) -> None:
    """Each action is applied for three frames, or up to the end of the episode, whatever the environment writes into
    the one that it is given; the record has the sum of their rewards, the last observation and its flags."""
    with runs_of(script) as runs:
        config = config_of(script)
        diary = runs.play("run", config, World(longest=17, scribbles=True), action_repeat=3)
    records = compare_batches(script, diary, config)
    compare_actions(script, diary, records)
    script.exact("records", len(records), STEPS)
    times = {record.frame.key: record.frame.key[3] for record in records}
    before: dict[int, Record] = {}
    for record in records:
        if not record.is_first:
            frames = times[record.frame.key] - times[before[record.worker].frame.key]
            where = f"frames of worker {record.worker} before its record {record.position}"
            script.holds(f"{where}: 3, or fewer at an end", frames == 3 or (record.is_last and 0 < frames < 3))
        before[record.worker] = record


@script("LOOP-24", "LOOP-33", uses=["run"], level=0)
def a_seed_determines_the_run(script: Script) -> None:
    """Two runs with one seed are the same in every number; with another seed every draw is another. Each reset has a
    seed of its own."""
    with runs_of(script) as runs:
        config = config_of(script)
        first, again = (runs.play(name, config) for name in ("first", "again"))
        other = runs.play("other", config, seed=script.setting.seed + 1)
    compare_learning(script, "the run again", again, first)
    for name in ("acts", "trains"):
        seeds = [{event.seed for event in getattr(diary, name)} for diary in (first, other)]
        script.holds(f"{name} of another seed have other seeds", seeds[0].isdisjoint(seeds[1]))
    seeds = [{frame.seed for frame in diary.frames if frame.is_reset} for diary in (first, other)]
    script.holds("resets have seeds", [None not in those for those in seeds])
    script.holds("episodes of another seed have other seeds", seeds[0].isdisjoint(seeds[1]))
    resets = [frame for frame in first.frames if frame.is_reset]
    script.exact("different seeds of the resets", len(seeds[0]), len(resets))


def compare_learning(script: Script, where: str, actual: Diary, expected: Diary) -> None:
    """All that the learner was given, in its order, and the training state at the end."""
    compare_events(script, where, learning(actual), learning(expected))
    for name, array in expected.last_state.items():
        script.exact(f"{where}: {name} at the end", actual.last_state[name], array)


def learning(diary: Diary) -> list[Act | Train]:
    return [event for event in diary.events if isinstance(event, Act | Train)]


def compare_events(script: Script, where: str, actual: list[Any], expected: list[Any]) -> None:
    """Policy steps and train steps, in every number."""
    for number, (one, other) in enumerate(zip(actual, expected, strict=False)):
        here = f"{where}, call {number} of the learner"
        script.holds(f"{here}: the same method", type(one) is type(other))
        script.exact(f"{here}: seed", one.seed, other.seed)
        for key, array in (other.batch if hasattr(other, "batch") else other.observation).items():
            script.exact(f"{here}: {key}", (one.batch if hasattr(one, "batch") else one.observation)[key], array)
        if hasattr(other, "is_first"):
            script.exact(f"{here}: is_first", one.is_first, other.is_first)
            carries = [np.where(event.is_first, 0, event.carry) for event in (one, other)]
            script.exact(f"{here}: carry", *carries)
            script.exact(f"{here}: action", one.action, other.action)
    script.exact(f"{where}: calls of the learner", len(actual), len(expected))


TABLES = ("LOOP-24", "LOOP-25", "LOOP-26", "LOOP-33")


@script(*TABLES, uses=["run", "derive_seed"], level=0)
def seeds_are_those_of_the_tables(script: Script) -> None:
    """Parameters, policy steps, train steps and the episodes of each worker have the seeds of their numbers."""
    with runs_of(script) as runs:
        seed = script.setting.seed + 7
        diary = runs.play("run", config_of(script), seed=seed)
    script.exact("parameters", diary.parameter_seeds, [derived(script, seed, "parameters", 0)])
    for purpose, events in (("policy", diary.acts), ("train", diary.trains)):
        expected = [derived(script, seed, purpose, number) for number in range(len(events))]
        script.exact(f"seeds of {purpose}", [event.seed for event in events], expected)
    seeds = [derived(script, seed, "environment", worker) for worker in range(3)]
    compare_episode_seeds(script, records_of(script, diary), seeds)


def derived(script: Script, seed: int, purpose: str, index: int) -> int:
    return int(script.call("derive_seed", seed, purpose, index))


def compare_episode_seeds(script: Script, records: list[Record], seeds: list[int]) -> None:
    """Of the resets in each row. seeds: of the workers, in the order of the rows."""
    for row, seed in enumerate(seeds):
        played = [record.frame.seed for record in records if record.row == row and record.is_first]
        expected = [derived(script, seed, "episode", number) for number in range(len(played))]
        script.exact(f"seeds of the episodes in row {row}", played, expected)


DRAWN = ("LOOP-4", "LOOP-26", "REP-4", "REP-7", "REP-8", "REP-9", "REP-12", "REP-33")


@script(*DRAWN, uses=["run", "derive_seed"], level=0)
def batches_are_drawn_as_their_seeds_say(script: Script) -> None:
    """Rows are new sequences, and then those that the numbers of this train step choose among the items of the moment
    or of the train step before; also in a small buffer, which is full soon."""
    with runs_of(script) as runs:
        for workers, ratio, capacity in ((3, 6.0, 500), (2, 14.0, 25)):
            config = config_of(script, envs=workers, replay_ratio=ratio, replay_capacity=capacity)
            diary = runs.play(f"{workers} workers", config)
            records = records_of(script, diary)

            def uniform(number: int, size: int = config.batch_size) -> np.ndarray:
                seed = derived(script, script.setting.seed, "replay", number)
                return np.random.Generator(np.random.PCG64(seed)).random(size)

            drawn = places_of(script, diary, records)
            allowed = [draws(records, config, uniform, ahead) for ahead in (False, True)]
            script.exact(f"{workers} workers: batches", len(drawn), len(allowed[0]))
            agree = [
                next((k for k, pair in enumerate(zip(drawn, those, strict=True)) if pair[0] != pair[1]), None)
                for those in allowed
            ]
            if None not in agree:
                number = max(place for place in agree if place is not None)
                where = f"{workers} workers: worker and position of the rows of batch {number}"
                script.exact(where, drawn[number], allowed[agree.index(number)][number])


@script("LOOP-40", "LOOP-42", "LOOP-43", uses=["run"], level=0)
def a_skipped_step_leaves_the_buffer_as_it_is(script: Script) -> None:
    """Every third train step meets a loss that is not finite: the run goes on and counts it, and its latents are in no
    batch."""
    with runs_of(script) as runs:
        config = config_of(script, envs=1, replay_ratio=12.0)
        diary = runs.play("run", config, skips=range(2, 10**6, 3), nonfinite="skip")
    script.holds("steps were skipped", sum(train.skipped for train in diary.trains) > 1)
    compare_train_steps(script, diary, config, "with skipped steps", STEPS)
    compare_latents(script, diary)


@script("LOOP-41", uses=["run"], level=0)
def a_skipped_step_stops_the_run(script: Script) -> None:
    """The sixth train step meets a loss that is not finite: the run ends with an error, and not by going on."""
    with runs_of(script) as runs:
        try:
            runs.play("run", config_of(script), skips=range(5, 10**6))
        except NotImplementedError:
            raise
        except Exception as error:
            script.holds("the error has a message", bool(str(error)))
        else:
            script.holds("a run with a loss that is not finite ends with an error", False)


@script("LOOP-20", uses=["run"], level=0)
def scores_are_plain_sums(script: Script) -> None:
    """The score of a training episode is the sum of its rewards, its length the number of its records."""
    with runs_of(script) as runs:
        diary = runs.play("run", config_of(script))
    if not diary.result or "episodes" not in diary.result:
        raise NotImplementedError("run returns no scores")
    expected: list[tuple[float, int]] = []
    under_way: dict[int, tuple[float, int]] = {}
    for record in records_of(script, diary):
        score, length = (0.0, 0) if record.is_first else under_way[record.worker]
        under_way[record.worker] = score + record.reward, length + 1
        if record.is_last:
            expected.append(under_way[record.worker])
    script.exact("scores and lengths", diary.result["episodes"], expected)
