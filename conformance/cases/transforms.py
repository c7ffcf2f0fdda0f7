"""Checks of spec/01-transforms.md."""

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Equal, Setting, equal, exact, judged, refused, related
from conformance.check import check, script
from conformance.compare import WIDE, Comparisons, round_to
from conformance.script import Script
from conformance.strategies import SHAPES, adversarial_numbers, arrays, normals, seeds
from conformance.worked import worked_cases
from reference_numpy import transforms as reference

SMALL_BINS = np.array([-3.0, -1.0, 0.0, 1.0, 3.0])


def arrays_of_any_shape(elements: st.SearchStrategy[float]) -> st.SearchStrategy[np.ndarray]:
    return st.sampled_from(SHAPES).flatmap(lambda shape: arrays(elements, shape))


def held_bins(setting: Setting, count: int = 255) -> np.ndarray:
    """The bins as the candidate's precision holds them."""
    return round_to(reference.exponential_bins(count), WIDE[setting.dtype])


def is_odd(c: Comparisons, plus: np.ndarray, minus: np.ndarray) -> None:
    c.exact("f(-x) + f(x)", minus, -np.asarray(plus))


@check("TRA-3", uses=["symlog"], level=0)
def symlog_literals(setting: Setting) -> Cases:
    """symlog of 0, 1, -10, 100 and 1e30 is 0, ln 2, -ln 11, ln 101 and 69.0776."""
    yield from worked_cases(setting, "transforms", "symlog", "symlog of a small number", bound=16 * setting.u)
    yield exact("symlog", (np.array([-0.0]),), np.zeros(1))


@check("TRA-2", "TRA-3", uses=["symlog"], level=0)
def symlog_matches(setting: Setting) -> Cases:
    """symlog agrees on zeros, subnormals, huge and non-finite numbers, in any shape."""

    def case(x: np.ndarray) -> Cases:
        x = setting.cast(x)
        yield equal("symlog", (x,), reference.symlog(x), bound=16 * setting.u)
        yield related(is_odd, ("symlog", (x,)), ("symlog", (-x,)))

    yield Drawn(case, x=arrays_of_any_shape(adversarial_numbers()))


@check("TRA-4", uses=["symexp"], level=0)
def symexp_literals(setting: Setting) -> Cases:
    """symexp of 0, 1, -2 and 20 is 0, 1.718282, -6.389056 and 485165194.41."""
    yield from worked_cases(setting, "transforms", "symexp", bound=16 * 21 * setting.u)
    yield exact("symexp", (np.array([-0.0]),), np.zeros(1))


@check("TRA-2", "TRA-4", uses=["symexp"], level=0)
def symexp_matches(setting: Setting) -> Cases:
    """symexp agrees within 16 u (1 + |x|), overflows to infinity, and is odd."""

    def case(x: np.ndarray) -> Cases:
        x = setting.cast(x)
        expected = round_to(reference.symexp(x), WIDE[setting.dtype])
        how = {"magnitude": np.abs(expected) * (1 + np.abs(x)), "bound": 16 * setting.u}
        large = 2.0 ** (1022 if setting.dtype == "float64" else 126)
        near_overflow = np.isfinite(expected) & (np.abs(expected) > large)

        def matches_or_overflows(c: Comparisons, actual: np.ndarray) -> None:
            either = np.where(near_overflow & np.isinf(actual), np.copysign(np.inf, expected), expected)
            c.compare("symexp", actual, either, **how)

        yield judged("symexp", (x,), matches_or_overflows if near_overflow.any() else Equal(expected, **how))
        yield related(is_odd, ("symexp", (x,)), ("symexp", (-x,)))

    yield Drawn(case, x=arrays_of_any_shape(adversarial_numbers()))


@script("TRA-3", "TRA-4", uses=["symlog", "symexp"], level=0)
def symexp_inverts_symlog(script: Script) -> None:
    """symexp(symlog(x)) is x."""

    @script.for_all(x=arrays(st.floats(-1e6, 1e6, width=32), (8,)))
    def _(x: np.ndarray) -> None:
        x = script.setting.cast(x)
        actual = script.call("symexp", script.call("symlog", x))
        script.compare("symexp(symlog(x))", actual, x, bound=512 * script.setting.u)


