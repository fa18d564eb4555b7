"""States of earlier trainings, which may hold what surefoot did not write: each fault is one line."""

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
"""What loaders and simulations raise at states that surefoot did not write."""


@contextmanager
def describe_state_errors(before: str, after: str = "", own: bool = True) -> Iterator[None]:
    """Turn what loaders and simulations raise inside into one line.

    Args:
        before: text before the fault.
        after: text after it.
        own: whether refusals of surefoot are turned too, otherwise they pass as they are.

    Raises:
        SurefootError: the fault between the two texts.
    """
    try:
        yield
    except _STATE_ERRORS as error:
        if isinstance(error, SurefootError) and not own:
            raise
        raise SurefootError(f"{before}: {_one_line(error)}{after}") from error


def _one_line(error: BaseException) -> str:
    """Return what an error says, without line breaks and not too long."""
    text = " ".join(str(error).split()) or type(error).__name__
    return f"it has no {text}" if isinstance(error, KeyError) else text[:300]


def read_progress(
    state: dict[str, Any], learner: PpoLearner
) -> tuple[TrainingEvaluation | None, dict[str, torch.Tensor], float]:
    """Return a checkpoint's best evaluation, the policy's parameters then, and the duration so far [s].

    Raises:
        SurefootError: values that no training has saved.
    """
    if check_count(state["steps"], "steps") != learner.steps:
        raise SurefootError(f"steps is {state['steps']}, and the learner has done {learner.steps}")
    best = None
    if state["best"] is not None:
        json.dumps(state["best"])  # it goes into the policy's contract
        best = TrainingEvaluation(**state["best"])
        for name, value in state["best"].items():
            if name != "rmse" and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise SurefootError(f"best.{name} is {quote(value)}; it must be a number")
    actor = state["best_actor"]
    if actor or best is not None:
        check_like(actor, learner.policy.state_dict(), "best_actor")
        check_finite(actor, "best_actor")
    return best, actor, check_real(state["seconds"], "seconds")
