"""The checks as tests of somebody else's test suite: conformance/testing.py."""

import contextlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from report_data import ADAPTER, CHECKS, FAIL, PASS

from conformance import serve, testing
from conformance.editions import own_reference
from conformance.errors import UserError
from conformance.mutants import MutantAdapter
from conformance.process import ProcessAdapter
from conformance.testing import dreamer_conformance

pytest_plugins = ["pytester"]

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "adapters.md"
ABSENT, RAISES = "transforms.twohot_literals", "layers.rms_norm_literals"


def run(pytester: pytest.Pytester, arguments: str, *options: str) -> pytest.RunResult:
    """A test file with the checks of the adapter of report_data.py, which has a mistake in its λ-return."""
    pytester.makepyfile(my_adapter=ADAPTER)
    pytester.makepyfile(
        test_mine=f"""
        from conformance.testing import dreamer_conformance

        test_dreamer = dreamer_conformance({arguments})
        """
    )
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", *options)


def one(name: str, more: str = "") -> str:
    return f'"my_adapter.py", edition="paper", only={name!r}, examples=2, {more}'


class Opened:
    """Stands in for the making of an adapter, and counts."""

    def __init__(self, adapter: object) -> None:
        self.adapter, self.begun, self.ended = adapter, 0, 0

    @contextlib.contextmanager
    def __call__(self, *_: Any) -> Iterator[object]:
        self.begun += 1
        if isinstance(self.adapter, Exception):
            raise self.adapter
        yield self.adapter
        self.ended += 1


# --- Outcomes
# ------------------------------------------------------------------------------


def test_a_check_that_holds_passes(pytester: pytest.Pytester) -> None:
    result = run(pytester, one(PASS), "-v")
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines([f"test_mine.py::test_dreamer?{PASS}? *PASSED*"])


def test_a_deviation_fails_and_says_what_is_wrong(pytester: pytest.Pytester) -> None:
    result = run(pytester, one(FAIL))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            f"{FAIL} (RET-1): {CHECKS[FAIL].summary}",
            "see 07 Returns (spec/07-returns.md)",
            "lambda_return, a return by hand?0, 2?: got 5.0, expected 7.0, differs by 2*",
            "  lambda_return, called with",
            "    reward = ??9.0, 1.0, 0.0, 2.0??",
            f"  conformance check {pytester.path}/my_adapter.py --dtype float64 --edition paper --only {FAIL} *",
        ]
    )
    result.stdout.no_fnmatch_line("*testing.py*")  # no traceback


def test_what_the_adapter_raises_fails(pytester: pytest.Pytester) -> None:
    result = run(pytester, one(RAISES))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["RuntimeError: out of order"])


def test_a_failure_with_extreme_input_only_says_so(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        timid="""
        import numpy as np

        def symlog(x):
            if not np.all(np.abs(x) < 1e9):
                raise OverflowError("too large")
            return np.sign(x) * np.log1p(np.abs(x))
        """
    )
    result = run(pytester, f'"timid.py", edition="paper", only="{PASS}"')
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["only with extreme input; with ordinary input it passes"])


