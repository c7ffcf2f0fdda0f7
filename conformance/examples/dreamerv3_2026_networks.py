"""What `dreamerv3_2026_adapter` offers of layers, recurrent model and networks: the authors' modules, with the given
numbers as their parameters."""

from functools import partial
from unittest import mock

import elements
import jax.numpy as jnp
import ninjax as nj
import numpy as np
from dreamerv3 import rssm
from dreamerv3_2026_names import (
    DEFAULTS,
    HEADS,
    KINDS,
    flat,
    is_image,
    joined,
    observation_of,
    of_heads,
    of_world_model,
    outputs_of,
    spaces_of,
    theirs,
)
from embodied.jax import heads, nets

SCALAR, BINARY = elements.Space(np.float32, ()), elements.Space(bool, (), 0, 2)  # as their agent makes them


def setup(dtype):
    if dtype == "float64":
        raise ValueError("their losses are float32: --dtype float32 or bfloat16")
    nets.COMPUTE_DTYPE = getattr(jnp, dtype)


def run(function, params, *arguments, **options):
    """The result of a function of theirs, whose modules find these parameters, and have this epsilon in their norms."""
    return run_on(function, params, *arguments, **options)[1]


def run_on(function, state, *arguments, epsilon=1e-4):
    """The state after that and the result."""
    with mock.patch.object(nets, "Norm", partial(nets.Norm, eps=epsilon)):
        return nj.pure(function)(state, *arguments, seed=0)


# layers


def layer(module, x, **params):
    return run(module, {f"layer/{name}": value for name, value in params.items()}, nets.cast(x))


def linear(x, kernel, bias):
    return layer(nets.Linear(kernel.shape[-1], name="layer"), x, kernel=kernel, bias=bias)


def block_linear(x, kernel, bias):
    blocks, _, outputs = kernel.shape
    return layer(nets.BlockLinear(blocks * outputs, blocks, name="layer"), x, kernel=kernel, bias=bias)


def rms_norm(x, scale, epsilon):
    return layer(nets.Norm("rms", eps=epsilon, name="layer"), x, scale=scale)


def silu(x):
    return nets.act("silu")(nets.cast(x))


def convolution(x, kernel, bias, stride):
    return of_images(nets.Conv2D(kernel.shape[-1], 5, stride, name="layer"), x, kernel, bias)


def transposed_convolution(x, kernel, bias):
    module = nets.Conv2D(kernel.shape[-1], 5, 2, transp=True, name="layer")
    return of_images(module, x, kernel[::-1, ::-1], bias)


def of_images(module, x, kernel, bias):
    y = layer(module, flat(x, 3), kernel=kernel, bias=bias)
    return y.reshape(*x.shape[:-3], *y.shape[1:])


def dense(params, name, x, epsilon):
    kernel, bias, scale = (params[f"{name}/{kind}"] for kind in KINDS)
    own = {"mlp/linear0/kernel": kernel, "mlp/linear0/bias": bias, "mlp/norm0/scale": scale}
    return run(nets.MLP(1, kernel.shape[-1], name="mlp"), own, x, epsilon=epsilon)


def mlp(params, name, x, layers, epsilon):
    for index in range(layers):
        x = dense(params, f"{name}/hidden{index}", x, epsilon)
    return x


# recurrent model


def rssm_of(config, actions):
    """Their recurrent model for flat actions, which are one vector to it. It is the one of their agent, but for
    that."""
    space = {"action": elements.Space(np.float32, (actions,))}
    return rssm.RSSM(space, **elements.Config(DEFAULTS | of_world_model(config)).dyn.rssm, name="dyn")


def of_rssm(params, config):
    return theirs({name: value for name, value in params.items() if name.startswith("rssm/")}, config)


def core(params, deter, stoch, action, config):
    model, arrays = rssm_of(config, action.shape[-1]), (flat(deter, 1), flat(stoch, 2), flat(action, 1))
    new = run(model._core, of_rssm(params, config), *nets.cast(arrays), epsilon=config.norm_epsilon)
    return new.reshape(deter.shape)


