"""The agent: parameters, training state, policy step, losses and train step. Chapter: spec/10-agent.md."""

import statistics
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jax.typing import ArrayLike

from impl_jax import behavior, networks, returns, rssm
from impl_jax.distributions import bernoulli_mean, symexp_twohot_mean
from impl_jax.layers import Params, truncated_normal
from impl_jax.optimizer import initial_optimizer_state, optimizer_step_with_metrics
from impl_jax.shapes import require_keys, require_observations, require_shape, require_shapes, wide_dtype, widen
from impl_jax.transforms import exponential_bins
from impl_jax.world_model import continue_target, world_model_losses
from spec import Config, Parameter, Spaces, parameter_table

Arrays = Mapping[str, jax.Array]
State = dict[str, Any]


def initial_parameters(table: Mapping[str, Parameter], uniforms: Mapping[str, ArrayLike]) -> dict[str, jax.Array]:
    """Every parameter of the table, from uniforms in the shape of each kernel, in their dtype. [AGT-3] to [AGT-6]"""
    kernels = {name: entry.shape for name, entry in table.items() if entry.initializer == "truncated_normal"}
    require_shapes("uniforms", uniforms, kernels)
    dtype = jnp.result_type(*(widen(uniform) for uniform in uniforms.values()))
    params = {}
    for name, entry in table.items():
        if entry.initializer == "truncated_normal":
            params[name] = truncated_normal(uniforms[name], entry.fan_in, entry.outscale)
        else:
            params[name] = jnp.full(entry.shape, 0.0 if entry.initializer == "zeros" else 1.0, dtype)
    return params


def initial_state(params: Params) -> State:
    """A fresh training state of these parameters. [AGT-7], [AGT-8]

    The slow critic has memory of its own: a train step takes over that of its state, and can take none twice.
    """
    dtype = jnp.result_type(*params.values())
    return {
        "params": dict(params),
        "slow_critic": {
            name: jnp.array(value, copy=True) for name, value in params.items() if name.startswith("critic/")
        },
        "optimizer": initial_optimizer_state(params),
        "return_range": {"low": jnp.zeros((), dtype), "high": jnp.zeros((), dtype)},
    }


def policy_step(
    params: Params,
    carry: Arrays,
    prev_action: jax.Array,
    observation: Arrays,
    is_first: jax.Array,
    noise: Arrays,
    spaces: Spaces,
    config: Config,
    mode: bool = False,
) -> tuple[dict[str, jax.Array], jax.Array]:
    """One acting step of N rows: (carry, flat action [N, A]). [AGT-11] to [AGT-13]

    carry: {"deter" [N, D], "stoch" [N, S, C]}; prev_action [N, A]; noise {"posterior" [N, S], "action" [N, K]}.
    mode: the action is the mode of the actor, not a sample. [LOOP-71]
    """
    _require_parameters("params", params, spaces, config)
    require_shape("is_first", is_first.shape, "N")
    N = is_first.shape[0]
    require_shape("carry['deter']", carry["deter"].shape, N, config.deter)
    require_shape("carry['stoch']", carry["stoch"].shape, N, config.stoch, config.classes)
    require_shape("prev_action", prev_action.shape, N, spaces.action_size)
    require_shape("noise['posterior']", noise["posterior"].shape, N, config.stoch)
    require_shape("noise['action']", noise["action"].shape, N, spaces.action_noise_size)
    require_observations("observation", observation, spaces, (N,))
    tokens = networks.encoder(params, observation, spaces, config)
    carry, _ = rssm.observe_step(params, carry, tokens, prev_action, is_first, noise["posterior"], config)
    outputs = networks.actor(params, networks.feature(carry["deter"], carry["stoch"]), spaces, config)
    if mode:
        return carry, behavior.mode_action(outputs, spaces, config)
    return carry, behavior.sample_action(outputs, noise["action"], spaces, config)


def losses(
    params: Params,
    slow_critic: Arrays,
    return_range: tuple[ArrayLike, ArrayLike],
    batch: Arrays,
    noise: Arrays,
    spaces: Spaces,
    config: Config,
) -> tuple[jax.Array, dict[str, Any]]:
    """The total loss, a scalar, and everything that a train step reports. [AGT-14] to [AGT-28]

    return_range: (low, high) before this step; batch: observations [B, T, ...], "reward", "is_first", "is_last",
    "is_terminal" [B, T], "prev_action" [B, T, A], "deter" [B, D], "stoch" [B, S] class indices;
    noise: {"posterior" [B, T, S], "prior" [N, H, S], "action" [N, H, K]}, with N = B * T;
    aux: "losses" {name: mean, unweighted}, "return_range" (updated), "deter" [B, T, D], "stoch" [B, T, S, C] and
    "metrics" {name: scalar}, all constants but the losses.
    """
    _require_parameters("params", params, spaces, config)
    _require_parameters("slow_critic", slow_critic, spaces, config)
    _require_batch(batch, noise, spaces, config)
    slow_critic, batch, noise = stop_gradient((dict(slow_critic), dict(batch), dict(noise)))
    low, high = (stop_gradient(jnp.asarray(end)) for end in return_range)
    states = _observe_batch(params, batch, noise["posterior"], spaces, config)
    each = world_model_losses(params, batch, states, spaces, config)
    behavior_losses, updated_range, metrics = _behavior_losses(
        params, slow_critic, (low, high), batch, states, noise, spaces, config
    )
    each |= behavior_losses
    means = {name: jnp.mean(loss) if loss.size else jnp.zeros((), loss.dtype) for name, loss in each.items()}
    total = jnp.asarray(sum(getattr(config, f"{name.split('/')[0]}_scale") * mean for name, mean in means.items()))
    latents = {"deter": states["deter"], "stoch": states["stoch"]}
    return total, {"losses": means} | stop_gradient({"return_range": updated_range, **latents, "metrics": metrics})


