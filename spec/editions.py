"""The editions of the algorithm, and where each leaves the requirements. The data are in editions.toml."""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any


@dataclasses.dataclass(frozen=True)
class Difference:
    """What holds in an edition in place of a requirement.

    instead: a sentence. like: the mutant of the reference that behaves so. settings: hyperparameters that the edition's
    profile sets, by which the requirement itself allows it. With neither, the edition's way is not modelled here.
    """

    instead: str
    like: str | None = None
    settings: tuple[str, ...] = ()

    @property
    def is_modelled(self) -> bool:
        return self.like is not None or bool(self.settings)


@dataclasses.dataclass(frozen=True)
class Edition:
    """One edition.

    title, source, date: which program or text it is. profile: the name of its values.
    differs: requirement id -> what holds instead.
    beyond: "chapter.function" of the reference, what the edition has otherwise without a model here.
    """

    name: str
    title: str
    source: str
    date: str
    profile: str
    differs: Mapping[str, Difference]
    beyond: tuple[str, ...]

    @property
    def mutants(self) -> tuple[str, ...]:
        """The names of the mutants that together are the edition's own reference."""
        return tuple(dict.fromkeys(difference.like for difference in self.differs.values() if difference.like))

    @property
    def is_built(self) -> bool:
        """Whether the networks and the optimizer of the edition are here, so that one can train with its profile."""
        return not self.beyond


@functools.cache
def editions() -> dict[str, Edition]:
    """Name -> edition, in the order of time."""
    data = tomllib.loads(resources.files("spec").joinpath("editions.toml").read_text(encoding="utf-8"))
    return {name: _edition(name, **entry) for name, entry in data.items()}


def _edition(name: str, differs: dict[str, dict[str, Any]], beyond: list[str], **about: str) -> Edition:
    differences = {}
    for requirement, entry in differs.items():
        fields: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()
        }
        differences[requirement] = Difference(**fields)
    return Edition(name, differs=differences, beyond=tuple(beyond), **about)


def find_edition(name: str) -> Edition:
    """The edition of a name, or of the name of its profile.

    Raises:
      ValueError: there is none; the message lists those that there are.
    """
    for edition in editions().values():
        if name in (edition.name, edition.profile):
            return edition
    raise ValueError(f"unknown edition {name!r}; known: {', '.join(editions())}")


def built_profiles() -> list[str]:
    """The names of the profiles whose edition is here as a whole; the default comes first."""
    built = [edition.profile for edition in editions().values() if edition.is_built]
    return sorted(built, key=lambda profile: profile != "paper")
