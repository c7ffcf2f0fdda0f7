"""Checks of spec/02-distributions.md."""

import dataclasses
import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.cases.transforms import SMALL_BINS, held_bins
from conformance.check import Run, check, round_to
from conformance.problems import random_parameters, small_config, spaces, uniforms
from conformance.strategies import adversarial_numbers, arrays, normals, seeds
from reference_numpy import distributions as reference
from reference_numpy.transforms import symlog

# Numbers in the chapter have seven digits; in bfloat16 already the rounded inputs move the results by a percent.
LITERAL = {"float64": 1e-6, "float32": 4e-6, "bfloat16": 3e-2}
LEADING = st.sampled_from([(), (2, 3)])
CATEGORICAL = st.sampled_from([(5,), (3, 1), (2, 3, 64)])
LOGITS = st.one_of(
    st.floats(-20, 20, width=32), st.sampled_from([0.0, -0.0, 1e-45, 100.0, -1e4, 1e30, -1e30, -math.inf])
)
# Small, so that no result is near the edge of a precision, where float32 may and may not overflow.
FINITE = st.one_of(
    st.floats(-1e4, 1e4, width=32), st.floats(-3, 3, width=32), st.sampled_from([0.0, -0.0, 1e-45, 1e-20, 1e9])
)
LN_2 = math.log(2)


def held(run: Run, x: Any) -> np.ndarray:
    """A result as float32 or float64 holds it: float32 overflows where float64, which a candidate is free to use, does
    not."""
    return round_to(x, "float64" if run.dtype == "float64" else "float32")


def expect_held(run: Run, function: str, arguments: tuple[Any, ...], **how: Any) -> None:
    """Compares with the reference, both after overflow."""
    with np.errstate(all="ignore"):
        expected = held(run, getattr(reference, function)(*arguments))
    run.compare(function, held(run, run.call(function, *arguments)), expected, **how)


def log_probs_of(run: Run, seed: int, shape: tuple[int, ...], scale: float = 3.0, unimix: float = 0.01) -> np.ndarray:
    return run.cast(reference.unimix_log_probs(normals(seed, *shape, scale=scale), unimix))


def summed_magnitude(classes: int, products: np.ndarray) -> np.ndarray:
    """[DIS-13], in units of the spacing."""
    return (classes + 16) * np.where(np.isfinite(products), np.abs(products), 0).sum(-1)


@check("DIS-5", uses=["unimix_log_probs"], level=0)
def mixture_literals(run: Run) -> None:
    """Logits ln 8, 0, 0 with 1 percent uniform are ln of .7953, .1023, .1023; without it a logit 1000 below has
    log-probability -1000."""
    logits = run.cast([math.log(8), 0, 0])
    mixed = np.array([-0.2289940, -2.2795198, -2.2795198])
    run.expect("unimix_log_probs", (logits, 0.01), mixed, magnitude=1.0, bound=LITERAL[run.dtype])
    run.expect("unimix_log_probs", (logits, 0.0), np.log([0.8, 0.1, 0.1]), magnitude=1.0, bound=LITERAL[run.dtype])
    run.expect("unimix_log_probs", (logits, 1.0), np.full(3, -math.log(3)), bound=16 * run.u)
    apart = run.cast([[0.0, -1000], [1000, 0], [-1000, -2000]])
    first = np.array([0.0, -1000])
    run.expect("unimix_log_probs", (apart, 0.0), np.tile(first, (3, 1)), magnitude=1024, bound=16 * run.u)
    run.expect(
        "unimix_log_probs", (apart, 0.01), np.tile(np.log([0.995, 0.005]), (3, 1)), magnitude=1.0, bound=64 * run.u
    )
    smallest = run.call("unimix_log_probs", np.where(np.arange(64) == 3, 100.0, 0.0), 0.01)
    run.compare("the least of 64 classes", np.min(smallest), math.log(0.01 / 64), bound=16 * run.u)