def _require_parameters(name: str, params: Params, spaces: Spaces, config: Config) -> None:
    """Raises ValueError where a parameter has not the shape of the table. [CON-8], [AGT-1]"""
    for key, entry in parameter_table(config, spaces).items():
        if key in params:
            require_shape(f"{name}[{key!r}]", params[key].shape, *entry.shape)


def _require_batch(batch: Arrays, noise: Arrays, spaces: Spaces, config: Config) -> None:
    """Raises ValueError where an array of a train step has a wrong shape. [CON-8], [CON-20]"""
    flags = ("reward", "is_first", "is_last", "is_terminal")
    require_keys("batch", batch, (*spaces.observations, *flags, "prev_action", "deter", "stoch"))
    require_keys("noise", noise, ("posterior", "prior", "action"))
    # B and T are what most arrays say, so that the error names the one that differs.
    steps = (*spaces.observations, *flags, "prev_action")
    B, T = statistics.mode((*batch[key].shape, 0, 0)[:2] for key in steps)
    require_observations("batch", batch, spaces, (B, T))
    for key in flags:
        require_shape(f"batch[{key!r}]", batch[key].shape, B, T)
    require_shape("batch['prev_action']", batch["prev_action"].shape, B, T, spaces.action_size)
    require_shape("batch['deter']", batch["deter"].shape, B, config.deter)
    require_shape("batch['stoch']", batch["stoch"].shape, B, config.stoch)
    N, H = B * T, config.imagination_horizon
    require_shape("noise['posterior']", noise["posterior"].shape, B, T, config.stoch)
    require_shape("noise['prior']", noise["prior"].shape, N, H, config.stoch)
    require_shape("noise['action']", noise["action"].shape, N, H, spaces.action_noise_size)


def _observe_batch(
    params: Params, batch: Arrays, uniform: jax.Array, spaces: Spaces, config: Config
) -> dict[str, jax.Array]:
    """The posterior states of a train batch, from the stored latents of the context step. [AGT-14], [AGT-15]"""
    tokens = networks.encoder(params, batch, spaces, config)
    carry = {"deter": batch["deter"], "stoch": jax.nn.one_hot(batch["stoch"], config.classes, dtype=jnp.float32)}
    return rssm.observe(params, carry, tokens, batch["prev_action"], batch["is_first"], uniform, config)


