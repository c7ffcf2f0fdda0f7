"""The networks around the recurrent model: encoder, decoder, heads. Chapter: spec/05-networks.md.

They return raw outputs, those of the decoder and the heads in float32 or better. [NET-26]
"""

import jax
import jax.numpy as jnp

from impl_jax.layers import (
    Params,
    activate,
    block_linear,
    convolution,
    dense,
    linear,
    max_pool,
    mlp,
    transposed_convolution,
    upsampled_convolution,
)
from impl_jax.shapes import Observations, compute_dtype, require_observations, require_shape, wide_dtype
from impl_jax.transforms import symlog
from spec import Config, Discrete, Spaces, Vector
from spec.parameters import bottleneck


def feature(deter: jax.Array, stoch: jax.Array) -> jax.Array:
    """The model state that all heads read: [..., D], [..., S, C] -> [..., D + S*C]. [NET-1], [CON-4]"""
    require_shape("stoch", stoch.shape, *deter.shape[:-1], "S", "C")
    return jnp.concatenate([deter, stoch.reshape(*stoch.shape[:-2], -1).astype(deter.dtype)], -1)


def encoder(params: Params, observations: Observations, spaces: Spaces, config: Config) -> jax.Array:
    """Raw observations {key: [..., *array_shape]} -> tokens [..., E]: those of vectors, then of images.

    [NET-2] to [NET-12]

    Raises:
      ValueError: a missing key, or an observation of the wrong shape or dtype. [NET-27]
    """
    leading = require_observations("observations", observations, spaces)
    if spaces.images:
        bottleneck(config, spaces)  # refuses sides that cannot be halved, before any network runs
    tokens = []
    if spaces.vectors:
        vectors = [_vector_input(observations[key], space, config) for key, space in spaces.vectors.items()]
        x = jnp.concatenate(vectors, -1).astype(compute_dtype(config))  # [..., sum of encoded sizes]
        tokens.append(mlp(params, "encoder/vector", x, config.encoder_layers, config.norm_epsilon))  # [..., d]
    if spaces.images:
        x = jnp.concatenate([observations[key] for key in spaces.images], -1).astype(wide_dtype(config))
        x = (x / 255.0 - 0.5).astype(compute_dtype(config))  # [..., H, W, channels]; rounded once, here
        tokens.append(_image_encoder(params, x, config).reshape(*leading, -1))  # [..., h0*w0*c0]
    return jnp.concatenate(tokens, -1)


def onehots(x: jax.Array, space: Discrete, dtype: jnp.dtype) -> jax.Array:
    """Class indices [..., len(classes)] as joined one-hots [..., sum(classes)]. [CON-26]"""
    return jnp.concatenate(
        [jax.nn.one_hot(x[..., entry], classes, dtype=dtype) for entry, classes in enumerate(space.classes)], -1
    )


def _vector_input(x: jax.Array, space: Vector | Discrete, config: Config) -> jax.Array:
    """What the encoder reads of one observation that is not an image. [NET-3], [CON-24]"""
    dtype = wide_dtype(config)
    return onehots(x, space, dtype) if isinstance(space, Discrete) else symlog(x.astype(dtype))


def _image_encoder(params: Params, x: jax.Array, config: Config) -> jax.Array:
    """[..., H, W, c] -> [..., h0, w0, c0]. [NET-7] to [NET-9]"""
    x = x.reshape(-1, *x.shape[-3:])
    for index in range(len(config.cnn_multipliers)):
        name = f"encoder/image/conv{index}"
        kernel, bias, scale = (params[f"{name}/{part}"] for part in ("kernel", "bias", "scale"))
        if index == 0 and config.cnn_outer:
            x = convolution(x, kernel, bias, 1)
        elif config.cnn_sampling == "strided":
            x = convolution(x, kernel, bias, 2)
        else:
            x = max_pool(convolution(x, kernel, bias, 1))
        x = activate(x, scale, config.norm_epsilon)  # [n, h, w, c]
    return x


