"""Our adapter. The code base is time first and flat; `third_party_code` itself stays as it is."""

import third_party_code as code
import torch

__version__ = "2.1"
convert = torch.as_tensor


def time_first(x):
    return x.swapaxes(0, 1)[..., None]


def lambda_return(reward, continue_, value, discount, lambda_):
    reward, continue_, value = (time_first(x[:, 1:]) for x in (reward, continue_, value))
    return code.lambda_values(reward, value, discount * continue_, value[-1], lambda_)[..., 0].swapaxes(0, 1)


def twohot(x, bins):
    return code.TwoHot(None, bins).encode(x)


def symexp_twohot_loss(logits, target, bins):
    return -code.TwoHot(logits, bins).log_prob(target)


def kl_losses(posterior_logits, prior_logits, config):
    return code.kl_loss(posterior_logits, prior_logits, config.free_nats, config.latent_unimix)


def core(params, deter, stoch, action, config):
    cell = code.Cell(
        config.deter, config.stoch * config.classes, action.shape[-1], config.units, config.blocks, config.norm_epsilon
    )
    state = {f"mix.{part}": params[f"rssm/hidden/{name}"] for part, name in (("0.bias", "bias"), ("1.weight", "scale"))}
    state["mix.0.weight"] = params["rssm/hidden/kernel"].mT
    state |= {"gates.weight": params["rssm/gru/kernel"].mT, "gates.bias": params["rssm/gru/bias"]}
    for i, name in enumerate(("rssm/embed_deter", "rssm/embed_stoch", "rssm/embed_action")):
        state |= {f"inputs.{i}.0.weight": params[f"{name}/kernel"].mT, f"inputs.{i}.0.bias": params[f"{name}/bias"]}
        state[f"inputs.{i}.1.weight"] = params[f"{name}/scale"]
    cell.double().load_state_dict(state)
    return cell(deter, stoch.flatten(-2), action)


def draw_categorical(logits, unimix, seed, n):
    torch.manual_seed(seed)
    return code.unimix_dist(logits, unimix).sample((n,))
