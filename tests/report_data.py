"""A small adapter with a pass, a failure, an error and a function that is not offered, and the result of checking
it."""

import types
from collections.abc import Mapping
from typing import Any

from conformance.candidate import ModuleAdapter
from conformance.execute import CheckOptions, run_check, selected_checks
from conformance.expected import ExpectedFailures
from conformance.offered import offered
from conformance.results import result_data

CHECKS = {check.name: check for check in selected_checks("float64")}
PASS, FAIL, ERROR, ABSENT = (
    "transforms.symlog_matches",
    "returns.lambda_return_literals",
    "layers.rms_norm_literals",
    "layers.silu_literals",
)
HOSTILE = '<script>alert(1)</script> & "quoted" | `code` ```\x00\x1b[31m [bold]x[/bold] ]]>'
DIAGNOSIS = {
    "mutant": "return_bootstraps_from_itself",
    "explanation": "lambda-return bootstraps from its own value",
    "provenance": "the paper's printed indices",
    "chapter": "spec/07-returns.md",
    "requirements": ["RET-1"],
    "fix": "Use the state that is reached.",
    "explained": [FAIL],
    "unexplained": [],
    "alternatives": [],
}
ADAPTER = """
import numpy as np

__version__ = "1.2"


def symlog(x):
    return np.sign(x) * np.log1p(np.abs(x))


def lambda_return(reward, continue_, value, discount, lambda_):
    last, result = value[:, -1], []
    for t in reversed(range(reward.shape[1] - 1)):
        last = reward[:, t + 1] + discount * continue_[:, t + 1] * ((1 - lambda_) * value[:, t] + lambda_ * last)
        result.insert(0, last)
    return np.stack(result, 1)


def rms_norm(x, scale, epsilon):
    raise RuntimeError("out of order")
"""


def settings(**changes: Any) -> CheckOptions:
    base = {
        "candidate": "mine.py",
        "process": False,
        "dtype": "float64",
        "device": None,
        "edition": "paper",
        "only": "",
    }
    return CheckOptions(**{**base, "seed": 3, "examples": 5, "at_least": 1, **changes})


def adapter(source: str = ADAPTER) -> ModuleAdapter:
    module = types.ModuleType("mine")
    exec(source, vars(module))
    return ModuleAdapter(module, "float64")


def make(
    names: tuple[str, ...] = (PASS, FAIL, ERROR, ABSENT), reasons: Mapping[str, str] | None = None, **changes: Any
) -> dict[str, Any]:
    asked = settings(**changes)
    results = [run_check(CHECKS[name], adapter(), asked.setting) for name in names]
    return result_data(
        asked,
        {"name": "mine", "version": "1.2", "edition": None, "offered": offered(adapter())},
        results,
        ExpectedFailures(reasons or {}),
        [DIAGNOSIS],
    )
