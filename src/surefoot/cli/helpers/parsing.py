"""Parsing of command lines into dataclasses, with errors of one line."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
import typing
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from surefoot.configuration import check_bounds
from surefoot.errors import SurefootError

T = TypeVar("T")


def parse(kind: type[T], words: Sequence[str], prog: str, default: T | None = None) -> T:
    """Parse the words behind a command (`prog`) into a dataclass, as `tyro.cli` does.

    Options that are not given have the values of `default`, or the dataclass's own.

    Raises:
        SurefootError: words that do not fit, in one line; tyro would draw a box. Numbers out of their fields' bounds.
    """
    _check_lists(kind, words)
    said = io.StringIO()
    given: dict[str, Any] = {} if default is None else {"default": default}
    # A preset may have flags that are on, and then each flag needs an option that turns it off.
    pairs = () if given else (tyro.conf.FlagCreatePairsOff,)
    try:
        with contextlib.redirect_stderr(said):
            parsed: T = tyro.cli(kind, args=list(words), prog=prog, config=pairs, **given)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        text = " ".join(re.sub(r"[\u2500-\u257f]+", " ", said.getvalue()).split())
        text = re.sub(r"^(Value error|Parsing error|Unrecognized options|Required options)\s+", "", text)
        text = re.sub(rf"^Error parsing {kind.__name__}: ", "", text)
        text = re.sub(r"\s*For full helptext, (see|run) ", f"; for every option: {prog} --help ", text)
        text = re.sub(r"( --help) .*$", r"\1", text)
        raise SurefootError(text) from None
    check_bounds(parsed)
    return parsed


def _check_lists(kind: type, words: Sequence[str]) -> None:
    """Refuse an option that takes several values and has none: tyro would take that for an empty list."""
    hints = options(kind)
    for word, after in zip(words, [*words[1:], "--"], strict=False):
        hint = hints.get(word.replace("_", "-"))
        listed = typing.get_origin(hint) is dict or typing.get_args(hint)[-1:] == (...,)
        if listed and after.startswith("--"):
            raise SurefootError(f"{word} has no value; it takes one or more")


def options(kind: type, prefix: str = "--") -> dict[str, Any]:
    """Return the options of a dataclass, positional ones too, with the types of their values, by tyro's names."""
    found: dict[str, Any] = {}
    hints = typing.get_type_hints(kind, include_extras=True)
    for name, hint in typing.get_type_hints(kind).items():
        marks = getattr(hints[name], "__metadata__", ())
        given = [mark.name for mark in marks if getattr(mark, "name", None)]
        option = f"{prefix}{given[0] if given else name.replace('_', '-')}"
        if dataclasses.is_dataclass(hint):
            within = prefix if tyro.conf.OmitArgPrefixes in marks else f"{option}."
            found |= options(typing.cast("type", hint), within)
        else:
            found[option] = hint
    return found
