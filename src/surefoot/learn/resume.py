"""Checks of saved training states, whose files may be damaged or foreign, with one-line error messages."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from surefoot.errors import SurefootError, quote
from surefoot.learn.checkpoint_state import check_count, check_finite, check_like, check_real
from surefoot.learn.evaluation import TrainingEvaluation
from surefoot.learn.ppo_learner import PpoLearner

_STATE_ERRORS = (SurefootError, LookupError, TypeError, ValueError, AttributeError, RuntimeError, ArithmeticError)
"""Exceptions that loaders and simulations raise for states that surefoot did not write."""


@contextmanager
def describe_state_errors(before: str, after: str = "", own: bool = True) -> Iterator[None]:
    """Convert exceptions of loaders and simulations into one-line errors.

    Args:
        before: text before the message of the exception.
        after: text after it.
        own: whether a `SurefootError` is also converted; otherwise it passes unchanged.

    Raises:
        SurefootError: the message between the two texts.
    """
    try:
        yield
    except _STATE_ERRORS as error:
        if isinstance(error, SurefootError) and not own:
            raise
        raise SurefootError(f"{before}: {_one_line(error)}{after}") from error


def _one_line(error: BaseException) -> str:
    """Return the message of an exception on one line, shortened to 300 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return f"it has no {text}" if isinstance(error, KeyError) else text[:300]


def read_progress(
    state: dict[str, Any], learner: PpoLearner
) -> tuple[TrainingEvaluation | None, dict[str, torch.Tensor], float]:
    """Return the best evaluation of a checkpoint, the policy's parameters at that time, and the training time [s].

    Raises:
        SurefootError: values that a training can't have saved.
    """
    if check_count(state["steps"], "steps") != learner.steps:
        raise SurefootError(f"steps is {state['steps']}, but the learner has done {learner.steps}")
    best = None
    if state["best"] is not None:
        json.dumps(state["best"])  # it becomes part of the policy's contract
        best = TrainingEvaluation(**state["best"])
        for name, value in state["best"].items():
            if name != "rmse" and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise SurefootError(f"best.{name} is {quote(value)}; it must be a number")
    actor = state["best_actor"]
    if actor or best is not None:
        check_like(actor, learner.policy.state_dict(), "best_actor")
        check_finite(actor, "best_actor")
    return best, actor, check_real(state["seconds"], "seconds")
