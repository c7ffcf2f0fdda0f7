"""Encoder, decoder and heads. Chapter: spec/05-networks.md.

All return raw outputs; last layers in float32 or better. Parameters are the flat mapping, in any precision.
"""

import functools
from collections.abc import Mapping

import torch
import torch.nn.functional as F  # noqa: N812 (so it is called everywhere)
from torch import Tensor

from impl_torch.layers import (
    Params,
    block_linear,
    convolution,
    dense,
    linear,
    max_pool,
    mlp,
    norm_silu,
    transposed_convolution,
    upsample,
)
from impl_torch.shapes import Observations, compute_dtype, require_observations, require_shape, wide_dtype
from impl_torch.transforms import symlog
from spec import Config, Discrete, Spaces, Vector
from spec.parameters import bottleneck

Outputs = Mapping[str, Mapping[str, Tensor]]
# On the CPU this many pixels go through a convolutional network at a time: what one layer hands to the next then stays
# in the cache.
CHUNK_PIXELS = 64 * 64 * 64


def feature(deter: Tensor, stoch: Tensor) -> Tensor:
    """The model state that every head reads: [..., D], [..., S, C] -> [..., D + S*C]. [NET-1] [CON-4]"""
    require_shape("stoch", stoch.shape, *deter.shape[:-1], "S", "C")
    return torch.cat([deter, stoch.flatten(-2).to(deter.dtype)], -1)


def encoder(params: Params, observations: Observations, spaces: Spaces, config: Config) -> Tensor:
    """Raw observations {key: [..., *array_shape]} -> tokens [..., E]. [NET-2] to [NET-12] [NET-24] [NET-26] [NET-27]"""
    leading = require_observations("observations", observations, spaces)
    if spaces.images:
        bottleneck(config, spaces)  # refuses sides that cannot be halved
    tokens = []
    if spaces.vectors:
        vectors = [encode_vector(observations[key], space, config) for key, space in spaces.vectors.items()]
        x = torch.cat(vectors, -1).to(compute_dtype(config))  # [..., sum of encoded sizes]
        tokens.append(mlp(params, "encoder/vector", x, config.encoder_layers, config.norm_epsilon))  # [..., d]
    if spaces.images:
        image = torch.cat([observations[key] for key in spaces.images], -1)  # uint8 [..., H, W, channels]
        x = image.reshape(-1, *image.shape[-3:])  # still uint8: each chunk is converted in the cache
        x = _in_chunks(functools.partial(_encode_image, params, config=config), x, x.shape[1] * x.shape[2])
        tokens.append(x.view(*leading, -1))  # [..., h0*w0*c0]
    return torch.cat(tokens, -1)


def encode_vector(x: Tensor, space: Vector | Discrete, config: Config) -> Tensor:
    """The symlog of a Vector, the one-hots of a Discrete: [..., encoded_size], float32 or better. [NET-3]"""
    if isinstance(space, Vector):
        return symlog(x.to(wide_dtype(config)))
    entries = [F.one_hot(x[..., i].long(), classes) for i, classes in enumerate(space.classes)]
    return torch.cat(entries, -1).to(wide_dtype(config))


