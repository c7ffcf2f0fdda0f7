"""What every column of the grid agrees on: the chapters, the numbers, the configuration, the spaces and the parameter table."""

from spec.config import Config, benchmarks, hyperparameters, load_config, profiles, sizes
from spec.parameters import Parameter, parameter_table
from spec.spaces import Discrete, Image, Spaces, Vector

__all__ = [
    "Config",
    "Discrete",
    "Image",
    "Parameter",
    "Spaces",
    "Vector",
    "benchmarks",
    "hyperparameters",
    "load_config",
    "parameter_table",
    "profiles",
    "sizes",
]