@check("DIS-1", "DIS-3", "DIS-5", "CON-23", uses=["unimix_log_probs"], level=0)
def mixture_matches(run: Run) -> None:
    """Logits of any size up to 1e30 and minus infinity, any leading axes and number of classes, any share of the
    mixture."""

    @run.for_all(
        logits=CATEGORICAL.flatmap(lambda shape: arrays(LOGITS, shape)), unimix=st.sampled_from([0.0, 0.01, 0.5])
    )
    def _(logits: np.ndarray, unimix: float) -> None:
        logits = run.cast(np.where(np.arange(logits.shape[-1]) == 0, np.maximum(logits, -1e30), logits))
        below = logits.max(-1, keepdims=True) - logits
        magnitude = logits.shape[-1] + 16 + 2 * np.where(np.isfinite(below), below, 0)
        expected = reference.unimix_log_probs(logits, unimix)
        run.expect("unimix_log_probs", (logits, unimix), expected, magnitude=magnitude, bound=run.u)

    whole = np.array([-3.0, 0, 2, 1])
    expected = reference.unimix_log_probs(whole, 0.0)
    for shift in (0, 64, -128):
        run.expect("unimix_log_probs", (whole + shift, 0.0), expected, magnitude=20 + 10, bound=run.u)


@check("DIS-6", uses=["unimix_log_probs"], level=0)
def mixture_of_special_logits(run: Run) -> None:
    """Minus infinity is probability 0; one NaN or plus infinity, or nothing but minus infinity, makes all classes NaN,
    in its row only."""
    inf, nan = math.inf, math.nan
    logits = np.array(
        [
            [0, -inf, 0],
            [nan, 0, 0],
            [0, inf, 0],
            [-inf] * 3,
            [inf, -inf, 0],
            [inf] * 3,
            [-inf, nan, -inf],
            [-inf, -inf, 7.0],
        ]
    )
    for unimix in (0.0, 0.01):
        s = np.array([[0.5, 0, 0.5]] + [[nan] * 3] * 6 + [[0, 0, 1]])
        with np.errstate(divide="ignore"):
            expected = np.log((1 - unimix) * s + unimix / 3)
        run.expect("unimix_log_probs", (logits, unimix), expected, magnitude=1.0, bound=64 * run.u)
        huge = run.cast(1.7e308 if run.dtype == "float64" else 3e38)
        expect_held(run, "unimix_log_probs", (np.array([huge, -huge]), unimix), magnitude=1.0, bound=64 * run.u)


@check("DIS-7", uses=["observe", "kl_losses"], level=1)
def latents_are_mixed(run: Run) -> None:
    """With a share of 1 latents are uniform and posterior and prior agree, whatever the logits; with 1/2 the KL is that
    of the mixtures."""
    config, task = small_config(run.profile, run.dtype, latent_unimix=1.0, free_nats=0.0), spaces("vector", "discrete")
    rng, N, T, S, C = run.rng(), 2, 3, config.stoch, config.classes
    params = random_parameters(rng, config, task, run.dtype)
    classes = rng.integers(0, C, (N, T, S))
    carry = {"deter": np.zeros((N, config.deter)), "stoch": np.zeros((N, S, C))}
    arguments = (np.zeros((N, T, config.units)), np.zeros((N, T, task.action_size)), np.zeros((N, T), bool))
    states = run.call("observe", params, carry, *arguments, run.cast((classes + 0.5) / C), config)
    run.exact("classes of uniform latents", np.round(states["stoch"], 3), np.eye(C)[classes])
    posterior, prior = run.cast(rng.normal(0, 5, (2, N, S, C)))
    run.compare(
        "KL of uniform latents",
        run.call("kl_losses", posterior, prior, config),
        (np.zeros(N),) * 2,
        magnitude=1.0,
        bound=64 * run.u,
    )
    half = dataclasses.replace(config, latent_unimix=0.5)
    p, q = (np.exp(x) / np.exp(x).sum(-1, keepdims=True) / 2 + 0.5 / C for x in (posterior, prior))
    kl = (p * np.log(p / q)).sum((-1, -2))
    run.compare(
        "KL of the mixtures",
        run.call("kl_losses", posterior, prior, half),
        (kl, kl),
        magnitude=1 + kl,
        bound=256 * run.u,
    )


