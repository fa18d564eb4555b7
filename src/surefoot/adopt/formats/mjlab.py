"""Format `mjlab` (github.com/mujocolab/mjlab): metadata properties of the ONNX file that its trainings write.

Joints, gains, default pose and action scale are in the same order. Values have three decimals. The control step is not
written.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.adopt.formats.common import unread_keys, unread_note
from surefoot.adopt.formats.isaac_lab import make_term
from surefoot.adopt.onnx_network import read_model
from surefoot.adopt.onnx_weights import read_network
from surefoot.adopt.specification import ObservationTerm, PolicySpecification, Range
from surefoot.errors import SurefootError, prefix_errors, quote
from surefoot.robot import RobotDescription

_CONTROL_STEP = 0.02
"""mjlab's usual control step [s]: four simulation steps of 5 ms."""
_LISTS = ("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale", "observation_names")
_OPTIONAL = {
    "observation_terms_scale": "scale",
    "observation_terms_history_length": "history",
    "observation_terms_clip": "clip",
    "observation_term_clip": "clip",
    "observation_history_lengths": "history",
}
"""Properties that only some versions write, with one value per observation."""
_HARMLESS = ("run_path", "command_names", "observation_terms_flatten_history_dim", "git", "version", "task", "date")
"""Properties that affect neither observations nor actions."""


def read(path: Path, robot: RobotDescription, overrides: Mapping[str, Any]) -> PolicySpecification:
    """Read the specification of a policy from its network's properties, which need not have fields in `overrides`.

    Raises:
        SurefootError: the file is not ONNX, a property is missing, or an observation is unknown.
    """
    data = read_network(path)
    with prefix_errors(path):
        properties = {one.key: one.value for one in read_model(data).metadata_props}
        for field, name in (("kp", "joint_stiffness"), ("kd", "joint_damping")):
            if overrides.get(field) is not None and not properties.get(name, "").strip():
                properties[name] = ",".join([f"{overrides[field]}"] * len(properties.get("joint_names", "").split(",")))
        if missing := [name for name in _LISTS if name not in properties]:
            raise SurefootError(f"has no property {', '.join(missing)}; mjlab's exporter writes {', '.join(_LISTS)}")
        joints = tuple(name.strip().rpartition("/")[2] for name in properties["joint_names"].split(","))
        stiffness, damping = (_numbers(properties, name) for name in ("joint_stiffness", "joint_damping"))
        scale, offset = _numbers(properties, "action_scale"), None
        if "action_offset" in properties:
            offset = _numbers(properties, "action_offset")
        step, silent = (
            _CONTROL_STEP,
            {
                "control_step": f"control step: mjlab does not write it, {1e3 * _CONTROL_STEP:g} ms is assumed; "
                "--control-step sets it"
            },
        )
        if "control_step" in properties:
            (step,), silent = _numbers(properties, "control_step")[:1], {}
        return PolicySpecification(
            joints=joints,
            default_pose=_numbers(properties, "default_joint_pos"),
            kp=stiffness,
            kd=damping,
            control_step=step,
            observations=_terms(properties),
            action_scale=scale[0] if len(scale) == 1 else scale,
            action_offset=offset,
            history_by="term",
            notes={
                **silent,
                "forward": "commands: mjlab does not write their ranges; --forward and others set them",
                **_gain_notes(joints, stiffness, damping),
                **unread_note(
                    unread_keys(properties, (*_LISTS, *_OPTIONAL, "action_offset", "control_step"), _HARMLESS)
                ),
            },
        )


def _numbers(properties: dict[str, str], name: str) -> tuple[float, ...]:
    """Parse a property that is a list of numbers."""
    try:
        return tuple(float(word) for word in properties[name].strip("[]").split(","))
    except ValueError:
        raise SurefootError(
            f"property {name} is {quote(properties[name][:80])}; it must be a list of numbers"
        ) from None


def _items(text: str) -> list[list[float]]:
    """Parse a list of numbers, or of lists of numbers, as a list of lists."""
    words = re.findall(r"\[[^\]]*\]|[^,\[\]\s]+", text)
    try:
        return [[float(number) for number in word.strip("[]").split(",")] for word in words]
    except ValueError:
        raise SurefootError(f"a property is {quote(text[:80])}; it must hold numbers") from None


def _terms(properties: dict[str, str]) -> tuple[ObservationTerm, ...]:
    names = [name.strip() for name in properties["observation_names"].split(",")]
    values: dict[str, list[list[float]]] = {}
    for name, what in _OPTIONAL.items():
        if name in properties:
            values[what] = _items(properties[name])
            if len(values[what]) != len(names):
                raise SurefootError(
                    f"property {name} has {len(values[what])} entries; there are {len(names)} observations"
                )
    terms = []
    for k, name in enumerate(names):
        scale = values["scale"][k] if "scale" in values else [1.0]
        length = values["history"][k][0] if "history" in values else 1.0
        if not math.isfinite(length):
            raise SurefootError(f"the history of observation {quote(name)} is {length}; it must be a whole number")
        clip: Range | None = None
        if "clip" in values and np.isfinite(values["clip"][k]).any():
            ends = np.nan_to_num(values["clip"][k], posinf=1e6, neginf=-1e6).tolist()
            if len(ends) != 2:
                raise SurefootError(f"the clip of observation {quote(name)} is {ends}; it must be two numbers")
            low, high = ends
            clip = (low, high)
        terms.append(make_term(name, scale[0] if len(scale) == 1 else tuple(scale), clip, int(length)))
    return tuple(terms)


def _gain_notes(joints: tuple[str, ...], stiffness: tuple[float, ...], damping: tuple[float, ...]) -> dict[str, str]:
    """Return a note if the gains look wrong; versions of mjlab up to November 2025 wrote some wrongly.

    Gains of actuators that compute torques themselves were 1 and 0, others were in the order of the actuators.
    """
    if len(stiffness) != len(joints) or len(damping) != len(joints):
        return {}
    if min(damping) <= 0 or max(stiffness) <= 1.0:
        return {
            "kp": f"gains look wrong: joint_stiffness is {min(stiffness):g} to {max(stiffness):g} and joint_damping "
            f"{min(damping):g} to {max(damping):g}; mjlab does not write gains of actuators that compute torques "
            "themselves: set --kp and --kd to the training's"
        }
    kinds: dict[str, set[tuple[float, float]]] = {}
    for joint, *gains in zip(joints, stiffness, damping, strict=True):
        kinds.setdefault(joint.partition("_")[2], set()).add((gains[0], gains[1]))
    different = [kind for kind, gains_of_kind in kinds.items() if len(gains_of_kind) > 1]
    if different and len(kinds) > 1:
        return {
            "kp": f"gains look wrong: for {different[0]} they differ from leg to leg; mjlab wrote them in the order of "
            "the actuators until November 2025: compare with the training, and set --kp and --kd"
        }
    return {}
