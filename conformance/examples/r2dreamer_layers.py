"""What `r2dreamer_adapter` offers of single layers. Most are those of PyTorch, which their networks are made of."""

from types import SimpleNamespace as Namespace

import networks
from r2dreamer_agent import fill
from r2dreamer_networks import block_of, mlp_of, mlp_options, with_epsilon
from torch import nn
from torch.func import functional_call


def run(module, tensors, *inputs):
    fill(zip(module.parameters(), tensors, strict=True))
    return module(*inputs)


def linear(x, kernel, bias):
    return run(nn.Linear(*kernel.shape), (kernel.mT, bias), x)


def block_linear(x, kernel, bias):
    blocks, inputs, outputs = kernel.shape
    module = networks.BlockLinear(blocks * inputs, blocks * outputs, blocks)
    return run(module, block_of({"/kernel": kernel, "/bias": bias}, ""), x)


def rms_norm(x, scale, epsilon):
    """With the scale itself in place of the parameter, so that its gradient is seen."""
    return functional_call(nn.RMSNorm(len(scale), eps=epsilon), {"weight": scale}, x)


def silu(x):
    return nn.SiLU()(x)


def of_images(module, x, tensors=()):
    y = run(module, tensors, x.reshape(-1, *x.shape[-3:]).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    return y.reshape(*x.shape[:-3], *y.shape[1:])


def convolution(x, kernel, bias, stride):
    height, _, inputs, outputs = kernel.shape
    return of_images(
        networks.Conv2dSamePad(inputs, outputs, height, stride=stride), x, (kernel.permute(3, 2, 0, 1), bias)
    )


def max_pool(x):
    return of_images(nn.MaxPool2d(2, 2), x)


def upsample(x):
    return of_images(nn.Upsample(scale_factor=2, mode="nearest"), x)


def mlp(params, name, x, layers, epsilon):
    sizes = {len(params[f"{name}/hidden{layer}/bias"]) for layer in range(layers)}
    if len(sizes) > 1:
        raise NotImplementedError("layers of different widths")
    config = Namespace(units=sizes.pop(), norm_epsilon=epsilon)
    module = with_epsilon(networks.MLP(mlp_options("layers", layers, config), x.shape[-1]), config)
    return run(module, mlp_of(params, name, layers), x)


def dense(params, name, x, epsilon):
    parts = {f"layer/hidden0/{part}": params[f"{name}/{part}"] for part in ("kernel", "bias", "scale")}
    return mlp(parts, "layer", x, 1, epsilon)
