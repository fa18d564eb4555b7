"""Errors that a user can cause, told in one line."""

from __future__ import annotations

from collections.abc import Iterable


class SurefootError(ValueError):
    """Something the user gave does not fit: the message names the value, the rule and the choices.

    The command line prints the message alone and exits with code 2.
    """


def at_least(name: str, number: float, least: int) -> None:
    """Refuse a number that is too small.

    Raises:
        SurefootError: with name, number and rule.
    """
    if number < least:
        raise SurefootError(f"{name} is {number}; it must be {least} or more")


def choices(names: Iterable[str]) -> str:
    """Return names as one readable list, for the end of an error message."""
    return ", ".join(str(name) for name in names)
