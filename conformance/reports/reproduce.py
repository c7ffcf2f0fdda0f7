"""What it takes to see one failure again: its inputs, a command line, and a few lines of Python."""

import shlex
from typing import Any

from conformance.execute import CheckOptions, FailedCall, Result
from conformance.interface import INTERFACE, OBJECTS
from conformance.our_candidates import OUR_CANDIDATES
from conformance.reports.values import WRITTEN_OUT, is_known, shown, size, source


def failure(result: Result, options: CheckOptions) -> dict[str, Any]:
    """The failing call in full as far as it is small, and how to repeat it; as the schema's `failure` says.

    The call is the last one before the deviation, with the most ordinary input that deviates: an example of a chapter,
    or else what is written down, or the smallest arguments that hypothesis finds.
    """
    call = result.call
    found: dict[str, Any] = {"function": None, "arguments": [], "got": None, "expected": None}
    if call is not None:
        names = INTERFACE[call.function]
        entries = [shown(name, value) for name, value in zip(names, call.arguments, strict=False)]
        found = {
            "function": call.function,
            "arguments": [entry for group in entries for entry in group],
            "got": None,
            "expected": None,
        }
        if call.got is not None and call.expected is not None:
            found["got"], found["expected"] = (
                shown("got", call.got, call.index)[0],
                shown("expected", call.expected, call.index)[0],
            )
    return {
        **found,
        "by_hand": call is not None and call.by_hand,
        "command": command(result.check.name, options),
        "snippet": snippet(result.check.name, call, options),
    }


def command(name: str, options: CheckOptions) -> str:
    """The command line that runs this check alone, on the same cases."""
    words = ["conformance", "check", *(["--process"] if options.process else []), options.candidate]
    words += [
        "--dtype",
        options.dtype,
        *(["--device", options.device] if options.device else []),
        "--edition",
        options.edition,
    ]
    return shlex.join([*words, "--only", name, "--seed", str(options.seed), "--examples", str(options.examples)])


def snippet(name: str, call: FailedCall | None, options: CheckOptions) -> str:
    """Python that makes the failing call again.

    Arguments of up to WRITTEN_OUT numbers are written out. Larger ones come from running the check again; so is a call
    that makes an object, which fails in one of its methods.
    """
    adapter = _adapter(options)
    is_written = (
        call is not None
        and call.function not in OBJECTS
        and size(call.arguments) <= WRITTEN_OUT
        and is_known(call.arguments)
    )
    if call is not None and is_written:
        names = INTERFACE[call.function]
        arguments = [(name, source(value)) for name, value in zip(names, call.arguments, strict=True)]
        spec = [
            word
            for word in ("Discrete", "Image", "Parameter", "Spaces", "Vector", "load_config")
            if f"{word}(" in str(arguments)
        ]
        lines = [
            "import numpy as np",
            "",
            adapter[0],
            *([f"from spec import {', '.join(spec)}"] if spec else []),
            "",
            adapter[1],
        ]
        lines += [f"{name} = {text}" for name, text in arguments]
        return "\n".join([*lines, f"print(adapter.{call.function}({', '.join(names)}))"])
    how = f"find_edition({options.edition!r}), {options.dtype!r}, seed={options.seed}, examples={options.examples}"
    lines = [
        "import conformance.cases",
        adapter[0],
        "from conformance.check import CHECKS",
        "from conformance.editions import judge_twice",
        "from spec import find_edition",
        "",
    ]
    lines += [adapter[1], f"result = judge_twice(CHECKS[{name!r}], adapter, {how})", "print(result.message)"]
    if call is not None and call.function not in OBJECTS:
        lines += [f"print(adapter.{call.function}(*result.call.arguments))"]
        lines += ["print(result.call.expected)"] if call.expected is not None else []
    return "\n".join(lines)


def _adapter(options: CheckOptions) -> tuple[str, str]:
    """Two lines: the import, and the adapter."""
    if options.process:
        made = f"ProcessAdapter({options.candidate!r}, {options.dtype!r}, timeout=120)"
        return "from conformance.process import ProcessAdapter", f"adapter = {made}"
    device = f", {options.device!r}" if options.device and options.candidate in OUR_CANDIDATES else ""
    return (
        "from conformance.candidate import load_candidate",
        f"adapter = load_candidate({options.candidate!r}, {options.dtype!r}{device})",
    )
