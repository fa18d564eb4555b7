"""Errors that a user can cause, told in one line."""

from __future__ import annotations

from collections.abc import Iterable


class SurefootError(ValueError):
    """Something the user gave does not fit: the message names the value, the rule and the choices.

    The command line prints the message alone and exits with code 2.
    """


def choices(names: Iterable[str]) -> str:
    """Return names as one readable list, for the end of an error message."""
    return ", ".join(str(name) for name in names)
