"""Checks of spec/12-training-loop.md: what a training loop must compute exactly. What only a running loop shows is in
running_loop.py and going_on.py, and tested in tests/."""

import hashlib
import json
from fractions import Fraction
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Equal, Setting, equal, exact, exactly, judged, refused
from conformance.check import check, script
from conformance.compare import Comparisons
from conformance.problems import small_config
from conformance.script import Script
from conformance.strategies import seeds
from conformance.worked import worked, worked_cases
from spec import Discrete, Spaces, Vector, load_config

TASK = Spaces({"x": Vector(1)}, {"turn": Vector(4), "buttons": Discrete((2, 3))})


@script("LOOP-14", uses=["ReplayRatio"], level=0)
def train_steps_by_hand(script: Script) -> None:
    """The worked numbers of the chapter: ratio 1.5 with batches of 4 steps, and the totals at the paper's sizes."""
    names = ("no drift", "totals", "sixteen workers", "a high ratio", "steps that jump and stand still")
    for case in worked("training_loop", *names):
        ratio = script.call("ReplayRatio", *case.arguments)
        steps = [ratio(*call.arguments) for call in case.calls]
        script.exact(f"ReplayRatio, {case.name}", steps, [call.expected for call in case.calls])
    ratio = script.call("ReplayRatio", 32.0, 1024)
    steps = [ratio(2048 + k) for k in range(65)]
    script.exact("sixteen workers, step by step", steps, [1, *([0] * 31 + [1]) * 2])


