"""Mistakes in spec/07-returns.md."""

from conformance.mutants.catalogue import Mutant

_IMAGINED = "reward[:, t + 1] + discount * continue_[:, t + 1] * future"

MUTANTS = (
    Mutant(
        name="return_bootstraps_from_itself",
        explanation=(
            "lambda-return bootstraps from its own value: reward, continue and value "
            "are those of the state that is left"
        ),
        provenance="the paper's printed indices (D-03); NaturalDreamer and naivoder's implementation",
        violates=("RET-1", "CON-13"),
        fix="Use reward, continue and value of the state that is reached, t + 1.",
        edits={
            "returns.lambda_return": {
                "(1 - lambda_) * value[:, t + 1]": "(1 - lambda_) * value[:, t]",
                _IMAGINED: _IMAGINED.replace("t + 1", "t"),
            }
        },
    ),
    Mutant(
        name="return_aligned_like_v2",
        explanation="lambda-return takes reward and continue of the state that is left, and the value of the next",
        provenance=(
            "DreamerV2's alignment; NM512/dreamerv3-torch until commit 9c58ab6 (issue 16), "
            "SimpleDreamer until dbd0810, DI-engine"
        ),
        violates=("RET-1", "CON-13"),
        fix="Use reward and continue of the state that is reached, t + 1.",
        edits={"returns.lambda_return": {_IMAGINED: _IMAGINED.replace("t + 1", "t")}},
    ),
    Mutant(
        name="return_looks_two_ahead",
        explanation="lambda-return bootstraps from the value two states ahead",
        provenance="navix until commit 76a5a0b",
        violates=("RET-1",),
        fix="Reward and value carry the same index, t + 1.",
        edits={"returns.lambda_return": {"value[:, t + 1]": "value[:, min(t + 2, horizon)]"}},
    ),
    Mutant(
        name="return_without_discount",
        explanation="lambda-return is not discounted",
        provenance="NaturalDreamer, which drops the discount where it has a continue head",
        violates=("RET-1", "RET-4"),
        fix="Multiply by the discount, 1 - 1/333, unless the continue head has learnt it.",
        edits={"returns.lambda_return": {"discount * continue_": "1.0 * continue_"}},
    ),
    Mutant(
        name="return_without_continue",
        explanation="lambda-return ignores the continue predictions",
        provenance="TorchRL until issue 4074",
        violates=("RET-1",),
        fix="Multiply by the predicted probability that the episode goes on.",
        edits={"returns.lambda_return": {"discount * continue_[:, t + 1] * future": "discount * future"}},
    ),
    Mutant(
        name="return_with_lambda_swapped",
        explanation="lambda weights the value and 1 - lambda the return",
        provenance="plausible",
        violates=("RET-1",),
        fix="(1 - lambda) value + lambda return.",
        edits={
            "returns.lambda_return": {
                "(1 - lambda_) * value[:, t + 1] + lambda_ * later": "lambda_ * value[:, t + 1] + (1 - lambda_) * later"
            }
        },
    ),
    Mutant(
        name="return_of_one_step",
        explanation="the return is one reward and the value of the next state",
        provenance="plausible: temporal-difference learning, lambda = 0",
        violates=("RET-1", "RET-5"),
        fix="Mix in the later returns with lambda = 0.95.",
        edits={"returns.lambda_return": {"(1 - lambda_) * value[:, t + 1] + lambda_ * later": "value[:, t + 1]"}},
    ),
    Mutant(
        name="return_starts_from_zero",
        explanation="lambda-return ends with 0 in place of the value of the last state",
        provenance="plausible: the return of a finished episode",
        violates=("RET-1",),
        fix="Start the recursion from the value of the last state.",
        edits={"returns.lambda_return": {"later = value[:, horizon]": "later = np.zeros(len(reward))"}},
    ),
    Mutant(
        name="weights_without_the_root",
        explanation="the weights leave out the continue of the start state: even a terminal state trains the actor",
        provenance="TorchRL until issue 4128",
        violates=("RET-7",),
        fix="Multiply the weights by the continue of the start state.",
        edits={
            "returns.cumulative_weights": {
                "product = product * (discount * continue_[:, t])": (
                    "product = product * (discount * (continue_[:, t] if t else 1.0))"
                )
            }
        },
    ),
    Mutant(
        name="weights_one_step_late",
        explanation="each weight leaves out the state's own continue, so that terminal states train the actor",
        provenance="NM512/dreamerv3-torch; DI-engine 0.5.3",
        violates=("RET-7",),
        fix="Multiply before reading: the weight of state t has the continues of states 0 to t.",
        edits={
            "returns.cumulative_weights": {
                "product = product * (discount * continue_[:, t])\n        weights[:, t] = product / discount": (
                    "weights[:, t] = product\n        product = product * (discount * continue_[:, t])"
                )
            }
        },
    ),
    Mutant(
        name="weights_discount_the_start",
        explanation="the weights carry one discount too many",
        provenance="r2dreamer (D-09)",
        violates=("RET-7",),
        fix="Divide the product by the discount once.",
        edits={"returns.cumulative_weights": {"product / discount": "product"}},
    ),
    Mutant(
        name="truncation_is_termination",
        explanation="a time limit in replay cuts the value that follows",
        provenance="lucidrains/dreamer4 (issue 22); NaturalDreamer and DI-engine store both ends in one flag",
        violates=("RET-9", "CON-11"),
        fix="Cut at is_terminal; at another is_last go on with the annotation.",
        edits={"returns.replay_lambda_return": {"(1 - is_terminal[:, t + 1])": "(1 - is_last[:, t + 1])"}},
    ),
    Mutant(
        name="return_crosses_episodes",
        explanation="replayed returns run on across the end of an episode",
        provenance="NaturalDreamer samples across episode ends",
        violates=("RET-9", "RET-10"),
        fix="Where the next step is_last, use its annotation alone.",
        edits={
            "returns.replay_lambda_return": {
                "mix = lambda_ * (1 - is_last[:, t + 1])": "mix = lambda_ * (1 - is_terminal[:, t + 1])"
            }
        },
    ),
    Mutant(
        name="replayed_return_of_the_step_before",
        explanation="replayed returns use the reward of the step that is left",
        provenance="plausible: two conventions of what a value contains in one loss (D-04)",
        violates=("RET-9", "CON-13"),
        fix="Use the reward of step t + 1.",
        edits={"returns.replay_lambda_return": {"later = reward[:, t + 1]": "later = reward[:, t]"}},
    ),
    Mutant(
        name="percentile_without_interpolation",
        explanation="a percentile is the next lower value",
        provenance="plausible",
        violates=("RET-12",),
        fix="Interpolate between the two nearest values.",
        edits={"returns.percentile": {"if fraction == 0:": "if True:"}},
    ),
    Mutant(
        name="return_range_not_smoothed",
        explanation="the return range is that of this batch",
        provenance="a table of the paper leaves the average out (D-124)",
        violates=("RET-14",),
        fix="Average the percentiles with a decay of 0.99.",
        edits={"returns.update_return_range": {"decay = config.return_decay": "decay = 0.0"}},
    ),
    Mutant(
        name="return_range_decay_swapped",
        explanation="the return range moves by its decay in place of 1 - decay",
        provenance="plausible: the rate 0.01 of one code base as the decay of another",
        violates=("RET-14",),
        fix="decay old + (1 - decay) new, with the decay 0.99.",
        edits={"returns.update_return_range": {"decay = config.return_decay": "decay = 1 - config.return_decay"}},
    ),
    Mutant(
        name="return_range_of_extremes",
        explanation=(
            "the return range is that between the smallest and the largest return, so that "
            "one outlier shrinks all advantages"
        ),
        provenance="plausible: minimum and maximum in place of percentiles",
        violates=("RET-14",),
        fix="Take the 5th and the 95th percentile.",
        edits={
            "returns.update_return_range": {
                "percentile(returns, config.return_percentile_low)": "percentile(returns, 0.0)",
                "percentile(returns, config.return_percentile_high)": "percentile(returns, 100.0)",
            }
        },
    ),
    Mutant(
        name="return_scale_without_limit",
        explanation="small return ranges are scaled up to 1",
        provenance="a table of the paper leaves the limit out (D-124)",
        violates=("RET-16",),
        fix="Divide by the range, but by no less than 1.",
        edits={"returns.return_scale": {"np.maximum(limit, ": "np.maximum(1e-8, "}},
    ),
)