def decoder(params: Params, feature: jax.Array, spaces: Spaces, config: Config) -> dict[str, jax.Array]:
    """Features [..., F] -> key -> vectors in symlog space, logits, or images in [0, 1]. [NET-13] to [NET-19]"""
    x = _feature_input(feature, config)
    result: dict[str, jax.Array] = {}
    if spaces.vectors:
        hidden = mlp(params, "decoder/vector", x, config.decoder_layers, config.norm_epsilon)
        result |= {key: _output(params, f"decoder/vector/out/{key}", hidden, config) for key in spaces.vectors}
    if spaces.images:
        images = _image_decoder(params, x.reshape(-1, x.shape[-1]), spaces, config)
        images = images.reshape(*x.shape[:-1], *images.shape[1:])
        start = 0
        for key, space in spaces.images.items():
            result[key] = images[..., start : start + space.channels]
            start += space.channels
    return {key: result[key] for key in spaces.observations}


def _image_decoder(params: Params, x: jax.Array, spaces: Spaces, config: Config) -> jax.Array:
    """Features [n, F] -> [n, H, W, image channels] in [0, 1]. [NET-15] to [NET-18]"""
    height, width, channels = bottleneck(config, spaces)
    deter, stoch = x[:, : config.deter], x[:, config.deter :]

    from_deter = block_linear(deter, params["decoder/image/deter/kernel"], params["decoder/image/deter/bias"])
    from_deter = from_deter.reshape(-1, config.blocks, height, width, channels // config.blocks)  # [n, G, h0, w0, c0/G]
    # Each block has its own channels: [n, h0, w0, c0].
    from_deter = from_deter.transpose(0, 2, 3, 1, 4).reshape(-1, height, width, channels)
    hidden = dense(params, "decoder/image/stoch_hidden", stoch, config.norm_epsilon)
    from_stoch = linear(hidden, params["decoder/image/stoch/kernel"], params["decoder/image/stoch/bias"])
    y = from_deter + from_stoch.reshape(from_deter.shape)
    y = activate(y, params["decoder/image/stem/scale"], config.norm_epsilon)

    double = transposed_convolution if config.cnn_sampling == "strided" else upsampled_convolution
    for index in range(len(config.cnn_multipliers) - 1):
        name = f"decoder/image/conv{index}"
        y = double(y, params[f"{name}/kernel"], params[f"{name}/bias"])
        y = activate(y, params[f"{name}/scale"], config.norm_epsilon)
    kernel, bias = params["decoder/image/out/kernel"], params["decoder/image/out/bias"]
    y = convolution(y, kernel, bias, 1) if config.cnn_outer else double(y, kernel, bias)
    return jax.nn.sigmoid(y.astype(wide_dtype(config)))


def _feature_input(feature: jax.Array, config: Config) -> jax.Array:
    require_shape("feature", feature.shape, ..., config.feature_size)
    return feature.astype(compute_dtype(config))


def _output(params: Params, name: str, x: jax.Array, config: Config) -> jax.Array:
    """A last linear layer, in float32 or better. [NET-26]"""
    return linear(x, params[f"{name}/kernel"], params[f"{name}/bias"]).astype(wide_dtype(config))


def _head(params: Params, name: str, feature: jax.Array, layers: int, config: Config) -> jax.Array:
    hidden = mlp(params, name, _feature_input(feature, config), layers, config.norm_epsilon)
    return _output(params, f"{name}/out", hidden, config)


def reward_head(params: Params, feature: jax.Array, config: Config) -> jax.Array:
    """Features [..., F] -> logits [..., bins] of the reward. [NET-20]"""
    return _head(params, "reward", feature, config.reward_layers, config)


def continue_head(params: Params, feature: jax.Array, config: Config) -> jax.Array:
    """Features [..., F] -> one logit [...]. [NET-21]"""
    return _head(params, "continue", feature, config.continue_layers, config)[..., 0]


def critic(params: Params, feature: jax.Array, config: Config) -> jax.Array:
    """Features [..., F] -> logits [..., bins] of the value, also by the slow critic's parameters. [NET-20], [NET-23]"""
    return _head(params, "critic", feature, config.critic_layers, config)


def actor(params: Params, feature: jax.Array, spaces: Spaces, config: Config) -> dict[str, dict[str, jax.Array]]:
    """Features [..., F] -> key -> raw "logits", or raw "mean" and "std". [NET-22]"""
    hidden = mlp(params, "actor", _feature_input(feature, config), config.actor_layers, config.norm_epsilon)
    return {
        key: {
            part: _output(params, f"actor/out/{key}/{part}", hidden, config)
            for part in (("logits",) if isinstance(space, Discrete) else ("mean", "std"))
        }
        for key, space in spaces.actions.items()
    }
