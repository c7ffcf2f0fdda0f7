"""Mistakes in spec/10-agent.md."""

from conformance.mutants.catalogue import Mutant

_VALUE = "value = stop_gradient(symexp_twohot_mean(networks.critic(params, features, config), bins))"
_POLICY = "observe_step(params, carry, tokens, prev_action, is_first, noise["

MUTANTS = (
    Mutant(
        name="fan_in_of_one_block",
        explanation="block-linear layers start too wide: their fan-in is counted within a block",
        provenance="TorchRL until issue 4128 (D-29)",
        violates=("AGT-5", "LAY-10"),
        fix="Count the inputs of all blocks.",
        edits={
            "agent.initial_parameters": {
                "entry.fan_in, entry.outscale": (
                    "entry.shape[1] if len(entry.shape) == 3 else entry.fan_in, entry.outscale"
                )
            }
        },
    ),
    Mutant(
        name="fan_average",
        explanation="initial weights are scaled by the mean of fan-in and fan-out",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl (D-77)",
        violates=("AGT-5", "LAY-10"),
        fix="Scale by the fan-in.",
        edits={
            "agent.initial_parameters": {
                "entry.fan_in, entry.outscale": "(entry.fan_in + entry.shape[-1]) // 2, entry.outscale"
            }
        },
    ),
    Mutant(
        name="reward_and_value_start_random",
        explanation=(
            "reward head and critic do not start at zero, so that first predictions are as large as the outermost bins"
        ),
        provenance="navix; sheeprl until issue 130",
        violates=("AGT-6", "NET-20"),
        fix="Start the output kernels of reward head and critic at zero.",
        edits={"agent.initial_parameters": {"entry.outscale)": "entry.outscale or 1.0)"}},
    ),
    Mutant(
        name="actor_starts_sharp",
        explanation="the actor's output starts at full scale, so that the first policy is far from uniform",
        provenance="2023 edition (D-69)",
        violates=("AGT-6",),
        fix="Start the actor's output kernels with an outscale of 0.01.",
        edits={
            "agent.initial_parameters": {"entry.outscale)": 'max(entry.outscale, float(name.startswith("actor/"))))'}
        },
    ),
    Mutant(
        name="slow_critic_starts_at_zero",
        explanation="the slow critic starts at zeros in place of a copy of the critic",
        provenance="plausible; no difference while the critic predicts 0",
        violates=("AGT-7", "BEH-21"),
        fix="Copy the critic's initial parameters.",
        edits={"agent.initial_state": {"value.copy() for": "np.zeros_like(value) for"}},
    ),
    Mutant(
        name="policy_ignores_observations",
        explanation="the policy acts without seeing the observation",
        provenance="TorchRL's collector until issue 4119",
        violates=("AGT-11",),
        fix="Give the encoder's tokens to the posterior when acting.",
        edits={"agent.policy_step": {"tokens = networks.encoder(": "tokens = 0.0 * networks.encoder("}},
    ),
    Mutant(
        name="policy_ignores_resets",
        explanation="acting carries the memory of one episode into the next",
        provenance="navix; NM512/dreamerv3-torch reset the wrong environments until commit 43e1b2a",
        violates=("AGT-13", "RSSM-13"),
        fix="Pass is_first when acting, for each environment its own.",
        edits={"agent.policy_step": {_POLICY: _POLICY.replace("is_first", "np.zeros_like(is_first)")}},
    ),
    Mutant(
        name="policy_without_previous_action",
        explanation="acting leaves out the previous action",
        provenance="plausible; danijar/dreamerv3 gave a wrong one at the start of sequences until commit 29eb964",
        violates=("AGT-11", "CON-12"),
        fix="Give the policy step the action that it chose before.",
        edits={"agent.policy_step": {_POLICY: _POLICY.replace("prev_action", "np.zeros_like(prev_action)")}},
    ),
    Mutant(
        name="sequences_start_from_zeros",
        explanation="every sequence starts from zeros in place of the stored latents",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl (D-85)",
        violates=("AGT-14",),
        fix="Start from the latents that are stored with the context step.",
        edits={
            "agent.losses": {
                'stop_gradient(batch["deter"])': 'stop_gradient(np.zeros(np.shape(batch["deter"])))',
                "stop_gradient(context)": "stop_gradient(0.0 * context)",
            }
        },
    ),
    Mutant(
        name="imagination_starts_at_the_last_step",
        explanation="every imagined trajectory starts at the last step of its sequence",
        provenance="plausible",
        violates=("AGT-17",),
        fix="Start one trajectory at every step.",
        edits={
            "agent.losses": {
                'stop_gradient(states["deter"]).reshape(': (
                    'stop_gradient(np.repeat(states["deter"][:, -1:], length, axis=1)).reshape('
                ),
                'stop_gradient(states["stoch"]).reshape(': (
                    'stop_gradient(np.repeat(states["stoch"][:, -1:], length, axis=1)).reshape('
                ),
            }
        },
    ),
    Mutant(
        name="bootstrap_from_the_slow_critic",
        explanation="returns bootstrap from the slow critic, which is the baseline, too",
        provenance="the habit of DreamerV1 and V2 (D-53)",
        violates=("BEH-16", "RET-3"),
        fix="Use the live critic; the slow one only regularizes.",
        edits={"agent.losses": {_VALUE: _VALUE.replace("params", "slow_critic")}},
    ),
    Mutant(
        name="continue_predicted_at_the_start",
        explanation="the weight of an imagined trajectory starts with a prediction in place of the flag that is known",
        provenance="danijar/dreamerv3 since December 2024, and right in the official profile (D-08)",
        violates=("RET-6", "AGT-20"),
        fix="Use 1 - is_terminal of the start state.",
        edits={"agent.losses": {'if config.start_continue == "true":': "if False:"}},
    ),
    Mutant(
        name="starts_in_the_order_of_time",
        explanation="the flags of the start states are flattened time first, and their states row first",
        provenance="plausible: [T, B] in one place and [B, T] in another",
        violates=("CON-2", "AGT-20"),
        fix="Flatten everything as [B, T].",
        edits={"agent.losses": {"config).reshape(starts, 1)": "config).T.reshape(starts, 1)"}},
    ),
    Mutant(
        name="noise_repeats_in_imagination",
        explanation="every imagined step draws its action with the same random numbers",
        provenance="plausible: a random key that is not split",
        violates=("CON-20", "CON-21"),
        fix="Use numbers of its own for every step.",
        edits={"agent.losses": {'np.asarray(noise["action"])[:, t]': 'np.asarray(noise["action"])[:, 0]'}},
    ),
    Mutant(
        name="return_range_one_step_late",
        explanation="advantages are scaled by the return range of the step before",
        provenance="plausible",
        violates=("AGT-22", "RET-15"),
        fix="Update the range first.",
        edits={
            "agent.losses": {
                "return_scale(low, high, config.return_limit)": "return_scale(*return_range, config.return_limit)"
            }
        },
    ),
    Mutant(
        name="actor_scored_at_the_outcome",
        explanation="the actor's probability of an action is taken at the state that it led to",
        provenance="navix until commit fd54961",
        violates=("BEH-11", "AGT-23"),
        fix="Score the action at the state where it was chosen.",
        edits={
            "agent.losses": {
                "networks.actor(params, acting, spaces, config)": (
                    "networks.actor(params, features[:, 1:], spaces, config)"
                )
            }
        },
    ),
    Mutant(
        name="baseline_one_step_late",
        explanation="the advantage subtracts the value of the next state",
        provenance="navix until commit fd54961",
        violates=("BEH-11", "AGT-23"),
        fix="Subtract the value of the state where the action was chosen.",
        edits={"agent.losses": {"returns, value[:, :-1], weight": "returns, value[:, 1:], weight"}},
    ),
    Mutant(
        name="critic_learns_scaled_returns",
        explanation="the critic learns returns that are divided by the return scale",
        provenance="naivoder's implementation",
        violates=("AGT-24",),
        fix="Divide the advantages of the actor alone.",
        edits={
            "agent.losses": {"slow_logits, returns, weight, config)": "slow_logits, returns / scale, weight, config)"}
        },
    ),
    Mutant(
        name="replayed_return_from_the_critic",
        explanation="replayed returns bootstrap from the critic in place of the imagined returns",
        provenance="an option of the edition of April 2024 (D-54)",
        violates=("RET-11", "AGT-25"),
        fix="Annotate each step with its imagined return.",
        edits={"agent.losses": {"annotation = returns[:, 0]": "annotation = value[:, 0]"}},
    ),
    Mutant(
        name="replay_mask_of_the_next_step",
        explanation="the step before the end of an episode learns no value, and the end does",
        provenance="plausible",
        violates=("BEH-14", "AGT-25"),
        fix="Mask with is_last of the step itself.",
        edits={"agent.losses": {'np.asarray(batch["is_last"])[:, :-1]': 'np.asarray(batch["is_last"])[:, 1:]'}},
    ),
    Mutant(
        name="two_steps_teach_no_value",
        explanation="sequences of two steps have no replayed critic loss",
        provenance="plausible: off by one",
        violates=("AGT-25",),
        fix="T steps teach T - 1 values.",
        edits={"agent.losses": {"if length > 1:": "if length > 2:"}},
    ),
    Mutant(
        name="replay_mask_of_another_row",
        explanation="the ends of episodes are those of another sequence of the batch",
        provenance=(
            "plausible; NM512/dreamerv3-torch cut the batch in place of the time until commit 52782d3 (pull request 6)"
        ),
        violates=("BEH-14", "AGT-25"),
        fix="The axes are batch and time, in this order.",
        edits={
            "agent.losses": {'np.asarray(batch["is_last"])[:, :-1]': 'np.roll(batch["is_last"], 1, axis=0)[:, :-1]'}
        },
    ),
    Mutant(
        name="replay_critic_does_not_train_the_model",
        explanation="the gradient of the replayed critic loss ends at the critic",
        provenance="plausible: the paper does not say where it ends (D-32)",
        violates=("BEH-15", "AGT-28"),
        fix="Let the critic read replayed states with their gradient.",
        edits={
            "agent.losses": {
                "networks.critic(params, replayed, config)": "networks.critic(params, stop_gradient(replayed), config)"
            }
        },
    ),
    Mutant(
        name="slow_target_moves_the_model",
        explanation="the slow critic's prediction at replayed states passes a gradient into the model",
        provenance="plausible: parameters that are constants, inputs that are not",
        violates=("BEH-15", "AGT-28"),
        fix="Take the slow critic's mean as a constant.",
        edits={
            "behavior._regularized_value_loss": {
                (
                    "slow_mean = stop_gradient(symexp_twohot_mean(slow_logits, bins))"
                ): "slow_mean = symexp_twohot_mean(slow_logits, bins)"
            },
            "distributions.symexp_twohot_loss": {"stop_gradient(checked(": "(checked("},
            "agent.losses": {"stop_gradient(replayed)": "replayed"},
        },
    ),
    Mutant(
        name="replay_loss_averaged_over_unmasked_steps",
        explanation="the replayed critic loss is averaged over the steps that count",
        provenance="plausible: a masked mean (D-11)",
        violates=("AGT-26", "BEH-17"),
        fix="Average over all steps, masked ones included.",
        edits={
            "agent.losses": {
                "means = {name:": (
                    'counted = np.mean(~np.asarray(batch["is_last"], bool)[:, :-1]) if length > 1 else 1.0\n'
                    '    elements["replay_critic"] = elements["replay_critic"] / max(counted, 1e-8)\n'
                    "    means = {name:"
                )
            }
        },
    ),
    Mutant(
        name="losses_summed_over_time",
        explanation="losses are summed over time in place of averaged",
        provenance="the paper's printed sums (D-11); TorchRL until issue 4119",
        violates=("AGT-26",),
        fix="Average every loss over all of its elements.",
        edits={
            "agent.losses": {
                "float(np.mean(value)) if value.size": "float(np.mean(value) * value.shape[1]) if value.size"
            }
        },
    ),
    Mutant(
        name="dynamics_loss_weighted_by_half",
        explanation="the dynamics loss counts 0.5 in place of 1",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl (D-131)",
        violates=("AGT-26",),
        fix="Weight the dynamics loss with 1 and the representation loss with 0.1.",
        edits={"agent._loss_scale": {"return float(": 'return (0.5 if name == "dynamics" else 1.0) * float('}},
    ),
    Mutant(
        name="no_replay_critic",
        explanation="the critic learns from imagination alone",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl (D-131)",
        violates=("AGT-26",),
        fix="Add the replayed critic loss with the weight 0.3.",
        edits={"agent._loss_scale": {"return float(": 'return 0.0 if name == "replay_critic" else float('}},
    ),
    Mutant(
        name="representation_loss_weighted_fully",
        explanation="the representation loss counts 1 in place of 0.1",
        provenance="plausible; TorchRL had one KL for both sides until issue 4073",
        violates=("AGT-26",),
        fix="Weight the dynamics loss with 1 and the representation loss with 0.1.",
        edits={"agent._loss_scale": {"return float(": 'return 1.0 if name == "representation" else float('}},
    ),
    Mutant(
        name="slow_critic_updated_before_the_step",
        explanation="the slow critic follows the parameters before the step",
        provenance="r2dreamer, NM512/dreamerv3-torch and sheeprl (D-52)",
        violates=("BEH-21", "AGT-29"),
        fix="Update the slow critic after the optimizer step, from the new parameters.",
        edits={"agent.train_step": {"params, config.slow_critic_decay)": 'state["params"], config.slow_critic_decay)'}},
    ),
    Mutant(
        name="slow_critic_updated_too_rarely",
        explanation="the slow critic moves in every 32nd step only",
        provenance="navix: once in an outer cycle",
        violates=("BEH-21", "AGT-29"),
        fix="Update the slow critic in every train step.",
        edits={
            "agent.train_step": {
                "params, config.slow_critic_decay)": (
                    'params, 1.0 if optimizer["step"] % 32 else config.slow_critic_decay)'
                )
            }
        },
    ),
    Mutant(
        name="return_range_forgotten",
        explanation="the new training state keeps the old return range",
        provenance="plausible",
        violates=("AGT-29",),
        fix="Store the updated range.",
        edits={"agent.train_step": {'low, high = aux["return_range"]': "low, high = before"}},
    ),
)
