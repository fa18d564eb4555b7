"""Usual mistakes in the specification of a policy, each represented by the change that would correct it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, permutations
from typing import Any, NamedTuple

import numpy as np

from surefoot.adopt.builder import check_specification
from surefoot.adopt.specification import ObservationTerm, PolicySpecification
from surefoot.adopt.usual_numbers import VECTORS
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

_SCALE_FACTORS = (0.05, 0.25, 0.5, 2.0, 4.0, 20.0, math.pi / 180, 180 / math.pi)
"""Factors by which scales are often wrong, because a usual scale (0.05, 0.25, 0.5, 2, degrees) was omitted or applied
twice."""
_GAIN_FACTORS = (0.25, 0.5, 2.0, 4.0)
_GRAVITY = 9.81
"""Gravity in m/s^2, which is sometimes observed instead of the unit vector."""


class Correction(NamedTuple):
    """A change of a specification that corrects a possible mistake."""

    field: str
    """Name of the changed field."""
    text: str
    """Description of the mistake."""
    specification: PolicySpecification
    """The corrected specification."""


def corrections(specification: PolicySpecification, robot: RobotDescription) -> list[Correction]:
    """Return corrections of all usual mistakes that are compatible with the robot, without duplicates."""
    unique: dict[str, Correction] = {}
    for generate in _CORRECTION_KINDS:
        for correction in generate(specification, robot):
            changed = correction.specification
            if changed == specification:
                continue
            # A change of only the observations is always compatible with the robot.
            if replace(changed, observations=specification.observations) == specification or fits_robot(changed, robot):
                unique.setdefault(repr(changed), correction)
    return list(unique.values())


def fits_robot(specification: PolicySpecification, robot: RobotDescription) -> bool:
    """Return whether a specification is compatible with the robot."""
    try:
        check_specification(specification, robot)
    except SurefootError:
        return False
    return True


def joint_orders(robot: RobotDescription) -> dict[str, tuple[str, ...]]:
    """Return the usual joint orders by name: all usual orders of legs, each leg by leg and joint by joint."""
    sides = {}
    for leg in robot.legs:
        front = "F" if "front" in leg.name else "R" if "back" in leg.name else ""
        side = "L" if "left" in leg.name else "R" if "right" in leg.name else ""
        if front and side:
            sides[front + side] = leg
    if len(sides) != 4:
        return {}
    orders = {}
    for legs in (
        ("FR", "FL", "RR", "RL"),
        ("FL", "FR", "RL", "RR"),
        ("FL", "RL", "FR", "RR"),
        ("FR", "RR", "FL", "RL"),
        ("RL", "RR", "FL", "FR"),
        ("RR", "RL", "FR", "FL"),
        ("FL", "FR", "RR", "RL"),
        ("FR", "FL", "RL", "RR"),
    ):
        chains = [sides[leg].motors for leg in legs]
        orders[f"{' '.join(legs)}, leg by leg"] = tuple(joint for chain in chains for joint in chain)
        orders[f"{' '.join(legs)}, joint by joint"] = tuple(
            joint for kind in zip(*chains, strict=True) for joint in kind
        )
    return orders


def _orders(spec: PolicySpecification, robot: RobotDescription) -> Iterator[Correction]:
    """Yield other joint orders, first applied only to the names, then to all per-joint numbers."""
    for name, order in joint_orders(robot).items():
        text = f"order of joints: it should be {name}"
        yield Correction("joints", text, replace(spec, joints=order))
        places = [spec.joints.index(joint) for joint in order] if {*order} == {*spec.joints} else []
        if places:
            yield Correction("joints", text, _reordered(spec, order, places))


def _reordered(spec: PolicySpecification, order: tuple[str, ...], places: Sequence[int]) -> PolicySpecification:
    """Reorder the joints of a specification together with all per-joint numbers."""

    def moved(value: Any) -> Any:
        return tuple(value[place] for place in places) if isinstance(value, tuple) else value

    numbers = ("default_pose", "kp", "kd", "action_scale", "action_offset", "joint_signs")
    changes: dict[str, Any] = {name: moved(getattr(spec, name)) for name in numbers}
    for name in ("action_clip", "target_clip"):
        if (ends := getattr(spec, name)) is not None:
            changes[name] = tuple(moved(end) for end in ends)
    per_joint = (
        replace(term, scale=moved(term.scale)) if np.size(term.scale) == len(order) else term
        for term in spec.observations
    )
    return replace(spec, joints=order, observations=tuple(per_joint), **changes)


def _signs(spec: PolicySpecification, robot: RobotDescription) -> Iterator[Correction]:
    own = np.array(spec.joint_signs or np.ones(len(spec.joints)))
    for group, chosen in {**_joint_groups(spec, robot, sides=True), "all joints": [True] * len(own)}.items():
        for keep in (False, True):
            flip = np.where(chosen, -1.0, 1.0)
            change: dict[str, Any] = {"joint_signs": tuple((own * flip).tolist())}
            if keep:  # assume that the pose already has the signs of the URDF
                change["default_pose"] = tuple((flip * spec.default_pose).tolist())
            yield Correction("joint_signs", f"sign of {group}: it should be the other one", replace(spec, **change))


def _joint_groups(spec: PolicySpecification, robot: RobotDescription, sides: bool) -> dict[str, list[bool]]:
    """Return masks over the specification's joints by group: all abductions, hips and knees, optionally per side."""
    groups: dict[str, list[bool]] = {}
    for leg in robot.legs:
        names = ("hip", "knee") if len(leg.motors) == 2 else ("abduction", "hip", "knee")
        side = "right" if "right" in leg.name else "left"
        for kind, motor in zip(names, leg.motors, strict=True):
            for group in (f"all {kind}s", *([f"{kind}s of the {side} legs"] if sides else [])):
                groups.setdefault(group, [False] * len(spec.joints))[spec.joints.index(motor)] = True
    return groups


