"""Checks of spec/06-world-model.md."""

import dataclasses
import functools
import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Equal, Setting, equal, exact, exactly, judged, refused, related
from conformance.cases.agent import SAMPLING_MARGIN, WHOLE, bound_of, problem_of, unit_directions
from conformance.check import check
from conformance.compare import Comparisons, round_to
from conformance.problems import (
    Problem,
    make_problem,
    random_actions,
    random_observations,
    random_parameters,
    small_config,
    spaces,
    uniforms,
)
from conformance.strategies import adversarial_numbers, arrays, normals, seeds
from conformance.worked import worked_cases
from reference_numpy import agent
from reference_numpy import world_model as reference
from reference_numpy.distributions import unimix_log_probs
from reference_numpy.transforms import exponential_bins, twohot
from spec import Config, Discrete, Image, Spaces, Vector, parameter_table

ACTIONS: dict[str, Vector | Discrete] = {"turn": Vector(2)}
TASK = Spaces({"position": Vector(3), "mode": Discrete((2, 3)), "image": Image(4, 6, 3)}, ACTIONS)
# Logits (0, ln 3) and a mixture of one percent: 0.128082 nats from the uniform distribution, 0.140535 nats to it.
SURE = math.log(3.0)
BEHAVIOR = ("actor", "critic", "replay_critic")  # losses of another chapter
WEIGHTS = {
    f"{name}_scale": weight
    for name, weight in (("reconstruction", 2.0), ("reward", 3.0), ("continue", 5.0), ("dynamics", 7.0))
}


def held(setting: Setting, x: Any) -> np.ndarray:
    """Losses read numbers of float32 or better in every compute dtype."""
    return round_to(x, "float64" if setting.dtype == "float64" else "float32")


@check("WM-7", "CON-11", uses=["continue_target"], level=0)
def continue_target_literals(setting: Setting) -> Cases:
    """0 at terminations; elsewhere 1, or 332/333 for the discounted target; any shape."""
    yield from worked_cases(setting, "world_model", "the continue target", bound=4 * setting.u)
    is_terminal = np.array([False, True, False])
    for kind, target in (("hard", 1.0), ("discounted", 0.75)):
        config = small_config(setting.profile, setting.dtype, continue_target=kind, discount_horizon=4.0)
        yield exact("continue_target", (is_terminal, config), target * ~is_terminal)


@check("WM-10", "WM-11", "WM-14", "RSSM-10", uses=["kl_losses"], level=0)
def kl_literals(setting: Setting) -> Cases:
    """2, 7, 8 and 10 latents of 0.128082 nats give 1, 1, 1.024657 and 1.280821: sum, then clip, for each row by
    itself."""
    bound = bound_of(setting, 1e-12, 64 * setting.u)
    yield from worked_cases(setting, "world_model", "KL of two classes", bound=bound)
    config = small_config(setting.profile, setting.dtype, stoch=10, classes=2, latent_unimix=0.01, free_nats=1.0)
    posterior, zeros = np.zeros((3, 10, 2)), np.zeros((3, 10, 2))
    for row, latents in enumerate((2, 8, 10)):
        posterior[row, :latents, 1] = held(setting, SURE)
    expected, where = reference.kl_losses(posterior, zeros, config), "kl_losses of several rows"
    yield equal("kl_losses", (posterior, zeros, config), expected, where=where, bound=bound)


@check("WM-10", "RSSM-10", uses=["kl_losses"], level=0)
def kl_is_bounded(setting: Setting) -> Cases:
    """32 latents of 64 classes that are sure of different classes are 277.331813 nats apart: the mixture is in both
    distributions."""
    bound, half = bound_of(setting, 1e-12, 64 * setting.u), np.zeros((1, 32, 64))
    yield from worked_cases(setting, "world_model", "the largest KL of a state", bound=bound)
    # Without mixture the probabilities are 1/2 and 63 times 1/126, here compared with 64 times 1/64.
    half[..., 0] = math.log(63)
    expected = np.array([32 * (math.log(64 / 2) + math.log(64 / 126)) / 2])
    plain = small_config(setting.profile, setting.dtype, stoch=32, classes=64, latent_unimix=0.0)
    yield equal("kl_losses", (held(setting, half), np.zeros((1, 32, 64)), plain), (expected, expected), bound=bound)


