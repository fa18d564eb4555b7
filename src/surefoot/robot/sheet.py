"""Reading a TOML table so that whatever does not fit is told with its file, key, rule and choices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from surefoot.configuration import is_number
from surefoot.errors import SurefootError, choices, quoted

T = TypeVar("T")
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Sheet:
    """One table of a data sheet, with the way to it for error messages."""

    path: Path
    data: dict[str, Any]
    prefix: str = ""

    def error(self, key: str, what: str, rule: str) -> SurefootError:
        """An error about a key: `FILE: KEY WHAT; RULE`."""
        return SurefootError(f"{self.path}: {self.prefix}{key} {what}; {rule}")

    def allow_only(self, *keys: str, optional: Sequence[str] = ()) -> None:
        """Refuse keys that nothing reads, and keys that are missing and not optional."""
        for key in self.data:
            if key not in keys:
                raise self.error(key, "is no key of this table", f"keys: {choices(keys)}")
        for key in keys:
            if key not in optional:
                self._get(key)

    def _get(self, key: str) -> Any:
        if key not in self.data:
            raise self.error(key, "is missing", f"found: {choices(self.data)}")
        return self.data[key]

    def table(self, key: str, *keys: str) -> Sheet:
        """The table under a key, with exactly the keys given (any, if none is given)."""
        value = self._get(key)
        if not isinstance(value, dict):
            raise self.error(key, f"is {quoted(value)}", "it must be a table")
        table = Sheet(self.path, value, f"{self.prefix}{key}.")
        if keys:
            table.allow_only(*keys)
        return table

    def tables(self, key: str, *keys: str) -> list[Sheet]:
        """The list of tables under a key, each with exactly the keys given."""
        value = self._get(key)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error(key, f"is {quoted(value)}", "it must be a list of tables")
        tables = [Sheet(self.path, item, f"{self.prefix}{key}.") for item in value]
        for table in tables:
            table.allow_only(*keys)
        return tables

    def text(self, key: str) -> str:
        """A string."""
        value = self._get(key)
        if not isinstance(value, str):
            raise self.error(key, f"is {quoted(value)}", "it must be text")
        return value

    def one_of(self, key: str, names: Sequence[str]) -> str:
        """A string out of `names`."""
        value = self.text(key)
        if value not in names:
            raise self.error(key, f"is '{value}', which the robot does not have", f"choices: {choices(names)}")
        return value

    def strings(self, key: str) -> list[str]:
        """A list of different strings."""
        value = self._get(key)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.error(key, f"is {quoted(value)}", "it must be a list of names")
        if len(set(value)) != len(value) or not value:
            raise self.error(key, f"is {quoted(value)}", "it must have names, and none twice")
        return value

    def names(self, key: str, valid: Sequence[str], count: int | None = None) -> list[str]:
        """A list of different strings out of `valid`, of a given length."""
        value = self.strings(key)
        for name in value:
            if name not in valid:
                raise self.error(key, f"names '{name}', which the robot does not have", f"choices: {choices(valid)}")
        if count is not None and len(value) != count:
            raise self.error(key, f"has {len(value)} names", f"it must have {count}")
        return value

    def number(self, key: str) -> float:
        """A number."""
        value = self._get(key)
        if not is_number(value):
            raise self.error(key, f"is {quoted(value)}", "it must be a finite number")
        return float(value)

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """A list of numbers, of a given length."""
        value = self._get(key)
        if not isinstance(value, list) or not all(map(is_number, value)):
            raise self.error(key, f"is {quoted(value)}", "it must be a list of finite numbers")
        if count is not None and len(value) != count:
            raise self.error(key, f"has {len(value)} numbers", f"it must have {count}")
        return [float(item) for item in value]

    def two_points(self, key: str, index: int) -> tuple[Point, Point]:
        """Two points in space; `index` tells which table of a list this is."""
        value = self._get(key)
        if not (
            isinstance(value, list)
            and len(value) == 2
            and all(isinstance(point, list) and len(point) == 3 for point in value)
            and all(is_number(x) for point in value for x in point)
        ):
            rule = "it must be two points of three finite numbers"
            raise self.error(key, f"of table {index + 1} is {quoted(value)}", rule)
        (a, b, c), (d, e, f) = value
        return (float(a), float(b), float(c)), (float(d), float(e), float(f))

    def range(self, key: str) -> tuple[float, float]:
        """A lower and an upper bound."""
        low, high = self.numbers(key, 2)
        if not low <= high:
            raise self.error(key, f"is [{low:g}, {high:g}]", "the lower bound must come first")
        return low, high

    def dataclass(self, kind: type[T], positive: Sequence[str] = ()) -> T:
        """A dataclass of numbers and tuples of numbers, each field a key; `positive` ones must be over 0.

        A key may be missing where the field has a default.
        """
        items = fields(kind)  # type: ignore[arg-type]
        self.allow_only(
            *(item.name for item in items), optional=[item.name for item in items if item.default is not MISSING]
        )
        values: dict[str, Any] = {}
        for item in items:
            if item.name not in self.data:
                continue
            if str(item.type).startswith("tuple"):
                values[item.name] = tuple(self.numbers(item.name))
                continue
            values[item.name] = number = self.number(item.name)
            if item.name in positive and not number > 0:
                raise self.error(item.name, f"is {number:g}", "it must be over 0")
            if number < 0:
                raise self.error(item.name, f"is {number:g}", "it must not be below 0")
        return kind(**values)
