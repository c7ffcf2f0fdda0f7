"""The agent: initial state, policy step, losses, train step. Chapter: spec/10-agent.md."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (so it is called everywhere)
from torch import Tensor

from impl_torch.behavior import (
    action_entropy,
    action_log_prob,
    actor_loss,
    critic_loss,
    mode_action,
    replay_critic_loss,
    sample_action,
    update_slow_critic,
)
from impl_torch.distributions import bernoulli_mean, symexp_twohot_mean
from impl_torch.layers import Params, for_many_rows, truncated_normal
from impl_torch.networks import actor, continue_head, critic, encoder, feature, reward_head
from impl_torch.optimizer import optimizer_step
from impl_torch.returns import (
    cumulative_weights,
    lambda_return,
    replay_lambda_return,
    return_scale,
    update_return_range,
)
from impl_torch.rssm import Carry, freeze, imagine_features, observe, observe_step, prepare
from impl_torch.shapes import (
    Observations,
    require_keys,
    require_observations,
    require_shape,
    require_shapes,
    wide_dtype,
)
from impl_torch.transforms import standard_bins
from impl_torch.world_model import continue_target, world_model_losses
from spec import Config, Parameter, Spaces, parameter_table

Range = tuple[Tensor, Tensor]
State = Mapping[str, Any]


def initial_parameters(table: Mapping[str, Parameter], uniforms: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Every parameter of the table, from uniforms in the shape of each kernel. [AGT-1] [AGT-3] to [AGT-6]"""
    kernels = {name: entry.shape for name, entry in table.items() if entry.initializer == "truncated_normal"}
    require_shapes("uniforms", uniforms, kernels)
    like = next(iter(uniforms.values()))
    params = {}
    for name, entry in table.items():
        if entry.initializer == "truncated_normal":
            params[name] = truncated_normal(uniforms[name], entry.fan_in, entry.outscale)
        else:
            params[name] = like.new_full(entry.shape, 1.0 if entry.initializer == "ones" else 0.0)
    return params


def initial_state(params: Mapping[str, Tensor]) -> dict[str, Any]:
    """A fresh training state. [AGT-7] [AGT-8] [OPT-13]"""
    zero = next(iter(params.values())).new_zeros(())
    return {
        "params": dict(params),
        "slow_critic": {name: x.detach().clone() for name, x in params.items() if name.startswith("critic/")},
        "optimizer": {
            "step": 0,
            **{
                moment: {name: torch.zeros_like(x) for name, x in params.items()}
                for moment in ("second_moment", "momentum")
            },
        },
        "return_range": {"low": zero, "high": zero.clone()},
    }


@torch.no_grad()
def policy_step(
    params: Params,
    carry: Carry,
    prev_action: Tensor,
    observation: Observations,
    is_first: Tensor,
    noise: Mapping[str, Tensor],
    spaces: Spaces,
    config: Config,
    mode: bool = False,
) -> tuple[dict[str, Tensor], Tensor]:
    """One acting step of N rows: the new carry and the flat action [N, A]. [AGT-11] [AGT-12] [AGT-13]

    carry of N rows, prev_action [N, A], observation {key: [N, ...]}, is_first [N], noise {"posterior" [N, S], "action"
    [N, K]}. mode: the action is the mode of the actor, not a sample. [LOOP-71]
    """
    params = prepare(params, config)
    tokens = encoder(params, observation, spaces, config)
    carry, _ = observe_step(params, carry, tokens, prev_action, is_first, noise["posterior"], config)
    outputs = actor(params, feature(carry["deter"], carry["stoch"]), spaces, config)
    if mode:
        return dict(carry), mode_action(outputs, spaces, config)
    return dict(carry), sample_action(outputs, noise["action"], spaces, config)


