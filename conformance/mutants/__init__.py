"""Mutants: the reference with one realistic mistake each, one module for every chapter.

A check that catches no mutant checks nothing, and a candidate that behaves like a mutant probably has its mistake.
"""

from conformance.mutants import (
    agent,
    behavior,
    distributions,
    layers,
    networks,
    optimizer,
    replay,
    returns,
    rssm,
    training_loop,
    transforms,
    world_model,
)
from conformance.mutants.catalogue import Mutant, MutantAdapter, PlantedAdapter, planted
from conformance.mutants.trial import relevant, sound, trial

__all__ = ["MUTANTS", "Mutant", "MutantAdapter", "PlantedAdapter", "planted", "relevant", "sound", "trial"]

_CHAPTERS = (
    transforms,
    distributions,
    layers,
    rssm,
    networks,
    world_model,
    returns,
    behavior,
    optimizer,
    agent,
    replay,
    training_loop,
)

MUTANTS: dict[str, Mutant] = {mutant.name: mutant for chapter in _CHAPTERS for mutant in chapter.MUTANTS}