def _behavior_losses(
    params: Params,
    slow_critic: Arrays,
    return_range: tuple[jax.Array, jax.Array],
    batch: Arrays,
    states: Arrays,
    noise: Arrays,
    spaces: Spaces,
    config: Config,
) -> tuple[dict[str, jax.Array], tuple[jax.Array, jax.Array], dict[str, jax.Array]]:
    """Losses of actor and critic, the updated return range, and metrics. [AGT-17] to [AGT-25]

    Imagined arrays have time first, as the loop leaves them: to turn features and logits around would copy the largest
    arrays of the step. What the chapter calls [N, H] is [H, N] here.
    """
    B, T = batch["is_first"].shape
    wide, bins = wide_dtype(config), exponential_bins(config.bins)
    constants = stop_gradient(dict(params))
    feature = networks.feature(states["deter"], states["stoch"])  # [B, T, F]

    features, action = _imagine_batch(constants, states, noise, spaces, config)  # [H+1, N, F], [H, N, A]
    reward = symexp_twohot_mean(networks.reward_head(constants, features, config), bins)  # [H+1, N]
    continue_ = bernoulli_mean(networks.continue_head(constants, features, config))  # [H+1, N]
    if config.start_continue == "true":
        continue_ = continue_.at[0].set(continue_target(batch["is_terminal"], config).reshape(-1))
    # One pass with gradients serves the critic's loss and, as a constant, the baseline and the bootstrap values.
    logits = networks.critic(params, features, config)  # [H+1, N, bins]
    value = stop_gradient(symexp_twohot_mean(logits, bins))  # [H+1, N]
    slow_logits = networks.critic(slow_critic, features, config)

    discount = config.imagined_discount
    imagined = returns.lambda_return(reward.T, continue_.T, value.T, discount, config.return_lambda)  # [N, H]
    weight = returns.cumulative_weights(continue_.T, discount).T  # [H, N]
    updated_range = returns.update_return_range(*return_range, imagined, config)  # first: this very step uses it
    scale = returns.return_scale(*updated_range, config.return_limit)
    target = imagined.T  # [H, N]

    # The actor once more, with gradients and at all states at once: the loop then has no way back, for which it would
    # have to keep what every layer of every step has read.
    outputs = jax.tree.map(lambda x: x[:-1], networks.actor(params, features, spaces, config))
    entropy = behavior.action_entropy(outputs, spaces, config)
    log_prob = behavior.action_log_prob(outputs, action, spaces, config)
    each = {
        "actor": behavior.actor_loss(log_prob, entropy, target, value[:-1], weight, scale, config),
        "critic": behavior.critic_loss(logits[:-1], slow_logits[:-1], target, weight, config),
        "replay_critic": jnp.zeros((B, 0), wide),
    }
    if T > 1:
        flags = (batch["is_last"], batch["is_terminal"])
        reward_seen = batch["reward"].astype(wide)
        annotation = target[0].reshape(B, T)  # the imagined return from each replayed state
        replayed = returns.replay_lambda_return(
            reward_seen, *flags, annotation, config.discount, config.return_lambda
        )  # [B, T-1]
        live = networks.critic(params, feature, config)  # with gradients into the world model
        # Imagination starts at the posterior states, so the slow critic has judged them already.
        slow = slow_logits[0].reshape(B, T, -1)
        each["replay_critic"] = behavior.replay_critic_loss(
            live[:, :-1], slow[:, :-1], replayed, batch["is_last"][:, :-1], config
        )
    metrics = {
        "return_scale": scale,
        "return_mean": jnp.mean(imagined),
        "value_mean": jnp.mean(value[:-1]),
        "reward_mean": jnp.mean(reward[1:]),
        "continue_mean": jnp.mean(continue_[1:]),
        "weight_mean": jnp.mean(weight),
        "actor_entropy": jnp.mean(entropy),
    }
    return each, updated_range, metrics


def _imagine_batch(
    constants: Params, states: Arrays, noise: Arrays, spaces: Spaces, config: Config
) -> tuple[jax.Array, jax.Array]:
    """Features [H+1, N, F] and actions [H, N, A] of imagination from every posterior state. [AGT-17], [AGT-18]"""
    N = states["deter"].shape[0] * states["deter"].shape[1]
    carry = stop_gradient({key: states[key].reshape(N, *states[key].shape[2:]) for key in ("deter", "stoch")})
    uniform, action_noise = (noise[key].swapaxes(0, 1) for key in ("prior", "action"))  # time first

    def policy(feature: jax.Array, t: jax.Array) -> jax.Array:
        outputs = networks.actor(constants, feature, spaces, config)
        return behavior.sample_action(outputs, action_noise[t], spaces, config)

    return rssm.imagine_features(constants, carry, policy, uniform, config)


def gradients(
    params: Params,
    slow_critic: Arrays,
    return_range: tuple[ArrayLike, ArrayLike],
    batch: Arrays,
    noise: Arrays,
    spaces: Spaces,
    config: Config,
) -> tuple[dict[str, jax.Array], jax.Array, dict[str, Any]]:
    """The gradient of the total by every parameter, and what `losses` returns: (gradients, total, aux). [AGT-28]"""

    def total(params: Params) -> tuple[jax.Array, dict[str, Any]]:
        return losses(params, slow_critic, return_range, batch, noise, spaces, config)

    (loss, aux), by_name = jax.value_and_grad(total, has_aux=True)(params)
    return by_name, loss, aux


def train_step(
    state: State, batch: Arrays, noise: Arrays, spaces: Spaces, config: Config
) -> tuple[State, dict[str, Any]]:
    """One gradient step: a new state, and the aux of `losses` with the optimizer's metrics. [AGT-29] to [AGT-31]

    The latents in aux are those of the parameters before the update.
    """
    return_range = (state["return_range"]["low"], state["return_range"]["high"])
    by_name, loss, aux = gradients(state["params"], state["slow_critic"], return_range, batch, noise, spaces, config)
    params, optimizer, metrics = optimizer_step_with_metrics(state["params"], by_name, state["optimizer"], config)
    low, high = aux["return_range"]
    new = {
        "params": params,
        "slow_critic": behavior.update_slow_critic(state["slow_critic"], params, config.slow_critic_decay),
        "optimizer": optimizer,
        "return_range": {"low": low, "high": high},
    }
    metrics = aux["metrics"] | metrics | {"loss/total": loss, "return_low": low, "return_high": high}
    return new, aux | {"metrics": metrics}
