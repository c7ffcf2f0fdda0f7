"""What a mutant is, and how it is planted.

A mutant is the reference with a few words of its source changed: a realistic mistake as data. `MutantAdapter` is the
reference with the mistake, in effect only while the candidate is called, so that a check compares the mutant with the
unharmed reference.
"""

import contextlib
import dataclasses
import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.requirements import chapter_of

Replacements = Mapping[str, Callable[..., Any]]


KNOWN, PAIR, GENERATED = "known", "pair", "generated"
"""Kinds of mutants: of the catalogue, two of it in one, and a single term of an equation changed by rule."""


@dataclasses.dataclass(frozen=True, eq=False)
class Mutant:
    """One mistake.

    name: what it is called. explanation: what the wrong code does. provenance: who made the mistake, or where it
    stands. violates: requirement ids, the chapter of the first is the mutant's. fix: what to do about it. edits:
    "chapter.function" or "chapter.Class" of the reference -> {right: wrong}, each text once in the source, changed in
    this order.
    """

    name: str
    explanation: str
    provenance: str
    violates: tuple[str, ...]
    fix: str
    edits: Mapping[str, Mapping[str, str]]
    kind: str = KNOWN

    @property
    def chapter(self) -> str:
        return chapter_of(self.violates[0])

    @functools.cached_property
    def replacements(self) -> Replacements:
        """The wrong functions and classes, by "chapter.name".

        Raises:
          ValueError: the reference has no such text, or more than once.
        """
        return {target: _edited(self.name, target, edits) for target, edits in self.edits.items()}


def _edited(mutant: str, target: str, edits: Mapping[str, str]) -> Callable[..., Any]:
    chapter, name = target.split(".")
    module = importlib.import_module(f"reference_numpy.{chapter}")
    source = source_of(target)
    for right, wrong in edits.items():
        if source.count(right) != 1:
            raise ValueError(f"mutant {mutant}: {target} holds {source.count(right)} times {right!r}")
        source = source.replace(right, wrong)
    made: dict[str, Any] = {}
    # The module's own names, looked up at each call, as for the function that is replaced.
    exec(compile(source, f"<mutant {mutant}>", "exec"), vars(module), made)
    wrong_version: Callable[..., Any] = made[name]
    return wrong_version


@functools.cache
def source_of(target: str) -> str:
    """The source of a function or class of the reference, "chapter.name"."""
    chapter, name = target.split(".")
    return inspect.getsource(getattr(importlib.import_module(f"reference_numpy.{chapter}"), name))


@contextlib.contextmanager
def planted(replacements: Replacements) -> Iterator[None]:
    """While this context lasts, the reference uses the wrong functions, wherever it had imported the right ones."""
    undo: list[tuple[Any, str, Any]] = []
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("reference_numpy")]
    try:
        for target, replacement in replacements.items():
            chapter, name = target.split(".")
            original = getattr(importlib.import_module(f"reference_numpy.{chapter}"), name)
            for module in modules:
                if vars(module).get(name) is original:
                    undo.append((module, name, original))
                    setattr(module, name, replacement)
        yield
    finally:
        for module, name, original in undo:
            setattr(module, name, original)


class PlantedAdapter:
    """The reference with other functions in place of its own: an adapter."""

    def __init__(self, replacements: Replacements) -> None:
        self._replacements = replacements
        self._reference = NumpyAdapter()

    def __getattr__(self, name: str) -> Any:
        getattr(self._reference, name)  # what the reference does not offer, its mutants do not either

        def call(*arguments: Any) -> Any:
            with planted(self._replacements):
                return getattr(self._reference, name)(*arguments)

        return call


class MutantAdapter(PlantedAdapter):
    """The reference with a mistake."""

    def __init__(self, mutant: Mutant) -> None:
        super().__init__(mutant.replacements)