@check("DIS-7", uses=["reconstruction_losses", "action_entropy"], level=1)
def the_actor_is_mixed_and_the_decoder_is_not(run: Run) -> None:
    """Discrete observations are scored without a mixture, whatever the shares; discrete actions with `actor_unimix`."""
    config, task = (
        small_config(run.profile, run.dtype, latent_unimix=0.5, actor_unimix=1.0),
        spaces("vector", "discrete"),
    )
    predictions = {"mode": np.array([[0, 0, 64.0, 8, 0]]), "position": np.zeros((1, 3))}
    losses = run.call(
        "reconstruction_losses", predictions, {"mode": np.array([[0, 1]]), "position": np.zeros((1, 3))}, task, config
    )
    run.compare("mode", losses["mode"], np.array([64 + 8 + math.log1p(math.exp(-8))]), bound=64 * run.u)
    entropy = run.call("action_entropy", {"action": {"logits": np.array([[9.0, 0, 0, 0]])}}, task, config)
    run.compare("entropy of a uniform actor", entropy, np.array([math.log(4)]), bound=64 * run.u)


@check("DIS-8", "CON-17", uses=["categorical_sample"], level=0)
def sample_literals(run: Run) -> None:
    """The class changes where the cumulative sum passes the uniform; probabilities are used as they are, the last sum
    is not needed."""
    log_probs = np.tile(run.cast([-0.2289940, -2.2795198, -2.2795198]), (5, 1))
    sample = run.call("categorical_sample", log_probs, run.cast([0, 0.79, 0.80, 0.90, 0.999]))
    run.exact("cumulative sums 0.795, 0.898", sample, np.eye(3)[[0, 0, 1, 2, 2]])
    quarters = run.cast(np.log(np.full((3, 3), 0.25)))
    run.exact("sum 0.75", run.call("categorical_sample", quarters, run.cast([0.2, 0.4, 0.95])), np.eye(3)[[0, 1, 2]])
    run.exact("sum 0.75", run.call("categorical_sample", quarters[0], run.cast(0.6)), np.eye(3)[2])
    run.exact("one class", run.call("categorical_sample", np.zeros((2, 1)), run.cast([0, 0.99])), np.ones((2, 1)))
    u = run.cast([0, 0.5, 1 - 2**-7])
    for place in range(4):
        certain = np.where(np.arange(4) == place, 0, -np.inf)
        run.exact(
            "a certain class", run.call("categorical_sample", np.tile(certain, (3, 1)), u), np.eye(4)[[place] * 3]
        )


@check("DIS-8", "CON-16", uses=["categorical_sample"], level=0)
def sample_matches(run: Run) -> None:
    """Random probabilities, uniforms that are not near a boundary; the same arguments give the same sample."""

    @run.for_all(seed=seeds(), shape=CATEGORICAL, scale=st.sampled_from([0.1, 3.0, 30.0]))
    def _(seed: int, shape: tuple[int, ...], scale: float) -> None:
        log_probs = log_probs_of(run, seed, shape, scale)
        boundaries = np.exp(log_probs).cumsum(-1)[..., :-1]
        drawn = run.cast(uniforms(np.random.default_rng(seed), 64, *shape[:-1]))
        margin = np.abs(drawn[..., None] - boundaries).min(-1, initial=1)
        first = np.argmax(margin > min(0.1 / shape[-1], 1e-3), axis=0)
        uniform = np.take_along_axis(drawn, first[None], 0)[0]
        expected = reference.categorical_sample(log_probs, uniform)
        for _ in range(2):
            run.exact("categorical_sample", run.call("categorical_sample", log_probs, uniform), expected)


@check("DIS-8", uses=["categorical_sample"], level=0)
def sample_is_always_one_hot(run: Run) -> None:
    """NaN, infinities, probabilities that sum to less or more than 1 and uniforms outside [0, 1) still give one 1 and
    zeros."""
    bad = np.array([np.nan, -np.inf, np.inf, 0, -50, -1])
    log_probs = np.array([[a, b, c] for a in bad for b in bad for c in (0, np.nan, -np.inf)])
    for uniform in (0.0, 0.5, 0.99, 1.0, -0.5, np.nan):
        sample = np.asarray(run.call("categorical_sample", log_probs, np.full(len(log_probs), uniform)))
        run.holds("one 1 and zeros", (np.sort(sample, -1) == np.array([0, 0, 1])))


