"""The agent of a checkpoint or a policy folder: what it is, read from files that nobody vouches for."""

import dataclasses
import platform
from collections.abc import Mapping
from typing import Any

import numpy as np

from dreamer_spec.arguments import check as check_keywords
from dreamer_spec.disk.checkpoint import Checkpoint
from dreamer_spec.disk.files import Arrays
from dreamer_spec.errors import UserError
from dreamer_spec.system.machine import own_version
from dreamer_spec.translation import Translation
from reference_numpy.shapes import require_shape
from spec import Config, Parameter, Spaces, hyperparameters, load_config, parameter_table

INFO = {
    "task": str,
    "step": int,
    "backend": str,
    "action_repeat": int,
    "image_size": int,
    "env_arg": dict,
    "source": dict,
    "versions": dict,
}
MOST_LAYERS = 1000  # of a network: no description is believed that would need more memory than the parameters


@dataclasses.dataclass(frozen=True)
class SavedAgent:
    """parameters: name -> float32 array. info: the entries of INFO; step: environment steps, with action repeat.

    translation: how values of the environment become arrays of the spaces, and actions the environment's.
    """

    config: Config
    spaces: Spaces
    parameters: Arrays
    info: dict[str, Any]
    translation: Translation


def agent_of(checkpoint: Checkpoint) -> SavedAgent:
    """The agent of a checkpoint.

    Raises:
      UserError: a file is damaged, or what they say is not an agent.
    """
    state, identity, counters = checkpoint.learner, checkpoint.info.get("identity"), checkpoint.info.get("counters")
    try:
        if not isinstance(identity, dict) or not isinstance(counters, dict):
            raise ValueError("checkpoint.json: expected the objects identity and counters")
        config = config_from_json({name: identity[name] for name in hyperparameters() if name in identity})
        spaces = Spaces.from_json(checkpoint.info.get("spaces"))
        translation = Translation.from_json(checkpoint.info.get("translation"), spaces)
        info: dict[str, Any] = {name: identity.get(name) for name in ("task", "action_repeat", "image_size")}
        info |= {"env_arg": identity.get("env_arg") or {}, "time_limit": identity.get("time_limit")}
        info |= {"step": counters.get("records"), "backend": checkpoint.info.get("backend"), "versions": versions()}
        info["source"] = {
            "checkpoint": str(checkpoint.path),
            "seed": identity.get("seed"),
            "train_steps": counters.get("train_steps"),
        }
        check_info(info, spaces)
        info["step"] *= info["action_repeat"]
        trained = {name.removeprefix("params/"): array for name, array in state.items() if name.startswith("params/")}
        return SavedAgent(
            config, spaces, checked_parameters(trained, parameter_table(config, spaces)), info, translation
        )
    except ValueError as error:
        raise UserError(f"the checkpoint {checkpoint.path} does not hold an agent: {error!s:.500}") from error


def config_from_json(values: Any) -> Config:
    """The inverse of `dataclasses.asdict` through JSON.

    Raises:
      ValueError: a hyperparameter is missing, unknown or has a value that no agent could have.
    """
    if not isinstance(values, dict):
        raise ValueError(f"configuration: expected an object, got {values!r:.80}")
    if names := sorted(set(values) ^ {field.name for field in dataclasses.fields(Config)}):
        raise ValueError(f"hyperparameters that are missing or unknown: {', '.join(names[:5])}")
    config = load_config(**values)
    for name, value in values.items():
        count = len(value) if isinstance(value, list) else value
        if (name.endswith("_layers") or isinstance(value, list)) and count > MOST_LAYERS:
            raise ValueError(f"hyperparameter {name} is {value!r:.80}; expected at most {MOST_LAYERS} layers")
    return config


def check_info(info: Mapping[str, Any], spaces: Spaces) -> None:
    """Raises:
    ValueError: an entry of `info` is missing, of another kind, or not what the spaces say.
    """
    for name, kind in INFO.items():
        if type(info.get(name)) is not kind:
            raise ValueError(f"expected a {kind.__name__} as {name}, got {info.get(name)!r:.80}")
    if not info["task"].isprintable():
        raise ValueError(f"the task {info['task']!r:.80} holds characters that cannot be printed")
    check_keywords(info.get("env_arg"))
    time_limit = info.get("time_limit")
    if time_limit is not None and (type(time_limit) is not int or time_limit < 1):
        raise ValueError(f"time_limit is {time_limit!r:.80}; expected null or a whole number of at least 1")
    for name, least in (("step", 0), ("action_repeat", 1), ("image_size", 1)):
        if info[name] < least:
            raise ValueError(f"{name} is {info[name]}; expected at least {least}")
    for key, image in spaces.images.items():
        if image.height != info["image_size"] or image.width != info["image_size"]:
            raise ValueError(
                f"the image {key!r} is {image.height} x {image.width}, but image_size is {info['image_size']}"
            )


def checked_parameters(arrays: Mapping[str, np.ndarray], table: Mapping[str, Parameter]) -> Arrays:
    """The arrays, after they were compared with the parameter table.

    Raises:
      ValueError: other names, shapes or dtypes than the table's in float32, or a number that is not finite.
    """
    if names := sorted(set(arrays) ^ set(table)):
        raise ValueError(f"parameters that are missing or too many for this configuration: {', '.join(names[:5])}")
    for name, entry in table.items():
        require_shape(f"parameter {name}", arrays[name].shape, *entry.shape)
        if arrays[name].dtype != np.float32:
            raise ValueError(f"parameter {name}: expected the dtype float32, got {arrays[name].dtype}")
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"parameter {name} holds numbers that are not finite")
    return dict(arrays)


def acting_table(config: Config, spaces: Spaces) -> dict[str, Parameter]:
    """The entries of the parameter table that the policy step reads: encoder, recurrent model without the prior,
    actor."""
    return {
        name: entry
        for name, entry in parameter_table(config, spaces).items()
        if name.startswith(("encoder/", "rssm/", "actor/")) and not name.startswith("rssm/prior/")
    }


def versions() -> dict[str, str]:
    """Of what writes a policy now."""
    return {"dreamer-spec": own_version(), "python": platform.python_version(), "numpy": np.__version__}
