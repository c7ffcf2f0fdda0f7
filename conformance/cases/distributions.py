"""Checks of spec/02-distributions.md."""

import dataclasses
import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Case, Cases, Drawn, Equal, Setting, equal, exact, judged, refused
from conformance.cases.transforms import SMALL_BINS, held_bins
from conformance.check import check
from conformance.compare import WIDE, Comparisons, round_to
from conformance.problems import random_parameters, small_config, spaces, uniforms
from conformance.strategies import adversarial_logits, adversarial_numbers, arrays, normals, seeds
from conformance.worked import worked, worked_cases
from reference_numpy import distributions as reference
from reference_numpy.transforms import symlog

# The digits that the chapters print, of a few operations in float32 or better: the checks of drawn numbers hold float64
# to its last digits.
LITERAL = {"float64": 1e-6, "float32": 4e-6, "bfloat16": 4e-6}
LEADING = st.sampled_from([(), (2, 3)])
CATEGORICAL = st.sampled_from([(5,), (3, 1), (2, 3, 64)])
# Small, so that no result is near the edge of a precision, where float32 may and may not overflow.
FINITE = st.one_of(
    st.floats(-1e4, 1e4, width=32), st.floats(-3, 3, width=32), st.sampled_from([0.0, -0.0, 1e-45, 1e-20, 1e9])
)
LN_2 = math.log(2)


def equal_after_overflow(setting: Setting, function: str, arguments: tuple[Any, ...], **how: Any) -> Case:
    """The result of the reference as float32 or float64 holds it: float32 overflows where float64, which a candidate is
    free to use, does not."""
    unlimited = getattr(reference, function)(*arguments)
    expected = round_to(unlimited, WIDE[setting.dtype])
    if np.array_equal(np.isinf(unlimited), np.isinf(expected)):
        return equal(function, arguments, expected, **how)

    def matches(c: Comparisons, actual: Any) -> None:
        c.compare(function, round_to(actual, WIDE[setting.dtype]), expected, **how)

    return judged(function, arguments, matches)


def log_probs_of(
    setting: Setting, seed: int, shape: tuple[int, ...], scale: float = 3.0, unimix: float = 0.01
) -> np.ndarray:
    return setting.cast(reference.unimix_log_probs(normals(seed, *shape, scale=scale), unimix))


def summed_magnitude(classes: int, products: np.ndarray) -> np.ndarray:
    """[DIS-13], in units of the spacing."""
    return (classes + 16) * np.where(np.isfinite(products), np.abs(products), 0).sum(-1)


@check("DIS-5", uses=["unimix_log_probs"], level=0)
def mixture_literals(setting: Setting) -> Cases:
    """Logits ln 8, 0, 0 with 1 percent uniform are ln of .7953, .1023, .1023; without it a logit 1000 below has
    log-probability -1000."""
    mixtures = ("a mixture with the uniform distribution", "nothing but the uniform distribution")
    far = ("the least probability of a mixture", "logits far apart", "huge logits")
    yield from worked_cases(setting, "distributions", *mixtures, *far, floor=1.0, bound=8 * setting.u)


@check("DIS-1", "DIS-3", "DIS-5", "CON-23", uses=["unimix_log_probs"], level=0)
def mixture_matches(setting: Setting) -> Cases:
    """Logits of any size up to 1e30 and minus infinity, any leading axes and number of classes, any share of the
    mixture."""

    def case(logits: np.ndarray, unimix: float) -> Cases:
        logits = setting.cast(np.where(np.arange(logits.shape[-1]) == 0, np.maximum(logits, -1e30), logits))
        below = logits.max(-1, keepdims=True) - logits
        magnitude = logits.shape[-1] + 16 + 2 * np.where(np.isfinite(below), below, 0)
        expected = reference.unimix_log_probs(logits, unimix)
        yield equal("unimix_log_probs", (logits, unimix), expected, magnitude=magnitude, bound=setting.u)

    logits = CATEGORICAL.flatmap(lambda shape: arrays(adversarial_logits(), shape))
    yield Drawn(case, logits=logits, unimix=st.sampled_from([0.0, 0.01, 0.5]))

    whole = np.array([-3.0, 0, 2, 1])
    expected = reference.unimix_log_probs(whole, 0.0)
    for shift in (0, 64, -128):
        yield equal("unimix_log_probs", (whole + shift, 0.0), expected, magnitude=20 + 10, bound=setting.u)


