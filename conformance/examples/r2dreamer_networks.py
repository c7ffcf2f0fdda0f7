"""The networks of r2dreamer: their options, their inputs and outputs, and our parameters in the order of theirs.

Their agent has one action and no discrete observations. Here, an actor of several keys is made of their heads;
discrete observations enter as the numbers of which their symlog makes ones, and are decoded by their one-hot
distribution. Images enter as theirs do, by `preprocess`, under whatever name.
"""

import itertools
from types import SimpleNamespace as Namespace

import distributions
import dreamer
import networks
import torch
from torch import nn


class Options(dict):
    """A part of a configuration of theirs."""

    __getattr__ = dict.__getitem__
    __setattr__ = dict.__setitem__


def require_theirs(spaces, config):
    """Raises NotImplementedError for a choice that their image networks do not have."""
    if split(spaces)[1] and config.cnn_sampling != "pooled":
        raise NotImplementedError("strided convolutions")
    if split(spaces)[1] and config.cnn_outer:
        raise NotImplementedError("a stage at full resolution")


def mlp_options(name, layers, config, **options):
    return Options(
        name=name, layers=layers, units=config.units, act="SiLU", norm=True, device="cpu",
        **{"shape": None, "outscale": 1.0, "symlog_inputs": False, **options},
    )  # fmt: skip


def rssm_options(config):
    return Options(
        stoch=config.stoch, deter=config.deter, hidden=config.units, discrete=config.classes, act="SiLU",
        unimix_ratio=config.latent_unimix, initial="learned", device="cpu", obs_layers=config.posterior_layers,
        img_layers=config.prior_layers, dyn_layers=1, blocks=config.blocks,
    )  # fmt: skip


def encoder_options(config):
    cnn = Options(act="SiLU", norm=True, kernel_size=5, depth=config.cnn_depth, mults=config.cnn_multipliers)
    mlp = mlp_options("encoder", config.encoder_layers, config, symlog_inputs=True)
    return Options(mlp_keys=".", cnn_keys=".", cnn=cnn, mlp=mlp)


def decoder_options(config):
    outputs = Options(name="identity")
    cnn = Options(encoder_options(config).cnn, bspace=config.blocks, units=config.units)
    mlp = mlp_options("decoder", config.decoder_layers, config, dist=outputs)
    return Options(mlp_keys=".", cnn_keys=".", cnn=cnn, mlp=mlp, cnn_dist=outputs, mlp_dist=outputs)


def with_epsilon(module, config):
    """Their norms have an epsilon of 1e-4, which is no option."""
    for part in module.modules():
        if isinstance(part, nn.RMSNorm):
            part.eps = config.norm_epsilon
    return module


# observations


def is_image(space):
    return hasattr(space, "channels")


def shapes_of(spaces):
    """Key -> shape, as their networks ask for it."""
    return {
        key: (space.height, space.width, space.channels) if is_image(space) else (encoded_size(space),)
        for key, space in sorted(spaces.observations.items())
    }


def encoded_size(space):
    return sum(space.classes) if hasattr(space, "classes") else space.size


def split(spaces):
    """The keys of vectors and discrete observations, and those of images."""
    keys = sorted(spaces.observations)
    return [key for key in keys if not is_image(spaces.observations[key])], [
        key for key in keys if is_image(spaces.observations[key])
    ]


def encoded(observation, spaces):
    return {key: encoded_one(observation[key], space) for key, space in spaces.observations.items()}


def encoded_one(x, space):
    if is_image(space):
        return dreamer.Dreamer.preprocess(None, {"image": x})["image"]
    if hasattr(space, "classes"):
        pairs = zip(x.unbind(-1), space.classes, strict=True)
        if x.is_floating_point():
            raise ValueError("discrete observations are whole numbers")
        hots = torch.cat([nn.functional.one_hot(entry.long(), count) for entry, count in pairs], -1)
        return distributions.symexp(hots.float())
    return x.float()


def decoded(output, space):
    """The distribution of an observation, given what the decoder's last layer says of it."""
    if is_image(space):
        return distributions.mse(output)
    if hasattr(space, "classes"):
        hots = distributions.multi_onehot(output, 0.0, tuple(space.classes))
        return Namespace(log_prob=lambda x: hots.log_prob(distributions.symlog(x)))
    return distributions.symlog_mse(output)


class Decoder(networks.MultiDecoder):
    def __init__(self, spaces, *arguments):
        super().__init__(*arguments)
        self.spaces = spaces

    def forward(self, stoch, deter):
        outputs = super().forward(stoch, deter)
        return {key: decoded(output, self.spaces.observations[key]) for key, output in outputs.items()}


