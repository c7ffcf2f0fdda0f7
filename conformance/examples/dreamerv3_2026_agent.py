"""What `dreamerv3_2026_adapter` offers of the whole agent: the authors' `Agent`, with the given numbers as its
parameters.

Two things stand in for theirs, both where random numbers come from. `sample`, the function that draws actions of a
policy, and `OneHot.sample`, the method that draws latents, hand out the sample of a tape; the gradient through a latent
is theirs. A tape holds samples, or noise, of which the classes are made here, by inverting their cumulative
probabilities. So what their agent makes of samples is judged, and not how it draws them.

Their `imag_loss` is wrapped, to read means that they do not report. Gradients are those of their loss by the kit's
parameters. Their optimizer updates these, and not their own tensors: a discrete key whose entries have different
numbers of classes has one output layer in the specification, and here several.
"""

import contextlib
from functools import partial
from unittest import mock

import elements
import embodied.jax
import jax
import jax.numpy as jnp
import ninjax as nj
import numpy as np
import optax
from dreamerv3 import agent, rssm
from dreamerv3.agent import imag_loss
from dreamerv3_2026_losses import cumulative_weights
from dreamerv3_2026_names import (
    classes_of,
    observation_of,
    ours,
    parts,
    placed,
    settings,
    spaces_of,
    theirs,
)
from dreamerv3_2026_networks import of_rssm, rssm_of, run, run_on
from embodied.jax import nets, outs


class Tape:
    """Samples or noise by kind, time first. How far it was read is a part of their state, which their loops over time
    carry along."""

    def __init__(self, entries, given):
        self.entries, self.given, self.latents = entries, given, "prior"

    @property
    def start(self):
        return {f"tape/{kind}": jnp.zeros((), jnp.int32) for kind in self.entries}

    def read(self, kind):
        """Beyond the end, the last entry: the action after the last imagined state, which no loss reads."""
        place, entries = nj.context()[f"tape/{kind}"], self.entries[kind]
        nj.context()[f"tape/{kind}"] = place + 1
        return entries[jnp.minimum(place, len(entries) - 1)]

    def classes(self, kind, logits):
        entry = self.read(kind)
        if self.given:
            return entry
        return (jax.nn.softmax(logits, -1).cumsum(-1)[..., :-1] <= entry[..., None]).sum(-1)

    def latent(self, dist, seed, shape=()):
        """In place of `OneHot.sample`."""
        return dist._onehot_with_grad(self.classes(self.latents, dist.dist.logits))

    def actions(self, policy):
        """In place of `sample`."""
        drawn = {}
        for key, dist in policy.items():
            dist = dist.output if isinstance(dist, outs.Agg) else dist
            if isinstance(dist, outs.Normal):
                entry = self.read(key)
                drawn[key] = entry if self.given else dist.mean + dist.stddev * entry
            else:
                drawn[key] = self.classes(key, dist.logits)
        return drawn

    @contextlib.contextmanager
    def played(self):
        observe = rssm.RSSM._observe

        def observing(*arguments, **options):
            self.latents = "posterior"
            step = observe(*arguments, **options)
            self.latents = "prior"
            return step

        latent = lambda dist, seed, shape=(): self.latent(dist, seed, shape)  # noqa: E731
        with (
            mock.patch.object(outs.OneHot, "sample", latent),
            mock.patch.object(agent, "sample", self.actions),
            mock.patch.object(rssm.RSSM, "_observe", observing),
        ):
            yield


def run_with(tape, function, params, *arguments, epsilon):
    with tape.played():
        return run(function, params | tape.start, *arguments, epsilon=epsilon)


def time_first(x):
    return x.swapaxes(0, 1)


# sequences with given latents


def observe_given(params, carry, tokens, prev_action, is_first, stoch, config):
    model, tape = rssm_of(config, prev_action.shape[-1]), Tape({"posterior": time_first(stoch.argmax(-1))}, given=True)

    def sequence():
        found = model.observe(carry, tokens, {"action": prev_action}, is_first, training=False)[2]
        return found["deter"], found["logit"], model._prior(found["deter"])

    found = run_with(tape, sequence, of_rssm(params, config), epsilon=config.norm_epsilon)
    return dict(zip(("deter", "posterior", "prior"), found, strict=True))