@check("DIS-6", uses=["unimix_log_probs"], level=0)
def mixture_of_special_logits(setting: Setting) -> Cases:
    """Minus infinity is probability 0; one NaN or plus infinity, or nothing but minus infinity, makes all classes NaN,
    in its row only."""
    function, inf, nan = "unimix_log_probs", math.inf, math.nan
    how: dict[str, Any] = {"magnitude": 1.0, "bound": 64 * setting.u}
    broken = [[nan, 0, 0], [0, inf, 0], [-inf] * 3, [inf, -inf, 0], [inf] * 3, [-inf, nan, -inf]]
    logits = np.array([[0, -inf, 0], *broken, [-inf, -inf, 7.0]])
    probs = np.array([[0.5, 0, 0.5], *[[nan] * 3] * 6, [0, 0, 1]])
    huge = setting.cast(1.7e308 if setting.dtype == "float64" else 3e38)
    for unimix in (0.0, 0.01):
        with np.errstate(divide="ignore"):
            expected = np.log((1 - unimix) * probs + unimix / 3)
        yield equal(function, (logits, unimix), expected, **how)
        yield equal_after_overflow(setting, function, (np.array([huge, -huge]), unimix), **how)


@check("DIS-7", uses=["observe", "kl_losses"], level=1)
def latents_are_mixed(setting: Setting) -> Cases:
    """With a share of 1 latents are uniform and posterior and prior agree, whatever the logits; with 1/2 the KL is that
    of the mixtures."""
    config = small_config(setting.profile, setting.dtype, latent_unimix=1.0, free_nats=0.0)
    task = spaces("vector", "discrete")
    rng, N, T, S, C = setting.rng(), 2, 3, config.stoch, config.classes
    params = random_parameters(rng, config, task, setting.dtype)
    classes = rng.integers(0, C, (N, T, S))
    carry = {"deter": np.zeros((N, config.deter)), "stoch": np.zeros((N, S, C))}
    sequence = (np.zeros((N, T, config.units)), np.zeros((N, T, task.action_size)), np.zeros((N, T), bool))

    def uniform_latents(c: Comparisons, states: dict[str, np.ndarray]) -> None:
        c.exact("classes of uniform latents", np.round(states["stoch"], 3), np.eye(C)[classes])

    uniform = setting.cast((classes + 0.5) / C)
    yield judged("observe", (params, carry, *sequence, uniform, config), uniform_latents)

    posterior, prior = setting.cast(rng.normal(0, 5, (2, N, S, C)))
    zeros, where = (np.zeros(N),) * 2, "KL of uniform latents"
    yield equal("kl_losses", (posterior, prior, config), zeros, where=where, magnitude=1.0, bound=64 * setting.u)
    half = dataclasses.replace(config, latent_unimix=0.5)
    p, q = (np.exp(x) / np.exp(x).sum(-1, keepdims=True) / 2 + 0.5 / C for x in (posterior, prior))
    kl, where = (p * np.log(p / q)).sum((-1, -2)), "KL of the mixtures"
    yield equal("kl_losses", (posterior, prior, half), (kl, kl), where=where, magnitude=1 + kl, bound=256 * setting.u)


