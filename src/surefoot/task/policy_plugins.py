"""Plug-ins that a policy needs: checks that they are registered, and its task without the missing ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from surefoot.errors import SurefootError, choices, quote
from surefoot.policy.contract import Contract
from surefoot.task.observation import PARTS
from surefoot.task.plugins import changed_plugins
from surefoot.task.reward import TERMS


def check_plugins(contract: Contract) -> None:
    """Reject a policy with an observation of a plug-in that is not registered."""
    for record in contract.plugins:
        if missing := [name for name in record.observations if name not in PARTS]:
            raise SurefootError(
                f"policy {quote(contract.name)} needs observation {choices(map(quote, missing))} of a plug-in; "
                f"name the file: --plugin {quote(record.name)}"
            )


def plugin_notes(contract: Contract) -> list[str]:
    """Return a note for each plug-in of a policy that has changed, and one for missing reward terms."""
    notes = changed_plugins(contract.plugins)
    if skipped := _skipped_rewards(contract):
        names = choices(quote(record.name) for record in contract.plugins)
        what = "are without" if skipped < {*contract.task.get("reward", {})} else "are by the paper's reward, without"
        notes.append(
            f"returns {what} {choices(map(quote, sorted(skipped)))}; to include them, name the plug-in: "
            f"--plugin {names}"
        )
    return notes


def _skipped_rewards(contract: Contract) -> set[str]:
    """Return the policy's reward terms of plug-ins that are not registered."""
    return {name for record in contract.plugins for name in record.rewards if name not in TERMS}


def task_without_skipped(contract: Contract) -> dict[str, Any]:
    """Return the contract's task table without reward terms of plug-ins that are not registered."""
    skipped, task = _skipped_rewards(contract), dict(contract.task)
    for key in ("reward", "reward_limits") if skipped else ():
        if isinstance(table := task.get(key), Mapping):
            task[key] = {name: value for name, value in table.items() if name not in skipped}
    if skipped and not task.get("reward"):
        task.pop("reward", None)
    return task
