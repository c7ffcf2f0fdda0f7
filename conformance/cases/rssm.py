"""Checks of spec/04-rssm.md."""

import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.check import Run, check, round_to
from conformance.problems import random_actions, random_carry, random_parameters, small_config, spaces
from conformance.strategies import normals, seeds
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


def margin(run: Run) -> float:
    """How far samples keep from class boundaries: more than the probabilities err in the candidate's dtype."""
    return 0.05 if run.dtype == "bfloat16" else 1e-4


def safe_uniform(rng: np.random.Generator, logits: np.ndarray, config: Config, distance: float) -> np.ndarray:
    """For each latent a number that picks a random class, no nearer than `distance` to where another class begins."""
    probs = np.exp(unimix_log_probs(logits, config.latent_unimix))
    index = np.where(probs > 2 * distance, rng.random(probs.shape), -1).argmax(-1)[..., None]
    high, share = np.cumsum(probs, -1), rng.random(index.shape)
    low = np.take_along_axis(high - probs, index, -1) + distance
    return round_to((low + share * (np.take_along_axis(high, index, -1) - distance - low))[..., 0], "float32")


def observe_arguments(run: Run, seed: int, config: Config, is_first: np.ndarray | None = None) -> tuple[Any, ...]:
    """Arguments of `observe`: uniforms are chosen step by step, so that no sample is near a class boundary."""
    rng = np.random.default_rng(seed)
    params = random_parameters(rng, config, TASK, run.dtype)
    carry = random_carry(rng, config, (ROWS,))
    tokens = round_to(rng.normal(size=(ROWS, STEPS, config.units)), "bfloat16")
    prev_action = random_actions(rng, TASK, (ROWS, STEPS))
    is_first = rng.random((ROWS, STEPS)) < 0.3 if is_first is None else is_first
    uniform, state = np.zeros((ROWS, STEPS, config.stoch)), carry
    for t in range(STEPS):
        inputs = params, state, tokens[:, t], prev_action[:, t], is_first[:, t]
        logits = reference.observe_step(*inputs, uniform[:, t], config)[1]
        uniform[:, t] = safe_uniform(rng, logits, config, margin(run))
        state = reference.observe_step(*inputs, uniform[:, t], config)[0]
    return params, carry, tokens, prev_action, is_first, uniform, config


def imagine_arguments(run: Run, seed: int, config: Config) -> tuple[Any, ...]:
    """Arguments of `imagine`, chosen in the same way. Actions are float32 numbers that bfloat16 cannot hold."""
    rng = np.random.default_rng(seed)
    params = random_parameters(rng, config, TASK, run.dtype)
    carry = random_carry(rng, config, (ROWS,))
    action = round_to(random_actions(rng, TASK, (ROWS, HORIZON)) * 1.1, "float32")
    uniform, deter, stoch = np.zeros((ROWS, HORIZON, config.stoch)), carry["deter"], carry["stoch"]
    for t in range(HORIZON):
        deter = reference.core(params, deter, stoch, action[:, t], config)
        logits = reference.prior(params, deter, config)
        uniform[:, t] = safe_uniform(rng, logits, config, margin(run))
        stoch = reference.categorical_sample(unimix_log_probs(logits, config.latent_unimix), uniform[:, t])
    return params, carry, action, uniform, config


def reference_imagine(
    params: Any, carry: Any, action: np.ndarray, uniform: np.ndarray, config: Config
) -> dict[str, np.ndarray]:
    return reference.imagine(params, carry, lambda feature, t: action[:, t], uniform, config)


@check("RSSM-7", uses=["core"], level=1)
def gates_literals(run: Run) -> None:
    """Memories 0.2, -0.5 and 1 with gate inputs (0, 1, 1), (1, 2, 0) and (0, 0, 0) become 0.331059, -0.124003 and
    0.731059."""
    config = small_config(run.profile, run.dtype, deter=3, blocks=1)
    params = zero_parameters(config) | {"rssm/gru/bias": np.array([0.0, 1, 0, 1, 2, 0, 1, 0, 0])}
    inputs = run.cast([[0.2, -0.5, 1.0]]), np.zeros((1, config.stoch, config.classes)), np.zeros((1, TASK.action_size))
    expected = np.array([[0.331059, -0.124003, 0.731059]])
    run.expect(
        "core", (params, *inputs, config), expected, magnitude=1.0, bound=2e-2 if run.dtype == "bfloat16" else 2e-6
    )