# actions


def policy_of(output, space, config):
    """The distribution of the actions of one key, given what its last layer says."""
    if hasattr(space, "classes"):
        return distributions.multi_onehot(output, config.actor_unimix, tuple(space.classes))
    return distributions.bounded_normal(output, config.actor_min_std, config.actor_max_std)


def actor_head(space, config, inputs):
    if hasattr(space, "classes"):
        shape, dist = tuple(space.classes), Options(name="multi_onehot", unimix_ratio=config.actor_unimix)
    else:
        bounds = {"min_std": config.actor_min_std, "max_std": config.actor_max_std}
        shape, dist = (space.size,), Options(name="bounded_normal", **bounds)
    options = mlp_options("actor", config.actor_layers, config, shape=shape, outscale=config.actor_outscale, dist=dist)
    return networks.MLPHead(options, inputs)


class Actor(nn.Module):
    """A head of theirs for each key, all on the same hidden layers."""

    def __init__(self, spaces, config, inputs):
        super().__init__()
        self.sizes = [encoded_size(space) for _, space in sorted(spaces.actions.items())]
        self.heads = nn.ModuleList(actor_head(space, config, inputs) for _, space in sorted(spaces.actions.items()))
        for head in self.heads[1:]:
            head.mlp = self.heads[0].mlp

    def forward(self, features):
        policies = [head(features) for head in self.heads]
        return Namespace(
            log_prob=lambda action: sum(
                policy.log_prob(part) for policy, part in zip(policies, action.split(self.sizes, -1), strict=True)
            ),
            entropy=lambda: sum(policy.entropy() for policy in policies),
        )


# parameters: ours, in the shapes and the order of theirs


