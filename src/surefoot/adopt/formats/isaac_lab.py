"""Observations as Isaac Lab's managers make them, which mjlab and unitree_rl_lab share.

A term is clipped, then scaled, then kept; its history is flattened with the oldest first, term after term. A history is
full from the start: the first value fills it.
"""

from __future__ import annotations

from surefoot.adopt.formats.common import unknown_term
from surefoot.adopt.specification import ObservationTerm, PerJoint, Range, TermName

TERMS: dict[str, TermName] = {
    **dict.fromkeys(("base_ang_vel", "imu_ang_vel", "angular_velocity"), "angular_velocity"),
    **dict.fromkeys(("projected_gravity", "gravity"), "gravity"),
    **dict.fromkeys(("command", "commands", "velocity_commands", "keyboard_velocity_commands"), "command"),
    **dict.fromkeys(("joint_pos", "joint_pos_rel"), "joint_positions"),
    **dict.fromkeys(("joint_vel", "joint_vel_rel"), "joint_speeds"),
    **dict.fromkeys(("actions", "last_action", "prev_actions"), "last_action"),
    "gait_phase": "clock",
}
"""Terms by the names that they usually have, mjlab's own first."""


def make_term(
    name: str, scale: PerJoint, clip: Range | None, length: int, period: float | None = None
) -> ObservationTerm:
    """Return a term of Isaac Lab.

    Args:
        name: its name.
        scale: its scale.
        clip: bounds before the scale.
        length: steps of its history, the oldest first; 0 and 1 mean none.
        period: of a gait's phase [s].

    Raises:
        SurefootError: a term that is not known or not measured.
    """
    if name not in TERMS:
        raise unknown_term(name, TERMS)
    steps = tuple(reversed(range(max(length, 1))))
    return ObservationTerm(TERMS[name], scale=scale, clip=clip, steps=steps, period=period or 1.0)
