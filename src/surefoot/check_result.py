"""Results of checks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from surefoot.errors import choices


@dataclass(frozen=True)
class CheckResult:
    """Result of one check."""

    name: str
    """Name of the check."""
    passed: bool | None
    """None: the check was not done."""
    message: str
    """What was measured or compared; of a check that failed, also the rule."""
    remedy: str = ""
    """What to do, unless the check passed without a warning."""
    value: float | str | None = None
    """What was measured, if it is one number or word; SI units."""
    warn: bool = False
    """Whether a check that passed warns: training works, and something is unusual."""


def fail_if(name: str, error: str | None, message: str, remedy: str, value: float | str | None = None) -> CheckResult:
    """Return a result that failed with a message `error`; it passed, with `message`, if there is no error."""
    if error is None:
        return CheckResult(name, True, message, value=value)
    return CheckResult(name, False, error, remedy, value)


def pass_if(
    name: str, passed: bool, message: str, rule: str, remedy: str, value: float | str | None = None
) -> CheckResult:
    """Return a result; only if it failed, its message ends with the rule."""
    return fail_if(name, None if passed else f"{message}{rule}", message, remedy, value)


def warn_if(name: str, warning: str | None, message: str, remedy: str, value: float | str | None = None) -> CheckResult:
    """Return a result that passed: with a warning as its message, or with `message` if there is none."""
    if warning is None:
        return CheckResult(name, True, message, value=value)
    return CheckResult(name, True, warning, remedy, value, warn=True)


def skip_checks(names: Iterable[str], reason: str, remedy: str = "repair that first") -> list[CheckResult]:
    """Return the results of checks that were not done."""
    return [CheckResult(name, None, reason, remedy) for name in names]


def first_failure(results: Sequence[CheckResult]) -> str | None:
    """Return the first failure and the names of the others in one line; None if nothing failed."""
    failed = [result for result in results if result.passed is False]
    if not failed:
        return None
    first, others = failed[0], [result.name for result in failed[1:]]
    more = f" (also failed: {choices(others)}; surefoot doctor lists every check)" if others else ""
    return f"{first.name}: {first.message}; {first.remedy}{more}"
