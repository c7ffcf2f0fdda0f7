"""Environments in the form of spec/00-notation.md: tasks by name, spaces and values translated and checked, many run in parallel."""

from train.envs.adapter import ContractEnv
from train.envs.factory import make_env
from train.envs.failure import Failure
from train.envs.history import History
from train.envs.spaces import Translation, random_actions, translate
from train.envs.trial import Trial, try_out
from train.envs.vector import Environments, Record

__all__ = [
    "ContractEnv",
    "Environments",
    "Failure",
    "History",
    "Record",
    "Translation",
    "Trial",
    "make_env",
    "random_actions",
    "translate",
    "try_out",
]