@script("LOOP-14", "LOOP-15", uses=["ReplayRatio"], level=0)
def train_steps_do_not_drift(script: Script) -> None:
    """After any steps the sum is 1 + floor((t - t0) ratio / batch steps) with the exact value of the ratio's
    float64."""

    @script.for_all(
        ratio=st.one_of(st.sampled_from([0.1, 0.3, 1 / 3, 7.3, 1e-7, 512.0]), st.floats(1e-3, 1e4)),
        batch=st.sampled_from([1, 3, 1024]),
        start=st.sampled_from([0, 1, 1088, 10**9]),
        stride=st.sampled_from([1, 2, 16, 10**6]),
    )
    def _(ratio: float, batch: int, start: int, stride: int) -> None:
        counter = script.call("ReplayRatio", ratio, batch)
        steps = [start + stride * k for k in range(200)]
        expected = [1 + (step - start) * Fraction(ratio) // batch for step in steps]
        script.exact("train steps", np.cumsum([counter(step) for step in steps]), expected)


@script("LOOP-16", uses=["ReplayRatio"], level=0)
def no_training_and_no_way_back(script: Script) -> None:
    """A ratio of 0 never trains, not even at the first call; a step smaller than the remembered one is refused with any
    ratio."""
    never = script.call("ReplayRatio", 0.0, 1024)
    script.exact("ratio 0", [never(step) for step in (0, 1, 2000, 10**7)], [0, 0, 0, 0])
    script.holds("ratio 0 remembers no step", never.state_dict()["step"] is None)
    counter, resumed = script.call("ReplayRatio", 1.0, 4), script.call("ReplayRatio", 0.0, 4)
    counter(10)
    resumed.load_state_dict(counter.state_dict())
    for ratio in (counter, resumed):
        try:
            ratio(9)
        except ValueError as error:
            script.holds("the error has a message", bool(str(error)))
        else:
            script.holds("step 9 after 10 is refused", False)


@script("LOOP-16", "LOOP-23", uses=["ReplayRatio"], level=0)
def a_pause_is_never_paid_for(script: Script) -> None:
    """What was collected with ratio 0 gives no credit to the ratio that follows; the credit from before is kept."""
    paying = script.call("ReplayRatio", 1.0, 1024)
    paying(0), paying(1000)
    paused = script.call("ReplayRatio", 0.0, 1024)
    paused.load_state_dict(json.loads(json.dumps(paying.state_dict())))
    script.exact("the pause", [paused(step) for step in (1000, 5000, 200_000)], [0, 0, 0])
    script.holds(
        f"{paused.state_dict()} is step 200000, credit 1000",
        dict(paused.state_dict()) == {"step": 200_000, "credit": "1000"},
    )
    paying.load_state_dict(json.loads(json.dumps(paused.state_dict())))
    script.exact("after it", [paying(step) for step in (200_000, 200_023, 200_024, 201_047, 201_048)], [0, 0, 1, 0, 1])
    large = script.call("ReplayRatio", 0.0, 4)
    large.load_state_dict({"step": 10, "credit": "7"})
    script.exact("a credit saved with larger batches", large(20), 0)


@script("LOOP-21", "LOOP-23", uses=["ReplayRatio"], level=0)
def the_replay_ratio_goes_on(script: Script) -> None:
    """Its state is exact and survives JSON; a loaded counter goes on as the saved one does, without another first train
    step."""
    counter = script.call("ReplayRatio", 0.5, 4)
    script.holds("no step before the first call", counter.state_dict()["step"] is None)
    counter(100), counter(107)
    script.holds(
        f"{counter.state_dict()} is step 107, credit 7/2", dict(counter.state_dict()) == {"step": 107, "credit": "7/2"}
    )

    @script.for_all(ratio=st.sampled_from([0.3, 0.1, 32.0]), calls=st.integers(0, 5), later=st.sampled_from([0.3, 5.0]))
    def _(ratio: float, calls: int, later: float) -> None:
        counters = [script.call("ReplayRatio", ratio, 7), script.call("ReplayRatio", later, 7)]
        for k in range(calls):
            counters[0](100 + 13 * k)
        saved = json.loads(json.dumps(counters[0].state_dict()))
        counters[0] = script.call("ReplayRatio", later, 7)
        for counter in counters:
            counter.load_state_dict(saved)
        script.exact("two that were loaded", *([counter(step) for step in range(180, 300)] for counter in counters))
        exact, last = Fraction(saved["credit"]), saved["step"]
        counters[0].load_state_dict(saved)
        if last is None:
            script.exact("the first call after an early save", counters[0](180), 1)
        else:
            script.exact("credit in time steps", counters[0](180), (exact + (180 - last) * Fraction(later)) // 7)


@check("LOOP-13", uses=["can_train"], level=0)
def training_starts_with_enough_items(setting: Setting) -> Cases:
    """Training starts with batch size times batch length items, and a buffer that cannot hold them is refused."""
    for batch_size, batch_length in ((16, 64), (3, 5), (1, 1)):
        config = load_config(setting.profile, batch_size=batch_size, batch_length=batch_length)
        needed = batch_size * batch_length
        for items, expected in ((0, False), (needed - 1, False), (needed, True), (10**6, True)):
            yield exact("can_train", (items, config), expected, where=f"{items} of {needed} items")
    for items in (0, 14, 15):
        small = small_config(setting.profile, batch_size=3, batch_length=5, replay_capacity=14)
        yield refused("can_train", items, small)
    enough = small_config(setting.profile, batch_size=3, batch_length=5, replay_capacity=15)
    yield exact("can_train", (15, enough), True, where="just enough")


@check("LOOP-12", "CON-27", uses=["environment_action"], level=0)
def environment_actions_by_hand(setting: Setting) -> Cases:
    """Indices of choices, numbers clipped and scaled to the bounds, to a range 2 wide at a single one, as they are
    where there is none."""
    (example,) = worked("training_loop", "actions of an environment")
    flat, _, low, high = example.arguments

    def has_the_keys(c: Comparisons, result: Any) -> None:
        c.holds("exactly the keys of the task", set(result) == set(TASK.actions))
        dtype = result["buttons"].dtype
        c.holds(f"indices are int64, got {dtype}", dtype == np.int64)

    yield judged("environment_action", example.arguments, exactly(example.expected), has_the_keys)
    yield from worked_cases(setting, "training_loop", "one dimension", bound=4 * setting.u)
    ties = np.array([0.5, 0.5, 0.1, 0.3, 0.3, 0, 0.3, 5, 0])
    where = "the first of equals"
    yield exact("environment_action", (ties, TASK, low, high), [0, 1], at=("buttons",), where=where)
    one = Spaces({"x": Vector(1)}, {"a": Vector(1)})
    for number, bottom, top, expected in ((-1.0, 0.1, 0.3, 0.1), (-1.7, -np.inf, 0.25, -1.75)):
        arguments = (np.array([number]), one, {"a": np.array([bottom])}, {"a": np.array([top])})
        yield equal("environment_action", arguments, {"a": np.array([expected])}, bound=4 * setting.u)

    def last_turn(c: Comparisons, result: Any) -> None:
        c.exact("turn of a batch", result["turn"][1, 2], example.expected["turn"])

    batch = np.stack([[flat, ties, flat], [ties, flat, flat]])
    indices = [[[1, 2], [0, 1], [1, 2]], [[0, 1], [1, 2], [1, 2]]]
    buttons = exactly(indices, ("buttons",), "buttons of a batch")
    yield judged("environment_action", (batch, TASK, low, high), buttons, last_turn)


@check("LOOP-12", uses=["environment_action"], level=0)
def environment_actions_stay_within_bounds(setting: Setting) -> Cases:
    """Whatever is sampled, the environment gets low + (a + 1) / 2 (high - low) of the clipped number, never outside the
    bounds."""
    one = Spaces({"x": Vector(1)}, {"a": Vector(5)})

    def case(seed: int, scale: float, size: float) -> Cases:
        rng = np.random.default_rng(seed)
        low = np.float32(rng.normal(size=5) * size).astype(np.float64)
        high = low + np.float32(rng.random(5) * size)
        flat = rng.normal(size=(3, 5)) * scale
        expected = low + (np.clip(flat, -1, 1) + 1) / 2 * (high - low)
        right = Equal(expected, ("a",), where="a", magnitude=np.abs(low) + np.abs(high), bound=8 * setting.u)

        def within(c: Comparisons, result: Any) -> None:
            c.holds("within the bounds", (np.asarray(result["a"]) >= low) & (np.asarray(result["a"]) <= high))

        yield judged("environment_action", (flat, one, {"a": low}, {"a": high}), right, within)

    scales, sizes = st.sampled_from([0.1, 1.0, 100.0]), st.sampled_from([1e-3, 1.0, 1e6])
    yield Drawn(case, seed=seeds(), scale=scales, size=sizes)


@check("LOOP-12", "CON-8", uses=["environment_action"], level=0)
def broken_actions_are_refused(setting: Setting) -> Cases:
    """A number that is not finite, wherever it is, and a flat action of another length are refused."""
    low, high = {"turn": np.zeros(4)}, {"turn": np.ones(4)}
    for index in (0, 4, 5, 8):
        for value in (np.nan, np.inf, -np.inf):
            flat = np.array([0, 1, 0, 0, 1, 0.5, -1.7, -0.25, 1.7])
            flat[index] = value
            yield refused("environment_action", flat, TASK, low, high)
    for size in (8, 10):
        yield refused("environment_action", np.zeros(size), TASK, low, high)


@check("LOOP-7", "LOOP-10", "CON-11", uses=["step_flags"], level=0)
def flags_by_hand(setting: Setting) -> Cases:
    """A reset is first and nothing else; an end is last by either reason, and terminal by termination alone."""
    examples = [(case.arguments, case.expected) for case in worked("training_loop", "flags of a step")]
    a_reset = examples[0][1]
    for arguments, expected in (*examples, ((True, True, True), a_reset)):
        for kind in (bool, np.bool_):
            yield exact("step_flags", tuple(map(kind, arguments)), expected)


RECORD = ("LOOP-3", "LOOP-9", "LOOP-10", "CON-9", "CON-10", "CON-27", "REP-6", "REP-19")


@script(*RECORD, uses=["make_record", "step_flags"], level=0)
def records_by_hand(script: Script) -> None:
    """A record holds what arrived, the raw action and the latents as indices; no reward at a reset, no action at an
    end; copies."""
    x, action = np.array([4.0], np.float32), np.array([1.75, -3.0], np.float32)
    deter, stoch = np.array([0.5, 0.25], np.float32), np.eye(3)[[2, 0]]
    plain: dict[str, Any] = {"x": [4], "reward": 2.5, "action": [1.75, -3], "deter": [0.5, 0.25], "stoch": [2, 0]}
    types = {
        **dict.fromkeys(("reward", "action", "deter"), "float32"),
        **dict.fromkeys(("is_first", "is_last"), "bool"),
    }
    for flags, changes in (
        ((False, False, False), {}),
        ((True, False, False), {"reward": 0.0}),
        ((False, True, False), {"action": [0, 0]}),
        ((False, False, True), {"action": [0, 0]}),
    ):
        step = script.call("step_flags", *flags)
        made = script.call("make_record", {"x": x}, 2.5, step, action, deter, stoch)
        script.holds(f"the keys {sorted(made)}", set(made) == {*plain, *step})
        for key, value in {**plain, **step, **changes}.items():
            script.exact(f"{key} with the flags {flags}", made[key], value)
        for key, dtype in types.items():
            script.holds(f"{key} is {dtype}", made[key].dtype == dtype)
        script.holds("stoch holds integers", made["stoch"].dtype.kind in "iu")
    step = script.call("step_flags", False, False, False)
    made = script.call("make_record", {"x": x}, 2.5, step, action, deter, stoch)
    for array in (x, action, deter):
        array[...] = 9
    for key in ("x", "action", "deter"):
        script.exact(f"{key} after the argument was overwritten", made[key], plain[key])


@check("LOOP-24", "LOOP-25", uses=["derive_seed"], level=0)
def seeds_by_hand(setting: Setting) -> Cases:
    """The seeds of the chapter, and those that SHA-256 gives for any other seed, purpose and index."""
    yield from worked_cases(setting, "training_loop", "seeds")

    def case(seed: int, purpose: str, index: int) -> Cases:
        first = hashlib.sha256(f"{seed}/{purpose}/{index}".encode()).digest()[:4]
        expected = (first[0] & 127) << 24 | first[1] << 16 | first[2] << 8 | first[3]
        yield exact("derive_seed", (seed, purpose, index), expected, where=f"derive_seed({seed}, {purpose}, {index})")

    purposes = st.sampled_from(["policy", "replay", "evaluation"])
    yield Drawn(case, seed=st.integers(0, 2**40), purpose=purposes, index=st.integers(0, 2**40))