def imagine_given(params, carry, action, stoch, config):
    model, tape = rssm_of(config, action.shape[-1]), Tape({"prior": time_first(stoch.argmax(-1))}, given=True)
    imagine = partial(model.imagine, length=action.shape[1], training=False)
    named = of_rssm(params, config)
    found = run_with(tape, imagine, named, nets.cast(carry), {"action": action}, epsilon=config.norm_epsilon)[1]
    return {"deter": jnp.concatenate([carry["deter"][:, None], found["deter"]], 1), "prior": found["logit"]}


# actions


def action_of(flat_action, spaces):
    """Their action. A discrete one that is all zeros is missing, which they write as -1."""
    own = {}
    for name, part, where in placed(spaces.actions):
        x = flat_action[..., where]
        if part.space.discrete:
            x = x.reshape(*x.shape[:-1], *part.space.shape, -1)
            x = jnp.where(x.any(-1), x.argmax(-1), -1)
        own[name] = x
    return own


def flat_action_of(action, spaces):
    arrays = []
    for name, part, _ in placed(spaces.actions):
        x = action[name]
        if part.space.discrete:
            x = jax.nn.one_hot(x, classes_of(part.space))
            x = x.reshape(*x.shape[:-2], -1)
        arrays.append(x)
    return jnp.concatenate(arrays, -1)


def action_noise_of(noise, spaces):
    """Of noise [..., K] that of each of their keys."""
    own, place = {}, 0
    for name, part in parts(spaces.actions).items():
        own[name] = noise[..., place : place + part.space.shape[0]]
        place += part.space.shape[0]
    return own


# optimizer


def update_slow_critic(slow, critic, decay):
    """Both as parameters of modules of theirs, that have no other."""
    if 0 < decay <= 0.5:
        raise NotImplementedError("a slow critic that follows by half or more, but as a copy")
    source, model = Holder(name="source"), Holder(name="model")
    own = {f"source/{name}": value for name, value in critic.items() if name.startswith("critic/")}
    own |= {f"model/{name}": value for name, value in slow.items()}
    tracker = embodied.jax.SlowModel(model, source=source, rate=1 - decay)
    state = nj.pure(tracker.update)(own, create=True)[0]
    return {name: state[f"model/{name}"] for name in slow}


class Holder(nj.Module):
    pass


def adaptive_gradient_clip(gradient, parameter, clip, epsilon):
    return embodied.jax.opt.clip_by_agc(clip, epsilon).update(gradient, (), parameter)[0]


def optimizer_of(config, **changes):
    options = {"lr": config.learning_rate, "agc": config.agc_clip, "eps": config.laprop_epsilon}
    options |= {"beta1": config.beta1, "beta2": config.beta2, "warmup": config.warmup_steps}
    clip = partial(embodied.jax.opt.clip_by_agc, pmin=config.agc_epsilon)
    with mock.patch.object(embodied.jax.opt, "clip_by_agc", clip):
        return agent.Agent._make_opt(None, **options | changes)


def update_of(params, gradients, second_moment, momentum, step, config, **changes):
    count = jnp.asarray(step, jnp.int32)
    state = ((), (count, second_moment), (count, momentum), optax.ScaleByScheduleState(count))
    updates, new = optimizer_of(config, **changes).update(gradients, state, params)
    return updates, new[1][1], new[2][1]


def laprop(gradient, second_moment, momentum, step, config):
    changes = {"lr": 1.0, "agc": 0.0, "warmup": 0}
    update, *moments = update_of(gradient, gradient, second_moment, momentum, step, config, **changes)
    return -update, *moments


def learning_rate(step, config):
    """How far a parameter moves whose normalized gradient is 1."""
    one = jnp.ones(())
    return -update_of(one, one, one, one, step, config, beta1=0.0, beta2=0.0, agc=0.0)[0]


