"""Mistakes in spec/03-layers.md."""

from conformance.mutants.catalogue import Mutant

MUTANTS = (
    Mutant(
        name="blocks_interleaved",
        explanation="a block-linear layer gives block g every G-th input in place of the g-th piece",
        provenance="plausible: reshape with the axes in the other order",
        violates=("LAY-3",),
        fix="Split the last axis into contiguous pieces.",
        edits={"layers.block_linear": {"x[..., block * inputs : (block + 1) * inputs]": "x[..., block::blocks]"}},
    ),
    Mutant(
        name="norm_subtracts_the_mean",
        explanation="the norm subtracts the mean: a LayerNorm",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl",
        violates=("LAY-4",),
        fix="Divide by the root mean square and subtract nothing.",
        edits={
            "layers.rms_norm": {
                "mean_square = np.mean(": "x = x - np.mean(x, axis=-1, keepdims=True)\n    mean_square = np.mean("
            }
        },
    ),
    Mutant(
        name="norm_epsilon_outside_the_root",
        explanation="the norm adds its epsilon to the root in place of the mean square",
        provenance="plausible",
        violates=("LAY-4",),
        fix="Add epsilon inside of the root.",
        edits={"layers.rms_norm": {"np.sqrt(mean_square + epsilon)": "(np.sqrt(mean_square) + epsilon)"}},
    ),
    Mutant(
        name="norm_epsilon_of_the_library",
        explanation="the norm uses an epsilon of 1e-6 in place of the configured one",
        provenance="plausible: a library's default; NM512/dreamerv3-torch and sheeprl have 1e-3",
        violates=("LAY-4", "CON-32"),
        fix="Pass norm_epsilon, 1e-4.",
        edits={"layers.rms_norm": {"mean_square + epsilon": "mean_square + 1e-6"}},
    ),
    Mutant(
        name="activation_is_elu",
        explanation="the activation is ELU",
        provenance="DreamerV1 and V2",
        violates=("LAY-5",),
        fix="Use SiLU: x times its sigmoid.",
        edits={
            "layers.silu": {"return x / (1.0 + np.exp(-x))": "return np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))"}
        },
    ),
    Mutant(
        name="kernel_flipped",
        explanation="the convolution flips its kernel",
        provenance="plausible: the mathematical convolution",
        violates=("LAY-6",),
        fix="Correlate: the kernel as it is.",
        edits={"layers.convolution": {"kernel[row, column]": "kernel[-1 - row, -1 - column]"}},
    ),
    Mutant(
        name="convolution_padded_on_the_other_side",
        explanation="a convolution of stride 2 is padded with two pixels before and one after",
        provenance="plausible: PyTorch's padding=2, against the padding 'same' of JAX",
        violates=("LAY-6",),
        fix="Pad one before and two after.",
        edits={"layers.convolution": {"else (1, 2)": "else (2, 1)"}},
    ),
    Mutant(
        name="transposed_convolution_shifted",
        explanation="the transposed convolution lies one pixel further up and left",
        provenance="plausible: PyTorch's padding=2 and output_padding=1",
        violates=("LAY-7",),
        fix="Input i and tap k add to output 2i + k - 1.",
        edits={
            "layers.transposed_convolution": {
                (
                    "padded[..., 1 : 1 + 2 * height, 1 : 1 + 2 * width, :]"
                ): "padded[..., 2 : 2 + 2 * height, 2 : 2 + 2 * width, :]"
            }
        },
    ),
    Mutant(
        name="activation_before_the_norm",
        explanation="a dense layer applies its activation before the norm",
        provenance="plausible",
        violates=("LAY-8",),
        fix="Linear, then norm, then activation.",
        edits={
            "layers.dense": {
                (
                    'silu(rms_norm(x, params[f"{name}/scale"], epsilon))'
                ): 'rms_norm(silu(x), params[f"{name}/scale"], epsilon)'
            }
        },
    ),
    Mutant(
        name="initial_weights_cut_at_two",
        explanation="initial weights are cut at the numbers -2 and 2, so hardly at all, and are too wide",
        provenance="NM512/dreamerv3-torch until commit 970d1dc",
        violates=("LAY-9",),
        fix="Cut at two standard deviations.",
        edits={
            "layers.truncated_normal": {
                "standard.cdf(-2.0), standard.cdf(2.0)": "standard.cdf(-6.0), standard.cdf(6.0)",
                "np.clip(z, -2.0, 2.0)": "z",
            }
        },
    ),
    Mutant(
        name="initial_weights_too_narrow",
        explanation="initial weights are not widened for what the truncation takes from their standard deviation",
        provenance="plausible: the factor 1.1368 is in no paper (D-77)",
        violates=("LAY-9",),
        fix="Divide by 0.8796, the standard deviation of a normal cut at two.",
        edits={"layers.truncated_normal": {"/ TRUNCATED_NORMAL_STD * outscale": "* outscale"}},
    ),
)
