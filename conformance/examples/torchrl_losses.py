"""TorchRL's actor and critic losses, on given numbers. For `torchrl_adapter`.

The loss modules imagine, and ask actor, critic and continuation model. Here all of these are replaced by ones that hand
out given numbers: an imagined state is the four numbers (value, continuation, log-probability, entropy).
"""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import SymExpTwoHot
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3ValueLoss, SoftUpdate, ValueEstimators


class Column(nn.Module):
    """Reads one number of a state."""

    def __init__(self, index):
        super().__init__()
        self.index = index

    def forward(self, state):
        return state[..., self.index, None]


class Policy(nn.Module):
    """An actor whose distribution has the log-probability and the entropy that the state holds."""

    in_keys = ("state",)

    def get_dist(self, data):
        return KnownActions(data["state"])


class KnownActions:
    """A distribution over actions of which two numbers are known."""

    def __init__(self, state):
        self.state = state

    def log_prob(self, action):
        return self.state[..., 2, None]

    def entropy(self):
        return self.state[..., 3, None]


class Dream(nn.Module):
    """A world model that has already dreamt: reset and rollout return what is given."""

    def __init__(self, data):
        super().__init__()
        self.data = data

    def reset(self, data):
        return data

    def rollout(self, **options):
        return self.data.clone()


def actor_loss_module(state, next_state, reward, discount, lambda_, **options):
    """The loss module and the data of one dream: state and next_state [N, H, 4], reward [N, H]."""
    here, following = ({"state": x, "belief": x} for x in (state, next_state))
    data = TensorDict({**here, "action": state, "next": {**following, "reward": reward[..., None]}}, reward.shape)
    value, continuation = (
        TensorDictModule(Column(i), ["state"], [key]) for i, key in ((0, "state_value"), (1, "continuation"))
    )
    loss = DreamerV3ActorLoss(
        Policy(), value, Dream(data), continuation_model=continuation, use_reinforce=True, **options
    )
    loss.make_value_estimator(ValueEstimators.TDLambda, gamma=discount, lmbda=lambda_)
    return loss, data


def dreamt(reward, continue_, value, discount, lambda_):
    state = torch.stack([value, continue_, torch.zeros_like(value), torch.zeros_like(value)], -1)
    loss, data = actor_loss_module(state[:, :-1], state[:, 1:], reward[:, 1:], discount, lambda_)
    return loss(data)[1]


def lambda_return(reward, continue_, value, discount, lambda_):
    return dreamt(reward, continue_, value, discount, lambda_)["lambda_target"][..., 0]


def cumulative_weights(continue_, discount):
    return dreamt(torch.zeros_like(continue_), continue_, torch.zeros_like(continue_), discount, 0.95)[
        "discount_weight"
    ][..., 0]


def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
    def one(log_prob, entropy, returns, value, weight):
        """Of a dream of one step whose reward is the return, after which nothing follows."""
        state = torch.stack([value, weight, log_prob, entropy], -1).reshape(1, 1, 4)
        module, data = actor_loss_module(
            state, torch.zeros(1, 1, 4), returns.reshape(1, 1), 1.0, 1.0, entropy_bonus=config.entropy_scale
        )
        module.eval()
        module.retnorm.high.fill_(scale)
        module.retnorm.min_scale = 0.0
        return module(data)[0]["loss_actor"]

    rows = (x.flatten() for x in (log_prob, entropy, returns, value, weight))
    # Detached: the module samples anew and holds logits as parameters of its own, so no gradient leads back here.
    return torch.stack([one(*numbers) for numbers in zip(*rows, strict=True)]).reshape(log_prob.shape).detach()


class Given(nn.Module):
    """A critic that is its own output, or any tensors by name."""

    def __init__(self, **tensors):
        super().__init__()
        self.tensors = nn.ParameterDict(tensors)

    def forward(self, state):
        return self.tensors["logits"]


def value_loss_module(config, logits, slow_logits):
    network = TensorDictSequential(
        TensorDictModule(Given(logits=logits), ["state"], ["state_value_logits"]),
        TensorDictModule(SymExpTwoHot(config.bins), ["state_value_logits"], ["state_value"]),
    )
    loss = DreamerV3ValueLoss(
        network,
        "two_hot",
        num_value_bins=config.bins,
        slow_critic_regularization=config.slow_critic_scale,
        reduction="none",
    )
    if config.slow_critic_scale:
        loss.target_value_model_params["module", "0", "module", "tensors", "logits"].data.copy_(slow_logits)
    return loss


def critic_loss(logits, slow_logits, returns, weight, config):
    data = {"state": returns[..., None], "lambda_target": returns[..., None], "discount_weight": weight[..., None]}
    return value_loss_module(config, logits, slow_logits)(TensorDict(data, returns.shape))[0]["loss_value"].detach()


def replay_critic_loss(logits, slow_logits, returns, is_last, config):
    """Each step is a sequence of its own, which ends with the next one: its return is the reward that arrives there."""
    steps = is_last.numel()
    logits, slow_logits = (x.reshape(steps, 1, -1).expand(-1, 2, -1).clone() for x in (logits, slow_logits))
    reward = returns.reshape(steps, 1, 1).expand(-1, 2, -1)
    here, end = is_last.reshape(steps, 1, 1).bool(), torch.ones(steps, 1, 1, dtype=torch.bool)
    following = {"reward": reward, "done": torch.cat([here, end], 1), "terminated": torch.cat([~end, end], 1)}
    data = TensorDict({"state": reward, "bootstrap": torch.zeros_like(reward), "next": following}, [steps, 2])
    return (
        value_loss_module(config, logits, slow_logits)
        .replay_value_loss(data)["loss_replay_value"]
        .reshape(is_last.shape)
    )


def update_slow_critic(slow, critic, decay):
    critic = {name: x for name, x in critic.items() if name.startswith("critic/")}
    if {name: x.shape for name, x in critic.items()} != {name: x.shape for name, x in slow.items()}:
        raise ValueError("slow must have the names and shapes of the critic")
    loss = DreamerV3ValueLoss(
        TensorDictModule(Given(**critic), ["state"], ["state_value"]), slow_critic_regularization=1.0
    )
    update = SoftUpdate(loss, eps=decay)
    targets = loss.target_value_model_params["module", "tensors"]
    for name, value in slow.items():
        targets[name].data.copy_(value)
    update.step()
    return {name: targets[name] for name in slow}
