"""Configuration as frozen dataclasses: from YAML and back, with errors that name key, rule and choices."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from surefoot.errors import SurefootError, choices

T = TypeVar("T")

_KIND = {float: "a number", int: "a whole number", str: "text", bool: "true or false", type(None): "nothing"}


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds one table.

    Raises:
        SurefootError: it can't be read, is not YAML, or holds something else.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SurefootError(f"{path}: can't be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SurefootError(f"{path}: is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise SurefootError(f"{path}: holds {type(data).__name__}; it must be a table of keys and values")
    return data


def from_mapping(kind: type[T], data: Mapping[str, Any], where: str = "", base: T | None = None) -> T:
    """Make a dataclass from a mapping, nested dataclasses from nested mappings.

    Args:
        kind: the dataclass.
        data: keys and values; a key left out keeps the value of `base`, or the field's default.
        where: the way to this mapping, for error messages.
        base: an instance whose values hold where `data` says nothing.

    Raises:
        SurefootError: an unknown key, a missing one, or a value of the wrong type.
    """
    hints = typing.get_type_hints(kind)
    names = [item.name for item in dataclasses.fields(kind)]  # type: ignore[arg-type]
    if not isinstance(data, Mapping):
        raise SurefootError(
            f"{where or kind.__name__} is {data!r}; it must be a table with keys out of: {choices(names)}"
        )
    for key in data:
        if key not in names:
            raise SurefootError(f"{where}{'.' if where else ''}{key} is no key; keys: {choices(names)}")
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):  # type: ignore[arg-type]
        way = f"{where}.{item.name}" if where else item.name
        if item.name in data:
            now = getattr(base, item.name) if base is not None else None
            values[item.name] = _convert(hints[item.name], data[item.name], way, now)
        elif base is not None:
            values[item.name] = getattr(base, item.name)
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise SurefootError(f"{way} is missing; it must be given")
    return kind(**values)


def _convert(hint: Any, value: Any, where: str, base: Any) -> Any:
    origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return from_mapping(hint, value, where, base)  # type: ignore[arg-type]
    if origin is typing.Literal:
        if value not in typing.get_args(hint):
            raise SurefootError(f"{where} is {value!r}; choices: {choices(typing.get_args(hint))}")
        return value
    if origin in (typing.Union, types.UnionType):
        for option in typing.get_args(hint):
            try:
                return _convert(option, value, where, base)
            except SurefootError:
                continue
        raise SurefootError(f"{where} is {value!r}; it must be {' or '.join(_name(x) for x in typing.get_args(hint))}")
    if origin is tuple:
        args = typing.get_args(hint)
        if not isinstance(value, list | tuple) or (args[-1] is not Ellipsis and len(value) != len(args)):
            raise SurefootError(f"{where} is {value!r}; it must be {_name(hint)}")
        kinds = [args[0]] * len(value) if args[-1] is Ellipsis else args
        return tuple(_convert(kinds[k], item, f"{where}[{k}]", None) for k, item in enumerate(value))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise SurefootError(f"{where} is {value!r}; it must be a table")
        return {
            str(key): _convert(typing.get_args(hint)[1], item, f"{where}.{key}", None) for key, item in value.items()
        }
    if hint is Any:
        return value
    is_bool = isinstance(value, bool)
    if hint is float and isinstance(value, int | float) and not is_bool:
        return float(value)
    if isinstance(value, hint) and is_bool == (hint is bool):
        return value
    raise SurefootError(f"{where} is {value!r}; it must be {_name(hint)}")


def _name(hint: Any) -> str:
    if typing.get_origin(hint) is tuple:
        args = typing.get_args(hint)
        return f"a list of {'' if args[-1] is Ellipsis else f'{len(args)} '}values, each {_name(args[0])}"
    if typing.get_origin(hint) is dict:
        return f"a table of values, each {_name(typing.get_args(hint)[1])}"
    return _KIND.get(hint, str(hint))


def to_mapping(config: Any) -> dict[str, Any]:
    """A dataclass as plain tables, lists and values, ready for YAML or JSON."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        if isinstance(value, Mapping):
            return {key: plain(item) for key, item in value.items()}
        return value

    result: dict[str, Any] = plain(config)
    return result


def write_yaml(path: Path, config: Any) -> None:
    """Write a dataclass, or plain tables, as YAML."""
    data = to_mapping(config) if dataclasses.is_dataclass(config) else config
    path.write_text(yaml.safe_dump(data, sort_keys=False, allow_unicode=True), encoding="utf-8")