def losses(
    params: Params,
    slow_critic: Params,
    return_range: Range,
    batch: Observations,
    noise: Mapping[str, Tensor],
    spaces: Spaces,
    config: Config,
) -> tuple[Tensor, dict[str, Any]]:
    """The total loss of a train step and everything else that comes out of it.

    [AGT-14] to [AGT-28] [RET-3] to [RET-6] [RET-11] [BEH-11] [BEH-16] [BEH-18]
    return_range: (low, high); batch: observations [B, T, ...], "reward", "is_first", "is_last", "is_terminal" [B, T],
    "prev_action" [B, T, A], "deter" [B, D], "stoch" [B, S] class indices;
    noise: "posterior" [B, T, S], "prior" [N, H, S], "action" [N, H, K], with N = B * T;
    aux: "losses" {name: scalar} with gradients, "return_range", "deter" [B, T, D], "stoch" [B, T, S, C], all constant,
    and "metrics" {name: scalar}.
    """
    B, T = _require_step(params, batch, noise, spaces, config)
    params = for_many_rows(prepare(params, config))
    frozen, slow_critic = freeze(params, config), for_many_rows(freeze(slow_critic, config))
    H = config.imagination_horizon
    dtype = wide_dtype(config)
    bins = standard_bins(config.bins, dtype, batch["reward"].device)

    # World model.
    start = {"deter": batch["deter"].to(dtype), "stoch": F.one_hot(batch["stoch"].long(), config.classes).to(dtype)}
    tokens = encoder(params, {key: batch[key] for key in spaces.observations}, spaces, config)  # [B, T, E]
    states = observe(params, start, tokens, batch["prev_action"], batch["is_first"], noise["posterior"], config)
    values: dict[str, Tensor] = world_model_losses(params, batch, states, spaces, config)  # [B, T] each

    # Imagination from all N posterior states. It has no gradients, but the actor's outputs along it are kept with
    # theirs: its loss then needs no second pass over the same states.
    constants = {name: states[name].detach() for name in ("deter", "stoch")}
    outputs = []

    def policy(state: Tensor, t: int) -> Tensor:
        with torch.enable_grad():
            outputs.append(actor(params, state, spaces, config))
        return sample_action(outputs[-1], noise["action"][:, t], spaces, config)

    features, actions = imagine_features(
        frozen, {name: x.flatten(0, 1) for name, x in constants.items()}, policy, noise["prior"], config
    )  # H+1 of [N, F], H of [N, A]
    logits = _over_time(lambda x: critic(params, x, config), features[:H])  # [N, H, bins]
    with torch.no_grad():
        slow_logits = _over_time(lambda x: critic(slow_critic, x, config), features[:H])
        reward = _over_time(lambda x: symexp_twohot_mean(reward_head(frozen, x, config), bins), features[1:])
        reward = F.pad(reward, (1, 0))  # [N, H+1]: the reward of state 0 has been earned, no formula reads it
        continue_ = _over_time(lambda x: bernoulli_mean(continue_head(frozen, x, config)), features)  # [N, H+1]
        if config.start_continue == "true":
            continue_[:, 0] = continue_target(batch["is_terminal"], config).flatten()
        # The value of states 0 .. H-1 is the mean of logits that the loss needs anyway; the last is for the bootstrap.
        last = symexp_twohot_mean(critic(frozen, features[H], config), bins)  # [N]
        value = torch.cat([symexp_twohot_mean(logits, bins), last.unsqueeze(1)], 1)  # [N, H+1]

    # Returns. The range is updated first: this very step uses it.
    returns = lambda_return(reward, continue_, value, config.imagined_discount, config.return_lambda)  # [N, H]
    weight = cumulative_weights(continue_, config.imagined_discount)  # [N, H]
    low, high = update_return_range(*return_range, returns, config)
    scale = return_scale(low, high, config.return_limit)

    # Actor and critic.
    policies = {
        key: {name: torch.stack([output[key][name] for output in outputs], 1) for name in outputs[0][key]}
        for key in spaces.actions
    }  # [N, H, ...] each
    log_prob = action_log_prob(policies, torch.stack(actions, 1), spaces, config)
    entropy = action_entropy(policies, spaces, config)
    values["actor"] = actor_loss(log_prob, entropy, returns, value[:, :H], weight, scale, config)
    values["critic"] = critic_loss(logits, slow_logits, returns, weight, config)
    if T > 1:
        annotation = returns[:, 0].view(B, T)  # the imagined return from each replayed state
        values["replay_critic"] = _replay_critic_loss(params, slow_critic, states, annotation, batch, config)

    means = {name: x.mean() for name, x in values.items()}
    means.setdefault("replay_critic", returns.new_zeros(()))
    total = torch.stack([loss_scale(name, config) * mean for name, mean in means.items()]).sum()
    metrics = {
        "return_scale": scale,
        "return_mean": returns.mean(),
        "value_mean": value[:, :H].mean(),
        "reward_mean": reward[:, 1:].mean(),
        "continue_mean": continue_[:, 1:].mean(),
        "weight_mean": weight.mean(),
        "actor_entropy": entropy.detach().mean(),
    }
    return total, {"losses": means, "return_range": (low, high), **constants, "metrics": metrics}


