"""dreamerv3: the code of the authors of DreamerV3 as it stands today.

Written for their repository at e3f0224 (May 2026), whose folder has to be on the path. It is the edition of December
2024: what was changed since lies outside of the algorithm. Everything is computed by their functions and modules, on
the given numbers: `dreamerv3_2026_names` says what is called how there, `dreamerv3_2026_networks`, `_distributions` and
`_losses` hold the parts, `dreamerv3_2026_agent` the agent.

Not offered: samples from given noise of single distributions and of the recurrent model, since they draw with the
generator of JAX; pooling, which is a line inside of their encoder; predictions without observations, which their report
makes without resets; replay and the training loop.
"""

import subprocess
from pathlib import Path

import jax.numpy as jnp
from dreamerv3 import agent
from dreamerv3_2026_agent import (  # noqa: F401 - these and the following are offered
    adaptive_gradient_clip,
    draw_parameters,
    gradients,
    gradients_given,
    imagine_given,
    laprop,
    learning_rate,
    loss_derivatives,
    losses,
    losses_given,
    observe_given,
    optimizer_step,
    policy_step,
    train_step,
    train_step_given,
    update_slow_critic,
)
from dreamerv3_2026_distributions import (  # noqa: F401
    action_entropy,
    action_log_prob,
    bernoulli_loss,
    bernoulli_mean,
    bounded_normal,
    categorical_entropy,
    categorical_kl,
    categorical_log_prob,
    draw_actions,
    draw_categorical,
    draw_normal,
    exponential_bins,
    mse_loss,
    normal_entropy,
    normal_log_prob,
    ordered_expectation,
    straight_through,
    symexp,
    symexp_twohot_loss,
    symexp_twohot_mean,
    symlog,
    symlog_mse_loss,
    twohot,
    unimix_log_probs,
)
from dreamerv3_2026_losses import (  # noqa: F401
    actor_loss,
    continue_target,
    critic_loss,
    cumulative_weights,
    kl_losses,
    lambda_return,
    percentile,
    reconstruction_losses,
    replay_critic_loss,
    replay_lambda_return,
    return_scale,
    update_return_range,
)
from dreamerv3_2026_networks import (  # noqa: F401
    actor,
    block_linear,
    continue_head,
    convolution,
    core,
    critic,
    decoder,
    dense,
    encoder,
    linear,
    mlp,
    posterior,
    prior,
    reward_head,
    rms_norm,
    setup,
    silu,
    transposed_convolution,
)

_FOLDER = Path(agent.__file__).parent
__version__ = subprocess.run(
    ["git", "-C", _FOLDER, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
).stdout.strip()
convert = jnp.asarray


def edition():
    return "2024-12"