@check("TRA-5", "TRA-6", uses=["exponential_bins"], level=0)
def bins_literals(setting: Setting) -> Cases:
    """255 bins from -485165194.41 to 485165194.41, exactly antisymmetric, 0 in the middle; 5 bins in full."""
    yield from worked_cases(setting, "transforms", "few bins", "the standard bins", bound=1e-12)

    def antisymmetric(c: Comparisons, bins: np.ndarray) -> None:
        bins = np.asarray(bins)
        c.holds("bins are float64", bins.dtype == np.float64)
        c.exact("bins are antisymmetric", bins[::-1], -bins)
        c.holds("bins increase", np.diff(bins) > 0)

    yield judged("exponential_bins", (255,), antisymmetric)


@check("TRA-6", uses=["exponential_bins"], level=0)
def bins_refuse_even_counts(setting: Setting) -> Cases:
    """An even number of bins, or fewer than 3, is refused."""
    for count in (254, 2, 1, 0, -3):
        yield refused("exponential_bins", count)


@check("TRA-6", "TRA-7", "TRA-10", uses=["exponential_bins", "twohot", "ordered_expectation"], level=0)
def the_fewest_bins(setting: Setting) -> Cases:
    """There are 3 exponential bins at least, a two-hot encoding over 2 bins, and a mean over 3."""
    yield from worked_cases(setting, "transforms", "few bins", bound=1e-12)
    yield from worked_cases(setting, "transforms", "two-hot over two bins", "exact means")


@check("TRA-7", "TRA-8", uses=["twohot"], level=0)
def twohot_literals(setting: Setting) -> Cases:
    """Over the bins -3, -1, 0, 1, 3: 2 is [0,0,0,.5,.5], -.25 is [0,.25,.75,0,0], a bin is itself, 7 is the last
    bin."""
    yield from worked_cases(setting, "transforms", "two-hot over five bins")
    yield exact("twohot", (np.array([-0.0]), SMALL_BINS), np.eye(5)[[2]])
    standard = "two-hot between the standard bins"
    yield from worked_cases(setting, "transforms", standard, floor=1.0, bound=64 * setting.u)


@check("TRA-7", "TRA-8", "TRA-9", "TRA-14", uses=["twohot"], level=0)
def twohot_matches(setting: Setting) -> Cases:
    """Weights agree on bin edges and their neighbours, huge and non-finite numbers; other entries are exactly 0; the
    sum is 1."""
    bins = held_bins(setting)
    edges = st.integers(0, 254).flatmap(
        lambda k: st.sampled_from([bins[k], np.nextafter(bins[k], -np.inf), np.nextafter(bins[k], np.inf)])
    )

    def case(x: np.ndarray) -> Cases:
        x = setting.cast(x)

        def two_weights(c: Comparisons, actual: np.ndarray) -> None:
            finite = np.asarray(actual, np.float64)[~np.isnan(x)]
            c.holds("at most two weights are not 0", (finite != 0).sum(-1) <= 2)
            c.holds("weights lie in [0, 1]", (finite >= 0) & (finite <= 1))
            ones = np.ones(finite.shape[:-1])
            c.compare("sum of weights", finite.sum(-1), ones, magnitude=1.0, bound=4 * setting.u)
            c.holds("a bin has weight 1 on itself", finite[np.isin(x[~np.isnan(x)], bins)].max(-1, initial=1.0) == 1)

        # Subnormal numbers may be flushed, and weights of the order of a rounding error may be 0.
        expected = Equal(reference.twohot(x, bins), magnitude=1.0, bound=64 * setting.u)
        yield judged("twohot", (x, bins), expected, two_weights)

    yield Drawn(case, x=arrays_of_any_shape(st.one_of(adversarial_numbers(), edges)))


@check("TRA-7", uses=["twohot"], level=0)
def twohot_mean_is_the_number(setting: Setting) -> Cases:
    """The mean of the weights is the number itself, interpolated between the raw bins and not between their symlogs."""
    bins = held_bins(setting)
    x = setting.cast(np.linspace(-50, 50, 41))

    def mean_is_x(c: Comparisons, weights: np.ndarray) -> None:
        mean = np.asarray(weights, np.float64) @ bins
        c.compare("mean of twohot(x)", mean, x, magnitude=1 + np.abs(x), bound=64 * setting.u)

    yield judged("twohot", (x, bins), mean_is_x)