@check("DIS-9", uses=["straight_through"], level=0)
def straight_through_is_the_sample(run: Run) -> None:
    """The value is the sample in every bit, whatever the probabilities."""
    run.exact("probability 0", run.call("straight_through", np.array([-np.inf, 0, -200]), np.eye(3)[0]), np.eye(3)[0])

    @run.for_all(seed=seeds(), shape=CATEGORICAL)
    def _(seed: int, shape: tuple[int, ...]) -> None:
        sample = np.eye(shape[-1])[np.random.default_rng(seed).integers(0, shape[-1], shape[:-1])]
        run.exact("straight_through", run.call("straight_through", log_probs_of(run, seed, shape), sample), sample)


@check(
    "DIS-10",
    "DIS-11",
    "DIS-12",
    "CON-7",
    uses=["categorical_log_prob", "categorical_entropy", "categorical_kl"],
    level=0,
)
def categorical_literals(run: Run) -> None:
    """Entropy 0.6486683 of the example, ln C when uniform; KL 0.1438410 one way, 0.1308120 the other, 0 to itself."""
    bound = LITERAL[run.dtype]
    example = run.cast([-0.2289940, -2.2795198, -2.2795198])
    run.expect("categorical_entropy", (example,), 0.6486683, bound=bound)
    run.expect("categorical_log_prob", (example, np.eye(3)[1]), -2.2795198, bound=bound)
    run.expect("categorical_entropy", (run.cast(np.full(64, -math.log(64))),), math.log(64), bound=bound)
    p, q = run.cast(np.log([0.5, 0.5])), run.cast(np.log([0.25, 0.75]))
    run.expect("categorical_kl", (p, q), 0.1438410, magnitude=1.0, bound=bound)
    run.expect("categorical_kl", (q, p), 0.1308120, magnitude=1.0, bound=bound)
    run.exact("KL of equal distributions", run.call("categorical_kl", example, example), 0.0)


@check("DIS-12", uses=["categorical_kl"], level=0)
def a_negative_divergence_is_not_clipped(run: Run) -> None:
    """Probabilities that sum to 1/2 and to 1 have a KL of -0.3465736: rounded log-probabilities do the same on a
    smaller scale."""
    half = np.full(2, -LN_2)
    run.expect("categorical_kl", (run.cast(half - LN_2), run.cast(half)), -LN_2 / 2, bound=LITERAL[run.dtype])


@check(
    "DIS-3",
    "DIS-10",
    "DIS-11",
    "DIS-12",
    "DIS-13",
    uses=["categorical_log_prob", "categorical_entropy", "categorical_kl"],
    level=0,
)
def categorical_matches(run: Run) -> None:
    """Log-probability, entropy and KL over the last axis only, for sharp and flat distributions."""

    @run.for_all(
        seed=seeds(), shape=CATEGORICAL, scale=st.sampled_from([0.1, 3.0, 30.0]), unimix=st.sampled_from([0.0, 0.01])
    )
    def _(seed: int, shape: tuple[int, ...], scale: float, unimix: float) -> None:
        p, q = (log_probs_of(run, s, shape, scale, unimix) for s in (seed, seed + 1))
        onehot = np.eye(shape[-1])[np.random.default_rng(seed).integers(0, shape[-1], shape[:-1])]
        for function, arguments, products in (
            ("categorical_log_prob", (p, onehot), onehot * p),
            ("categorical_entropy", (p,), np.exp(p) * p),
            ("categorical_kl", (p, q), np.exp(p) * (np.abs(p) + np.abs(q))),
        ):
            expected = getattr(reference, function)(*arguments)
            run.expect(function, arguments, expected, magnitude=summed_magnitude(shape[-1], products), bound=run.u)
        run.exact("KL of equal distributions", run.call("categorical_kl", p, p), np.zeros(shape[:-1]))


