"""Mistakes planted in what is fast: the backends, their learners and the trainer, each a small patch as data.

The mutants of the reference say that the checks can fail. These say whether they fail where people work for speed: in
fused operations, hoisted terms, chunks, caches and gradients written by hand. torch.toml, jax.toml, learners.toml and
trainer.toml hold the patches, planting.py makes a copy of our packages with one of them, judging.py judges that copy
from inside, trial.py runs it and the tests.
"""

import dataclasses
import functools
import tomllib
from importlib import resources
from pathlib import PurePosixPath
from typing import Any

CATALOGUES = ("torch", "jax", "learners", "trainer", "thirty")
KINDS = {
    "wrong_axis": "a fused operation along a wrong axis, or along too many",
    "precision": "right in one precision and wrong in another: a cast too early, a sum or a product in a narrow one",
    "forgotten_reset": "what was taken out of a loop, or back through it, forgets is_first",
    "configured_size": "a mean, a reshape or noise by the configured batch in place of the actual one",
    "chunk_boundary": "only what is larger than a threshold: a piece dropped, in another order, or in place of all",
    "stale_cache": "what was kept for speed is used after it has changed",
    "shared_noise": "the same random numbers across rows, steps, heads or calls",
    "transposed_pair": "two axes swapped, which nobody sees where they have one length",
    "gradient_only": "the values are right, and the gradient written by hand is not",
    "stop_gradient": "a gradient goes where it must not, or ends where it must not",
    "state": "something of the training state is not updated, not saved, not loaded, or in the wrong order",
    "loop": "the trainer: what is recorded, how often it trains, seeds, evaluation, what a checkpoint carries over",
}


@dataclasses.dataclass(frozen=True)
class Patch:
    """One mistake.

    name: what is wrong. kind: of KINDS. file: where, from the root of the repository. old -> new: the text, which
    occurs once. explanation: in a sentence. equivalent: why no result can differ, where that is argued; else empty.
    device: "cuda" where nothing differs on a CPU. tests: arguments of pytest, asked where checks and preflight see
    nothing.
    """

    name: str
    kind: str
    file: str
    old: str
    new: str
    explanation: str
    equivalent: str = ""
    device: str = ""
    tests: tuple[str, ...] = ()

    @property
    def candidate(self) -> str:
        """What `conformance check` calls the implementation."""
        package = PurePosixPath(self.file).parts[0]
        return package.removeprefix("impl_") if package.startswith("impl_") else "trainer"

    @property
    def module(self) -> str:
        return ".".join(PurePosixPath(self.file).with_suffix("").parts)

    def apply(self, source: str) -> str:
        """The source of the file with the mistake.

        Raises:
          ValueError: the text does not occur, or more than once.
        """
        if (count := source.count(self.old)) != 1:
            raise ValueError(f"mutant {self.name}: {self.file} holds {count} times {self.old!r}")
        return source.replace(self.old, self.new)


@functools.cache
def catalogues() -> dict[str, dict[str, Patch]]:
    """Catalogue -> name -> mutant.

    Raises:
      ValueError: a name that is there twice, or a kind that is none.
    """
    found = {name: [_patch(entry) for entry in _entries(name)] for name in CATALOGUES}
    names: set[str] = set()
    for patch in (patch for those in found.values() for patch in those):
        if patch.name in names or patch.kind not in KINDS:
            raise ValueError(f"mutant {patch.name} is there twice, or of the unknown kind {patch.kind!r}")
        names.add(patch.name)
    return {name: {patch.name: patch for patch in those} for name, those in found.items()}


def patches() -> dict[str, Patch]:
    """All mutants by name."""
    return {name: patch for those in catalogues().values() for name, patch in those.items()}


def catalogue_of(mutant: str) -> str:
    return next(name for name, those in catalogues().items() if mutant in those)


def _entries(catalogue: str) -> list[dict[str, Any]]:
    text = resources.files(__name__).joinpath(f"{catalogue}.toml").read_text(encoding="utf-8")
    entries: list[dict[str, Any]] = tomllib.loads(text)["mutant"]
    return entries


def _patch(entry: dict[str, Any]) -> Patch:
    return Patch(**{**entry, "tests": tuple(entry.get("tests", ()))})
