"""Adapters made of functions, and a single check of them."""

import types
from typing import Any

from conformance.candidate import ModuleAdapter
from conformance.case import Setting
from conformance.execute import Result, run_check, selected_checks
from conformance.problems import small_config

CHECKS = {check.name: check for check in selected_checks("float64")}
CONFIG = small_config("paper")  # S = 3, C = 5


def module(**functions: Any) -> ModuleAdapter:
    made = types.ModuleType("mine")
    vars(made).update(functions)
    return ModuleAdapter(made, "float64")


def run(name: str, adapter: object, dtype: str = "float64") -> Result:
    return run_check(CHECKS[name], adapter, Setting(dtype, "paper", examples=5))
