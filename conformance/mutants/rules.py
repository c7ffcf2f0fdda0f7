"""What can be otherwise in one term of an equation: pairs of a node of the syntax tree and what takes its place."""

import ast
import copy
import itertools
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from spec.config import Config

Change = tuple[ast.expr, ast.expr]

OPTIONS = frozenset(name for name, kind in typing.get_type_hints(Config).items() if kind is float)
"""Of the configuration, the numbers that equations hold."""
SHAPES = ("reshape", "zeros", "ones", "full", "eye", "checked", "require_shape", "require_shapes", "require_keys")
"""Functions whose arguments are sizes and names: nothing of an equation."""
ONE_ARGUMENT = ("abs", "sqrt", "exp", "log", "log1p", "expm1", "tanh")
FACTORS, SUMMANDS = (ast.Mult, ast.Div), (ast.Add, ast.Sub)


def changes(function: ast.stmt, names: Mapping[str, Any]) -> Iterator[Change]:
    """Every change of a single term in the body of a function, likely mistakes first.

    names: what stands in the function's module.
    """
    assert isinstance(function, ast.FunctionDef)
    nodes = list(_nodes(function))
    indices = {inner for node in nodes if isinstance(node, ast.Subscript) for inner in ast.walk(node.slice)}
    terms = [node for node in nodes if node not in indices]
    scalars = {argument.arg for argument in function.args.args if _is_float(argument)}
    parents = {child: node for node in nodes for child in ast.iter_child_nodes(node)}
    for node in nodes:
        yield from _shifted_indices(node)
    rules: tuple[Callable[[ast.AST], Iterator[Change]], ...] = (
        lambda node: _left_out(node, parents.get(node)),
        _other_reductions,
        _without_stop_gradient,
        lambda node: _inner_terms(node, names),
        _turned_signs,
        lambda node: _constants(node, parents.get(node), scalars, names),
        _comparisons,
    )
    for rule in rules:
        for node in terms:
            yield from rule(node)


def precedence(node: ast.expr) -> int:
    """How tightly an expression binds."""
    if isinstance(node, ast.BinOp):
        return {ast.Add: 2, ast.Sub: 2, ast.Pow: 5}.get(type(node.op), 3)
    if isinstance(node, ast.UnaryOp):
        return 1 if isinstance(node.op, ast.Not) else 4
    return 0 if isinstance(node, ast.IfExp | ast.Lambda | ast.BoolOp) else 1 if isinstance(node, ast.Compare) else 6


