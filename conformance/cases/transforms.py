"""Checks of spec/01-transforms.md."""

import hypothesis.strategies as st
import numpy as np

from conformance.check import Run, check, round_to
from conformance.strategies import adversarial_numbers, arrays, normals, seeds, shapes
from reference_numpy import transforms as reference

SMALL_BINS = np.array([-3.0, -1.0, 0.0, 1.0, 3.0])


def held_bins(run: Run, count: int = 255) -> np.ndarray:
    """The bins as the candidate's precision holds them."""
    return round_to(reference.exponential_bins(count), "float64" if run.dtype == "float64" else "float32")


@check("TRA-3", uses=["symlog"], level=0)
def symlog_literals(run: Run) -> None:
    """symlog of 0, 1, -10, 100 and 1e30 is 0, ln 2, -ln 11, ln 101 and 69.0776."""
    x = run.cast([0.0, -0.0, 1.0, -10.0, 100.0])
    expected = np.array([0, 0, 0.6931471805599453, -2.3978952727983707, 4.61512051684126])
    run.expect("symlog", (x,), expected, bound=16 * run.u)


@check("TRA-2", "TRA-3", uses=["symlog"], level=0)
def symlog_matches(run: Run) -> None:
    """symlog agrees on zeros, subnormals, huge and non-finite numbers, in any shape."""

    @run.for_all(x=shapes().flatmap(lambda shape: arrays(adversarial_numbers(), shape)))
    def _(x: np.ndarray) -> None:
        x = run.cast(x)
        expected = reference.symlog(x)
        actual = run.expect("symlog", (x,), expected, bound=16 * run.u)
        run.exact("symlog(-x) + symlog(x)", run.call("symlog", -x), -np.asarray(actual))


@check("TRA-4", uses=["symexp"], level=0)
def symexp_literals(run: Run) -> None:
    """symexp of 0, 1, -2 and 20 is 0, 1.718282, -6.389056 and 485165194.41."""
    expected = np.array([0.0, 0.0, 1.718281828459045, -6.38905609893065, 485165194.4097903])
    run.expect("symexp", (run.cast([0.0, -0.0, 1.0, -2.0, 20.0]),), expected, bound=16 * 21 * run.u)


@check("TRA-2", "TRA-4", uses=["symexp"], level=0)
def symexp_matches(run: Run) -> None:
    """symexp agrees within 16 u (1 + |x|), overflows to infinity, and is odd."""

    @run.for_all(x=shapes().flatmap(lambda shape: arrays(adversarial_numbers(), shape)))
    def _(x: np.ndarray) -> None:
        x = run.cast(x)
        with np.errstate(over="ignore"):
            expected = round_to(reference.symexp(x), "float64" if run.dtype == "float64" else "float32")
        actual = np.asarray(run.call("symexp", x), np.float64)
        near_overflow = np.abs(expected) > 2.0 ** (1022 if run.dtype == "float64" else 126)
        expected = np.where(near_overflow & np.isinf(actual), np.copysign(np.inf, expected), expected)
        run.compare("symexp", actual, expected, magnitude=np.abs(expected) * (1 + np.abs(x)), bound=16 * run.u)
        run.exact("symexp(-x) + symexp(x)", run.call("symexp", -x), -actual)


@check("TRA-3", "TRA-4", uses=["symlog", "symexp"], level=0)
def symexp_inverts_symlog(run: Run) -> None:
    """symexp(symlog(x)) is x."""

    @run.for_all(x=arrays(st.floats(-1e6, 1e6, width=32), (8,)))
    def _(x: np.ndarray) -> None:
        x = run.cast(x)
        run.compare("symexp(symlog(x))", run.call("symexp", run.call("symlog", x)), x, bound=512 * run.u)


@check("TRA-5", "TRA-6", uses=["exponential_bins"], level=0)
def bins_literals(run: Run) -> None:
    """255 bins from -485165194.41 to 485165194.41, exactly antisymmetric, 0 in the middle; 5 bins in full."""
    five = [-485165194.4097903, -22025.465794806718, 0.0, 22025.465794806718, 485165194.4097903]
    run.expect("exponential_bins", (5,), np.array(five), bound=1e-12)
    bins = np.asarray(run.expect("exponential_bins", (255,), reference.exponential_bins(255), bound=1e-12))
    run.compare(
        "bins 127 to 129", bins[127:130], np.array([0.0, 0.17055771862604, 0.37020536395145]), magnitude=1.0, bound=1e-8
    )
    run.holds("bins are float64", bins.dtype == np.float64)
    run.exact("bins are antisymmetric", bins[::-1], -bins)
    run.holds("bins increase", np.diff(bins) > 0)