def _in_chunks(network: functools.partial[Tensor], x: Tensor, pixels: int) -> Tensor:
    """The network on N images [N, ...] at once, on the CPU on a few at a time."""
    size = max(1, CHUNK_PIXELS // pixels)
    if x.device.type != "cpu" or len(x) <= size:
        return network(x)
    return torch.cat([network(chunk) for chunk in x.split(size)])


def _encode_image(params: Params, image: Tensor, config: Config) -> Tensor:
    """[N, H, W, channels] uint8 -> [N, h0*w0*c0]. [NET-6] to [NET-10] [LAY-14]"""
    x = (image.to(wide_dtype(config)) - 127.5) / 255  # x/255 - 1/2 without the rounding of x/255
    x = x.to(compute_dtype(config))  # rounded once, here
    for index in range(len(config.cnn_multipliers)):
        name = f"encoder/image/conv{index}"
        kernel, bias, scale = params[f"{name}/kernel"], params[f"{name}/bias"], params[f"{name}/scale"]
        if index == 0 and config.cnn_outer:
            x = convolution(x, kernel, bias, 1)
        elif config.cnn_sampling == "strided":
            x = convolution(x, kernel, bias, 2)
        else:
            x = max_pool(convolution(x, kernel, bias, 1))
        x = norm_silu(x, scale, config.norm_epsilon)  # [N, h, w, c]
    return x.flatten(1)


def decoder(params: Params, feature: Tensor, spaces: Spaces, config: Config) -> dict[str, Tensor]:
    """[..., F] -> {key: [..., size] in symlog space, logits [..., sum of classes] or image [..., H, W, C] in [0, 1]}.

    [NET-13] to [NET-19] [NET-24] to [NET-27]
    """
    require_shape("feature", feature.shape, ..., config.feature_size)
    x = feature.to(compute_dtype(config))
    outputs: dict[str, Tensor] = {}
    if spaces.vectors:
        hidden = mlp(params, "decoder/vector", x, config.decoder_layers, config.norm_epsilon)
        outputs |= {key: _out(params, f"decoder/vector/out/{key}", hidden, config) for key in spaces.vectors}
    if spaces.images:
        image = next(iter(spaces.images.values()))
        network = functools.partial(_decode_image, params, spaces=spaces, config=config)
        pixels = _in_chunks(network, x.reshape(-1, x.shape[-1]), image.height * image.width)
        channels = [space.channels for space in spaces.images.values()]
        parts = pixels.view(*x.shape[:-1], *pixels.shape[1:]).split(channels, -1)  # [..., H, W, channels] each
        outputs |= dict(zip(spaces.images, parts, strict=True))
    return {key: outputs[key] for key in spaces.observations}


def _decode_image(params: Params, feature: Tensor, spaces: Spaces, config: Config) -> Tensor:
    """[N, F] -> brightness [N, H, W, channels], float32 or better. [NET-15] to [NET-18] [LAY-14]"""
    height, width, channels = bottleneck(config, spaces)
    epsilon, strided = config.norm_epsilon, config.cnn_sampling == "strided"
    deter, stoch = feature.split([config.deter, config.stoch * config.classes], -1)
    memory = block_linear(deter, params["decoder/image/deter/kernel"], params["decoder/image/deter/bias"])
    memory = memory.view(-1, config.blocks, height, width, channels // config.blocks)  # [N, G, h0, w0, c0/G]
    memory = memory.permute(0, 2, 3, 1, 4).flatten(-2)  # [N, h0, w0, c0]: each block has its own channels
    stoch = dense(params, "decoder/image/stoch_hidden", stoch, epsilon)
    stoch = linear(stoch, params["decoder/image/stoch/kernel"], params["decoder/image/stoch/bias"])  # [N, h0*w0*c0]
    x = norm_silu(memory + stoch.view_as(memory), params["decoder/image/stem/scale"], epsilon)

    def double(x: Tensor, name: str) -> Tensor:
        kernel, bias = params[f"{name}/kernel"], params[f"{name}/bias"]
        return transposed_convolution(x, kernel, bias) if strided else convolution(upsample(x), kernel, bias, 1)

    for index in range(len(config.cnn_multipliers) - 1):
        name = f"decoder/image/conv{index}"
        x = norm_silu(double(x, name), params[f"{name}/scale"], epsilon)
    name = "decoder/image/out"
    x = convolution(x, params[f"{name}/kernel"], params[f"{name}/bias"], 1) if config.cnn_outer else double(x, name)
    return torch.sigmoid(x.to(wide_dtype(config)))


def _out(params: Params, name: str, x: Tensor, config: Config) -> Tensor:
    return linear(x, params[f"{name}/kernel"], params[f"{name}/bias"]).to(wide_dtype(config))


def _hidden(params: Params, name: str, feature: Tensor, layers: int, config: Config) -> Tensor:
    require_shape("feature", feature.shape, ..., config.feature_size)
    return mlp(params, name, feature.to(compute_dtype(config)), layers, config.norm_epsilon)


def reward_head(params: Params, feature: Tensor, config: Config) -> Tensor:
    """Logits over the bins: [..., F] -> [..., bins]. [NET-20] [NET-26]"""
    return _out(params, "reward/out", _hidden(params, "reward", feature, config.reward_layers, config), config)


def continue_head(params: Params, feature: Tensor, config: Config) -> Tensor:
    """Logit of going on: [..., F] -> [...]. [NET-21] [NET-26]"""
    hidden = _hidden(params, "continue", feature, config.continue_layers, config)
    return _out(params, "continue/out", hidden, config).squeeze(-1)


def critic(params: Params, feature: Tensor, config: Config) -> Tensor:
    """Logits over the bins, from the critic or the slow critic: [..., F] -> [..., bins]. [NET-20] [NET-23] [NET-26]"""
    return _out(params, "critic/out", _hidden(params, "critic", feature, config.critic_layers, config), config)


def actor(params: Params, feature: Tensor, spaces: Spaces, config: Config) -> dict[str, dict[str, Tensor]]:
    """Raw outputs: [..., F] -> {key: {"logits": [..., sum of classes]} or {"mean", "std": [..., size]}}. [NET-22]"""
    x = _hidden(params, "actor", feature, config.actor_layers, config)
    return {
        key: {
            output: _out(params, f"actor/out/{key}/{output}", x, config)
            for output in (("logits",) if isinstance(space, Discrete) else ("mean", "std"))
        }
        for key, space in spaces.actions.items()
    }
