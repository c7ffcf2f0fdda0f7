"""Checks of spec/08-behavior.md."""

import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Equal, Setting, equal, exact, exactly, judged, refused, related
from conformance.cases.agent import WHOLE, problem_of
from conformance.cases.distributions import LITERAL
from conformance.check import check
from conformance.compare import Comparisons, round_to
from conformance.problems import action_noise, small_config
from conformance.strategies import normals, seeds
from conformance.worked import worked, worked_cases
from reference_numpy import behavior as reference
from reference_numpy import distributions
from spec import Config, Discrete, Spaces, Vector

LEADING = st.sampled_from([(), (2, 3)])
# Given unsorted; in sorted order Aim, buttons, one, turn: 1 + 5 + 1 + 2 numbers in a flat action, 1 + 2 + 1 + 2 in its
# noise.
TASK = Spaces(
    {"x": Vector(1)}, {"turn": Vector(2), "buttons": Discrete((2, 3)), "one": Discrete((1,)), "Aim": Vector(1)}
)
DISCRETE = Spaces({"x": Vector(1)}, {"action": Discrete((2,))})


def random_outputs(
    setting: Setting, seed: int, leading: tuple[int, ...], scale: float
) -> dict[str, dict[str, np.ndarray]]:
    """Raw actor outputs of TASK."""
    rng = np.random.default_rng(seed)
    sizes = {
        "Aim": {"mean": 1, "std": 1},
        "buttons": {"logits": 5},
        "one": {"logits": 1},
        "turn": {"mean": 2, "std": 2},
    }
    return {
        key: {name: setting.cast(rng.normal(0, scale, (*leading, n))) for name, n in names.items()}
        for key, names in sizes.items()
    }


def config_of(setting: Setting, **overrides: Any) -> Config:
    return small_config(setting.profile, setting.dtype, **overrides)


def safe_noise(setting: Setting, seed: int, outputs: Any, leading: tuple[int, ...], config: Config) -> np.ndarray:
    """[..., K] noise whose uniforms are not near a boundary: moving them a little changes no class."""
    rng = np.random.default_rng(seed)
    for _ in range(100):
        noise = setting.cast(action_noise(rng, TASK, leading))
        moved = np.array([0, 1e-3, 1e-3, 1e-3, 0, 0])
        below, above = (reference.sample_action(outputs, noise + sign * moved, TASK, config) for sign in (-1, 1))
        if np.array_equal(below, above):
            return noise
    raise RuntimeError("no noise with a margin was found")


def log_prob_magnitude(outputs: Any, action: np.ndarray, config: Config) -> np.ndarray:
    """The sum of the magnitudes of all terms of a log-probability."""
    size = 20 + 2 * np.ptp(outputs["buttons"]["logits"], -1)
    for key, part in (("Aim", action[..., :1]), ("turn", action[..., 7:])):
        mean, std = distributions.bounded_normal(
            outputs[key]["mean"], outputs[key]["std"], config.actor_min_std, config.actor_max_std
        )
        size = size + (0.5 * ((np.abs(part) + np.abs(mean)) / std) ** 2 + np.abs(np.log(std)) + 1).sum(-1)
    return size


@check("BEH-1", "BEH-2", "BEH-3", "CON-19", "CON-25", "CON-26", "CON-27", uses=["sample_action"], level=0)
def action_literals(setting: Setting) -> Cases:
    """Noise and action follow the sorted keys; each entry has its own segment; a sample of 3 standard deviations is not
    clipped."""
    config = config_of(setting, actor_unimix=0.01, actor_min_std=0.25, actor_max_std=0.25)
    outputs = {
        "turn": {"mean": np.array([0.0, -30]), "std": np.zeros(2)},
        "one": {"logits": np.array([-5.0])},
        "buttons": {"logits": np.array([0.0, 0, 0, 0, 60])},
        "Aim": {"mean": np.array([30.0]), "std": np.zeros(1)},
    }
    # Aim: 1 + 3/4. Buttons: 0.75 of (1/2, 1/2) and 0.25 of (0, 0, 1). One: its uniform is consumed. Turn: 0 + 1/2 and
    # -1 - 1.
    for noise, expected in (
        ([3.0, 0.75, 0.25, 0.875, 2.0, -4.0], [1.75, 0, 1, 0, 0, 1, 1, 0.5, -2]),
        ([3.0, 0.25, 0.001, 0.875, 2.0, -4.0], [1.75, 1, 0, 1, 0, 0, 1, 0.5, -2]),
    ):
        arguments = outputs, np.array(noise), TASK, config
        yield equal("sample_action", arguments, np.array(expected), magnitude=1.0, bound=16 * setting.u)


