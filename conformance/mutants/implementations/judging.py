"""Runs inside of a copy: `python -m conformance.mutants.implementations.judging REQUEST`, and as a plugin of pytest.

REQUEST is JSON: candidate; file, whose mistake is looked for; dtypes, in order; device; examples, of the properties;
skip, pairs of dtype and check that the right implementation does not pass; only, such a pair to ask nothing else; and
preflight, whether to ask it. The answer is the last line of what is printed: by, name, dtype, how; null for nothing.
"""

import gc
import importlib
import importlib.util
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from conformance.own_names import OURS

Found = dict[str, str | None]

NOTHING: Found = {"by": None, "name": None, "dtype": None, "how": None}
ALL = (
    *("transforms", "distributions", "layers", "rssm", "networks"),
    *("world_model", "returns", "behavior", "optimizer", "agent"),
)
# File of a backend -> the chapters whose functions can reach it, its own first.
REACHED_FROM = {
    "transforms": ("transforms", "distributions", "networks", "world_model", "behavior", "agent"),
    "distributions": ("distributions", "rssm", "world_model", "behavior", "agent"),
    "layers": ("layers", "rssm", "networks", "world_model", "agent"),
    "convolutions": ("layers", "networks", "world_model", "agent"),
    "scan": ("rssm", "world_model", "agent"),
    "rssm": ("rssm", "world_model", "agent", "learner"),
    "networks": ("networks", "world_model", "agent"),
    "world_model": ("world_model", "agent"),
    "returns": ("returns", "agent", "learner"),
    "behavior": ("behavior", "agent"),
    "optimizer": ("optimizer", "agent", "learner"),
    "parameters": ("optimizer", "agent", "learner"),
    "agent": ("agent", "learner"),
    "shapes": ALL,
    "learner": ("learner",),
}


def require_copy() -> None:
    """Raises RuntimeError unless Python finds all our packages in the folder where this process runs."""
    here = Path.cwd().resolve()
    for name in OURS:
        found = importlib.util.find_spec(name)
        place = Path(str(found and found.origin)).resolve()
        if here not in place.parents:
            raise RuntimeError(f"{name} is {place}, which is not in the copy {here}")


def pytest_configure(config: Any) -> None:
    """As a plugin of pytest: what is tested is the copy."""
    require_copy()


def chapter_of_function(name: str) -> str:
    """The chapter whose module of the reference defines a function of the interface; "" for others."""
    if name == "Learner":
        return "learner"
    for chapter in ALL:
        function = getattr(importlib.import_module(f"reference_numpy.{chapter}"), name, None)
        if getattr(function, "__module__", None) == f"reference_numpy.{chapter}":
            return chapter
    return "agent" if name in ("gradients", "loss_derivatives", "losses_given", "train_step") else ""


def reaching(file: str, dtype: str) -> list[Any]:
    """The checks that can notice a mistake in a file: those of its own chapter first, each by level."""
    from conformance.execute import selected_checks

    checks = selected_checks(dtype)
    if PurePosixPath(file).parts[0] == "dreamer_spec":
        return checks
    chapters = REACHED_FROM[PurePosixPath(file).stem]
    named = {check: {chapter_of_function(name) for name in check.uses} for check in checks}
    found = [check for check in checks if named[check] & set(chapters)]
    return sorted(found, key=lambda check: (chapters[0] not in named[check], check.level, check.name))


def first_failure(request: Mapping[str, Any]) -> Found:
    """The first check that the candidate fails."""
    from conformance.case import Setting
    from conformance.execute import FAILING, calls_of, run_check
    from conformance.our_candidates import load_adapter

    skip = {tuple(pair) for pair in request["skip"]}
    for dtype in request["dtypes"]:
        _forget_precision(request["candidate"])
        adapter = load_adapter(request["candidate"], dtype, request["device"] or None)
        setting = Setting(dtype, "paper", 0, request["examples"])
        for check in _asked(request, dtype):
            if (dtype, check.name) in skip:
                continue
            if compile_calls := getattr(adapter, "compile_calls", None):
                compile_calls(calls_of([check], adapter, setting))
            result = run_check(check, adapter, setting, shrink=False)
            if result.status in FAILING:
                return {"by": "check", "name": check.name, "dtype": dtype, "how": result.status}
        del adapter
        gc.collect()
    return NOTHING


def _forget_precision(candidate: str) -> None:
    """After float64 JAX would go on with 64-bit numbers."""
    if candidate == "jax":
        import jax

        jax.config.update("jax_enable_x64", False)


def _asked(request: Mapping[str, Any], dtype: str) -> Iterator[Any]:
    for check in reaching(request["file"], dtype):
        if request["only"] is None or request["only"] == [dtype, check.name]:
            yield check


def preflight_failure(request: Mapping[str, Any]) -> Found:
    """What the preflight says of the candidate in a small size."""
    from conformance.preflight import preflight
    from spec import Discrete, Image, Spaces, Vector, load_config

    _forget_precision(request["candidate"])
    spaces = Spaces({"position": Vector(3), "image": Image(16, 16, 1)}, {"move": Vector(2), "button": Discrete((3,))})
    config = load_config("paper", "tiny", deter=1280, compute_dtype="float32")  # with tensors as large as in a run
    try:
        report = preflight(request["candidate"], spaces, config, request["device"] or None)
    except Exception as error:
        return {"by": "preflight", "name": type(error).__name__, "dtype": "float32", "how": "error"}
    if report.passed:
        return NOTHING
    return {"by": "preflight", "name": report.summary.partition(":")[0], "dtype": "float32", "how": "fail"}


def judge(request: Mapping[str, Any]) -> Found:
    require_copy()
    module = importlib.import_module(".".join(PurePosixPath(request["file"]).with_suffix("").parts))
    if Path.cwd().resolve() not in Path(str(module.__file__)).resolve().parents:
        raise RuntimeError(f"{module.__file__} is not the copy")
    if request["device"] and not _has(request["candidate"], request["device"]):
        return {**NOTHING, "by": "no device", "name": request["device"]}
    found = first_failure(request)
    if found["by"] is None and request["preflight"]:
        found = preflight_failure(request)
    return found


def _has(candidate: str, device: str) -> bool:
    select = importlib.import_module(f"impl_{candidate}.learner").select_device
    try:
        select(device)
    except ValueError:
        return False
    return True


if __name__ == "__main__":
    print(json.dumps(judge(json.loads(sys.argv[1]))))