def prior(params, deter, config):
    return run(rssm_of(config, 1)._prior, of_rssm(params, config), nets.cast(deter), epsilon=config.norm_epsilon)


def posterior(params, deter, tokens, config):
    """Of one step of theirs, whose core is replaced by one that gives this memory."""
    model, rows = rssm_of(config, 1), flat(deter, 1)
    model._core = lambda *state: nets.cast(rows)
    carry = {"deter": rows, "stoch": jnp.zeros((len(rows), config.stoch, config.classes))}
    step = partial(model.observe, training=False, single=True)
    inputs = (carry, flat(tokens, 1), {"action": jnp.zeros((len(rows), 1))}, jnp.zeros(len(rows), bool))
    logits = run(step, of_rssm(params, config), *inputs, epsilon=config.norm_epsilon)[2]["logit"]
    return logits.reshape(*deter.shape[:-1], *logits.shape[1:])


# encoder, decoder and heads


def of_parts(params, config, spaces, *prefixes):
    return theirs({name: value for name, value in params.items() if name.startswith(prefixes)}, config, spaces)


def encoder(params, observation, spaces, config):
    own = spaces_of(spaces.observations)
    arrays = observation_of(observation, spaces.observations)
    rows = {name: flat(x, len(own[name].shape)) for name, x in arrays.items()}
    name, first = next(iter(arrays.items()))
    leading = first.shape[: first.ndim - len(own[name].shape)]
    module = rssm.Encoder(own, **elements.Config(DEFAULTS | of_world_model(config)).enc.simple, name="enc")
    encode = partial(module, training=False, single=True)
    reset = jnp.zeros(len(rows[name]), bool)
    named = of_parts(params, config, spaces, "encoder/")
    tokens = run(encode, named, {}, rows, reset, epsilon=config.norm_epsilon)[2]
    return tokens.reshape(*leading, -1)


def decoder(params, feature, spaces, config):
    own = spaces_of(spaces.observations)
    rows = flat(feature, 1)
    latents = {"deter": rows[:, : config.deter], "stoch": rows[:, config.deter :]}
    latents["stoch"] = latents["stoch"].reshape(-1, config.stoch, config.classes)
    module = rssm.Decoder(own, **elements.Config(DEFAULTS | of_world_model(config)).dec.simple, name="dec")
    decode = partial(module, training=False, single=True)
    named = of_parts(params, config, spaces, "decoder/")
    found = run(decode, named, {}, latents, jnp.zeros(len(rows), bool), epsilon=config.norm_epsilon)[2]
    raw = {name: getattr(out.output, "logits", out.pred()) for name, out in found.items()}
    arrays = {name: x if is_image(own[name]) else x.reshape(len(rows), -1) for name, x in raw.items()}
    return {key: x.reshape(*feature.shape[:-1], *x.shape[1:]) for key, x in joined(arrays, spaces.observations).items()}


def head(name, space, params, feature, config):
    options = elements.Config(DEFAULTS | of_heads(config))
    module = heads.MLPHead(space, **options[{"rew": "rewhead", "con": "conhead", "val": "value"}[name]], name=name)
    named = of_parts(params, config, None, *(prefix for prefix, own in HEADS.items() if own == name))
    return run(module, named, flat(feature, 1), 1, epsilon=config.norm_epsilon)


def reward_head(params, feature, config):
    return head("rew", SCALAR, params, feature, config).logits.reshape(*feature.shape[:-1], -1)


def continue_head(params, feature, config):
    return head("con", BINARY, params, feature, config).logit.reshape(feature.shape[:-1])


def critic(params, feature, config):
    return head("val", SCALAR, params, feature, config).logits.reshape(*feature.shape[:-1], -1)


def actor(params, feature, spaces, config):
    """Layer by layer: the outputs of their head are those after tanh and sigmoid."""
    hidden = mlp(params, "actor", feature, config.actor_layers, config.norm_epsilon)
    return {
        key: {
            name: linear(hidden, *(params[f"actor/out/{key}/{name}/{kind}"] for kind in ("kernel", "bias")))
            for name in outputs_of(space)
        }
        for key, space in spaces.actions.items()
    }
