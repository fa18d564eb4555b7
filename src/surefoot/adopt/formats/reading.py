"""Tables of other frameworks, which have more in them than is needed here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from surefoot.configuration import from_mapping

T = TypeVar("T")


def pick(kind: type[T], data: Mapping[str, Any]) -> T:
    """Make a dataclass from those keys of a table that it has; others are not read.

    Raises:
        SurefootError: a missing key, or a value of another kind.
    """
    names = {item.name for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return from_mapping(kind, {key: value for key, value in data.items() if key in names and value is not None})


def first_names(terms: Mapping[str, str]) -> dict[str, str]:
    """Return the first name of each term in a format's table of terms by name."""
    return {term: name for name, term in reversed([*terms.items()])}
