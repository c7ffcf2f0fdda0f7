"""Mistakes in spec/08-behavior.md."""

from conformance.mutants.catalogue import Mutant

_ACTOR = "-stop_gradient(weight) * (advantage * log_prob + config.entropy_scale * entropy)"

MUTANTS = (
    Mutant(
        name="action_is_the_mode",
        explanation="actions are the mean or the most likely class in place of a sample",
        provenance="evaluation in NM512/dreamerv3-torch and r2dreamer (D-70)",
        violates=("BEH-8", "AGT-12"),
        fix="Sample, in training and in evaluation.",
        edits={
            "behavior.sample_action": {
                "normal_sample(mean, std, own)": "normal_sample(mean, std, 0.0 * own)",
                "categorical_sample(log_probs, own[..., entry])": (
                    "np.eye(log_probs.shape[-1])[np.argmax(log_probs, axis=-1)]"
                ),
            }
        },
    ),
    Mutant(
        name="no_unimix_in_the_actor",
        explanation="discrete policies have no uniform mixture, so that an action can die out",
        provenance="danijar/dreamerv3 since December 2024: configured and not passed on (issue 219, D-22)",
        violates=("BEH-2", "DIS-7"),
        fix="Mix 1 % of the uniform distribution into every discrete policy.",
        edits={"behavior._categoricals": {"config.actor_unimix": "0.0"}},
    ),
    Mutant(
        name="log_prob_averaged",
        explanation="the log-probability of a continuous action is the mean over its dimensions",
        provenance="plausible; NM512/dreamerv3-torch left a log-probability unsummed (commit 78e8670)",
        violates=("BEH-6",),
        fix="Sum over the dimensions.",
        edits={
            "behavior.action_log_prob": {
                "np.sum(normal_log_prob(mean, std, own), axis=-1)": "np.mean(normal_log_prob(mean, std, own), axis=-1)"
            }
        },
    ),
    Mutant(
        name="entropy_averaged",
        explanation="the entropy of a continuous policy is the mean over its dimensions",
        provenance="plausible",
        violates=("BEH-7",),
        fix="Sum over the dimensions.",
        edits={
            "behavior.action_entropy": {"np.sum(normal_entropy(std), axis=-1)": "np.mean(normal_entropy(std), axis=-1)"}
        },
    ),
    Mutant(
        name="entropy_minimized",
        explanation="the entropy is minimized",
        provenance="the paper's printed sign (D-60); danijar/dreamerv3 had it once (issue 69)",
        violates=("BEH-9",),
        fix="Subtract the entropy from the loss.",
        edits={"behavior.actor_loss": {"+ config.entropy_scale * entropy": "- config.entropy_scale * entropy"}},
    ),
    Mutant(
        name="entropy_not_weighted",
        explanation="the entropy counts fully at states after a predicted end",
        provenance="plausible",
        violates=("BEH-9",),
        fix="Weight score and entropy alike.",
        edits={
            "behavior.actor_loss": {
                _ACTOR: "-(stop_gradient(weight) * advantage * log_prob + config.entropy_scale * entropy)"
            }
        },
    ),
    Mutant(
        name="entropy_divided_by_the_scale",
        explanation="the entropy is divided by the return scale",
        provenance="plausible",
        violates=("BEH-9",),
        fix="Divide the advantage alone.",
        edits={"behavior.actor_loss": {"config.entropy_scale * entropy": "config.entropy_scale * entropy / scale"}},
    ),
    Mutant(
        name="advantage_not_normalized",
        explanation="the advantage is not divided by the return scale",
        provenance="NM512/dreamerv3-torch with reinforce (issue 64); TorchRL in its default mode (issue 4125)",
        violates=("BEH-9",),
        fix="Divide the advantage by the return scale.",
        edits={"behavior.actor_loss": {"(returns - value) / scale": "returns - value"}},
    ),
    Mutant(
        name="only_returns_normalized",
        explanation="the return is divided by the scale, and the value that is subtracted is not",
        provenance="plausible",
        violates=("BEH-9",),
        fix="Divide the difference.",
        edits={"behavior.actor_loss": {"(returns - value) / scale": "returns / scale - value"}},
    ),
    Mutant(
        name="advantage_standardized",
        explanation="advantages are divided by their standard deviation, and their mean is subtracted",
        provenance="plausible: the normalization of PPO",
        violates=("BEH-9",),
        fix="Divide the difference of return and value by the return scale.",
        edits={
            "behavior.actor_loss": {
                "advantage = stop_gradient((returns - value) / scale)": (
                    "difference = returns - value\n"
                    "    advantage = stop_gradient((difference - difference.mean()) / "
                    "(difference.std() + 1e-8) + 0.0 * scale)"
                )
            }
        },
    ),
    Mutant(
        name="no_baseline",
        explanation="the actor learns from the return in place of the advantage",
        provenance="plausible: the plain Reinforce estimator",
        violates=("BEH-9",),
        fix="Subtract the critic's value.",
        edits={"behavior.actor_loss": {"(returns - value) / scale": "returns / scale"}},
    ),
    Mutant(
        name="actor_loss_not_weighted",
        explanation="the actor learns fully at states after a predicted end",
        provenance="the paper does not mention the weights (D-09); NaturalDreamer",
        violates=("BEH-9",),
        fix="Multiply by the cumulative continue probability.",
        edits={"behavior.actor_loss": {"-stop_gradient(weight) *": "-stop_gradient(np.ones_like(weight)) *"}},
    ),
    Mutant(
        name="critic_loss_not_weighted",
        explanation="the critic learns fully at states after a predicted end",
        provenance="the paper does not mention the weights (D-09); NaturalDreamer",
        violates=("BEH-12",),
        fix="Multiply by the cumulative continue probability.",
        edits={"behavior.critic_loss": {"stop_gradient(weight) *": "stop_gradient(np.ones_like(weight)) *"}},
    ),
    Mutant(
        name="no_slow_critic",
        explanation="the critic is not held near its slow copy",
        provenance="NaturalDreamer has none",
        violates=("BEH-12",),
        fix="Add the cross entropy towards the slow critic's mean.",
        edits={
            "behavior._regularized_value_loss": {
                "towards_return + config.slow_critic_scale * towards_slow": "towards_return + 0.0 * towards_slow"
            }
        },
    ),
    Mutant(
        name="critic_follows_the_slow_distribution",
        explanation="the critic is held near the slow critic's distribution in place of its mean",
        provenance="plausible: what the paper's sentence also allows (D-51)",
        violates=("BEH-12",),
        fix="Encode the slow critic's mean as two-hot, and take that as the target.",
        edits={
            "behavior._regularized_value_loss": {
                "towards_slow = symexp_twohot_loss(logits, slow_mean, bins)": (
                    "slow = np.exp(unimix_log_probs(slow_logits, 0.0))\n"
                    "    towards_slow = -np.sum(stop_gradient(slow) * unimix_log_probs(logits, "
                    "0.0), axis=-1) + 0.0 * slow_mean"
                )
            }
        },
    ),
    Mutant(
        name="slow_target_follows_the_critic",
        explanation="the critic is held near its own mean, which moves with it",
        provenance="plausible: no second set of parameters, and no stop-gradient",
        violates=("BEH-12", "BEH-13"),
        fix="Take the mean of the slow critic, as a constant.",
        edits={
            "behavior._regularized_value_loss": {
                (
                    "slow_mean = stop_gradient(symexp_twohot_mean(slow_logits, bins))"
                ): "slow_mean = symexp_twohot_mean(logits, bins)"
            }
        },
    ),
    Mutant(
        name="replayed_ends_learn_values",
        explanation="the last step of a replayed episode learns the value of a return that belongs to the next",
        provenance="plausible; the paper mentions no mask (D-55)",
        violates=("BEH-14",),
        fix="Multiply by 1 - is_last.",
        edits={"behavior.replay_critic_loss": {"(1 - is_last) *": "np.ones_like(is_last) *"}},
    ),
    Mutant(
        name="slow_critic_decay_swapped",
        explanation="the slow critic moves by its decay in place of 1 - decay",
        provenance="plausible: the rate 0.02 of one code base as the decay of another",
        violates=("BEH-19",),
        fix="0.98 slow + 0.02 critic.",
        edits={"behavior.update_slow_critic": {"decay * old + (1 - decay) * new": "(1 - decay) * old + decay * new"}},
    ),
    Mutant(
        name="slow_critic_is_the_critic",
        explanation="the slow critic is a copy of the critic in every step",
        provenance="plausible",
        violates=("BEH-19",),
        fix="0.98 slow + 0.02 critic.",
        edits={"behavior.update_slow_critic": {"decay * old + (1 - decay) * new": "0.0 * old + new"}},
    ),
)