@check("RSSM-6", uses=["core"], level=1)
def gates_are_split_inside_each_block(run: Run) -> None:
    """With 4 memory units in 2 blocks, the gate outputs are r0 r1 c0 c1 u0 u1 r2 r3 c2 c3 u2 u3."""
    config = small_config(run.profile, run.dtype, deter=4, blocks=2)
    bias = np.array([100, 100, 0.25, 0.5, 100, 100, 100, 100, 0.75, 1, 100, 100])
    inputs = np.ones((1, 4)), np.zeros((1, config.stoch, config.classes)), np.zeros((1, TASK.action_size))
    expected = np.tanh([[0.25, 0.5, 0.75, 1.0]])
    run.expect("core", (zero_parameters(config) | {"rssm/gru/bias": bias}, *inputs, config), expected)


@check("RSSM-3", "RSSM-4", "RSSM-5", uses=["core"], level=1)
def inputs_of_the_blocks(run: Run) -> None:
    """The blocks read (1, 2, 7, 8, 9) and (3, 4, 7, 8, 9): their memory, then all embeddings; RMSNorm runs over both
    blocks together."""
    config = small_config(run.profile, run.dtype, deter=4, blocks=2, units=1, norm_epsilon=1e-20)
    params = zero_parameters(config) | {"rssm/hidden/scale": np.ones(4), "rssm/hidden/bias": np.array([0.0, 8, 0, 8])}
    for name, scale in (
        ("deter", 7.0),
        ("stoch", 8.0),
        ("action", 9.0),
    ):  # one unit: RMSNorm leaves the sign of the bias times the scale
        params |= {f"rssm/embed_{name}/bias": np.ones(1), f"rssm/embed_{name}/scale": np.array([scale])}
    params["rssm/gru/bias"] = np.array([100.0, 100, 0, 0, 100, 100] * 2)
    params["rssm/gru/kernel"][:, 0, 2] = (
        1  # the candidate of each block's first unit reads the block's first hidden unit
    )
    inputs = np.array([[1.0, 2, 3, 4]]), np.zeros((1, config.stoch, config.classes)), np.zeros((1, TASK.action_size))
    embeddings = [x / (1 + math.exp(-x)) for x in (7, 8, 9)]
    for index, (first, second) in enumerate(zip([1, 2, *embeddings], [3, 4, *embeddings], strict=True)):
        kernel = np.zeros_like(params["rssm/hidden/kernel"])
        kernel[:, index, 0] = 1
        hidden = np.array([first, second]) / math.sqrt((first**2 + second**2 + 2 * 8**2) / 4)
        candidate = np.tanh(hidden / (1 + np.exp(-hidden)))
        expected = np.array([[candidate[0], 0, candidate[1], 0]])
        run.expect("core", (params | {"rssm/hidden/kernel": kernel}, *inputs, config), expected, magnitude="tensor")


@check("RSSM-1", "RSSM-2", "RSSM-3", "RSSM-4", "RSSM-5", "RSSM-6", "RSSM-7", "RSSM-26", uses=["core"], level=1)
def core_matches(run: Run) -> None:
    """Random memories, latents that are one-hot or zero, and actions of any scale; many blocks, and few."""

    @run.for_all(seed=seeds(), sizes=SIZES, scale=st.sampled_from([1e-3, 1.0, 1e3, 1e30]))
    def _(seed: int, sizes: dict[str, Any], scale: float) -> None:
        rng, config = np.random.default_rng(seed), small_config(run.profile, run.dtype, **sizes)
        params, carry = random_parameters(rng, config, TASK, run.dtype), random_carry(rng, config, (ROWS,))
        stoch = carry["stoch"] * (rng.random((ROWS, 1, 1)) < 0.8)
        arguments = params, carry["deter"], stoch, run.cast(normals(seed, ROWS, TASK.action_size, scale=scale)), config
        run.expect("core", arguments, reference.core(*arguments), magnitude="tensor")


