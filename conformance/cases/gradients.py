"""Gradients of single functions, seen through the losses: where infinities, ties and norms make automatic
differentiation go wrong."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from conformance.case import Cases, Equal, Setting, judged, related
from conformance.cases.agent import LOSS_BOUND, SAMPLING_MARGIN, WHOLE, Example, bound_of
from conformance.cases.losses import demands_of
from conformance.check import check
from conformance.compare import Comparisons
from conformance.problems import Problem, make_problem, unusual_problem, with_sampling_margin
from conformance.settled import settled
from reference_numpy import agent
from reference_numpy.transforms import exponential_bins, twohot
from reference_numpy.world_model import continue_target

UNUSUAL = 4  # problems with drawn options in a run of the checks
MASKED = ("rssm/posterior/out/bias", "rssm/prior/out/bias", "actor/out/buttons/logits/bias")


@functools.lru_cache(maxsize=8)
def masked_problem(seed: int, profile: str, dtype: str) -> Problem:
    """No mixtures; one class of the first latent and one of an action have probability 0. No sample lies near a
    boundary."""

    def draw(attempt: int) -> Problem:
        problem = make_problem(
            1000 * seed + attempt, profile, "vector", "mixed", dtype, latent_unimix=0.0, actor_unimix=0.0, free_nats=0.0
        )
        for name in MASKED:
            problem.state["params"][name][1] = -np.inf
        return problem

    return with_sampling_margin(draw, SAMPLING_MARGIN)


@check(
    "DIS-2", "DIS-4", "DIS-9", "DIS-12", "DIS-14", "DIS-21", "BEH-7", uses=["loss_derivatives"], level=2, dtypes=WHOLE
)
def impossible_classes_have_finite_gradients(setting: Setting) -> Cases:
    """Every loss has its finite derivative where a latent and an action have classes of probability 0."""
    problem = masked_problem(setting.seed, setting.profile, setting.dtype)
    params, rng = problem.state["params"], setting.rng()
    directions = [{name: rng.normal(size=value.shape) / 16 for name, value in params.items()} for _ in range(3)]
    names = list(agent.losses(*problem.loss_arguments)[1]["losses"])

    def means(point: Any) -> np.ndarray:
        losses = agent.losses(point, *problem.loss_arguments[1:])[1]["losses"]
        return np.array([losses[name] for name in names])

    expected = np.array([agent.directional_derivative(means, params, direction, 1e-5) for direction in directions]).T
    bound = bound_of(setting, 1e-6, 5e-3)
    demands = [
        Equal(x, (name,), where=f"derivative of {name}", magnitude=np.abs(x).max() + 1e-3, bound=bound)
        for name, x in zip(names, expected, strict=True)
    ]
    yield judged("loss_derivatives", (*problem.loss_arguments, directions), *demands)


@check("DIS-14", "DIS-17", uses=["loss_derivatives"], level=2, dtypes=WHOLE)
def constant_outputs_have_the_gradients_of_the_chapter(setting: Setting) -> Cases:
    """The derivative of the continue loss is sigmoid - target at the logits 0, 800 and -800; that of the reward loss
    softmax - two-hot."""
    problem = make_problem(setting.seed, setting.profile, "vector", "discrete", setting.dtype)
    config, along = problem.config, setting.rng().normal(size=problem.config.bins)
    directions = [{"continue/out/bias": np.ones(1)}, {"reward/out/bias": along}]
    target = continue_target(problem.batch["is_terminal"], config).mean()
    weights = twohot(problem.batch["reward"], exponential_bins(config.bins)).mean((0, 1))
    of_reward = (1 / config.bins - weights) @ along
    for logit, probability in ((0.0, 0.5), (800.0, 1.0), (-800.0, 0.0)):
        params = dict(problem.state["params"])
        for name in ("continue/out/kernel", "reward/out/kernel", "reward/out/bias"):
            params[name] = np.zeros_like(params[name])
        params["continue/out/bias"] = np.array([logit])
        demands = [
            Equal(x, (name,), where=f"derivative of {name}", magnitude=1.0, bound=bound_of(setting, 1e-6, 1e-5))
            for name, x in (
                ("continue", np.array([probability - target, 0])),
                ("reward", np.array([0, of_reward])),
            )
        ]
        yield judged("loss_derivatives", (params, *problem.loss_arguments[1:], directions), *demands)


@functools.lru_cache(maxsize=8)
def problem_without_epsilon(seed: int, profile: str, dtype: str) -> Problem:
    """All observations and actions, and norms that are exact up to 1e-12."""

    def draw(attempt: int) -> Problem:
        return make_problem(1000 * seed + attempt, profile, "both", "mixed", dtype, norm_epsilon=1e-12)

    return with_sampling_margin(draw, SAMPLING_MARGIN)


@check("LAY-4", "LAY-8", uses=["loss_derivatives"], level=2, dtypes=WHOLE)
def normalized_layers_have_no_gradient_along_themselves(setting: Setting) -> Cases:
    """A norm undoes longer kernels and biases, so no loss changes along them: the gradient passes through the mean
    square too."""
    problem = problem_without_epsilon(setting.seed, setting.profile, setting.dtype)
    params = problem.state["params"]
    layers = [name.removesuffix("/scale") for name in params if name.endswith("/scale") and "stem" not in name]
    along = {f"{layer}/{part}": params[f"{layer}/{part}"] / 16 for layer in layers for part in ("kernel", "bias")}
    across = {f"{layer}/scale": params[f"{layer}/scale"] / 16 for layer in layers}
    names = list(agent.losses(*problem.loss_arguments)[1]["losses"])

    def flat(c: Comparisons, actual: Any) -> None:
        for name in names:
            zero, size = actual[name]
            bound = bound_of(setting, 1e-6, 1e-3)
            c.compare(f"derivative of {name}", zero, 0.0, magnitude=abs(size) + 0.1, bound=bound)

    yield judged("loss_derivatives", (*problem.loss_arguments, [along, across]), flat)


@check("LAY-12", uses=["gradients"], level=2, dtypes=WHOLE)
def the_first_of_equal_pixels_has_the_gradient(setting: Setting) -> Cases:
    """Where the four pixels of every window are equal, the gradient is the one that holds nearby, where the first is a
    little larger.

    The image repeats a 2x2 pattern and the first layer sees only its middle tap, so its output is the same at every
    window, and the gradient of that tap is the pixel that was chosen, times what comes from above.
    """
    pooled = {"cnn_sampling": "pooled", "cnn_outer": False, "cnn_multipliers": (2, 4)}
    problem = make_problem(setting.seed, setting.profile, "image", "discrete", setting.dtype, **pooled)
    pattern = np.array([[240, 30], [100, 5]], np.uint8)
    batch = {**problem.batch, "image": np.tile(pattern[..., None], (*problem.batch["reward"].shape, 6, 8, 3))}
    kernel = "encoder/image/conv0/kernel"
    middle = np.zeros_like(problem.state["params"][kernel])
    middle[2, 2] = np.abs(problem.state["params"][kernel][2, 2])

    def same(c: Comparisons, equal: Any, nearby: Any) -> None:
        chosen, expected = (np.asarray(gradients[kernel])[2, 2] for gradients in (equal, nearby))
        c.compare("gradient of the middle tap", chosen, expected, magnitude="tensor", bound=1e-2)

    calls = []
    for size in (0.0, 1e-5):
        state = {**problem.state, "params": {**problem.state["params"], kernel: size * middle}}
        changed = dataclasses.replace(problem, state=state, batch=batch)
        calls.append(("gradients", changed.loss_arguments))
    yield related(same, *calls)


@functools.lru_cache(maxsize=32)
def unusual_example(seed: int, number: int, profile: str, dtype: str) -> Example:
    """In bfloat16 rounding could change a sample, or whether the free nats clip a time step: there every uniform number
    lies in the middle of the likeliest class, and nothing is clipped."""
    problem = unusual_problem(seed, number, profile, dtype)
    if dtype == "bfloat16":
        problem = dataclasses.replace(problem, config=dataclasses.replace(problem.config, free_nats=0.0))
    return Example(settled(problem, 1.0 if dtype == "bfloat16" else SAMPLING_MARGIN), seed)


OPTIONS = ("AGT-15", "AGT-26", "AGT-27", "NET-1", "WM-1", "BEH-10", "CON-4")


@check(*OPTIONS, uses=["losses"], level=2, dtypes=WHOLE)
def losses_with_unusual_options_match(setting: Setting) -> Cases:
    """Losses, metrics and latents where every option is drawn, for images alone, several images, vectors alone, and
    every kind of action."""
    for number in range(UNUSUAL):
        example = unusual_example(setting.seed, number, setting.profile, setting.dtype)
        reach = max(1.0, *map(abs, example.losses[1]["return_range"]))
        demands = demands_of(example, f"options {number}: ", bound_of(setting, 1e-9, LOSS_BOUND), reach)
        yield judged("losses", example.problem.loss_arguments, *demands.values())


@check("AGT-28", "AGT-32", "CON-14", "CON-23", "NET-25", uses=["gradients"], level=2)
def every_tensor_has_its_gradient(setting: Setting) -> Cases:
    """The gradient of every tensor along itself and along random signs, in every precision, where every option is
    drawn: its length is right then, and so is its angle."""
    # In bfloat16 layers of 8 to 12 units err by up to 0.16 of a gradient in PyTorch, over 8 seeds and both profiles.
    bound = {"float64": 1e-5, "float32": 1e-3, "bfloat16": 0.3}[setting.dtype]
    # In bfloat16 layer by layer: a sum over more would hide one tensor behind the rounding of the others.
    group = (lambda name: name.rpartition("/")[0]) if setting.dtype == "bfloat16" else (lambda name: name.split("/")[0])
    for number in range(UNUSUAL):
        example = unusual_example(setting.seed, number, setting.profile, setting.dtype)
        relation = functools.partial(by_group, example, group, f"options {number}", bound)
        yield judged("gradients", example.problem.loss_arguments, relation)


def by_group(
    example: Example, group: Callable[[str], str], where: str, bound: float, c: Comparisons, gradients: Any
) -> None:
    """The relation of gradients to derivatives of the total: one number for each group, to which each of its tensors
    contributes alike, however long its gradient is."""
    rng = np.random.default_rng(example.seed)
    found = {name: np.asarray(gradients[name], np.float64) for name in example.problem.state["params"]}
    least = 1e-3 * np.sqrt(sum(float((x**2).sum()) for x in found.values()))
    for label in dict.fromkeys(map(group, found)):
        along = {}
        for name in [name for name in found if group(name) == label]:
            size = max(float(np.linalg.norm(found[name])), least)
            signs = rng.choice([-1.0, 1.0], found[name].shape)
            along[name] = (found[name] / size + signs / np.sqrt(signs.size)) / size
        length = np.sqrt(sum(float((x**2).sum()) for x in along.values()))
        product = sum(float((found[name] * x).sum()) for name, x in along.items()) / length
        derivative = example.total_derivative({name: x / length for name, x in along.items()})
        what = f"{where}: gradient of {label}"
        c.compare(what, product, derivative, magnitude=max(len(along) / length, abs(derivative)), bound=bound)