@check("WM-10", "WM-11", "WM-14", "WM-18", uses=["kl_losses"], level=0)
def kl_matches(setting: Setting) -> Cases:
    """Random logits from almost uniform to almost sure, with several floors; both results are the same number."""
    options = [{}, {"free_nats": 0.0}, {"free_nats": 3.0, "latent_unimix": 0.3}]

    def case(seed: int, overrides: dict[str, Any], scale: float) -> Cases:
        config = small_config(setting.profile, setting.dtype, **overrides)
        shape = 2, 4, config.stoch, config.classes
        posterior, prior = (held(setting, normals(seed + i, *shape, scale=scale)) for i in (0, 1))
        log_q, log_p = (unimix_log_probs(logits, config.latent_unimix) for logits in (posterior, prior))
        magnitude = 1 + (np.exp(log_q) * (np.abs(log_q) + np.abs(log_p))).sum((-2, -1))
        arguments = posterior, prior, config
        expected = reference.kl_losses(*arguments)
        yield equal("kl_losses", arguments, expected, magnitude=(magnitude, magnitude), bound=64 * setting.u)

    yield Drawn(case, seed=seeds(), overrides=st.sampled_from(options), scale=st.sampled_from([0.1, 1.0, 10.0, 1e3]))


@check("WM-14", "WM-18", uses=["kl_losses"], level=0)
def kl_extremes(setting: Setting) -> Cases:
    """Equal distributions are 0 nats apart and never less; a NaN shows in its own element, and no other."""
    config = small_config(setting.profile, setting.dtype)
    free = dataclasses.replace(config, free_nats=0.0)
    logits = held(setting, normals(setting.seed, 4, config.stoch, config.classes, scale=2.0))

    def not_negative(c: Comparisons, losses: Any) -> None:
        for name, loss in zip(("dynamics", "representation"), losses, strict=True):
            c.holds(f"{name} is not negative", np.asarray(loss) >= 0)

    where, zeros = "losses of equal distributions", (np.zeros(4), np.zeros(4))
    golden = Equal(zeros, where=where, magnitude=1.0, bound=64 * setting.u)
    yield judged("kl_losses", (logits, logits, free), golden, not_negative)

    def shows(c: Comparisons, before: Any, after: Any) -> None:
        for name, clean, loss in zip(("dynamics", "representation"), before, after, strict=True):
            c.exact(f"{name} with a NaN", loss, np.where(np.arange(4) == 1, np.nan, clean))

    for argument in (0, 1):
        clean = [logits, np.zeros_like(logits)]
        spoiled = [x.copy() for x in clean]
        spoiled[argument][1, 2, 0] = np.nan
        yield related(shows, ("kl_losses", (*clean, config)), ("kl_losses", (*spoiled, config)))


@check("WM-2", "WM-3", "WM-4", "WM-5", uses=["reconstruction_losses"], level=0)
def reconstruction_literals(setting: Setting) -> Cases:
    """Vector 10 at 1 costs 1.954111 times the scale; Discrete((2, 3)) at (0, 2) ln 4 + ln 3, whatever the scale; a
    pixel 0.25."""
    losses = ("the loss of a Vector", "the loss of a Discrete", "the loss of an Image")
    yield from worked_cases(setting, "world_model", *losses, bound=16 * setting.u)


@check("WM-2", "WM-3", "WM-4", "WM-5", "WM-18", "CON-24", uses=["reconstruction_losses"], level=0)
def reconstruction_matches(setting: Setting) -> Cases:
    """Random predictions and observations of any scale, two leading axes; one loss for each key, with predictions in
    float32 or better."""
    config = small_config(setting.profile, setting.dtype)

    def case(seed: int, position: np.ndarray, scale: float) -> Cases:
        observations = random_observations(np.random.default_rng(seed), TASK, (2, 3))
        observations["position"] = position.astype(np.float32)
        brightness = np.random.default_rng(seed + 3).random((2, 3, 4, 6, 3))
        drawn = {
            "position": normals(seed, 2, 3, 3, scale=scale),
            "mode": normals(seed + 1, 2, 3, 5, scale=scale),
            "image": brightness,
        }
        predictions = {key: held(setting, value) for key, value in drawn.items()}
        distance = np.abs(predictions["position"]) + np.log1p(np.abs(observations["position"].astype(float)))
        magnitude = {
            "position": (distance**2).sum(-1),
            "mode": 2 + 2 * np.abs(predictions["mode"]).max(-1),
            "image": ((brightness + observations["image"] / 255.0) ** 2).sum((-3, -2, -1)),
        }
        others = {"reward": np.full((2, 3), np.nan), **observations}
        expected = reference.reconstruction_losses(predictions, observations, TASK, config)
        arguments = predictions, others, TASK, config
        yield equal("reconstruction_losses", arguments, expected, magnitude=magnitude, bound=64 * setting.u)

    yield Drawn(
        case,
        seed=seeds(),
        position=arrays(adversarial_numbers(finite=True), (2, 3, 3)),
        scale=st.sampled_from([0.1, 3.0, 100.0]),
    )


