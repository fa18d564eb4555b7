"""What checks find, and what follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from surefoot.errors import choices


@dataclass(frozen=True)
class Finding:
    """What a check has found."""

    name: str
    """What was looked at."""
    passed: bool | None
    """Whether it is as it must be; None: the check was not done."""
    why: str
    """What was found, and the rule."""
    what_to_do: str = ""
    """How to mend it, or how to have it done; empty if it passed."""
    value: float | str | None = None
    """What was measured, if there is one number or word for it; SI units."""


def compared(name: str, why: str | None, told: str, what_to_do: str, value: float | str | None = None) -> Finding:
    """Return a finding that failed for a reason `why`, or passed if there is none."""
    if why is None:
        return Finding(name, True, told, value=value)
    return Finding(name, False, why, what_to_do, value)


def judged(name: str, passed: bool, told: str, rule: str, what_to_do: str, value: float | str | None = None) -> Finding:
    """Return a finding whose rule and advice are given only if it failed."""
    return compared(name, None if passed else f"{told}{rule}", told, what_to_do, value)


def undone(names: Iterable[str], why: str, what_to_do: str = "mend that first") -> list[Finding]:
    """Return findings of checks that were not done."""
    return [Finding(name, None, why, what_to_do) for name in names]


def refusal(findings: Sequence[Finding]) -> str | None:
    """Why a policy must not run, in one line; None if nothing failed."""
    failed = [finding for finding in findings if finding.passed is False]
    if not failed:
        return None
    first, others = failed[0], [finding.name for finding in failed[1:]]
    more = f" ({choices(others)} also failed; surefoot doctor tells all)" if others else ""
    return f"{first.name}: {first.why}; {first.what_to_do}{more}"