@check("TRA-10", "TRA-14", uses=["ordered_expectation"], level=0)
def expectation_matches(setting: Setting) -> Cases:
    """The mean over bins that span 17 orders of magnitude, within rounding of the paired sum."""
    yield from worked_cases(setting, "transforms", "exact means")
    yield from worked_cases(setting, "transforms", "the mean over five bins", floor=1.0, bound=64 * setting.u)
    bins = held_bins(setting)

    def case(seed: int, shape: tuple[int, ...], scale: float) -> Cases:
        logits = normals(seed, *shape, 255, scale=scale)
        odds = np.exp(logits - logits.max(-1, keepdims=True))
        probs = setting.cast(odds / odds.sum(-1, keepdims=True))
        magnitude = (bins[128:] * np.abs(probs[..., 128:] - probs[..., 126::-1])).sum(-1) + setting.tiny
        expected = reference.ordered_expectation(probs, bins)
        yield equal("ordered_expectation", (probs, bins), expected, magnitude=magnitude, bound=64 * setting.u)

    yield Drawn(case, seed=seeds(), shape=st.sampled_from(SHAPES), scale=st.sampled_from([1e-3, 1.0, 30.0]))


@check("TRA-11", uses=["ordered_expectation"], level=0)
def expectation_is_exactly_antisymmetric(setting: Setting) -> Cases:
    """Mirror-symmetric probabilities give exactly 0, and mirroring the probabilities exactly changes the sign."""
    yield from worked_cases(setting, "transforms", "the mean of equal probabilities")
    bins = held_bins(setting)

    def mirrored(c: Comparisons, mean: np.ndarray, other: np.ndarray) -> None:
        c.exact("mirrored", other, -np.asarray(mean))

    def case(seed: int) -> Cases:
        probs = setting.cast(np.random.default_rng(seed).dirichlet(np.full(255, 0.5), 3))
        reverse = probs[:, ::-1].copy()
        yield related(mirrored, ("ordered_expectation", (probs, bins)), ("ordered_expectation", (reverse, bins)))
        symmetric = setting.cast((probs + reverse) / 2)
        symmetric = np.concatenate([symmetric[:, :128], symmetric[:, 126::-1]], -1)
        yield exact("ordered_expectation", (symmetric, bins), np.zeros(3), where="symmetric")

    yield Drawn(case, seed=seeds())


@check("TRA-12", uses=["ordered_expectation"], level=0)
def expectation_of_nan(setting: Setting) -> Cases:
    """A NaN among the probabilities of one distribution makes its mean NaN, and no other."""
    probs = np.full((4, 255), 1 / 255)
    probs[1, 127] = probs[2, 0] = np.nan
    yield exact("ordered_expectation", (probs, held_bins(setting)), np.array([0, np.nan, np.nan, 0]))


@check("TRA-13", uses=["twohot", "ordered_expectation"], level=0)
def wrong_bins_are_refused(setting: Setting) -> Cases:
    """Bins that are not one row of enough entries, or that do not fit the probabilities, are refused."""
    yield refused("twohot", np.zeros(3), np.zeros((2, 5)))
    yield refused("twohot", np.zeros(3), np.zeros(1))
    yield refused("ordered_expectation", np.full((2, 4), 0.25), np.array([-3.0, -1.0, 1.0, 3.0]))
    yield refused("ordered_expectation", np.full((2, 5), 0.2), np.array([-1.0, 0.0, 1.0]))
    yield refused("ordered_expectation", np.full((2, 5), 0.2), np.zeros((1, 5)))


@check("TRA-1", uses=["symlog", "symexp", "twohot", "ordered_expectation"], level=0)
def float32_or_better(setting: Setting) -> Cases:
    """Whatever the compute dtype, results are more precise than bfloat16 could hold."""
    x, probs = setting.cast([0.3, 0.7, 5.1]), setting.cast([0.1, 0.2, 0.3, 0.15, 0.25])
    weights, mean = reference.twohot(x, SMALL_BINS), reference.ordered_expectation(probs, SMALL_BINS)
    yield equal("symlog", (x,), reference.symlog(x), bound=16 * setting.u)
    yield equal("symexp", (x,), reference.symexp(x), bound=16 * 7 * setting.u)
    yield equal("twohot", (x, SMALL_BINS), weights, magnitude=1.0, bound=64 * setting.u)
    yield equal("ordered_expectation", (probs, SMALL_BINS), mean, magnitude=1.0, bound=64 * setting.u)