@check("WM-18", uses=["reconstruction_losses"], level=0)
def reconstruction_shows_nan(setting: Setting) -> Cases:
    """A NaN in a prediction or an observation shows in the loss of its own key and step, and no other."""
    config = small_config(setting.profile, setting.dtype)
    observations = random_observations(setting.rng(), TASK, (3,))
    predictions = {"position": np.zeros((3, 3)), "mode": np.zeros((3, 5)), "image": np.zeros((3, 4, 6, 3))}
    expected = reference.reconstruction_losses(predictions, observations, TASK, config)
    for mapping, key in ((predictions, "image"), (predictions, "mode"), (observations, "position")):
        spoiled = mapping[key].copy()
        spoiled.reshape(3, -1)[1, 1] = np.nan
        arguments = [mapping | {key: spoiled} if x is mapping else x for x in (predictions, observations)]
        wanted = expected | {key: np.where(np.arange(3) == 1, np.nan, expected[key])}
        yield equal("reconstruction_losses", (*arguments, TASK, config), wanted, bound=256 * setting.u)


@check("WM-19", "WM-3", "WM-4", "NET-4", "NET-6", "CON-8", uses=["reconstruction_losses"], level=0)
def reconstruction_refuses(setting: Setting) -> Cases:
    """Missing keys, shapes that do not fit, real numbers for a Discrete and anything but uint8 for an Image are
    refused."""
    config = small_config(setting.profile, setting.dtype)
    observations = random_observations(setting.rng(), TASK, (3,))
    predictions = {"position": np.zeros((3, 3)), "mode": np.zeros((3, 5)), "image": np.zeros((3, 4, 6, 3))}
    for key in TASK.observations:
        for index, mapping in enumerate((predictions, observations)):
            missing, value = {name: x for name, x in mapping.items() if name != key}, mapping[key]
            resized = [missing | {key: x} for x in (value[..., :-1], value[:1], value[0])]
            for changed, naming in zip([missing, *resized], ([key], [key], [], []), strict=True):
                pair = (predictions, changed) if index else (changed, observations)
                yield refused("reconstruction_losses", *pair, TASK, config, naming=naming)
    for key, real in (("mode", np.float32), ("image", np.float32), ("image", np.int64)):
        changed = observations | {key: observations[key].astype(real)}
        yield refused("reconstruction_losses", predictions, changed, TASK, config, naming=[key])


@check("WM-19", "CON-8", uses=["kl_losses"], level=0)
def kl_refuses(setting: Setting) -> Cases:
    """Logits of another shape than [..., stoch, classes], and two shapes that could be broadcast, are refused."""
    config = small_config(setting.profile, setting.dtype)
    S, C = config.stoch, config.classes
    for wrong in ((4, S * C), (4, C, S), (4, S, C - 1), (4, S, 1), (4, 1, C), (1, S, C), (S, C), (5, S, C)):
        yield refused("kl_losses", np.zeros(wrong), np.zeros((4, S, C)), config)
        yield refused("kl_losses", np.zeros((4, S, C)), np.zeros(wrong), config)