def test_what_is_not_offered_is_skipped(pytester: pytest.Pytester) -> None:
    result = run(pytester, one(ABSENT), "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["SKIPPED*the adapter does not offer twohot"])


def test_what_the_edition_leaves_open_is_skipped(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(mine="def core(params, deter, stoch, action, config):\n    return deter\n")
    result = run(pytester, '"mine.py", edition="2023", only="rssm.core_matches"', "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["SKIPPED*2023*otherwise*"])


def test_an_edition_is_judged_by_its_own_reference(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    first = own_reference("2023")
    assert first is not None
    monkeypatch.setattr(testing, "opened", Opened(MutantAdapter(first)))
    run(pytester, '"numpy", edition="2023", only="twohot_literals"').assert_outcomes(passed=2)
    run(pytester, '"numpy", edition="official", only="twohot_literals"').assert_outcomes(failed=2)


# --- Known failures
# ------------------------------------------------------------------------------


def test_a_known_failure_is_expected(pytester: pytest.Pytester) -> None:
    result = run(pytester, one(FAIL, f'xfail={{"{FAIL}": "issue 12"}}'), "-rx")
    result.assert_outcomes(xfailed=1)
    result.stdout.fnmatch_lines(["XFAIL*issue 12*"])


def test_a_known_failure_that_passes_fails(pytester: pytest.Pytester) -> None:
    result = run(pytester, one(PASS, f'xfail={{"{PASS}": "issue 12"}}'))
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*XPASS(strict)* issue 12*"])


def test_a_known_failure_that_is_not_offered_is_skipped(pytester: pytest.Pytester) -> None:
    run(pytester, one(ABSENT, f'xfail={{"{ABSENT}": "issue 12"}}')).assert_outcomes(skipped=1)


def test_an_adapter_that_cannot_be_made_is_no_known_failure(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = Opened(RuntimeError("no license"))
    monkeypatch.setattr(testing, "opened", opened)
    result = run(pytester, one("returns.lambda_return", f'xfail={{"{FAIL}": "issue 12"}}'))
    result.assert_outcomes(failed=3)
    result.stdout.fnmatch_lines(["RuntimeError: no license"])
    assert opened.begun == 1, "it is not tried again for every check"


def test_an_adapter_that_is_not_there(pytester: pytest.Pytester) -> None:
    result = run(pytester, '"theirs.py", edition="paper", only="symlog_literals"')
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines([f"no file {pytester.path}/theirs.py; `conformance new-adapter *"])


# --- As pytest users expect
# ------------------------------------------------------------------------------


def test_all_tests_share_one_adapter_that_is_closed_at_the_end(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = Opened(object())
    monkeypatch.setattr(testing, "opened", opened)
    run(pytester, one("symlog")).assert_outcomes(skipped=3)
    assert (opened.begun, opened.ended) == (1, 1)
    run(pytester, one("symlog"), "--collect-only")
    assert opened.begun == 1, "none is made before a test needs it"


def test_a_process_is_checked_and_ended(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[object] = []
    close = ProcessAdapter.close
    monkeypatch.setattr(ProcessAdapter, "close", lambda adapter: (closed.append(adapter), close(adapter)))
    command = f"{sys.executable} {serve.__file__} my_adapter.py"
    result = run(
        pytester, f"process={command!r}, edition='paper', only='_literals', examples=2", "-k", "symlog or lambda"
    )
    assert {"passed": 1, "failed": 1}.items() <= result.parseoutcomes().items()
    result.stdout.fnmatch_lines([f"  conformance check --process '{command}' *"])
    assert len(closed) == 1


def test_tests_are_chosen_by_name(pytester: pytest.Pytester) -> None:
    result = run(pytester, one("returns"), "-k", f"{FAIL} or weights_literals")
    assert {name: count for name, count in result.parseoutcomes().items() if name in ("failed", "skipped")} == {
        "failed": 1,
        "skipped": 1,
    }


def test_the_first_failure_ends_the_run(pytester: pytest.Pytester) -> None:
    run(pytester, one("returns.lambda_return"), "-x").assert_outcomes(failed=1)


def test_several_processes_share_the_work(pytester: pytest.Pytester) -> None:
    result = run(pytester, one("returns.lambda_return"), "-n", "2")
    result.assert_outcomes(failed=3)


def test_an_adapter_is_looked_for_beside_the_test_file(pytester: pytest.Pytester) -> None:
    folder = pytester.mkdir("tests")
    (folder / "beside.py").write_text(ADAPTER, encoding="utf-8")
    (folder / "test_theirs.py").write_text(
        f"from conformance.testing import dreamer_conformance as make\ntest = make('beside.py', edition='paper', "
        f"only='{PASS}')\n",
        encoding="utf-8",
    )
    pytester.runpytest_inprocess("-p", "no:cacheprovider").assert_outcomes(passed=1)


def test_the_example_of_the_document(pytester: pytest.Pytester) -> None:
    (example,) = (
        block
        for block in re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
        if "dreamer_conformance" in block
    )
    pytester.makepyfile(my_adapter=ADAPTER, test_mine=example)
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-k", "lambda_return_m or symlog_matches")
    assert {"passed": 1, "xfailed": 1}.items() <= result.parseoutcomes().items()


# --- What cannot be
# ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"edition": "2020"}, "edition: unknown edition '2020'; known: 2023, 2024-04, 2024-12, paper"),
        ({"dtype": "float16"}, "dtype: expected one of float64, float32, bfloat16, got 'float16'"),
        ({"only": "no such"}, "only: no check has 'no such' in its name or in the id of a requirement"),
        (
            {"xfail": {"returns.lambda_return_match": "why"}},
            "xfail: no check and no requirement is named returns.lambda_return_match; is returns.lambda_return_matches",
        ),
        ({"xfail": {FAIL: ""}}, f"xfail: {FAIL}: expected a reason as text, got ''"),
        ({"xfail": {"RET-3": "why"}}, "xfail: RET-3 is a requirement; name its checks: .*losses.return_range_matches"),
        ({"candidate": None}, "give either a candidate, such as .my_adapter.py., or process="),
        ({"process": "COMMAND"}, "give either a candidate, such as .my_adapter.py., or process="),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        dreamer_conformance(**{"candidate": "my_adapter.py", "edition": "paper", **arguments})


def test_a_wrong_argument_is_an_error_of_the_test_file(pytester: pytest.Pytester) -> None:
    result = run(pytester, '"my_adapter.py", edition="2020"')
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*UserError: edition: unknown edition '2020'; known: 2023, 2024-04, 2024-12, paper"])