def _with_term(spec: PolicySpecification, place: int, term: ObservationTerm) -> PolicySpecification:
    terms = list(spec.observations)
    terms[place] = term
    return replace(spec, observations=tuple(terms))


def _scaled(term: ObservationTerm, factor: float, columns: Sequence[int] = (0, 1, 2)) -> ObservationTerm:
    """Multiply the scale of a term, or of some components of a vector, by a factor."""
    width = len(term.scale) if isinstance(term.scale, tuple) else 3 if term.term in VECTORS else 0
    if not width:
        return replace(term, scale=float(np.asarray(term.scale)) * factor)
    scales = np.broadcast_to(term.scale, width) * [factor if k in columns or width > 3 else 1.0 for k in range(width)]
    return replace(term, scale=tuple(scales.tolist()))


def _scales(spec: PolicySpecification, robot: RobotDescription) -> Iterator[Correction]:
    for place, term in enumerate(spec.observations):
        if term.term in ("clock", "constant"):
            continue
        if term.term == "gravity":
            yield from _gravity_scales(spec, place, term)
            continue
        what = term.term.replace("_", " ")
        for factor in _SCALE_FACTORS:
            text = f"scale of {what}: it should be {_format(_multiply(term.scale, factor))}, "
            text += f"{factor:.3g} times as large"
            scaled = _scaled(term, factor)
            yield Correction("observations", text, _with_term(spec, place, scaled))
        if term.term == "command":
            for factor in _SCALE_FACTORS[1:5]:
                for part, chosen in (("speeds", (0, 1)), ("yaw rate", (2,))):
                    text = f"scale of command's {part}: it should be {factor:g} times as large"
                    scaled = _scaled(term, factor, chosen)
                    yield Correction("observations", text, _with_term(spec, place, scaled))
        if term.term == "joint_positions":
            text = "joint positions: they should be " + (
                "angles themselves" if term.relative else "less the default pose"
            )
            yield Correction("observations", text, _with_term(spec, place, replace(term, relative=not term.relative)))
        if term.term == "last_action":
            for scale, which in ((spec.action_scale, "the scaled one, in rad"), (1.0, "as the network gave it")):
                text = f"last action: it should be {which}"
                yield Correction("observations", text, _with_term(spec, place, replace(term, scale=scale)))


