"""Training for real: `train --backend jax|torch --task SUITE:NAME`. The way through: cli.py, options.py, loop.py.

From Python: docs/python.md. The names below are imported when they are asked for, so that `import dreamer_spec` costs
nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dreamer_spec.api import Training, evaluate, load_policy, make_options, train
    from dreamer_spec.errors import UserError
    from dreamer_spec.options import Options
    from dreamer_spec.policy import Policy
    from dreamer_spec.separate_evaluation import Evaluation

__all__ = [
    "Evaluation",
    "Options",
    "Policy",
    "Training",
    "UserError",
    "evaluate",
    "load_policy",
    "make_options",
    "train",
]

_PLACES = {"Evaluation": "separate_evaluation", "Options": "options", "Policy": "policy", "UserError": "errors"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"dreamer_spec.{_PLACES.get(name, 'api')}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
