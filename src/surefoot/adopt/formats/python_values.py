"""Static reader of the numbers, strings and dictionaries that the classes of a Python file assign; the file is not run.

Arithmetic of literals and previously assigned names is evaluated. Any other assigned value becomes a `Computed`.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from surefoot.errors import SurefootError

_MAX_DEPTH = 8
_MAX_ITEMS = 1000
_MAX_POWER = 64
_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}
Scope = dict[str, Any]


class Computed(NamedTuple):
    """A value that can't be determined without running the file."""

    text: str
    """Source text of the expression."""


class _NotLiteralError(Exception):
    """An expression does not consist of literals."""


def read_classes(source: bytes, sections: tuple[str, ...]) -> dict[str, Any]:
    """Return the values that the classes of a Python file assign, by dotted name below the top-level class.

    If several top-level classes assign the same name, the last one wins.

    Args:
        source: content of the file.
        sections: names of classes that are treated as nested even if they are at the top level.

    Raises:
        SurefootError: the file is not Python.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise SurefootError(f"is not Python: {error}") from error
    values: dict[str, Any] = {}
    module: Scope = {}
    for item in tree.body:
        if isinstance(item, ast.ClassDef):
            _visit(item.body, f"{item.name}." if item.name in sections else "", 0, module, values)
        else:
            _assign(item, "", {}, module, {}, module)
            values.update(_attribute_assignments(item, module))
    return values


def _visit(body: list[ast.stmt], prefix: str, depth: int, module: Scope, values: dict[str, Any]) -> None:
    own: Scope = {}
    for item in body:
        if isinstance(item, ast.ClassDef):
            if depth < _MAX_DEPTH:
                _visit(item.body, f"{prefix}{item.name}.", depth + 1, module, values)
        else:
            _assign(item, prefix, own, module, values, own)


def _assign(item: ast.stmt, prefix: str, own: Scope, module: Scope, values: dict[str, Any], scope: Scope) -> None:
    """Store the names that a statement assigns in `scope` and, by dotted name, in `values`."""
    if isinstance(item, ast.Assign | ast.AnnAssign) and item.value is not None:
        targets = item.targets if isinstance(item, ast.Assign) else [item.target]
        value = _fold_or_computed(item.value, {**module, **own})
        names = {one.id: value for one in targets if isinstance(one, ast.Name)}
    elif isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Import | ast.ImportFrom):
        return
    else:  # a branch, loop or augmented assignment, whose result is unknown without running it
        stored = (one.id for one in ast.walk(item) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store))
        names = {name: Computed(_text(item)) for name in stored}
    scope.update(names)
    values.update({f"{prefix}{name}": value for name, value in names.items()})


def _attribute_assignments(item: ast.stmt, module: Scope) -> dict[str, Any]:
    """Return the attributes that a top-level statement assigns, such as `Config.control.decimation = 4`."""
    assigned = {}
    for one in ast.walk(item):
        if isinstance(one, ast.Attribute) and isinstance(one.ctx, ast.Store):
            names, inner = [one.attr], one.value
            while isinstance(inner, ast.Attribute):
                names.insert(0, inner.attr)
                inner = inner.value
            plain = isinstance(item, ast.Assign | ast.AnnAssign) and item.value is not None
            value = _fold_or_computed(item.value, module) if plain else Computed(_text(item))  # type: ignore[attr-defined]
            assigned[".".join(names)] = value
    return assigned


def _fold_or_computed(node: ast.expr, scope: Mapping[str, Any]) -> Any:
    try:
        return _fold(node, scope, 0)
    except (_NotLiteralError, ArithmeticError, ValueError, TypeError, RecursionError, MemoryError):
        return Computed(_text(node))


def _text(node: ast.AST) -> str:
    try:
        return " ".join(ast.unparse(node).split())[:80]
    except RecursionError:
        return "a long expression"


def _fold(node: ast.expr, scope: Mapping[str, Any], depth: int) -> Any:
    """Evaluate an expression of literals, arithmetic and names in a scope."""
    if depth > 50:
        raise _NotLiteralError
    fold = lambda part: _fold(part, scope, depth + 1)  # noqa: E731
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name) and node.id in scope and not isinstance(scope[node.id], Computed):
        return scope[node.id]
    if isinstance(node, ast.List | ast.Tuple | ast.Set):
        return [fold(part) for part in node.elts]
    if isinstance(node, ast.Dict):
        if None in node.keys:
            raise _NotLiteralError
        return {fold(key): fold(value) for key, value in zip(node.keys, node.values, strict=True) if key is not None}
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        value = fold(node.operand)
        return -_number(value) if isinstance(node.op, ast.USub) else _number(value)
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        left, right = fold(node.left), fold(node.right)
        if isinstance(node.op, ast.Mult) and isinstance(left, list) and isinstance(right, int):
            if not 0 <= right * len(left) <= _MAX_ITEMS:
                raise _NotLiteralError
            return left * right
        left, right = _number(left), _number(right)
        if isinstance(node.op, ast.Pow) and abs(right) > _MAX_POWER:
            raise _NotLiteralError
        return _number(_BINARY[type(node.op)](left, right))
    raise _NotLiteralError


def _number(value: Any) -> int | float:
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e15:
        raise _NotLiteralError
    return value