@check(
    "BEH-2", "BEH-3", "BEH-6", "BEH-7", "DIS-7", uses=["sample_action", "action_log_prob", "action_entropy"], level=0
)
def discrete_literals(setting: Setting) -> Cases:
    """Logits ln 3, 0 with 1 percent uniform: 0.7475 and 0.2525, boundary at 0.7475, log-probabilities and entropy of
    the mixture."""
    yield from worked_cases(setting, "behavior", "a choice of two", "a single class takes its uniform")
    choices = ("log-probabilities of a choice", "the entropy of a choice")
    yield from worked_cases(setting, "behavior", *choices, bound=LITERAL[setting.dtype])
    config, plain = (config_of(setting, actor_unimix=share) for share in (0.01, 0.0))
    # Far logits: finite log-probabilities without the mixture, a floor of ln(u/C) with it; probability 0 has no
    # entropy.
    far, second = {"action": {"logits": np.array([1000.0, 0])}}, np.array([0.0, 1])
    yield equal("action_log_prob", (far, second, DISCRETE, plain), -1000.0, bound=16 * setting.u)
    yield equal("action_log_prob", (far, second, DISCRETE, config), math.log(0.005), bound=16 * setting.u)
    certain = {"action": {"logits": np.array([0, -np.inf])}}
    yield exact("action_entropy", (certain, DISCRETE, plain), 0.0, where="entropy of certainty")


@check("BEH-4", "BEH-6", "BEH-7", "CON-18", uses=["sample_action", "action_log_prob", "action_entropy"], level=0)
def continuous_literals(setting: Setting) -> Cases:
    """Raw 0, 0 and the normal 1.5: action 1.339076, log-density -1.930453, entropy 1.305453; narrow normals have
    negative entropy."""
    of_one = ("a normal action", "the log-density of a normal action", "entropies of a normal action")
    of_several = ("an action of several keys", "the log-probability of several keys", "the entropy of several keys")
    yield from worked_cases(setting, "behavior", *of_one, *of_several, bound=LITERAL[setting.dtype])


@check("BEH-1", "BEH-2", "BEH-3", "BEH-4", "BEH-22", "CON-16", uses=["sample_action"], level=0)
def actions_match(setting: Setting) -> Cases:
    """Actions of several keys, any leading axes, sharp and flat outputs, any mixture and deviation."""

    def case(seed: int, leading: tuple[int, ...], scale: float, unimix: float) -> Cases:
        config = config_of(setting, actor_unimix=unimix, actor_max_std=2.0)
        outputs = random_outputs(setting, seed, leading, scale)
        noise = safe_noise(setting, seed, outputs, leading, config)
        expected = reference.sample_action(outputs, noise, TASK, config)
        size = 1 + 2 * np.abs(expected)
        yield equal("sample_action", (outputs, noise, TASK, config), expected, magnitude=size, bound=16 * setting.u)

    yield Drawn(
        case, seed=seeds(), leading=LEADING, scale=st.sampled_from([0.5, 4.0]), unimix=st.sampled_from([0.0, 0.01, 0.5])
    )