def optimizer_step(params, gradients, state, config):
    updates, *moments = update_of(params, gradients, state["second_moment"], state["momentum"], state["step"], config)
    return optax.apply_updates(params, updates), {
        "step": state["step"] + 1,
        **dict(zip(("second_moment", "momentum"), moments, strict=True)),
    }


# the agent

LOSSES = {"rew": "reward", "con": "continue", "dyn": "dynamics", "rep": "representation"}
LOSSES |= {"policy": "actor", "value": "critic", "repval": "replay_critic"}
FLAGS = ("is_first", "is_last", "is_terminal")


def agent_of(spaces, config):
    """Their agent, without the part that lays it out on devices and compiles it."""
    flags = {name: elements.Space(bool) for name in FLAGS} | {"reward": elements.Space(np.float32)}
    model = object.__new__(agent.Agent)
    model.__init__(spaces_of(spaces.observations) | flags, spaces_of(spaces.actions), settings(config))
    return model


def state_of(params, slow_critic, return_range, spaces, config):
    """What their modules keep."""
    slow = {f"slow{name}": value for name, value in theirs(slow_critic, config).items()}
    low, high = (jnp.asarray(end, jnp.float32) for end in return_range)
    return theirs(params, config, spaces) | slow | {"retnorm/lo/value": low, "retnorm/hi/value": high}


def inputs_of(batch, spaces, config):
    """What their loss takes."""
    stoch = jax.nn.one_hot(batch["stoch"], config.classes)
    carry = ({}, {"deter": batch["deter"], "stoch": stoch}, {})
    observation = observation_of(batch, spaces.observations) | {name: batch[name] for name in (*FLAGS, "reward")}
    return carry, observation, action_of(batch["prev_action"], spaces)


def reporting(act, rew, con, policy, value, slow, retnorm, *norms, contdisc, horizon, **options):
    """`imag_loss` with the means that the kit asks for beside those of theirs."""
    losses, found, metrics = imag_loss(
        act, rew, con, policy, value, slow, retnorm, *norms, contdisc=contdisc, horizon=horizon, **options
    )
    weight = cumulative_weights(con, 1.0 if contdisc else 1 - 1 / horizon)
    means = {"return": found["ret"], "value": value.pred()[:, :-1], "reward": rew[:, 1:], "continue": con[:, 1:]}
    asked = {f"{name}_mean": x.mean() for name, x in (means | {"weight": weight}).items()}
    asked["return_scale"] = retnorm.stats()[1]
    asked["actor_entropy"] = sum(metrics[f"ent/{key}"] for key in policy)
    return losses, found, metrics | {f"asked/{name}": x for name, x in asked.items()}


def loss(params, slow_critic, return_range, batch, entries, spaces, config, given):
    """Their total, and the kit's aux."""
    model, tape = agent_of(spaces, config), Tape(entries, given)
    state = state_of(params, slow_critic, return_range, spaces, config) | tape.start
    with tape.played(), mock.patch.object(agent, "imag_loss", reporting):
        whole = partial(model.loss, training=True)
        state, (total, (_, _, found, metrics)) = run_on(
            whole, state, *inputs_of(batch, spaces, config), epsilon=config.norm_epsilon
        )
    means = {name: metrics[f"loss/{own}"] for own, name in LOSSES.items()}
    for own, part in parts(spaces.observations).items():
        name = f"reconstruction/{part.key}"
        means[name] = means.get(name, 0.0) + metrics[f"loss/{own}"]
    return total, {
        "losses": means,
        "return_range": (state["retnorm/lo/value"], state["retnorm/hi/value"]),
        **{name: found["repfeat"][name] for name in ("deter", "stoch")},
        "metrics": {name.removeprefix("asked/"): x for name, x in metrics.items() if name.startswith("asked/")},
    }


def each_gradient(params, *arguments, **options):
    return jax.jacrev(lambda params: loss(params, *arguments, **options)[1]["losses"])(params)


PROGRAMS: dict = {}


