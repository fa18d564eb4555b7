"""World with stairs of box geoms, whose contacts with feet and bodies are MuJoCo's own.

Servos, motors, delays and sensors are those of the world `mujoco`. Friction has an elliptic cone and impratio 10, since
feet creep with a pyramidal cone (docs/decisions/physics.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from surefoot.robot import RobotDescription
from surefoot.world.ground import FLAT, Ground
from surefoot.world.interface import WorldConfig
from surefoot.world.mujoco_engine import MujocoEngine
from surefoot.world.mujoco_model import build_spec
from surefoot.world.terrain import HALF_SIDE, START_HALF_SIDE, TREAD_DEPTH

DEEP = 1.0
"""Depth of the boxes below the floor [m]."""


class BoxEngine(MujocoEngine):
    """MuJoCo engine with stairs of boxes instead of a `Ground` of upward stairs."""

    def _build(self, robot: RobotDescription, config: WorldConfig) -> mujoco.MjModel:
        spec = build_spec(robot, replace(config, ground=FLAT))
        option = spec.option
        option.cone, option.impratio, option.iterations = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0, 50
        friction = [robot.contact.friction, 0.005, 0.0001]
        spec.geom("ground").friction = friction
        for leg in robot.legs:
            foot = spec.geom(f"{leg.name}_foot")
            foot.conaffinity, foot.friction = 1, friction
        for middle, half in _boxes(config.ground):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=middle,
                size=half,
                contype=1,
                conaffinity=0,
                condim=3,
                friction=friction,
            )
        return spec.compile()

    def _layout(self) -> Any:
        # No feet for the contact law of `surefoot.world.contact`; MuJoCo's contacts of all geoms are always on.
        none = np.zeros(0, np.int64)
        return super()._layout()._replace(foot_geom=none, shape_geom=none)


def _boxes(ground: Ground) -> list[tuple[list[float], list[float]]]:
    """Return centers and half sizes [m] of the boxes of upward stairs: four per step, around the level center."""
    boxes = []
    for step in range(0 if ground.is_flat else round((HALF_SIDE - START_HALF_SIDE) / TREAD_DEPTH)):
        near = START_HALF_SIDE + step * TREAD_DEPTH
        top = float(ground.height(np.array([near + 0.5 * TREAD_DEPTH, 0.0])))
        middle, height = 0.5 * (top - DEEP), 0.5 * (top + DEEP)
        place, width, reach = near + 0.5 * TREAD_DEPTH, 0.5 * TREAD_DEPTH, near + TREAD_DEPTH
        for sign in (-1.0, 1.0):
            boxes.append(([sign * place, 0.0, middle], [width, reach, height]))
            boxes.append(([0.0, sign * place, middle], [reach, width, height]))
    return boxes