@check("BEH-2", "BEH-4", "BEH-6", "BEH-7", "BEH-22", uses=["action_log_prob", "action_entropy"], level=0)
def log_prob_and_entropy_match(setting: Setting) -> Cases:
    """Sums over keys, entries and dimensions of any action, also of one far from the mean."""

    def case(seed: int, leading: tuple[int, ...], scale: float, unimix: float) -> Cases:
        config = config_of(setting, actor_unimix=unimix, actor_min_std=0.05)
        outputs = random_outputs(setting, seed, leading, scale)
        noise = action_noise(np.random.default_rng(seed), TASK, leading)
        action = setting.cast(reference.sample_action(outputs, noise, TASK, config))
        action[..., :1] *= seed % 3
        action[..., 7:] *= seed % 3
        size = log_prob_magnitude(outputs, action, config)
        expected = reference.action_log_prob(outputs, action, TASK, config)
        yield equal("action_log_prob", (outputs, action, TASK, config), expected, magnitude=size, bound=16 * setting.u)
        expected = reference.action_entropy(outputs, TASK, config)
        size = np.abs(expected) + 20
        yield equal("action_entropy", (outputs, TASK, config), expected, magnitude=size, bound=16 * setting.u)

    yield Drawn(
        case,
        seed=seeds(),
        leading=LEADING,
        scale=st.sampled_from([0.5, 4.0, 60.0]),
        unimix=st.sampled_from([0.0, 0.01, 0.5]),
    )


@check("BEH-6", "DIS-10", uses=["action_log_prob"], level=0)
def blanked_actions_count_nothing(setting: Setting) -> Cases:
    """The zeros that stand for an action before the first step of an episode: no class of theirs is counted."""
    config, outputs = config_of(setting, actor_min_std=0.05), random_outputs(setting, setting.seed, (3,), 1.0)
    action = np.zeros((3, TASK.action_size))
    expected, size = (
        reference.action_log_prob(outputs, action, TASK, config),
        log_prob_magnitude(outputs, action, config),
    )
    yield equal("action_log_prob", (outputs, action, TASK, config), expected, magnitude=size, bound=16 * setting.u)


@check("BEH-9", uses=["actor_loss"], level=0)
def actor_loss_literals(setting: Setting) -> Cases:
    """Return 3, value 1, scale 4, weight 0.9: 0.130807. The entropy is rewarded, weighted, and not divided by the
    scale."""
    bound = LITERAL[setting.dtype]
    yield from worked_cases(setting, "behavior", "an actor loss", "entropy in the actor loss", bound=bound)
    yield from worked_cases(setting, "behavior", "what the actor loss rewards")


@check("BEH-9", "BEH-17", "BEH-22", uses=["actor_loss"], level=0)
def actor_loss_matches(setting: Setting) -> Cases:
    """Every entry on its own, without a mean, for any scales."""

    def case(seed: int, scale: float, entropy: float) -> Cases:
        config = config_of(setting, entropy_scale=entropy, actor_scale=3.0)
        log_prob, returns, value = (
            setting.cast(normals(seed + i, 4, 3, scale=s)) for i, s in enumerate((3.0, 50.0, 50.0))
        )
        spread, weight = setting.cast(normals(seed + 3, 4, 3)), setting.cast(np.random.default_rng(seed).random((4, 3)))
        arguments = (log_prob, spread, returns, value, weight, scale, config)
        size = weight * ((np.abs(returns) + np.abs(value)) / scale * np.abs(log_prob) + entropy * np.abs(spread))
        yield equal("actor_loss", arguments, reference.actor_loss(*arguments), magnitude=size, bound=16 * setting.u)

    yield Drawn(case, seed=seeds(), scale=st.sampled_from([1.0, 37.5]), entropy=st.sampled_from([0.0, 3e-4, 0.5]))