@check("DIS-7", uses=["reconstruction_losses", "action_entropy"], level=1)
def the_actor_is_mixed_and_the_decoder_is_not(setting: Setting) -> Cases:
    """Discrete observations are scored without a mixture, whatever the shares; discrete actions with `actor_unimix`."""
    config = small_config(setting.profile, setting.dtype, latent_unimix=0.5, actor_unimix=1.0)
    task = spaces("vector", "discrete")
    predictions = {"mode": np.array([[0, 0, 64.0, 8, 0]]), "position": np.zeros((1, 3))}
    observation = {"mode": np.array([[0, 1]]), "position": np.zeros((1, 3))}
    arguments = (predictions, observation, task, config)
    expected = np.array([64 + 8 + math.log1p(math.exp(-8))])
    yield equal("reconstruction_losses", arguments, expected, at=("mode",), where="mode", bound=64 * setting.u)
    outputs, where = {"action": {"logits": np.array([[9.0, 0, 0, 0]])}}, "entropy of a uniform actor"
    expected = np.array([math.log(4)])
    yield equal("action_entropy", (outputs, task, config), expected, where=where, bound=64 * setting.u)


@check("DIS-8", "CON-17", uses=["categorical_sample"], level=0)
def sample_literals(setting: Setting) -> Cases:
    """The class changes where the cumulative sum passes the uniform; probabilities are used as they are, the last sum
    is not needed."""
    function, cast = "categorical_sample", setting.cast
    yield from worked_cases(setting, "notation", "sampling a class")
    less = "samples of probabilities that sum to less than 1"
    yield from worked_cases(setting, "distributions", "samples of the mixture", less)
    yield exact(function, (np.zeros((2, 1)), cast([0, 0.99])), np.ones((2, 1)), where="one class")
    for place in range(4):
        certain = np.tile(np.where(np.arange(4) == place, 0, -np.inf), (3, 1))
        expected = np.eye(4)[[place] * 3]
        yield exact(function, (certain, cast([0, 0.5, 1 - 2**-7])), expected, where="a certain class")


@check("DIS-8", "CON-16", uses=["categorical_sample"], level=0)
def sample_matches(setting: Setting) -> Cases:
    """Random probabilities, uniforms that are not near a boundary; the same arguments give the same sample."""

    def case(seed: int, shape: tuple[int, ...], scale: float) -> Cases:
        log_probs = log_probs_of(setting, seed, shape, scale)
        boundaries = np.exp(log_probs).cumsum(-1)[..., :-1]
        drawn = setting.cast(uniforms(np.random.default_rng(seed), 64, *shape[:-1]))
        margin = np.abs(drawn[..., None] - boundaries).min(-1, initial=1)
        first = np.argmax(margin > min(0.1 / shape[-1], 1e-3), axis=0)
        uniform = np.take_along_axis(drawn, first[None], 0)[0]
        expected = reference.categorical_sample(log_probs, uniform)
        for _ in range(2):
            yield exact("categorical_sample", (log_probs, uniform), expected)

    yield Drawn(case, seed=seeds(), shape=CATEGORICAL, scale=st.sampled_from([0.1, 3.0, 30.0]))


@check("DIS-8", uses=["categorical_sample"], level=0)
def sample_is_always_one_hot(setting: Setting) -> Cases:
    """NaN, infinities, probabilities that sum to less or more than 1 and uniforms outside [0, 1) still give one 1 and
    zeros."""
    bad = np.array([np.nan, -np.inf, np.inf, 0, -50, -1])
    log_probs = np.array([[a, b, c] for a in bad for b in bad for c in (0, np.nan, -np.inf)])

    def one_hot(c: Comparisons, sample: np.ndarray) -> None:
        c.holds("one 1 and zeros", np.sort(np.asarray(sample), -1) == np.array([0, 0, 1]))

    for uniform in (0.0, 0.5, 0.99, 1.0, -0.5, np.nan):
        yield judged("categorical_sample", (log_probs, np.full(len(log_probs), uniform)), one_hot)


