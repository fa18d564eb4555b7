"""Static reader of the numbers, strings and dictionaries that the classes of a Python file assign; the file is not run.

Arithmetic of literals and previously assigned names is evaluated. A value that is assigned or changed in any other way,
such as `table["calf"] = 40.0`, becomes a `Computed`.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Iterator, Mapping
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
_CHANGING = {
    "append", "clear", "extend", "insert", "pop", "popitem", "remove", "reverse", "setdefault", "sort", "update",
}  # fmt: skip
"""Methods that change a list or a dictionary."""


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
        text = Computed(_text(item))
        names |= {name: text for one in targets for name in _changed(one, scope) if name not in names}
    elif isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Import | ast.ImportFrom):
        return
    else:  # a branch, loop or augmented assignment, whose result is unknown without running it
        text = Computed(_text(item))
        names = {name: text for name in _changed(item, scope)}
    scope.update(names)
    values.update({f"{prefix}{name}": value for name, value in names.items()})


def _changed(node: ast.AST, scope: Scope) -> Iterator[str]:
    """Yield the names that a statement or target stores, and those in a scope whose value it changes in place."""
    for one in ast.walk(node):
        if isinstance(one, ast.Name) and not isinstance(one.ctx, ast.Load):
            yield one.id
        elif isinstance(base := _changed_value(one), ast.Name) and base.id in scope:
            yield base.id


def _changed_value(node: ast.AST) -> ast.expr | None:
    """Return the list or dictionary that an expression changes: `x` of `x["a"]["b"]` as a target, or of `x.append`."""
    value = None
    if isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
        value = node.value
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _CHANGING:
        value = node.func.value
    while isinstance(value, ast.Subscript):
        value = value.value
    return value


def _attribute_assignments(item: ast.stmt, module: Scope) -> dict[str, Any]:
    """Return the attributes that a top-level statement assigns or changes, such as `Config.control.decimation = 4`."""
    plain = isinstance(item, ast.Assign | ast.AnnAssign) and item.value is not None
    text = Computed(_text(item))
    value = _fold_or_computed(item.value, module) if plain else text  # type: ignore[attr-defined]
    assigned: dict[str, Any] = {}
    for one in ast.walk(item):
        if isinstance(one, ast.Attribute) and not isinstance(one.ctx, ast.Load):
            assigned[_attribute_name(one)] = value
        elif isinstance(changed := _changed_value(one), ast.Attribute):
            assigned[_attribute_name(changed)] = text
    return assigned


def _attribute_name(node: ast.Attribute) -> str:
    """Return the dotted name of an attribute below the class: `control.decimation` of `Config.control.decimation`."""
    names, inner = [node.attr], node.value
    while isinstance(inner, ast.Attribute):
        names.insert(0, inner.attr)
        inner = inner.value
    return ".".join(names)


def _fold_or_computed(node: ast.expr, scope: Mapping[str, Any]) -> Any:
    try:
        return _fold(node, scope, 0)
    except (_NotLiteralError, ArithmeticError, ValueError, TypeError, RecursionError, MemoryError):
        return Computed(_text(node))


def _text(node: ast.AST) -> str:
    try:
        return " ".join(ast.unparse(node).split())[:80]
    except (RecursionError, ValueError):  # also an integer of more digits than Python writes
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
