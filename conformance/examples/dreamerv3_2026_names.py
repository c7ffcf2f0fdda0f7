"""Configuration, keys and parameters of `dreamerv3_2026_adapter` in the words of the authors' code.

Their modules keep their parameters in a flat mapping, too. The numbers are the same but for four conventions: their
decoder of vectors reads the latents first, their transposed convolution has the kernel turned around, all entries of a
discrete observation or action have equally many classes there, so that entries that differ become keys of their own,
and keys hold letters and digits, so that they are numbered here.
"""

import re
from collections import namedtuple
from pathlib import Path

import elements
import jax.numpy as jnp
import numpy as np
import ruamel.yaml
from dreamerv3 import agent

DEFAULTS = elements.Config(
    ruamel.yaml.YAML(typ="safe").load(Path(agent.__file__).with_name("configs.yaml"))["defaults"]["agent"]
).flat


def settings(config):
    """Their configuration of an agent."""
    if config.actor_unimix:
        raise NotImplementedError("a uniform mixture in the actor")
    if config.start_continue != "predicted":
        raise NotImplementedError("the true continue flag of the start")
    if config.vector_loss_scale != 1:
        raise NotImplementedError("a scale for the squared errors of vectors")
    return elements.Config(DEFAULTS | {key: value for part in PARTS for key, value in part(config).items()})


def of_world_model(config):
    model = {"deter": config.deter, "hidden": config.units, "stoch": config.stoch, "classes": config.classes}
    model |= {"unimix": config.latent_unimix, "blocks": config.blocks, "free_nats": config.free_nats}
    model |= {"imglayers": config.prior_layers, "obslayers": config.posterior_layers}
    images = {"depth": config.cnn_depth, "mults": config.cnn_multipliers, "units": config.units}
    images |= {"outer": config.cnn_outer, "strided": config.cnn_sampling == "strided"}
    encoder, decoder = {"layers": config.encoder_layers}, {"layers": config.decoder_layers, "bspace": config.blocks}
    groups = {"dyn.rssm": model, "enc.simple": images | encoder, "dec.simple": images | decoder}
    return {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}


def of_heads(config):
    twohot = {"units": config.units, "bins": config.bins}
    groups = {
        "rewhead": twohot | {"layers": config.reward_layers, "outscale": config.reward_outscale},
        "conhead": {"units": config.units, "layers": config.continue_layers},
        "value": twohot | {"layers": config.critic_layers, "outscale": config.critic_outscale},
        "policy": {"units": config.units, "layers": config.actor_layers, "outscale": config.actor_outscale}
        | {"minstd": config.actor_min_std, "maxstd": config.actor_max_std},
    }
    return {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}


def of_behavior(config):
    range_ = {"rate": 1 - config.return_decay, "limit": config.return_limit}
    range_ |= {"perclo": config.return_percentile_low, "perchi": config.return_percentile_high}
    scales = {"rec": config.reconstruction_scale, "rew": config.reward_scale, "con": config.continue_scale}
    scales |= {"dyn": config.dynamics_scale, "rep": config.representation_scale, "policy": config.actor_scale}
    scales |= {"value": config.critic_scale, "repval": config.replay_critic_scale}
    losses = {"lam": config.return_lambda, "slowreg": config.slow_critic_scale}
    groups = {"retnorm": range_, "loss_scales": scales, "repl_loss": losses}
    groups |= {"imag_loss": losses | {"actent": config.entropy_scale}, "slowvalue": {"rate": 1.0}}
    named = {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}
    named |= {"imag_length": config.imagination_horizon, "horizon": config.discount_horizon, "replay_context": 1}
    return named | {"contdisc": config.continue_target == "discounted"}


PARTS = (of_world_model, of_heads, of_behavior)

# A key of theirs: the key of the kit that it is a part of, its space, and its places among the encoded numbers and
# among the entries of that key.
Part = namedtuple("Part", "key space encoded entries")


def parts(spaces):
    """Their keys, in the same order as the kit's."""
    found = {}
    for index, (key, space) in enumerate(sorted(spaces.items())):
        name = f"key{index:02}"
        if hasattr(space, "channels"):
            own = elements.Space(np.uint8, (space.height, space.width, space.channels))
            found[name] = Part(key, own, slice(None), slice(None))
        elif not hasattr(space, "classes"):
            found[name] = Part(key, elements.Space(np.float32, (space.size,)), slice(None), slice(None))
        elif len(set(space.classes)) == 1:
            own = elements.Space(np.int32, (len(space.classes),), 0, space.classes[0])
            found[name] = Part(key, own, slice(None), slice(None))
        else:
            for entry, classes in enumerate(space.classes):
                first = sum(space.classes[:entry])
                own = elements.Space(np.int32, (1,), 0, classes)
                found[f"{name}_{entry:02}"] = Part(key, own, slice(first, first + classes), slice(entry, entry + 1))
    return found


def spaces_of(spaces):
    return {name: part.space for name, part in parts(spaces).items()}


def placed(actions):
    """Their keys of actions, with their places in a flat action."""
    start = 0
    for name, part in parts(actions).items():
        width = int(np.prod(part.space.shape)) * (classes_of(part.space) if part.space.discrete else 1)
        yield name, part, slice(start, start + width)
        start += width


def classes_of(space):
    return int(np.max(space.classes))


def outputs_of(space):
    """What the actor puts out for an action."""
    return ("logits",) if hasattr(space, "classes") else ("mean", "std")


def is_image(space):
    return len(space.shape) == 3


def observation_of(observation, spaces):
    """Their observation."""
    return {
        name: observation[part.key] if is_image(part.space) else observation[part.key][..., part.entries]
        for name, part in parts(spaces).items()
    }


