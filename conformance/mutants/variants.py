"""Single-term variants of the equations: of each function of the reference all versions with one term otherwise.

They are made from its source by rule, when they are asked for: an index is shifted by one, a factor or a summand is
left out, a sign is turned, a mean is a sum, an axis is the next one, a stop-gradient is missing, a constant is 0 or 1,
and < is <=. Such a variant is nobody's known mistake. It says where an implementation leaves the equation, and how.
"""

import ast
import functools
import importlib
import inspect
import itertools
import re
from typing import Any

from conformance.mutants import rules
from conformance.mutants.catalogue import GENERATED, Mutant
from conformance.requirements import chapter_of, requirements

CHAPTERS = (
    *("transforms", "distributions", "layers", "rssm", "networks", "world_model", "returns", "behavior"),
    *("optimizer", "agent"),
)
"""The modules of the reference that hold equations."""


@functools.cache
def variants(target: str) -> tuple[Mutant, ...]:
    """Of a function, "chapter.function": likely ones first. None of classes, and of modules without equations."""
    chapter, name = target.split(".")
    module = importlib.import_module(f"reference_numpy.{chapter}")
    function = getattr(module, name, None)
    if chapter not in CHAPTERS or not inspect.isfunction(function):
        return ()
    lines, first_line = inspect.getsourcelines(function)
    source = "".join(lines)
    violated = _requirement_of(module, name)
    path = chapter_of(violated[0])
    made: dict[str, Mutant] = {}
    for node, wrong in rules.changes(ast.parse(source).body[0], vars(module)):
        edited = _replaced(source, node, wrong)
        where = f"reference_numpy/{chapter}.py:{first_line + node.lineno - 1}"
        right, instead = ast.unparse(node), ast.unparse(wrong)
        if edited != source and edited not in made:
            made[edited] = Mutant(
                name=f"{where}: {instead} for {right}",
                explanation=f"{name} ({path}, {violated[0]}) behaves as if `{right}` were `{instead}`",
                provenance="",
                violates=violated,
                fix=f"Compare with {where}, which has `{right}`.",
                edits={target: {source: edited}},
                kind=GENERATED,
            )
    return tuple(made.values())


def _replaced(source: str, node: ast.expr, wrong: ast.expr) -> str:
    """The source with another expression in place of a node. Columns of the syntax tree are bytes."""
    lines = source.encode().splitlines(keepends=True)
    starts = [0, *itertools.accumulate(map(len, lines))]
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    begin, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
    text = ast.unparse(wrong)
    if rules.precedence(wrong) < rules.precedence(node):
        text = f"({text})"
    whole = b"".join(lines)
    return (whole[:begin] + text.encode() + whole[end:]).decode()


def _requirement_of(module: Any, name: str) -> tuple[str, ...]:
    """The requirement that begins with a function's name; or else the first that it implements, or the first function
    of its module that calls it."""
    if own_sentence := [key for key, text in requirements().items() if text.startswith(f"`{name}(")]:
        return (own_sentence[0],)
    functions = [value for value in vars(module).values() if inspect.isfunction(value)]
    own = [value for value in functions if value.__module__ == module.__name__]
    callers = [value for value in own if name in value.__code__.co_names]
    for function in (getattr(module, name), *callers, *own):
        known = [word for word in re.findall(r"\[([A-Z]+-\d+)\]", function.__doc__ or "") if word in requirements()]
        if known:
            return (known[0],)
    raise ValueError(f"no function of {module.__name__} names a requirement")
