"""Observation terms of Isaac Lab's managers, which mjlab and unitree_rl_lab share.

A term is clipped, then scaled, then stored in its history. Histories are flattened term by term, oldest first. The
first value fills the whole history.
"""

from __future__ import annotations

from surefoot.adopt.formats.common import unknown_term
from surefoot.adopt.specification import MAX_HISTORY, ObservationTerm, PerJoint, Range, TermName
from surefoot.errors import SurefootError

TERMS: dict[str, TermName] = {
    **dict.fromkeys(("base_ang_vel", "imu_ang_vel", "angular_velocity"), "angular_velocity"),
    **dict.fromkeys(("base_lin_vel", "base_linear_velocity"), "base_velocity"),
    **dict.fromkeys(("projected_gravity", "gravity"), "gravity"),
    **dict.fromkeys(("command", "commands", "velocity_commands", "keyboard_velocity_commands"), "command"),
    **dict.fromkeys(("joint_pos", "joint_pos_rel"), "joint_positions"),
    **dict.fromkeys(("joint_vel", "joint_vel_rel"), "joint_speeds"),
    **dict.fromkeys(("actions", "last_action", "prev_actions"), "last_action"),
    "gait_phase": "clock",
}
"""Terms by their usual names, mjlab's name first."""


def make_term(
    name: str, scale: PerJoint, clip: Range | None, length: int, period: float | None = None
) -> ObservationTerm:
    """Convert an observation term of Isaac Lab.

    Args:
        name: name of the term.
        scale: scale of the term.
        clip: bounds before scaling.
        length: length of the history, oldest first; 0 and 1 mean no history.
        period: period of a gait phase [s].

    Raises:
        SurefootError: the term is unknown, or robots do not measure it.
    """
    if name not in TERMS:
        raise unknown_term(name, TERMS)
    if length > MAX_HISTORY:
        raise SurefootError(f"term '{name}' has a history of {length}; at most {MAX_HISTORY} are allowed")
    steps = tuple(reversed(range(max(length, 1))))
    return ObservationTerm(TERMS[name], scale=scale, clip=clip, steps=steps, period=period or 1.0)
