"""What a train step leaves behind whose loss or gradient is not finite, so that it can be looked at and repeated.
Implements [LOOP-44].

LOGDIR/nonfinite/<train step>/
  learner.safetensors   the training state that met the problem, under its canonical names
  batch.safetensors     the batch of that train step
  incident.json         which step, its seed and metrics, and a tally of every tensor that is not finite
"""

import dataclasses
import math
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from conformance.schema import closed, misfit, validator
from dreamer_spec.backend import Arrays, Learner
from dreamer_spec.disk.files import entries
from dreamer_spec.disk.folders import open_sealed, require_intact, write_folder
from dreamer_spec.errors import UserError
from dreamer_spec.system.machine import versions

FORMAT = 1
FILES = ("learner.safetensors", "batch.safetensors", "incident.json")
PACKAGES = ("dreamer-spec", "jax", "jaxlib", "torch", "numpy")

TEXT, OBJECT, COUNT = {"type": "string"}, {"type": "object"}, {"type": "integer", "minimum": 0}
NUMBER = {"anyOf": [{"type": "number"}, {"enum": ["nan", "inf", "-inf"]}]}  # JSON has none of these three.
METRICS = OBJECT | {"additionalProperties": NUMBER}
TENSOR = closed(
    {
        "kind": {"enum": ["batch", "state", "gradient"]},
        "name": TEXT,
        **dict.fromkeys(("elements", "nan", "inf", "negative_inf"), COUNT),
        "largest": {"type": ["number", "null"]},
    }
)
PROPERTIES = {
    **dict.fromkeys(("train_step", "step"), COUNT),
    "seed": COUNT | {"maximum": 2**31 - 1},
    **dict.fromkeys(("backend", "device"), TEXT),
    **dict.fromkeys(("identity", "spaces", "versions"), OBJECT),
    **dict.fromkeys(("metrics", "repeated"), METRICS),
    "tensors": {"type": "array", "items": TENSOR},
}
EXPECTED = validator(OBJECT | {"properties": PROPERTIES, "required": list(PROPERTIES)})


@dataclasses.dataclass(frozen=True)
class Tally:
    """How many of a tensor's numbers are not finite.

    kind: "batch", "state" or "gradient". name: in the batch, in the training state, or of the parameter. largest: of
    the absolute finite values; None if there are none.
    """

    kind: str
    name: str
    elements: int
    nan: int
    inf: int
    negative_inf: int
    largest: float | None

    @property
    def nonfinite(self) -> int:
        """How many are not finite."""
        return self.nan + self.inf + self.negative_inf


@dataclasses.dataclass(frozen=True)
class Incident:
    """An incident as it was saved.

    info: what `save_incident` was given, and format, seed, device, versions. metrics: of the train step; repeated: of
    the same step once more, up to the gradients. tallies: of all tensors that are not finite.
    """

    path: Path
    info: dict[str, Any]
    metrics: dict[str, float]
    repeated: dict[str, float]
    tallies: list[Tally]
    state: dict[str, np.ndarray]
    batch: dict[str, np.ndarray]


def tally(kind: str, name: str, array: np.ndarray) -> Tally:
    """Counts what is not finite in an array of any shape and dtype."""
    finite = array[np.isfinite(array)]
    largest = max(abs(float(finite.min())), abs(float(finite.max()))) if finite.size else None
    inf, negative_inf = (int(np.sum(array == end)) for end in (np.inf, -np.inf))
    return Tally(kind, name, array.size, array.size - finite.size - inf - negative_inf, inf, negative_inf, largest)


def offending(kind: str, arrays: Arrays) -> list[Tally]:
    """The tallies of those arrays that hold a number that is not finite."""
    tallies = (tally(kind, name, np.asarray(array)) for name, array in arrays.items())
    return [one for one in tallies if one.nonfinite]


def nonfinite(metrics: Mapping[str, float]) -> dict[str, float]:
    """The metrics that are not finite."""
    return {name: float(value) for name, value in metrics.items() if not math.isfinite(value)}


def save_incident(directory: Path, learner: Learner, batch: Arrays, seed: int, info: Mapping[str, Any]) -> Path:
    """Writes an incident, complete or not at all, and returns its folder. An older one of the same train step is
    replaced.

    Args:
      directory: of the run's logs.
      learner: in the state that met the problem, [LOOP-41].
      batch: of the train step, as `train_step` got it.
      seed: of the train step.
      info: "train_step" (train steps made before this one), "step" (environment steps), "backend", "identity"
        (Options.identity), "spaces" (Spaces.to_json) and "metrics" (name -> number that the train step returned).

    Raises:
      UserError: the disk refuses it.
    """
    state = learner.state_dict()
    repeated, gradients = learner.gradients(batch, seed)
    tallies = [*offending("batch", batch), *offending("state", state), *offending("gradient", gradients)]
    incident = {
        "format": FORMAT,
        **info,
        "seed": seed,
        "device": learner.device,
        "versions": {"python": platform.python_version(), **versions(PACKAGES)},
        "metrics": _to_json(info["metrics"]),
        "repeated": _to_json(repeated),
        "tensors": [dataclasses.asdict(one) for one in tallies],
    }
    final = directory / "nonfinite" / f"{info['train_step']:012d}"
    write_folder(final, dict(zip(FILES, (state, batch, incident), strict=True)), "incident")
    return final


def stop_error(path: Path, info: Mapping[str, Any]) -> UserError:
    """What a run ends with after `save_incident(...)` has returned `path`. info: as given there. [LOOP-41]"""
    names = list(nonfinite(info["metrics"]))
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return UserError(
        f"training stopped at train step {info['train_step']} (step {info['step']}), not finite: "
        f"{', '.join(names[:3])}{more}. The update "
        f"was not made. The state before it, the batch and the names of the tensors are in {path}: `train "
        f"inspect {path}` shows them. The "
        "same command continues from the last checkpoint; with --nonfinite skip it leaves such updates out"
    )


def newest_incident(logdir: Path) -> Path | None:
    """The folder of the last incident of a log directory, if it has any."""
    return max((path for path in entries(logdir / "nonfinite") if re.fullmatch("[0-9]{12}", path.name)), default=None)


def load_incident(path: Path) -> Incident:
    """An incident from its folder; nothing in it is trusted.

    Raises:
      UserError: a file is missing or damaged, or of another format.
    """
    try:
        sealed = open_sealed(path, FILES)
        require_intact(sealed, FILES)
        info = sealed.json(FILES[-1])
        if info.get("format") != FORMAT:
            raise ValueError(f"format {info.get('format')!r}; this version reads format {FORMAT}")
        if problem := misfit(info, EXPECTED):
            raise ValueError(f"{FILES[-1]}: {problem}")
        metrics, repeated = (
            {name: float(value) for name, value in info.pop(entry).items()} for entry in ("metrics", "repeated")
        )
        tallies = [Tally(**entry) for entry in info.pop("tensors")]
        return Incident(path, info, metrics, repeated, tallies, sealed.arrays(FILES[0]), sealed.arrays(FILES[1]))
    except (OSError, ValueError) as error:
        raise UserError(f"the incident {path} is damaged: {error}") from error


def _to_json(metrics: Mapping[str, float]) -> dict[str, Any]:
    numbers = {name: float(value) for name, value in metrics.items()}
    return {name: value if math.isfinite(value) else str(value) for name, value in numbers.items()}
