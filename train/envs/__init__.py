"""Environments in the form of spec/00-notation.md: tasks by name, spaces and values translated and checked, many run in parallel."""

from train.envs.adapter import ContractEnv
from train.envs.factory import env_maker, make_env
from train.envs.failure import Failure
from train.envs.history import History
from train.envs.spaces import doubts, random_actions, translate
from train.envs.trial import Trial, try_out
from train.envs.vector import Environments, Record
from train.translation import Translation

__all__ = [
    "ContractEnv",
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
    "translate",
    "try_out",
]