def _gravity_scales(spec: PolicySpecification, place: int, term: ObservationTerm) -> Iterator[Correction]:
    """Yield scales of gravity with another magnitude, with the same and the opposite sign."""
    length = float(np.abs(term.scale).max())
    unit = math.isclose(length, 1.0)
    targets = (_GRAVITY, 1 / _GRAVITY) if unit else (1.0,) if length else ()
    for target in targets:
        for sign in (1.0, -1.0):
            scaled = _scaled(term, sign * target / length)
            now = "" if unit else f" (now {_format(term.scale)}{': m/s2' if _is_standard_gravity(length) else ''})"
            text = f"scale of gravity: it should be {_format(scaled.scale)}{now}"
            yield Correction("observations", text, _with_term(spec, place, scaled))


def _is_standard_gravity(length: float) -> bool:
    return bool(np.isclose(length, _GRAVITY, rtol=0.01))


def _format(value: float | Sequence[float]) -> str:
    """Format a number, or the distinct numbers of a sequence."""
    return " and ".join(f"{number:.3g}" for number in np.unique(value))


def _multiply(value: Any, factor: float) -> Any:
    """Multiply a number, or each number of a tuple, by a factor."""
    return tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value


def _frames(spec: PolicySpecification, robot: RobotDescription) -> Iterator[Correction]:
    """Yield other signs and component orders of vectors, and other orders of observation terms."""
    for place, term in enumerate(spec.observations):
        what = term.term.replace("_", " ")
        if term.term not in VECTORS:
            if term.term in ("joint_positions", "joint_speeds", "last_action"):
                text = f"sign of {what}: it should be the other one"
                yield Correction("observations", text, _with_term(spec, place, _scaled(term, -1.0)))
            continue
        names = ("forward", "sideways", "yaw rate") if term.term == "command" else ("x", "y", "z")
        for chosen in ((0, 1, 2), (0, 1), (1, 2), (0,), (1,), (2,)):
            parts = " and ".join(names[k] for k in chosen)
            flipped = _scaled(term, -1.0, chosen)
            text = f"sign of {what} ({parts}): it should be the other one"
            yield Correction("observations", text, _with_term(spec, place, flipped))
        own = term.columns or (0, 1, 2)
        scales = np.broadcast_to(term.scale, len(own))
        for order in permutations(range(len(own))):
            if order == tuple(range(len(own))) or len(own) != len(names):
                continue
            text = f"order of {what}: it should be {', '.join(names[own[k]] for k in order)}"
            moved = replace(term, columns=tuple(own[k] for k in order), scale=tuple(scales[list(order)].tolist()))
            yield Correction("observations", text, _with_term(spec, place, moved))
            stayed = replace(term, columns=tuple(own[k] for k in order))
            yield Correction("observations", text, _with_term(spec, place, stayed))
    yield from _term_orders(spec)


_TERM_ORDERS = {
    "of legged_gym, Isaac Lab and robot_lab": (
        *("angular_velocity", "gravity", "command", "joint_positions", "joint_speeds", "last_action"),
    ),
    "of HIMLoco": ("command", "angular_velocity", "gravity", "joint_positions", "joint_speeds", "last_action"),
    "of legged_gym and Isaac Lab with the base's velocity": (
        *("base_velocity", "angular_velocity", "gravity", "command"),
        *("joint_positions", "joint_speeds", "last_action"),
    ),
    "of mjlab with the base's velocity": (
        *("base_velocity", "angular_velocity", "gravity"),
        *("joint_positions", "joint_speeds", "last_action", "command"),
    ),
    "of mjlab": ("angular_velocity", "gravity", "joint_positions", "joint_speeds", "last_action", "command"),
    "with gravity first": ("gravity", "angular_velocity", "command", "joint_positions", "joint_speeds", "last_action"),
}