@check("DIS-9", uses=["straight_through"], level=0)
def straight_through_is_the_sample(setting: Setting) -> Cases:
    """The value is the sample in every bit, whatever the probabilities."""
    sample = np.eye(3)[0]
    yield exact("straight_through", (np.array([-np.inf, 0, -200]), sample), sample, where="probability 0")

    def case(seed: int, shape: tuple[int, ...]) -> Cases:
        sample = np.eye(shape[-1])[np.random.default_rng(seed).integers(0, shape[-1], shape[:-1])]
        yield exact("straight_through", (log_probs_of(setting, seed, shape), sample), sample)

    yield Drawn(case, seed=seeds(), shape=CATEGORICAL)


@check(
    "DIS-10",
    "DIS-11",
    "DIS-12",
    "CON-7",
    uses=["categorical_log_prob", "categorical_entropy", "categorical_kl"],
    level=0,
)
def categorical_literals(setting: Setting) -> Cases:
    """Entropy 0.6486683 of the example, ln C when uniform; KL 0.1438410 one way, 0.1308120 the other, 0 to itself."""
    bound = LITERAL[setting.dtype]
    yield from worked_cases(setting, "distributions", "entropies", bound=bound)
    # The other row of the example is all zeros: zero_weights_silence.
    log_probs, onehot = (argument[0] for argument in worked("distributions", "a log-probability")[0].arguments)
    chosen = setting.cast(log_probs), onehot
    yield equal("categorical_log_prob", chosen, reference.categorical_log_prob(*chosen), bound=bound)
    divergences = ("the divergence of two coins", "the largest divergence of a mixture")
    yield from worked_cases(setting, "distributions", *divergences, floor=1.0, bound=bound)
    log_probs = log_probs_of(setting, setting.seed, (3,))
    yield exact("categorical_kl", (log_probs, log_probs), 0.0, where="KL of equal distributions")


@check("DIS-12", uses=["categorical_kl"], level=0)
def a_negative_divergence_is_not_clipped(setting: Setting) -> Cases:
    """Probabilities that sum to 1/2 and to 1 have a KL of -0.3465736: rounded log-probabilities do the same on a
    smaller scale."""
    yield from worked_cases(setting, "distributions", "a negative divergence", bound=LITERAL[setting.dtype])


@check(
    "DIS-3",
    "DIS-10",
    "DIS-11",
    "DIS-12",
    "DIS-13",
    uses=["categorical_log_prob", "categorical_entropy", "categorical_kl"],
    level=0,
)
def categorical_matches(setting: Setting) -> Cases:
    """Log-probability, entropy and KL over the last axis only, for sharp and flat distributions."""

    def case(seed: int, shape: tuple[int, ...], scale: float, unimix: float) -> Cases:
        p, q = (log_probs_of(setting, s, shape, scale, unimix) for s in (seed, seed + 1))
        onehot = np.eye(shape[-1])[np.random.default_rng(seed).integers(0, shape[-1], shape[:-1])]
        for function, arguments, products in (
            ("categorical_log_prob", (p, onehot), onehot * p),
            ("categorical_entropy", (p,), np.exp(p) * p),
            ("categorical_kl", (p, q), np.exp(p) * (np.abs(p) + np.abs(q))),
        ):
            expected, magnitude = getattr(reference, function)(*arguments), summed_magnitude(shape[-1], products)
            yield equal(function, arguments, expected, magnitude=magnitude, bound=setting.u)
        yield exact("categorical_kl", (p, p), np.zeros(shape[:-1]), where="KL of equal distributions")

    scale, unimix = st.sampled_from([0.1, 3.0, 30.0]), st.sampled_from([0.0, 0.01])
    yield Drawn(case, seed=seeds(), shape=CATEGORICAL, scale=scale, unimix=unimix)