def _require_step(
    params: Params, batch: Observations, noise: Mapping[str, Tensor], spaces: Spaces, config: Config
) -> tuple[int, int]:
    """B and T, if everything has the names and shapes that belong to them. [CON-8] [CON-20]"""
    flags = ("reward", "is_first", "is_last", "is_terminal")
    require_keys("batch", batch, (*spaces.observations, *flags, "prev_action", "deter", "stoch"))
    require_keys("noise", noise, ("posterior", "prior", "action"))
    # B and T are what most arrays say, so that the error names the one that differs.
    steps = (*spaces.observations, *flags, "prev_action")
    (B, T), _ = Counter((*batch[key].shape, 0, 0)[:2] for key in steps).most_common(1)[0]
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
    require_shapes("params", params, {name: entry.shape for name, entry in parameter_table(config, spaces).items()})
    return B, T


def _over_time(head: Callable[[Tensor], Tensor], features: list[Tensor]) -> Tensor:
    """A head at t imagined states [N, F] each -> [N, t, ...].

    On the CPU step by step, so that the N rows stay in the cache; an accelerator takes all t * N rows at once.
    """
    if features[0].device.type == "cpu":
        return torch.stack([head(x) for x in features], 1)
    return head(torch.stack(features)).transpose(0, 1)


def _replay_critic_loss(
    params: Params,
    slow_critic: Params,
    states: Mapping[str, Tensor],
    annotation: Tensor,
    batch: Observations,
    config: Config,
) -> Tensor:
    """[B, T-1], with gradients into the states. [AGT-25]"""
    state = feature(states["deter"], states["stoch"])[:, :-1]  # [B, T-1, F]: the last step has no next reward
    with torch.no_grad():
        slow_logits = critic(slow_critic, state, config)
        reward, is_last, is_terminal = batch["reward"], batch["is_last"], batch["is_terminal"]
        returns = replay_lambda_return(reward, is_last, is_terminal, annotation, config.discount, config.return_lambda)
    return replay_critic_loss(critic(params, state, config), slow_logits, returns, is_last[:, :-1], config)


def loss_scale(name: str, config: Config) -> float:
    """The weight of a loss in the total. [AGT-26]"""
    return getattr(config, f"{name.split('/')[0]}_scale")


def gradients(
    params: Params,
    slow_critic: Params,
    return_range: Range,
    batch: Observations,
    noise: Mapping[str, Tensor],
    spaces: Spaces,
    config: Config,
) -> tuple[dict[str, Tensor], Tensor, dict[str, Any]]:
    """(gradients by every parameter, zeros where there are none; total; aux of `losses`). [AGT-28] [AGT-32] [OPT-18]"""
    leaves = {name: x if x.requires_grad else x.detach().requires_grad_() for name, x in params.items()}
    with torch.enable_grad():
        total, aux = losses(leaves, slow_critic, return_range, batch, noise, spaces, config)
        by_leaf: Iterable[Tensor] = torch.autograd.grad(total, list(leaves.values()), materialize_grads=True)
    aux["losses"] = {name: loss.detach() for name, loss in aux["losses"].items()}
    return dict(zip(leaves, by_leaf, strict=True)), total.detach(), aux


def train_step(
    state: State, batch: Observations, noise: Mapping[str, Tensor], spaces: Spaces, config: Config
) -> tuple[dict[str, Any], dict[str, Any]]:
    """One training step as a function: a new state and aux. `Learner` does the same in place.

    [AGT-29] [AGT-30] [AGT-31] [OPT-21] [BEH-21]
    """
    return_range = (state["return_range"]["low"], state["return_range"]["high"])
    by_name, _, aux = gradients(state["params"], state["slow_critic"], return_range, batch, noise, spaces, config)
    params, optimizer = optimizer_step(state["params"], by_name, state["optimizer"], config)
    low, high = aux["return_range"]
    new_state = {
        "params": params,
        "slow_critic": update_slow_critic(state["slow_critic"], params, config.slow_critic_decay),
        "optimizer": optimizer,
        "return_range": {"low": low, "high": high},
    }
    return new_state, aux
