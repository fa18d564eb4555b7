"""Configuration as frozen dataclasses, read from and written to YAML; errors name the key, the rule and the choices."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
import yaml

from surefoot.errors import SurefootError, choices, describe_os_errors, quote, suggest
from surefoot.files import read_configuration

T = TypeVar("T")

_KIND = {float: "a number", int: "a whole number", str: "text", bool: "true or false", type(None): "nothing"}
_MAX_DEPTH = 50
"""Maximum nesting of tables and lists in a YAML file; other parsers stop at Python's recursion limit."""
_MAX_NODES = 200_000
"""Maximum number of values in a YAML file, counting each repetition by an alias."""
_MAX_TEXT_LENGTH = 4096
"""Maximum length of a text."""
_MAX_KEY_LENGTH = 100
"""Maximum length of an unknown key that messages quote unchanged."""


@dataclasses.dataclass(frozen=True)
class Within:
    """Bounds of a field, such as `Annotated[float, Within(0, 1)]`; they apply to each number in a list or table."""

    minimum: float
    """Smallest allowed number."""
    maximum: float
    """Largest allowed number."""
    exclusive: bool = False
    """Whether `minimum` itself is not allowed."""

    def check(self, where: str, value: Any) -> None:
        """Reject numbers out of bounds, and texts that are not valid in a file or path, also in lists and tables.

        The message contains the name `where`, the value and the rule. Values of other types are not checked.
        """
        if isinstance(value, Mapping):
            for key, item in value.items():
                self.check(f"{where}.{key}", item)
        elif isinstance(value, list | tuple):
            for place, item in enumerate(value):
                self.check(f"{where}[{place}]", item)
        elif isinstance(value, str):
            if (
                len(value) > _MAX_TEXT_LENGTH
                or "\0" in value
                or any("\ud800" <= letter <= "\udfff" for letter in value)
            ):
                rule = f"it must be Unicode text of at most {_MAX_TEXT_LENGTH} characters without NUL"
                raise SurefootError(f"{where} is {quote(value)}; {rule}")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            rule = self._violated_rule(value)
            if rule:
                shown = f"{value:g}" if isinstance(value, float) else quote(value)
                raise SurefootError(f"{where} is {shown}; it must be {rule}")

    def _violated_rule(self, value: float) -> str:
        """Return the rule that a number violates, or an empty text."""
        if isinstance(value, float) and math.isnan(value):
            return "a finite number"
        if value < self.minimum or (self.exclusive and value == self.minimum):
            return f"over {self.minimum:.15g}" if self.exclusive else f"{self.minimum:.15g} or more"
        return f"{self.maximum:.15g} or less" if value > self.maximum else ""


_ANY = Within(-1e15, 1e15)
"""Default bounds of fields."""

Seed = Annotated[int, Within(0, 2**32 - 1)]
"""Seed of random numbers."""
Threads = Annotated[int, Within(0, 1024)]
"""Number of threads; 0 means one per core."""
Count = Annotated[int, Within(1, 10_000)]
"""Number of episodes or runs."""
Duration = Annotated[float, Within(0, 3600, exclusive=True)]
"""Length of a run [s]."""
NoOption = Annotated[T, tyro.conf.Fixed, tyro.conf.Suppress]
"""A field without an option of its dotted name, because commands have another option for it."""
Positive = Annotated[float, Within(0, 1e9, exclusive=True)]
NotNegative = Annotated[float, Within(0, 1e9)]


def check_bounds(config: Any, where: str = "") -> None:
    """Reject a dataclass with a number that is not finite or outside its field's bounds (`Within`).

    Nested dataclasses are checked as well. `where` is the dotted name for messages.
    """
    for name, within in field_bounds(config.__class__).items():
        value, place = getattr(config, name), f"{where}.{name}" if where else name
        if dataclasses.is_dataclass(value):
            check_bounds(value, place)
        else:
            within.check(place, value)


@functools.cache
def field_bounds(kind: type) -> dict[str, Within]:
    """Return the bounds of a dataclass's fields, by name."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {item.name: _within(hints[item.name]) or _ANY for item in dataclasses.fields(kind)}


@functools.cache
def _field_types(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields, by name."""
    return typing.get_type_hints(kind)