@check(
    "DIS-4",
    "DIS-12",
    uses=["categorical_log_prob", "categorical_entropy", "categorical_kl", "symexp_twohot_loss"],
    level=0,
)
def zero_weights_silence(setting: Setting) -> Cases:
    """A weight of 0 silences an infinite or NaN logarithm; a class that p has and q has not makes the KL infinite."""
    inf, nan, bound, half = np.inf, np.nan, LITERAL[setting.dtype], float(setting.cast(-LN_2))
    log_probs = np.array([[0.0, -inf, -inf], [half, half, -inf], [nan, nan, nan]])
    expected = np.array([0, -2 * math.exp(half) * half, nan])
    yield equal("categorical_entropy", (log_probs,), expected, where="entropy", bound=bound)
    log_probs = np.array([[-1.0, -inf], [-1, nan], [nan, -2], [-inf, -inf], [-inf, 0]])
    arguments, expected = (log_probs, np.eye(2)[[0, 0, 1, 0, 0]]), np.array([-1, -1, -2, -inf, -inf])
    yield exact("categorical_log_prob", arguments, expected, where="log-probability")
    yield exact("categorical_log_prob", (np.array([-1, -inf, nan]), np.zeros(3)), 0.0, where="blanked action")
    p = np.array([[0.0, -inf], [0, -inf], [half, half], [-inf, 0]])
    q = np.array([[0.0, -inf], [half, half], [0, -inf], [0, -inf]])
    expected = np.array([0, -half, inf, inf])
    yield equal("categorical_kl", (p, q), expected, where="KL", magnitude=1.0, bound=bound)
    logits, target = np.tile([-inf, -inf, 0, 0, -inf], (3, 1)), np.array([0.5, 0, 2.0])
    expected, where = np.array([LN_2, LN_2, inf]), "twohot loss beside infinite logits"
    yield equal("symexp_twohot_loss", (logits, target, SMALL_BINS), expected, where=where, bound=16 * setting.u)


@check("DIS-14", "DIS-15", uses=["symexp_twohot_loss", "symexp_twohot_mean"], level=0)
def symexp_twohot_literals(setting: Setting) -> Cases:
    """255 equal logits: loss ln 255, mean 0. Logits 0, 0, 0, 0, ln 4 over small bins: loss 1.3862944 for the target 2,
    mean 1.125."""
    bound, bins = LITERAL[setting.dtype], held_bins(setting)
    yield from worked_cases(setting, "distributions", "equal logits over the bins", bound=bound)
    yield from worked_cases(setting, "distributions", "the mean of equal logits")
    for level in (-1e4, 1e30):
        logits = setting.cast(np.full((2, 255), level))
        arguments = (logits, setting.cast([300.0, -1e12]), bins)
        yield equal("symexp_twohot_loss", arguments, np.full(2, math.log(255)), bound=bound)
        yield exact("symexp_twohot_mean", (logits, bins), np.zeros(2), where="mean of equal logits")
    small = ("a two-hot loss over five bins", "a mean over five bins")
    yield from worked_cases(setting, "distributions", *small, bound=bound)
    logits = np.array([0.0, 0, 0, 0, 2])
    for target, loss in ((np.inf, math.log1p(4 * math.exp(-2))), (np.nan, np.nan)):
        yield equal("symexp_twohot_loss", (logits, target, SMALL_BINS), loss, bound=bound)
    for special in (np.nan, np.inf):
        yield exact("symexp_twohot_mean", (np.where(np.arange(5) == 1, special, 0), SMALL_BINS), np.nan)