@check(
    "DIS-4",
    "DIS-12",
    uses=["categorical_log_prob", "categorical_entropy", "categorical_kl", "symexp_twohot_loss"],
    level=0,
)
def zero_weights_silence(run: Run) -> None:
    """A weight of 0 silences an infinite or NaN logarithm; a class that p has and q has not makes the KL infinite."""
    inf, nan = np.inf, np.nan
    log_probs = np.array([[0.0, -inf, -inf], [-LN_2, -LN_2, -inf], [nan, nan, nan]])
    run.compare(
        "entropy",
        run.call("categorical_entropy", run.cast(log_probs)),
        np.array([0, LN_2, nan]),
        bound=LITERAL[run.dtype],
    )
    chosen = run.call(
        "categorical_log_prob",
        np.array([[-1.0, -inf], [-1, nan], [nan, -2], [-inf, -inf], [-inf, 0]]),
        np.eye(2)[[0, 0, 1, 0, 0]],
    )
    run.exact("log-probability", chosen, np.array([-1, -1, -2, -inf, -inf]))
    run.exact("blanked action", run.call("categorical_log_prob", np.array([-1, -inf, nan]), np.zeros(3)), 0.0)
    p = np.array([[0.0, -inf], [0, -inf], [-LN_2, -LN_2], [-inf, 0]])
    q = np.array([[0.0, -inf], [-LN_2, -LN_2], [0, -inf], [0, -inf]])
    expected = np.array([0, LN_2, inf, inf])
    run.compare(
        "KL", run.call("categorical_kl", run.cast(p), run.cast(q)), expected, magnitude=1.0, bound=LITERAL[run.dtype]
    )
    logits = np.array([-inf, -inf, 0, 0, -inf])
    loss = run.call("symexp_twohot_loss", np.stack([logits] * 3), np.array([0.5, 0, 2.0]), SMALL_BINS)
    run.compare("twohot loss beside infinite logits", loss, np.array([LN_2, LN_2, inf]), bound=16 * run.u)


@check("DIS-14", "DIS-15", uses=["symexp_twohot_loss", "symexp_twohot_mean"], level=0)
def symexp_twohot_literals(run: Run) -> None:
    """255 equal logits: loss ln 255, mean 0. Logits 0, 0, 0, 0, ln 4 over small bins: loss 1.3862944 for the target 2,
    mean 1.125."""
    for level in (0.0, 3.75, -1e4, 1e30):
        logits = run.cast(np.full((2, 255), level))
        loss = run.call("symexp_twohot_loss", logits, run.cast([300.0, -1e12]), held_bins(run))
        run.compare("loss", loss, np.full(2, 5.5412635), bound=LITERAL["float32"])
        run.exact("mean of equal logits", run.call("symexp_twohot_mean", logits, held_bins(run)), np.zeros(2))
    logits = run.cast([0, 0, 0, 0, 2 * LN_2])
    # In symlog space the target 2 would be 1.0986, and the loss 2.0113.
    run.expect("symexp_twohot_loss", (logits, 2.0, SMALL_BINS), 1.3862944, bound=LITERAL[run.dtype])
    for target, loss in ((7.0, LN_2), (np.inf, LN_2), (-9.0, 3 * LN_2), (np.nan, np.nan)):
        run.expect("symexp_twohot_loss", (logits, target, SMALL_BINS), loss, bound=LITERAL[run.dtype])
    run.expect("symexp_twohot_mean", (logits, SMALL_BINS), 1.125, bound=LITERAL[run.dtype])
    for special in (np.nan, np.inf):
        run.exact("mean", run.call("symexp_twohot_mean", np.where(np.arange(5) == 1, special, 0), SMALL_BINS), np.nan)


@check("DIS-1", "DIS-14", "DIS-15", uses=["symexp_twohot_loss", "symexp_twohot_mean"], level=0)
def symexp_twohot_matches(run: Run) -> None:
    """Targets on, beside and between the bins, huge and non-finite; flat and sharp logits."""
    bins = held_bins(run)
    targets = st.one_of(adversarial_numbers(), st.sampled_from([float(x) for x in bins[::17]]))

    @run.for_all(seed=seeds(), target=arrays(targets, (2, 3)), scale=st.sampled_from([0.1, 3.0, 100.0]))
    def _(seed: int, target: np.ndarray, scale: float) -> None:
        logits, target = run.cast(normals(seed, 2, 3, 255, scale=scale)), run.cast(target)
        size = (255 + 64) * (1 + np.ptp(logits, -1))
        arguments = (logits, target, bins)
        run.expect(
            "symexp_twohot_loss", arguments, reference.symexp_twohot_loss(*arguments), magnitude=size, bound=run.u
        )
        probs = np.exp(reference.unimix_log_probs(logits, 0.0))
        magnitude = size * (probs * np.abs(bins)).sum(-1)
        run.expect(
            "symexp_twohot_mean",
            (logits, bins),
            reference.symexp_twohot_mean(logits, bins),
            magnitude=magnitude,
            bound=run.u,
        )


