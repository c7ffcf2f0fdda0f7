"""The interface as tables: its functions, what they take and give, and what of a configuration they read."""

import inspect

from conformance.adapter import Adapter
from conformance.serve import OBJECTS as OBJECTS

INTERFACE: dict[str, tuple[str, ...]] = {
    name: tuple(inspect.signature(function).parameters)[1:]
    for name, function in vars(Adapter).items()
    if inspect.isfunction(function) and not name.startswith("_")
}
"""Every function that the checks know -> the names of its arguments, which are given by position."""

RESULTS: dict[str, tuple[str, ...]] = {
    "bounded_normal": ("mean", "std"),
    "kl_losses": ("dynamics", "representation"),
    "update_return_range": ("low", "high"),
    "laprop": ("update", "second_moment", "momentum"),
    "optimizer_step": ("params", "state"),
    "policy_step": ("carry", "action"),
    **dict.fromkeys(("losses", "losses_given"), ("total", "aux")),
    **dict.fromkeys(("train_step", "train_step_with", "train_step_given"), ("state", "aux")),
}
"""Functions with several results -> what these are, in their order."""

_CELL = ("blocks", "norm_epsilon")
_IMAGES = ("cnn_depth", "cnn_multipliers", "cnn_outer", "cnn_sampling", "halvings", "norm_epsilon")
_POLICY = ("actor_min_std", "actor_max_std", "actor_unimix")
_LAPROP = ("beta1", "beta2", "laprop_epsilon")
CONFIG_FIELDS: dict[str, tuple[str, ...]] = {
    "core": _CELL,
    "prior": ("prior_layers", "norm_epsilon"),
    "posterior": ("posterior_layers", "norm_epsilon"),
    "observe": ("latent_unimix", "posterior_layers", *_CELL),
    "imagine": ("latent_unimix", "prior_layers", *_CELL),
    "observe_given": ("prior_layers", "posterior_layers", *_CELL),
    "imagine_given": ("prior_layers", *_CELL),
    "encoder": ("encoder_layers", *_IMAGES),
    "decoder": ("decoder_layers", "blocks", *_IMAGES),
    "reward_head": ("reward_layers", "norm_epsilon"),
    "continue_head": ("continue_layers", "norm_epsilon"),
    "actor": ("actor_layers", "norm_epsilon"),
    "critic": ("critic_layers", "norm_epsilon"),
    "continue_target": ("continue_target", "discount"),
    "kl_losses": ("free_nats", "latent_unimix"),
    "reconstruction_losses": ("vector_loss_scale",),
    "update_return_range": ("return_decay", "return_percentile_low", "return_percentile_high"),
    **dict.fromkeys(("sample_action", "action_log_prob", "action_entropy", "draw_actions"), _POLICY),
    "actor_loss": ("entropy_scale",),
    **dict.fromkeys(("critic_loss", "replay_critic_loss"), ("slow_critic_scale",)),
    "learning_rate": ("learning_rate", "warmup_steps"),
    "laprop": _LAPROP,
    "optimizer_step": ("agc_clip", "agc_epsilon", "learning_rate", "warmup_steps", *_LAPROP),
    "can_train": ("batch_size", "batch_length", "replay_capacity"),
}
"""Functions of one part -> what of the configuration their results depend on, but for sizes, which the shapes show
too."""