@check("DIS-1", "DIS-14", "DIS-15", uses=["symexp_twohot_loss", "symexp_twohot_mean"], level=0)
def symexp_twohot_matches(setting: Setting) -> Cases:
    """Targets on, beside and between the bins, huge and non-finite; flat and sharp logits."""
    bins = held_bins(setting)
    targets = st.one_of(adversarial_numbers(), st.sampled_from([float(x) for x in bins[::17]]))

    def case(seed: int, target: np.ndarray, scale: float) -> Cases:
        logits, target = setting.cast(normals(seed, 2, 3, 255, scale=scale)), setting.cast(target)
        size = (255 + 64) * (1 + np.ptp(logits, -1))
        loss, mean = reference.symexp_twohot_loss(logits, target, bins), reference.symexp_twohot_mean(logits, bins)
        yield equal("symexp_twohot_loss", (logits, target, bins), loss, magnitude=size, bound=setting.u)
        magnitude = size * (np.exp(reference.unimix_log_probs(logits, 0.0)) * np.abs(bins)).sum(-1)
        yield equal("symexp_twohot_mean", (logits, bins), mean, magnitude=magnitude, bound=setting.u)

    yield Drawn(case, seed=seeds(), target=arrays(targets, (2, 3)), scale=st.sampled_from([0.1, 3.0, 100.0]))


@check("DIS-16", "DIS-18", uses=["bernoulli_loss", "bernoulli_mean"], level=0)
def bernoulli_literals(setting: Setting) -> Cases:
    """Logit 0 and 2 with the targets 1, 0 and 0.997; logit 10000; both infinities."""
    bound = LITERAL[setting.dtype]
    yield from worked_cases(setting, "distributions", "Bernoulli losses", floor=1e-3, bound=bound)
    yield from worked_cases(setting, "distributions", "Bernoulli losses of infinite logits")
    yield from worked_cases(setting, "distributions", "Bernoulli means", floor=setting.tiny / bound, bound=bound)
    nan, expected = np.full(2, np.nan), np.array([1, 0, 0.5, 0.5])
    yield exact("bernoulli_loss", (nan, np.array([0.0, 1])), nan)
    yield exact("bernoulli_mean", (np.array([np.inf, -np.inf, 0.0, -0.0]),), expected)
    yield exact("bernoulli_mean", (nan,), nan)


@check("DIS-1", "DIS-16", "DIS-18", "DIS-25", uses=["bernoulli_loss", "bernoulli_mean"], level=0)
def bernoulli_matches(setting: Setting) -> Cases:
    """Logits of any size, NaN and infinities included, and targets between 0 and 1."""
    shares = st.one_of(st.sampled_from([0.0, 1.0, 1 - 1 / 333, 0.5]), st.floats(0, 1, width=32))
    u, floor = setting.u, setting.tiny / setting.u

    def case(pair: tuple[np.ndarray, np.ndarray]) -> Cases:
        logit, target = map(setting.cast, pair)
        size = 16 * (1 + np.where(np.isfinite(logit), np.abs(logit), 0))
        loss = round_to(reference.bernoulli_loss(logit, target), WIDE[setting.dtype])
        magnitude = np.minimum(size * np.where(np.isfinite(loss), loss, 0) + 16, 1e300)
        yield equal_after_overflow(setting, "bernoulli_loss", (logit, target), magnitude=magnitude, bound=u)
        mean = reference.bernoulli_mean(logit)
        yield equal("bernoulli_mean", (logit,), mean, magnitude=size * np.nan_to_num(mean) + floor, bound=u)

    pairs = LEADING.flatmap(lambda shape: st.tuples(arrays(adversarial_numbers(), shape), arrays(shares, shape)))
    yield Drawn(case, pair=pairs)

    # Where softplus is not yet the identity in float64, and where a sigmoid made of tanh, or its logarithm, has lost
    # its digits.
    logit = setting.cast(np.concatenate([np.arange(-40, 41), [-200, 200]]))
    size, mean = 16 * (1 + np.abs(logit)), reference.bernoulli_mean(logit)
    yield equal("bernoulli_mean", (logit,), mean, magnitude=size * mean + floor, bound=u)
    for share in (0.0, 0.5, 1.0):
        target = np.full(logit.shape, share)
        loss = reference.bernoulli_loss(logit, target)
        yield equal("bernoulli_loss", (logit, target), loss, magnitude=size * loss + 16, bound=u)


