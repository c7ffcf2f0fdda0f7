"""A check that asks several functions judges those that are there."""

from typing import Any

import pytest
from adapters import CHECKS

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.editions import editions, judge
from conformance.execute import by_requirement, missing
from conformance.offered import narrowed, unchecked

SETTING = Setting("float64", "paper", 0, 3)


class Only:
    """The reference, with some of its functions, and one of them wrong."""

    def __init__(self, *names: str, wrong: str = "") -> None:
        self._names, self._wrong = names, wrong

    def __getattr__(self, name: str) -> Any:
        if name not in self._names:
            raise AttributeError(name)
        function = getattr(NumpyAdapter(), name)
        return (lambda *arguments: function(*arguments) + 1) if name == self._wrong else function


def judged(name: str, adapter: object) -> Any:
    return judge(CHECKS[name], adapter, editions()["paper"], "float64", examples=3)


@pytest.mark.parametrize(
    ("check", "function"),
    [
        ("rssm.logits_match", "prior"),
        ("distributions.normal_matches", "normal_log_prob"),
        ("networks.heads_literals", "continue_head"),
        ("layers.layers_refuse_shapes", "max_pool"),
    ],
)
def test_one_of_several_functions_is_judged_without_the_others(check: str, function: str) -> None:
    alone = judged(check, Only(function))
    assert alone.status == "pass"
    assert 0 < alone.compared < judged(check, NumpyAdapter()).compared
    assert set(alone.check.lacking) == set(CHECKS[check].uses) - {function}
    if not check.endswith("refuse_shapes"):
        assert judged(check, Only(function, wrong=function)).status == "fail"


def test_its_requirements_are_covered_in_part() -> None:
    whole, part = ([judged("rssm.logits_match", adapter)] for adapter in (NumpyAdapter(), Only("prior")))
    assert {one.status for one in by_requirement(whole)} == {"pass"}
    assert {one.status for one in by_requirement(part)} == {"not offered"}
    assert unchecked(["prior"], part) == []


def test_cases_that_ask_several_functions_need_all_of_them() -> None:
    check = CHECKS["transforms.symexp_inverts_symlog"]
    assert narrowed(check, Only("symlog"), SETTING) is check
    assert judged(check.name, Only("symlog")).status == "not offered"


def test_what_offers_nothing_of_it_or_all_of_it_keeps_the_check() -> None:
    check = CHECKS["rssm.logits_match"]
    for adapter in (Only("symlog"), Only("prior", "posterior")):
        assert narrowed(check, adapter, SETTING) is check
    once, again = (narrowed(check, Only("prior"), SETTING) for _ in range(2))
    assert once == again
    assert missing(Only("prior"), once) == []
