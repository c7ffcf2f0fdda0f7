"""Which checks cover which requirement on which column."""

from conformance.adapter import COLUMNS, load_adapter
from conformance.check import CHECKS
from conformance.execute import offered, selected_checks
from conformance.requirements import requirements

# Replay and the training loop are rows that both backends share: the reference and the trainer are their columns.
SHARED_ROWS = ("REP", "LOOP")


def coverage() -> tuple[dict[str, dict[str, list[str]]], list[str]]:
    """Requirement -> column -> names of the checks that cover it there, and what is wrong: uncovered requirements and unknown ids."""
    selected_checks("float64")
    adapters = {column: load_adapter(column) for column in COLUMNS}
    table: dict[str, dict[str, list[str]]] = {}
    problems = []
    for requirement in requirements():
        columns = ("numpy",) if requirement.split("-")[0] in SHARED_ROWS else COLUMNS
        table[requirement] = {
            column: [check.name for check in CHECKS.values() if requirement in check.requirements and offered(adapters[column], check)]
            for column in columns
        }
        problems += [f"{requirement}: no check covers it on {column}" for column, checks in table[requirement].items() if not checks]
    for check in CHECKS.values():
        problems += [f"{check.name} names {name}, which no chapter has" for name in check.requirements if name not in requirements()]
    return table, problems
