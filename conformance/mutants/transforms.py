"""Mistakes in spec/01-transforms.md."""

from conformance.mutants.catalogue import Mutant

MUTANTS = (
    Mutant(
        name="symlog_without_log1p",
        explanation="symlog takes the logarithm of 1 + |x|, in which small numbers vanish",
        provenance="NM512/dreamerv3-torch and others write log(|x| + 1)",
        violates=("TRA-3",),
        fix="Compute log1p(|x|).",
        edits={"transforms.symlog": {"np.log1p(np.abs(x))": "np.log(1.0 + np.abs(x))"}},
    ),
    Mutant(
        name="symexp_without_expm1",
        explanation="symexp subtracts 1 from the exponential, in which small numbers vanish",
        provenance="NM512/dreamerv3-torch and others write exp(|x|) - 1",
        violates=("TRA-4",),
        fix="Compute expm1(|x|).",
        edits={"transforms.symexp": {"np.expm1(np.abs(x))": "(np.exp(np.abs(x)) - 1.0)"}},
    ),
    Mutant(
        name="bins_evenly_spaced",
        explanation="the bins are the numbers from -20 to 20 themselves, without symexp",
        provenance="2023 edition, whose bins lie in symlog space; PPO-v3 encoded raw returns with such bins (issue 4)",
        violates=("TRA-5",),
        fix="Space the bins exponentially: symexp of the numbers from -20 to 20.",
        edits={
            "transforms.exponential_bins": {
                "symexp(20.0 * np.arange(1, centre + 1) / centre)": "20.0 * np.arange(1, centre + 1) / centre"
            }
        },
    ),
    Mutant(
        name="twohot_in_symlog_space",
        explanation="two-hot weights are interpolated in symlog space",
        provenance="2023 edition; TorchRL until issue 4065, NM512/dreamerv3-torch and sheeprl",
        violates=("TRA-7",),
        fix="Interpolate between the raw positions of the bins.",
        edits={
            "transforms.twohot": {
                'bins = checked("bins", bins, "K")': 'x, bins = symlog(x), symlog(checked("bins", bins, "K"))'
            }
        },
    ),
    Mutant(
        name="twohot_with_weights_swapped",
        explanation="the two weights of a two-hot encoding are exchanged, so that the farther bin gets more",
        provenance="plausible",
        violates=("TRA-7",),
        fix="The nearer bin gets the larger weight: the distance to the other bin over their width.",
        edits={
            "transforms.twohot": {
                "weights[(*index, lower)] = (": "weights[(*index, lower + 1)] = (",
                "weights[(*index, lower + 1)] = (number": "weights[(*index, lower)] = (number",
            }
        },
    ),
    Mutant(
        name="twohot_is_onehot",
        explanation="all weight goes to the nearest bin",
        provenance="plausible",
        violates=("TRA-7",),
        fix="Share the weight between the two bins around the number.",
        edits={
            "transforms.twohot": {
                "width = bins[lower + 1] - bins[lower]": (
                    "upper = float(number - bins[lower] > bins[lower + 1] - number)"
                ),
                "(bins[lower + 1] - number) / width": "1.0 - upper",
                "= (number - bins[lower]) / width": "= upper",
            }
        },
    ),
    Mutant(
        name="twohot_of_large_numbers_is_empty",
        explanation="a number beyond the last bin has no weight anywhere",
        provenance="the paper's printed equation, which is not defined there (D-45)",
        violates=("TRA-8",),
        fix="Clamp: beyond an end the end bin has weight 1.",
        edits={
            "transforms.twohot": {
                "weights[(*index, lower)] = 1.0": "weights[(*index, lower)] = float(number == bins[lower])"
            }
        },
    ),
    Mutant(
        name="broken_target_trains_a_bin",
        explanation="NaN is encoded as the first bin, so that a broken target trains it",
        provenance="plausible: comparisons with NaN are false",
        violates=("TRA-9",),
        fix="Let a NaN give NaN in every entry.",
        edits={"transforms.twohot": {"weights[index] = np.nan": "weights[(*index, 0)] = 1.0"}},
    ),
    Mutant(
        name="expectation_from_left_to_right",
        explanation="the mean over the bins is summed from left to right, which leaves rounding where the bins cancel",
        provenance="plausible: a plain sum or matrix product (D-47)",
        violates=("TRA-10", "TRA-11"),
        fix="Subtract mirrored probabilities first, and sum from small to large bins.",
        edits={
            "transforms.ordered_expectation": {
                "range(1, centre + 1)": "range(len(bins))",
                "bins[centre + j] * (probs[..., centre + j] - probs[..., centre - j])": "bins[j] * probs[..., j]",
                "return total + probs[..., centre] * bins[centre]": "return total",
            }
        },
    ),
)