@check("TRA-6", uses=["exponential_bins"], level=0)
def bins_refuse_even_counts(run: Run) -> None:
    """An even number of bins, or fewer than 3, is refused."""
    for count in (254, 2, 1, 0, -3):
        run.refuses("exponential_bins", count)


@check("TRA-6", "TRA-7", "TRA-10", uses=["exponential_bins", "twohot", "ordered_expectation"], level=0)
def the_fewest_bins(run: Run) -> None:
    """There are 3 exponential bins at least, a two-hot encoding over 2 bins, and a mean over 3."""
    run.expect("exponential_bins", (3,), np.array([-485165194.4097903, 0.0, 485165194.4097903]), bound=1e-12)
    run.exact("twohot", run.call("twohot", np.array([0.0, -5.0]), np.array([-1.0, 3.0])), [[0.75, 0.25], [1, 0]])
    run.exact("mean", run.call("ordered_expectation", np.array([0.25, 0.25, 0.5]), np.array([-2.0, 0.0, 2.0])), 0.5)


@check("TRA-7", "TRA-8", uses=["twohot"], level=0)
def twohot_literals(run: Run) -> None:
    """Over the bins -3, -1, 0, 1, 3: 2 is [0,0,0,.5,.5], -.25 is [0,.25,.75,0,0], a bin is itself, 7 is the last
    bin."""
    x = np.array([2.0, -0.25, 1.0, 7.0, -3.0, -0.0, -9.0])
    expected = np.zeros((7, 5))
    expected[0, 3:] = 0.5
    expected[1, 1:3] = 0.25, 0.75
    expected[2, 3] = expected[3, 4] = expected[4, 0] = expected[5, 2] = expected[6, 0] = 1
    run.exact("twohot", run.call("twohot", x, SMALL_BINS), expected)
    weights = np.zeros((2, 255))
    weights[0, 127:129] = 0.4136882, 0.5863118
    weights[1, 163:165] = 0.774017, 0.225983
    run.expect(
        "twohot",
        (run.cast([0.1, 300.0]), held_bins(run)),
        weights,
        magnitude=1.0,
        bound=1e-5 if run.dtype != "bfloat16" else 1e-2,
    )


@check("TRA-7", "TRA-8", "TRA-9", "TRA-14", uses=["twohot"], level=0)
def twohot_matches(run: Run) -> None:
    """Weights agree on bin edges and their neighbours, huge and non-finite numbers; other entries are exactly 0; the
    sum is 1."""
    bins = held_bins(run)
    edges = st.integers(0, 254).flatmap(
        lambda k: st.sampled_from([bins[k], np.nextafter(bins[k], -np.inf), np.nextafter(bins[k], np.inf)])
    )

    @run.for_all(x=shapes().flatmap(lambda shape: arrays(st.one_of(adversarial_numbers(), edges), shape)))
    def _(x: np.ndarray) -> None:
        x = run.cast(x)
        expected = reference.twohot(x, bins)
        actual = np.asarray(run.call("twohot", x, bins), np.float64)
        # Subnormal numbers may be flushed, and weights of the order of a rounding error may be 0.
        run.compare("twohot", actual, expected, magnitude=1.0, bound=64 * run.u)
        finite = actual[~np.isnan(x)]
        run.holds("at most two weights are not 0", (finite != 0).sum(-1) <= 2)
        run.holds("weights lie in [0, 1]", (finite >= 0) & (finite <= 1))
        run.compare("sum of weights", finite.sum(-1), np.ones(finite.shape[:-1]), magnitude=1.0, bound=4 * run.u)
        run.holds("a bin has weight 1 on itself", finite[np.isin(x[~np.isnan(x)], bins)].max(-1, initial=1.0) == 1)


@check("TRA-7", uses=["twohot"], level=0)
def twohot_mean_is_the_number(run: Run) -> None:
    """The mean of the weights is the number itself, interpolated between the raw bins and not between their symlogs."""
    bins = held_bins(run)
    x = run.cast(np.linspace(-50, 50, 41))
    mean = np.asarray(run.call("twohot", x, bins), np.float64) @ bins
    run.compare("mean of twohot(x)", mean, x, magnitude=1 + np.abs(x), bound=64 * run.u)


