"""Checks of spec/04-rssm.md."""

import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Equal, Setting, equal, exact, exactly, judged, refused, related
from conformance.check import check
from conformance.compare import BOUND, Comparisons, round_to
from conformance.problems import random_actions, random_carry, random_parameters, small_config, spaces
from conformance.strategies import normals, seeds
from conformance.worked import worked_cases
from reference_numpy import rssm as reference
from reference_numpy.distributions import unimix_log_probs
from spec import Config, Spaces, parameter_table

TASK = spaces("vector", "mixed")
ROWS, STEPS, HORIZON = 3, 5, 4
# Other depths, sizes and mixture than those of the profiles: 2 blocks of 6 memory units instead of 8 blocks of 2.
UNUSUAL = {
    "deter": 12,
    "blocks": 2,
    "units": 6,
    "prior_layers": 3,
    "posterior_layers": 2,
    "latent_unimix": 0.5,
    "norm_epsilon": 0.1,
}
SIZES = st.sampled_from([{}, UNUSUAL])
FRACTION = np.array(
    [[0.251, 0.251, 0.251, 0.0], [0.253, 0.744, 0.499, 0.006], [0.0, 0.753, 0.501, 0.0], [1 - 2.0**-24] * 4]
)
LATENTS = np.array([[0.0, math.log(3.0)], [math.log(3.0), 0.0], [0.0, 0.0], [-131072.0, 0.0]])


def zero_parameters(config: Config, task: Spaces = TASK) -> dict[str, np.ndarray]:
    return {name: np.zeros(entry.shape) for name, entry in parameter_table(config, task).items()}


def margin(setting: Setting) -> float:
    """How far samples keep from class boundaries: more than the probabilities err in the candidate's dtype."""
    return 0.05 if setting.dtype == "bfloat16" else 1e-4


def safe_uniform(rng: np.random.Generator, logits: np.ndarray, config: Config, distance: float) -> np.ndarray:
    """For each latent a number that picks a random class, no nearer than `distance` to where another class begins."""
    probs = np.exp(unimix_log_probs(logits, config.latent_unimix))
    index = np.where(probs > 2 * distance, rng.random(probs.shape), -1).argmax(-1)[..., None]
    high, share = np.cumsum(probs, -1), rng.random(index.shape)
    low = np.take_along_axis(high - probs, index, -1) + distance
    return round_to((low + share * (np.take_along_axis(high, index, -1) - distance - low))[..., 0], "float32")


def observe_arguments(
    setting: Setting, seed: int, config: Config, is_first: np.ndarray | None = None
) -> tuple[Any, ...]:
    """Arguments of `observe`: uniforms are chosen step by step, so that no sample is near a class boundary."""
    rng = np.random.default_rng(seed)
    params = random_parameters(rng, config, TASK, setting.dtype)
    carry = random_carry(rng, config, (ROWS,))
    tokens = round_to(rng.normal(size=(ROWS, STEPS, config.units)), "bfloat16")
    prev_action = random_actions(rng, TASK, (ROWS, STEPS))
    is_first = rng.random((ROWS, STEPS)) < 0.3 if is_first is None else is_first
    uniform, state = np.zeros((ROWS, STEPS, config.stoch)), carry
    for t in range(STEPS):
        inputs = params, state, tokens[:, t], prev_action[:, t], is_first[:, t]
        logits = reference.observe_step(*inputs, uniform[:, t], config)[1]
        uniform[:, t] = safe_uniform(rng, logits, config, margin(setting))
        state = reference.observe_step(*inputs, uniform[:, t], config)[0]
    return params, carry, tokens, prev_action, is_first, uniform, config


def imagine_arguments(setting: Setting, seed: int, config: Config) -> tuple[Any, ...]:
    """Arguments of `imagine`, chosen in the same way. Actions are float32 numbers that bfloat16 cannot hold."""
    rng = np.random.default_rng(seed)
    params = random_parameters(rng, config, TASK, setting.dtype)
    carry = random_carry(rng, config, (ROWS,))
    action = round_to(random_actions(rng, TASK, (ROWS, HORIZON)) * 1.1, "float32")
    uniform, deter, stoch = np.zeros((ROWS, HORIZON, config.stoch)), carry["deter"], carry["stoch"]
    for t in range(HORIZON):
        deter = reference.core(params, deter, stoch, action[:, t], config)
        logits = reference.prior(params, deter, config)
        uniform[:, t] = safe_uniform(rng, logits, config, margin(setting))
        stoch = reference.categorical_sample(unimix_log_probs(logits, config.latent_unimix), uniform[:, t])
    return params, carry, action, uniform, config


