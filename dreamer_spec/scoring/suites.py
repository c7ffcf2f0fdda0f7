"""The suites whose scores can be compared with the paper's: how their tasks are called, and how the paper summarizes
them (docs/scores.md)."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from dreamer_spec.scoring import bsuite
from spec.paper_scores import PaperTable, bsuite_categories, paper_tables, references, windows

CATEGORIES = tuple(sorted({name for names in bsuite_categories().values() for name in names}))  # of BSuite
OTHER_WINDOW = 0.05  # the share of the budget, for tasks that the paper does not have


@dataclasses.dataclass(frozen=True)
class Summary:
    """A number about all tasks of a suite.

    reference: of `spec.paper_scores.references`, by which scores become per cent; empty if returns are taken as they
    are. capped: what is above 100 % counts as 100 %; nothing is capped below. statistic: mean, median, iqm, or
    category_mean, the mean over BSuite's categories. category: of BSuite, whose tasks alone count; empty for all tasks.
    """

    name: str
    reference: str
    capped: bool
    statistic: str
    category: str = ""

    @property
    def unit(self) -> str:
        return "%" if self.reference else ""

    def counts(self, task: str) -> bool:
        return not self.category or self.category in bsuite_categories()[task]

    def normalized(self, tasks: Sequence[str], scores: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Returns of each task, of any shape, in per cent of the reference."""
        return [self._normalized(task, score) for task, score in zip(tasks, scores, strict=True)]

    def _normalized(self, task: str, score: np.ndarray) -> np.ndarray:
        if not self.reference:
            return score
        low, high = references()[self.reference][task]
        per_cent = 100 * (score - low) / (high - low)
        return np.minimum(per_cent, 100) if self.capped else per_cent


def _three(name: str, reference: str, capped: bool = False) -> tuple[Summary, ...]:
    """human_{}_capped -> human_mean_capped, human_median_capped, human_iqm_capped"""
    return tuple(Summary(name.format(one), reference, capped, one) for one in ("mean", "median", "iqm"))


# The first one of a suite says how a single task is normalized. The paper has no scores of Crafter, which is scored as
# any other task.
SUMMARIES: Mapping[str, tuple[Summary, ...]] = {
    "minecraft": (),  # one task
    "atari": (
        *_three("gamer_{}", "gamer"),
        Summary("record_mean", "record", False, "mean"),
        Summary("record_mean_capped", "record", True, "mean"),
    ),
    "procgen": _three("normalized_{}", "range"),
    "dmlab": _three("human_{}_capped", "human", capped=True),
    "atari100k": _three("gamer_{}", "gamer"),
    "dmc": _three("task_{}", ""),
    "dmc_vision": _three("task_{}", ""),
    "bsuite": (
        *(Summary(name, "", False, "mean", name) for name in CATEGORIES),
        Summary("task_mean", "bsuite", False, "mean"),
        Summary("category_mean", "bsuite", False, "category_mean"),
    ),
}


def split_task(task: str) -> tuple[str, str]:
    """dmc:walker-walk -> "dmc", "walker-walk". A task of no suite of the paper, or that its table lacks, is of
    the suite "", under its whole name. The tasks of BSuite are its experiments: bsuite:catch/3 -> "bsuite", "catch"."""
    namespace, _, name = task.partition(":")
    if found := bsuite.configuration(task):
        return namespace, found[0]
    suite = namespace if namespace in SUMMARIES else ""
    if suite == "dmlab" and name.endswith("_train"):  # trained on one set of levels, listed under the other: D-100
        name = name.removesuffix("_train") + "_test"
    return (suite, name) if suite and name in paper_tables()[suite].scores else ("", task)


def window_of(suite: str) -> float:
    """The share of the budget at its end whose episodes are scored."""
    return windows().get(suite, OTHER_WINDOW)


def tasks_of(table: PaperTable, found: Sequence[str]) -> list[str]:
    """Those of the paper's tasks that were found, in its order."""
    return [task for task in table.scores if task in found]
