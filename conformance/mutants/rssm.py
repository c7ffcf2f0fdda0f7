"""Mistakes in spec/04-rssm.md."""

from conformance.mutants.catalogue import Mutant

MUTANTS = (
    Mutant(
        name="latents_flattened_by_class",
        explanation="the core flattens the latents with the classes outside and the latents inside",
        provenance="plausible",
        violates=("RSSM-1", "CON-3"),
        fix="Flatten [S, C] row by row: class c of latent s is entry s C + c.",
        edits={"rssm.core": {"flat_stoch = stoch.reshape(": "flat_stoch = np.swapaxes(stoch, -1, -2).reshape("}},
    ),
    Mutant(
        name="actions_enter_unbounded",
        explanation="the core reads actions beyond [-1, 1] as they are",
        provenance="plausible: the paper does not mention the bound (D-26)",
        violates=("RSSM-2",),
        fix="Divide each number by max(1, |a|).",
        edits={
            "rssm.core": {"action = action / stop_gradient(np.maximum(1.0, np.abs(action)))": "stop_gradient(action)"}
        },
    ),
    Mutant(
        name="norm_within_each_block",
        explanation="the hidden layer of the core is normalized within each block",
        provenance="plausible; an option of danijar/dreamerv3 that is off (D-29)",
        violates=("RSSM-5",),
        fix="Normalize over all outputs together.",
        edits={
            "rssm.core": {
                'x = silu(rms_norm(x, params["rssm/hidden/scale"], config.norm_epsilon))': (
                    "parts = x.reshape(*rows, blocks, -1)\n"
                    "    parts = rms_norm(parts, np.ones(parts.shape[-1]), config.norm_epsilon)\n"
                    '    x = silu(parts.reshape(x.shape) * params["rssm/hidden/scale"])'
                )
            }
        },
    ),
    Mutant(
        name="gates_split_across_blocks",
        explanation="the gates are the three thirds of the whole layer in place of thirds of each block",
        provenance="plausible: the split of an ordinary GRU (D-27)",
        violates=("RSSM-6",),
        fix="Split the outputs of each block into reset, candidate and update.",
        edits={
            "rssm.core": {
                "gates.reshape(*rows, blocks, 3, config.deter // blocks)": "gates.reshape(*rows, 3, config.deter)",
                "gates[..., part, :].reshape(*rows, config.deter)": "gates[..., part, :]",
            }
        },
    ),
    Mutant(
        name="gates_in_the_order_of_pytorch",
        explanation="the gates are read in the order reset, update, candidate",
        provenance="plausible: the order of PyTorch's GRU",
        violates=("RSSM-6",),
        fix="Read reset, candidate, update.",
        edits={"rssm.core": {"reset, candidate, update = (": "reset, update, candidate = ("}},
    ),
    Mutant(
        name="update_gate_without_bias",
        explanation=(
            "the update gate lacks the - 1 before its sigmoid, so that a fresh memory forgets half in each step"
        ),
        provenance="plausible: an ordinary GRU (D-27)",
        violates=("RSSM-7",),
        fix="Subtract 1 before the sigmoid of the update gate.",
        edits={"rssm.core": {"sigmoid(update - 1.0)": "sigmoid(update)"}},
    ),
    Mutant(
        name="update_gate_keeps_the_old_memory",
        explanation="the update gate weights the old memory in place of the candidate",
        provenance="plausible: PyTorch's GRU",
        violates=("RSSM-7",),
        fix="h' = u c + (1 - u) h.",
        edits={
            "rssm.core": {"update * candidate + (1.0 - update) * deter": "(1.0 - update) * candidate + update * deter"}
        },
    ),
    Mutant(
        name="candidate_without_reset",
        explanation="the reset gate is not applied to the candidate",
        provenance="plausible",
        violates=("RSSM-7",),
        fix="Multiply the whole candidate by the sigmoid of the reset gate before tanh.",
        edits={"rssm.core": {"np.tanh(sigmoid(reset) * candidate)": "np.tanh(candidate)"}},
    ),
    Mutant(
        name="posterior_reads_tokens_first",
        explanation="the posterior concatenates tokens and memory in this order",
        provenance="plausible",
        violates=("RSSM-9",),
        fix="Concatenate memory and tokens.",
        edits={"rssm.posterior": {"[deter, tokens]": "[tokens, deter]"}},
    ),
    Mutant(
        name="posterior_ignores_the_memory",
        explanation="the posterior sees the observation alone",
        provenance="plausible; an option of danijar/dreamerv3 that is off (D-132)",
        violates=("RSSM-9",),
        fix="Give the posterior memory and tokens.",
        edits={"rssm.posterior": {"[deter, tokens]": "[0.0 * deter, tokens]"}},
    ),
    Mutant(
        name="resets_ignored",
        explanation="the memory runs on across the starts of episodes",
        provenance=(
            "NM512/dreamerv3-torch until commit 308eeff (pull request 14); navix and "
            "TorchRL until compared with a reference"
        ),
        violates=("RSSM-13",),
        fix="Where is_first, replace memory, latents and previous action by zeros before the core.",
        edits={
            "rssm.observe_step": {
                "is_first = np.asarray(is_first, dtype=bool)": "is_first = np.zeros(np.shape(is_first), dtype=bool)"
            }
        },
    ),
    Mutant(
        name="reset_keeps_the_action",
        explanation="a reset clears the memory, and the last action of the episode before enters the new one",
        provenance="TorchRL between issues 4119 and 4128",
        violates=("RSSM-13",),
        fix="Replace the previous action by zeros, too.",
        edits={"rssm.observe_step": {"    prev_action = np.where(is_first[:, None], 0.0, prev_action)\n": ""}},
    ),
    Mutant(
        name="reset_keeps_the_latents",
        explanation="a reset clears the memory and keeps the latents of the episode before",
        provenance="plausible; sheeprl started the posterior inconsistently until issue 225",
        violates=("RSSM-13",),
        fix="Replace memory, latents and previous action by zeros.",
        edits={"rssm.observe_step": {"    stoch = np.where(is_first[:, None, None], 0.0, stoch)\n": ""}},
    ),
    Mutant(
        name="reset_to_the_first_class",
        explanation="a reset sets each latent to its first class in place of zeros",
        provenance="plausible: the one-hot of index 0",
        violates=("RSSM-13",),
        fix="A latent before the first step is all zeros.",
        edits={
            "rssm.observe_step": {
                "np.where(is_first[:, None, None], 0.0, stoch)": (
                    "np.where(is_first[:, None, None], np.eye(config.classes)[0], stoch)"
                )
            }
        },
    ),
    Mutant(
        name="reset_by_multiplication",
        explanation="a reset multiplies by 0, which leaves a NaN of the episode before where it was",
        provenance="the usual mask, for instance in danijar/dreamerv3",
        violates=("RSSM-14",),
        fix="Select zeros in place of multiplying by 0.",
        edits={
            "rssm.observe_step": {
                "np.where(is_first[:, None], 0.0, deter)": "deter * ~is_first[:, None]",
                "np.where(is_first[:, None, None], 0.0, stoch)": "stoch * ~is_first[:, None, None]",
                "np.where(is_first[:, None], 0.0, prev_action)": "prev_action * ~is_first[:, None]",
            }
        },
    ),
    Mutant(
        name="reset_one_step_early",
        explanation="the memory is cleared one step before the first observation of an episode",
        provenance="navix, whose environment deferred its reset",
        violates=("RSSM-13", "RSSM-17"),
        fix="Use the flag of the step that enters.",
        edits={"rssm.observe": {"is_first[:, t]": "is_first[:, min(t + 1, steps - 1)]"}},
    ),
    Mutant(
        name="actions_not_shifted",
        explanation="observing pairs each observation with the action that was taken at it",
        provenance="DI-engine, navix and RLlib's Dreamer (issue 31009)",
        violates=("RSSM-18", "CON-12"),
        fix="Pair observation t with the action of record t - 1.",
        edits={"rssm.observe": {"prev_action[:, t]": "prev_action[:, min(t + 1, steps - 1)]"}},
    ),
    Mutant(
        name="state_never_advances",
        explanation="every step of a sequence starts from the state before the first one",
        provenance="TorchRL's rollout until issue 3236",
        violates=("RSSM-17",),
        fix="Carry the state from step to step.",
        edits={
            "rssm.observe": {
                "state, logits = observe_step(": "after, logits = observe_step(",
                'state["deter"])\n': 'after["deter"])\n',
                'state["stoch"])\n': 'after["stoch"])\n',
            }
        },
    ),
    Mutant(
        name="no_gradient_through_time",
        explanation="gradients end at each step of a sequence",
        provenance="plausible: a detached state",
        violates=("RSSM-23",),
        fix="Let gradients flow through all steps, and cut them only at the stored state.",
        edits={
            "rssm.observe": {
                'outputs["deter"].append(state["deter"])': 'outputs["deter"].append(state["deter"])\n    '
                "    before = state\n"
                "        state = {name: stop_gradient(value) for name, value in state.items()}",
                'outputs["stoch"].append(state["stoch"])': 'outputs["stoch"].append(before["stoch"])',
            }
        },
    ),
    Mutant(
        name="imagined_latents_not_fed_back",
        explanation="every imagined step reads the latents of the start state",
        provenance="sheeprl's notebook until issue 272",
        violates=("RSSM-20",),
        fix="Feed the sampled latents into the next step.",
        edits={
            "rssm.imagine": {
                "core(params, deter, stoch, action, config)": "core(params, deter, stochs[0], action, config)"
            }
        },
    ),
    Mutant(
        name="prior_of_the_memory_before",
        explanation="imagined latents are drawn from the prior of the memory before the step",
        provenance="plausible",
        violates=("RSSM-20",),
        fix="Update the memory first, and take the prior of the new one.",
        edits={"rssm.imagine": {"prior(params, deter, config)": "prior(params, deters[-1], config)"}},
    ),
    Mutant(
        name="no_unimix_in_imagination",
        explanation="imagined latents are drawn without the uniform mixture",
        provenance="plausible",
        violates=("RSSM-10", "DIS-7"),
        fix="Mix wherever the logits become a distribution.",
        edits={"rssm.imagine": {"config.latent_unimix": "0.0"}},
    ),
)
