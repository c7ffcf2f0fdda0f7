"""The checks of the chapter on the buffer of a run, with sequences that cross files. With files of the usual size:
test_trainer_conforms.py."""

import functools

import pytest

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.check import Check
from conformance.execute import run_check, selected_checks
from dreamer_spec.replay import Replay

CHECKS = [check for check in selected_checks("float64") if "Replay" in check.uses]


class WithThisBuffer(NumpyAdapter):
    """deter in float32, because the checks compare it bit by bit; small chunks, so that sequences cross them."""

    Replay = staticmethod(functools.partial(Replay, deter_dtype="float32", chunk_records=8, block_records=4))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_the_buffer_passes(check: Check) -> None:
    result = run_check(check, WithThisBuffer(), Setting("float64", "paper", examples=10))
    assert result.status == "pass", result.message


def test_there_are_checks() -> None:
    assert len(CHECKS) >= 15