@check("TRA-10", "TRA-14", uses=["ordered_expectation"], level=0)
def expectation_matches(run: Run) -> None:
    """The mean over bins that span 17 orders of magnitude, within rounding of the paired sum."""
    literal = run.call("ordered_expectation", np.array([0.125, 0.1875, 0.3125, 0.125, 0.25]), SMALL_BINS)
    run.exact("ordered_expectation of [2, 3, 5, 2, 4] / 16", literal, 0.3125)

    @run.for_all(seed=seeds(), shape=shapes(2), scale=st.sampled_from([1e-3, 1.0, 30.0]))
    def _(seed: int, shape: tuple[int, ...], scale: float) -> None:
        bins = held_bins(run)
        logits = normals(seed, *shape, 255, scale=scale)
        probs = run.cast(
            np.exp(logits - logits.max(-1, keepdims=True))
            / np.exp(logits - logits.max(-1, keepdims=True)).sum(-1, keepdims=True)
        )
        magnitude = (bins[128:] * np.abs(probs[..., 128:] - probs[..., 126::-1])).sum(-1) + run.tiny
        run.expect(
            "ordered_expectation",
            (probs, bins),
            reference.ordered_expectation(probs, bins),
            magnitude=magnitude,
            bound=64 * run.u,
        )


@check("TRA-11", uses=["ordered_expectation"], level=0)
def expectation_is_exactly_antisymmetric(run: Run) -> None:
    """Mirror-symmetric probabilities give exactly 0, and mirroring the probabilities exactly changes the sign."""
    run.exact(
        "uniform probabilities",
        run.call("ordered_expectation", run.cast(np.full((3, 255), 1 / 255)), held_bins(run)),
        np.zeros(3),
    )

    @run.for_all(seed=seeds())
    def _(seed: int) -> None:
        probs = run.cast(np.random.default_rng(seed).dirichlet(np.full(255, 0.5), 3))
        mean = np.asarray(run.call("ordered_expectation", probs, held_bins(run)))
        run.exact("mirrored", run.call("ordered_expectation", probs[:, ::-1].copy(), held_bins(run)), -mean)
        symmetric = run.cast((probs + probs[:, ::-1]) / 2)
        symmetric = np.concatenate([symmetric[:, :128], symmetric[:, 126::-1]], -1)
        run.exact("symmetric", run.call("ordered_expectation", symmetric, held_bins(run)), np.zeros(3))


@check("TRA-12", uses=["ordered_expectation"], level=0)
def expectation_of_nan(run: Run) -> None:
    """A NaN among the probabilities of one distribution makes its mean NaN, and no other."""
    probs = np.full((4, 255), 1 / 255)
    probs[1, 127] = probs[2, 0] = np.nan
    actual = run.call("ordered_expectation", probs, held_bins(run))
    run.exact("ordered_expectation", actual, np.array([0, np.nan, np.nan, 0]))


@check("TRA-13", uses=["twohot", "ordered_expectation"], level=0)
def wrong_bins_are_refused(run: Run) -> None:
    """Bins that are not one row of enough entries, or that do not fit the probabilities, are refused."""
    run.refuses("twohot", np.zeros(3), np.zeros((2, 5)))
    run.refuses("twohot", np.zeros(3), np.zeros(1))
    run.refuses("ordered_expectation", np.full((2, 4), 0.25), np.array([-3.0, -1.0, 1.0, 3.0]))
    run.refuses("ordered_expectation", np.full((2, 5), 0.2), np.array([-1.0, 0.0, 1.0]))
    run.refuses("ordered_expectation", np.full((2, 5), 0.2), np.zeros((1, 5)))


@check("TRA-1", uses=["symlog", "symexp", "twohot", "ordered_expectation"], level=0)
def float32_or_better(run: Run) -> None:
    """Whatever the compute dtype, results are more precise than bfloat16 could hold."""
    x = run.cast([0.3, 0.7, 5.1])
    run.expect("symlog", (x,), reference.symlog(x), bound=16 * run.u)
    run.expect("symexp", (x,), reference.symexp(x), bound=16 * 7 * run.u)
    run.expect("twohot", (x, SMALL_BINS), reference.twohot(x, SMALL_BINS), magnitude=1.0, bound=64 * run.u)
    probs = np.array([0.1, 0.2, 0.3, 0.15, 0.25])
    held = run.cast(probs)
    run.expect(
        "ordered_expectation",
        (held, SMALL_BINS),
        reference.ordered_expectation(held, SMALL_BINS),
        magnitude=1.0,
        bound=64 * run.u,
    )
