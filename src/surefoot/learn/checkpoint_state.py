"""Checks of a checkpoint's content. Its digest proves that the file is complete, not that surefoot wrote it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from surefoot.errors import SurefootError, choices, quote

_ADAM_MOMENTS = ("exp_avg", "exp_avg_sq")
"""Moments that Adam stores for each parameter, with the parameter's shape."""


def check_like(value: Any, template: Any, where: str) -> None:
    """Check that a state has the same structure as a template.

    Tables must have the same keys, lists the same length, arrays and tensors the same shape and data type, and other
    values the same type. Single numbers must be finite.

    Args:
        value: state from a checkpoint.
        template: newly made state.
        where: dotted name of the value for the message.

    Raises:
        SurefootError: the first value that differs.
    """
    if isinstance(template, Mapping):
        _check_type(value, dict, where, "a table")
        if value.keys() != template.keys():
            different = sorted(map(str, value.keys() ^ template.keys()))
            raise SurefootError(f"{where} has missing or unknown entries: {choices(map(quote, different[:5]))}")
        for key, item in template.items():
            check_like(value[key], item, f"{where}.{key}")
    elif isinstance(template, list | tuple):
        _check_type(value, (list, tuple), where, "a list")
        if len(value) != len(template):
            raise SurefootError(f"{where} has {len(value)} entries; it must have {len(template)}")
        for index, item in enumerate(template):
            check_like(value[index], item, f"{where}[{index}]")
    elif isinstance(template, np.ndarray | torch.Tensor):
        kind = torch.Tensor if isinstance(template, torch.Tensor) else np.ndarray
        _check_type(value, kind, where, "numbers")
        if value.dtype != template.dtype or value.shape != template.shape:
            actual, expected = (f"{tuple(array.shape)} of {array.dtype}" for array in (value, template))
            raise SurefootError(f"{where} has the shape {actual}; it must be {expected}")
    elif isinstance(template, bool | str) or template is None:
        _check_type(value, type(template), where, type(template).__name__)
    elif isinstance(template, int | np.integer):
        check_count(value, where)
    else:
        check_real(value, where)


def check_count(value: Any, where: str) -> int:
    """Return a whole number of 0 or more, or raise a `SurefootError`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise SurefootError(f"{where} is {quote(value)}; it must be a whole number, 0 or more")
    return int(value)


def check_real(value: Any, where: str) -> float:
    """Return a finite number, or raise a `SurefootError`."""
    number = math.nan
    if isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise SurefootError(f"{where} is {quote(value)}; it must be a finite number")
    return number


def check_finite(state: Any, where: str) -> None:
    """Raise a `SurefootError` if an array or tensor in nested tables is not finite."""
    if isinstance(state, Mapping):
        for key, item in state.items():
            check_finite(item, f"{where}.{key}")
    elif isinstance(state, np.ndarray | torch.Tensor) and not np.isfinite(np.asarray(state)).all():
        raise SurefootError(f"{where} has numbers that are not finite")


def check_optimizer(state: Any, parameters: list[torch.nn.Parameter], where: str) -> None:
    """Raise a `SurefootError` if a state of Adam does not fit the parameters, which Adam's loader does not check."""
    _check_type(state, dict, where, "a table")
    for number, moments in state.items():
        if number not in range(len(parameters)):
            raise SurefootError(f"{where} has a parameter {quote(number)}; there are {len(parameters)}")
        _check_type(moments, dict, f"{where}.{number}", "a table")
        template = dict.fromkeys(_ADAM_MOMENTS, parameters[number].detach()) | {"step": torch.zeros(())}
        check_like(moments, template, f"{where}.{number}")
        for name in ("step", "exp_avg_sq"):
            if bool((moments[name] < 0).any()):
                raise SurefootError(f"{where}.{number}.{name} has numbers below 0")
    check_finite(state, where)


def _check_type(value: Any, kinds: type | tuple[type, ...], where: str, what: str) -> None:
    if not isinstance(value, kinds):
        raise SurefootError(f"{where} is {quote(value)}; it must be {what}")
