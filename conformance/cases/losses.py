"""Checks of whole losses and of their derivatives: one for each output of `losses`, all from the same few passes.

The requirements are those that the output shows; spec/10-agent.md says what the losses are made of.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from conformance.case import Cases, Equal, Setting, judged
from conformance.cases.agent import (
    COMBINATIONS,
    GROUPS,
    LOSS_BOUND,
    WHOLE,
    Example,
    bound_of,
    example_of,
    latents_are,
    loss_magnitude,
)
from conformance.check import check
from conformance.compare import Comparisons

RECONSTRUCTIONS = ("AGT-15", "AGT-16", "WM-1", "WM-15", "WM-16", "NET-1", "CON-3", "CON-4", "CON-24")
REWARD_AND_CONTINUE = ("AGT-15", "AGT-16", "WM-1", "WM-6", "WM-15", "WM-16", "NET-1", "CON-4", "CON-13")
KL = ("AGT-14", "AGT-15", "AGT-16", "WM-9", "WM-15", "WM-16", "CON-1")
PREDICTIONS = (
    *("AGT-17", "AGT-18", "AGT-19", "AGT-20", "AGT-21", "AGT-27", "RET-3", "RET-4", "RET-6", "BEH-16"),
    *("RSSM-20", "RSSM-22", "NET-1", "CON-2", "CON-4", "CON-13", "CON-20", "CON-23"),
)
RANGE = (
    *("AGT-17", "AGT-18", "AGT-19", "AGT-21", "AGT-22", "RET-3", "RET-4", "RET-15", "BEH-16"),
    *("RSSM-20", "RSSM-22", "CON-13"),
)
ACTOR = (
    *("AGT-20", "AGT-22", "AGT-23", "RET-6", "RET-15", "BEH-11", "BEH-16", "BEH-17", "BEH-18"),
    *("NET-1", "CON-2", "CON-4"),
)
CRITIC = ("AGT-20", "AGT-21", "AGT-24", "RET-4", "RET-6", "BEH-16", "BEH-17", "BEH-18", "NET-1", "CON-4")
REPLAY_CRITIC = (
    *("AGT-25", "AGT-26", "RET-5", "RET-11", "BEH-16", "BEH-17", "BEH-18"),
    *("CON-1", "CON-2", "CON-13"),
)
TOTAL = ("AGT-26", "AGT-27", "BEH-17", "WM-15", "CON-23")

Ask = Callable[[Example], tuple[str, tuple[Any, ...]]]
"""The call that makes a pass over an example: the function and its arguments."""


def with_noise(example: Example) -> tuple[str, tuple[Any, ...]]:
    return "losses", example.problem.loss_arguments


def demands_of(example: Example, where: str, bound: float, reach: float = 1.0) -> dict[str, Equal]:
    """What every output must be, by its name. reach: size of the returns, to which rounding of their range is
    relative."""
    total, aux = example.losses
    size, range_ = loss_magnitude(aux), np.array(aux["return_range"])
    means = {
        name: Equal(mean, (1, group, name), where=where + name, magnitude=size, bound=bound)
        for group in ("losses", "metrics")
        for name, mean in aux[group].items()
    }
    deter, stoch = latents_are(aux, where, bound)
    return {
        "total": Equal(total, (0,), where=f"{where}total", bound=bound),
        "return_range": Equal(range_, (1, "return_range"), where=f"{where}return_range", magnitude=reach, bound=bound),
        "deter": deter,
        "stoch": stoch,
        **means,
    }


def passes(setting: Setting, *outputs: str, ask: Ask = with_noise) -> Cases:
    """A case for each kind of task, of the outputs with these names; "reconstruction" is that of every key."""
    for observation, action in COMBINATIONS:
        example = example_of(setting, observation, action)
        demands = demands_of(example, f"{observation}, {action}: ", bound_of(setting, 1e-9, LOSS_BOUND))
        chosen = [demand for name, demand in demands.items() if name.partition("/")[0] in outputs]
        relations = (all_losses(example),) if "total" in outputs else ()
        yield judged(*ask(example), *chosen, *relations)


def all_losses(example: Example) -> Callable[[Comparisons, Any], None]:
    names = set(example.losses[1]["losses"])

    def relation(c: Comparisons, result: Any) -> None:
        found = set(result[1]["losses"])
        c.holds(f"the losses are {sorted(names)}, got {sorted(found)}; this", found == names)

    return relation


@check("AGT-14", "AGT-15", "AGT-27", "CON-1", "CON-3", "CON-20", "CON-24", uses=["losses"], level=2, dtypes=WHOLE)
def latents_match(setting: Setting) -> Cases:
    """The posterior states that a pass returns."""
    yield from passes(setting, "deter", "stoch")


@check(*RECONSTRUCTIONS, uses=["losses"], level=2, dtypes=WHOLE)
def reconstructions_match(setting: Setting) -> Cases:
    """The reconstruction loss of every observation key."""
    yield from passes(setting, "reconstruction")


@check(*REWARD_AND_CONTINUE, uses=["losses"], level=2, dtypes=WHOLE)
def reward_and_continue_match(setting: Setting) -> Cases:
    """The losses of the reward head and the continue head."""
    yield from passes(setting, "reward", "continue")


@check(*KL, uses=["losses"], level=2, dtypes=WHOLE)
def dynamics_and_representation_match(setting: Setting) -> Cases:
    """The two KL losses."""
    yield from passes(setting, "dynamics", "representation")


@check(*PREDICTIONS, uses=["losses"], level=2, dtypes=WHOLE)
def predictions_match(setting: Setting) -> Cases:
    """The metrics of imagination: means of returns, values, rewards, continues, weights and entropies."""
    means = ("return_mean", "value_mean", "reward_mean", "continue_mean", "weight_mean", "actor_entropy")
    yield from passes(setting, *means)


@check(*RANGE, uses=["losses"], level=2, dtypes=WHOLE)
def return_range_matches(setting: Setting) -> Cases:
    """The return range after this pass, and the scale that is made of it."""
    yield from passes(setting, "return_range", "return_scale")


@check(*ACTOR, uses=["losses"], level=2, dtypes=WHOLE)
def actor_matches(setting: Setting) -> Cases:
    """The loss of the actor."""
    yield from passes(setting, "actor")


@check(*CRITIC, uses=["losses"], level=2, dtypes=WHOLE)
def critic_matches(setting: Setting) -> Cases:
    """The loss of the critic at imagined states."""
    yield from passes(setting, "critic")


@check(*REPLAY_CRITIC, uses=["losses"], level=2, dtypes=WHOLE)
def replay_critic_matches(setting: Setting) -> Cases:
    """The loss of the critic at replayed states."""
    yield from passes(setting, "replay_critic")


@check(*TOTAL, uses=["losses"], level=2, dtypes=WHOLE)
def total_matches(setting: Setting) -> Cases:
    """The weighted sum of all losses, and their names."""
    yield from passes(setting, "total")


# What reaches what: the table of [AGT-28].
WORLD = {"encoder", "core", "posterior"}
REACHES = {
    "reconstruction": WORLD | {"decoder"},
    "reward": WORLD | {"reward"},
    "continue": WORLD | {"continue"},
    "dynamics": WORLD | {"prior"},
    "representation": WORLD,
    "actor": {"actor"},
    "critic": {"critic"},
    "replay_critic": WORLD | {"critic"},
}
FLOW = ("AGT-28", "AGT-32", "CON-14")
INTO_THE_WORLD_MODEL = (*FLOW, "CON-15", "RSSM-23", "RSSM-24", "NET-25")


def derivatives(setting: Setting, *losses: str) -> Cases:
    """The derivatives of losses along random directions and within every group of parameters; where none may flow,
    exactly 0."""
    for observation, action in (("vector", "continuous"), ("both", "mixed")):
        example, where = example_of(setting, observation, action), f"{observation}, {action}: derivative of "
        expected = {name: x for name, x in example.derivatives.items() if name.partition("/")[0] in losses}
        arguments = (*example.problem.loss_arguments, list(example.directions.values()))
        # A derivative is a sum over parameters of both signs; central differences err by 1e-11 of the loss.
        demands = [
            Equal(x, (name,), where=where + name, magnitude=np.abs(x).max() + 1e-3, bound=bound_of(setting, 1e-6, 5e-3))
            for name, x in expected.items()
        ]
        yield judged("loss_derivatives", arguments, *demands, reach(where, list(expected), list(example.directions)))


def reach(where: str, names: list[str], labels: list[str]) -> Callable[[Comparisons, Any], None]:
    """The relation that derivatives are 0 along groups that the loss does not reach, and no others."""

    def relation(c: Comparisons, actual: Any) -> None:
        for name in names:
            for label, value in zip(labels, np.asarray(actual[name]), strict=True):
                reached = label not in GROUPS or label in REACHES[name.partition("/")[0]]
                is_zero = f"{where}{name} by the {label} parameters is {'not ' if reached else ''}0"
                c.holds(is_zero, (value != 0) == reached)

    return relation


@check(
    *(*INTO_THE_WORLD_MODEL, "WM-1", "WM-11", "WM-12", "WM-13", "WM-14", "WM-17"),
    uses=["loss_derivatives"],
    level=2,
    dtypes=WHOLE,
)
def derivatives_of_the_world_model_match(setting: Setting) -> Cases:
    """The losses of decoder, reward and continue head train their part and what the states are made of; the dynamics
    loss trains the prior, the representation loss does not, and both train what memories are made of."""
    yield from derivatives(setting, "reconstruction", "reward", "continue", "dynamics", "representation")


@check(
    *(*INTO_THE_WORLD_MODEL, "RSSM-25", "RET-18", "BEH-5", "BEH-10", "BEH-13", "BEH-15"),
    uses=["loss_derivatives"],
    level=2,
    dtypes=WHOLE,
)
def derivatives_of_actor_and_critic_match(setting: Setting) -> Cases:
    """The losses of actor and critic at imagined states train the actor and the critic alone; that of the critic at
    replayed states trains what the states are made of, too."""
    yield from derivatives(setting, "actor", "critic", "replay_critic")