@check("RSSM-2", uses=["core"], level=1)
def large_actions_count_as_one(run: Run) -> None:
    """Entries outside [-1, 1] count exactly as 1 or -1, others as they are."""
    config = small_config(run.profile, run.dtype)
    rng = run.rng()
    params, carry = random_parameters(rng, config, TASK, run.dtype), random_carry(rng, config, (2,))
    action = np.array([[-3.0, 0.5, 2, 1, 1e30, -0.25, 0], [1, -1, 5, -7, 0.125, 0, -1e30]])
    limited = np.clip(action, -1, 1)
    before = run.call("core", params, carry["deter"], carry["stoch"], run.cast(action), config)
    run.exact("core", run.call("core", params, carry["deter"], carry["stoch"], limited, config), before)
    expected = reference.core(params, carry["deter"], carry["stoch"], limited, config)
    run.compare("core", before, expected, magnitude="tensor")


@check("RSSM-8", "RSSM-9", "RSSM-10", "RSSM-26", uses=["prior", "posterior"], level=1)
def logits_literals(run: Run) -> None:
    """With zero weights the logits are the biases of the output layer, row by row, before any mixture or
    normalization."""
    config = small_config(run.profile, run.dtype)
    bias = np.arange(15.0) * 16
    params = zero_parameters(config) | {"rssm/prior/out/bias": bias, "rssm/posterior/out/bias": -bias}
    expected = np.tile(bias.reshape(3, 5), (2, 1, 1))
    run.exact("prior", run.call("prior", params, np.ones((2, config.deter)), config), expected)
    run.exact(
        "posterior",
        run.call("posterior", params, np.ones((2, config.deter)), np.ones((2, config.units)), config),
        -expected,
    )


@check("RSSM-8", "RSSM-9", "RSSM-10", "RSSM-26", uses=["prior", "posterior"], level=1)
def logits_match(run: Run) -> None:
    """Random memories and tokens, of any scale, and other depths than usual."""

    @run.for_all(seed=seeds(), sizes=SIZES, scale=st.sampled_from([1e-2, 1.0, 30.0]))
    def _(seed: int, sizes: dict[str, Any], scale: float) -> None:
        config = small_config(run.profile, run.dtype, **sizes)
        params = random_parameters(np.random.default_rng(seed), config, TASK, run.dtype)
        deter = run.cast(normals(seed + 1, ROWS, config.deter))
        tokens = run.cast(normals(seed + 2, ROWS, config.units, scale=scale))
        run.expect("prior", (params, deter, config), reference.prior(params, deter, config), magnitude="tensor")
        expected = reference.posterior(params, deter, tokens, config)
        run.expect("posterior", (params, deter, tokens, config), expected, magnitude="tensor")


@check("RSSM-1", "RSSM-8", "RSSM-9", uses=["core", "prior", "posterior"], level=1)
def leading_axes(run: Run) -> None:
    """No leading axes, or two of them."""
    config = small_config(run.profile, run.dtype)
    rng = run.rng()
    params = random_parameters(rng, config, TASK, run.dtype)
    for leading in ((), (2, 3)):
        carry, action = random_carry(rng, config, leading), random_actions(rng, TASK, leading)
        deter, stoch = carry["deter"], carry["stoch"]
        tokens = round_to(rng.normal(size=(*leading, config.units)), "bfloat16")
        core, prior = (params, deter, stoch, action, config), (params, deter, config)
        run.expect("core", core, reference.core(*core), magnitude="tensor")
        run.expect("prior", prior, reference.prior(*prior), magnitude="tensor")
        posterior = (params, deter, tokens, config)
        run.expect("posterior", posterior, reference.posterior(*posterior), magnitude="tensor")