@check("DIS-16", "DIS-18", uses=["bernoulli_loss", "bernoulli_mean"], level=0)
def bernoulli_literals(run: Run) -> None:
    """Logit 0 and 2 with the targets 1, 0 and 0.997; logit 10000; both infinities."""
    bound, inf, nan = LITERAL[run.dtype], np.inf, np.nan
    logit, target = run.cast([0, 2, 2, 2, 1e4, 1e4, 1e4]), run.cast([1, 1, 0, 0.997, 0, 1, 1 - 1 / 333])
    soft = [2 * (1 - target[3]) + 0.1269280, run.cast(1e4) * (1 - target[6])]
    expected = np.array([0.6931472, 0.1269280, 2.1269280, soft[0], 1e4, 0, soft[1]])
    run.expect("bernoulli_loss", (logit, target), expected, magnitude=expected + 1e-3, bound=bound)
    if run.dtype != "bfloat16":
        run.compare("soft targets", np.array(soft), np.array([0.1329280, 30.030030]), bound=1e-3)
    logit, target = np.array([inf, inf, inf, -inf, -inf, -inf, nan, nan]), np.array([1, 0.5, 0, 0, 0.5, 1, 0, 1])
    run.exact(
        "infinite logits", run.call("bernoulli_loss", logit, target), np.array([0, inf, inf, 0, inf, inf, nan, nan])
    )
    mean = run.call("bernoulli_mean", np.array([inf, -inf, 0.0, -0.0, nan]))
    run.exact("bernoulli_mean", mean, np.array([1, 0, 0.5, 0.5, nan]))
    run.expect("bernoulli_mean", (np.array([2.0, -2]),), np.array([0.8807971, 0.1192029]), bound=LITERAL["float32"])


@check("DIS-1", "DIS-16", "DIS-18", "DIS-25", uses=["bernoulli_loss", "bernoulli_mean"], level=0)
def bernoulli_matches(run: Run) -> None:
    """Logits of any size, NaN and infinities included, and targets between 0 and 1."""
    shares = st.one_of(st.sampled_from([0.0, 1.0, 1 - 1 / 333, 0.5]), st.floats(0, 1, width=32))

    @run.for_all(
        case=LEADING.flatmap(lambda shape: st.tuples(arrays(adversarial_numbers(), shape), arrays(shares, shape)))
    )
    def _(case: tuple[np.ndarray, np.ndarray]) -> None:
        logit, target = run.cast(case[0]), run.cast(case[1])
        expected = held(run, reference.bernoulli_loss(logit, target))
        size = 16 * (1 + np.where(np.isfinite(logit), np.abs(logit), 0))
        loss = np.where(np.isfinite(expected), expected, 0)
        expect_held(run, "bernoulli_loss", (logit, target), magnitude=np.minimum(size * loss + 16, 1e300), bound=run.u)
        mean = reference.bernoulli_mean(logit)
        run.expect(
            "bernoulli_mean", (logit,), mean, magnitude=size * np.nan_to_num(mean) + run.tiny / run.u, bound=run.u
        )

    # Where softplus is not yet the identity in float64, and where a sigmoid made of tanh, or its logarithm, has lost
    # its digits.
    logit = run.cast(np.concatenate([np.arange(-40, 41), [-200, 200]]))
    mean = reference.bernoulli_mean(logit)
    run.expect(
        "bernoulli_mean", (logit,), mean, magnitude=16 * (1 + np.abs(logit)) * mean + run.tiny / run.u, bound=run.u
    )
    for share in (0.0, 0.5, 1.0):
        expected = reference.bernoulli_loss(logit, np.full(logit.shape, share))
        magnitude = 16 * (1 + np.abs(logit)) * expected + 16
        run.expect("bernoulli_loss", (logit, np.full(logit.shape, share)), expected, magnitude=magnitude, bound=run.u)