def reference_imagine(
    params: Any, carry: Any, action: np.ndarray, uniform: np.ndarray, config: Config
) -> dict[str, np.ndarray]:
    return reference.imagine(params, carry, lambda feature, t: action[:, t], uniform, config)


@check("RSSM-7", uses=["core"], level=1)
def gates_literals(setting: Setting) -> Cases:
    """Memories 0.2, -0.5 and 1 with gate inputs (0, 1, 1), (1, 2, 0) and (0, 0, 0) become 0.331059, -0.124003 and
    0.731059."""
    bound = {"float64": 1e-12, "float32": 2e-6, "bfloat16": 2e-2}[setting.dtype]
    yield from worked_cases(setting, "rssm", "the gates", floor=1.0, bound=bound)


@check("RSSM-6", uses=["core"], level=1)
def gates_are_split_inside_each_block(setting: Setting) -> Cases:
    """With 4 memory units in 2 blocks, the gate outputs are r0 r1 c0 c1 u0 u1 r2 r3 c2 c3 u2 u3."""
    yield from worked_cases(setting, "rssm", "the layout of the gates", bound=BOUND[setting.dtype])


@check("RSSM-3", "RSSM-4", "RSSM-5", uses=["core"], level=1)
def inputs_of_the_blocks(setting: Setting) -> Cases:
    """The blocks read (1, 2, 7, 8, 9) and (3, 4, 7, 8, 9): their memory, then all embeddings; RMSNorm runs over both
    blocks together."""
    config = small_config(setting.profile, setting.dtype, deter=4, blocks=2, units=1, norm_epsilon=1e-20)
    params = zero_parameters(config) | {"rssm/hidden/scale": np.ones(4), "rssm/hidden/bias": np.array([0.0, 8, 0, 8])}
    # One unit: RMSNorm leaves the sign of the bias times the scale.
    for name, scale in (("deter", 7.0), ("stoch", 8.0), ("action", 9.0)):
        params |= {f"rssm/embed_{name}/bias": np.ones(1), f"rssm/embed_{name}/scale": np.array([scale])}
    params["rssm/gru/bias"] = np.array([100.0, 100, 0, 0, 100, 100] * 2)
    # The candidate of each block's first unit reads the block's first hidden unit.
    params["rssm/gru/kernel"][:, 0, 2] = 1
    inputs = np.array([[1.0, 2, 3, 4]]), np.zeros((1, config.stoch, config.classes)), np.zeros((1, TASK.action_size))
    embeddings = [x / (1 + math.exp(-x)) for x in (7, 8, 9)]
    for index, (first, second) in enumerate(zip([1, 2, *embeddings], [3, 4, *embeddings], strict=True)):
        kernel = np.zeros_like(params["rssm/hidden/kernel"])
        kernel[:, index, 0] = 1
        hidden = np.array([first, second]) / math.sqrt((first**2 + second**2 + 2 * 8**2) / 4)
        candidate = np.tanh(hidden / (1 + np.exp(-hidden)))
        expected = np.array([[candidate[0], 0, candidate[1], 0]])
        arguments = params | {"rssm/hidden/kernel": kernel}, *inputs, config
        yield equal("core", arguments, expected, magnitude="tensor")


@check("RSSM-1", "RSSM-2", "RSSM-3", "RSSM-4", "RSSM-5", "RSSM-6", "RSSM-7", "RSSM-26", uses=["core"], level=1)
def core_matches(setting: Setting) -> Cases:
    """Random memories, latents that are one-hot or zero, and actions of any scale; many blocks, and few."""

    def case(seed: int, sizes: dict[str, Any], scale: float) -> Cases:
        rng, config = np.random.default_rng(seed), small_config(setting.profile, setting.dtype, **sizes)
        params, carry = random_parameters(rng, config, TASK, setting.dtype), random_carry(rng, config, (ROWS,))
        stoch = carry["stoch"] * (rng.random((ROWS, 1, 1)) < 0.8)
        action = setting.cast(normals(seed, ROWS, TASK.action_size, scale=scale))
        arguments = params, carry["deter"], stoch, action, config
        yield equal("core", arguments, reference.core(*arguments), magnitude="tensor")

    yield Drawn(case, seed=seeds(), sizes=SIZES, scale=st.sampled_from([1e-3, 1.0, 1e3, 1e30]))