def sample_both(run: Run, config: Config, logits: np.ndarray, uniform: np.ndarray, expected: np.ndarray) -> None:
    """Samples of posterior and prior, whose logits [S, C] are given as biases: the classes [N, S] must be as
    expected."""
    bias = logits.reshape(-1)
    params = zero_parameters(config) | {"rssm/prior/out/bias": bias, "rssm/posterior/out/bias": bias}
    rows, onehot = len(uniform), np.eye(config.classes)[expected]
    carry = {"deter": np.zeros((rows, config.deter)), "stoch": np.zeros((rows, config.stoch, config.classes))}
    action, tokens = np.zeros((rows, 1, TASK.action_size)), np.zeros((rows, 1, config.units))
    uniform = round_to(uniform[:, None], "float64" if run.dtype == "float64" else "float32")
    observed = run.call("observe", params, carry, tokens, action, np.zeros((rows, 1), bool), uniform, config)
    run.exact("posterior sample", observed["stoch"][:, 0], onehot)
    run.exact("posterior logits", observed["logits"][:, 0], np.broadcast_to(logits, onehot.shape))
    run.exact("prior sample", run.call("imagine", params, carry, action, uniform, config)["stoch"][:, 1], onehot)


@check("RSSM-10", "RSSM-11", "RSSM-12", uses=["observe", "imagine"], level=1)
def sampling_literals(run: Run) -> None:
    """Probabilities (1/4, 3/4) give class 0 at 0.251 with one percent of uniform mixture and class 1 without; 0 and
    almost 1."""
    logits = round_to(
        LATENTS, "bfloat16"
    )  # so that every dtype holds them: 0.2495 instead of 0.25, and likewise with 0.7505
    mixed = small_config(run.profile, run.dtype, stoch=4, classes=2, latent_unimix=0.01)
    sample_both(run, mixed, logits, FRACTION, np.array([[0, 0, 0, 0], [1, 0, 0, 1], [0, 1, 1, 0], [1, 1, 1, 1]]))
    plain = small_config(run.profile, run.dtype, stoch=4, classes=2, latent_unimix=0.0)
    sample_both(run, plain, logits, FRACTION, np.array([[1, 0, 0, 1], [1, 0, 0, 1], [0, 1, 1, 1], [1, 1, 1, 1]]))


@check("RSSM-10", "RSSM-11", "RSSM-12", "RSSM-26", "CON-17", uses=["observe", "imagine"], level=1)
def sampling_near_boundaries(run: Run) -> None:
    """Uniform numbers just below and above where a class begins, or just below 1: sums of probabilities are at least
    float32."""
    config = small_config(run.profile, run.dtype)
    distance = 1e-9 if run.dtype == "float64" else 1e-5

    @run.for_all(seed=seeds(), scale=st.sampled_from([0.1, 1.0, 3.0]))
    def _(seed: int, scale: float) -> None:
        logits = round_to(normals(seed, config.stoch, config.classes, scale=scale), "bfloat16")
        ends = np.cumsum(np.exp(unimix_log_probs(logits, config.latent_unimix)), -1)
        rng = np.random.default_rng(seed + 1)
        index = rng.integers(0, config.classes - 1, (8, config.stoch))
        side = rng.integers(0, 2, index.shape)
        uniform = ends[np.arange(config.stoch), index] + (2 * side - 1) * distance
        uniform[0], largest = 1 - (2.0**-53 if run.dtype == "float64" else 2.0**-24), config.classes - 1
        sample_both(run, config, logits, uniform, np.where(uniform == uniform[0], largest, index + side))


@check("RSSM-12", *(f"RSSM-{n}" for n in range(13, 20)), "CON-12", uses=["observe"], level=1)
def observe_matches(run: Run) -> None:
    """Memories, exactly one-hot samples and logits of random sequences, with resets at any step of any row."""

    @run.for_all(seed=seeds(), sizes=SIZES)
    def _(seed: int, sizes: dict[str, Any]) -> None:
        arguments = observe_arguments(run, seed, small_config(run.profile, run.dtype, **sizes))
        expected = reference.observe(*arguments)
        actual = run.expect("observe", arguments, expected, magnitude="tensor")
        run.exact("stoch", actual["stoch"], expected["stoch"])


