"""The recurrent state-space model: memory update, prior, posterior, observing, imagining. Chapter: spec/04-rssm.md."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.distributions import bernoulli_mean as sigmoid
from reference_numpy.distributions import categorical_sample, straight_through, unimix_log_probs
from reference_numpy.layers import block_linear, dense, linear, mlp, rms_norm, silu
from reference_numpy.networks import feature
from reference_numpy.shapes import checked, require_shape
from reference_numpy.stop_gradient import stop_gradient
from spec.config import Config

Array = NDArray[np.float64]
Params = Mapping[str, Any]
Carry = Mapping[str, Any]


def core(params: Params, deter: Any, stoch: Any, action: Any, config: Config) -> Array:
    """One update of the memory: the block-diagonal GRU. Implements [RSSM-1] to [RSSM-7], [RSSM-24], [RSSM-27].

    Paper: Networks ("The sequence model is a GRU with block-diagonal recurrent weights"); D-26 to D-29.

    Args:
      params: `rssm/embed_deter`, `rssm/embed_stoch`, `rssm/embed_action`, `rssm/hidden` and `rssm/gru`.
      deter: [..., D], the memory.
      stoch: [..., S, C], one-hot latents, or zeros.
      action: [..., A], a flat action of any scale.

    Returns:
      The new memory [..., D].

    Raises:
      ValueError: a shape does not fit.
    """
    deter = checked("deter", deter, ..., config.deter)
    rows, blocks = deter.shape[:-1], config.blocks
    stoch = checked("stoch", stoch, *rows, config.stoch, config.classes)
    action = checked("action", action, *rows, _action_size(params))

    action = action / stop_gradient(np.maximum(1.0, np.abs(action)))
    flat_stoch = stoch.reshape(*rows, config.stoch * config.classes)
    embeddings = [
        dense(params, "rssm/embed_deter", deter, config.norm_epsilon),
        dense(params, "rssm/embed_stoch", flat_stoch, config.norm_epsilon),
        dense(params, "rssm/embed_action", action, config.norm_epsilon),
    ]

    inputs = []
    for memory in np.split(deter, blocks, axis=-1):
        inputs += [memory, *embeddings]
    x = np.concatenate(inputs, axis=-1)
    x = block_linear(x, params["rssm/hidden/kernel"], params["rssm/hidden/bias"])
    x = silu(rms_norm(x, params["rssm/hidden/scale"], config.norm_epsilon))

    gates = block_linear(x, params["rssm/gru/kernel"], params["rssm/gru/bias"])
    gates = gates.reshape(*rows, blocks, 3, config.deter // blocks)
    reset, candidate, update = (gates[..., part, :].reshape(*rows, config.deter) for part in range(3))
    candidate = np.tanh(sigmoid(reset) * candidate)
    update = sigmoid(update - 1.0)
    return update * candidate + (1.0 - update) * deter


def prior(params: Params, deter: Any, config: Config) -> Array:
    """Logits of the latents as foreseen from the memory alone. Implements [RSSM-8], [RSSM-10], [RSSM-27].

    Paper: World model learning (dynamics predictor); D-30.

    Args:
      params: `rssm/prior/...`.
      deter: [..., D], the memory after the core.

    Returns:
      Logits [..., S, C], before the uniform mixture.

    Raises:
      ValueError: a shape does not fit.
    """
    deter = checked("deter", deter, ..., config.deter)
    hidden = mlp(params, "rssm/prior", deter, config.prior_layers, config.norm_epsilon)
    logits = linear(hidden, params["rssm/prior/out/kernel"], params["rssm/prior/out/bias"])
    return logits.reshape(*deter.shape[:-1], config.stoch, config.classes)


def posterior(params: Params, deter: Any, tokens: Any, config: Config) -> Array:
    """Logits of the latents given memory and observation. Implements [RSSM-9], [RSSM-10], [RSSM-27].

    Paper: World model learning (encoder); D-30.

    Args:
      params: `rssm/posterior/...`.
      deter: [..., D], the memory after the core.
      tokens: [..., E], the encoder's output.

    Returns:
      Logits [..., S, C], before the uniform mixture.

    Raises:
      ValueError: a shape does not fit.
    """
    deter = checked("deter", deter, ..., config.deter)
    tokens = checked("tokens", tokens, *deter.shape[:-1], _token_size(params, config))
    inputs = np.concatenate([deter, tokens], axis=-1)
    hidden = mlp(params, "rssm/posterior", inputs, config.posterior_layers, config.norm_epsilon)
    logits = linear(hidden, params["rssm/posterior/out/kernel"], params["rssm/posterior/out/bias"])
    return logits.reshape(*deter.shape[:-1], config.stoch, config.classes)


def observe_step(
    params: Params, carry: Carry, tokens: Any, prev_action: Any, is_first: Any, uniform: Any, config: Config
) -> tuple[dict[str, Array], Array]:
    """One step with an observation. Implements [RSSM-10] to [RSSM-16], [RSSM-27].

    Paper: World model learning; D-21, D-24, D-25.

    Args:
      params: `rssm/...` without the prior.
      carry: "deter" [N, D] and "stoch" [N, S, C] of the step before.
      tokens: [N, E], the encoder's output for this observation.
      prev_action: [N, A], the flat action that led to this observation.
      is_first: [N] bool, this observation starts an episode.
      uniform: [N, S], numbers in [0, 1).

    Returns:
      The new carry, and the posterior logits [N, S, C].

    Raises:
      ValueError: a shape does not fit.
    """
    is_first = np.asarray(is_first, dtype=bool)
    require_shape("is_first", is_first.shape, "N")
    rows = len(is_first)
    deter = checked("carry['deter']", carry["deter"], rows, config.deter)
    stoch = checked("carry['stoch']", carry["stoch"], rows, config.stoch, config.classes)
    prev_action = checked("prev_action", prev_action, rows, _action_size(params))
    uniform = checked("uniform", uniform, rows, config.stoch)

    deter = np.where(is_first[:, None], 0.0, deter)
    stoch = np.where(is_first[:, None, None], 0.0, stoch)
    prev_action = np.where(is_first[:, None], 0.0, prev_action)

    deter = core(params, deter, stoch, prev_action, config)
    logits = posterior(params, deter, tokens, config)
    log_probs = unimix_log_probs(logits, config.latent_unimix)
    stoch = straight_through(log_probs, categorical_sample(log_probs, uniform))
    return {"deter": deter, "stoch": stoch}, logits


def observe(
    params: Params, carry: Carry, tokens: Any, prev_action: Any, is_first: Any, uniform: Any, config: Config
) -> dict[str, Array]:
    """A sequence of observations, with resets wherever an episode starts.
    Implements [RSSM-17] to [RSSM-19], [RSSM-23], [RSSM-27].

    Paper: World model learning; D-20, D-85, D-86.

    Args:
      params: `rssm/...` without the prior.
      carry: "deter" [B, D] and "stoch" [B, S, C] of the step before the first one; constants.
      tokens: [B, T, E], the encoder's output.
      prev_action: [B, T, A]; entry t is the flat action that led to observation t.
      is_first: [B, T] bool.
      uniform: [B, T, S], numbers in [0, 1).

    Returns:
      "deter" [B, T, D], "stoch" [B, T, S, C] (posterior samples) and "logits" [B, T, S, C] (posterior, before the
      uniform mixture).

    Raises:
      ValueError: a shape does not fit.
    """
    is_first = np.asarray(is_first, dtype=bool)
    require_shape("is_first", is_first.shape, "B", "T")
    rows, steps = is_first.shape
    tokens = checked("tokens", tokens, rows, steps, _token_size(params, config))
    prev_action = checked("prev_action", prev_action, rows, steps, _action_size(params))
    uniform = checked("uniform", uniform, rows, steps, config.stoch)
    require_shape("carry['deter']", np.shape(carry["deter"]), rows, config.deter)
    require_shape("carry['stoch']", np.shape(carry["stoch"]), rows, config.stoch, config.classes)

    state = {name: stop_gradient(np.asarray(carry[name], dtype=np.float64)) for name in ("deter", "stoch")}
    outputs: dict[str, list[Array]] = {"deter": [], "stoch": [], "logits": []}
    for t in range(steps):
        state, logits = observe_step(
            params, state, tokens[:, t], prev_action[:, t], is_first[:, t], uniform[:, t], config
        )
        outputs["deter"].append(state["deter"])
        outputs["stoch"].append(state["stoch"])
        outputs["logits"].append(logits)
    return {name: np.stack(values, axis=1) for name, values in outputs.items()}


def imagine(
    params: Params, carry: Carry, policy: Callable[[Array, int], Any], uniform: Any, config: Config
) -> dict[str, Array]:
    """Trajectories without observations, under a policy. Implements [RSSM-20] to [RSSM-22], [RSSM-25], [RSSM-27].

    Paper: Critic learning ("abstract trajectories"); D-01, D-58.

    Args:
      params: `rssm/...` without the posterior.
      carry: "deter" [N, D] and "stoch" [N, S, C], the states to start from.
      policy: (feature [N, F], t) -> flat actions [N, A], called for t = 0 .. H-1.
      uniform: [N, H, S], numbers in [0, 1); entry t draws the latents of state t + 1.

    Returns:
      "deter" [N, H+1, D], "stoch" [N, H+1, S, C] and "action" [N, H, A], all constants.

    Raises:
      ValueError: a shape does not fit.
    """
    uniform = checked("uniform", uniform, "N", "H", config.stoch)
    rows, horizon, _ = uniform.shape
    deter = stop_gradient(checked("carry['deter']", carry["deter"], rows, config.deter))
    stoch = stop_gradient(checked("carry['stoch']", carry["stoch"], rows, config.stoch, config.classes))
    deters, stochs, actions = [deter], [stoch], []
    for t in range(horizon):
        action = stop_gradient(checked("action", policy(feature(deter, stoch), t), rows, _action_size(params)))
        deter = stop_gradient(core(params, deter, stoch, action, config))
        log_probs = unimix_log_probs(prior(params, deter, config), config.latent_unimix)
        stoch = categorical_sample(log_probs, uniform[:, t])
        deters.append(deter)
        stochs.append(stoch)
        actions.append(action)
    return {"deter": np.stack(deters, axis=1), "stoch": np.stack(stochs, axis=1), "action": np.stack(actions, axis=1)}


def _action_size(params: Params) -> int:
    return np.shape(params["rssm/embed_action/kernel"])[0]


def _token_size(params: Params, config: Config) -> int:
    return np.shape(params["rssm/posterior/hidden0/kernel"])[0] - config.deter
