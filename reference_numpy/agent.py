"""The agent: initialization, the policy step, the losses of a train step and the step itself.

Chapter: spec/10-agent.md. Paper: sections World model learning, Critic learning, Actor learning; table Hyperparameters.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy import networks
from reference_numpy.behavior import (
    action_entropy,
    action_log_prob,
    actor_loss,
    critic_loss,
    mode_action,
    replay_critic_loss,
    sample_action,
    update_slow_critic,
)
from reference_numpy.distributions import bernoulli_mean, symexp_twohot_mean
from reference_numpy.layers import truncated_normal
from reference_numpy.optimizer import optimizer_step
from reference_numpy.returns import (
    cumulative_weights,
    lambda_return,
    replay_lambda_return,
    return_scale,
    update_return_range,
)
from reference_numpy.rssm import imagine, observe, observe_step
from reference_numpy.shapes import require, require_keys, require_observations, require_shape, require_shapes
from reference_numpy.stop_gradient import recording, replaying, stop_gradient
from reference_numpy.transforms import exponential_bins
from reference_numpy.world_model import continue_target, world_model_losses
from spec.config import Config
from spec.parameters import Parameter
from spec.spaces import Spaces

Array = NDArray[np.float64]
Params = Mapping[str, Any]


def initial_parameters(table: Mapping[str, Parameter], uniforms: Mapping[str, Any]) -> dict[str, Array]:
    """Fresh parameters as a function of uniform numbers.
    Implements [AGT-3] to [AGT-6], [LAY-9]; paper: Critic learning.

    Args:
      table: name -> Parameter, from `spec.parameters.parameter_table`.
      uniforms: name -> numbers in [0, 1) in the parameter's shape, for exactly the entries with initializer
        "truncated_normal".

    Raises:
      ValueError: a name is missing or too many, or a shape differs.
    """
    kernels = {name: entry.shape for name, entry in table.items() if entry.initializer == "truncated_normal"}
    require_shapes("uniforms", uniforms, kernels)
    params = {}
    for name, entry in table.items():
        if entry.initializer == "truncated_normal":
            params[name] = truncated_normal(uniforms[name], entry.fan_in, entry.outscale)
        else:
            params[name] = np.full(entry.shape, {"zeros": 0.0, "ones": 1.0}[entry.initializer])
    return params


def initial_state(params: Params) -> dict[str, Any]:
    """The training state of a fresh run. Implements [AGT-7], [AGT-8].

    Args:
      params: name -> array.

    Returns:
      {"params", "slow_critic": name -> array, "optimizer": {"step", "second_moment", "momentum"}, "return_range":
      {"low", "high"}}.
    """
    params = {name: np.array(value, np.float64) for name, value in params.items()}
    return {
        "params": params,
        "slow_critic": {name: value.copy() for name, value in params.items() if name.startswith("critic/")},
        "optimizer": {
            "step": 0,
            "second_moment": {name: np.zeros_like(value) for name, value in params.items()},
            "momentum": {name: np.zeros_like(value) for name, value in params.items()},
        },
        "return_range": {"low": 0.0, "high": 0.0},
    }


def flatten_state(state: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """A training state under the flat names and in the types of a checkpoint. Implements [AGT-9].

    Returns:
      Name -> float32 array, except `optimizer/step`, which is int64; scalars have shape [].
    """
    groups = {
        "params": state["params"],
        "slow_critic": state["slow_critic"],
        "optimizer/second_moment": state["optimizer"]["second_moment"],
        "optimizer/momentum": state["optimizer"]["momentum"],
        "return_range": state["return_range"],
    }
    flat = {
        f"{group}/{name}": np.array(value, np.float32)
        for group, entries in groups.items()
        for name, value in entries.items()
    }
    return {**flat, "optimizer/step": np.array(state["optimizer"]["step"], np.int64)}


def unflatten_state(arrays: Mapping[str, Any], table: Mapping[str, Parameter]) -> dict[str, Any]:
    """The inverse of `flatten_state`, for the parameters of `table`. Implements [AGT-10].

    Raises:
      ValueError: names or shapes are not those of a training state with these parameters.
    """
    zeros = initial_state({name: np.zeros(entry.shape) for name, entry in table.items()})
    expected = {name: value.shape for name, value in flatten_state(zeros).items()}
    require_shapes("training state", arrays, expected)

    def group(prefix: str) -> dict[str, Array]:
        return {
            name.removeprefix(prefix): np.array(arrays[name], np.float64)
            for name in expected
            if name.startswith(prefix)
        }

    return {
        "params": group("params/"),
        "slow_critic": group("slow_critic/"),
        "optimizer": {
            "step": int(arrays["optimizer/step"]),
            "second_moment": group("optimizer/second_moment/"),
            "momentum": group("optimizer/momentum/"),
        },
        "return_range": {"low": float(arrays["return_range/low"]), "high": float(arrays["return_range/high"])},
    }


def policy_step(
    params: Params,
    carry: Mapping[str, Any],
    prev_action: Any,
    observation: Mapping[str, Any],
    is_first: Any,
    noise: Mapping[str, Any],
    spaces: Spaces,
    config: Config,
    mode: bool = False,
) -> tuple[dict[str, Array], Array]:
    """One observation of each row in, one action of each row out.
    Implements [AGT-11] to [AGT-13], [LOOP-71]; paper: Critic learning.

    Args:
      carry: {"deter" [N, D], "stoch" [N, S, C]}.
      prev_action: flat action [N, A] chosen at the observation before; not used where is_first.
      observation: key -> [N, ...], raw.
      is_first: [N] bool.
      noise: {"posterior" [N, S] uniforms, "action" [N, K] uniforms and normals}.
      mode: the action is the mode of the actor, not a sample; the latents are sampled all the same.

    Returns:
      The new carry and the flat action [N, A].

    Raises:
      ValueError: an argument has another shape.
    """
    rows = len(np.asarray(prev_action))
    require_shape("noise['posterior']", np.shape(noise["posterior"]), rows, config.stoch)
    require_shape("noise['action']", np.shape(noise["action"]), rows, spaces.action_noise_size)
    tokens = networks.encoder(params, observation, spaces, config)
    carry, _ = observe_step(params, carry, tokens, prev_action, is_first, noise["posterior"], config)
    outputs = networks.actor(params, networks.feature(carry["deter"], carry["stoch"]), spaces, config)
    if mode:
        return dict(carry), mode_action(outputs, spaces, config)
    return dict(carry), sample_action(outputs, noise["action"], spaces, config)


def losses(
    params: Params,
    slow_critic: Params,
    return_range: tuple[float, float],
    batch: Mapping[str, Any],
    noise: Mapping[str, Any],
    spaces: Spaces,
    config: Config,
) -> tuple[float, dict[str, Any]]:
    """The one scalar that is minimized. Implements [AGT-14] to [AGT-28]; paper: all loss equations of the main text.

    Args:
      params, slow_critic: name -> array.
      return_range: moving averages (low, high) before this step.
      batch: as replay gives it: observations [B, T, ...], reward, is_first, is_last, is_terminal [B, T], prev_action
        [B, T, A], and the latents of the context step: deter [B, D], stoch [B, S] class indices.
      noise: {"posterior" [B, T, S], "prior" [N, H, S], "action" [N, H, K]} with N = B*T.

    Returns:
      The total, and aux: "losses" {name: mean}, "return_range" (low, high), "deter" [B, T, D], "stoch" [B, T, S, C],
      "metrics" {name: scalar}.

    Raises:
      ValueError: an array of the batch or the noise has another shape.
    """
    _check_batch(batch, spaces, config)
    rows, length = np.shape(batch["reward"])
    starts, bins = rows * length, exponential_bins(config.bins)
    _check_noise(noise, rows, length, spaces, config)

    # World model: read the sequences from the stored latents on.
    context = np.eye(config.classes)[np.asarray(batch["stoch"])]
    carry = {"deter": stop_gradient(batch["deter"]), "stoch": stop_gradient(context)}
    tokens = networks.encoder(params, {key: batch[key] for key in spaces.observations}, spaces, config)
    states = observe(params, carry, tokens, batch["prev_action"], batch["is_first"], noise["posterior"], config)
    elements = dict(world_model_losses(params, batch, states, spaces, config))

    # Imagination: follow the actor from every posterior state; nothing here carries a gradient.
    start = {
        "deter": stop_gradient(states["deter"]).reshape(starts, config.deter),
        "stoch": stop_gradient(states["stoch"]).reshape(starts, config.stoch, config.classes),
    }

    def policy(feature: Array, t: int) -> Array:
        outputs = networks.actor(params, feature, spaces, config)
        return sample_action(outputs, np.asarray(noise["action"])[:, t], spaces, config)

    dream = imagine(params, start, policy, noise["prior"], config)
    features = stop_gradient(networks.feature(dream["deter"], dream["stoch"]))
    reward = stop_gradient(symexp_twohot_mean(networks.reward_head(params, features, config), bins))
    continue_ = stop_gradient(bernoulli_mean(networks.continue_head(params, features, config)))
    value = stop_gradient(symexp_twohot_mean(networks.critic(params, features, config), bins))
    if config.start_continue == "true":
        true_continue = continue_target(batch["is_terminal"], config).reshape(starts, 1)
        continue_ = np.concatenate([true_continue, continue_[:, 1:]], axis=1)

    # Returns: the range is updated first, so that this very step uses it.
    returns = lambda_return(reward, continue_, value, config.imagined_discount, config.return_lambda)
    weight = cumulative_weights(continue_, config.imagined_discount)
    low, high = update_return_range(*return_range, returns, config)
    scale = return_scale(low, high, config.return_limit)

    # Actor and critic at imagined states 0 .. H-1.
    acting = features[:, :-1]
    outputs = networks.actor(params, acting, spaces, config)
    log_prob = action_log_prob(outputs, dream["action"], spaces, config)
    entropy = action_entropy(outputs, spaces, config)
    elements["actor"] = actor_loss(log_prob, entropy, returns, value[:, :-1], weight, scale, config)
    logits, slow_logits = networks.critic(params, acting, config), networks.critic(slow_critic, acting, config)
    elements["critic"] = critic_loss(logits, slow_logits, returns, weight, config)

    # Critic at the replayed states: here the gradient goes on into the world model.
    elements["replay_critic"] = np.zeros((rows, 0))
    if length > 1:
        annotation = returns[:, 0].reshape(rows, length)
        targets = replay_lambda_return(
            batch["reward"], batch["is_last"], batch["is_terminal"], annotation, config.discount, config.return_lambda
        )
        replayed = networks.feature(states["deter"], states["stoch"])[:, :-1]
        logits, slow_logits = (
            networks.critic(params, replayed, config),
            networks.critic(slow_critic, stop_gradient(replayed), config),
        )
        elements["replay_critic"] = replay_critic_loss(
            logits, slow_logits, targets, np.asarray(batch["is_last"])[:, :-1], config
        )

    means = {name: float(np.mean(value)) if value.size else 0.0 for name, value in elements.items()}
    total = sum(_loss_scale(name, config) * mean for name, mean in means.items())
    metrics = {
        "return_scale": scale,
        "return_mean": returns.mean(),
        "value_mean": value[:, :-1].mean(),
        "reward_mean": reward[:, 1:].mean(),
        "continue_mean": continue_[:, 1:].mean(),
        "weight_mean": weight.mean(),
        "actor_entropy": entropy.mean(),
    }
    aux = {
        "losses": means,
        "return_range": (low, high),
        "deter": states["deter"],
        "stoch": states["stoch"],
        "metrics": {name: float(metric) for name, metric in metrics.items()},
    }
    return total, aux


def train_step(
    state: Mapping[str, Any],
    batch: Mapping[str, Any],
    noise: Mapping[str, Any],
    gradients: Mapping[str, Any],
    spaces: Spaces,
    config: Config,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """One update of everything that learns. Implements [AGT-29] to [AGT-31]; paper: Optimizer, Critic learning.

    Args:
      state: a training state, see `initial_state`.
      batch, noise: as `losses` takes them.
      gradients: name -> gradient of the total at state["params"]; the reference cannot compute it.

    Returns:
      The new training state, and the aux of `losses` at the old one.

    Raises:
      ValueError: an argument has another shape.
    """
    before = (state["return_range"]["low"], state["return_range"]["high"])
    _, aux = losses(state["params"], state["slow_critic"], before, batch, noise, spaces, config)
    params, optimizer = optimizer_step(state["params"], gradients, state["optimizer"], config)
    low, high = aux["return_range"]
    new_state = {
        "params": params,
        "slow_critic": update_slow_critic(state["slow_critic"], params, config.slow_critic_decay),
        "optimizer": optimizer,
        "return_range": {"low": low, "high": high},
    }
    return new_state, aux


def directional_derivative(
    function: Callable[[dict[str, Array]], Any], params: Params, direction: Params, step: float
) -> Any:
    """The derivative of `function` at `params` along `direction`, stop-gradients held constant.
    Implements [AGT-32], [CON-14].

    Args:
      function: params -> scalar or array; must call `stop_gradient` equally often at every point.
      direction: name -> array of the parameter's shape; names that are absent do not move.
      step: how far the two points of the central difference lie from `params`, in units of `direction`.

    Raises:
      ValueError: the direction has unknown names or shapes, or the step is not positive.
    """
    require(step > 0, "step", "a positive number", step)
    for name, value in direction.items():
        if name not in params:
            raise ValueError(f"direction: unknown parameter {name!r}")
        require_shape(f"direction[{name!r}]", np.shape(value), *np.shape(params[name]))

    def shifted(distance: float) -> dict[str, Array]:
        moved = {name: np.array(value, np.float64) for name, value in params.items()}
        return moved | {
            name: moved[name] + distance * np.asarray(value, np.float64) for name, value in direction.items()
        }

    with recording() as tape:
        function(shifted(0.0))
    with replaying(tape):
        above = np.asarray(function(shifted(step)))
    with replaying(tape):
        below = np.asarray(function(shifted(-step)))
    return (above - below) / (2 * step)


def _loss_scale(name: str, config: Config) -> float:
    """The weight of a loss in the total, the table of [AGT-26]."""
    return float(getattr(config, f"{name.partition('/')[0]}_scale"))


def _check_batch(batch: Mapping[str, Any], spaces: Spaces, config: Config) -> None:
    flags = ("reward", "is_first", "is_last", "is_terminal")
    require_keys("batch", batch, (*spaces.observations, *flags, "prev_action", "deter", "stoch"))
    require_shape("batch['reward']", np.shape(batch["reward"]), "B", "T")
    rows, length = np.shape(batch["reward"])
    require_observations("batch", batch, spaces, (rows, length))
    for key in flags:
        require_shape(f"batch[{key!r}]", np.shape(batch[key]), rows, length)
    require_shape("batch['prev_action']", np.shape(batch["prev_action"]), rows, length, spaces.action_size)
    require_shape("batch['deter']", np.shape(batch["deter"]), rows, config.deter)
    require_shape("batch['stoch']", np.shape(batch["stoch"]), rows, config.stoch)
    indices = np.asarray(batch["stoch"])
    valid = indices.dtype.kind in "iu" and indices.min() >= 0 and indices.max() < config.classes
    require(valid, "batch['stoch']", f"class indices in 0 .. {config.classes - 1}", f"{indices.dtype} {indices!r}")


def _check_noise(noise: Mapping[str, Any], rows: int, length: int, spaces: Spaces, config: Config) -> None:
    require_keys("noise", noise, ("posterior", "prior", "action"))
    starts, horizon = rows * length, config.imagination_horizon
    require_shape("noise['posterior']", np.shape(noise["posterior"]), rows, length, config.stoch)
    require_shape("noise['prior']", np.shape(noise["prior"]), starts, horizon, config.stoch)
    require_shape("noise['action']", np.shape(noise["action"]), starts, horizon, spaces.action_noise_size)
