"""Contract of a policy file as text: inputs, commands, actions, rates, gains, height map and notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from surefoot.policy.contract import MEMORY, Contract
from surefoot.robot.commands import COMMANDS

_MAX_LISTED = 4
"""Maximum number of different values that are listed; more are given as a range."""


def policy_rows(contract: Contract, path: Path) -> list[dict[str, str]]:
    """Return the facts in the contract of a policy file, one row each."""
    facts = {
        "policy": f"{contract.name}, {path} ({path.stat().st_size / 1024:.0f} kB)",
        "robot": f"{contract.robot}, {len(contract.motor_names)} motors: {', '.join(contract.motor_names)}",
        "made": " ".join(part for part in (f"by surefoot {contract.version}", contract.created) if part),
        "inputs": _inputs(contract),
        **{f"input {part.name}": _part(contract, part.name, part.unit, part.frame) for part in contract.observation},
        **_commands(contract),
        "actions": _actions(contract),
        "reference": str(contract.reference.get("kind", "yes")) if contract.reference else "none",
        "control step": f"{1e3 * contract.control_step:g} ms ({1 / contract.control_step:g} Hz)",
        "latency": f"policy {1e3 * contract.control_latency:g} ms, servo {1e3 * contract.servo_latency:g} ms",
        "gains": f"kp {_numbers(contract.servo_kp)}, kd {_numbers(contract.servo_kd)}",
        "rest pose": "; ".join(_numbers(values) for values in contract.rest),
        "height map": _grid(contract),
        "plug-ins": ", ".join(one.name for one in contract.plugins) or "none",
        **_adopted(contract),
    }
    return [{"": name, "says": text} for name, text in facts.items()]


def _numbers(values: float | Sequence[float]) -> str:
    """Return the different values as text: a few of them listed, or their range."""
    different = np.unique(np.round(np.atleast_1d(values), 6))
    if len(different) > _MAX_LISTED:
        return f"{different[0]:g} to {different[-1]:g}"
    return " and ".join(f"{value:g}" for value in different)


def _inputs(contract: Contract) -> str:
    width = len(contract.columns)
    text = f"{width} numbers"
    if contract.history > 1:
        text = f"{width * contract.history} numbers: {width} of each of {contract.history} control steps, newest first"
    return text


def _part(contract: Contract, name: str, unit: str, frame: str) -> str:
    prefixes = {"motor_angles": "angle.", "motor_speeds": "speed.", "height_scan": "ground", MEMORY: f"{MEMORY}."}
    count = sum(one == name or one.startswith(prefixes.get(name, f"{name}.")) for one in contract.columns)
    amount = " ".join(part for part in (str(count) if count else "", unit if unit != "1" else "") if part)
    return "; ".join(part for part in (amount, frame) if part) or "yes"


def _commands(contract: Contract) -> dict[str, str]:
    limits = contract.commands
    if limits is None:
        return {"commands": "none"}
    ranges = zip(COMMANDS.items(), limits.low, limits.high, strict=True)
    texts = [f"{name.replace('_', ' ')} {low:g} to {high:g} {unit}" for (name, unit), low, high in ranges]
    return {"commands": ", ".join(texts), "deadband": f"commands up to {_numbers(limits.deadband)} let it stand"}


def _actions(contract: Contract) -> str:
    memory = sum(name.startswith(f"{MEMORY}.") for name in contract.action_names)
    count = len(contract.action_names) - memory
    first = contract.action_names[0].partition(".")[0]
    kind = {"angle": "motor angles [rad]", "joint": "joint angles [rad]"}.get(first, "coordinates of leg space")
    bounds = f"from {min(contract.low[:count]):.3g} to {max(contract.high[:count]):.3g}"
    return f"{count} {kind}, {bounds}" + (f", and {memory} memory values" if memory else "")


def _grid(contract: Contract) -> str:
    grid = contract.height_map
    if grid is None:
        return "none"
    places = [
        f"{len(places)} points {where} from {places[0]:.4g} to {places[-1]:.4g} m, {places[1] - places[0]:.4g} m apart"
        for where, places in (("ahead", grid.ahead), ("to the left", grid.left))
    ]
    return f"{', '.join(places)}; {1e3 * grid.age:g} ms old"


def _adopted(contract: Contract) -> dict[str, str]:
    """Return the origin of an adopted policy, and its notes."""
    adopted = contract.figures.get("adopted")
    if not isinstance(adopted, Mapping):
        return {}
    from surefoot.adopt.builder import adopted_notes

    texts = {f"note {name}": text for name, text in adopted_notes(contract).items()}
    return {"adopted from": str(adopted.get("format", "another framework")), **texts}