@check("RSSM-2", uses=["core"], level=1)
def large_actions_count_as_one(setting: Setting) -> Cases:
    """Entries outside [-1, 1] count exactly as 1 or -1, others as they are."""
    config = small_config(setting.profile, setting.dtype)
    rng = setting.rng()
    params, carry = random_parameters(rng, config, TASK, setting.dtype), random_carry(rng, config, (2,))
    action = np.array([[-3.0, 0.5, 2, 1, 1e30, -0.25, 0], [1, -1, 5, -7, 0.125, 0, -1e30]])
    large, limited = (
        (params, carry["deter"], carry["stoch"], x, config) for x in (setting.cast(action), np.clip(action, -1, 1))
    )

    def same(c: Comparisons, before: np.ndarray, after: np.ndarray) -> None:
        c.exact("core", after, before)

    yield related(same, ("core", large), ("core", limited))
    yield equal("core", large, reference.core(*limited), magnitude="tensor")


@check("RSSM-8", "RSSM-9", "RSSM-10", "RSSM-26", uses=["prior", "posterior"], level=1)
def logits_literals(setting: Setting) -> Cases:
    """With zero weights the logits are the biases of the output layer, row by row, before any mixture or
    normalization."""
    config = small_config(setting.profile, setting.dtype)
    bias = np.arange(15.0) * 16
    params = zero_parameters(config) | {"rssm/prior/out/bias": bias, "rssm/posterior/out/bias": -bias}
    expected = np.tile(bias.reshape(3, 5), (2, 1, 1))
    deter, tokens = np.ones((2, config.deter)), np.ones((2, config.units))
    yield exact("prior", (params, deter, config), expected)
    yield exact("posterior", (params, deter, tokens, config), -expected)


@check("RSSM-8", "RSSM-9", "RSSM-10", "RSSM-26", uses=["prior", "posterior"], level=1)
def logits_match(setting: Setting) -> Cases:
    """Random memories and tokens, of any scale, and other depths than usual."""

    def case(seed: int, sizes: dict[str, Any], scale: float) -> Cases:
        config = small_config(setting.profile, setting.dtype, **sizes)
        params = random_parameters(np.random.default_rng(seed), config, TASK, setting.dtype)
        deter = setting.cast(normals(seed + 1, ROWS, config.deter))
        tokens = setting.cast(normals(seed + 2, ROWS, config.units, scale=scale))
        yield equal("prior", (params, deter, config), reference.prior(params, deter, config), magnitude="tensor")
        expected = reference.posterior(params, deter, tokens, config)
        yield equal("posterior", (params, deter, tokens, config), expected, magnitude="tensor")

    yield Drawn(case, seed=seeds(), sizes=SIZES, scale=st.sampled_from([1e-2, 1.0, 30.0]))


@check("RSSM-1", "RSSM-8", "RSSM-9", uses=["core", "prior", "posterior"], level=1)
def leading_axes(setting: Setting) -> Cases:
    """No leading axes, or two of them."""
    config = small_config(setting.profile, setting.dtype)
    rng = setting.rng()
    params = random_parameters(rng, config, TASK, setting.dtype)
    for leading in ((), (2, 3)):
        carry, action = random_carry(rng, config, leading), random_actions(rng, TASK, leading)
        deter, stoch = carry["deter"], carry["stoch"]
        tokens = round_to(rng.normal(size=(*leading, config.units)), "bfloat16")
        core, prior = (params, deter, stoch, action, config), (params, deter, config)
        yield equal("core", core, reference.core(*core), magnitude="tensor")
        yield equal("prior", prior, reference.prior(*prior), magnitude="tensor")
        posterior = (params, deter, tokens, config)
        yield equal("posterior", posterior, reference.posterior(*posterior), magnitude="tensor")


