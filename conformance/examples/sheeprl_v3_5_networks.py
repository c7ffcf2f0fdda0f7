"""What `sheeprl_v3_5_adapter` offers of layers, encoder and decoder, with the given numbers as the parameters of
sheeprl's modules.

Their encoder pools and has no stage at full resolution. Images are channels first there, latents come with the
stochastic part first, and discrete observations, which they do not have, enter beside the symlog of the vectors, in
their encoder without symlog.
"""

import torch
from sheeprl.algos.dreamer_v3_5 import agent
from sheeprl.utils.utils import symlog
from torch.func import functional_call

__all__ = [
    "block_linear",
    "decoder",
    "dense_of",
    "encoder",
    "fill",
    "linear",
    "max_pool",
    "mlp_of",
    "out_of",
    "rms_norm",
    "upsample",
]


def fill(module, tensors):
    """The module with these tensors as its parameters, in their order."""
    with torch.no_grad():
        for parameter, tensor in zip(module.parameters(), tensors, strict=True):
            assert parameter.shape == tensor.shape, (parameter.shape, tensor.shape)
            parameter.copy_(tensor)
    return module


def dense_of(params, *names):
    return [x for name in names for x in (params[f"{name}/kernel"].mT, params[f"{name}/bias"], params[f"{name}/scale"])]


def mlp_of(params, name, layers):
    return dense_of(params, *(f"{name}/hidden{i}" for i in range(layers)))


def out_of(params, name):
    return [params[f"{name}/kernel"].mT, params[f"{name}/bias"]]


def convolution_of(params, name):
    """Kernel [5, 5, in, out] as theirs, and the bias."""
    return [params[f"{name}/kernel"].permute(3, 2, 0, 1), params[f"{name}/bias"]]


def linear(x, kernel, bias):
    return fill(agent.Linear(*kernel.shape), (kernel.mT, bias))(x)


def block_linear(x, kernel, bias):
    blocks, inputs, outputs = kernel.shape
    return fill(agent.BlockLinear(blocks * inputs, blocks * outputs, blocks), (kernel, bias))(x)


def rms_norm(x, scale, epsilon):
    """With the scale itself in place of the parameter, so that its gradient is seen."""
    return functional_call(agent.RMSNorm(len(scale), epsilon), {"weight": scale}, x)


def max_pool(x):
    return of_images(agent.MaxPool(), x)


def upsample(x):
    return of_images(agent.Upsample(), x)


def of_images(module, x):
    y = module(x.reshape(-1, *x.shape[-3:]).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    return y.reshape(*x.shape[:-3], *y.shape[1:])


def split(spaces):
    """The observations that are vectors or discrete, and those that are images, in the order of their names."""
    images = {key: space for key, space in sorted(spaces.observations.items()) if hasattr(space, "channels")}
    if len({(space.height, space.width) for space in images.values()}) > 1:
        raise NotImplementedError("images of different sizes")
    return {key: space for key, space in sorted(spaces.observations.items()) if key not in images}, images


def require_pooling(config):
    if config.cnn_sampling != "pooled":
        raise NotImplementedError("strided convolutions")
    if config.cnn_outer:
        raise NotImplementedError("a stage at full resolution")


def encoder(params, observation, spaces, config):
    vectors, images = split(spaces)
    parts = []
    if vectors:
        inputs = {key: vector_input(observation[key], space) for key, space in vectors.items()}
        widths = [x.shape[-1] for x in inputs.values()]
        network = agent.MLPEncoder(
            list(vectors), widths, config.encoder_layers, config.units, eps=config.norm_epsilon, symlog_inputs=False
        )
        parts.append(fill(network, mlp_of(params, "encoder/vector", config.encoder_layers))(inputs))
    if images:
        require_pooling(config)
        first = next(iter(images.values()))
        channels, size = [space.channels for space in images.values()], (first.height, first.width)
        stages = config.cnn_multipliers
        network = agent.CNNEncoder(list(images), channels, size, config.cnn_depth, stages, eps=config.norm_epsilon)
        names = [f"encoder/image/conv{index}" for index in range(len(stages))]
        fill(network, [x for name in names for x in (*convolution_of(params, name), params[f"{name}/scale"])])
        tokens = network({key: (observation[key].float() / 255 - 0.5).movedim(-1, -3) for key in images})
        maps = tokens.unflatten(-1, (-1, size[0] >> len(stages), size[1] >> len(stages)))
        parts.append(maps.movedim(-3, -1).flatten(-3))
    return torch.cat(parts, -1)


def vector_input(x, space):
    if not hasattr(space, "classes"):
        return symlog(x)
    if x.is_floating_point():
        raise ValueError("discrete observations are whole numbers")
    hots = (
        torch.nn.functional.one_hot(entry.long(), count)
        for entry, count in zip(x.unbind(-1), space.classes, strict=True)
    )
    return torch.cat([hot.float() for hot in hots], -1)


def decoder(params, feature, spaces, config):
    vectors, images = split(spaces)
    flat = config.stoch * config.classes
    latent = torch.cat([feature[..., config.deter :], feature[..., : config.deter]], -1)
    decoded = {}
    if vectors:
        widths = [sum(space.classes) if hasattr(space, "classes") else space.size for space in vectors.values()]
        network = agent.MLPDecoder(
            list(vectors), widths, config.feature_size, config.decoder_layers, config.units, eps=config.norm_epsilon
        )
        heads = [x for key in vectors for x in out_of(params, f"decoder/vector/out/{key}")]
        decoded |= fill(network, mlp_of(params, "decoder/vector", config.decoder_layers) + heads)(feature)
    if images:
        require_pooling(config)
        first = next(iter(images.values()))
        channels, size = [space.channels for space in images.values()], (first.height, first.width)
        stages, blocks = config.cnn_multipliers, config.blocks
        network = agent.CNNDecoder(
            list(images), channels, config.cnn_depth, flat, config.deter, size, stages,
            block_space=blocks, dense_units=config.units, eps=config.norm_epsilon,
        )  # fmt: skip
        names = [f"decoder/image/conv{index}" for index in range(len(stages) - 1)]
        stages_of = [x for name in names for x in (*convolution_of(params, name), params[f"{name}/scale"])]
        stem = [*projections_of(params, network.initial_shape, blocks), params["decoder/image/stem/scale"]]
        fill(network, [*stem, *stages_of, *convolution_of(params, "decoder/image/out")])
        decoded |= {key: image.movedim(-3, -1) for key, image in network(latent).items()}
    return decoded


def projections_of(params, shape, blocks):
    """The layers from latents to the first feature maps [channels, height, width], whose outputs are in another order
    there."""
    channels, height, width = shape

    def of_blocks(x):
        return x.unflatten(-1, (height, width, channels // blocks)).movedim(-1, -3).flatten(-3)

    def of_all(x):
        return x.unflatten(-1, (height, width, channels)).movedim(-1, -3).flatten(-3)

    deter, stoch = (
        [params[f"decoder/image/{name}/{part}"] for part in ("kernel", "bias")] for name in ("deter", "stoch")
    )
    memory = [of_blocks(deter[0]), of_blocks(deter[1].unflatten(-1, (blocks, -1))).flatten()]
    return [*memory, *dense_of(params, "decoder/image/stoch_hidden"), of_all(stoch[0]).mT, of_all(stoch[1])]
