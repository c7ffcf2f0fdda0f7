"""Results as plain JSON types."""

import importlib.metadata
import json
from pathlib import Path
from typing import Any


def finite(number: float) -> float | None:
    """Three digits of a number; None where it has no size."""
    return float(f"{number:.3g}") if abs(number) < 1e300 else None


def versions() -> dict[str, str]:
    """Of the kit and of what it stands on."""
    installed = {distribution.name: distribution.version for distribution in importlib.metadata.distributions()}
    return {name: installed[name] for name in ("dreamer-spec", "numpy", "jax", "torch") if name in installed}


def write(path: Path, report: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
