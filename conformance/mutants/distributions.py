"""Mistakes in spec/02-distributions.md."""

from conformance.mutants.catalogue import Mutant

MUTANTS = (
    Mutant(
        name="no_unimix",
        explanation="the latents and the actor have no uniform mixture",
        provenance=(
            "plausible: danijar/dreamerv3 sets it and leaves it out for discrete actors since December 2024 (issue 219)"
        ),
        violates=("DIS-5",),
        fix="Mix 1 % of the uniform distribution into the probabilities of posterior, prior and actor.",
        edits={"distributions.unimix_log_probs": {"if unimix == 0:": "if True:"}},
    ),
    Mutant(
        name="unimix_adds_up_to_more_than_one",
        explanation="the uniform share is added to the softmax without shrinking it",
        provenance="plausible",
        violates=("DIS-5",),
        fix="Multiply the softmax with 1 - unimix before the uniform share is added.",
        edits={"distributions.unimix_log_probs": {"(1 - unimix) * np.exp(log_softmax)": "np.exp(log_softmax)"}},
    ),
    Mutant(
        name="unimix_in_the_twohot_heads",
        explanation="the distributions of reward and value have the uniform mixture, too",
        provenance="the paper says all categoricals (D-21)",
        violates=("DIS-7", "DIS-14"),
        fix="Leave reward head and critic without a mixture.",
        edits={
            "distributions.symexp_twohot_loss": {"unimix_log_probs(logits, 0.0)": "unimix_log_probs(logits, 0.01)"},
            "distributions.symexp_twohot_mean": {"unimix_log_probs(logits, 0.0)": "unimix_log_probs(logits, 0.01)"},
        },
    ),
    Mutant(
        name="sample_is_the_most_likely_class",
        explanation="the most likely class is taken in place of a sample",
        provenance="plausible: evaluation by the mode, left on in training",
        violates=("DIS-8", "BEH-8"),
        fix="Sample every latent and action.",
        edits={
            "distributions.categorical_sample": {
                "np.sum(cumulative[..., :-1] <= uniform[..., None], axis=-1)": "np.argmax(log_probs, axis=-1)"
            }
        },
    ),
    Mutant(
        name="impossible_class_is_drawn",
        explanation="a uniform number of 0 draws a first class of probability 0",
        provenance="plausible: < in place of <=",
        violates=("DIS-8",),
        fix="Count the cumulative probabilities that are smaller than or equal to the uniform number.",
        edits={"distributions.categorical_sample": {"<= uniform[..., None]": "< uniform[..., None]"}},
    ),
    Mutant(
        name="straight_through_logits",
        explanation="the straight-through gradient goes through the log-probabilities",
        provenance="SimpleDreamer until commit 1800326",
        violates=("DIS-9", "RSSM-12"),
        fix="Give the sample the gradient of the probabilities: sample + (p - sg(p)).",
        edits={
            "distributions.straight_through": {
                'np.exp(checked("log_probs", log_probs, ..., "C"))': 'checked("log_probs", log_probs, ..., "C")'
            }
        },
    ),
    Mutant(
        name="no_straight_through",
        explanation="samples are constants: no gradient passes the latents",
        provenance="plausible; navix had it for the actions (commit 5d43c78)",
        violates=("DIS-9", "RSSM-12"),
        fix="Give the sample the gradient of the probabilities: sample + (p - sg(p)).",
        edits={"distributions.straight_through": {"(probs - stop_gradient(probs))": "0.0 * stop_gradient(probs)"}},
    ),
    Mutant(
        name="entropy_averaged_over_classes",
        explanation="the entropy of a categorical is the mean over its classes",
        provenance="plausible",
        violates=("DIS-11",),
        fix="Sum over the classes.",
        edits={
            "distributions.categorical_entropy": {
                "-np.sum(_product(np.exp(log_probs), log_probs), axis=-1)": (
                    "-np.mean(_product(np.exp(log_probs), log_probs), axis=-1)"
                )
            }
        },
    ),
    Mutant(
        name="target_squashed_before_twohot",
        explanation="rewards and returns pass symlog before they are encoded with bins in raw units",
        provenance="naivoder's implementation applies symlog twice",
        violates=("DIS-14", "WM-6"),
        fix="Encode the raw number: the exponential bins are in its unit.",
        edits={"distributions.symexp_twohot_loss": {"twohot(target, bins)": "twohot(symlog(target), bins)"}},
    ),
    Mutant(
        name="mean_in_symlog_space",
        explanation="the mean is taken over the bins in symlog space, and symexp comes after it",
        provenance="2023 edition; biased low where the target is uncertain (D-46)",
        violates=("DIS-15",),
        fix="Average the raw positions of the bins.",
        edits={
            "distributions.symexp_twohot_mean": {
                "return ordered_expectation(np.exp(unimix_log_probs(logits, 0.0)), bins)": (
                    "mean = ordered_expectation(np.exp(unimix_log_probs(logits, 0.0)), symlog(bins))\n"
                    "    return np.sign(mean) * np.expm1(np.abs(mean))"
                )
            }
        },
    ),
    Mutant(
        name="continue_loss_from_probabilities",
        explanation="the continue loss takes the logarithm of a computed sigmoid, which is infinite for large logits",
        provenance="plausible: a textbook cross entropy",
        violates=("DIS-16", "WM-8"),
        fix="Use softplus of the logit, or a loss that takes logits.",
        edits={
            "distributions.bernoulli_loss": {
                "return _product(target, _softplus(-logit)) + _product(1 - target, _softplus(logit))": (
                    'with np.errstate(all="ignore"):\n        p = 1.0 / (1.0 + np.exp(-logit))\n'
                    "        return _product(target, -np.log(p)) + _product(1 - target, -np.log(1.0 - p))"
                )
            }
        },
    ),
    Mutant(
        name="continue_loss_of_hard_targets",
        explanation="a continue target between 0 and 1 is rounded",
        provenance="plausible: a loss for classes; no difference unless targets are discounted",
        violates=("DIS-16",),
        fix="Take the target as it is: it may lie between 0 and 1.",
        edits={
            "distributions.bernoulli_loss": {
                "target = stop_gradient(": "target = np.round(",
                "*logit.shape))": "*logit.shape))",
            }
        },
    ),
    Mutant(
        name="continue_is_the_mode",
        explanation="imagined returns use the most likely continue flag in place of its probability",
        provenance="2023 edition, and sheeprl (D-07)",
        violates=("DIS-18", "RET-3"),
        fix="Use the sigmoid of the logit.",
        edits={
            "distributions.bernoulli_mean": {
                'return _sigmoid(checked("logit", logit, ...))': (
                    "return np.where(np.isnan(logit), np.nan, np.asarray(logit) > 0.0)"
                )
            }
        },
    ),
    Mutant(
        name="continue_is_nan_at_one_half",
        explanation="imagined returns use the most likely continue flag, which is NaN where both are as likely",
        provenance="sheeprl until issue 186: the mode of a Bernoulli distribution of PyTorch",
        violates=("DIS-18", "RET-3"),
        fix="Use the sigmoid of the logit.",
        edits={
            "distributions.bernoulli_mean": {
                'return _sigmoid(checked("logit", logit, ...))': (
                    "logit = np.asarray(logit, dtype=np.float64)\n    return np.where(np.isnan(logit) | (logit "
                    "== 0), np.nan, logit > 0.0)"
                )
            }
        },
    ),
    Mutant(
        name="continue_is_the_logit",
        explanation="the logit of the continue head is used as a probability",
        provenance="naivoder's implementation; TorchRL used logits of reward and value as numbers (issue 4066)",
        violates=("DIS-18", "RET-3"),
        fix="Use the sigmoid of the logit.",
        edits={
            "distributions.bernoulli_mean": {'_sigmoid(checked("logit", logit, ...))': 'checked("logit", logit, ...)'}
        },
    ),
    Mutant(
        name="std_without_offset",
        explanation=(
            "the standard deviation of continuous actions lacks the + 2 before its sigmoid, "
            "so that a fresh policy explores less"
        ),
        provenance="the paper does not mention it (D-66)",
        violates=("DIS-19", "BEH-4"),
        fix="Add 2 to the raw output before the sigmoid.",
        edits={"distributions.bounded_normal": {"_sigmoid(std + 2.0)": "_sigmoid(std)"}},
    ),
    Mutant(
        name="std_by_softplus",
        explanation="the standard deviation of continuous actions is a softplus with a lower bound",
        provenance="sheeprl until issue 224, after DreamerV2",
        violates=("DIS-19", "BEH-4"),
        fix="Scale a sigmoid into the bounds: (max - min) sigmoid(x + 2) + min.",
        edits={
            "distributions.bounded_normal": {
                "(max_std - min_std) * _sigmoid(std + 2.0) + min_std": "_softplus(std) + min_std"
            }
        },
    ),
    Mutant(
        name="mean_without_tanh",
        explanation="the mean of continuous actions is not squashed",
        provenance="plausible",
        violates=("DIS-19", "BEH-4"),
        fix="Take tanh of the raw output.",
        edits={"distributions.bounded_normal": {"np.tanh(mean)": "mean"}},
    ),
    Mutant(
        name="action_clipped_when_sampled",
        explanation=(
            "sampled actions are clipped to [-1, 1], so that the score belongs to another "
            "action than the one that was drawn"
        ),
        provenance="plausible; the environment's action is clipped, the sample is not (D-67)",
        violates=("DIS-20", "CON-27"),
        fix="Store and score the raw sample, and clip what the environment gets.",
        edits={
            "distributions.normal_sample": {
                'mean + std * checked("normal", normal, *mean.shape)': (
                    'np.clip(mean + std * checked("normal", normal, *mean.shape), -1, 1)'
                )
            }
        },
    ),
    Mutant(
        name="log_density_without_log_std",
        explanation=(
            "the log-density of a normal leaves out the logarithm of the standard "
            "deviation, so that the score pushes it apart"
        ),
        provenance="plausible: a squared error in place of a density",
        violates=("DIS-21",),
        fix="Subtract log(std).",
        edits={"distributions.normal_log_prob": {"- np.log(std) - 0.5": "- 0.5"}},
    ),
    Mutant(
        name="score_without_detached_action",
        explanation="the score of a normal policy follows its own sample, so that the gradient of the mean cancels",
        provenance="NM512/dreamerv3-torch with reinforce and continuous actions; TorchRL until issue 4119",
        violates=("DIS-21", "BEH-5"),
        fix="Detach the action before its log-probability is taken.",
        edits={
            "distributions.normal_log_prob": {
                'value = stop_gradient(checked("value", value, *mean.shape))': (
                    'value = stop_gradient(checked("value", value, *mean.shape))\n'
                    "    value = mean + std * stop_gradient((value - mean) / std)"
                )
            }
        },
    ),
    Mutant(
        name="squared_error_halved",
        explanation="the squared error of images has the factor 1/2",
        provenance="the paper's printed equation, which is for vectors (D-14)",
        violates=("DIS-23", "WM-4"),
        fix="Sum the plain squares.",
        edits={"distributions.mse_loss": {"(prediction - target) ** 2": "0.5 * (prediction - target) ** 2"}},
    ),
    Mutant(
        name="vector_loss_in_raw_space",
        explanation="the decoder's vectors are compared with the raw observation",
        provenance="plausible",
        violates=("DIS-24", "WM-2"),
        fix="Compare with symlog of the observation.",
        edits={"distributions.symlog_mse_loss": {"symlog(target)": "target"}},
    ),
    Mutant(
        name="vector_loss_with_a_dead_zone",
        explanation="squared errors below 1e-8 count as 0",
        provenance="edition of April 2024, NM512/dreamerv3-torch, sheeprl, r2dreamer (D-14)",
        violates=("DIS-24",),
        fix="Leave small errors as they are.",
        edits={
            "distributions.symlog_mse_loss": {
                "return scale * (prediction - symlog(target)) ** 2": (
                    "square = (prediction - symlog(target)) ** 2\n        return scale * "
                    "np.where(square < 1e-8, 0.0, square)"
                )
            }
        },
    ),
)
