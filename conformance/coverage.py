"""Which checks and tests cover which requirement in which implementation."""

import ast
from pathlib import Path

from conformance.check import CHECKS
from conformance.execute import missing, selected_checks
from conformance.our_candidates import OUR_CANDIDATES, TRAINER, load_adapter
from conformance.requirements import requirements

# Replay and the training loop are chapters of the reference and of the trainer, and of no backend; the trainer has no
# others.
SHARED_CHAPTERS = ("REP", "LOOP")
OURS = ("conformance", "dreamer_spec", "impl_jax", "impl_torch", "reference_numpy", "spec")
TESTS = Path(__file__).resolve().parent.parent / "tests"


def coverage() -> tuple[dict[str, dict[str, list[str]]], list[str]]:
    """Requirement -> implementation -> names of the checks that cover it there, and what is wrong: uncovered
    requirements and unknown ids.

    The entry `tests` holds tests marked with `pytest.mark.covers`: what a whole trainer or learner shows, and no
    adapter can. Such a requirement needs no check. A backend that is not installed has no entry. An installed package
    comes without tests: then there is no entry `tests` either, and a requirement without a check is not wrong, as
    nobody can tell whether a test covers it.
    """
    selected_checks("float64")
    adapters = installed_adapters()
    tests = covering_tests()
    table: dict[str, dict[str, list[str]]] = {}
    problems = []
    for requirement in requirements():
        shared = requirement.split("-")[0] in SHARED_CHAPTERS
        checks = {
            implementation: [
                check.name
                for check in CHECKS.values()
                if requirement in check.requirements and not missing(adapters[implementation], check)
            ]
            for implementation in adapters
            if implementation == "numpy" or (implementation == TRAINER) == shared
        }
        table[requirement] = {**checks, **({"tests": tests.get(requirement, [])} if tests else {})}
        if tests and requirement not in tests:
            problems += [
                f"{requirement}: no check covers it in {implementation}, and no test"
                for implementation, names in checks.items()
                if not names
            ]
    for check in CHECKS.values():
        problems += [
            f"{check.name} names {name}, which no chapter has"
            for name in check.requirements
            if name not in requirements()
        ]
    problems += [
        f"{', '.join(tests[name])} names {name}, which no chapter has" for name in tests if name not in requirements()
    ]
    return table, problems


def installed_adapters() -> dict[str, object]:
    """Implementation -> its adapter, for those whose libraries are installed."""
    found = {}
    for implementation in OUR_CANDIDATES:
        try:
            found[implementation] = load_adapter(implementation)
        except ModuleNotFoundError as error:
            if error.name is None or error.name.startswith(OURS):
                raise  # a mistake of ours, and not a library that is not there
    return found


def covering_tests(folder: Path = TESTS) -> dict[str, list[str]]:
    """Requirement -> tests marked `@pytest.mark.covers("LOOP-1", ...)`, read from their source: the tests are not run,
    nor imported.

    Empty where there is no such folder: an installed package comes without tests.

    Raises:
      ValueError: a mark whose arguments are not written out.
    """
    found: dict[str, list[str]] = {}
    for path in sorted(folder.glob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                for identifier in _marked(node, path):
                    found.setdefault(identifier, []).append(f"{path.stem}.{node.name}")
    return found


def _marked(function: ast.FunctionDef, path: Path) -> list[str]:
    marks = [
        mark
        for mark in function.decorator_list
        if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.covers"
    ]
    identifiers = [
        argument.value if isinstance(argument, ast.Constant) else None for mark in marks for argument in mark.args
    ]
    if any(mark.keywords or not mark.args for mark in marks) or not all(
        isinstance(identifier, str) for identifier in identifiers
    ):
        raise ValueError(f"{path.name}:{function.lineno}: pytest.mark.covers takes requirement ids, written out")
    return [str(identifier) for identifier in identifiers]