def _term_orders(spec: PolicySpecification) -> Iterator[Correction]:
    terms = spec.observations
    kinds: list[str] = [term.term for term in terms]
    for name, order in _TERM_ORDERS.items():
        if sorted(order) == sorted(kinds):
            chosen = tuple(terms[kinds.index(kind)] for kind in order)
            text = f"order of the observation: it should be that {name}: {', '.join(order).replace('_', ' ')}"
            yield Correction("observations", text, replace(spec, observations=chosen))
    for first, second in combinations(range(len(terms)), 2):
        swapped = list(terms)
        swapped[first], swapped[second] = swapped[second], swapped[first]
        names = f"{kinds[first]} and {kinds[second]}".replace("_", " ")
        text = f"order of the observation: {names} should change places"
        yield Correction("observations", text, replace(spec, observations=tuple(swapped)))


def _histories(spec: PolicySpecification, robot: RobotDescription) -> Iterator[Correction]:
    if max(len(term.steps) for term in spec.observations) == 1:
        return
    turned = tuple(replace(term, steps=term.steps[::-1]) for term in spec.observations)
    newest = spec.observations[0].steps[0] < spec.observations[0].steps[-1]
    order = f"the {'oldest' if newest else 'newest'} first"
    other = "term" if spec.history_by == "step" else "step"
    by = f"{other} by {other}"
    yield Correction("observations", f"history: it should be {order}", replace(spec, observations=turned))
    if len({term.steps for term in spec.observations}) == 1:
        yield Correction("history_by", f"history: it should be {by}", replace(spec, history_by=other))  # type: ignore[arg-type]
        both = replace(spec, observations=turned, history_by=other)  # type: ignore[arg-type]
        yield Correction("history_by", f"history: it should be {by}, {order}", both)


def _actions(spec: PolicySpecification, robot: RobotDescription) -> Iterator[Correction]:
    for factor in _GAIN_FACTORS:
        scale = _multiply(spec.action_scale, factor)
        text = f"scale of actions: it should be {_format(scale)}, {factor:g} times as large"
        yield Correction("action_scale", text, replace(spec, action_scale=scale))
    own = np.broadcast_to(spec.action_scale, len(spec.joints))
    for group, chosen in _joint_groups(spec, robot, sides=False).items():
        for factor in _GAIN_FACTORS:
            scales = np.where(chosen, factor, 1.0) * own
            text = f"scale of actions ({group}): it should be {_format(scales[chosen])}, {factor:g} times as large"
            yield Correction("action_scale", text, replace(spec, action_scale=tuple(scales.tolist())))
    negated = replace(spec, action_scale=_multiply(spec.action_scale, -1.0))
    yield Correction("action_scale", "sign of actions: it should be the other one", negated)


def _timing(spec: PolicySpecification, robot: RobotDescription) -> Iterator[Correction]:
    for name, what, unit in (("kp", "proportional gains", "N m/rad"), ("kd", "derivative gains", "N m s/rad")):
        for factor in _GAIN_FACTORS:
            value = _multiply(getattr(spec, name), factor)
            text = f"{what}: they should be {_format(value)} {unit}, {factor:g} times as large"
            yield Correction(name, text, replace(spec, **{name: value}))
    for factor in _GAIN_FACTORS:
        kp, kd = _multiply(spec.kp, factor), _multiply(spec.kd, factor)
        text = f"gains: kp should be {_format(kp)} and kd {_format(kd)}, {factor:g} times as large"
        yield Correction("kp", text, replace(spec, kp=kp, kd=kd))
    for factor in _GAIN_FACTORS:
        step = spec.control_step * factor
        if 0.004 <= step <= 0.05:
            text = f"control step: it should be {1e3 * step:g} ms"
            yield Correction("control_step", text, replace(spec, control_step=step))


_CORRECTION_KINDS = (_orders, _signs, _scales, _frames, _histories, _actions, _timing)
"""Generators of corrections, one per kind of mistake."""
