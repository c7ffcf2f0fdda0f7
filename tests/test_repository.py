"""What holds for the repository as text: the grid, the one-way dependencies, citations, generated parts."""

import ast
import graphlib
import importlib
import inspect
import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from conformance.coverage import coverage
from conformance.requirements import requirements
from docs.render import stale

ROOT = Path(__file__).resolve().parent.parent
CHAPTERS = [
    *("transforms", "distributions", "layers", "rssm", "networks", "world_model"),
    *("returns", "behavior", "optimizer", "agent"),
]
SHARED_CHAPTERS = ["replay", "training_loop"]
MAY_IMPORT = {
    "spec": set(),
    "reference_numpy": {"spec"},
    "impl_jax": {"spec"},
    "impl_torch": {"spec"},
    "conformance": {"spec", "reference_numpy"},
    "dreamer_spec": {"spec", "reference_numpy", "conformance"},
}
ADAPTERS = {"jax_adapter.py": "impl_jax", "torch_adapter.py": "impl_torch", "trainer_adapter.py": "dreamer_spec"}


def public_functions(chapter: str) -> list[tuple[str, object]]:
    module = importlib.import_module(f"reference_numpy.{chapter}")
    members = inspect.getmembers(module, lambda member: inspect.isfunction(member) or inspect.isclass(member))
    return [
        (name, member) for name, member in members if member.__module__ == module.__name__ and not name.startswith("_")
    ]


@pytest.mark.parametrize("chapter", [*CHAPTERS, *SHARED_CHAPTERS, "stop_gradient"])
def test_every_public_function_of_the_reference_cites_its_requirements(chapter: str) -> None:
    functions = public_functions(chapter)
    assert functions
    for name, function in functions:
        cited = set(re.findall(r"\[([A-Z]{2,6}-\d+)\]", inspect.getdoc(function) or ""))
        assert cited, f"{chapter}.{name} cites no requirement"
        assert cited <= set(requirements()), (
            f"{chapter}.{name} cites {sorted(cited - set(requirements()))}, which no chapter has"
        )


def test_every_cited_requirement_exists() -> None:
    for path in [*ROOT.glob("spec/*.md"), *ROOT.glob("*/*.py"), *ROOT.glob("conformance/*/*.py")]:
        cited = set(
            re.findall(
                r"\[((?:CON|TRA|DIS|LAY|RSSM|NET|WM|RET|BEH|OPT|AGT|REP|LOOP)-\d+)\]", path.read_text(encoding="utf-8")
            )
        )
        assert cited <= set(requirements()), f"{path.name} cites {sorted(cited - set(requirements()))}"


def test_every_requirement_is_covered() -> None:
    table, problems = coverage()
    assert len(table) > 200
    assert problems == []


def test_every_decision_is_there() -> None:
    text = (ROOT / "spec" / "decisions.md").read_text(encoding="utf-8")
    numbers = [int(number) for number in re.findall(r"^### D-(\d+)", text, re.MULTILINE)]
    assert numbers == list(range(1, 139))


def test_cited_decisions_exist() -> None:
    known = set(
        re.findall(r"^### ([DE]-\d+)", (ROOT / "spec" / "decisions.md").read_text(encoding="utf-8"), re.MULTILINE)
    )
    for path in [*ROOT.glob("spec/*.md"), *ROOT.glob("spec/*.toml"), *ROOT.glob("*/*.py")]:
        cited = set(re.findall(r"\b([DE]-\d{2,3})\b", path.read_text(encoding="utf-8")))
        assert cited <= known, f"{path.name} cites {sorted(cited - known)}"


@pytest.mark.parametrize("chapter", CHAPTERS)
def test_the_grid_shows_in_the_folders(chapter: str) -> None:
    assert [path.name for path in (ROOT / "spec").glob(f"*-{chapter.replace('_', '-')}.md")]
    for implementation in ("reference_numpy", "impl_jax", "impl_torch", "conformance/cases"):
        assert (ROOT / implementation / f"{chapter}.py").exists(), f"{implementation} lacks the chapter {chapter}"


def imported_packages(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        found |= {name.split(".")[0] for name in names}
    return found


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_dependencies_point_one_way(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
        allowed = MAY_IMPORT[package] | {package} | {ADAPTERS.get(path.name, package)}
        ours = imported_packages(path) & set(MAY_IMPORT)
        assert ours <= allowed, f"{path.relative_to(ROOT)} imports {sorted(ours - allowed)}"


def modules_of_the_trainer() -> dict[str, Path]:
    """Name inside of dreamer_spec -> file, a package under its own name."""
    root = ROOT / "dreamer_spec"
    paths = {".".join(path.relative_to(root).with_suffix("").parts): path for path in root.rglob("*.py")}
    del paths["__init__"]
    return {name.removesuffix(".__init__"): path for name, path in paths.items()}


def imported_modules(path: Path, modules: Iterable[str]) -> set[str]:
    """Those of dreamer_spec that a file imports anywhere, in functions and for types too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            inside = {name for name in names if name.removeprefix("dreamer_spec.") in modules}
            found |= inside | ({node.module} if inside != names else set())
    return {name.removeprefix("dreamer_spec.") for name in found if name.startswith("dreamer_spec.")}


def test_the_packages_of_the_trainer_point_one_way() -> None:
    """By the table in dreamer_spec/__init__.py: nothing imports from above, or from another package of its level."""
    lines = re.findall(r"^  (\S+(?:, \S+)*)  +\S", inspect.getdoc(importlib.import_module("dreamer_spec")) or "", re.M)
    levels = {name: level for level, names in enumerate(lines) for name in names.split(", ")}
    modules = modules_of_the_trainer()

    def place(module: str) -> str:
        package, _, inside = module.partition(".")
        return f"{package}.*" if inside and f"{package}.*" in levels else package

    assert {place(module) for module in modules} == set(levels), "the table does not name every package once"
    for module, path in modules.items():
        here = place(module)
        for other in imported_modules(path, modules):
            assert place(other) == here or levels[place(other)] < levels[here], (
                f"{module} imports {other}, which is not below"
            )


def test_no_modules_of_the_trainer_import_each_other_in_a_circle() -> None:
    modules = modules_of_the_trainer()
    graph = {module: imported_modules(path, modules) for module, path in modules.items()}
    assert set().union(*graph.values()) <= set(modules), "an import of something else than a module"
    graphlib.TopologicalSorter(graph).prepare()  # CycleError names the circle


def test_nothing_is_unpickled() -> None:
    forbidden = re.compile(
        r"import pickle|pickle\.loads?|allow_pickle\s*=\s*True|weights_only\s*=\s*False|torch\.load\("
    )
    for folder in (*MAY_IMPORT, "tests", "docs", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            if path.name != Path(__file__).name:
                assert not forbidden.search(path.read_text(encoding="utf-8")), path


def test_generated_parts_of_the_documents_are_current() -> None:
    assert stale() == [], "run: make docs"


def test_links_between_documents_lead_somewhere() -> None:
    for path in [*ROOT.glob("*.md"), *ROOT.glob("spec/*.md"), *ROOT.glob("docs/*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (path.parent / target).exists(), f"{path.relative_to(ROOT)} links to {target}, which is missing"
