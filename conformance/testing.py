"""The checks as tests of your own: one pytest test for each. Of the whole kit only this module needs pytest."""

import contextlib
import traceback
from collections.abc import Callable, Mapping

import pytest

from conformance.candidate import candidate as opened
from conformance.check import CHECKS, Check
from conformance.compare import DTYPES
from conformance.editions import NOT_JUDGED, judge_twice
from conformance.errors import UserError
from conformance.execute import FAILING, CheckOptions, Result, selected_checks
from conformance.expected import require_reasons
from conformance.reports import summary, terminal
from conformance.requirements import chapter_of, requirements
from conformance.results import check_data
from spec import Edition, find_edition


def dreamer_conformance(
    candidate: str | None = None,
    *,
    edition: str,
    process: str | None = None,
    timeout: float = 120.0,
    dtype: str = "float64",
    device: str | None = None,
    only: str = "",
    xfail: Mapping[str, str] | None = None,
    seed: int = 0,
    examples: int = 25,
) -> Callable[..., None]:
    """A test function with one test for each check: assign it to a name that pytest collects, such as `test_dreamer`.

    A check that the adapter does not offer, or that is not judged in the edition, is skipped with the reason. All tests
    of a module share one adapter, which the first of them makes.

    Args:
      candidate: an adapter of your own, a module or a .py file; a relative path is looked for beside the test file.
      edition: to judge in, such as "2024-12". `conformance check` says which one fits.
      process: in place of a candidate, a command that starts one.
      xfail: name of a check -> why it fails. If it passes, its test fails.

    The others are the options of `conformance check`.

    Raises:
      UserError: there is no such edition, dtype or check, or there is not one candidate.
    """
    if (candidate is None) == (process is None):
        raise UserError('give either a candidate, such as "my_adapter.py", or process="COMMAND"')
    if dtype not in DTYPES:
        raise UserError(f"dtype: expected one of {', '.join(DTYPES)}, got {dtype!r}")
    judged_in = _find_edition(edition)
    checks = selected_checks(dtype, only)
    if not checks:
        raise UserError(f"only: no check has {only!r} in its name or in the id of a requirement, with dtype {dtype!r}")
    reasons = xfail or {}
    _require_checks(reasons)
    shared = _SharedAdapter()

    @pytest.mark.parametrize(
        "check", [pytest.param(check, id=check.name, marks=_marks(check, reasons)) for check in checks]
    )
    def test(check: Check, request: pytest.FixtureRequest) -> None:
        path = str(request.path.parent / candidate) if candidate and candidate.endswith(".py") else candidate
        asked = CheckOptions(
            candidate=path or process or "",
            process=process is not None,
            dtype=dtype,
            device=device,
            edition=judged_in.name,
            only=only,
            seed=seed,
            examples=examples,
            at_least=1,
        )
        adapter = shared.of(request.node, lambda: opened(path, process, dtype, device, timeout))
        result = judge_twice(check, adapter, judged_in, dtype, seed, examples)
        if result.status in ("not offered", NOT_JUDGED):
            pytest.skip(result.message)
        if result.status in FAILING:
            raise CheckFailed(_told(result, asked), pytrace=False)

    return test


class CheckFailed(pytest.fail.Exception):  # type: ignore[name-defined]
    """A check fails. Nothing else is a failure that `xfail` expects, least of all an adapter that cannot be loaded."""

    __module__ = "builtins"  # as of pytest's own: it is shown by its name alone


def _find_edition(name: str) -> Edition:
    try:
        return find_edition(name)
    except ValueError as error:
        raise UserError(f"edition: {error}") from error


def _require_checks(xfail: Mapping[str, str]) -> None:
    """Raises UserError unless these are names of checks, each with a reason. A requirement does not say which of its
    checks must fail."""
    require_reasons(xfail, "xfail")
    for name in xfail.keys() & requirements().keys():
        checks = [check.name for check in CHECKS.values() if name in check.requirements]
        raise UserError(f"xfail: {name} is a requirement; name its checks: {', '.join(checks) or 'there is none'}")


def _marks(check: Check, reasons: Mapping[str, str]) -> list[pytest.MarkDecorator]:
    if check.name not in reasons:
        return []
    return [pytest.mark.xfail(reason=reasons[check.name], raises=CheckFailed, strict=True)]


class _SharedAdapter:
    """The adapter of all tests of a module, from the first that asks for it until the last has ended."""

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._adapter: object | None = None
        self._problem = ""

    def of(self, test: pytest.Item, make: Callable[[], contextlib.AbstractContextManager[object]]) -> object:
        """Fails the test if there is none. That is found out once: a slow start is not tried for every check."""
        if self._adapter is None and not self._problem:
            self._begin(test, make)
        if self._problem:
            pytest.fail(self._problem, pytrace=False)
        return self._adapter

    def _begin(self, test: pytest.Item, make: Callable[[], contextlib.AbstractContextManager[object]]) -> None:
        stack = contextlib.ExitStack()
        stack.callback(self._forget)
        module = test.getparent(pytest.Module)
        assert module is not None
        module.addfinalizer(stack.close)
        try:
            self._adapter = stack.enter_context(make())
        except UserError as error:
            self._problem = str(error)
        except Exception:
            self._problem = traceback.format_exc()


def _told(result: Result, asked: CheckOptions) -> str:
    """A failure as `conformance check` prints it, with the chapters to read."""
    data = terminal.printable(check_data(result, asked))
    texts = {name: requirements()[name] for name in result.check.requirements if name in requirements()}
    paths = dict.fromkeys(map(chapter_of, result.check.requirements))
    return "\n".join(
        [
            f"{result.check.name} ({', '.join(data['requirements'])}): {data['summary']}",
            *(f"  {sentence}" for sentence in summary.sentences(texts)),
            f"see {', '.join(f'{summary.title(path)} ({path})' for path in paths)}",
            *(["only with extreme input; with ordinary input it passes"] if result.extreme else []),
            terminal.details(data),
            f"  {data['failure']['command']}",
        ]
    )
