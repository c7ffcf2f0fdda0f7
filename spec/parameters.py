"""The parameter table, canonical name -> shape and initializer: derived from configuration and spaces, here alone.

Names are paths: `rssm/gru/kernel`. A linear layer has `kernel` [in, out] and `bias` [out]; a block-linear layer has
`kernel` [blocks, in/blocks, out/blocks] and `bias` [out]; a convolution has `kernel` [5, 5, in, out] and `bias` [out];
a layer that is followed by RMSNorm and SiLU also has `scale` [out]. The slow critic is a copy of `critic/...` and not
in the table. Chapter: spec/10-agent.md.
"""

import dataclasses
from collections.abc import Iterator

from spec.config import Config
from spec.spaces import Discrete, Spaces

CNN_KERNEL = 5  # D-35


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One tensor of the table.

    initializer: "truncated_normal", "zeros" or "ones"; fan_in and outscale apply to the first: its standard deviation
    is outscale / sqrt(fan_in), see [LAY-9].
    """

    shape: tuple[int, ...]
    initializer: str
    fan_in: int = 1
    outscale: float = 1.0


Entries = Iterator[tuple[str, Parameter]]


def parameter_table(config: Config, spaces: Spaces) -> dict[str, Parameter]:
    """Every trained parameter of an agent, in the order of the chapters.

    Raises:
      ValueError: an image whose sides the encoder cannot halve as often as configured.
    """
    return dict(
        entry
        for part in (
            _encoder(config, spaces),
            _rssm(config, spaces, _token_size(config, spaces)),
            _decoder(config, spaces),
            _head("reward", config.reward_layers, config.bins, config.reward_outscale, config),
            _head("continue", config.continue_layers, 1, 1.0, config),
            _actor(config, spaces),
            _head("critic", config.critic_layers, config.bins, config.critic_outscale, config),
        )
        for entry in part
    )


def _linear(name: str, inputs: int, outputs: int, norm: bool = True, outscale: float = 1.0) -> Entries:
    yield f"{name}/kernel", Parameter((inputs, outputs), "truncated_normal", inputs, outscale)
    yield from _bias_and_scale(name, outputs, norm)


def _block_linear(name: str, blocks: int, inputs: int, outputs: int, norm: bool) -> Entries:
    """The fan-in counts the inputs of all blocks (D-29)."""
    yield f"{name}/kernel", Parameter((blocks, inputs // blocks, outputs // blocks), "truncated_normal", inputs)
    yield from _bias_and_scale(name, outputs, norm)


def _convolution(name: str, inputs: int, outputs: int, norm: bool = True) -> Entries:
    shape = (CNN_KERNEL, CNN_KERNEL, inputs, outputs)
    yield f"{name}/kernel", Parameter(shape, "truncated_normal", CNN_KERNEL * CNN_KERNEL * inputs)
    yield from _bias_and_scale(name, outputs, norm)


def _bias_and_scale(name: str, outputs: int, norm: bool) -> Entries:
    yield f"{name}/bias", Parameter((outputs,), "zeros")
    if norm:
        yield f"{name}/scale", Parameter((outputs,), "ones")


def _mlp(name: str, layers: int, inputs: int, units: int) -> Entries:
    for layer in range(layers):
        yield from _linear(f"{name}/hidden{layer}", inputs if layer == 0 else units, units)


def _head(name: str, layers: int, outputs: int, outscale: float, config: Config) -> Entries:
    yield from _mlp(name, layers, config.feature_size, config.units)
    yield from _linear(f"{name}/out", config.units, outputs, norm=False, outscale=outscale)


def _encoder(config: Config, spaces: Spaces) -> Entries:
    if spaces.vectors:
        inputs = sum(space.encoded_size for space in spaces.vectors.values())
        yield from _mlp("encoder/vector", config.encoder_layers, inputs, config.units)
    if spaces.images:
        inputs = spaces.image_channels
        for index, multiplier in enumerate(config.cnn_multipliers):
            outputs = multiplier * config.cnn_depth
            yield from _convolution(f"encoder/image/conv{index}", inputs, outputs)
            inputs = outputs


def _rssm(config: Config, spaces: Spaces, tokens: int) -> Entries:
    deter, units, stoch = config.deter, config.units, config.stoch * config.classes
    yield from _linear("rssm/embed_deter", deter, units)
    yield from _linear("rssm/embed_stoch", stoch, units)
    yield from _linear("rssm/embed_action", spaces.action_size, units)
    yield from _block_linear("rssm/hidden", config.blocks, deter + config.blocks * 3 * units, deter, norm=True)
    yield from _block_linear("rssm/gru", config.blocks, deter, 3 * deter, norm=False)
    yield from _mlp("rssm/posterior", config.posterior_layers, deter + tokens, units)
    yield from _linear("rssm/posterior/out", units, stoch, norm=False)
    yield from _mlp("rssm/prior", config.prior_layers, deter, units)
    yield from _linear("rssm/prior/out", units, stoch, norm=False)


def _decoder(config: Config, spaces: Spaces) -> Entries:
    if spaces.vectors:
        yield from _mlp("decoder/vector", config.decoder_layers, config.feature_size, config.units)
        for key, space in spaces.vectors.items():
            yield from _linear(f"decoder/vector/out/{key}", config.units, space.encoded_size, norm=False)
    if spaces.images:
        height, width, channels = bottleneck(config, spaces)
        pixels = height * width * channels
        yield from _block_linear("decoder/image/deter", config.blocks, config.deter, pixels, norm=False)
        yield from _linear("decoder/image/stoch_hidden", config.stoch * config.classes, 2 * config.units)
        yield from _linear("decoder/image/stoch", 2 * config.units, pixels, norm=False)
        yield "decoder/image/stem/scale", Parameter((channels,), "ones")
        for index, multiplier in enumerate(reversed(config.cnn_multipliers[:-1])):
            outputs = multiplier * config.cnn_depth
            yield from _convolution(f"decoder/image/conv{index}", channels, outputs)
            channels = outputs
        yield from _convolution("decoder/image/out", channels, spaces.image_channels, norm=False)


def _actor(config: Config, spaces: Spaces) -> Entries:
    yield from _mlp("actor", config.actor_layers, config.feature_size, config.units)
    for key, space in spaces.actions.items():
        for output in ("logits",) if isinstance(space, Discrete) else ("mean", "std"):
            name, scale = f"actor/out/{key}/{output}", config.actor_outscale
            yield from _linear(name, config.units, space.encoded_size, norm=False, outscale=scale)


def bottleneck(config: Config, spaces: Spaces) -> tuple[int, int, int]:
    """Height, width and channels of the image encoder's last feature map."""
    image = next(iter(spaces.images.values()))
    divisor = 2**config.halvings
    if image.height % divisor or image.width % divisor:
        key = next(iter(spaces.images))
        raise ValueError(
            f"image {key!r} is {image.height}x{image.width}; the encoder halves it {config.halvings} times, "
            f"so both sides must be multiples of {divisor}: resize it"
        )
    return image.height // divisor, image.width // divisor, config.cnn_multipliers[-1] * config.cnn_depth


def _token_size(config: Config, spaces: Spaces) -> int:
    tokens = config.units if spaces.vectors else 0
    if spaces.images:
        height, width, channels = bottleneck(config, spaces)
        tokens += height * width * channels
    return tokens
