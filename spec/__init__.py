"""What all implementations agree on: chapters, numbers, configuration, spaces and parameter table."""

from spec.config import Config, benchmarks, hyperparameters, load_config, profiles, sizes
from spec.editions import Difference, Edition, built_profiles, editions, find_edition
from spec.parameters import Parameter, parameter_table
from spec.spaces import Discrete, Image, Spaces, Vector

__all__ = [
    "Config",
    "Difference",
    "Discrete",
    "Edition",
    "Image",
    "Parameter",
    "Spaces",
    "Vector",
    "benchmarks",
    "built_profiles",
    "editions",
    "find_edition",
    "hyperparameters",
    "load_config",
    "parameter_table",
    "profiles",
    "sizes",
]