def constant_heads(setting: Setting, continue_logit: float) -> tuple[Problem, dict[str, np.ndarray]]:
    """A problem whose weights are all zero, so that every prediction is the bias of its output layer, and these
    biases."""
    problem = make_problem(setting.seed, setting.profile, "both", "mixed", setting.dtype, **WEIGHTS)
    rng = setting.rng()
    biases = {
        name: round_to(rng.normal(size=value.shape), "bfloat16")
        for name, value in problem.state["params"].items()
        if name.startswith(("decoder/vector/out/", "decoder/image/out", "reward/out")) and name.endswith("bias")
    } | {"continue/out/bias": np.array([continue_logit])}
    params = {name: np.zeros_like(value) for name, value in problem.state["params"].items()} | biases
    reward = np.array([[0, 1, -1, 3.3, 1e12], [-1e12, 20, 0.01, -7e4, 485165194]], np.float32)
    changed = dataclasses.replace(
        problem, state=problem.state | {"params": params}, batch=problem.batch | {"reward": reward}
    )
    return changed, biases


@check(
    "WM-2",
    "WM-3",
    "WM-4",
    "WM-5",
    "WM-6",
    "WM-8",
    "WM-11",
    "WM-14",
    "WM-15",
    "WM-16",
    "WM-18",
    uses=["losses"],
    level=2,
)
def losses_of_constant_predictions(setting: Setting) -> Cases:
    """Where no prediction depends on the state, every loss is the plain mean over all steps, without weights; logits
    may be huge."""
    for continue_logit in (6.0, 1000.0, -1000.0):
        problem, biases = constant_heads(setting, continue_logit)
        batch, config = problem.batch, problem.config
        logits, mode = biases["decoder/vector/out/mode/bias"], batch["mode"]
        sigmoid = 1 / (1 + np.exp(-biases["decoder/image/out/bias"]))  # depth comes first
        error = biases["decoder/vector/out/position/bias"] - np.sign(batch["position"]) * np.log1p(
            np.abs(batch["position"].astype(float))
        )
        log_softmax = unimix_log_probs(biases["reward/out/bias"], 0.0)
        target = (1.0 - batch["is_terminal"]) * (config.discount if config.continue_target == "discounted" else 1.0)
        entries = [unimix_log_probs(part, 0.0) for part in (logits[:3], logits[3:])]
        expected = {
            "reconstruction/position": config.vector_loss_scale * (error**2).sum(-1),
            "reconstruction/mode": -entries[0][mode[..., 0]] - entries[1][mode[..., 1]],
            "reconstruction/depth": ((sigmoid[:1] - batch["depth"] / 255.0) ** 2).sum((-3, -2, -1)),
            "reconstruction/image": ((sigmoid[1:] - batch["image"] / 255.0) ** 2).sum((-3, -2, -1)),
            "reward": -(twohot(batch["reward"], exponential_bins(config.bins)) * log_softmax).sum(-1),
            "continue": max(continue_logit, 0.0) - target * continue_logit + math.log1p(math.exp(-abs(continue_logit))),
            "dynamics": np.full(target.shape, config.free_nats),
            "representation": np.full(target.shape, config.free_nats),
        }

        def names(c: Comparisons, result: Any, expected: dict[str, Any] = expected) -> None:
            c.holds("the names of the losses", set(result[1]["losses"]) - set(BEHAVIOR) == set(expected))

        bound = 1e-12 if setting.dtype == "float64" else 256 * setting.u
        means = (
            Equal(
                values.mean(),
                at=(1, "losses", name),
                where=f"{name} with continue logit {continue_logit}",
                magnitude=abs(continue_logit) if name == "continue" else values.mean(),
                bound=bound,
            )
            for name, values in expected.items()
        )
        yield judged("losses", problem.loss_arguments, names, *means)


@check("WM-1", "WM-6", "WM-8", "WM-9", "WM-15", "WM-16", "NET-1", uses=["losses"], level=2, dtypes=WHOLE)
def losses_read_the_state_of_the_same_step(setting: Setting) -> Cases:
    """With heads that depend strongly on memory and latents, each loss pairs state, reward, flag and observation of one
    step."""
    problem = problem_of(setting, "both", "mixed")
    strong = ("reward/out/kernel", "continue/out/kernel", "decoder/vector/out/mode/kernel", "rssm/prior/out/kernel")
    params = {name: value * 8 if name in strong else value for name, value in problem.state["params"].items()}
    arguments = (params, *problem.loss_arguments[1:])
    expected = agent.losses(*arguments)[1]["losses"]
    bound = bound_of(setting, 1e-10, 2e-4)
    losses = (
        Equal(value, at=(1, "losses", name), where=name, magnitude=abs(value) + 1, bound=bound)
        for name, value in expected.items()
        if name not in BEHAVIOR
    )
    yield judged("losses", arguments, *losses)