def joined(values, spaces):
    """Of arrays by their keys those by the kit's."""
    groups = {}
    for name, part in parts(spaces).items():
        groups.setdefault(part.key, []).append(values[name])
    return {key: jnp.concatenate(arrays, -1) for key, arrays in groups.items()}


# parameters

KINDS = ("kernel", "bias", "scale")
NUMBER = r"(\d+)"
HEADS = {"reward": "rew", "continue": "con", "critic": "val", "actor": "pol"}
LAYERS = {
    f"encoder/vector/hidden{NUMBER}": r"enc/mlp\1",
    f"encoder/image/conv{NUMBER}": r"enc/cnn\1",
    **{f"rssm/embed_{name}": f"dyn/dynin{index}" for index, name in enumerate(("deter", "stoch", "action"))},
    **{"rssm/hidden": "dyn/dynhid0", "rssm/gru": "dyn/dyngru"},
    **{f"rssm/posterior/hidden{NUMBER}": r"dyn/obs\1", "rssm/posterior/out": "dyn/obslogit"},
    **{f"rssm/prior/hidden{NUMBER}": r"dyn/prior\1", "rssm/prior/out": "dyn/priorlogit"},
    f"decoder/vector/hidden{NUMBER}": r"dec/mlp/linear\1",
    **{"decoder/image/deter": "dec/sp0", "decoder/image/stoch_hidden": "dec/sp1", "decoder/image/stoch": "dec/sp2"},
    **{"decoder/image/stem": "dec/sp", "decoder/image/out": "dec/imgout"},
    **{f"{name}/hidden{NUMBER}": rf"{own}/mlp/linear\1" for name, own in HEADS.items()},
    **{f"{name}/out": f"{HEADS[name]}/head/logits" for name in ("reward", "critic")},
    "continue/out": "con/head/logit",
}
OUTPUTS = {"mean": "mean", "std": "stddev", "logits": "logits"}


def theirs(params, config, spaces=None):
    """The parameters under their names and in their layouts. spaces: of keys that have outputs of their own."""
    named = {}
    for name, value in params.items():
        layer, _, kind = name.rpartition("/")
        value = in_their_layout(name, value, config)
        for path, own in paths_of(layer, config, spaces):
            named[of_kind(path, kind)] = value[..., own]
    return named


def of_kind(path, kind):
    """Their norms are layers of their own."""
    if kind == "scale":
        path = path.replace("/linear", "/norm") if "/mlp/linear" in path else f"{path}norm"
    return f"{path}/{kind}"


def paths_of(layer, config, spaces):
    """Their layers that hold a layer, and which of its outputs each has."""
    group, out, rest = layer.partition("/out/")
    if out:
        key, _, output = rest.partition("/")
        own = parts(spaces.actions if group == "actor" else spaces.observations)
        prefix = "pol/head" if group == "actor" else "dec/vec"
        for name, part in own.items():
            if part.key == key:
                last = OUTPUTS[output] if output else "logits" if part.space.discrete else "pred"
                yield f"{prefix}/{name}/{last}", part.encoded
    elif found := re.fullmatch(f"decoder/image/conv{NUMBER}", layer):
        yield f"dec/conv{len(config.cnn_multipliers) - 2 - int(found.group(1))}", slice(None)
    else:
        (pattern,) = (pattern for pattern in LAYERS if re.fullmatch(pattern, layer))
        yield re.sub(pattern, LAYERS[pattern], layer), slice(None)


def in_their_layout(name, value, config, back=False):
    if name == "decoder/vector/hidden0/kernel":
        first = len(value) - config.deter if back else config.deter
        return jnp.concatenate([value[first:], value[:first]])
    transposed = re.fullmatch(f"decoder/image/(conv{NUMBER}{'' if config.cnn_outer else '|out'})/kernel", name)
    return value[::-1, ::-1] if transposed and config.cnn_sampling == "strided" else value


def ours(named, config, spaces):
    """The inverse of `theirs`."""
    params = {}
    for layer in layers_of(config, spaces):
        paths = [path for path, _ in paths_of(layer, config, spaces)]
        for kind in KINDS:
            found = [named[own] for path in paths if (own := of_kind(path, kind)) in named]
            if found:
                name = f"{layer}/{kind}"
                params[name] = in_their_layout(name, jnp.concatenate(found, -1), config, back=True)
    return params


def layers_of(config, spaces):
    """The names of all layers."""
    vectors = [key for key, space in spaces.observations.items() if not hasattr(space, "channels")]
    images = len(vectors) < len(spaces.observations)
    for name in HEADS:
        yield from hidden(name, getattr(config, f"{name}_layers"))
    yield from ("reward/out", "continue/out", "critic/out")
    for key, space in spaces.actions.items():
        yield from (f"actor/out/{key}/{name}" for name in outputs_of(space))
    yield from (name for name in LAYERS if name.startswith("rssm/") and NUMBER not in name)
    yield from (*hidden("rssm/posterior", config.posterior_layers), *hidden("rssm/prior", config.prior_layers))
    if vectors:
        yield from hidden("encoder/vector", config.encoder_layers)
        yield from hidden("decoder/vector", config.decoder_layers)
        yield from (f"decoder/vector/out/{key}" for key in vectors)
    if images:
        stages = len(config.cnn_multipliers)
        yield from (f"encoder/image/conv{index}" for index in range(stages))
        yield from (f"decoder/image/conv{index}" for index in range(stages - 1))
        yield from (name for name in LAYERS if name.startswith("decoder/image/"))


def hidden(name, layers):
    return [f"{name}/hidden{index}" for index in range(layers)]


def flat(x, axes):
    """With one leading axis in place of any number; `axes` do not lead."""
    return x.reshape(-1, *x.shape[x.ndim - axes :])
