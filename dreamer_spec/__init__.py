"""Training for real: `train --backend jax|torch --task SUITE:NAME`. The way through: cli.py, options.py, training/.

The packages by level, the lowest first. A module imports from lower levels and from its own package: never from above,
never from another package of its level, never in a circle. tests/test_repository.py reads this table and checks it.

  errors, own_packages, suites, words          what the user can mend, in one line; how counts are said; protocols
  system                                       the process and its machine: cores, memory, threads, signals
  arguments, backend, kinds, options, resize   what a run is, and the interface to what trains
  translation                                  an environment's values as arrays, and flat actions as the environment's
  disk                                         what a run leaves: record, checkpoints, incidents; reading without trust
  envs, policy, replay                         environments; a trained agent with NumPy alone; the buffer of chapter 11
  monitoring, option_table                     what people see of a run; the options as one table
  report, training                             the HTML page about runs; a run from its options to its end
  scoring                                      final scores of runs, beside the paper's
  api, commands                                the interface from Python; the names of the commands beside training
  cli                                          the command line
  sweeping                                     many runs: what they are, who runs them, how far they are
  commands.*, __main__                         what each command does

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
    from dreamer_spec.training.separate_evaluation import Evaluation

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

_PLACES = {
    "Evaluation": "training.separate_evaluation",
    "Options": "options",
    "Policy": "policy",
    "UserError": "errors",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"dreamer_spec.{_PLACES.get(name, 'api')}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
