"""NM512/dreamerv3-torch: DreamerV3 after the paper of 2023, in PyTorch.

Their repository is no package: its folder has to be on the path. Their code is time first with a last axis of length 1.
The two-hot distribution has 255 bins, even between two ends in symlog space; ends and number are taken from the bins
that the kit gives. Heads are reached through `MLP.dist`, which makes a distribution of the outputs of a last layer.
λ-returns and weights are results of `ImagBehavior._compute_target`, and the losses of actor and critic of its `_train`,
which gets given predictions in place of networks, one state at a time; the actor learns by reinforce, which their
presets have for discrete actions. Where an agent has both real and discrete actions, each action key gets a policy of
its own, and discrete observations, which they do not have, are decoded by their one-hot distribution.

Not offered: recurrent cell, heads and the losses of a whole step, which this edition has otherwise than the kit can
judge; samples from given noise, since they draw with the generator of PyTorch.
"""

import os
import subprocess
from types import SimpleNamespace as Namespace

import models
import networks
import torch
from tools import symexp, symlog  # noqa: F401 - offered here
from torch import nn

_FOLDER = os.path.dirname(models.__file__)
__version__ = subprocess.run(
    ["git", "-C", _FOLDER, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
).stdout.strip()


def edition():
    return "2023"


def convert(array):
    tensor = torch.as_tensor(array)
    return tensor.float() if tensor.is_floating_point() else tensor


# transforms and distributions


def made(kind, outputs, std=None, **options):
    """The distribution that a head of theirs makes of the outputs of its last layer."""
    options = {"_min_std": 0.1, "_max_std": 1.0, "_absmax": 1.0, "_unimix_ratio": 0.0, "_device": "cpu", **options}
    return networks.MLP.dist(Namespace(**options), kind, outputs, std, (outputs.shape[-1],))


def twohot_of(logits, low=-20.0, high=20.0):
    twohot = made("symlog_disc", logits)
    twohot.buckets = torch.linspace(low, high, logits.shape[-1])
    return twohot


def ends(bins):
    return (float(symlog(end)) for end in (bins[0], bins[-1]))


def symexp_twohot_loss(logits, target, bins):
    return -twohot_of(logits, *ends(bins)).log_prob(torch.as_tensor(target).float()[..., None])


def symexp_twohot_mean(logits, bins):
    return twohot_of(logits, *ends(bins)).mean()[..., 0]


def unimix_log_probs(logits, unimix):
    return made("onehot", logits, _unimix_ratio=unimix).logits


def categorical_log_prob(log_probs, onehot):
    return made("onehot", log_probs).log_prob(torch.as_tensor(onehot).float())


def categorical_entropy(log_probs):
    return made("onehot", log_probs).entropy()


def categorical_kl(log_probs_p, log_probs_q):
    return torch.distributions.kl_divergence(made("onehot", log_probs_p), made("onehot", log_probs_q))


def bernoulli_loss(logit, target):
    return -made("binary", logit[..., None]).log_prob(torch.as_tensor(target)[..., None])


def bernoulli_mean(logit):
    return made("binary", logit[..., None]).mean[..., 0]


def bounded_normal(mean, std, min_std, max_std):
    normal = made("normal", mean[..., None], std[..., None], _min_std=min_std, _max_std=max_std).base_dist
    return normal.loc[..., 0], normal.scale[..., 0]


def normal_of(mean, std):
    """Of every number alone, without their bound of 1."""
    return made("normal_std_fixed", mean[..., None], _std=std[..., None], _absmax=None)


def normal_log_prob(mean, std, value):
    return normal_of(mean, std).log_prob(value[..., None])


def normal_entropy(std):
    return normal_of(torch.zeros_like(std), std).entropy()


def draw_normal(mean, std, seed, n):
    torch.manual_seed(seed)
    return normal_of(mean, std).sample((n,))[..., 0]


def draw_categorical(logits, unimix, seed, n):
    torch.manual_seed(seed)
    return made("onehot", logits, _unimix_ratio=unimix).sample((n,))


def image_loss(prediction, target):
    """Of [N, T, ...]."""
    return -networks.MultiDecoder._make_image_dist(Namespace(_image_dist="mse"), prediction).log_prob(target)


def mse_loss(prediction, target):
    return image_loss(prediction.reshape(-1, 1, 1), target.reshape(-1, 1, 1)).reshape(prediction.shape)


def symlog_mse_loss(prediction, target, scale):
    losses = -made("symlog_mse", prediction.reshape(-1, 1, 1)).log_prob(target.reshape(-1, 1, 1))
    return scale * losses.reshape(prediction.shape)


# layers


def of_images(module, x):
    y = module(x.reshape(-1, *x.shape[-3:]).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    return y.reshape(*x.shape[:-3], *y.shape[1:])


def fill(module, *tensors):
    with torch.no_grad():
        for parameter, tensor in zip(module.parameters(), tensors, strict=True):
            assert parameter.shape == tensor.shape, (parameter.shape, tensor.shape)
            parameter.copy_(tensor)
    return module


def rms_norm(x, scale, epsilon):
    """The norm of their convolutions, which is a LayerNorm."""
    norm = fill(networks.ImgChLayerNorm(len(scale), eps=epsilon), scale, torch.zeros_like(scale))
    return of_images(norm, x[..., None, None, :]).reshape(x.shape)


def convolution(x, kernel, bias, stride):
    size, _, inputs, outputs = kernel.shape
    return of_images(
        fill(networks.Conv2dSamePad(inputs, outputs, size, stride=stride), kernel.permute(3, 2, 0, 1), bias), x
    )


# world model


def kl_losses(posterior_logits, prior_logits, config):
    rssm = Namespace(_discrete=config.classes, _unimix_ratio=config.latent_unimix)
    rssm.get_dist = lambda state: networks.RSSM.get_dist(rssm, state)
    states = ({"logit": logits} for logits in (posterior_logits, prior_logits))
    _, _, dynamics, representation = networks.RSSM.kl_loss(rssm, *states, config.free_nats, 1.0, 1.0)
    return dynamics, representation


def preprocessed(**observations):
    given = {name: torch.zeros(1) for name in ("image", "is_first", "is_terminal")}
    return models.WorldModel.preprocess(Namespace(_config=Namespace(device="cpu")), {**given, **observations})


def continue_target(is_terminal, config):
    if config.continue_target != "hard":
        raise NotImplementedError("a discounted continue target")
    return preprocessed(is_terminal=is_terminal)["cont"][..., 0]


def reconstruction_losses(predictions, observations, spaces, config):
    losses = {}
    for key, space in spaces.observations.items():
        one, axes = reconstruction_loss(space, config), 3 if hasattr(space, "channels") else 1
        prediction, target = (
            x.reshape(1, -1, *x.shape[x.ndim - axes :]) for x in (predictions[key], observations[key])
        )
        losses[key] = one(prediction, target).reshape(observations[key].shape[:-axes])
    return losses


def reconstruction_loss(space, config):
    if hasattr(space, "channels"):
        return lambda prediction, target: image_loss(prediction, preprocessed(image=target)["image"])
    if hasattr(space, "size"):
        return lambda prediction, target: -config.vector_loss_scale * made("symlog_mse", prediction).log_prob(target)

    def of_classes(prediction, target):
        parts = zip(prediction.split(list(space.classes), -1), target.unbind(-1), space.classes, strict=True)
        return -sum(made("onehot", part).log_prob(nn.functional.one_hot(index, n).float()) for part, index, n in parts)

    return of_classes


# returns


def targets(reward, continue_, value, discount, lambda_):
    """λ-returns [N, H] and weights [N, H+1] of imagined states."""
    time_first = lambda x: x.mT[..., None]  # noqa: E731
    head = lambda states: Namespace(mean=time_first(continue_))  # noqa: E731
    behavior = Namespace(
        _config=Namespace(discount=discount, discount_lambda=lambda_),
        _world_model=Namespace(heads={"cont": head}, dynamics=Namespace(get_feat=lambda states: states)),
        value=lambda states: Namespace(mode=lambda: time_first(value)),
    )
    returns, weights, _ = models.ImagBehavior._compute_target(behavior, None, None, time_first(reward))
    return torch.stack(returns)[..., 0], weights[..., 0].mT


def lambda_return(reward, continue_, value, discount, lambda_):
    return targets(reward, continue_, value, discount, lambda_)[0]


def cumulative_weights(continue_, discount):
    zero = torch.zeros_like(continue_)
    return targets(zero, continue_, zero, discount, 0.95)[1][:, :-1]


def moving_range(low, high, returns, alpha=0.0, percentiles=(5.0, 95.0)):
    """The range after an update, and its size."""
    moving, values = models.RewardEMA("cpu", alpha=alpha), torch.tensor([float(low), float(high)])
    moving.range = torch.tensor(percentiles) / 100
    return values, moving(returns, values)[1]


def percentile(values, q):
    return moving_range(0.0, 0.0, values, 1.0, (q, q))[0][0]


def update_return_range(low, high, returns, config):
    percentiles = config.return_percentile_low, config.return_percentile_high
    return tuple(moving_range(low, high, returns, 1 - config.return_decay, percentiles)[0])


def return_scale(low, high, limit):
    """In units of the limit, which is 1 there."""
    return limit * moving_range(low / limit, high / limit, torch.zeros(2))[1]


# behavior


def policies(outputs, spaces, config):
    """The distribution of every action, and its size."""
    options = {"_min_std": config.actor_min_std, "_max_std": config.actor_max_std, "_unimix_ratio": config.actor_unimix}
    for key, space in sorted(spaces.actions.items()):
        raw = outputs[key]
        if "mean" in raw:
            yield made("normal", raw["mean"], raw["std"], **options), space.size
        else:
            for logits in raw["logits"].split(list(space.classes), -1):
                yield made("onehot", logits, **options), logits.shape[-1]


def action_log_prob(outputs, action, spaces, config):
    every = list(policies(outputs, spaces, config))
    parts = action.float().split([size for _, size in every], -1)
    return sum(one.log_prob(part) for (one, _), part in zip(every, parts, strict=True))


def action_entropy(outputs, spaces, config):
    return sum(one.entropy() for one, _ in policies(outputs, spaces, config))


def draw_actions(outputs, spaces, config, seed, n):
    torch.manual_seed(seed)
    return torch.cat([one.sample((n,)) for one, _ in policies(outputs, spaces, config)], -1)


def behavior_losses(policy, value, weight, returns, scale=1.0, entropy_scale=0.0, slow_value=None):
    """The losses of actor and critic of one imagined state. value, slow_value: distributions of its return."""
    caught, zero, twice = {}, torch.zeros(2, 1, 1), lambda x: x.reshape(1, 1, 1).expand(2, 1, 1)
    config = {"imag_horizon": 1, "imag_gradient": "reinforce", "reward_EMA": True, "critic": {"slow_target": True}}
    behavior = Namespace(
        _config=Namespace(**config, actor={"entropy": entropy_scale, "dist": "normal"}),
        _use_amp=False,
        _update_slow_target=lambda: None,
        _imagine=lambda *inputs: (zero, zero, zero),
        _world_model=Namespace(dynamics=Namespace(get_dist=lambda state: Namespace(entropy=lambda: None))),
        _compute_target=lambda *inputs: ([returns.reshape(1, 1)], twice(weight), value.mode()),
        value=Network(value),
        _slow_value=lambda states: slow_value or value,
        actor=Network(policy),
        ema_vals=torch.zeros(2),
        reward_ema=lambda returns, values: (torch.zeros(()), scale),
        _actor_opt=lambda loss, parameters: caught.update(actor=loss) or {},
        _value_opt=lambda loss, parameters: caught.update(critic=loss) or {},
        requires_grad_=lambda requires_grad: None,
    )
    behavior._compute_actor_loss = lambda *inputs: models.ImagBehavior._compute_actor_loss(behavior, *inputs)
    models.ImagBehavior._train(behavior, None, lambda *inputs: zero)
    return caught


class Network:
    """Stands in for a network with the same output everywhere."""

    def __init__(self, output):
        self.output = output

    def __call__(self, states):
        return self.output

    def parameters(self):
        return []

    def requires_grad_(self, requires_grad):
        return self


def one_by_one(loss, *arrays):
    """A loss of every element, each alone."""
    rows = zip(*(x.flatten(0, 1) for x in arrays), strict=True)
    return torch.stack([loss(*row) for row in rows]).reshape(arrays[0].shape[:2])


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    def loss(log_prob, entropy, returns, value, weight):
        policy = Namespace(log_prob=lambda action: log_prob.expand(2, 1), entropy=lambda: entropy.expand(2, 1))
        critic = Namespace(mode=lambda: value.reshape(1, 1, 1), log_prob=lambda target: torch.zeros(1, 1))
        return behavior_losses(policy, critic, weight, returns, scale, config.entropy_scale)["actor"]

    return one_by_one(loss, log_prob, entropy, returns, value, weight)


def critic_loss(logits, slow_logits, returns, weight, config):
    """Their weight of the slow critic is 1. Towards the slow critic alone goes half of the loss whose return is the
    slow critic's mean."""
    idle = Namespace(log_prob=lambda action: torch.zeros(2, 1), entropy=lambda: torch.zeros(2, 1))

    def loss(logits, slow_logits, returns, weight):
        value, slow = (twohot_of(x.reshape(1, 1, -1)) for x in (logits, slow_logits))
        return behavior_losses(idle, value, weight, returns, slow_value=slow)["critic"]

    losses = one_by_one(loss, logits, slow_logits, returns, weight)
    if config.slow_critic_scale == 1:
        return losses
    means = twohot_of(slow_logits).mode()[..., 0]
    return losses + (config.slow_critic_scale - 1) / 2 * one_by_one(loss, logits, slow_logits, means, weight)


def update_slow_critic(slow, critic, decay):
    live, updated = ({name: Namespace(data=x[name]) for name in slow} for x in (critic, slow))
    behavior = Namespace(
        _config=Namespace(critic={"slow_target": True, "slow_target_update": 1, "slow_target_fraction": 1 - decay}),
        _updates=0,
        value=Namespace(parameters=live.values),
        _slow_value=Namespace(parameters=updated.values),
    )
    models.ImagBehavior._update_slow_target(behavior)
    return {name: parameter.data for name, parameter in updated.items()}
