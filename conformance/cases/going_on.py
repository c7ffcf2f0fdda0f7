"""Checks of a running loop beside and after its ordinary steps: evaluation, a run that is continued, one that begins
with the parameters of another, and environments that fail."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from conformance.cases.running_loop import (
    compare_batches,
    compare_carries,
    compare_episode_seeds,
    compare_events,
    compare_latents,
    compare_learning,
    compare_train_steps,
    derived,
    learning,
)
from conformance.check import script
from conformance.running.diary import Act, Diary, Frame
from conformance.running.environment import HIGH, LOW, World
from conformance.running.playing import STEPS, Runs, config_of, runs_of
from conformance.running.records import records_of
from conformance.script import Script
from spec import Config

EPISODES = 4  # of an evaluation: more than the workers, and no multiple of them
EVALUATED: dict[str, Any] = {"evaluate_every": 25, "evaluation_episodes": EPISODES}
SHARED: dict[str, Any] = {"shared_environment": True, "evaluation_episodes": 2}
SHORT = World(longest=2)


def evaluated(script: Script, runs: Runs, config: Config, **options: Any) -> tuple[Diary, Diary, list[list[Act]]]:
    """A run without evaluations, one with them, and the policy steps of each evaluation."""
    plain = runs.play("plain", config, SHORT)
    diary = runs.play("evaluated", config, SHORT, **{**EVALUATED, **options})
    training = {key for act in plain.acts for key in act.keys}
    evaluations: list[list[Act]] = []
    begins = True
    for event in learning(diary):
        is_evaluation = isinstance(event, Act) and training.isdisjoint(event.keys)
        if isinstance(event, Act) and is_evaluation:
            evaluations += [[]] if begins else []
            evaluations[-1].append(event)
        begins = not is_evaluation
    script.holds("there were two evaluations or more", len(evaluations) > 1)
    return plain, diary, evaluations


def without(diary: Diary, evaluations: list[list[Act]]) -> Diary:
    """The diary of training alone."""
    left_out = {id(act) for acts in evaluations for act in acts}
    return dataclasses.replace(diary, events=[event for event in diary.events if id(event) not in left_out])


@script("LOOP-18", "LOOP-19", uses=["run"], level=0)
def evaluation_changes_nothing(script: Script) -> None:
    """All that the learner gets in training is what it gets without evaluations. These begin with resets, and go on
    with a carry of their own."""
    with runs_of(script) as runs:
        plain, diary, evaluations = evaluated(script, runs, config_of(script))
    compare_learning(script, "training", without(diary, evaluations), plain)
    for number, acts in enumerate(evaluations):
        script.holds(f"evaluation {number} begins with resets", acts[0].is_first)
        compare_carries(script, diary, acts)


@script("LOOP-66", uses=["run"], level=0)
def a_shared_environment_changes_nothing(script: Script) -> None:
    """With one environment for training and evaluation, training gets the episodes that it gets with two, and an
    evaluation begins where one of these has ended."""
    with runs_of(script) as runs:
        plain, diary, evaluations = evaluated(script, runs, config_of(script, envs=1), **SHARED)
    script.exact("environments that were reset", diary.environments, 1)
    compare_learning(script, "training", without(diary, evaluations), plain)
    begun = {acts[0].keys[0] for acts in evaluations[:-1]}  # the last one may abandon an episode
    for before, frame in itertools.pairwise(diary.frames):
        if frame.key in begun:
            script.holds("an evaluation begins where an episode has ended", before.terminated or before.truncated)


@script("LOOP-18", "LOOP-19", "LOOP-33", uses=["run"], level=0)
def evaluations_play_new_episodes_with_fresh_noise(script: Script) -> None:
    """No two resets of a run have the same seed, nor two policy steps, whether in training or in evaluation; also where
    it was continued between two evaluations."""
    with runs_of(script) as runs:
        config, options = config_of(script, envs=2), {**EVALUATED, "evaluate_every": 20}
        parts = [runs.play("run", config, SHORT, steps=steps, **options) for steps in (40, 80)]
    acts = [act.seed for part in parts for act in part.acts]
    # What is repeated to bring an environment back is the same episode.
    resets = [frame.seed for part in parts for frame in part.frames if frame.is_reset]
    brought_back = {frame.seed for frame in parts[0].frames if frame.is_reset and is_under_way(frame, parts[0])}
    script.exact("different seeds of policy steps", len(set(acts)), len(acts))
    script.holds("resets have seeds", None not in resets)
    again = sum(seed in brought_back for seed in set(resets) if resets.count(seed) == 2)
    script.exact("different seeds of resets", len(set(resets)), len(resets) - again)


def is_under_way(reset: Frame, diary: Diary) -> bool:
    """Whether the episode of a reset is the last of its environment."""
    own = [frame for frame in diary.frames if frame.environment == reset.environment and frame.is_reset]
    return own[-1] is reset


@script("LOOP-25", "LOOP-26", "LOOP-33", uses=["run", "derive_seed"], level=0)
def evaluations_have_the_seeds_of_the_tables(script: Script) -> None:
    """Every policy step of evaluation has the seed of its number, and every episode of each environment that of
    its own."""
    with runs_of(script) as runs:
        _, diary, evaluations = evaluated(script, runs, config_of(script))
    seed = script.setting.seed
    acts = [act for those in evaluations for act in those]
    expected = [derived(script, seed, "evaluation", number) for number in range(len(acts))]
    script.exact("seeds of evaluation", [act.seed for act in acts], expected)
    resets = {frame.key: frame.seed for frame in diary.frames if frame.is_reset}
    for number, own in enumerate(evaluations):
        for row in range(len(own[0].keys)):
            worker = derived(script, seed, "evaluation_environment", row + len(own[0].keys) * number)
            played = [resets[act.keys[row]] for act in own if act.is_first[row]]
            expected = [derived(script, worker, "episode", episode) for episode in range(len(played))]
            script.exact(f"seeds of the episodes in row {row} of evaluation {number}", played, expected)


@script("LOOP-26", "LOOP-33", uses=["run", "derive_seed"], level=0)
def the_random_policy_draws_for_every_environment(script: Script) -> None:
    """Before the first policy step each environment plays episodes of its own seeds, with actions of its own that its
    spaces allow; and the run is what it is without them."""
    with runs_of(script) as runs:
        plain = runs.play("plain", config_of(script), SHORT)
        diary = runs.play("random", config_of(script), SHORT, random_episodes=6)
    compare_learning(script, "the run", diary, plain)
    acted = {key for act in plain.acts for key in act.keys}
    first = next(number for number, event in enumerate(diary.events) if isinstance(event, Act))
    frames = [event for event in diary.events[:first] if isinstance(event, Frame) and event.key not in acted]
    environments = list(dict.fromkeys(frame.environment for frame in frames))
    script.holds("several environments play at random", len(environments) > 1)
    played = {number: [frame for frame in frames if frame.environment == number] for number in environments}
    for row, own in enumerate(played.values()):
        worker = derived(script, script.setting.seed, "random_environment", row)
        seeds = [frame.seed for frame in own if frame.is_reset]
        expected = [derived(script, worker, "episode", episode) for episode in range(len(seeds))]
        script.exact(f"seeds of the episodes of environment {row}", seeds, expected)
    actions = [frame.action["steer"] for frame in frames if frame.action]
    script.holds("steer is in its range", np.all((LOW["steer"] <= actions) & (actions <= HIGH["steer"])))
    script.exact("different actions of all steps", len({tuple(action) for action in actions}), len(actions))


@script("LOOP-20", uses=["run"], level=0)
def an_evaluation_is_the_mean_of_whole_episodes(script: Script) -> None:
    """Its score is that of as many episodes as were asked for, each the plain sum of its rewards."""
    with runs_of(script) as runs:
        _, diary, evaluations = evaluated(script, runs, config_of(script))
    if not diary.result or "evaluations" not in diary.result:
        raise NotImplementedError("run returns no scores")
    means = diary.result["evaluations"]
    script.exact("evaluations", len(means), len(evaluations))
    for number, (mean, acts) in enumerate(zip(means, evaluations, strict=True)):
        scores = scores_of(diary, {key for act in acts for key in act.keys if key[3] == 0})
        possible = [np.mean(chosen) for chosen in itertools.combinations(scores, EPISODES)]
        where = f"evaluation {number} has a mean of {EPISODES} of its {len(scores)} whole episodes, got {mean}"
        script.holds(where, bool(possible) and np.min(np.abs(np.array(possible) - mean)) < 1e-9)


def scores_of(diary: Diary, begun: set[Any]) -> list[float]:
    """The sums of rewards of the episodes that began with these observations and have ended."""
    scores, total = [], dict[int, float]()
    for frame in diary.frames:
        if frame.is_reset:
            total.pop(frame.environment, None)
            if frame.key in begun:
                total[frame.environment] = 0.0
        elif frame.environment in total:
            total[frame.environment] += frame.reward
            if frame.terminated or frame.truncated:
                scores.append(total.pop(frame.environment))
    return scores


RESUMED = ("LOOP-21", "LOOP-23", "LOOP-34", "REP-23", "REP-29", "REP-33")


@script(*RESUMED, uses=["run"], level=0)
def a_continued_run_is_the_run_in_one_go(script: Script) -> None:
    """Where environments can be brought back, every policy step and every train step after it gets what it would have
    got, and the training state at the end is the same: with more new sequences than batches have room for, and with a
    buffer that has been full, twice in a row."""
    with runs_of(script) as runs:
        for name, config, parts in (
            ("three workers", config_of(script, replay_ratio=0.6), (60, 120)),
            ("one full buffer", config_of(script, envs=1, replay_ratio=7.0, replay_capacity=70), (90, 140, 200)),
        ):
            whole = runs.play(f"{name} in one go", config, steps=parts[-1])
            played = [runs.play(name, config, steps=steps) for steps in parts]
            for part in played[1:]:
                if part.acts[0].is_first.all() and is_fresh(part, played):
                    raise NotImplementedError("a continued run that repeats the episodes under way")
            first, *later = (learning(part) for part in played)
            compare_events(script, f"{name}, continued", [*first, *itertools.chain(*later)], learning(whole))
            for state, array in whole.last_state.items():
                script.exact(f"{name}, {state} at the end", played[-1].last_state[state], array)


def is_fresh(part: Diary, parts: Sequence[Diary]) -> bool:
    """Whether a part of a run begins with episodes that no earlier one has begun."""
    earlier = {frame.key for one in parts[: parts.index(part)] for frame in one.frames}
    return earlier.isdisjoint(part.acts[0].keys)


ANEW = ("LOOP-21", "LOOP-23", "LOOP-26", "REP-25")


@script(*ANEW, uses=["run"], level=0)
def environments_that_lead_elsewhere_begin_anew(script: Script) -> None:
    """Where the same actions lead elsewhere, a continued run begins with resets, fresh carries and new streams, and
    goes on with its training state and its counters."""
    with runs_of(script) as runs:
        config = config_of(script, replay_ratio=5.0)
        parts = [runs.play("run", config, World(repeatable=False), steps=steps) for steps in (42, 81, 120)]
    for before, part in itertools.pairwise(parts):
        script.holds("a continued run begins with resets", part.acts[0].is_first)
        script.exact("its carry is fresh", part.acts[0].carry, np.zeros(config.envs))
        assert part.first_state is not None
        for name, array in before.last_state.items():
            script.exact(f"{name} is as it was", part.first_state[name], array)
    compare_train_steps(script, joined(parts), config, "the run in three parts", 120)
    compare_batches(script, joined(parts), config)
    compare_latents(script, joined(parts))
    seeds = [event.seed for event in learning(joined(parts))]
    script.exact("different seeds of policy steps and train steps", len(set(seeds)), len(seeds))
    acted = {key for part in parts for act in part.acts for key in act.keys}
    resets = [frame.seed for part in parts for frame in part.frames if frame.is_reset and frame.key in acted]
    script.exact("different seeds of the episodes that were played", len(set(resets)), len(resets))


def joined(parts: Sequence[Diary]) -> Diary:
    """One diary of several parts, each with environments of its own."""
    events: list[Any] = []
    latents: dict[int, Any] = {}
    first = 0
    for part in parts:
        for event in part.events:
            if isinstance(event, Frame):
                event = dataclasses.replace(event, environment=event.environment + first)
            events.append(event)
        first += part.environments
        latents |= part.latents
    return Diary(events, first, latents=latents)


@script("LOOP-26", uses=["run", "derive_seed"], level=0)
def environments_that_begin_anew_have_the_seeds_of_their_start(script: Script) -> None:
    """The seeds of the workers count the starts of a run that was continued twice with new episodes."""
    with runs_of(script) as runs:
        config = config_of(script)
        parts = [runs.play("run", config, World(repeatable=False), steps=steps) for steps in (30, 60, 90)]
    for start, part in enumerate(parts):
        indices = [worker + config.envs * start for worker in range(config.envs)]
        seeds = [derived(script, script.setting.seed, "environment", index) for index in indices]
        compare_episode_seeds(script, records_of(script, part), seeds)


@script("LOOP-72", uses=["run"], level=0)
def a_warm_start_takes_over_what_was_learned(script: Script) -> None:
    """Parameters, slow critic and return range of the other run, bit for bit; the optimizer, the buffer and all
    counters begin anew."""
    with runs_of(script) as runs:
        config = config_of(script)
        other = runs.play("other", config)
        fresh = runs.play("fresh", config, seed=script.setting.seed + 1)
        warm = runs.play("warm", config, seed=script.setting.seed + 1, begin_with=runs.directory("other"))
    assert fresh.first_state is not None
    assert warm.first_state is not None
    script.exact("names of the training state", sorted(warm.first_state) == sorted(fresh.first_state), True)
    for name, array in warm.first_state.items():
        taken = name.startswith(("params/", "slow_critic/", "return_range/"))
        script.exact(name, array, (other.last_state if taken else fresh.first_state)[name])
    script.exact("seeds", [event.seed for event in learning(warm)], [event.seed for event in learning(fresh)])
    compare_train_steps(script, warm, config, "the new run", STEPS)
    compare_batches(script, warm, config)


FAILS = World(fails=(1, 9))


@script("LOOP-32", "REP-16", uses=["run"], level=0)
def a_failed_environment_is_replaced(script: Script) -> None:
    """One that raises gives way to a new one, whose reset takes the place of the missing record; the others go on as
    they would have, and batches end the episode that was abandoned."""
    with runs_of(script) as runs:
        config = config_of(script, replay_ratio=0.0)
        whole, failing = runs.play("whole", config), runs.play("failing", config, FAILS)
        trained = config_of(script)
        learned = runs.play("trained", trained, FAILS)
    expected, records = records_of(script, whole), records_of(script, failing)
    script.exact("records", len(records), len(expected))
    script.exact("environments that failed", len(failing.failed), 1)
    broken = next(record.row for record in records if record.frame.environment == failing.failed[0])
    for record, right in zip(records, expected, strict=True):
        if record.row != broken:
            script.exact(f"policy step {record.act}, row {record.row}", record.frame.key, right.frame.key)
    new = [one.is_first for one in records if one.row == broken and one.frame.environment > failing.failed[0]]
    script.holds("a new environment takes the place of the one that failed, and begins an episode", new[:1] == [True])
    compare_train_steps(script, learned, trained, "with an environment that fails", STEPS)
    compare_batches(script, learned, trained)


@script("LOOP-32", uses=["run", "derive_seed"], level=0)
def a_replaced_environment_has_the_seed_of_its_restart(script: Script) -> None:
    """The worker's seed is derived from the one before, and those of the new environment's episodes follow from it."""
    with runs_of(script) as runs:
        diary = runs.play("run", config_of(script), FAILS)
    records = records_of(script, diary)
    row = next(record.row for record in records if record.frame.environment == diary.failed[0])
    seed = derived(script, derived(script, script.setting.seed, "environment", row), "restart", 0)
    new = [one for one in records if one.row == row and one.frame.environment != diary.failed[0] and one.is_first]
    expected = [derived(script, seed, "episode", number) for number in range(len(new))]
    script.holds("a new environment has begun an episode", new)
    script.exact("seeds of the episodes of the new environment", [record.frame.seed for record in new], expected)