def scaled(problem: Problem, scale: float) -> Problem:
    """The problem with larger or smaller logits of posterior and prior."""
    outputs = ("rssm/posterior/out/", "rssm/prior/out/")
    params = {
        name: value * scale if name.startswith(outputs) else value for name, value in problem.state["params"].items()
    }
    return dataclasses.replace(problem, state=problem.state | {"params": params})


@check("WM-14", uses=["losses", "loss_derivatives"], level=2)
def free_nats_leave_no_gradient(setting: Setting) -> Cases:
    """Where posterior and prior are close everywhere, both losses are exactly the free nats and move with no
    parameter."""
    problem = scaled(make_problem(setting.seed, setting.profile, "vector", "continuous", setting.dtype), 2.0**-6)
    directions = list(unit_directions(problem, setting.seed).values())
    names = ("dynamics", "representation")
    free = (exactly(problem.config.free_nats, at=(1, "losses", name), where=name) for name in names)
    yield judged("losses", problem.loss_arguments, *free)
    still = (exactly(np.zeros(len(directions)), at=(name,), where=f"derivatives of {name}") for name in names)
    yield judged("loss_derivatives", (*problem.loss_arguments, directions), *still)


@check("WM-12", "WM-13", "RSSM-23", uses=["loss_derivatives"], level=2)
def constants_of_the_kl(setting: Setting) -> Cases:
    """Where every step is a reset: dynamics moves with prior and core alone, representation with posterior, encoder and
    core alone."""
    problem = scaled(make_problem(setting.seed, setting.profile, "vector", "continuous", setting.dtype), 8.0)
    batch = problem.batch | {"is_first": np.ones_like(problem.batch["is_first"])}
    problem = dataclasses.replace(problem, batch=batch)
    directions = unit_directions(problem, setting.seed)
    moving = {"dynamics": ("prior", "core"), "representation": ("posterior", "encoder", "core")}

    def moves(c: Comparisons, derivatives: Any) -> None:
        for name, labels in moving.items():
            for label, derivative in zip(directions, derivatives[name], strict=True):
                if label in labels:
                    c.holds(f"{name} moves with {label}", derivative != 0)
                elif not label.startswith("all"):
                    c.exact(f"derivative of {name} by {label}", derivative, 0.0)

    yield judged("loss_derivatives", (*problem.loss_arguments, list(directions.values())), moves)


@dataclasses.dataclass(frozen=True)
class Sequences:
    """The arguments of `open_loop`."""

    params: dict[str, np.ndarray]
    observation: dict[str, np.ndarray]
    prev_action: np.ndarray
    is_first: np.ndarray
    context: int
    noise: dict[str, np.ndarray]
    spaces: Spaces
    config: Config

    @property
    def arguments(self) -> tuple[Any, ...]:
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    def observing(self, others: dict[str, np.ndarray], start: int) -> "Sequences":
        """With other observations from a step on."""
        observation = {
            key: np.concatenate([value[:, :start], others[key][:, start:]], 1)
            for key, value in self.observation.items()
        }
        return dataclasses.replace(self, observation=observation)

    def nudged(self, distance: float) -> "Sequences":
        return dataclasses.replace(self, noise={name: value + distance for name, value in self.noise.items()})


ROWS, STEPS, CONTEXT = 3, 7, 3
STARTS = np.zeros((ROWS, STEPS), bool)  # row 1 goes on from zeros and is reset twice, row 2 where the prediction begins
STARTS[[0, 1, 1, 2, 2], [0, 1, CONTEXT + 2, 0, CONTEXT]] = True


@functools.lru_cache(maxsize=16)
def sequences(seed: int, profile: str, dtype: str, observation: str, context: int) -> Sequences:
    """Sequences with resets in context and prediction, in which honest rounding moves no sample into another class."""
    config, task = small_config(profile, dtype), spaces(observation, "mixed")
    rng = np.random.default_rng(seed)
    for _ in range(1000):
        noise = {
            "posterior": uniforms(rng, ROWS, context, config.stoch),
            "prior": uniforms(rng, ROWS, STEPS - context, config.stoch),
        }
        params = random_parameters(rng, config, task, dtype)
        recorded = random_observations(rng, task, (ROWS, STEPS))
        action = random_actions(rng, task, (ROWS, STEPS))
        drawn = Sequences(params, recorded, action, STARTS, context, noise, task, config)
        below, above = (reference.open_loop(*drawn.nudged(d).arguments) for d in (-SAMPLING_MARGIN, SAMPLING_MARGIN))
        if all(np.array_equal(below[key], above[key]) for key in below):
            return drawn
    raise RuntimeError("no sequences keep every sample away from the next class")