def sample_both(
    setting: Setting, config: Config, logits: np.ndarray, uniform: np.ndarray, expected: np.ndarray
) -> Cases:
    """Samples of posterior and prior, whose logits [S, C] are given as biases: the classes [N, S] must be as
    expected."""
    bias = logits.reshape(-1)
    params = zero_parameters(config) | {"rssm/prior/out/bias": bias, "rssm/posterior/out/bias": bias}
    rows, onehot = len(uniform), np.eye(config.classes)[expected][:, None]
    carry = {"deter": np.zeros((rows, config.deter)), "stoch": np.zeros((rows, config.stoch, config.classes))}
    action, tokens = np.zeros((rows, 1, TASK.action_size)), np.zeros((rows, 1, config.units))
    uniform = round_to(uniform[:, None], "float64" if setting.dtype == "float64" else "float32")
    yield judged(
        "observe",
        (params, carry, tokens, action, np.zeros((rows, 1), bool), uniform, config),
        exactly(onehot, at=("stoch",), where="posterior sample"),
        exactly(np.broadcast_to(logits, onehot.shape), at=("logits",), where="posterior logits"),
    )
    trajectory = np.concatenate([carry["stoch"][:, None], onehot], 1)
    yield exact("imagine", (params, carry, action, uniform, config), trajectory, at=("stoch",), where="prior sample")


@check("RSSM-10", "RSSM-11", "RSSM-12", uses=["observe", "imagine"], level=1)
def sampling_literals(setting: Setting) -> Cases:
    """Probabilities (1/4, 3/4) give class 0 at 0.251 with one percent of uniform mixture and class 1 without; 0 and
    almost 1."""
    # So that every dtype holds them: 0.2495 instead of 0.25, and likewise with 0.7505.
    logits = round_to(LATENTS, "bfloat16")
    mixed = small_config(setting.profile, setting.dtype, stoch=4, classes=2, latent_unimix=0.01)
    classes = np.array([[0, 0, 0, 0], [1, 0, 0, 1], [0, 1, 1, 0], [1, 1, 1, 1]])
    yield from sample_both(setting, mixed, logits, FRACTION, classes)
    plain = small_config(setting.profile, setting.dtype, stoch=4, classes=2, latent_unimix=0.0)
    classes = np.array([[1, 0, 0, 1], [1, 0, 0, 1], [0, 1, 1, 1], [1, 1, 1, 1]])
    yield from sample_both(setting, plain, logits, FRACTION, classes)


@check("RSSM-10", "RSSM-11", "RSSM-12", "RSSM-26", "CON-17", uses=["observe", "imagine"], level=1)
def sampling_near_boundaries(setting: Setting) -> Cases:
    """Uniform numbers just below and above where a class begins, or just below 1: sums of probabilities are at least
    float32."""
    config = small_config(setting.profile, setting.dtype)
    distance = 1e-9 if setting.dtype == "float64" else 1e-5

    def case(seed: int, scale: float) -> Cases:
        logits = round_to(normals(seed, config.stoch, config.classes, scale=scale), "bfloat16")
        ends = np.cumsum(np.exp(unimix_log_probs(logits, config.latent_unimix)), -1)
        rng = np.random.default_rng(seed + 1)
        index = rng.integers(0, config.classes - 1, (8, config.stoch))
        side = rng.integers(0, 2, index.shape)
        uniform = ends[np.arange(config.stoch), index] + (2 * side - 1) * distance
        uniform[0], largest = 1 - (2.0**-53 if setting.dtype == "float64" else 2.0**-24), config.classes - 1
        classes = np.where(uniform == uniform[0], largest, index + side)
        yield from sample_both(setting, config, logits, uniform, classes)

    yield Drawn(case, seed=seeds(), scale=st.sampled_from([0.1, 1.0, 3.0]))


@check("RSSM-12", *(f"RSSM-{n}" for n in range(13, 20)), "CON-12", uses=["observe"], level=1)
def observe_matches(setting: Setting) -> Cases:
    """Memories, exactly one-hot samples and logits of random sequences, with resets at any step of any row."""

    def case(seed: int, sizes: dict[str, Any]) -> Cases:
        arguments = observe_arguments(setting, seed, small_config(setting.profile, setting.dtype, **sizes))
        expected = reference.observe(*arguments)
        samples = exactly(expected["stoch"], at=("stoch",), where="stoch")
        yield judged("observe", arguments, Equal(expected, magnitude="tensor"), samples)

    yield Drawn(case, seed=seeds(), sizes=SIZES)


