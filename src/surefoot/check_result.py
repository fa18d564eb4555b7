"""Results of checks, such as the checks of `surefoot doctor`, and helpers that make them."""

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
    """True or false, or None if the check was not done."""
    message: str
    """What was measured or compared; if the check failed, also the rule that was violated."""
    remedy: str = ""
    """What the user can do; empty if the check passed without a warning."""
    value: float | str | None = None
    """Measured value in SI units, if the check measures a single number or word."""
    warn: bool = False
    """Whether a check that passed warns of something unusual that does not prevent training."""


def fail_if(name: str, error: str | None, message: str, remedy: str, value: float | str | None = None) -> CheckResult:
    """Return a failed result with the message `error`, or a passed one with `message` if `error` is None."""
    if error is None:
        return CheckResult(name, True, message, value=value)
    return CheckResult(name, False, error, remedy, value)


def pass_if(
    name: str, passed: bool, message: str, rule: str, remedy: str, value: float | str | None = None
) -> CheckResult:
    """Return a passed or failed result; if it failed, `rule` is appended to its message."""
    return fail_if(name, None if passed else f"{message}{rule}", message, remedy, value)


def warn_if(name: str, warning: str | None, message: str, remedy: str, value: float | str | None = None) -> CheckResult:
    """Return a passed result: with `warning` as its message, or with `message` if `warning` is None."""
    if warning is None:
        return CheckResult(name, True, message, value=value)
    return CheckResult(name, True, warning, remedy, value, warn=True)


def skip_checks(names: Iterable[str], reason: str, remedy: str = "repair that first") -> list[CheckResult]:
    """Return results of checks that were not done, one per name, with the reason."""
    return [CheckResult(name, None, reason, remedy) for name in names]


def first_failure(results: Sequence[CheckResult]) -> str | None:
    """Return one line with the first failure and the names of the others, or None if nothing failed."""
    failed = [result for result in results if result.passed is False]
    if not failed:
        return None
    first, others = failed[0], [result.name for result in failed[1:]]
    more = f" (also failed: {choices(others)}; surefoot doctor lists every check)" if others else ""
    return f"{first.name}: {first.message}; {first.remedy}{more}"