@check("DIS-19", uses=["bounded_normal"], level=0)
def bounded_normal_literals(run: Run) -> None:
    """Raw 0, 0 is mean 0 and deviation 0.8927174; raw mean 0.5 is 0.4621172; the bounds are reached at the
    infinities."""
    raw = np.array([0.0, 0.5, np.inf, -np.inf, np.nan]), np.array([0.0, -2, np.inf, -np.inf, np.nan])
    expected = np.array([0, 0.4621172, 1, -1, np.nan]), np.array([0.8927174, 0.55, 1, 0.1, np.nan])
    run.expect("bounded_normal", (*raw, 0.1, 1.0), expected, magnitude=1.0, bound=LITERAL["float32"])
    run.expect(
        "bounded_normal",
        (*raw, 0.5, 0.5),
        (expected[0], np.array([0.5] * 4 + [np.nan])),
        magnitude=1.0,
        bound=LITERAL["float32"],
    )


@check("DIS-19", "DIS-25", uses=["bounded_normal"], level=0)
def bounded_normal_matches(run: Run) -> None:
    """Mean and deviation for any raw outputs, never beyond their bounds."""

    @run.for_all(
        raw=LEADING.flatmap(lambda shape: st.tuples(*[arrays(adversarial_numbers(), shape)] * 2)),
        bounds=st.sampled_from([(0.1, 1.0), (0.25, 4.0)]),
    )
    def _(raw: tuple[np.ndarray, np.ndarray], bounds: tuple[float, float]) -> None:
        arguments = (run.cast(raw[0]), run.cast(raw[1]), *bounds)
        expected = reference.bounded_normal(*arguments)
        mean, std = run.expect(
            "bounded_normal", arguments, expected, magnitude=(1.0, max(1.0, bounds[1])), bound=16 * run.u
        )
        run.holds("mean in [-1, 1]", ~(np.abs(mean) > 1 + 4 * run.u))
        run.holds(
            "deviation within its bounds",
            ~((np.asarray(std) < bounds[0] - 16 * run.u) | (np.asarray(std) > bounds[1] * (1 + 4 * run.u))),
        )


@check("DIS-20", "DIS-21", "DIS-22", "CON-18", uses=["normal_sample", "normal_log_prob", "normal_entropy"], level=0)
def normal_literals(run: Run) -> None:
    """Mean 0.5, deviation 0.8, noise -1: sample -0.3, log-density -1.1957950, entropy at 1 and 0.1; far samples are not
    cut off."""
    bound = LITERAL[run.dtype]
    mean, std, sample = run.cast(0.5), run.cast(0.8), run.cast(-0.3)
    run.expect("normal_sample", (mean, std, -1.0), -0.3, magnitude=1.0, bound=bound)
    run.exact(
        "a far sample",
        run.call("normal_sample", np.array([0.75, -1]), np.array([1.0, 0.5]), np.array([8.0, -6])),
        np.array([8.75, -4]),
    )
    run.expect("normal_log_prob", (mean, std, sample), -1.1957950, bound=bound)
    run.expect("normal_log_prob", (0.0, 1.0, 8.0), -32.9189385, bound=LITERAL["float32"])
    run.expect("normal_entropy", (run.cast([1.0, 0.1]),), np.array([1.4189385, -0.8836466]), bound=bound)
    far = 1e200 if run.dtype == "float64" else 1e30
    expect_held(run, "normal_log_prob", (np.zeros(2), np.full(2, 0.125), run.cast([far, -far])), bound=16 * run.u)


