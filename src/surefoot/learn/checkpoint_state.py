"""Checks of a checkpoint's content: its digest shows that it is whole, not that surefoot wrote it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from surefoot.errors import SurefootError, choices, quote

_ADAM_MOMENTS = ("exp_avg", "exp_avg_sq")
"""What Adam keeps of each parameter, in its shape."""


def check_like(value: Any, template: Any, where: str) -> None:
    """Refuse a state that is not made as a template is.

    Tables must have the same keys, lists the same length, arrays and tensors the same shape and kind of numbers, and
    single values the same type. Single numbers must be finite.

    Args:
        value: of a checkpoint.
        template: a state that was just made.
        where: dotted name of the value, for the message.

    Raises:
        SurefootError: the first value that differs.
    """
    if isinstance(template, Mapping):
        _check_type(value, dict, where, "a table")
        if value.keys() != template.keys():
            odd = sorted(map(str, value.keys() ^ template.keys()))
            raise SurefootError(f"{where} has other entries than it must: {choices(map(quote, odd[:5]))}")
        for key, item in template.items():
            check_like(value[key], item, f"{where}.{key}")
    elif isinstance(template, list | tuple):
        _check_type(value, (list, tuple), where, "a list")
        if len(value) != len(template):
            raise SurefootError(f"{where} has {len(value)} entries; it must have {len(template)}")
        for place, item in enumerate(template):
            check_like(value[place], item, f"{where}[{place}]")
    elif isinstance(template, np.ndarray | torch.Tensor):
        kind = torch.Tensor if isinstance(template, torch.Tensor) else np.ndarray
        _check_type(value, kind, where, "numbers")
        if value.dtype != template.dtype or value.shape != template.shape:
            found, rule = (f"{tuple(one.shape)} of {one.dtype}" for one in (value, template))
            raise SurefootError(f"{where} has the shape {found}; it must be {rule}")
    elif isinstance(template, bool | str) or template is None:
        _check_type(value, type(template), where, type(template).__name__)
    elif isinstance(template, int | np.integer):
        check_count(value, where)
    else:
        check_real(value, where)


def check_count(value: Any, where: str) -> int:
    """Return a whole number of 0 or more; refuse anything else."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise SurefootError(f"{where} is {quote(value)}; it must be a whole number, 0 or more")
    return int(value)


def check_real(value: Any, where: str) -> float:
    """Return a finite number; refuse anything else."""
    number = math.nan
    if isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise SurefootError(f"{where} is {quote(value)}; it must be a finite number")
    return number


def check_finite(state: Any, where: str) -> None:
    """Refuse arrays and tensors, in tables of any depth, with numbers that are not finite."""
    if isinstance(state, Mapping):
        for key, item in state.items():
            check_finite(item, f"{where}.{key}")
    elif isinstance(state, np.ndarray | torch.Tensor) and not np.isfinite(np.asarray(state)).all():
        raise SurefootError(f"{where} has numbers that are not finite")


def check_optimizer(state: Any, parameters: list[torch.nn.Parameter], where: str) -> None:
    """Refuse a state of Adam that is not one of these parameters, as its own loader does not."""
    _check_type(state, dict, where, "a table")
    for number, moments in state.items():
        if number not in range(len(parameters)):
            raise SurefootError(f"{where} has a parameter {quote(number)}; there are {len(parameters)}")
        _check_type(moments, dict, f"{where}.{number}", "a table")
        template = dict.fromkeys(_ADAM_MOMENTS, parameters[number].detach()) | {"step": torch.zeros(())}
        check_like(moments, template, f"{where}.{number}")
    check_finite(state, where)


def _check_type(value: Any, kinds: type | tuple[type, ...], where: str, what: str) -> None:
    if not isinstance(value, kinds):
        raise SurefootError(f"{where} is {quote(value)}; it must be {what}")
