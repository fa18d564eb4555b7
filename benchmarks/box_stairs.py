"""A world of MuJoCo alone: stairs of box geoms, which feet and bodies meet by MuJoCo's own contacts.

All else is as in the world `mujoco`: servos, motors, delays and sensors. Friction has an elliptic cone and impratio 10:
in a pyramidal cone feet creep (docs/decisions/physics.md).
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
from surefoot.world.terrain import HALF_SIDE, START, TREAD_DEPTH

DEEP = 1.0
"""How far boxes go down below the floor [m]."""


class BoxEngine(MujocoEngine):
    """MuJoCo with stairs of boxes in place of a `Ground` of stairs upward."""

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
        # Without feet for the law of `surefoot.world.contact`, and with contacts of all shapes all the time.
        none = np.zeros(0, np.int64)
        return super()._layout()._replace(foot_geom=none, shape_geom=none)


def _boxes(ground: Ground) -> list[tuple[list[float], list[float]]]:
    """Return middles and half sides [m] of the boxes of stairs upward: four a step, around the level place."""
    boxes = []
    for step in range(0 if ground.is_flat else round((HALF_SIDE - START) / TREAD_DEPTH)):
        near = START + step * TREAD_DEPTH
        top = float(ground.height(np.array([near + 0.5 * TREAD_DEPTH, 0.0])))
        middle, height = 0.5 * (top - DEEP), 0.5 * (top + DEEP)
        place, width, reach = near + 0.5 * TREAD_DEPTH, 0.5 * TREAD_DEPTH, near + TREAD_DEPTH
        for sign in (-1.0, 1.0):
            boxes.append(([sign * place, 0.0, middle], [width, reach, height]))
            boxes.append(([0.0, sign * place, middle], [reach, width, height]))
    return boxes