@check(
    "DIS-1",
    "DIS-3",
    "DIS-20",
    "DIS-21",
    "DIS-22",
    "DIS-25",
    uses=["normal_sample", "normal_log_prob", "normal_entropy"],
    level=0,
)
def normal_matches(run: Run) -> None:
    """Samples, log-densities and entropies of each element; NaN shows."""
    numbers = st.one_of(FINITE, st.sampled_from([np.nan, np.inf, -np.inf]))
    positive = st.one_of(st.floats(2**-10, 8, width=32), st.sampled_from([0.1, 1.0, 1e-6]))
    draws = LEADING.flatmap(
        lambda shape: st.tuples(arrays(numbers, shape), arrays(positive, shape), arrays(numbers, shape))
    )

    @run.for_all(draws=draws)
    def _(draws: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        mean, std, x = (run.cast(draw) for draw in draws)
        with np.errstate(all="ignore"):
            size = np.nan_to_num(np.abs(mean) + std * np.abs(x), posinf=0)
            run.expect(
                "normal_sample", (mean, std, x), reference.normal_sample(mean, std, x), magnitude=size, bound=4 * run.u
            )
            size = np.nan_to_num(0.5 * ((np.abs(x) + np.abs(mean)) / std) ** 2, posinf=0) + np.abs(np.log(std)) + 1
            run.expect(
                "normal_log_prob",
                (mean, std, x),
                reference.normal_log_prob(mean, std, x),
                magnitude=size,
                bound=16 * run.u,
            )
        entropy = reference.normal_entropy(std)
        run.expect("normal_entropy", (std,), entropy, magnitude=np.abs(np.log(std)) + 1.5, bound=16 * run.u)

    run.exact("NaN deviation", run.call("normal_entropy", np.array([np.nan, 1]))[0], np.nan)


@check("DIS-23", "DIS-24", uses=["mse_loss", "symlog_mse_loss"], level=0)
def squared_error_literals(run: Run) -> None:
    """(1 - 4) squared is 9; prediction 1, target 3, scale 1/2 is 0.0746117; a tiny error counts, with its square."""
    run.exact("mse_loss", run.call("mse_loss", np.array([1.0, 4, 2]), np.array([4.0, 1, 2])), np.array([9.0, 9, 0]))
    run.expect(
        "symlog_mse_loss", (np.array([1.0]), np.array([3.0]), 0.5), np.array([0.0746117]), bound=LITERAL["float32"]
    )
    run.expect(
        "symlog_mse_loss", (np.array([-1.0]), np.array([-3.0]), 1.0), np.array([0.1492234]), bound=LITERAL["float32"]
    )
    tiny = run.cast([1e-5, -1e-3])
    run.expect("symlog_mse_loss", (tiny, np.zeros(2), 0.5), 0.5 * tiny**2, bound=16 * run.u)


@check("DIS-1", "DIS-3", "DIS-23", "DIS-24", "DIS-25", uses=["mse_loss", "symlog_mse_loss"], level=0)
def squared_errors_match(run: Run) -> None:
    """Predictions and targets of any size, NaN, infinities and overflow included."""
    draws = LEADING.flatmap(lambda shape: st.tuples(*[arrays(adversarial_numbers(), shape)] * 2))

    @run.for_all(draws=draws, scale=st.sampled_from([0.5, 1.0]))
    def _(draws: tuple[np.ndarray, np.ndarray], scale: float) -> None:
        prediction, target = (run.cast(draw) for draw in draws)
        expect_held(run, "mse_loss", (prediction, target), bound=16 * run.u)
        with np.errstate(all="ignore"):
            size = np.nan_to_num(scale * (np.abs(prediction) + np.abs(symlog(target))) ** 2, posinf=0)
        expect_held(run, "symlog_mse_loss", (prediction, target, scale), magnitude=size, bound=64 * run.u)


PAIRS = ("straight_through", "categorical_log_prob", "categorical_kl", "bernoulli_loss", "mse_loss")
NORMALS = ("normal_sample", "normal_log_prob")


@check(
    "DIS-3", "CON-8", level=0,
    uses=["categorical_sample", "symexp_twohot_loss", "symexp_twohot_mean", "bounded_normal", "symlog_mse_loss",
          *PAIRS, *NORMALS],
)  # fmt: skip
def shapes_that_differ_are_refused(run: Run) -> None:
    """Arguments whose shapes differ are refused, also where they could be broadcast."""
    full, row = np.full((2, 3), -1.0), np.full(3, -1.0)
    for wrong in (np.zeros(3), np.zeros((1,)), np.zeros((2, 1)), np.zeros(())):
        run.refuses("categorical_sample", full, wrong)
        run.refuses("symexp_twohot_loss", full, wrong, SMALL_BINS[1:4])
    for wrong in (row, row[None], np.full((2, 1), -1.0), np.full((2, 4), -1.0)):
        for function in PAIRS:
            run.refuses(function, full, wrong)
        run.refuses("symlog_mse_loss", full, wrong, 0.5)
        run.refuses("bounded_normal", full, wrong, 0.1, 1.0)
        for function in NORMALS:
            run.refuses(function, full, wrong, full)
            run.refuses(function, full, -full, wrong)
    run.refuses("symexp_twohot_loss", full, np.zeros(2), SMALL_BINS)
    run.refuses("symexp_twohot_mean", full, SMALL_BINS)