@check("WM-20", "WM-21", "WM-23", "RSSM-18", "NET-1", uses=["open_loop"], level=1, dtypes=WHOLE)
def open_loop_matches(setting: Setting) -> Cases:
    """Every prediction of every step: images, vectors in their units, probabilities, rewards; long and short contexts,
    and resets."""
    for observation, context in (("both", CONTEXT), ("vector", 1), ("vector", STEPS - 1)):
        drawn = sequences(setting.seed, setting.profile, setting.dtype, observation, context)
        expected = reference.open_loop(*drawn.arguments)
        magnitude = {key: 1 + np.abs(value).max() for key, value in expected.items()}
        yield equal("open_loop", drawn.arguments, expected, magnitude=magnitude, bound=bound_of(setting, 1e-10, 2e-4))


@check("WM-23", uses=["open_loop"], level=1)
def open_loop_literals(setting: Setting) -> Cases:
    """Decoder outputs 1, -2 and 0 are 1.718282, -6.389056 and 0; logits 0, ln 3 a quarter and three; a reward between
    two bins."""
    config, task = small_config(setting.profile, setting.dtype), spaces("both", "mixed")
    ln3 = float(round_to(SURE, "bfloat16"))  # so that every dtype holds it
    odds = math.exp(ln3)
    bins = np.arange(config.bins)
    params = {name: np.zeros(entry.shape) for name, entry in parameter_table(config, task).items()} | {
        "decoder/vector/out/position/bias": np.array([1.0, -2, 0]),
        "decoder/vector/out/mode/bias": np.array([0.0, ln3, 0, ln3, 0]),
        "decoder/image/out/bias": np.array([0.0, 0, ln3, -ln3]),  # depth comes first
        "continue/out/bias": np.array([ln3]),
        "reward/out/bias": np.where(np.isin(bins, (15, 16)), bins == 16, -1024 / ln3) * ln3,
    }
    noise = {"posterior": np.zeros((1, 1, config.stoch)), "prior": np.zeros((1, 1, config.stoch))}
    observation = random_observations(setting.rng(), task, (1, 2))
    inputs = observation, random_actions(setting.rng(), task, (1, 2)), np.zeros((1, 2), bool), 1, noise
    high, low = odds / (1 + odds), 1 / (1 + odds)
    expected = {
        "position": [math.e - 1, 1 - math.e**2, 0],
        "mode": [1 / (2 + odds), odds / (2 + odds), 1 / (2 + odds), high, low],
        "depth": np.full((12, 16, 1), 0.5),
        "image": np.broadcast_to([0.5, high, low], (12, 16, 3)),
        "reward": high * exponential_bins(config.bins)[16],
        "continue_": high,
    }
    both = {key: np.stack([[value, value]]) for key, value in expected.items()}
    yield equal("open_loop", (params, *inputs, task, config), both, magnitude="tensor", bound=256 * setting.u)


def same(one: dict[str, Any], other: dict[str, Any], row: int, steps: slice) -> bool:
    """Whether two predictions of a row agree in every bit in the given steps."""
    return all(np.array_equal(one[key][row, steps], other[key][row, steps]) for key in one)