def _within(hint: Any) -> Within | None:
    marks = getattr(hint, "__metadata__", ())
    args = typing.get_args(hint)[:1] if marks else typing.get_args(hint)
    candidates = (mark if isinstance(mark, Within) else None for mark in marks), map(_within, args)
    return next((within for within in itertools.chain(*candidates) if within is not None), None)


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number that a floating-point number can represent."""
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


class _Loader(yaml.SafeLoader):
    """YAML loader that reads dates as text, and limits the nesting and the number of values."""

    yaml_implicit_resolvers = {  # noqa: RUF012, as in PyYAML
        first: [rule for rule in rules if rule[0] != "tag:yaml.org,2002:timestamp"]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a value; reject one that is nested too deep, too large or contains itself."""
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise yaml.YAMLError(f"it is nested more than {_MAX_DEPTH} levels deep")
        alias = self.check_event(yaml.AliasEvent)
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        if alias and id(node) not in self._sizes:
            raise yaml.YAMLError("it contains a value that contains itself")
        if not alias:
            parts = [] if isinstance(node.value, str) else node.value
            inner = [part for pair in parts for part in pair] if isinstance(node, yaml.MappingNode) else parts
            self._sizes[id(node)] = 1 + sum(self._sizes[id(part)] for part in inner)
        if self._sizes[id(node)] > _MAX_NODES:
            raise yaml.YAMLError(f"it contains more than {_MAX_NODES} values")
        return node


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file whose content is a table; reject a file that can't be read, is not YAML or is not a table."""
    with describe_os_errors(path):
        content = read_configuration(path)
    try:
        loader = _Loader(content.decode("utf-8"))
        try:
            data = loader.get_single_data()
        finally:
            loader.dispose()
    # PyYAML raises all of these for values that do not match their tags, such as `!!int x`.
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError) as error:
        raise SurefootError(f"{path}: is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise SurefootError(f"{path}: contains {type(data).__name__}; it must be a table of keys and values")
    return data


def read_toml(path: Path) -> tuple[dict[str, Any], bytes]:
    """Read a TOML file; return its table and its bytes. Reject a file that can't be read or is not TOML."""
    with describe_os_errors(path):
        content = read_configuration(path)
    try:
        return tomllib.loads(content.decode("utf-8")), content
    except RecursionError:
        raise SurefootError(f"{path}: is not TOML: it is nested too deeply") from None
    except ValueError as error:
        raise SurefootError(f"{path}: is not TOML: {error}") from error


def from_mapping(kind: type[T], data: Mapping[str, Any], where: str = "", base: T | None = None) -> T:
    """Construct a dataclass from a mapping, and nested dataclasses from nested mappings.

    Args:
        kind: the dataclass.
        data: keys and values; omitted keys keep the value of `base`, or the field's default.
        where: dotted name of this mapping, for error messages.
        base: instance that provides the values of omitted keys.

    Raises:
        SurefootError: an unknown key, a missing one, or a value of the wrong type.
    """
    hints = _field_types(kind)  # type: ignore[arg-type]
    fields = {item.name: item for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if not isinstance(data, Mapping):
        raise SurefootError(
            f"{where or kind.__name__} is {quote(data)}; it must be a table with keys from: {choices(fields)}"
        )
    prefix = f"{where}." if where else ""
    for key in data:
        if key not in fields:
            name = str(key) if len(str(key)) <= _MAX_KEY_LENGTH and str(key).isprintable() else quote(key)
            raise SurefootError(f"{prefix}{name} is not a key; {suggest(str(key), fields)}")
    values = {} if base is None else {name: getattr(base, name) for name in fields}
    nothing = dataclasses.MISSING
    needed = [name for name, item in fields.items() if item.default is nothing and item.default_factory is nothing]
    missing = [f"{prefix}{name}" for name in needed if name not in data] if base is None else []
    if missing:
        rule = "is missing; it must be given" if len(missing) == 1 else "are missing; they must be given"
        raise SurefootError(f"{choices(missing)} {rule}")
    for name in fields:
        if name in data:
            values[name] = _convert(hints[name], data[name], prefix + name, values.get(name))
    config = kind(**values)
    check_bounds(config, where)
    return config


def typed_entries(kind: type[T], data: Mapping[str, Any], where: str = "") -> T:
    """Construct a dataclass from a mapping, ignoring keys that are not its fields; see `from_mapping`."""
    names = {item.name for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return from_mapping(kind, {name: value for name, value in data.items() if name in names}, where)


def from_tagged(options: Sequence[type[T]], data: Any, where: str = "", base: T | None = None) -> T:
    """Construct one of several dataclasses from a mapping, selected by its key `kind` (a tagged union).

    Each option has a field `kind`, whose default is its own kind, and defaults for all other fields. A key that belongs
    to another kind is ignored if it has that kind's default, as in files of earlier versions.

    Args:
        options: the dataclasses; the first is the default without `kind` and `base`.
        data: keys and values; omitted keys keep the value of `base`, or the field's default.
        where: dotted name of this mapping, for error messages.
        base: instance that provides the values of omitted keys; if it is of another kind, only of the common fields.

    Raises:
        SurefootError: an unknown kind, a key of another kind, or the errors of `from_mapping`.
    """
    kinds: dict[Any, Any] = {_kind(option): option for option in options}
    entries = data if isinstance(data, Mapping) else {}
    tag, prefix = entries.get("kind", _kind(options[0] if base is None else base)), f"{where}." if where else ""
    if tag not in list(kinds):  # it may be unhashable
        raise SurefootError(f"{prefix}kind is {quote(tag)}; {suggest(tag, kinds)}")
    option: Any = kinds[tag]
    own_entries = keys_of_kind(options, data, tag)
    for key in [key for key in entries if key not in own_entries]:
        others = {kind: other for kind, other in kinds.items() if key in field_bounds(other)}
        other = next(iter(others.values()))
        value = _convert(_field_types(other)[key], entries[key], f"{prefix}{key}", None)
        if value != getattr(other(), key):
            raise SurefootError(
                f"{prefix}{key} is not a key of kind {tag}, but of {choices(others)}; keys of kind {tag}: "
                f"{choices(field_bounds(option))}"
            )
    if base is not None and not isinstance(base, option):
        shared = field_bounds(typing.cast(Any, type(base))).keys() & field_bounds(option).keys() - {"kind"}
        base = option(**{name: getattr(base, name) for name in shared})
    config: T = from_mapping(option, own_entries, where, base)
    return config


def keys_of_kind(options: Sequence[type], data: Any, kind: Any = None) -> Any:
    """Return a mapping without the keys that belong only to other kinds; anything but a mapping is returned unchanged.

    `kind` defaults to the mapping's own, or else to the first option's. With an unknown kind no key is dropped.
    """
    if not isinstance(data, Mapping):
        return data
    tag = data.get("kind", _kind(options[0])) if kind is None else kind
    own = next((field_bounds(option) for option in options if _kind(option) == tag), data)
    others = {name for option in options for name in field_bounds(option)}
    return {key: value for key, value in data.items() if key in own or key not in others}


def _kind(option: Any) -> Any:
    return option.kind


def _convert(hint: Any, value: Any, where: str, base: Any) -> Any:
    """Convert a value to the type of a field, whose value in the base instance is `base`."""
    origin, args, is_bool = typing.get_origin(hint), typing.get_args(hint), isinstance(value, bool)
    if dataclasses.is_dataclass(hint):
        return from_mapping(hint, value, where, base)  # type: ignore[arg-type]
    if hint is Any:
        return value
    if origin is typing.Literal:
        if value not in [option for option in args if isinstance(option, bool) == is_bool]:  # 1 equals true
            raise SurefootError(f"{where} is {quote(value)}; {suggest(value, args)}")
        return value
    if origin in (typing.Union, types.UnionType):
        tables: list[Any] = [option for option in args if dataclasses.is_dataclass(option)]
        if len(tables) > 1:
            return from_tagged(tables, value, where, base)
        if isinstance(value, Mapping) and len(tables) == 1:
            return _convert(tables[0], value, where, base)
        for option in args:
            try:
                return _convert(option, value, where, base)
            except SurefootError:
                continue
    elif origin is tuple:
        if isinstance(value, list | tuple) and (args[-1] is Ellipsis or len(value) == len(args)):
            kinds = [args[0]] * len(value) if args[-1] is Ellipsis else args
            return tuple(_convert(kinds[k], item, f"{where}[{k}]", None) for k, item in enumerate(value))
    elif origin is dict:
        if isinstance(value, Mapping):
            return {str(key): _convert(args[1], item, f"{where}.{key}", None) for key, item in value.items()}
    elif hint is float and isinstance(value, int) and not is_bool:
        try:
            return float(value)
        except OverflowError:
            raise SurefootError(f"{where} is {quote(value)}; it must be a finite number") from None
    elif isinstance(value, hint) and is_bool == (hint is bool):
        return value
    raise SurefootError(f"{where} is {quote(value)}; it must be {_name(hint)}")


def _name(hint: Any) -> str:
    """Return the name of a type for messages."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(_name, args))
    if origin is tuple:
        if len({*args} - {Ellipsis}) > 1:
            return f"a list of {len(args)} values: {', '.join(map(_name, args))}"
        return f"a list of {'' if args[-1] is Ellipsis else f'{len(args)} '}values, each {_name(args[0])}"
    if origin is typing.Literal:
        return choices(args)
    if origin is dict:
        return f"a table of values, each {_name(args[1])}"
    if dataclasses.is_dataclass(hint):
        return f"a table with keys from: {choices(item.name for item in dataclasses.fields(hint))}"
    return "of any kind" if hint is Any else _KIND.get(hint, str(hint))


def to_mapping(config: Any) -> dict[str, Any]:
    """Convert a dataclass to plain dicts, lists and values for YAML or JSON."""

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
    """Write a dataclass, or plain dicts and lists, as YAML."""
    data = to_mapping(config) if dataclasses.is_dataclass(config) else config
    path.write_text(yaml.safe_dump(data, sort_keys=False, allow_unicode=True), encoding="utf-8")