def _nodes(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """The nodes of the body in the order of the source, without docstrings, annotations, errors and shapes."""
    left: list[ast.AST] = [*reversed(function.body)]
    while left:
        node = left.pop()
        yield node
        if isinstance(node, ast.Raise | ast.JoinedStr):
            continue
        children: list[ast.AST] = list(ast.iter_child_nodes(node))
        if isinstance(node, ast.AnnAssign):
            children = [node.target] if node.value is None else [node.target, node.value]
        if isinstance(node, ast.FunctionDef):
            children = [*node.body]
        if isinstance(node, ast.Call) and _called(node) in SHAPES:
            children = [node.func]
        if isinstance(node, ast.Call) and _called(node) == "require":
            children = [node.args[0]]  # the condition
        left += reversed(children)


def _is_float(argument: ast.arg) -> bool:
    return isinstance(argument.annotation, ast.Name) and argument.annotation.id == "float"


def _called(node: ast.expr) -> str:
    """The last name of what is called: sum of np.sum(x) and of x.sum()."""
    if not isinstance(node, ast.Call):
        return ""
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def _shifted_indices(node: ast.AST) -> Iterator[Change]:
    """x[t + 1] is x[t] or x[t + 2], x[:-1] is x[1:], and a loop ends one step earlier or later."""
    if isinstance(node, ast.Subscript) and getattr(node.value, "attr", "") != "shape":
        is_tuple = isinstance(node.slice, ast.Tuple)
        entries = list(node.slice.elts) if isinstance(node.slice, ast.Tuple) else [node.slice]
        for (place, entry), step in itertools.product(enumerate(entries), (-1, 1)):
            if (moved := _moved(entry, step)) is not None:
                others = [*entries[:place], moved, *entries[place + 1 :]]
                inside = ast.Tuple(others, ast.Load()) if is_tuple else moved
                yield node, ast.Subscript(node.value, inside, node.ctx)
    elif isinstance(node, ast.Call) and _called(node) == "range":
        for step in (-1, 1):
            last = _plus(node.args[-1], step)
            yield node, ast.Call(node.func, [*node.args[:-1], last], [])


def _moved(entry: ast.expr, step: int) -> ast.expr | None:
    """An index or a slice, shifted; None where it cannot be."""
    if isinstance(entry, ast.Slice):
        if (entry.lower is None and (entry.upper is None or step < 0)) or _value(entry.step) in (-1,):
            return None
        if entry.lower is None and entry.upper is not None and _value(entry.upper) is None:
            return ast.Slice(None, _plus(entry.upper, step), entry.step)
        lower, upper = _bound(entry.lower, step, 0), _bound(entry.upper, step, None)
        return ast.Slice(lower, upper, entry.step)
    is_number = isinstance(_value(entry), int) or isinstance(entry, ast.Name)
    is_sum = isinstance(entry, ast.BinOp) and isinstance(entry.op, SUMMANDS)
    return _plus(entry, step) if is_number or is_sum else None


def _bound(bound: ast.expr | None, step: int, default: int | None) -> ast.expr | None:
    """A bound of a slice, shifted. At the beginning and at the end it is left out."""
    if bound is None:
        return ast.Constant(step) if default == 0 or step < 0 else None
    moved = _plus(bound, step)
    return None if _value(moved) == 0 else moved


def _plus(node: ast.expr, step: int) -> ast.expr:
    """An expression and a number, added where that can be done."""
    if isinstance(value := _value(node), int):
        return _number(value + step)
    if isinstance(node, ast.BinOp) and isinstance(node.op, SUMMANDS) and isinstance(value := _value(node.right), int):
        total = (value if isinstance(node.op, ast.Add) else -value) + step
        return _plus(node.left, total) if total else node.left
    return ast.BinOp(node, ast.Add() if step > 0 else ast.Sub(), ast.Constant(abs(step)))


def _number(value: int) -> ast.expr:
    return ast.UnaryOp(ast.USub(), ast.Constant(-value)) if value < 0 else ast.Constant(value)


def _value(node: ast.AST | None) -> int | float | None:
    """The number that an expression is."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        inner = _value(node.operand)
        return None if inner is None else -inner
    is_number = isinstance(node, ast.Constant) and isinstance(node.value, int | float)
    return node.value if is_number and not isinstance(node.value, bool) else None  # type: ignore[union-attr]


def _left_out(node: ast.AST, parent: ast.AST | None) -> Iterator[Change]:
    """A factor or a summand is missing: of 1 - x the 1 with its sign."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        yield node, node.left
        return
    kind = FACTORS if _is_chain(node, FACTORS) else SUMMANDS
    if not _is_chain(node, kind) or (_is_chain(parent, kind) and getattr(parent, "left", None) is node):
        return  # what is on the left of a chain belongs to it
    assert isinstance(node, ast.expr)
    terms = _terms(node, kind)
    for place in range(len(terms)):
        yield node, _chain(terms[:place] + terms[place + 1 :], kind)


def _is_chain(node: ast.AST | None, kind: tuple[type[ast.operator], ...]) -> bool:
    return isinstance(node, ast.BinOp) and isinstance(node.op, kind)


def _terms(node: ast.expr, kind: tuple[type[ast.operator], ...]) -> list[tuple[ast.operator, ast.expr]]:
    """a - b + c as +a, -b, +c; a / b * c as *a, /b, *c."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, kind):
        return [*_terms(node.left, kind), (node.op, node.right)]
    return [(kind[0](), node)]


def _chain(terms: list[tuple[ast.operator, ast.expr]], kind: tuple[type[ast.operator], ...]) -> ast.expr:
    (first, whole), *others = terms
    if isinstance(first, ast.Div):
        whole = ast.BinOp(ast.Constant(1), ast.Div(), whole)
    elif isinstance(first, ast.Sub) and others:
        whole = ast.UnaryOp(ast.USub(), whole)
    for operator, term in others:
        whole = ast.BinOp(whole, operator, term)
    return whole


def _turned_signs(node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and _value(node) is None:
        yield node, node.operand
    elif isinstance(node, ast.BinOp) and isinstance(node.op, SUMMANDS):
        yield node, ast.BinOp(node.left, ast.Sub() if isinstance(node.op, ast.Add) else ast.Add(), node.right)


def _other_reductions(node: ast.AST) -> Iterator[Change]:
    """A mean is a sum, and an axis is another one."""
    if not isinstance(node, ast.Call):
        return
    swapped = {"mean": "sum", "sum": "mean", "maximum": "minimum", "minimum": "maximum"}
    if isinstance(node.func, ast.Attribute) and node.func.attr in swapped:
        other = ast.Attribute(node.func.value, swapped[node.func.attr], ast.Load())
        yield node, ast.Call(other, node.args, node.keywords)
    for place, keyword in enumerate(node.keywords):
        if keyword.arg == "axis":
            for axis in _other_axes(keyword.value):
                changed = copy.copy(node.keywords)
                changed[place] = ast.keyword("axis", axis)
                yield node, ast.Call(node.func, node.args, changed)


def _other_axes(axis: ast.expr) -> Iterator[ast.expr]:
    if isinstance(axis, ast.Tuple):
        for place in range(len(axis.elts)):
            yield ast.Tuple(axis.elts[:place] + axis.elts[place + 1 :], ast.Load())
    elif isinstance(value := _value(axis), int):
        yield from map(_number, [-2, 0] if value == -1 else [value - 1, value + 1])


def _without_stop_gradient(node: ast.AST) -> Iterator[Change]:
    """A stop-gradient is missing, or holds the neighbor in place of its own argument."""
    if not isinstance(node, ast.Call):
        return
    if _called(node) == "stop_gradient":
        yield node, node.args[0]
    for one, other in itertools.permutations(range(len(node.args)), 2):
        stopped = node.args[one]
        if isinstance(stopped, ast.Call) and _called(stopped) == "stop_gradient" and abs(one - other) == 1:
            moved = list(node.args)
            moved[one] = stopped.args[0]
            moved[other] = ast.Call(stopped.func, [node.args[other]], [])
            yield node, ast.Call(node.func, moved, node.keywords)


def _inner_terms(node: ast.AST, names: Mapping[str, Any]) -> Iterator[Change]:
    """A function is not applied; of a choice or a limit, one side is taken always."""
    if not isinstance(node, ast.Call):
        return
    name = _called(node)
    if name in ("where", "maximum", "minimum"):
        yield from ((node, argument) for argument in node.args[name == "where" :])
    elif name == "clip":
        yield node, node.args[0]
    elif len(node.args) == 1 and not node.keywords and not isinstance(node.args[0], ast.Starred):
        is_applied = callable(names.get(name)) and not name.lstrip("_").startswith(("require", "stop_gradient"))
        if name in ONE_ARGUMENT or is_applied:
            yield node, node.args[0]


def _constants(node: ast.AST, parent: ast.AST | None, scalars: set[str], names: Mapping[str, Any]) -> Iterator[Change]:
    """A number, an option or an argument that is one number is 1 or 0."""
    is_literal = _value(node) is not None and isinstance(node, ast.Constant) and _is_of_an_equation(parent)
    is_option = isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "config" and node.attr in OPTIONS
    name = node.id if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load) else ""
    is_scalar = name in scalars or (name.isupper() and isinstance(names.get(name), int | float))
    if is_literal or is_option or is_scalar:
        assert isinstance(node, ast.expr)
        for value in (1.0, 0.0):
            if _value(node) != value and not _is_as_left_out(node, value, parent):
                yield _in_its_term(node, ast.Constant(value), parent)


def _is_as_left_out(node: ast.expr, value: float, parent: ast.AST | None) -> bool:
    """Whether an operand does nothing with this value: 1 * x, x / 1, x + 0."""
    if not isinstance(parent, ast.BinOp):
        return False
    if isinstance(parent.op, ast.Add) or (isinstance(parent.op, ast.Sub) and parent.right is node):
        return value == 0.0
    return value == 1.0 and (isinstance(parent.op, ast.Mult) or parent.right is node)


def _in_its_term(node: ast.expr, wrong: ast.expr, parent: ast.AST | None) -> Change:
    """The change of an operand or an argument as one of its term, so that it can be told from others of its name."""
    if not isinstance(parent, ast.BinOp | ast.Compare | ast.Call):
        return node, wrong
    changed = copy.copy(parent)
    for field, value in ast.iter_fields(parent):
        if value is node:
            setattr(changed, field, wrong)
        elif isinstance(value, list):
            setattr(changed, field, [wrong if entry is node else entry for entry in value])
    return parent, changed


def _is_of_an_equation(parent: ast.AST | None) -> bool:
    if isinstance(parent, ast.Call):
        return _called(parent) in ("where", "maximum", "minimum", "clip")
    return isinstance(parent, ast.BinOp | ast.Compare)


def _comparisons(node: ast.AST) -> Iterator[Change]:
    """< is <=."""
    others = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
    if isinstance(node, ast.Compare):
        for place, operator in enumerate(node.ops):
            if other := others.get(type(operator)):
                changed = [*node.ops[:place], other(), *node.ops[place + 1 :]]
                yield node, ast.Compare(node.left, changed, node.comparators)
