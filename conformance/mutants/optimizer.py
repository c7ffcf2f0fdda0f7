"""Mistakes in spec/09-optimizer.md."""

from conformance.mutants.catalogue import Mutant

_CLIP = "adaptive_gradient_clip(gradients[name], params[name], config.agc_clip, config.agc_epsilon)"

MUTANTS = (
    Mutant(
        name="clip_by_unit",
        explanation="gradients are clipped for each output by itself",
        provenance="plausible: the paper that introduced adaptive clipping does so (D-74)",
        violates=("OPT-1", "OPT-2"),
        fix="Take one norm over the whole tensor.",
        edits={
            "optimizer.adaptive_gradient_clip": {
                "length, size = _norm(gradient), _norm(parameter)": (
                    "if gradient.ndim > 1:\n"
                    "        units = zip(np.moveaxis(gradient, -1, 0), np.moveaxis(parameter, -1, 0), strict=True)\n"
                    "        clipped = [adaptive_gradient_clip(g.ravel(), p.ravel(), clip, "
                    "epsilon).reshape(g.shape) for g, p in units]\n"
                    "        return np.stack(clipped, -1)\n"
                    "    length, size = _norm(gradient), _norm(parameter)"
                )
            }
        },
    ),
    Mutant(
        name="clip_by_global_norm",
        explanation="the gradient of all parameters together is clipped at a norm of 1",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl clip one global norm",
        violates=("OPT-2",),
        fix="Clip each tensor against its own parameters.",
        edits={
            "optimizer.optimizer_step": {
                "rate = learning_rate(step, config)": (
                    "rate = learning_rate(step, config)\n"
                    "    together = max(1.0, _norm(np.concatenate([np.ravel(gradient) for "
                    "gradient in gradients.values()])))"
                ),
                _CLIP: "np.asarray(gradients[name]) / together",
            }
        },
    ),
    Mutant(
        name="clip_without_floor",
        explanation="parameters that are zero are never updated, because nothing is large against them",
        provenance="plausible: the smallest norm of a parameter left out",
        violates=("OPT-1",),
        fix="Take the parameter's norm to be at least agc_epsilon.",
        edits={"optimizer.adaptive_gradient_clip": {"max(epsilon, size)": "size"}},
    ),
    Mutant(
        name="clip_leaves_vectors_out",
        explanation="biases and scales are not clipped",
        provenance="plausible: common in implementations of adaptive clipping",
        violates=("OPT-2",),
        fix="Clip every tensor.",
        edits={"optimizer.optimizer_step": {_CLIP: f"{_CLIP} if np.ndim(params[name]) > 1 else gradients[name]"}},
    ),
    Mutant(
        name="clip_against_the_new_moments",
        explanation="what is clipped is the normalized update in place of the gradient",
        provenance="plausible: the links of an optimizer chain in another order",
        violates=("OPT-15",),
        fix="Clip first, then normalize, then average.",
        edits={
            "optimizer.optimizer_step": {
                "clipped, state[": "gradients[name], state[",
                "- rate * update": f"- rate * {_CLIP.replace('gradients[name]', 'update')}",
            }
        },
    ),
    Mutant(
        name="warmup_starts_at_one",
        explanation="the warmup counts from 1, so that the first update moves",
        provenance="r2dreamer (D-75)",
        violates=("OPT-6",),
        fix="The first update has a learning rate of 0.",
        edits={"optimizer.learning_rate": {"step / config.warmup_steps)": "(step + 1) / config.warmup_steps)"}},
    ),
    Mutant(
        name="no_warmup",
        explanation="the learning rate is full from the first update on",
        provenance="plausible; the paper's text has no warmup (D-75)",
        violates=("OPT-6",),
        fix="Raise the learning rate linearly over warmup_steps.",
        edits={"optimizer.learning_rate": {"if config.warmup_steps == 0:": "if True:"}},
    ),
    Mutant(
        name="momentum_before_normalization",
        explanation="the gradient is averaged before it is normalized: Adam",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl",
        violates=("OPT-8", "OPT-12"),
        fix="Normalize first, then average: LaProp.",
        edits={
            "optimizer.laprop": {
                (
                    "normalized = np.where(gradient == 0, 0.0, gradient / np.where(gradient == 0, 1.0, root))"
                ): "normalized = gradient",
                "(1 - config.beta1**updates)": "(1 - config.beta1**updates) / np.where(root == 0, 1.0, root)",
            }
        },
    ),
    Mutant(
        name="no_correction_of_the_second_moment",
        explanation="the second moment is not corrected for its start at 0",
        provenance="plausible: RMSProp",
        violates=("OPT-8",),
        fix="Divide the second moment by 1 - beta2^t.",
        edits={"optimizer.laprop": {"np.sqrt(second_moment / (1 - config.beta2**updates))": "np.sqrt(second_moment)"}},
    ),
    Mutant(
        name="no_correction_of_the_momentum",
        explanation="the momentum is not corrected for its start at 0",
        provenance="plausible",
        violates=("OPT-8",),
        fix="Divide the momentum by 1 - beta1^t.",
        edits={"optimizer.laprop": {"momentum / (1 - config.beta1**updates)": "1.0 * momentum"}},
    ),
    Mutant(
        name="correction_one_step_late",
        explanation="the corrections of the moments count the updates before this one",
        provenance="plausible: a counter that is raised at the end",
        violates=("OPT-8",),
        fix="Count this update: t = step + 1.",
        edits={"optimizer.laprop": {"updates = step + 1": "updates = max(step, 1)"}},
    ),
    Mutant(
        name="epsilon_inside_the_root",
        explanation="the epsilon of LaProp is added to the second moment in place of its root",
        provenance="plausible",
        violates=("OPT-8",),
        fix="Add epsilon outside of the root.",
        edits={
            "optimizer.laprop": {
                "np.sqrt(second_moment / (1 - config.beta2**updates)) + config.laprop_epsilon": (
                    "np.sqrt(second_moment / (1 - config.beta2**updates) + config.laprop_epsilon)"
                )
            }
        },
    ),
    Mutant(
        name="epsilon_of_adam",
        explanation="LaProp divides with an epsilon of 1e-8 in place of 1e-20, so that small gradients move less",
        provenance="plausible: the default of a library",
        violates=("OPT-8", "CON-32"),
        fix="Pass laprop_epsilon, 1e-20.",
        edits={"optimizer.laprop": {"+ config.laprop_epsilon": "+ 1e-8"}},
    ),
    Mutant(
        name="learning_rate_inside_the_momentum",
        explanation="the momentum averages steps that hold the learning rate of their time",
        provenance="r2dreamer, after the original LaProp (D-73)",
        violates=("OPT-12",),
        fix="Multiply the finished update by the learning rate.",
        edits={
            "optimizer.laprop": {
                "(1 - config.beta1) * normalized": "(1 - config.beta1) * learning_rate(step, config) * normalized"
            },
            "optimizer.optimizer_step": {"- rate * update": "- update"},
        },
    ),
    Mutant(
        name="no_dead_zone",
        explanation="gradients below 1e-16 are normalized like any other, where float32 cannot square them",
        provenance="danijar/dreamerv3 (D-73)",
        violates=("OPT-9",),
        fix="Replace gradients below 1e-16 by 0.",
        edits={"optimizer.laprop": {"np.where(np.abs(gradient) < DEAD_ZONE, 0.0, gradient)": "gradient"}},
    ),
    Mutant(
        name="zero_over_zero",
        explanation="a gradient of 0 is divided by a root of 0, which is NaN where the epsilon is 0",
        provenance="Optax and TorchRL, whose updates divide in one operation",
        violates=("OPT-10",),
        fix="Where the gradient is 0, the normalized gradient is 0.",
        edits={
            "optimizer.laprop": {
                "np.where(gradient == 0, 0.0, gradient / np.where(gradient == 0, 1.0, root))": "gradient / root"
            }
        },
    ),
    Mutant(
        name="weight_decay",
        explanation="parameters decay",
        provenance="plausible: DreamerV2 has a weight decay of 1e-6 (D-79)",
        violates=("OPT-16",),
        fix="Leave weight decay out.",
        edits={"optimizer.optimizer_step": {"rate * update": "rate * (update + 1e-6 * np.asarray(params[name]))"}},
    ),
    Mutant(
        name="broken_gradients_are_skipped",
        explanation="gradients that are not finite count as 0, so that a broken run goes on",
        provenance="plausible: mixed-precision scalers skip such steps",
        violates=("OPT-20",),
        fix="Let a NaN show in the parameters, and let the training loop notice.",
        edits={
            "optimizer.optimizer_step": {
                _CLIP: _CLIP.replace("gradients[name]", "np.nan_to_num(gradients[name], posinf=0, neginf=0)")
            }
        },
    ),
)