def compiled(function, spaces, config, **options):
    """Compiled once for each task and configuration."""
    key = (function.__name__, repr(spaces), repr(config), repr(options))
    if key not in PROGRAMS:
        PROGRAMS[key] = jax.jit(partial(function, spaces=spaces, config=config, **options))
    return PROGRAMS[key]


def noise_of(noise, spaces):
    actions = action_noise_of(time_first(noise["action"]), spaces)
    return {name: time_first(noise[name]) for name in ("posterior", "prior")} | actions


def samples_of(samples, spaces):
    actions = action_of(time_first(samples["action"]), spaces)
    return {name: time_first(samples[name].argmax(-1)) for name in ("posterior", "prior")} | actions


def with_tape(function, params, slow_critic, return_range, batch, entries, spaces, config, given):
    return compiled(function, spaces, config, given=given)(params, slow_critic, return_range, batch, entries)


def losses(*arguments):
    *state, noise, spaces, config = arguments
    return with_tape(loss, *state, noise_of(noise, spaces), spaces, config, given=False)


def losses_given(*arguments):
    *state, samples, spaces, config = arguments
    return with_tape(loss, *state, samples_of(samples, spaces), spaces, config, given=True)


def loss_and_gradient(params, *arguments, **options):
    (total, aux), gradient = jax.value_and_grad(loss, has_aux=True)(params, *arguments, **options)
    return gradient, total, aux


def gradients(*arguments):
    *state, noise, spaces, config = arguments
    return with_tape(loss_and_gradient, *state, noise_of(noise, spaces), spaces, config, given=False)[0]


def gradients_given(*arguments):
    *state, samples, spaces, config = arguments
    return with_tape(loss_and_gradient, *state, samples_of(samples, spaces), spaces, config, given=True)[0]


def loss_derivatives(*arguments):
    *state, noise, spaces, config, directions = arguments
    gradients = with_tape(each_gradient, *state, noise_of(noise, spaces), spaces, config, given=False)
    return {
        name: [sum(float(np.vdot(gradient[key], x)) for key, x in direction.items()) for direction in directions]
        for name, gradient in gradients.items()
    }


def step(state, batch, entries, spaces, config, given):
    params, slow, range_ = state["params"], state["slow_critic"], state["return_range"]
    ends = (range_["low"], range_["high"])
    gradient, _, aux = with_tape(loss_and_gradient, params, slow, ends, batch, entries, spaces, config, given)
    params, optimizer = optimizer_step(params, gradient, state["optimizer"], config)
    low, high = aux["return_range"]
    new = {"params": params, "optimizer": optimizer, "return_range": {"low": low, "high": high}}
    return new | {"slow_critic": update_slow_critic(slow, params, config.slow_critic_decay)}, aux


def train_step(state, batch, noise, spaces, config):
    return step(state, batch, noise_of(noise, spaces), spaces, config, given=False)


def train_step_given(state, batch, samples, spaces, config):
    return step(state, batch, samples_of(samples, spaces), spaces, config, given=True)


def policy_step(params, carry, prev_action, observation, is_first, noise, spaces, config):
    model = agent_of(spaces, config)
    tape = Tape({"posterior": noise["posterior"][None], **action_noise_of(noise["action"][None], spaces)}, given=False)
    observation = observation_of(observation, spaces.observations) | {"is_first": is_first}
    own = ({}, nets.cast(carry), {}, action_of(prev_action, spaces))
    named = theirs(params, config, spaces) | tape.start
    with tape.played():
        own, action, _ = run(model.policy, named, own, observation, epsilon=config.norm_epsilon)
    return own[1], flat_action_of(action, spaces)


def draw_parameters(spaces, config, seed):
    """Their parameters are made by a first pass over a batch."""
    model, rows = agent_of(spaces, config), (1, 2)

    def zeros(own):
        return {name: jnp.zeros((*rows, *space.shape), space.dtype) for name, space in own.items()}

    carry = model.init_train(rows[0])[:3]
    whole = partial(model.loss, training=False)
    made = nj.init(whole)({}, carry, zeros(model.obs_space), zeros(model.act_space), seed=seed)
    return ours(made, config, spaces)
