"""Encoder, decoder and the four heads. Chapter: spec/05-networks.md."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.distributions import bernoulli_mean as sigmoid
from reference_numpy.layers import (
    block_linear,
    convolution,
    dense,
    linear,
    max_pool,
    mlp,
    rms_norm,
    silu,
    transposed_convolution,
    upsample,
)
from reference_numpy.observations import one_hots, scaled_image
from reference_numpy.shapes import checked, require_observations
from reference_numpy.transforms import symlog
from spec.config import Config
from spec.parameters import bottleneck
from spec.spaces import Discrete, Spaces, Vector

Array = NDArray[np.float64]
Params = Mapping[str, Any]


def feature(deter: Any, stoch: Any) -> Array:
    """The model state as one vector. Implements [NET-1], [CON-4].

    Args:
      deter: [..., D], the memory.
      stoch: [..., S, C], the latents.

    Returns:
      [..., D + S*C]: first the memory, then the latents, class by class.

    Raises:
      ValueError: the leading axes differ.
    """
    deter = checked("deter", deter, ..., "D")
    stoch = checked("stoch", stoch, *deter.shape[:-1], "S", "C")
    return np.concatenate([deter, stoch.reshape(*stoch.shape[:-2], -1)], axis=-1)


def encoder(params: Params, observations: Mapping[str, Any], spaces: Spaces, config: Config) -> Array:
    """Tokens of observations. Implements [NET-2] to [NET-12], [NET-24], [NET-27].

    Paper: Networks; Robust predictions (symlog of vector inputs); D-15 to D-17.

    Args:
      params: `encoder/...`.
      observations: raw observations by key, each [..., *array_shape] with equal leading axes; other keys are ignored.

    Returns:
      [..., E]: vector features, then image features in the order height, width, channels.

    Raises:
      ValueError: a key is missing, a shape or dtype does not fit, a Discrete value is out of range, or an image cannot
        be halved.
    """
    rows = require_observations("observations", observations, spaces)
    if spaces.images:
        bottleneck(config, spaces)  # raises if the sides cannot be halved as often as configured
    tokens = []
    if spaces.vectors:
        inputs = [_encode_vector(key, observations[key], space) for key, space in spaces.vectors.items()]
        tokens.append(
            mlp(params, "encoder/vector", np.concatenate(inputs, axis=-1), config.encoder_layers, config.norm_epsilon)
        )
    if spaces.images:
        images = [scaled_image(observations[key]) - 0.5 for key in spaces.images]
        picture = np.concatenate(images, axis=-1)
        tokens.append(_encode_image(params, picture.reshape(-1, *picture.shape[-3:]), config).reshape(*rows, -1))
    return np.concatenate(tokens, axis=-1)


def decoder(params: Params, feature: Any, spaces: Spaces, config: Config) -> dict[str, Array]:
    """Reconstructions of all observations. Implements [NET-13] to [NET-19], [NET-24], [NET-27].

    Paper: Networks; Robust predictions; D-15, D-16, D-36.

    Args:
      params: `decoder/...`.
      feature: [..., F], the model state.

    Returns:
      By key: Vector [..., size] in symlog space; Discrete logits [..., sum of classes]; Image [..., height, width,
        channels] in [0, 1].

    Raises:
      ValueError: a shape does not fit, or an image cannot be halved as often as configured.
    """
    feature = checked("feature", feature, ..., config.feature_size)
    outputs = {}
    if spaces.vectors:
        hidden = mlp(params, "decoder/vector", feature, config.decoder_layers, config.norm_epsilon)
        for key in spaces.vectors:
            name = f"decoder/vector/out/{key}"
            outputs[key] = linear(hidden, params[f"{name}/kernel"], params[f"{name}/bias"])
    if spaces.images:
        flat = _decode_image(params, feature.reshape(-1, config.feature_size), spaces, config)
        picture = flat.reshape(*feature.shape[:-1], *flat.shape[1:])
        first = 0
        for key, image in spaces.images.items():
            outputs[key] = picture[..., first : first + image.channels]
            first += image.channels
    return {key: outputs[key] for key in spaces.observations}


def reward_head(params: Params, feature: Any, config: Config) -> Array:
    """Logits of the symexp-twohot distribution of the reward. Implements [NET-20], [NET-24], [NET-27].

    Args:
      params: `reward/...`.
      feature: [..., F].

    Returns:
      [..., bins].

    Raises:
      ValueError: a shape does not fit.
    """
    return _head(params, "reward", feature, config.reward_layers, config)


def continue_head(params: Params, feature: Any, config: Config) -> Array:
    """Logit of the probability that the episode goes on. Implements [NET-21], [NET-24], [NET-27].

    Args:
      params: `continue/...`.
      feature: [..., F].

    Returns:
      [...].

    Raises:
      ValueError: a shape does not fit.
    """
    return _head(params, "continue", feature, config.continue_layers, config)[..., 0]


def critic(params: Params, feature: Any, config: Config) -> Array:
    """Logits of the symexp-twohot distribution of the return. Implements [NET-20], [NET-23], [NET-24], [NET-27].

    Args:
      params: `critic/...`: of the critic, or of the slow critic.
      feature: [..., F].

    Returns:
      [..., bins].

    Raises:
      ValueError: a shape does not fit.
    """
    return _head(params, "critic", feature, config.critic_layers, config)


def actor(params: Params, feature: Any, spaces: Spaces, config: Config) -> dict[str, dict[str, Array]]:
    """Raw outputs of the policy. Implements [NET-22], [NET-24], [NET-27].

    Args:
      params: `actor/...`.
      feature: [..., F].

    Returns:
      By action key: {"logits": [..., sum of classes]} for a Discrete, {"mean": [..., size], "std": [..., size]} for a
        Vector.

    Raises:
      ValueError: a shape does not fit.
    """
    feature = checked("feature", feature, ..., config.feature_size)
    hidden = mlp(params, "actor", feature, config.actor_layers, config.norm_epsilon)
    outputs = {}
    for key, space in spaces.actions.items():
        outputs[key] = {
            output: linear(hidden, params[f"actor/out/{key}/{output}/kernel"], params[f"actor/out/{key}/{output}/bias"])
            for output in (("logits",) if isinstance(space, Discrete) else ("mean", "std"))
        }
    return outputs


def _encode_vector(key: str, value: Any, space: Vector | Discrete) -> Array:
    if isinstance(space, Discrete):
        return one_hots(key, value, space)
    return symlog(np.asarray(value, dtype=np.float64))


def _encode_image(params: Params, x: Array, config: Config) -> Array:
    """[N, height, width, channels] -> [N, h0, w0, c0]. Implements [NET-7] to [NET-10]."""
    for index in range(len(config.cnn_multipliers)):
        name = f"encoder/image/conv{index}"
        halving = not (config.cnn_outer and index == 0)
        strided = config.cnn_sampling == "strided"
        x = convolution(x, params[f"{name}/kernel"], params[f"{name}/bias"], 2 if halving and strided else 1)
        if halving and not strided:
            x = max_pool(x)
        x = silu(rms_norm(x, params[f"{name}/scale"], config.norm_epsilon))
    return x


def _decode_image(params: Params, feature: Array, spaces: Spaces, config: Config) -> Array:
    """[N, F] -> [N, height, width, all channels]. Implements [NET-15] to [NET-18]."""
    x = _stem(params, feature[:, : config.deter], feature[:, config.deter :], spaces, config)
    for index in range(len(config.cnn_multipliers) - 1):
        name = f"decoder/image/conv{index}"
        x = _doubling(params, name, x, config)
        x = silu(rms_norm(x, params[f"{name}/scale"], config.norm_epsilon))
    if config.cnn_outer:
        x = convolution(x, params["decoder/image/out/kernel"], params["decoder/image/out/bias"], 1)
    else:
        x = _doubling(params, "decoder/image/out", x, config)
    return sigmoid(x)


def _stem(params: Params, deter: Array, flat_stoch: Array, spaces: Spaces, config: Config) -> Array:
    """The first feature map of the image decoder [N, h0, w0, c0]. Implements [NET-16]."""
    height, width, channels = bottleneck(config, spaces)
    blocks = config.blocks
    memory = block_linear(deter, params["decoder/image/deter/kernel"], params["decoder/image/deter/bias"])
    memory = memory.reshape(-1, blocks, height, width, channels // blocks)
    memory = memory.transpose(0, 2, 3, 1, 4).reshape(-1, height, width, channels)
    latents = dense(params, "decoder/image/stoch_hidden", flat_stoch, config.norm_epsilon)
    latents = linear(latents, params["decoder/image/stoch/kernel"], params["decoder/image/stoch/bias"])
    latents = latents.reshape(-1, height, width, channels)
    return silu(rms_norm(memory + latents, params["decoder/image/stem/scale"], config.norm_epsilon))


def _doubling(params: Params, name: str, x: Array, config: Config) -> Array:
    if config.cnn_sampling == "strided":
        return transposed_convolution(x, params[f"{name}/kernel"], params[f"{name}/bias"])
    return convolution(upsample(x), params[f"{name}/kernel"], params[f"{name}/bias"], 1)


def _head(params: Params, name: str, feature: Any, layers: int, config: Config) -> Array:
    feature = checked("feature", feature, ..., config.feature_size)
    hidden = mlp(params, name, feature, layers, config.norm_epsilon)
    return linear(hidden, params[f"{name}/out/kernel"], params[f"{name}/out/bias"])
