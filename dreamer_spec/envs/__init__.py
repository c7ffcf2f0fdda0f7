"""Environments in the form of spec/00-notation.md: tasks by name, spaces and values translated and checked, many run in
parallel."""

from dreamer_spec.envs.adapter import ContractEnv
from dreamer_spec.envs.contract_vector import Adapted, ContractVector
from dreamer_spec.envs.factory import env_maker, make_env
from dreamer_spec.envs.failure import Failure
from dreamer_spec.envs.history import History
from dreamer_spec.envs.records import Record, stored
from dreamer_spec.envs.spaces import doubts, random_actions, translate
from dreamer_spec.envs.trial import Trial, try_out
from dreamer_spec.envs.vector import Environments
from dreamer_spec.translation import Translation

__all__ = [
    "Adapted",
    "ContractEnv",
    "ContractVector",
    "Environments",
    "Failure",
    "History",
    "Record",
    "Translation",
    "Trial",
    "doubts",
    "env_maker",
    "make_env",
    "random_actions",
    "stored",
    "translate",
    "try_out",
]
