"""How far two results of a train step are apart, tensor by tensor, and how far they may be.

Tensors of a state are measured against the way they have come: ‖a - b‖ / ‖b - c‖, Euclidean norms over all numbers of a
tensor, where b is the baseline's and c the state in which both were last the same. 1e-12 means that twelve digits of
what training did are the same, 1 that the two have nothing in common. The way counts as at least a millionth of ‖b‖,
far less than one update: where nothing moves, the last bit of a stored number must not look like a different way.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

Nested = Mapping[str, Any]

PARTS = ("encoder", "rssm", "decoder", "reward", "continue", "actor", "critic")
LEAST_WAY = 1e-6
# In the order in which a train step computes them, so that the first to deviate is the closest to the cause.
GROUPS = ("samples", "latents", "losses", "return range", "second moments", "momenta", *PARTS, "slow critic")


@dataclasses.dataclass(frozen=True)
class Tensor:
    """One tensor of two results: its group, the parameter's part that it belongs to, its name, and the deviation."""

    group: str
    part: str
    name: str
    deviation: float


def deviations(actual: tuple[Nested, Nested], expected: tuple[Nested, Nested], origin: Nested) -> Iterator[Tensor]:
    """Every tensor of (state, aux) of a train step against the baseline's, in the order of GROUPS; origin: the last
    common state.

    Raises:
      KeyError: a result lacks something.
    """
    (state, aux), (expected_state, expected_aux) = actual, expected
    yield Tensor("samples", "rssm", "posterior samples", share_of_others(aux["stoch"], expected_aux["stoch"]))
    yield Tensor("latents", "rssm", "deter", beyond_one(aux["deter"], expected_aux["deter"]))
    for name, loss in expected_aux["losses"].items():
        yield Tensor("losses", name.partition("/")[0], f"loss {name}", beyond_one(aux["losses"][name], loss))
    ends = (
        np.array([float(x["return_range"][end]) for end in ("low", "high")]) for x in (state, expected_state, origin)
    )
    yield Tensor("return range", "critic", "return_range", of_the_way(*ends))
    for group, key in (("second moments", "second_moment"), ("momenta", "momentum")):
        moments = (x["optimizer"][key] for x in (state, expected_state, origin))
        yield from _tensors(group, f"optimizer/{key}", *moments)
    yield from _tensors(None, "params", *(x["params"] for x in (state, expected_state, origin)))
    yield from _tensors("slow critic", "slow_critic", *(x["slow_critic"] for x in (state, expected_state, origin)))


def _tensors(group: str | None, prefix: str, actual: Nested, expected: Nested, origin: Nested) -> Iterator[Tensor]:
    """group None: each tensor belongs to the group of its part."""
    for name, value in expected.items():
        part = name.partition("/")[0]
        yield Tensor(group or part, part, f"{prefix}/{name}", of_the_way(actual[name], value, origin[name]))


def share_of_others(actual: Any, expected: Any) -> float:
    """Of the one-hot samples [..., C], the share that is of another class; infinite where shapes differ."""
    if np.shape(actual) != np.shape(expected):
        return math.inf
    return float(np.mean(np.any(np.round(actual) != np.round(expected), -1)))


def of_the_way(actual: Any, expected: Any, origin: Any) -> float:
    """‖actual - expected‖ / ‖expected - origin‖; infinite where shapes differ, numbers are not finite, or only one of
    them left zero."""
    actual, expected, origin = (np.asarray(x, np.float64) for x in (actual, expected, origin))
    if actual.shape != expected.shape:
        return math.inf
    gap = float(np.linalg.norm(actual - expected))
    way = max(float(np.linalg.norm(expected - origin)), LEAST_WAY * float(np.linalg.norm(expected)))
    if gap == 0:
        return 0.0
    return gap / way if way and math.isfinite(gap / way) else math.inf


def beyond_one(actual: Any, expected: Any) -> float:
    """The largest |actual - expected|, relative to the largest |expected| if that is above 1."""
    actual, expected = (np.asarray(x, np.float64) for x in (actual, expected))
    if actual.shape != expected.shape:
        return math.inf
    deviation = float(np.max(np.abs(actual - expected)) / max(1.0, float(np.max(np.abs(expected)))))
    return deviation if math.isfinite(deviation) else math.inf