@check("DIS-19", uses=["bounded_normal"], level=0)
def bounded_normal_literals(setting: Setting) -> Cases:
    """Raw 0, 0 is mean 0 and deviation 0.8927174; raw mean 0.5 is 0.4621172; the bounds are reached at the
    infinities."""
    yield from worked_cases(setting, "distributions", "bounded normals", floor=1.0, bound=16 * setting.u)
    nan = np.full(1, np.nan)
    for bounds in ((0.1, 1.0), (0.5, 0.5)):
        yield exact("bounded_normal", (nan, nan, *bounds), (nan, nan))


@check("DIS-19", "DIS-25", uses=["bounded_normal"], level=0)
def bounded_normal_matches(setting: Setting) -> Cases:
    """Mean and deviation for any raw outputs, never beyond their bounds."""

    def case(raw: tuple[np.ndarray, np.ndarray], bounds: tuple[float, float]) -> Cases:
        low, high = bounds
        arguments = (setting.cast(raw[0]), setting.cast(raw[1]), low, high)

        def within_bounds(c: Comparisons, result: tuple[np.ndarray, np.ndarray]) -> None:
            mean, std = map(np.asarray, result)
            c.holds("mean in [-1, 1]", ~(np.abs(mean) > 1 + 4 * setting.u))
            outside = (std < low - 16 * setting.u) | (std > high * (1 + 4 * setting.u))
            c.holds("deviation within its bounds", ~outside)

        expected = reference.bounded_normal(*arguments)
        right = Equal(expected, magnitude=(1.0, max(1.0, high)), bound=16 * setting.u)
        yield judged("bounded_normal", arguments, right, within_bounds)

    raw = LEADING.flatmap(lambda shape: st.tuples(*[arrays(adversarial_numbers(), shape)] * 2))
    yield Drawn(case, raw=raw, bounds=st.sampled_from([(0.1, 1.0), (0.25, 4.0)]))