@check("RSSM-13", "RSSM-14", "RSSM-17", "CON-12", uses=["observe"], level=1)
def resets_forget_everything(setting: Setting) -> Cases:
    """Nothing before a reset changes anything from it on, not even as NaN or infinity; rows without a reset notice
    nothing."""
    config = small_config(setting.profile, setting.dtype)
    is_first = np.zeros((ROWS, STEPS), bool)
    is_first[0, 0] = is_first[1, 2] = True
    arguments = observe_arguments(setting, setting.seed, config, is_first)
    params, carry, *sequences, _ = arguments
    for bad in (np.nan, np.inf, 1e30):
        spoiled_carry = {name: value.copy() for name, value in carry.items()}
        tokens, prev_action, _, uniform = (x.copy() for x in sequences)
        for row, reset in ((0, 0), (1, 2)):
            spoiled_carry["deter"][row] = spoiled_carry["stoch"][row] = bad
            tokens[row, :reset] = prev_action[row, : reset + 1] = bad
            uniform[row, :reset] = 1 - uniform[row, :reset]

        def same(c: Comparisons, before: Any, after: Any, bad: float = bad) -> None:
            for name in ("deter", "stoch", "logits"):
                for row, start in ((0, 0), (1, 2), (2, 0)):
                    c.exact(f"{name} of row {row} with {bad}", after[name][row, start:], before[name][row, start:])

        spoiled = params, spoiled_carry, tokens, prev_action, is_first, uniform, config
        yield related(same, ("observe", arguments), ("observe", spoiled))


@check("RSSM-13", "RSSM-15", "CON-5", uses=["observe"], level=1)
def a_reset_is_a_start_from_zeros(setting: Setting) -> Cases:
    """A reset at the first step equals, in every bit, no reset with zeros for memory, latents and the whole previous
    action."""
    config = small_config(setting.profile, setting.dtype)
    is_first = np.zeros((ROWS, STEPS), bool)
    is_first[:, 0] = True
    arguments = observe_arguments(setting, setting.seed, config, is_first)
    params, carry, tokens, prev_action, _, uniform, _ = arguments
    zeros = {name: np.zeros_like(value) for name, value in carry.items()}
    prev_action = prev_action.copy()
    prev_action[:, 0] = 0

    def same(c: Comparisons, reset: Any, started: Any) -> None:
        for name in ("deter", "stoch", "logits"):
            c.exact(name, reset[name], started[name])

    start = params, zeros, tokens, prev_action, np.zeros_like(is_first), uniform, config
    yield related(same, ("observe", arguments), ("observe", start))


@check("RSSM-2", "RSSM-10", "RSSM-11", "RSSM-20", "RSSM-21", "RSSM-22", uses=["imagine"], level=1)
def imagine_matches(setting: Setting) -> Cases:
    """Trajectories under given actions: the start unchanged, samples of the prior fed back, actions as they were
    given."""

    def case(seed: int, sizes: dict[str, Any]) -> Cases:
        arguments = imagine_arguments(setting, seed, small_config(setting.profile, setting.dtype, **sizes))
        expected = reference_imagine(*arguments)

        def start(c: Comparisons, actual: Any) -> None:
            c.exact("deter of the start", actual["deter"][:, 0], expected["deter"][:, 0])

        unrounded = (exactly(expected[name], at=(name,), where=name) for name in ("stoch", "action"))
        yield judged("imagine", arguments, Equal(expected, magnitude="tensor"), *unrounded, start)

    yield Drawn(case, seed=seeds(), sizes=SIZES)


@check("RSSM-26", uses=["core", "observe", "imagine"], level=1, dtypes=("bfloat16",))
def memory_is_rounded_at_every_step(setting: Setting) -> Cases:
    """Every new memory is a number that the compute dtype can hold."""
    config = small_config(setting.profile, setting.dtype)
    arguments = imagine_arguments(setting, setting.seed, config)
    params, carry, action, *_ = arguments

    def rounded(c: Comparisons, core: np.ndarray, observed: Any, imagined: Any) -> None:
        for name, deter in (("core", core), ("observe", observed["deter"]), ("imagine", imagined["deter"])):
            c.exact(name, deter, round_to(deter, setting.dtype))

    yield related(
        rounded,
        ("core", (params, carry["deter"], carry["stoch"], setting.cast(action[:, 0]), config)),
        ("observe", observe_arguments(setting, setting.seed, config)),
        ("imagine", arguments),
    )


