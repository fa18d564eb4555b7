"""Parsing of command lines into dataclasses, with one-line errors."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro

from surefoot.configuration import check_bounds
from surefoot.errors import SurefootError, nearest, suggest

T = TypeVar("T")

_QUOTED = "'([^']*)'"
_OWN_OPTIONS = {
    "task.robot": "robot",
    "task.params": "set",
    "task.actuator": "actuator",
    "task.pushes.enabled": "pushes",
}
"""Keys of a task that are set by options of other names."""


def parse(kind: type[T], words: Sequence[str], prog: str, default: T | None = None) -> T:
    """Parse the arguments of a command (`prog`) into a dataclass, as `tyro.cli` does.

    Omitted options have the values of `default`, or the dataclass's defaults.

    Raises:
        SurefootError: invalid arguments, or numbers out of bounds; the message has one line, unlike tyro's boxes.
    """
    _check_words(options(kind, default), words, prog)
    output = io.StringIO()
    # Flags may be on in `default`, and then each needs an option that turns it off.
    preset: dict[str, Any] = {"config": (tyro.conf.FlagCreatePairsOff,)} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(output):
            parsed: T = tyro.cli(kind, args=list(words), prog=prog, **preset)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        text = " ".join(re.sub(r"[\u2500-\u257f]+|-{4,}", " ", output.getvalue()).split())
        raise SurefootError(f"{_shorten(text, kind)}; all options: {prog} --help") from None
    check_bounds(parsed)
    if plugins := getattr(parsed, "plugin", ()):
        from surefoot.task.plugins import load_plugins

        load_plugins(plugins)
    return parsed


def _shorten(text: str, kind: type) -> str:
    """Return an error message of tyro without headings, help texts and hints."""
    headings = "Value error|Parsing error|Required options|Unrecognized options|Invalid choice|Missing argument"
    text = re.sub(rf"^({headings}) +|Error parsing ({kind.__name__}: )?", "", text)
    text = re.sub(r" *(For full helptext|Argument helptext:|Perhaps you meant|Arguments similar to).*", "", text)
    text = re.sub(r"^Missing from [^:]*: (\S+).*", r"\1 is missing", text)
    text = re.sub(r"^Missing value for argument '(\S+)'.*", r"\1 has no value", text)
    if surplus := re.match(r"Unrecognized options: ([^,]*)", text):
        is_run = (Path(surplus[1]) / "run.json").is_file()
        several = "; the pattern matches several runs, give one of them" if is_run else ""
        return f"unexpected argument {surplus[1]}{several}"
    if choice := re.match(r"invalid choice '(.*)' for argument '(\S+)'. Expected one of \((.*)\)", text):
        return f"{choice[2]} is '{choice[1]}'; {suggest(choice[1], re.findall(_QUOTED, choice[3]))}"
    return text


def _check_words(types: Mapping[str, Any], words: Sequence[str], prog: str) -> None:
    """Reject unknown options, and list options without a value, which tyro would read as an empty list."""
    names = {name.removeprefix("--"): name for name in types}
    off = {f"--{head}{dot}no-{tail}" for head, dot, tail in (name.rpartition(".") for name in names)}
    names |= {key: f"--{name}" for key, name in _OWN_OPTIONS.items() if f"--{name}" in types}
    for word, after in zip(words, [*words[1:], "--"], strict=False):
        name = word.partition("=")[0].replace("_", "-")
        if name.startswith("--") and not (name in types or name in off or name in ("--", "--help")):
            near = nearest(name[2:], names)
            question = f"did you mean {names[near]}? " if near else ""
            raise SurefootError(f"{name} is not an option; {question}all options: {prog} --help")
        hint = types.get(word.replace("_", "-"))
        is_list = typing.get_origin(hint) is dict or typing.get_args(hint)[-1:] == (...,)
        if is_list and after.startswith("--"):
            raise SurefootError(f"{word} has no value; it takes one or more")


def positional_words(words: Sequence[str], *kinds: type) -> list[str]:
    """Return the words that are neither options of these dataclasses nor the value after an option.

    Further values of a list option count as positional, since callers use only the first word.
    """
    flags = {name for kind in kinds for name, hint in options(kind).items() if hint is bool} | {"-h", "--help"}

    def takes_value(word: str) -> bool:
        return word.startswith("-") and "=" not in word and word.replace("_", "-") not in flags

    pairs = zip(["", *words], words, strict=False)
    return [word for before, word in pairs if not (word.startswith("-") or takes_value(before))]


def options(kind: type, default: Any = None, prefix: str = "--") -> dict[str, Any]:
    """Return the types of a dataclass's options and positional arguments, by tyro's names.

    A dict that is not empty in the instance `default` has one option per key.
    """
    types: dict[str, Any] = {}
    hints, annotated = typing.get_type_hints(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, marks = hints[field.name], getattr(annotated[field.name], "__metadata__", ())
        name = next((mark.name for mark in marks if getattr(mark, "name", None)), field.name.replace("_", "-"))
        value = getattr(default, field.name, None)
        if tyro.conf.Fixed in marks:
            continue
        if dataclasses.is_dataclass(value) and not dataclasses.is_dataclass(hint):
            hint = type(value)  # in a union, the type of the default
        if dataclasses.is_dataclass(hint):
            is_flat = tyro.conf.OmitArgPrefixes in marks
            types |= options(typing.cast("type", hint), value, prefix if is_flat else f"{prefix}{name}.")
        else:
            types[f"{prefix}{name}"] = hint
            if isinstance(value, Mapping):
                types |= dict.fromkeys((f"{prefix}{name}.{key.replace('_', '-')}" for key in value), float)
    return types
