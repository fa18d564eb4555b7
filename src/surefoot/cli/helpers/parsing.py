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
    """Parse the arguments of a command (`prog`) into a dataclass, as `tyro.cli` does.

    Options that are not given have the values of `default`, or the dataclass's own.

    Raises:
        SurefootError: invalid words, or numbers out of their fields' bounds; in one line, where tyro would draw a box.
    """
    _check_lists(kind, words)
    output = io.StringIO()
    # A default may have flags that are on, and then each flag needs an option that turns it off.
    preset: dict[str, Any] = {"config": (tyro.conf.FlagCreatePairsOff,)} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(output):
            parsed: T = tyro.cli(kind, args=list(words), prog=prog, **preset)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        text = " ".join(re.sub(r"[\u2500-\u257f]+", " ", output.getvalue()).split())
        text = re.sub(r"^(Value error|Parsing error|Unrecognized options|Required options)\s+", "", text)
        text = re.sub(rf"^Error parsing {kind.__name__}: ", "", text)
        text = re.sub(r"\s*For full helptext, (see|run) ", f"; for every option: {prog} --help ", text)
        raise SurefootError(re.sub(r"( --help) .*$", r"\1", text)) from None
    check_bounds(parsed)
    return parsed


def _check_lists(kind: type, words: Sequence[str]) -> None:
    """Refuse an option of several values that has none: tyro would read an empty list."""
    types = options(kind)
    for word, after in zip(words, [*words[1:], "--"], strict=False):
        hint = types.get(word.replace("_", "-"))
        is_list = typing.get_origin(hint) is dict or typing.get_args(hint)[-1:] == (...,)
        if is_list and after.startswith("--"):
            raise SurefootError(f"{word} has no value; it takes one or more")


def options(kind: type, prefix: str = "--") -> dict[str, Any]:
    """Return the types of a dataclass's options, positional ones too, by tyro's names."""
    types: dict[str, Any] = {}
    annotated = typing.get_type_hints(kind, include_extras=True)
    for field, hint in typing.get_type_hints(kind).items():
        marks = getattr(annotated[field], "__metadata__", ())
        name = next((mark.name for mark in marks if getattr(mark, "name", None)), field.replace("_", "-"))
        if dataclasses.is_dataclass(hint):
            is_flat = tyro.conf.OmitArgPrefixes in marks
            types |= options(typing.cast("type", hint), prefix if is_flat else f"{prefix}{name}.")
        else:
            types[f"{prefix}{name}"] = hint
    return types
