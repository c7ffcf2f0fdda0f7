"""RLlib of ray 2.60: its DreamerV3 for PyTorch, `ray.rllib.algorithms.dreamerv3`.

Their code is time first. Losses and returns are methods of `DreamerV3TorchLearner`; they are called as they are, with
stand-ins for the learner, its configuration and its actor, and the actor's loss, which is a mean, one element at a
time. The scale of the returns is read off advantages that were divided by it.

Not offered: bins and two-hot losses, which are 255 even bins in symlog space and written inside of longer functions;
recurrent cell and heads, which have LayerNorm and other shapes than the kit's.
"""

from importlib.metadata import version
from types import SimpleNamespace as Namespace

import gymnasium
import torch
from ray.rllib.algorithms.dreamerv3.torch.dreamerv3_torch_learner import DreamerV3TorchLearner as Learner
from ray.rllib.algorithms.dreamerv3.torch.models.components.representation_layer import RepresentationLayer
from ray.rllib.utils.torch_utils import inverse_symlog, symlog  # noqa: F401

__version__ = version("ray")
convert = torch.as_tensor
symexp = inverse_symlog


def edition():
    return "2023"


def setup(dtype):
    torch.distributions.Distribution.set_default_validate_args(False)
    torch.set_default_dtype(getattr(torch, dtype))


def probabilities(logits):
    """Probabilities [N, S, C] of logits, with their uniform mixture of one percent."""
    layer = RepresentationLayer(
        input_size=1, model_size="XS", num_categoricals=logits.shape[-2], num_classes_per_categorical=logits.shape[-1]
    )
    layer.z_generating_layer = torch.nn.Identity()
    return layer(logits.flatten(-2), return_z_probs=True)[1]


def kl_losses(posterior_logits, prior_logits, config):
    rows = posterior_logits.shape[:-2]
    posterior, prior = (probabilities(logits.flatten(0, -3)) for logits in (posterior_logits, prior_logits))
    settings = Namespace(batch_size_B_per_learner=len(posterior), batch_length_T=1)
    given = {"z_posterior_probs_BxT": posterior, "z_prior_probs_BxT": prior}
    losses = Learner._compute_world_model_dynamics_and_representation_loss(None, config=settings, fwd_out=given)
    return tuple(loss.reshape(rows) for loss in losses)


def lambda_return(reward, continue_, value, discount, lambda_):
    return Learner._compute_value_targets(
        None,
        config=Namespace(gamma=discount, gae_lambda=lambda_),
        rewards_t0_to_H_BxT=reward.mT,
        intrinsic_rewards_t1_to_H_BxT=None,
        continues_t0_to_H_BxT=continue_.mT,
        value_predictions_t0_to_H_BxT=value.mT,
    ).mT


def learner_of(low, high, **attributes):
    """A learner, and its actor, which keeps the range of the returns."""
    actor = Namespace(
        **{f"ema_value_target_pct{q}": torch.as_tensor(x) for q, x in ((5, low), (95, high))}, **attributes
    )
    learner = Namespace(module={"default": Namespace(unwrapped=lambda: Namespace(actor=actor))})
    learner._compute_scaled_value_targets = lambda **given: Learner._compute_scaled_value_targets(learner, **given)
    learner.metrics = Namespace(log_dict=lambda *values, **options: None)
    return learner, actor


def advantages(low, high, returns, values, decay):
    """Scaled advantages [H, N], and the range afterwards."""
    learner, actor = learner_of(low, high)
    given = {"value_targets_t0_to_Hm1_BxT": returns, "value_predictions_t0_to_Hm1_BxT": values}
    scaled = learner._compute_scaled_value_targets(
        module_id="default", config=Namespace(return_normalization_decay=decay), **given
    )
    return scaled, (actor.ema_value_target_pct5, actor.ema_value_target_pct95)


def update_return_range(low, high, returns, config):
    return advantages(low, high, returns.mT, torch.zeros_like(returns.mT), config.return_decay)[1]


def return_scale(low, high, limit):
    """They have no limit but 1e-8."""
    one = torch.ones(1, 1)
    return 1 / advantages(low, high, one, 0 * one, 1.0)[0][0, 0]


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    rows = zip(*(x.reshape(-1, 1, 1) for x in (log_prob, entropy, returns, value, weight)), strict=True)
    return torch.stack([one_actor_loss(*row, scale, config) for row in rows]).reshape(returns.shape)


def one_actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    policy = Namespace(entropy=lambda: entropy)
    space = gymnasium.spaces.Discrete(2)
    learner, _ = learner_of(0.0, float(scale), action_space=space, get_action_dist_object=lambda parameters: policy)
    settings = Namespace(
        return_normalization_decay=1.0, entropy_scale=config.entropy_scale, report_individual_batch_item_stats=False
    )
    twice = {
        "values_dreamed": value,
        "actions_dreamed": torch.ones(1, 1, 1),
        "actions_dreamed_dist_params": log_prob[..., None],
    }
    twice["dream_loss_weights"] = weight
    dreams = {
        f"{name}_t0_to_H_BxT": torch.cat([x, x]) for name, x in twice.items()
    }  # the last imagined state is not read
    return Learner._compute_actor_loss(
        learner, module_id="default", config=settings, dream_data=dreams, value_targets_t0_to_Hm1_BxT=returns
    )
