"""Mistakes in spec/05-networks.md."""

from conformance.mutants.catalogue import Mutant

MUTANTS = (
    Mutant(
        name="feature_with_latents_first",
        explanation="the model state is latents and memory, in this order",
        provenance="the decoder of danijar/dreamerv3 reads it so (D-31)",
        violates=("NET-1", "CON-4"),
        fix="Concatenate memory and latents.",
        edits={
            "networks.feature": {
                "[deter, stoch.reshape(*stoch.shape[:-2], -1)]": "[stoch.reshape(*stoch.shape[:-2], -1), deter]"
            }
        },
    ),
    Mutant(
        name="vectors_enter_raw",
        explanation="the encoder reads vectors without symlog",
        provenance="plausible",
        violates=("NET-3",),
        fix="Pass vectors through symlog.",
        edits={
            "networks._encode_vector": {
                "symlog(np.asarray(value, dtype=np.float64))": "np.asarray(value, dtype=np.float64)"
            }
        },
    ),
    Mutant(
        name="images_without_offset",
        explanation="the encoder reads images between 0 and 1 in place of -1/2 and 1/2",
        provenance="sheeprl until issue 214, NM512/dreamerv3-torch until commit a9e85e8",
        violates=("NET-6",),
        fix="Subtract 1/2 from the scaled image, in the encoder only.",
        edits={"networks.encoder": {"scaled_image(observations[key]) - 0.5": "scaled_image(observations[key])"}},
    ),
    Mutant(
        name="images_not_scaled",
        explanation="the encoder reads the bytes of images as numbers up to 255",
        provenance=(
            "the DreamerV2 port in PyTorch by jsikyoon (issue 11), when acting: a tensor that forgot it was of bytes"
        ),
        violates=("NET-6",),
        fix="Divide by 255, in training and in acting.",
        edits={
            "networks.encoder": {
                "scaled_image(observations[key]) - 0.5": "255.0 * scaled_image(observations[key]) - 0.5"
            }
        },
    ),
    Mutant(
        name="stem_blocks_side_by_side",
        explanation="the stem of the image decoder reshapes the memory's blocks straight into the picture",
        provenance="plausible: a reshape without the transposition (D-36)",
        violates=("NET-16",),
        fix="Let every block fill its own channels at all positions.",
        edits={"networks._stem": {"memory.transpose(0, 2, 3, 1, 4).reshape": "memory.reshape"}},
    ),
    Mutant(
        name="decoder_without_sigmoid",
        explanation="the decoder's images are not squashed into [0, 1]",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl (D-15)",
        violates=("NET-19",),
        fix="Apply a sigmoid to the last layer.",
        edits={"networks._decode_image": {"return sigmoid(x)": "return x"}},
    ),
)
