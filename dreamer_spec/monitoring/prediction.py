"""Open-loop predictions of recorded episodes: record, predict, measure. Chapter: spec/06-world-model.md; pictures:
dreamer_spec/monitoring/pictures.py.

Sequences are a mapping of [B, T, ...] arrays: the observation keys, "reward", "is_first", "is_terminal" and "action",
the flat action that was taken after each observation.
"""

from collections.abc import Mapping

import numpy as np

from dreamer_spec.backend import Learner
from dreamer_spec.envs import Record
from reference_numpy.transforms import symlog
from spec import Discrete, Image, Spaces

CONTEXT = 5  # records that are seen, as in the paper's figure
STEPS = 50  # records in all
ROWS = 6  # sequences

Sequences = Mapping[str, np.ndarray]


class SequenceRecorder:
    """Keeps the first `STEPS` records of up to `ROWS` environments, and the actions taken at them."""

    def __init__(self) -> None:
        self._steps: list[dict[str, np.ndarray]] = []

    def add(self, record: Record, action: np.ndarray) -> None:
        """To be called at every step, with records [N, ...] and the flat actions [N, A] taken after them."""
        if len(self._steps) < STEPS:
            self._steps.append({name: np.array(value[:ROWS]) for name, value in {**record, "action": action}.items()})

    def sequences(self) -> dict[str, np.ndarray] | None:
        """What was recorded, or None if it is too short to predict anything."""
        if len(self._steps) <= CONTEXT:
            return None
        return {name: np.stack([step[name] for step in self._steps], axis=1) for name in self._steps[0]}


def predict(learner: Learner, spaces: Spaces, sequences: Sequences, seed: int) -> dict[str, np.ndarray]:
    """The open-loop prediction of sequences after `CONTEXT` steps: see `Learner.predict`. seed: of its random numbers.

    Sequences shorter than `STEPS` are filled up, and the result cut again: a backend may compile for every length,
    and nothing that comes later changes what is predicted before.
    """
    steps = sequences["is_first"].shape[1]
    action = sequences["action"]
    given = {key: sequences[key] for key in spaces.observations} | {
        "prev_action": np.concatenate([np.zeros_like(action[:, :1]), action[:, :-1]], axis=1),  # [CON-12]
        "is_first": sequences["is_first"],
    }
    full = {
        name: np.concatenate([value, np.repeat(value[:, -1:], STEPS - steps, axis=1)], axis=1)
        for name, value in given.items()
    }
    observation = {key: full[key] for key in spaces.observations}
    predicted = learner.predict(observation, full["prev_action"], full["is_first"], CONTEXT, seed)
    return {name: np.asarray(value)[:, :steps] for name, value in predicted.items()}


def prediction_errors(
    spaces: Spaces, truth: Sequences, predicted: Sequences, context: int = CONTEXT
) -> dict[str, float]:
    """How far predictions are off: `prediction/<key>_error`, and `prediction/<key>_context_error` where the model had
    seen the observation.

    Means over sequences, steps and entries: for images of the squared error of the brightness in [0, 1]; for vectors
    and the reward of the squared error in symlog space; for a Discrete of the probability that the true class did not
    get. A prediction counts up to the end of the episode: how the next one begins, nobody could foresee. Where every
    episode ends with the context, `_error` is missing.
    """
    errors = {key: _errors(space, truth[key], predicted[key]) for key, space in spaces.observations.items()}
    errors["reward"] = _squared_symlog_error(truth["reward"], predicted["reward"])
    counts = ~np.logical_or.accumulate(truth["is_first"][:, context:], axis=1)
    result = {}
    for key, error in errors.items():
        each = error.reshape(*error.shape[:2], -1).mean(axis=-1, dtype=np.float64)
        if counts.any():
            result[f"prediction/{key}_error"] = float(each[:, context:][counts].mean())
        result[f"prediction/{key}_context_error"] = float(each[:, :context].mean())
    return result


def _errors(space: object, truth: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    if isinstance(space, Image):
        return np.square(predicted - truth.astype(np.float32) / 255)
    if isinstance(space, Discrete):
        return 1 - true_class_probabilities(space, truth, predicted)
    return _squared_symlog_error(truth, predicted)


def _squared_symlog_error(truth: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    return np.square(symlog(predicted) - symlog(truth))


def true_class_probabilities(space: Discrete, truth: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """What was given to the class that came: classes [..., entries] and probabilities [..., sum of classes] -> [...,
    entries]."""
    first = np.cumsum((0, *space.classes[:-1]))
    return np.take_along_axis(predicted, truth + first, axis=-1)