@check("DIS-20", "DIS-21", "DIS-22", "CON-18", uses=["normal_sample", "normal_log_prob", "normal_entropy"], level=0)
def normal_literals(setting: Setting) -> Cases:
    """Mean 0.5, deviation 0.8, noise -1: sample -0.3, log-density -1.1957950, entropy at 1 and 0.1; far samples are not
    cut off."""
    bound = LITERAL[setting.dtype]
    yield from worked_cases(setting, "distributions", "a normal sample", floor=1.0, bound=bound)
    yield from worked_cases(setting, "distributions", "far samples are not cut off")
    yield from worked_cases(setting, "distributions", "log-densities", "entropies of a normal", bound=bound)
    far = 1e200 if setting.dtype == "float64" else 1e30
    arguments = (np.zeros(2), np.full(2, 0.125), setting.cast([far, -far]))
    yield equal_after_overflow(setting, "normal_log_prob", arguments, bound=16 * setting.u)


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
def normal_matches(setting: Setting) -> Cases:
    """Samples, log-densities and entropies of each element; NaN shows."""
    numbers = st.one_of(FINITE, st.sampled_from([np.nan, np.inf, -np.inf]))
    positive = st.one_of(st.floats(2**-10, 8, width=32), st.sampled_from([0.1, 1.0, 1e-6]))
    draws = LEADING.flatmap(
        lambda shape: st.tuples(arrays(numbers, shape), arrays(positive, shape), arrays(numbers, shape))
    )

    def case(draws: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Cases:
        mean, std, x = map(setting.cast, draws)
        size = np.nan_to_num(np.abs(mean) + std * np.abs(x), posinf=0)
        sample, log_prob = reference.normal_sample(mean, std, x), reference.normal_log_prob(mean, std, x)
        yield equal("normal_sample", (mean, std, x), sample, magnitude=size, bound=4 * setting.u)
        size = np.nan_to_num(0.5 * ((np.abs(x) + np.abs(mean)) / std) ** 2, posinf=0) + np.abs(np.log(std)) + 1
        yield equal("normal_log_prob", (mean, std, x), log_prob, magnitude=size, bound=16 * setting.u)
        entropy, size = reference.normal_entropy(std), np.abs(np.log(std)) + 1.5
        yield equal("normal_entropy", (std,), entropy, magnitude=size, bound=16 * setting.u)

    yield Drawn(case, draws=draws)
    std = np.array([np.nan, 1])
    yield equal("normal_entropy", (std,), reference.normal_entropy(std), where="NaN deviation", bound=16 * setting.u)


@check("DIS-23", "DIS-24", uses=["mse_loss", "symlog_mse_loss"], level=0)
def squared_error_literals(setting: Setting) -> Cases:
    """(1 - 4) squared is 9; prediction 1, target 3, scale 1/2 is 0.0746117; a tiny error counts, with its square."""
    yield from worked_cases(setting, "distributions", "squared errors")
    in_symlog_space = "squared errors in symlog space"
    yield from worked_cases(setting, "distributions", in_symlog_space, bound=LITERAL[setting.dtype])
    tiny = setting.cast([1e-5, -1e-3])
    yield equal("symlog_mse_loss", (tiny, np.zeros(2), 0.5), 0.5 * tiny**2, bound=16 * setting.u)


@check("DIS-1", "DIS-3", "DIS-23", "DIS-24", "DIS-25", uses=["mse_loss", "symlog_mse_loss"], level=0)
def squared_errors_match(setting: Setting) -> Cases:
    """Predictions and targets of any size, NaN, infinities and overflow included."""
    draws = LEADING.flatmap(lambda shape: st.tuples(*[arrays(adversarial_numbers(), shape)] * 2))

    def case(draws: tuple[np.ndarray, np.ndarray], scale: float) -> Cases:
        prediction, target = map(setting.cast, draws)
        yield equal_after_overflow(setting, "mse_loss", (prediction, target), bound=16 * setting.u)
        arguments = (prediction, target, scale)
        size = np.nan_to_num(scale * (np.abs(prediction) + np.abs(symlog(target))) ** 2, posinf=0)
        yield equal_after_overflow(setting, "symlog_mse_loss", arguments, magnitude=size, bound=64 * setting.u)

    yield Drawn(case, draws=draws, scale=st.sampled_from([0.5, 1.0]))


PAIRS = ("straight_through", "categorical_log_prob", "categorical_kl", "bernoulli_loss", "mse_loss")
NORMALS = ("normal_sample", "normal_log_prob")


@check(
    "DIS-3", "CON-8", level=0,
    uses=["categorical_sample", "symexp_twohot_loss", "symexp_twohot_mean", "bounded_normal", "symlog_mse_loss",
          *PAIRS, *NORMALS],
)  # fmt: skip
def shapes_that_differ_are_refused(setting: Setting) -> Cases:
    """Arguments whose shapes differ are refused, also where they could be broadcast."""
    full, row = np.full((2, 3), -1.0), np.full(3, -1.0)
    for wrong in (np.zeros(3), np.zeros((1,)), np.zeros((2, 1)), np.zeros(())):
        yield refused("categorical_sample", full, wrong)
        yield refused("symexp_twohot_loss", full, wrong, SMALL_BINS[1:4])
    for wrong in (row, row[None], np.full((2, 1), -1.0), np.full((2, 4), -1.0)):
        for function in PAIRS:
            yield refused(function, full, wrong)
        yield refused("symlog_mse_loss", full, wrong, 0.5)
        yield refused("bounded_normal", full, wrong, 0.1, 1.0)
        for function in NORMALS:
            yield refused(function, full, wrong, full)
            yield refused(function, full, -full, wrong)
    yield refused("symexp_twohot_loss", full, np.zeros(2), SMALL_BINS)
    yield refused("symexp_twohot_mean", full, SMALL_BINS)