@check("WM-20", "WM-21", "WM-22", uses=["open_loop"], level=1)
def open_loop_reads_only_the_context(setting: Setting) -> Cases:
    """What is observed after the context changes nothing; the last step of it changes what follows, and nothing that
    came before."""
    drawn = sequences(setting.seed, setting.profile, "float64", "both", CONTEXT)
    others = random_observations(np.random.default_rng(setting.seed + 1), drawn.spaces, (ROWS, STEPS))
    others["position"][:] = np.nan

    def unread(c: Comparisons, before: Any, after: Any) -> None:
        for key, value in before.items():
            c.exact(f"{key} after other observations", after[key], value)

    hidden = drawn.observing(others, CONTEXT)
    yield related(unread, ("open_loop", drawn.arguments), ("open_loop", hidden.arguments))

    calls, last = [], CONTEXT - 1
    for seed in range(10):  # with one noise or another, the other observation draws other latents
        rng = np.random.default_rng(seed)
        noise = drawn.noise | {"posterior": uniforms(rng, *drawn.noise["posterior"].shape)}
        before = dataclasses.replace(drawn, noise=noise)
        after = before.observing(random_observations(rng, drawn.spaces, (ROWS, STEPS)), last)
        calls += [("open_loop", before.arguments), ("open_loop", after.arguments)]

    def counts(c: Comparisons, *predictions: Any) -> None:
        changes = []
        for before, after in zip(predictions[::2], predictions[1::2], strict=True):
            c.holds("nothing changes before the observation that changed", same(before, after, 0, slice(last)))
            changes.append(
                [not same(before, after, 0, steps) for steps in (slice(last, CONTEXT), slice(CONTEXT, None))]
            )
        c.holds("the last observation of the context counts, at its step and later", np.any(changes, 0))

    yield related(counts, *calls)


@check("WM-20", "RSSM-13", "RSSM-14", "RSSM-18", uses=["open_loop"], level=1)
def open_loop_follows_actions_and_resets(setting: Setting) -> Cases:
    """An action moves the prediction of its own step and nothing before; after a reset nothing from before it counts,
    not even NaN."""
    drawn = sequences(setting.seed, setting.profile, "float64", "vector", CONTEXT)
    for step in (1, CONTEXT, STEPS - 1):

        def moves(c: Comparisons, before: Any, after: Any, step: int = step) -> None:
            c.holds(f"nothing changes before action {step}", same(before, after, 0, slice(step)))
            c.holds(f"action {step} counts at its own step", not same(before, after, 0, slice(step, step + 1)))

        action = drawn.prev_action.copy()
        action[0, step] = -action[0, step] + 0.25
        other = dataclasses.replace(drawn, prev_action=action)
        yield related(moves, ("open_loop", drawn.arguments), ("open_loop", other.arguments))
    for row, step in ((1, CONTEXT + 2), (2, CONTEXT)):

        def forgets(c: Comparisons, before: Any, after: Any, row: int = row, step: int = step) -> None:
            where = f"nothing before the reset of row {row} counts after it"
            c.holds(where, same(before, after, row, slice(step, None)))

        action = drawn.prev_action.copy()
        action[row, : step + 1] = np.nan
        other = dataclasses.replace(drawn, prev_action=action)
        yield related(forgets, ("open_loop", drawn.arguments), ("open_loop", other.arguments))


@check("WM-24", "WM-19", "CON-8", uses=["open_loop"], level=1)
def open_loop_refuses(setting: Setting) -> Cases:
    """A context that is no part of the sequence, missing keys, and rows, steps or sizes that differ, are refused."""
    drawn = sequences(setting.seed, setting.profile, "float64", "vector", CONTEXT)
    config, task = drawn.config, drawn.spaces
    for context in (-1, 0, STEPS, STEPS + 1):
        yield refused("open_loop", *dataclasses.replace(drawn, context=context).arguments, naming=["context"])
    for key, value in drawn.observation.items():
        rest = {name: other for name, other in drawn.observation.items() if name != key}
        for wrong in (rest, rest | {key: value[..., :-1]}, rest | {key: value[:, :-1]}, rest | {key: value[:1]}):
            yield refused("open_loop", *dataclasses.replace(drawn, observation=wrong).arguments, naming=[key])
    for size in (
        (ROWS, STEPS, task.action_size - 1),
        (ROWS, STEPS - 1, task.action_size),
        (1, STEPS, task.action_size),
    ):
        yield refused("open_loop", *dataclasses.replace(drawn, prev_action=np.zeros(size)).arguments)
    for starts in (STARTS[:, 0], STARTS[:1], STARTS[..., None]):
        yield refused("open_loop", *dataclasses.replace(drawn, is_first=starts).arguments)
    for name, steps in (("posterior", CONTEXT), ("prior", STEPS - CONTEXT)):
        for shape in ((ROWS, steps + 1, config.stoch), (1, steps, config.stoch), (ROWS, steps, 1)):
            noise = drawn.noise | {name: np.zeros(shape)}
            yield refused("open_loop", *dataclasses.replace(drawn, noise=noise).arguments)
