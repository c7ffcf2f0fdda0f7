"""What r2dreamer writes inside of `_cal_grad`, the function of a whole training step: weights, and the losses of actor
and critic.

It is called with stand-ins for the networks. Weights are the gradient of the actor's loss in the entropies, and losses
are taken of one state at a time.
"""

from types import SimpleNamespace as Namespace

import distributions
import dreamer
import torch
from tensordict import TensorDict


class Scale:
    """Stands in for the return range."""

    ema_vals = (0.0, 0.0)

    def __init__(self, scale):
        self.scale = scale

    def __call__(self, returns):
        return 0.0, self.scale


def every(number):
    """A network whose prediction is this number at every state."""
    return lambda states: Namespace(mode=lambda: number.expand(*states.shape[:2], 1))


def predicting(logits):
    """A critic with these logits at every state."""
    return lambda states: distributions.symexp_twohot(logits.expand(*states.shape[:2], -1), len(logits))


def pass_of(imagined, replayed, returns=None, scale=1.0, is_last=None, **given):
    """The metrics of `_cal_grad` where the world model is nothing.

    imagined, replayed: states [N, H+1, 2 K] and [B, T, 2 K] with N = B*T: the logits of the critic, then those of the
    slow critic. given: attributes of the agent.
    """
    bins = distributions.symexp_twohot(torch.zeros(replayed.shape[-1] // 2), replayed.shape[-1] // 2).bins
    zero, returns = torch.zeros(*replayed.shape[:2], 1), torch.zeros(()) if returns is None else returns
    last = zero if is_last is None else is_last
    nothing = Namespace(log_prob=lambda target: zero, entropy=lambda: zero)
    idle = torch.zeros(imagined.shape[:2])
    parts = {
        "observe": lambda *inputs: (zero, zero, zero),
        "prior": lambda deter: (zero, zero),
        "kl_loss": lambda *inputs: (zero, zero),
        "get_feat": lambda *inputs: replayed,
        "get_dist": lambda logits: nothing,
    }
    critic = lambda states: distributions.TwoHot(states[..., : len(bins)], bins)  # noqa: E731
    agent = {
        "rssm": Namespace(**parts),
        "encoder": lambda data: zero,
        "decoder": lambda *inputs: {},
        **dict.fromkeys(("reward", "cont"), lambda states: nothing),
        **dict.fromkeys(("value", "_frozen_value"), critic),
        "_frozen_slow_value": lambda states: distributions.TwoHot(states[..., len(bins) :], bins),
        "_frozen_reward": every(torch.zeros(1)),
        "_frozen_cont": lambda states: Namespace(mean=torch.ones(*states.shape[:2], 1)),
        "actor": lambda states: Namespace(log_prob=lambda action: idle, entropy=lambda: idle),
        "return_ema": Scale(scale),
        "_imagine": lambda *inputs: (imagined, idle[..., None]),
        "_lambda_return": lambda last, *others: returns.expand(last.shape[0], last.shape[1] - 1, 1),
        "_scaler": Namespace(scale=lambda loss: Namespace(backward=lambda: None)),
        "_loss_scales": dict.fromkeys(("dyn", "rep", "rew", "con", "policy", "value", "repval"), 1.0),
        **{"kl_free": 0.0, "imag_horizon": 1, "horizon": float("inf"), "lamb": 1.0, "act_entropy": 0.0},
        "rep_loss": "dreamer",
    }
    data = dict.fromkeys(("action", "is_first", "reward", "is_terminal"), zero) | {"is_last": last}
    return dreamer.Dreamer._cal_grad(Namespace(**{**agent, **given}), TensorDict(data, zero.shape[:2]), None)[1]


def cumulative_weights(continue_, discount):
    continues = continue_.repeat_interleave(2, 0)[..., None]
    entropy = torch.zeros(continues.shape[:2], requires_grad=True)
    policy = Namespace(log_prob=lambda action: torch.zeros_like(entropy), entropy=lambda: entropy)
    states = torch.zeros(*continues.shape[:2], 6), torch.zeros(len(continue_), 2, 6)
    given = {
        "_frozen_cont": lambda states: Namespace(mean=continues),
        "actor": lambda states: policy,
        "act_entropy": 1.0,
        "horizon": 1 / (1 - discount) if discount != 1 else float("inf"),
        "_scaler": Namespace(scale=lambda loss: loss),
        "_loss_scales": {
            **dict.fromkeys(("dyn", "rep", "rew", "con", "value", "repval"), 0.0),
            "policy": entropy[:, :-1].numel(),
        },
    }
    pass_of(*states, **given)
    return -entropy.grad[::2, :-1]


def one_by_one(loss, *arrays):
    """A loss of every element, each alone."""
    rows = zip(*(x.flatten(0, 1) for x in arrays), strict=True)
    return torch.stack([loss(*row) for row in rows]).reshape(arrays[0].shape[:2])


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    def loss(log_prob, entropy, returns, value, weight):
        policy = Namespace(log_prob=lambda action: log_prob.expand(2, 2), entropy=lambda: entropy.expand(2, 2))
        given = {
            "actor": lambda states: policy,
            "_frozen_value": every(value),
            "_frozen_cont": lambda states: Namespace(mean=weight.expand(2, 2, 1)),
            "act_entropy": config.entropy_scale,
        }
        return pass_of(torch.zeros(2, 2, 6), torch.zeros(1, 2, 6), returns, scale, **given)["loss/policy"]

    return one_by_one(loss, log_prob, entropy, returns, value, weight)


def regularized(loss_of, logits, slow_logits, returns, entries, config):
    """The losses with the weight of the configuration: theirs is 1. Towards the slow critic alone goes half of the loss
    whose return is the slow critic's mean."""
    losses = one_by_one(loss_of, logits, slow_logits, returns, entries)
    if config.slow_critic_scale == 1:
        return losses
    means = distributions.symexp_twohot(slow_logits, slow_logits.shape[-1]).mode()[..., 0]
    towards_slow = one_by_one(loss_of, logits, slow_logits, means, entries) / 2
    return losses + (config.slow_critic_scale - 1) * towards_slow


def critic_loss(logits, slow_logits, returns, weight, config):
    def loss(logits, slow_logits, returns, weight):
        states = torch.cat([logits, slow_logits]).expand(2, 2, -1)
        given = {
            "value": predicting(logits),  # the states lose their gradients on the way
            "_frozen_slow_value": predicting(slow_logits),
            "_frozen_cont": lambda states: Namespace(mean=weight.expand(2, 2, 1)),
        }
        return pass_of(states, states[:1], returns, **given)["loss/value"]

    return regularized(loss, logits, slow_logits, returns, weight, config)


def replay_critic_loss(logits, slow_logits, returns, is_last, config):
    def loss(logits, slow_logits, returns, is_last):
        states = torch.cat([logits, slow_logits]).expand(2, 2, -1)
        return pass_of(states, states[:1], returns, is_last=is_last.expand(1, 2, 1))["loss/repval"]

    return regularized(loss, logits, slow_logits, returns, is_last.float(), config)