@check("RSSM-13", "RSSM-14", "RSSM-17", "CON-12", uses=["observe"], level=1)
def resets_forget_everything(run: Run) -> None:
    """Nothing before a reset changes anything from it on, not even as NaN or infinity; rows without a reset notice
    nothing."""
    config = small_config(run.profile, run.dtype)
    is_first = np.zeros((ROWS, STEPS), bool)
    is_first[0, 0] = is_first[1, 2] = True
    params, carry, *sequences, config = observe_arguments(run, run.seed, config, is_first)
    before = run.call("observe", params, carry, *sequences, config)
    for bad in (np.nan, np.inf, 1e30):
        spoiled_carry = {name: value.copy() for name, value in carry.items()}
        tokens, prev_action, _, uniform = (x.copy() for x in sequences)
        for row, reset in ((0, 0), (1, 2)):
            spoiled_carry["deter"][row] = spoiled_carry["stoch"][row] = bad
            tokens[row, :reset] = prev_action[row, : reset + 1] = bad
            uniform[row, :reset] = 1 - uniform[row, :reset]
        with np.errstate(invalid="ignore"):
            after = run.call("observe", params, spoiled_carry, tokens, prev_action, is_first, uniform, config)
        for name in ("deter", "stoch", "logits"):
            for row, start in ((0, 0), (1, 2), (2, 0)):
                run.exact(f"{name} of row {row} with {bad}", after[name][row, start:], before[name][row, start:])


@check("RSSM-13", "RSSM-15", "CON-5", uses=["observe"], level=1)
def a_reset_is_a_start_from_zeros(run: Run) -> None:
    """A reset at the first step equals, in every bit, no reset with zeros for memory, latents and the whole previous
    action."""
    config = small_config(run.profile, run.dtype)
    is_first = np.zeros((ROWS, STEPS), bool)
    is_first[:, 0] = True
    params, carry, tokens, prev_action, is_first, uniform, config = observe_arguments(run, run.seed, config, is_first)
    reset = run.call("observe", params, carry, tokens, prev_action, is_first, uniform, config)
    zeros = {name: np.zeros_like(value) for name, value in carry.items()}
    prev_action = prev_action.copy()
    prev_action[:, 0] = 0
    started = run.call("observe", params, zeros, tokens, prev_action, np.zeros_like(is_first), uniform, config)
    for name in ("deter", "stoch", "logits"):
        run.exact(name, reset[name], started[name])


@check("RSSM-2", "RSSM-10", "RSSM-11", "RSSM-20", "RSSM-21", "RSSM-22", uses=["imagine"], level=1)
def imagine_matches(run: Run) -> None:
    """Trajectories under given actions: the start unchanged, samples of the prior fed back, actions as they were
    given."""

    @run.for_all(seed=seeds(), sizes=SIZES)
    def _(seed: int, sizes: dict[str, Any]) -> None:
        arguments = imagine_arguments(run, seed, small_config(run.profile, run.dtype, **sizes))
        expected = reference_imagine(*arguments)
        actual = run.expect("imagine", arguments, expected, magnitude="tensor")
        run.exact("stoch", actual["stoch"], expected["stoch"])
        run.exact("action", actual["action"], expected["action"])
        run.exact("deter of the start", actual["deter"][:, 0], expected["deter"][:, 0])


@check("RSSM-26", uses=["core", "observe", "imagine"], level=1, dtypes=("bfloat16",))
def memory_is_rounded_at_every_step(run: Run) -> None:
    """Every new memory is a number that the compute dtype can hold."""
    config = small_config(run.profile, run.dtype)
    params, carry, action, uniform, config = imagine_arguments(run, run.seed, config)
    memories = {
        "core": run.call("core", params, carry["deter"], carry["stoch"], run.cast(action[:, 0]), config),
        "observe": run.call("observe", *observe_arguments(run, run.seed, config))["deter"],
        "imagine": run.call("imagine", params, carry, action, uniform, config)["deter"],
    }
    for name, deter in memories.items():
        run.exact(name, deter, run.cast(deter))


