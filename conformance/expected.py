"""Failures that are known and have a reason: a TOML file of names and reasons."""

import dataclasses
import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from conformance.check import CHECKS, Check
from conformance.errors import UserError, read_text
from conformance.execute import Result
from conformance.requirements import requirements


@dataclasses.dataclass(frozen=True)
class ExpectedFailures:
    """reasons: name of a check or id of a requirement -> why it fails. A requirement stands for every check that names
    it."""

    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def reason(self, check: Check) -> str | None:
        """Why this check may fail; None if it must not."""
        return next((self.reasons[name] for name in (check.name, *check.requirements) if name in self.reasons), None)

    def outcome(self, name: str, results: Iterable[Result]) -> str:
        """What came of an entry: "fail" as expected; "pass": all that it names and that was run; "not run"."""
        statuses = {result.status for result in results if name in (result.check.name, *result.check.requirements)} - {
            "not offered",
            "not in edition",
        }
        if not statuses:
            return "not run"
        return "pass" if statuses == {"pass"} else "fail"


def read_expected(path: Path) -> ExpectedFailures:
    """Reads lines such as `RET-1 = "bootstraps from its own value, as the paper prints it"`.

    The name of a check may be written as it is, `returns.lambda_return_matches`: that a dot makes a table in TOML does
    no harm.

    Raises:
      UserError: the file cannot be read, or names what there is not, or gives no reason.
    """
    try:
        entries = tomllib.loads(read_text(path))
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
    reasons = _flat(entries)
    require_reasons(reasons, str(path))
    return ExpectedFailures(reasons)


def require_reasons(reasons: Mapping[str, Any], where: str) -> None:
    """Raises UserError unless these are names of checks or requirements, each with a reason. where: what the message
    begins with."""
    import conformance.cases  # noqa: F401 - importing registers the checks

    known = {*CHECKS, *requirements()}
    for name, reason in reasons.items():
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            raise UserError(
                f"{where}: no check and no requirement is named {name}" + (f"; is {close[0]} meant?" if close else "")
            )
        if not isinstance(reason, str) or not reason.strip():
            raise UserError(f"{where}: {name}: expected a reason as text, got {reason!r:.80}")


def _flat(entries: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, entry in entries.items():
        flat |= (
            {f"{name}.{inner}": value for inner, value in _flat(entry).items()}
            if isinstance(entry, dict)
            else {name: entry}
        )
    return flat
