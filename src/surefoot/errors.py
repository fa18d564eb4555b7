"""Errors caused by invalid input, reported in one line."""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any


class SurefootError(ValueError):
    """Invalid input; the message states the value, the rule and the choices.

    The command line prints only the message, without a traceback, and exits with code 2.
    """


@contextmanager
def describe_os_errors(what: object, verb: str = "read") -> Iterator[None]:
    """Convert an `OSError` raised inside to a `SurefootError`: `WHAT: can't be VERB: REASON`."""
    try:
        yield
    except OSError as error:
        raise SurefootError(f"{what}: can't be {verb}: {error.strerror}") from error


@contextmanager
def prefix_errors(where: object) -> Iterator[None]:
    """Prefix the message of a `SurefootError` raised inside with a path or another location: `WHERE: MESSAGE`."""
    try:
        yield
    except SurefootError as error:
        raise type(error)(f"{where}: {error}") from error.__cause__


def check_name(what: str, name: str) -> None:
    """Reject a name that is not safe as a file or folder name; `what` says whose name it is, for the message."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,99}", name):
        raise SurefootError(
            f"{what} is {quote(name)}; a name has letters, digits, - and _ only, does not start with -, and has 1 to "
            "100 characters, since it names a file or folder"
        )


_QUOTES = reprlib.Repr()
_QUOTES.maxlevel = 3
_QUOTES.maxlist = _QUOTES.maxtuple = _QUOTES.maxdict = 10
_QUOTES.maxstring = _QUOTES.maxother = 100
_QUOTES.maxlong = 40


def quote(value: Any) -> str:
    """Return a value's `repr` for error messages, shortened if it is long or deeply nested."""
    try:
        text = _QUOTES.repr(value)
    except ValueError:  # Python writes integers of at most 4300 digits
        text = "a number of too many digits"
    return text if len(text) <= 200 else f"{text[:200]}..."


def suggest(name: object, names: Iterable[object]) -> str:
    """Return the end of an error message about an unknown name: the closest name, if any is close, and all choices."""
    texts = [str(choice) for choice in names]
    near = nearest(str(name), texts)
    return f"{f'did you mean {near}? ' if near else ''}choices: {choices(texts)}"


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Return the known name that is most similar to a misspelled one, or None if none is similar."""
    return next(iter(difflib.get_close_matches(name[:100], list(names), n=1, cutoff=0.65)), None)


def choices(names: Iterable[str]) -> str:
    """Join names to a readable list, for the end of an error message."""
    return ", ".join(str(name) for name in names)