@check("RSSM-27", "CON-8", uses=["core", "prior", "posterior"], level=1)
def steps_refuse_shapes(setting: Setting) -> Cases:
    """Wrong sizes are refused, with name and shape; and different numbers of rows, also where they could be
    broadcast."""
    config = small_config(setting.profile, setting.dtype)
    D, S, C, A, E = config.deter, config.stoch, config.classes, TASK.action_size, config.units
    params = random_parameters(setting.rng(), config, TASK, setting.dtype)
    good = {"deter": (3, D), "stoch": (3, S, C), "action": (3, A)}
    wrong: tuple[int, ...]
    for name, wrong in (("deter", (3, D + 1)), ("stoch", (3, S * C)), ("stoch", (3, C, S)), ("action", (3, A - 1))):
        arrays = map(np.zeros, (good | {name: wrong}).values())
        yield refused("core", params, *arrays, config, naming=[name, listed(wrong)])
    for name, wrong in (
        ("deter", (1, D)), ("stoch", (1, S, C)), ("action", (1, A)), ("action", (A,)), ("action", (4, A)),
    ):  # fmt: skip
        yield refused("core", params, *map(np.zeros, (good | {name: wrong}).values()), config)
    short, long = np.zeros((3, D - 1)), np.zeros((3, E + 1))
    yield refused("prior", params, short, config, naming=["deter", f"3, {D - 1}"])
    yield refused("posterior", params, short, np.zeros((3, E)), config, naming=["deter", f"3, {D - 1}"])
    yield refused("posterior", params, np.zeros((3, D)), long, config, naming=["tokens", f"3, {E + 1}"])
    for deter, tokens in (((1, D), (3, E)), ((3, D), (1, E)), ((3, D), (E,))):
        yield refused("posterior", params, np.zeros(deter), np.zeros(tokens), config)


def listed(shape: tuple[int, ...]) -> str:
    """What every message about a shape must hold."""
    return ", ".join(map(str, shape))


@check("RSSM-27", "CON-8", uses=["observe", "imagine"], level=1)
def sequences_refuse_shapes(setting: Setting) -> Cases:
    """Wrong sizes are refused by name; and different numbers of rows or steps, also where they could be broadcast."""
    config = small_config(setting.profile, setting.dtype)
    B, T, H, A, E = ROWS, STEPS, HORIZON, TASK.action_size, config.units
    D, S, C = config.deter, config.stoch, config.classes
    params, carry, tokens, prev_action, is_first, uniform, _ = observe_arguments(setting, setting.seed, config)
    good = {"carry": carry, "tokens": tokens, "prev_action": prev_action, "is_first": is_first, "uniform": uniform}
    for name, wrong in (
        ("tokens", (B, T, E + 1)),
        ("prev_action", (B, T, A - 1)),
        ("uniform", (B, T, S + 1)),
        ("uniform", (B, T, 1)),
    ):
        yield refused("observe", params, *(good | {name: np.zeros(wrong)}).values(), config, naming=[name])
    lengths: dict[str, list[tuple[int, ...]]] = {
        "tokens": [(B, T - 1, E), (1, T, E), (B, E)],
        "prev_action": [(B, T + 1, A), (1, T, A), (B, T)],
        "uniform": [(1, T, S), (B, T - 1, S)],
        "is_first": [(B,), (1, T), (B, T, 1), (B, T + 1)],
    }
    for name, shapes in lengths.items():  # here the message may as well name the argument that this one does not fit
        for shape in shapes:
            array = np.zeros(shape, bool if name == "is_first" else float)
            yield refused("observe", params, *(good | {name: array}).values(), config)
    action, uniform = np.zeros((B, H, A)), np.zeros((B, H, S))
    carries: dict[str, list[tuple[int, ...]]] = {
        "deter": [(B, D - 1), (1, D)],
        "stoch": [(B, S * C), (B, C, S), (1, S, C)],
    }
    for name, shapes in carries.items():
        for shape in shapes:
            changed, naming = carry | {name: np.zeros(shape)}, [name, listed(shape)] if shape[0] == B else []
            yield refused("observe", params, *(good | {"carry": changed}).values(), config, naming=naming)
            yield refused("imagine", params, changed, action, uniform, config, naming=naming)
    for shape in ((B, H, S + 1), (B, H, 1)):
        yield refused("imagine", params, carry, action, np.zeros(shape), config, naming=["uniform"])
    for shape in ((B, S), (1, H, S)):
        yield refused("imagine", params, carry, action, np.zeros(shape), config)
    for shape in ((B, H, A + 1), (1, H, A)):
        yield refused("imagine", params, carry, np.zeros(shape), uniform, config)