def table_of(spaces, config):
    """Our name -> shape, of every parameter."""
    (vectors, images), units, flat = split(spaces), config.units, config.stoch * config.classes
    deter, blocks, feature = config.deter, config.blocks, config.deter + flat
    sizes = {key: encoded_size(spaces.observations[key]) for key in vectors}
    shapes, tokens = {}, units if vectors else 0

    def linear(name, *shape, scale=True):
        outputs = shape[-1] if len(shape) in (2, 4) else shape[0] * shape[-1]
        shapes.update(
            {f"{name}/kernel": shape, f"{name}/bias": (outputs,)} | ({f"{name}/scale": (outputs,)} if scale else {})
        )

    def head(name, inputs, layers, **outputs):
        for layer in range(layers):
            linear(f"{name}/hidden{layer}", units if layer else inputs, units)
        for out, size in outputs.items():
            linear(f"{name}/{out}", units, size, scale=False)

    if vectors:
        head("encoder/vector", sum(sizes.values()), config.encoder_layers)
        head("decoder/vector", feature, config.decoder_layers, **{f"out/{key}": size for key, size in sizes.items()})
    if images:
        first, depths = spaces.observations[images[0]], [config.cnn_depth * m for m in config.cnn_multipliers]
        pixels = (first.height >> len(depths)) * (first.width >> len(depths)) * depths[-1]
        channels = sum(spaces.observations[key].channels for key in images)
        tokens += pixels
        for index, (inputs, outputs) in enumerate(zip([channels, *depths[:-1]], depths, strict=True)):
            linear(f"encoder/image/conv{index}", 5, 5, inputs, outputs)
        for index, (inputs, outputs) in enumerate(itertools.pairwise(reversed(depths))):
            linear(f"decoder/image/conv{index}", 5, 5, inputs, outputs)
        linear("decoder/image/out", 5, 5, depths[0], channels, scale=False)
        linear("decoder/image/deter", blocks, deter // blocks, pixels // blocks, scale=False)
        linear("decoder/image/stoch_hidden", flat, 2 * units)
        linear("decoder/image/stoch", 2 * units, pixels, scale=False)
        shapes["decoder/image/stem/scale"] = (depths[-1],)
    for name, inputs in (("deter", deter), ("stoch", flat)):
        linear(f"rssm/embed_{name}", inputs, units)
    linear("rssm/embed_action", sum(encoded_size(space) for space in spaces.actions.values()), units)
    linear("rssm/hidden", blocks, deter // blocks + 3 * units, deter // blocks)
    linear("rssm/gru", blocks, deter // blocks, 3 * deter // blocks, scale=False)
    head("rssm/posterior", deter + tokens, config.posterior_layers, out=flat)
    head("rssm/prior", deter, config.prior_layers, out=flat)
    head("reward", feature, config.reward_layers, out=config.bins)
    head("continue", feature, config.continue_layers, out=1)
    head("critic", feature, config.critic_layers, out=config.bins)
    policies = {
        f"out/{key}/{part}": encoded_size(space)
        for key, space in spaces.actions.items()
        for part in (("logits",) if hasattr(space, "classes") else ("mean", "std"))
    }
    head("actor", feature, config.actor_layers, **policies)
    return shapes


def dense_of(params, *names):
    return [x for name in names for x in (params[f"{name}/kernel"].mT, params[f"{name}/bias"], params[f"{name}/scale"])]


def mlp_of(params, name, layers, rows=lambda kernel: kernel):
    first = {**params, f"{name}/hidden0/kernel": rows(params[f"{name}/hidden0/kernel"])}
    return dense_of(first, *(f"{name}/hidden{i}" for i in range(layers)))


def out_of(params, *names):
    """The last layers of these names as one."""
    return [
        torch.cat([params[f"{name}/kernel"] for name in names], -1).mT,
        torch.cat([params[f"{name}/bias"] for name in names]),
    ]


def block_of(params, name):
    return [params[f"{name}/kernel"].permute(2, 1, 0), params[f"{name}/bias"]]


def convolution_of(params, name):
    return [params[f"{name}/kernel"].permute(3, 2, 0, 1), params[f"{name}/bias"]]


def stages_of(params, name, stages):
    names = [f"{name}/conv{index}" for index in range(stages)]
    return [x for stage in names for x in (*convolution_of(params, stage), params[f"{stage}/scale"])]


def core_of(params):
    embeddings = dense_of(params, "rssm/embed_deter", "rssm/embed_stoch", "rssm/embed_action")
    return [*embeddings, *block_of(params, "rssm/hidden"), params["rssm/hidden/scale"], *block_of(params, "rssm/gru")]


def rssm_of(params, config, rows=lambda kernel: kernel):
    """rows: of the posterior's first layer, in the order of their tokens."""
    prior = mlp_of(params, "rssm/prior", config.prior_layers) + out_of(params, "rssm/prior/out")
    posterior = mlp_of(params, "rssm/posterior", config.posterior_layers, rows) + out_of(params, "rssm/posterior/out")
    return [*core_of(params), *posterior, *prior]


def encoder_of(params, spaces, config):
    vectors, images = split(spaces)
    image = stages_of(params, "encoder/image", len(config.cnn_multipliers)) if images else []
    return [*image, *(mlp_of(params, "encoder/vector", config.encoder_layers) if vectors else [])]


def decoder_of(params, spaces, config, rows=lambda kernel: kernel):
    vectors, images = split(spaces)
    tensors = []
    if images:
        name = "decoder/image"
        tensors += [*block_of(params, f"{name}/deter"), *dense_of(params, f"{name}/stoch_hidden")]
        tensors += [*out_of(params, f"{name}/stoch"), params[f"{name}/stem/scale"]]
        tensors += stages_of(params, name, len(config.cnn_multipliers) - 1) + convolution_of(params, f"{name}/out")
    if vectors:
        tensors += mlp_of(params, "decoder/vector", config.decoder_layers, rows)
        tensors += out_of(params, *(f"decoder/vector/out/{key}" for key in vectors))
    return tensors


def actor_of(params, spaces, config, rows=lambda kernel: kernel):
    first, *others = (actor_out_of(params, key, space) for key, space in sorted(spaces.actions.items()))
    return mlp_of(params, "actor", config.actor_layers, rows) + first + [x for out in others for x in out]


def actor_out_of(params, key, space):
    outputs = ("logits",) if hasattr(space, "classes") else ("mean", "std")
    return out_of(params, *(f"actor/out/{key}/{output}" for output in outputs))


def head_of(params, name, layers, rows=lambda kernel: kernel):
    return mlp_of(params, name, layers, rows) + out_of(params, f"{name}/out")


def token_rows(spaces, config):
    """Their tokens begin with the image, whose feature maps are channels first."""
    vectors, images = split(spaces)

    def rows(kernel):
        ends = config.deter, config.deter + bool(vectors) * config.units
        memory, vector, image = kernel.tensor_split(ends)
        if images:
            space, halvings = spaces.observations[images[0]], len(config.cnn_multipliers)
            maps = image.unflatten(0, (space.height >> halvings, space.width >> halvings, -1))
            image = maps.permute(2, 0, 1, 3).flatten(0, 2)
        return torch.cat([memory, image, vector])

    return rows