@check("RSSM-27", "CON-8", uses=["core", "prior", "posterior"], level=1)
def steps_refuse_shapes(run: Run) -> None:
    """Wrong sizes are refused, with name and shape; and different numbers of rows, also where they could be
    broadcast."""
    config = small_config(run.profile, run.dtype)
    D, S, C, A, E = config.deter, config.stoch, config.classes, TASK.action_size, config.units
    params = random_parameters(run.rng(), config, TASK, run.dtype)
    good = {"deter": (3, D), "stoch": (3, S, C), "action": (3, A)}
    sizes: tuple[tuple[str, tuple[int, ...]], ...] = (
        ("deter", (3, D + 1)),
        ("stoch", (3, S * C)),
        ("stoch", (3, C, S)),
        ("action", (3, A - 1)),
    )
    for name, wrong in sizes:
        run.refuses(
            "core", params, *map(np.zeros, (good | {name: wrong}).values()), config, naming=[name, listed(wrong)]
        )
    rows: tuple[tuple[str, tuple[int, ...]], ...] = (
        ("deter", (1, D)), ("stoch", (1, S, C)), ("action", (1, A)), ("action", (A,)), ("action", (4, A)),
    )  # fmt: skip
    for name, wrong in rows:
        run.refuses("core", params, *map(np.zeros, (good | {name: wrong}).values()), config)
    run.refuses("prior", params, np.zeros((3, D - 1)), config, naming=["deter", f"3, {D - 1}"])
    run.refuses("posterior", params, np.zeros((3, D - 1)), np.zeros((3, E)), config, naming=["deter", f"3, {D - 1}"])
    run.refuses("posterior", params, np.zeros((3, D)), np.zeros((3, E + 1)), config, naming=["tokens", f"3, {E + 1}"])
    for deter, tokens in (((1, D), (3, E)), ((3, D), (1, E)), ((3, D), (E,))):
        run.refuses("posterior", params, np.zeros(deter), np.zeros(tokens), config)


def listed(shape: tuple[int, ...]) -> str:
    """What every message about a shape must hold."""
    return ", ".join(map(str, shape))


@check("RSSM-27", "CON-8", uses=["observe", "imagine"], level=1)
def sequences_refuse_shapes(run: Run) -> None:
    """Wrong sizes are refused by name; and different numbers of rows or steps, also where they could be broadcast."""
    config = small_config(run.profile, run.dtype)
    B, T, H, D, S, C, A, E = (
        ROWS,
        STEPS,
        HORIZON,
        config.deter,
        config.stoch,
        config.classes,
        TASK.action_size,
        config.units,
    )
    params, carry, tokens, prev_action, is_first, uniform, _ = observe_arguments(run, run.seed, config)
    good = {"carry": carry, "tokens": tokens, "prev_action": prev_action, "is_first": is_first, "uniform": uniform}
    for name, wrong in (
        ("tokens", (B, T, E + 1)),
        ("prev_action", (B, T, A - 1)),
        ("uniform", (B, T, S + 1)),
        ("uniform", (B, T, 1)),
    ):
        run.refuses("observe", params, *(good | {name: np.zeros(wrong)}).values(), config, naming=[name])
    lengths: dict[str, list[tuple[int, ...]]] = {
        "tokens": [(B, T - 1, E), (1, T, E), (B, E)],
        "prev_action": [(B, T + 1, A), (1, T, A), (B, T)],
        "uniform": [(1, T, S), (B, T - 1, S)],
        "is_first": [(B,), (1, T), (B, T, 1), (B, T + 1)],
    }
    for name, shapes in lengths.items():  # here the message may as well name the argument that this one does not fit
        for shape in shapes:
            array = np.zeros(shape, bool if name == "is_first" else float)
            run.refuses("observe", params, *(good | {name: array}).values(), config)
    action, uniform = np.zeros((B, H, A)), np.zeros((B, H, S))
    carries: dict[str, list[tuple[int, ...]]] = {
        "deter": [(B, D - 1), (1, D)],
        "stoch": [(B, S * C), (B, C, S), (1, S, C)],
    }
    for name, shapes in carries.items():
        for shape in shapes:
            changed, naming = carry | {name: np.zeros(shape)}, [name, listed(shape)] if shape[0] == B else []
            run.refuses("observe", params, *(good | {"carry": changed}).values(), config, naming=naming)
            run.refuses("imagine", params, changed, action, uniform, config, naming=naming)
    for shape in ((B, H, S + 1), (B, H, 1)):
        run.refuses("imagine", params, carry, action, np.zeros(shape), config, naming=["uniform"])
    for shape in ((B, S), (1, H, S)):
        run.refuses("imagine", params, carry, action, np.zeros(shape), config)
    run.refuses("imagine", params, carry, np.zeros((B, H, A + 1)), uniform, config)
    run.refuses("imagine", params, carry, np.zeros((1, H, A)), uniform, config)
