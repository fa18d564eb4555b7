"""Words of the command line into dataclasses, with errors of one line."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from surefoot.errors import SurefootError

T = TypeVar("T")


def parse(kind: type[T], words: Sequence[str], prog: str, default: T | None = None, config: Sequence[Any] = ()) -> T:
    """Parse words into a dataclass, as `tyro.cli` does.

    Args:
        kind: the dataclass.
        words: what stands behind the command.
        prog: the command, for the help text.
        default: values of options that are not given; the dataclass's own, if left out.
        config: tyro's configuration markers.

    Raises:
        SurefootError: words that do not fit, in one line; tyro would draw a box.
    """
    said = io.StringIO()
    given: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(said):
            parsed: T = tyro.cli(kind, args=list(words), prog=prog, config=tuple(config), **given)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        text = " ".join(re.sub(r"[\u2500-\u257f]+", " ", said.getvalue()).split())
        text = re.sub(r"^(Value error|Parsing error|Unrecognized options|Required options)\s+", "", text)
        text = re.sub(rf"^Error parsing {kind.__name__}: ", "", text)
        text = re.sub(r"\s*For full helptext, (see|run) ", f"; for every option: {prog} --help ", text)
        text = re.sub(r"( --help) .*$", r"\1", text)
        raise SurefootError(text) from None
    return parsed
