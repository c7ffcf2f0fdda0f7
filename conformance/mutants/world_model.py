"""Mistakes in spec/06-world-model.md."""

from conformance.mutants.catalogue import Mutant

_DYNAMICS = "categorical_kl(stop_gradient(posterior), prior).sum(axis=-1)"
_REPRESENTATION = "categorical_kl(posterior, stop_gradient(prior)).sum(axis=-1)"
_CLIPPED = "return np.maximum(config.free_nats, dynamics), np.maximum(config.free_nats, representation)"

MUTANTS = (
    Mutant(
        name="continue_target_discounted_twice",
        explanation="the continue head learns the discounted flag, and imagined returns discount again",
        provenance="half of the official profile in the paper's (D-06)",
        violates=("WM-7",),
        fix="Either learn the plain flag and discount the returns, or learn the discounted one and leave the returns.",
        edits={
            "world_model.continue_target": {
                (
                    'if config.continue_target == "discounted" else going_on'
                ): 'if config.continue_target == "hard" else going_on'
            }
        },
    ),
    Mutant(
        name="continue_trained_on_is_last",
        explanation="the continue head learns is_last, so that a time limit counts as an end",
        provenance="navix until commit fd54961, sheeprl until issue 252, DI-engine, NaturalDreamer",
        violates=("WM-7", "CON-11"),
        fix="Learn is_terminal: a time limit ends the episode, and not the return.",
        edits={
            "world_model.world_model_losses": {
                'continue_target(batch["is_terminal"], config)': 'continue_target(batch["is_last"], config)'
            }
        },
    ),
    Mutant(
        name="reward_of_the_step_before",
        explanation="the reward head learns at each state the reward of the state before",
        provenance="RLlib's Dreamer (issue 31009) and yusukeurakami's (issue 5)",
        violates=("WM-6", "CON-9"),
        fix="Learn the reward that arrived with the observation of the same step.",
        edits={
            "world_model.world_model_losses": {
                'reward_logits, batch["reward"]': 'reward_logits, np.roll(batch["reward"], 1, axis=1)'
            }
        },
    ),
    Mutant(
        name="reward_squashed",
        explanation="the reward head learns tanh of the reward",
        provenance="DreamerV2 on Atari (D-71)",
        violates=("WM-6",),
        fix="Learn the raw reward: the two-hot loss copes with any scale.",
        edits={
            "world_model.world_model_losses": {
                'reward_logits, batch["reward"]': 'reward_logits, np.tanh(batch["reward"])'
            }
        },
    ),
    Mutant(
        name="reward_by_squared_error",
        explanation="the reward is learnt by the squared error in symlog space",
        provenance="a sentence of the paper that is left from its first version (D-13)",
        violates=("WM-6",),
        fix="Use the symexp-twohot loss.",
        edits={
            "world_model.world_model_losses": {
                'symexp_twohot_loss(reward_logits, batch["reward"], exponential_bins(config.bins))': (
                    "symlog_mse_loss(np.arcsinh(symexp_twohot_mean(reward_logits, exponential_bins(config.bins)) / 2), "
                    'batch["reward"], config.vector_loss_scale)'
                )
            }
        },
    ),
    Mutant(
        name="reward_does_not_train_the_model",
        explanation="the gradient of the reward loss ends at the reward head",
        provenance="plausible: an ablation of the paper (D-32)",
        violates=("WM-1", "AGT-28"),
        fix="Let the reward head read the state with its gradient.",
        edits={
            "world_model.world_model_losses": {
                "networks.reward_head(params, feature, config)": (
                    "networks.reward_head(params, stop_gradient(feature), config)"
                )
            }
        },
    ),
    Mutant(
        name="reconstruction_does_not_train_the_model",
        explanation="the gradient of the reconstruction losses ends at the decoder",
        provenance="plausible: an ablation of the paper (D-32)",
        violates=("WM-1", "AGT-28"),
        fix="Let the decoder read the state with its gradient.",
        edits={
            "world_model.world_model_losses": {
                "networks.decoder(params, feature, spaces, config)": (
                    "networks.decoder(params, stop_gradient(feature), spaces, config)"
                )
            }
        },
    ),
    Mutant(
        name="vector_loss_averaged",
        explanation="the loss of a vector is the mean over its entries",
        provenance="plausible: a library's default reduction",
        violates=("WM-2",),
        fix="Sum over the entries.",
        edits={
            "world_model.reconstruction_losses": {
                "config.vector_loss_scale).sum(axis=-1)": "config.vector_loss_scale).mean(axis=-1)"
            }
        },
    ),
    Mutant(
        name="image_loss_averaged",
        explanation="the loss of an image is the mean over its pixels",
        provenance="plausible: a library's default reduction",
        violates=("WM-4",),
        fix="Sum over height, width and channels.",
        edits={"world_model.reconstruction_losses": {".sum(axis=(-3, -2, -1))": ".mean(axis=(-3, -2, -1))"}},
    ),
    Mutant(
        name="image_target_with_offset",
        explanation="the decoder's images are compared with the image minus 1/2",
        provenance="NM512/dreamerv3-torch and sheeprl, when the offset was on one side only",
        violates=("WM-4",),
        fix="Compare with the image divided by 255.",
        edits={
            "world_model.reconstruction_losses": {
                "target = scaled_image(observations[key])": "target = scaled_image(observations[key]) - 0.5"
            }
        },
    ),
    Mutant(
        name="kl_reversed",
        explanation="the KL runs from prior to posterior",
        provenance="plausible: the arguments of a library in the other order",
        violates=("WM-10",),
        fix="The posterior comes first: KL(posterior, prior), in both losses.",
        edits={
            "world_model.kl_losses": {
                _DYNAMICS: "categorical_kl(prior, stop_gradient(posterior)).sum(axis=-1)",
                _REPRESENTATION: "categorical_kl(stop_gradient(prior), posterior).sum(axis=-1)",
            }
        },
    ),
    Mutant(
        name="kl_without_unimix",
        explanation="the KL compares the plain softmax, without the uniform mixture",
        provenance="plausible",
        violates=("WM-10", "DIS-7"),
        fix="Compare the mixtures that are sampled from.",
        edits={
            "world_model.kl_losses": {
                "unimix_log_probs(posterior_logits, config.latent_unimix)": "unimix_log_probs(posterior_logits, 0.0)",
                "unimix_log_probs(prior_logits, config.latent_unimix)": "unimix_log_probs(prior_logits, 0.0)",
            }
        },
    ),
    Mutant(
        name="kl_averaged_over_latents",
        explanation="the KL is averaged over the latents in place of summed",
        provenance="plausible",
        violates=("WM-11",),
        fix="Sum over the latents before clipping.",
        edits={
            "world_model.kl_losses": {
                _DYNAMICS: _DYNAMICS.replace(".sum", ".mean"),
                _REPRESENTATION: _REPRESENTATION.replace(".sum", ".mean"),
            }
        },
    ),
    Mutant(
        name="free_nats_for_each_latent",
        explanation="the free nats are granted to each latent: 32 nats in place of 1",
        provenance="TorchRL until issue 4073; the lesson DrunkJin/dreamer-from-scratch",
        violates=("WM-11",),
        fix="Sum over the latents, and clip the sum.",
        edits={
            "world_model.kl_losses": {
                _DYNAMICS: "np.maximum(config.free_nats, categorical_kl(stop_gradient(posterior), prior)).sum(axis=-1)",
                _REPRESENTATION: (
                    "np.maximum(config.free_nats, categorical_kl(posterior, stop_gradient(prior))).sum(axis=-1)"
                ),
                _CLIPPED: "return dynamics, representation",
            }
        },
    ),
    Mutant(
        name="free_nats_after_the_mean",
        explanation="the free nats are granted to the mean over the batch",
        provenance="STORM (issue 12); naivoder's implementation clips a sum over the batch",
        violates=("WM-11",),
        fix="Clip every time step of every row by itself.",
        edits={
            "world_model.kl_losses": {
                _CLIPPED: (
                    "means = [np.full(kl.shape, np.maximum(config.free_nats, kl.mean())) for "
                    "kl in (dynamics, representation)]\n"
                    "    return means[0], means[1]"
                )
            }
        },
    ),
    Mutant(
        name="no_free_nats",
        explanation="the KL is not clipped",
        provenance="plausible",
        violates=("WM-11", "WM-14"),
        fix="Clip the summed KL from below at free_nats.",
        edits={"world_model.kl_losses": {_CLIPPED: "return dynamics, representation"}},
    ),
    Mutant(
        name="kl_without_stop_gradient",
        explanation="dynamics and representation loss both train both sides",
        provenance="plausible; TorchRL had one KL for both until issue 4073",
        violates=("WM-12",),
        fix="Stop the gradient at the posterior in the dynamics loss and at the prior in the representation loss.",
        edits={
            "world_model.kl_losses": {
                _DYNAMICS: "categorical_kl(posterior, prior).sum(axis=-1)",
                _REPRESENTATION: "categorical_kl(posterior, prior).sum(axis=-1)",
            }
        },
    ),
    Mutant(
        name="kl_stop_gradients_swapped",
        explanation="the dynamics loss trains the posterior and the representation loss the prior",
        provenance="plausible",
        violates=("WM-12",),
        fix="Stop the gradient at the posterior in the dynamics loss and at the prior in the representation loss.",
        edits={
            "world_model.kl_losses": {
                f"dynamics = {_DYNAMICS}": f"dynamics = {_REPRESENTATION}",
                f"representation = {_REPRESENTATION}": f"representation = {_DYNAMICS}",
            }
        },
    ),
    Mutant(
        name="dynamics_loss_ends_at_the_prior",
        explanation="the dynamics loss trains the prior, and not the memory that it reads",
        provenance="plausible",
        violates=("WM-13",),
        fix="Let the prior read the memory with its gradient.",
        edits={
            "world_model.world_model_losses": {
                "rssm.prior(params, deter, config)": "rssm.prior(params, stop_gradient(deter), config)"
            }
        },
    ),
    Mutant(
        name="open_loop_sees_everything",
        explanation="open-loop prediction goes on looking at the observations",
        provenance="plausible; sheeprl's notebook showed frames of the same latents (issue 272)",
        violates=("WM-22",),
        fix="After the context draw the latents from the prior.",
        edits={
            "world_model.open_loop": {
                "np.asarray(observation[key])[:, :context]": "np.asarray(observation[key])",
                "prev_action[:, :context], is_first[:, :context]": "prev_action, is_first",
                "posterior_noise, config": "np.concatenate([posterior_noise, prior_noise], axis=1), config",
                "for t in range(context, steps)": "for t in range(0)",
            }
        },
    ),
    Mutant(
        name="open_loop_context_too_long",
        explanation="open-loop prediction sees one observation more than its context",
        provenance="plausible",
        violates=("WM-21", "WM-22"),
        fix="Observe exactly `context` steps.",
        edits={
            "world_model.open_loop": {
                "seen = {key:": (
                    "uniform = np.concatenate([posterior_noise, prior_noise], axis=1)\n"
                    "    context = min(context + 1, steps - 1)\n"
                    "    posterior_noise, prior_noise = uniform[:, :context], uniform[:, context:]\n"
                    "    seen = {key:"
                )
            }
        },
    ),
    Mutant(
        name="open_loop_actions_not_shifted",
        explanation="open-loop prediction pairs each step with the action taken after it",
        provenance="plausible; as in DI-engine's training",
        violates=("WM-20", "CON-12"),
        fix="Step t takes the action that led to it.",
        edits={
            "world_model.open_loop": {
                'prev_action = checked("prev_action", prev_action, rows, steps, spaces.action_size)': (
                    'prev_action = np.roll(checked("prev_action", prev_action, rows, steps, '
                    "spaces.action_size), -1, axis=1)"
                )
            }
        },
    ),
    Mutant(
        name="open_loop_without_resets",
        explanation="open-loop prediction runs across the starts of episodes after the context",
        provenance="plausible",
        violates=("WM-20",),
        fix="Where is_first, predict from zeros.",
        edits={
            "world_model.open_loop": {"starts = is_first[:, t, None]": "starts = np.zeros_like(is_first[:, t, None])"}
        },
    ),
    Mutant(
        name="open_loop_in_symlog_space",
        explanation="open-loop prediction leaves vectors in symlog space",
        provenance="plausible",
        violates=("WM-23",),
        fix="Take symexp of the decoder's vectors.",
        edits={"world_model._in_units": {"return symexp(prediction)": "return prediction"}},
    ),
)
