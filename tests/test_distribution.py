"""What is published: the source distribution, the wheel, and what messages say about them."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

from dreamer_spec.envs import factory

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PACKAGES = ("spec", "reference_numpy", "impl_jax", "impl_torch", "conformance", "dreamer_spec")
NOT_SOURCES = (".git", ".venv*", ".*_cache", ".hypothesis", "__pycache__", "build", "dist", "runs", "*.egg-info")


def sources(*patterns: str) -> list[Path]:
    """The files of the packages that match."""
    return [path for package in PACKAGES for pattern in patterns for path in sorted((ROOT / package).rglob(pattern))]


def files(root: Path, folder: str) -> set[Path]:
    """The files under a folder, relative to the root."""
    found = (path for path in (root / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(root) for path in found}


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the source distribution unpacks to."""
    folder = tmp_path_factory.mktemp("sdist")
    shutil.copytree(ROOT, folder / "source", ignore=shutil.ignore_patterns(*NOT_SOURCES))
    archive = folder / build("sdist", folder / "source", folder)
    with tarfile.open(archive) as opened:
        opened.extractall(folder / "unpacked", filter="data")
    return folder / "unpacked" / archive.name.removesuffix(".tar.gz")


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built as a packager would, from the source distribution."""
    folder = tmp_path_factory.mktemp("wheel")
    return folder / build("wheel", sdist, folder)


def build(kind: str, source: Path, out: Path) -> str:
    command = f"import sys; from setuptools import build_meta; build_meta.build_{kind}(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", command, out], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(path.name for path in out.iterdir() if path.suffix in (".gz", ".whl"))


def members(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as opened:
        return set(opened.namelist())


def test_the_wheel_holds_every_file_of_the_packages(wheel: Path) -> None:
    present = {str(path) for package in PACKAGES for path in files(ROOT, package)}
    packed = {name for name in members(wheel) if name.split("/")[0] in PACKAGES}
    assert present - packed == set(), "missing in [tool.setuptools] packages or package-data"
    assert packed - present == set()


def test_the_wheel_adds_no_other_package(wheel: Path) -> None:
    ours = f"dreamer_spec-{PROJECT['version']}"
    assert {name.split("/")[0] for name in members(wheel)} == {*PACKAGES, f"{ours}.dist-info", f"{ours}.data"}


def test_the_source_distribution_holds_what_tests_and_readers_need(sdist: Path) -> None:
    for name in ("CITATION.cff", "SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md", "README.md", "LICENSE", "Makefile"):
        assert (sdist / name).is_file(), name
    for folder in ("docs", "tests", "benchmarks", "requirements"):
        assert files(sdist, folder) == files(ROOT, folder)


def test_an_installation_finds_every_page_that_its_files_name(wheel: Path, tmp_path: Path) -> None:
    """Help, messages and comments name pages; `conformance docs` of the installed wheel says where each is."""
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--ignore-installed"]
    subprocess.run([*install, "--prefix", tmp_path, wheel], check=True)
    environment = os.environ | {"PYTHONPATH": str(next(tmp_path.glob("lib*/python*/site-packages")))}
    command = [sys.executable, "-m", "conformance.cli", "docs"]
    shown = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    pages = dict(line.split(maxsplit=1) for line in shown.stdout.splitlines())
    texts = (path.read_text(encoding="utf-8") for path in sources("*.py", "*.toml"))
    named = {name for text in texts for name in re.findall(r"\b(?:docs|spec)/[\w-]+\.md\b", text)}
    assert {"docs/editions.md", "docs/adapters.md", "spec/10-agent.md"} <= named <= set(pages)
    for name, path in pages.items():
        assert Path(path).is_relative_to(tmp_path)
        assert Path(path).read_bytes() == (ROOT / name).read_bytes()


def test_every_extra_that_a_text_recommends_exists() -> None:
    """dreamer-spec[NAME] and '.[NAME]', and further [NAME] on such a line of the README."""
    known = set(PROJECT["optional-dependencies"])
    passed = {
        *factory._EXTRAS.values(),
        *(extra for _, extra in factory._NAMESPACES.values()),
        *extras_passed_in_factory(),
    }
    backends = {"jax", "torch"}
    placeholders = {
        "{extra}": passed,
        "{backend}": backends,
        "{info['backend']}": backends,
        "{name}": backends,
        "$(RANGES)": set(),
    }
    documents = [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/*.md"),
        *ROOT.glob("spec/*.md"),
        *ROOT.glob(".github/workflows/*"),
    ]
    found = set()
    for path in [
        *sources("*.py", "*.toml"),
        *ROOT.glob("benchmarks/*.py"),
        *documents,
        ROOT / "pyproject.toml",
        ROOT / "Makefile",
    ]:
        text = path.read_text(encoding="utf-8")
        recommended = re.findall(r"""(?:dreamer-spec|['" ]\.)\[([^\s"]*[^\s"'])\]""", text)
        recommended += re.findall(
            r"(?<!\w)\[([\w-]+)\]", "".join(re.findall(r"^pip install '\.\[.*$", text, re.MULTILINE))
        )
        for name in ",".join(recommended).split(",") if recommended else []:
            assert placeholders.get(name, {name}) <= known, (
                f"{path.relative_to(ROOT)} recommends [{name}], which is no extra"
            )
            found.add(name)
    assert {"{extra}", "{backend}", "jax", "torch", "box2d", "wandb", "dev"} <= found


def extras_passed_in_factory() -> set[str]:
    """Every literal that dreamer_spec/envs/factory.py passes as a parameter `extra`."""
    tree = ast.parse(Path(factory.__file__).read_text(encoding="utf-8"))
    definitions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    functions = {node.name: [argument.arg for argument in node.args.args] for node in definitions}
    found = set()
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
        for name, argument in zip(functions.get(call.func.id, []), call.args, strict=False):
            if name == "extra" and isinstance(argument, ast.Constant):
                found.add(argument.value)
    return found


def locked(name: str) -> dict[str, list[tuple[Requirement, str]]]:
    """Package -> its lines in a file of requirements/, with what follows each."""
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8")
    text = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    lines: dict[str, list[tuple[Requirement, str]]] = {}
    for line in filter(None, map(str.strip, text.splitlines())):
        requirement, _, hashes = line.split("  #")[0].partition("--hash=")
        lines.setdefault(Requirement(requirement).name, []).append((Requirement(requirement), hashes))
    return lines


def development() -> list[Requirement]:
    """What the extra `dev` asks for, the extras of ours resolved."""
    found, waiting = [Requirement(line) for line in PROJECT["dependencies"]], ["dev"]
    for extra in waiting:
        for requirement in map(Requirement, PROJECT["optional-dependencies"][extra]):
            if requirement.name == PROJECT["name"]:
                waiting += sorted(requirement.extras)
            else:
                found.append(requirement)
    return found


def test_the_lock_holds_what_development_needs() -> None:
    lock = locked("lock.txt") | {"torch": locked("torch.txt")["torch"]}
    for requirement in development():
        assert requirement.name in lock, f"{requirement.name} is not in the lock; run: make lock"
        for line, _ in lock[requirement.name]:
            version = str(line.specifier).removeprefix("==")
            assert Version(version) in requirement.specifier, f"{line} is locked, {requirement} wanted; run: make lock"


def test_the_lock_is_exact_and_has_hashes() -> None:
    for lines in locked("lock.txt").values():
        for requirement, hashes in lines:
            assert re.fullmatch(r"==[^,*]+", str(requirement.specifier))
            assert re.match(r"sha256:[0-9a-f]{64}", hashes), requirement


def test_what_has_no_hash_is_pytorch_and_its_cuda_packages() -> None:
    """The rest of what PyTorch needs has the same version in both files."""
    lock = locked("lock.txt")
    for name, lines in locked("torch.txt").items():
        assert all(re.fullmatch(r"==[^,*]+", str(line.specifier)) for line, _ in lines)
        if name in lock:
            assert [str(line) for line, _ in lines] == [str(line).removesuffix(" ") for line, _ in lock[name]]
        else:
            assert re.match(r"torch$|triton$|nvidia-|cuda-", name), name


def test_the_lock_keeps_the_pins() -> None:
    lock = locked("lock.txt") | {"torch": locked("torch.txt")["torch"]}
    for name, [(pin, _)] in locked("pins.txt").items():
        assert [line.specifier for line, _ in lock[name]] == [pin.specifier]


def test_the_workflow_runs_the_commands_of_the_makefile() -> None:
    """On two versions of Python, with the least permissions, and with no actions but those of the host."""
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    commands, versions = set(), set()
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        workflow = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert workflow["permissions"] == {"contents": "read"}
        assert set(workflow[True]) >= {"push", "pull_request", "schedule"}  # `on` is a boolean in YAML 1.1
        for job in workflow["jobs"].values():
            assert job["timeout-minutes"] <= 360
            versions |= set(map(str, job.get("strategy", {}).get("matrix", {}).get("python", [])))
            for step in job["steps"]:
                assert re.fullmatch(r"actions/(checkout|setup-python)@v\d+", step.get("uses", "actions/checkout@v0"))
                commands |= {step["run"].split()[1]} if step.get("run", "").startswith("make ") else set()
    assert {"test", "test-lowest", "test-newest", "test-slow"} <= commands <= targets
    assert {"3.11", "3.13"} <= versions


def test_ci_runs_the_tests_and_nothing_else() -> None:
    lines = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert lines == ["#!/usr/bin/env bash", "set -euo pipefail", "make test"]


def test_the_citation_is_complete() -> None:
    """What version 1.2.0 of the format requires, and the facts that stand elsewhere too."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert (citation["cff-version"], citation["type"]) == ("1.2.0", "software")
    assert [citation[key] for key in ("title", "version", "license")] == [
        PROJECT[key] for key in ("name", "version", "license")
    ]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in PROJECT["authors"]]
    [paper] = citation["references"]
    assert {"type", "title", "authors"} <= set(paper)
    assert [author["family-names"] for author in paper["authors"]] == ["Hafner", "Pasukonis", "Ba", "Lillicrap"]