def value_logits(setting: Setting, seed: int, shape: tuple[int, int], bins: int, slow: bool) -> np.ndarray:
    """Logits of a critic; those of the slow critic have a peak somewhere, so that their mean is well determined in
    every precision."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 1 if slow else 3, (*shape, bins))
    if slow:
        logits -= np.minimum(2.0 * np.abs(np.arange(bins) - rng.integers(0, bins, (*shape, 1))), 25)
    return setting.cast(logits)


@check("BEH-12", uses=["critic_loss"], level=0)
def critic_loss_literals(setting: Setting) -> Cases:
    """Equal logits cost 2 ln 255 whatever the targets; the slow critic is a target as the two-hot of its mean, not as a
    distribution."""
    examples = ("critic losses at initialization", "critic losses towards a slow critic")
    yield from worked_cases(setting, "behavior", *examples, bound=LITERAL[setting.dtype])


@check("BEH-12", "BEH-14", uses=["replay_critic_loss"], level=0)
def replay_critic_loss_literals(setting: Setting) -> Cases:
    """The same, where the last step of an episode costs nothing."""
    yield from worked_cases(setting, "behavior", "replayed critic losses", bound=LITERAL[setting.dtype])
    slow, is_last = "critic losses towards a slow critic", np.array([[False, True]])
    for case in worked("behavior", slow, profile=setting.profile, dtype=setting.dtype):
        *arrays, _, config = case.arguments
        arguments = (*(np.repeat(setting.cast(x), 2, axis=1) for x in arrays), is_last, config)
        yield equal("replay_critic_loss", arguments, case.expected * ~is_last, bound=LITERAL[setting.dtype])


@check("BEH-12", "BEH-17", "BEH-22", uses=["critic_loss"], level=0)
def critic_loss_matches(setting: Setting) -> Cases:
    """Every entry on its own, over the bins of the configuration, for returns of any size."""
    yield from critic_losses(setting, "critic_loss")


@check("BEH-12", "BEH-14", "BEH-17", "BEH-22", uses=["replay_critic_loss"], level=0)
def replay_critic_loss_matches(setting: Setting) -> Cases:
    """The same, for flags of any type."""
    yield from critic_losses(setting, "replay_critic_loss")


def critic_losses(setting: Setting, function: str) -> Cases:
    def case(seed: int, bins: int, slow_scale: float, flags: type) -> Cases:
        config = config_of(setting, bins=bins, slow_critic_scale=slow_scale, critic_scale=5.0, replay_critic_scale=7.0)
        rng = np.random.default_rng(seed)
        logits = value_logits(setting, seed, (4, 3), bins, slow=False)
        slow = value_logits(setting, seed + 1, (4, 3), bins, slow=True)
        returns = setting.cast(rng.normal(size=(4, 3)) * 10 ** rng.uniform(-3, 9, (4, 3)))
        weight = setting.cast(rng.random((4, 3)))
        is_last: np.ndarray = (rng.random((4, 3)) < 0.4).astype(flags)
        size = (bins + 64) * (2 + np.ptp(logits, -1)) * (2 + np.ptp(slow, -1))
        entries, magnitude = (weight, size * weight) if function == "critic_loss" else (is_last, size)
        arguments = (logits, slow, returns, entries, config)
        yield equal(function, arguments, getattr(reference, function)(*arguments), magnitude=magnitude, bound=setting.u)

    yield Drawn(
        case,
        seed=seeds(),
        bins=st.sampled_from([31, 255]),
        slow_scale=st.sampled_from([0.5, 1.0]),
        flags=st.sampled_from([bool, float]),
    )


@check("BEH-16", "BEH-17", uses=["losses"], level=2, dtypes=WHOLE)
def the_slow_critic_only_regularizes(setting: Setting) -> Cases:
    """Another slow critic changes the two critic losses and nothing else, and with `slow_critic_scale` 0 not even
    these."""
    problem = problem_of(setting, "vector", "discrete")
    params, slow, *rest, config = problem.loss_arguments
    other = {name: value * 0.5 for name, value in slow.items()}

    def regularizes(c: Comparisons, before: Any, after: Any) -> None:
        before, after = before[1], after[1]
        for name, value in before["losses"].items():
            if name in ("critic", "replay_critic"):
                difference = abs(float(value) - float(after["losses"][name]))
                c.holds(f"{name} depends on the slow critic", difference > 1e-3)
            else:
                c.exact(name, after["losses"][name], value)
        for name, value in before["metrics"].items():
            c.exact(name, after["metrics"][name], value)

    yield related(regularizes, *(("losses", (params, critic, *rest, config)) for critic in (slow, other)))

    def same(c: Comparisons, before: Any, after: Any) -> None:
        one, two = before[1]["losses"], after[1]["losses"]
        c.exact("critic losses without the regularizer", [one[name] for name in one], [two[name] for name in one])

    alone = config_of(setting, slow_critic_scale=0.0)
    yield related(same, *(("losses", (params, critic, *rest, alone)) for critic in (slow, other)))


@check("BEH-19", uses=["update_slow_critic"], level=0)
def slow_critic_literals(setting: Setting) -> Cases:
    """1 towards 2 with decay 0.98 is 1.02; decay 1 freezes, decay 0 copies; other parameters are ignored, arguments
    left alone."""
    (case,) = worked("behavior", "an update of the slow critic")
    slow, critic, decay = case.arguments
    params = critic | {"slow_critic": np.zeros(1)}
    magnitude = {name: np.maximum(np.abs(value), np.abs(params[name])) for name, value in slow.items()}
    golden = Equal(case.expected, magnitude=magnitude, bound=4 * setting.u)
    yield judged("update_slow_critic", (slow, params, decay), golden, keeps=True)
    for decay, result in ((1.0, slow), (0.0, params)):
        updated = (exactly(result[name], at=(name,), where=f"{name} with decay {decay}") for name in slow)
        yield judged("update_slow_critic", (slow, params, decay), *updated)


@check("BEH-19", "CON-22", uses=["update_slow_critic"], level=0)
def slow_critic_matches(setting: Setting) -> Cases:
    """Small differences arrive too: float32 or better whatever the compute dtype."""

    def case(seed: int, decay: float, distance: float) -> Cases:
        stored = "float64" if setting.dtype == "float64" else "float32"
        slow = {
            name: round_to(normals(seed + n, 3, n + 1), stored)
            for n, name in enumerate(("critic/x/kernel", "critic/x/bias"))
        }
        params = {
            name: round_to(value + normals(seed + 2, *value.shape, scale=distance), stored)
            for name, value in slow.items()
        }
        magnitude = {name: np.abs(value) + np.abs(params[name]) for name, value in slow.items()}
        expected = reference.update_slow_critic(slow, params, decay)
        yield equal("update_slow_critic", (slow, params, decay), expected, magnitude=magnitude, bound=4 * setting.u)

    yield Drawn(case, seed=seeds(), decay=st.sampled_from([0.98, 0.999, 0.5]), distance=st.sampled_from([1e-3, 1.0]))


@check("BEH-20", uses=["update_slow_critic"], level=0)
def slow_critic_refuses_other_names(setting: Setting) -> Cases:
    """A missing or additional critic parameter, or another shape, is refused."""
    a, b = np.zeros(2), np.zeros((2, 3))
    yield refused("update_slow_critic", {"critic/a": a}, {"critic/a": a, "critic/b": b}, 0.98)
    yield refused("update_slow_critic", {"critic/a": a, "critic/b": b}, {"critic/a": a}, 0.98)
    yield refused("update_slow_critic", {"critic/a": a, "actor/a": a}, {"critic/a": a, "actor/a": a}, 0.98)
    for wrong in (np.zeros(1), np.zeros(3), np.zeros((1, 2)), np.zeros(())):
        yield refused("update_slow_critic", {"critic/a": wrong}, {"critic/a": a}, 0.98)


@check("BEH-24", uses=["actor_loss", "critic_loss", "replay_critic_loss"], level=0)
def behavior_does_not_hide_nan(setting: Setting) -> Cases:
    """A NaN shows at its position, also where the weight is 0 or the step is the last, and nowhere else."""
    config = config_of(setting)
    spoiled, zeros = np.array([[0.0, np.nan], [0, 0]]), np.zeros((2, 2))
    logits = np.zeros((2, 2, config.bins))
    broken = logits.copy()
    broken[0, 1, 3] = np.nan

    def shows(c: Comparisons, loss: np.ndarray) -> None:
        c.exact("where the loss is NaN", np.isnan(loss), np.isnan(spoiled))

    for weight in (zeros, np.ones((2, 2))):
        for place in range(5):
            arrays = [spoiled if place == i else weight if i == 4 else zeros for i in range(5)]
            yield judged("actor_loss", (*arrays, 1.0, config), shows)
        for arguments in ((broken, logits, zeros), (logits, broken, zeros), (logits, logits, spoiled)):
            for function in ("critic_loss", "replay_critic_loss"):
                yield judged(function, (*arguments, weight, config), shows)


@check("BEH-23", "CON-8", uses=["sample_action", "action_log_prob", "action_entropy"], level=0)
def actions_refuse_shapes(setting: Setting) -> Cases:
    """Missing or additional keys, and outputs, noise or actions of other sizes are refused."""
    config, outputs = config_of(setting), random_outputs(setting, setting.seed, (2,), 1.0)
    noise, action = np.zeros((2, 6)), np.zeros((2, 9))
    wrong_outputs: list[dict[str, Any]] = [
        {key: value for key, value in outputs.items() if key != "one"},
        {**outputs, "two": {"logits": np.zeros((2, 3))}},
        {**outputs, "Aim": {"mean": np.zeros((2, 1)), "std": np.zeros((1, 1))}},
        {**outputs, "turn": {"mean": np.zeros((2, 2)), "std": np.zeros((2, 1))}},
        {**outputs, "buttons": {"logits": np.zeros((2, 6))}},
        {**outputs, "one": {"logits": np.zeros((3, 1))}},
        {**outputs, "one": {"logits": np.zeros(1)}},
    ]
    for wrong in wrong_outputs:
        yield refused("sample_action", wrong, noise, TASK, config)
        yield refused("action_log_prob", wrong, action, TASK, config)
        yield refused("action_entropy", wrong, TASK, config)
    for shape in ((2, 5), (2, 9), (1, 6), (6,)):
        yield refused("sample_action", outputs, np.zeros(shape), TASK, config)
    for shape in ((2, 8), (2, 6), (1, 9), (9,)):
        yield refused("action_log_prob", outputs, np.zeros(shape), TASK, config)


@check("BEH-23", "CON-8", uses=["actor_loss", "critic_loss", "replay_critic_loss"], level=0)
def losses_refuse_shapes(setting: Setting) -> Cases:
    """Arrays that are not all [N, H], or [N, H, bins], are refused, also where they could be broadcast."""
    config, good = config_of(setting), np.zeros((2, 3))
    logits = np.zeros((2, 3, config.bins))
    for shape in ((2, 4), (1, 3), (2, 1), (3,), (), (2, 3, 1)):
        for place in range(5):
            yield refused("actor_loss", *[np.zeros(shape) if i == place else good for i in range(5)], 1.0, config)
        for function in ("critic_loss", "replay_critic_loss"):
            yield refused(function, logits, logits, np.zeros(shape), good, config)
            yield refused(function, logits, logits, good, np.zeros(shape), config)
    for wrong in (
        np.zeros((2, 3, config.bins + 2)),
        np.zeros((2, 4, config.bins)),
        np.zeros((1, 3, config.bins)),
        np.zeros((3, config.bins)),
    ):
        for function in ("critic_loss", "replay_critic_loss"):
            yield refused(function, wrong, logits, good, good, config)
            yield refused(function, logits, wrong, good, good, config)
    yield refused("actor_loss", good, good, good, good, good, np.ones(2), config)
