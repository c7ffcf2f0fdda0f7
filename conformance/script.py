"""Scripts: checks that hand a candidate's result to another call, or that drive an object which the candidate made."""

from collections.abc import Callable, Iterable
from typing import Any

from conformance.case import Call, Equal, Refused, Setting
from conformance.compare import Comparisons
from conformance.drawing import run_examples
from conformance.judge import Ask, copied, judge_refusal


class Script:
    """What a script is run with.

    setting: precision, profile and seed. compare, exact and holds: see `Comparisons`. shrink: whether hypothesis makes
    values smaller that a candidate deviates with. any_error: whether it may refuse with any exception. refusals:
    whether what must be refused is tried.
    """

    def __init__(
        self,
        setting: Setting,
        ask: Ask,
        comparisons: Comparisons,
        shrink: bool = True,
        any_error: bool = False,
        refusals: bool = True,
    ) -> None:
        self.setting, self.comparisons = setting, comparisons
        self.compare, self.exact, self.holds = comparisons.compare, comparisons.exact, comparisons.holds
        self._ask, self._shrink, self._any_error, self._refusals = ask, shrink, any_error, refusals

    def call(self, function: str, *arguments: Any) -> Any:
        """The candidate's result."""
        self.comparisons.call = Call(function, copied(arguments))
        return self._ask(Call(function, arguments), None)

    def expect(self, function: str, arguments: tuple[Any, ...], expected: Any, **how: Any) -> Any:
        """Compares the candidate's result, and returns it. `how`: see `Comparisons.compare`."""
        self.comparisons.call = Call(function, copied(arguments))
        actual = self._ask(Call(function, arguments), Equal(expected, **how))
        self.compare(function, actual, expected, **how)
        return actual

    def refuses(self, function: str, *arguments: Any, naming: Iterable[str] = ()) -> None:
        """Raises `Deviation` unless the candidate refuses the call: see `Refused`."""
        if self._refusals:
            call, demand = Call(function, arguments), Refused(tuple(naming))
            judge_refusal(call, demand, self._ask, self.comparisons, self._any_error)

    def for_all(self, **strategies: Any) -> Callable[[Callable[..., None]], None]:
        """Decorator: runs the function on values drawn by hypothesis, and shrinks the first that deviate."""
        return lambda body: run_examples(body, strategies, self.setting, self._shrink)
