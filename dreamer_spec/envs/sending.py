"""What an environment in a process of its own needs of this one: what makes it, and the Gymnasium ids that a script, or
what it has imported, has registered here."""

import dataclasses
import sys
import warnings
from collections.abc import Iterable
from contextlib import suppress
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector.utils import CloudpickleWrapper


def require_sendable(value: Any) -> None:
    """Raises whatever pickling the value for another process raises."""
    ForkingPickler.dumps(CloudpickleWrapper(value))


def known_here() -> list[EnvSpec]:
    """What is registered beside Gymnasium's own, as far as it can be sent to another process."""
    specs = [spec for spec in gymnasium.registry.values() if not str(spec.entry_point).startswith("gymnasium.")]
    return [spec for spec in map(_with_code, specs) if _is_sendable(spec)]


def register(specs: Iterable[EnvSpec]) -> None:
    """Makes them known in this process; what is known already stays. Their package registers them once more when it is
    imported: ale-py hundreds of them, with a warning for each."""
    if [spec for spec in specs if gymnasium.registry.setdefault(spec.id, spec) is spec]:
        warnings.filterwarnings("ignore", r".*Overriding environment", UserWarning)


def _with_code(spec: EnvSpec) -> EnvSpec:
    """`__main__:Maze` is another module in another process: the class itself takes its place."""
    module, _, name = str(spec.entry_point).partition(":")
    code = getattr(sys.modules["__main__"], name, None) if module == "__main__" else None
    return dataclasses.replace(spec, entry_point=code) if code else spec


def _is_sendable(spec: EnvSpec) -> bool:
    with suppress(Exception):
        require_sendable(spec)
        return True
    return False
