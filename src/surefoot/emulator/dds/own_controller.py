"""The controller that a Go2 has of its own, as far as others notice it: postures, and commands on rt/lowcmd.

It stands up, stands, lies down and damps; it does not walk. Its poses, times and gains are those of the vendor's
stand-up example; those of the real one are not published. While it is active it commands the motors at 500 Hz whoever
else does, and motors follow what came last: they twitch between the two, as owners report.
"""

from __future__ import annotations

import json

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.dds.low_level import Record, new_command
from surefoot.deploy.dds.services import BAD_PARAMETER, OK, OWN_CONTROLLER, Answer, parse_object

FOLDED = np.tile([0.0, 1.36, -2.65], 4)
STANDING = np.tile([0.0, 0.67, -1.3], 4)
LYING = np.array([-0.35, 1.36, -2.65, 0.35, 1.36, -2.65, -0.5, 1.36, -2.65, 0.5, 1.36, -2.65])
"""Poses [rad] in the order of the messages: unitree_sdk2, go2_stand_example.cpp."""
KP, KD = 60.0, 5.0
"""Its gains [N m/rad, N m s/rad]: the same."""
_DAMPING = 3.0
"""Gain of damped motors [N m s/rad], that of the vendor's passive state in unitree_rl_lab."""
_UP, _DOWN = 1.0, 1.8
"""Times [s] for folding the legs, for stretching them, and for lying down: the same example."""
NOT_ACTIVE = 4202
"""Error of the sport service that is not initialized (unitree_sdk2_python, `go2/sport/sport_api.py`)."""
_BLOCKING_MODE = "normal"
"""Mode of former software. Owners report that selecting it wedges a new robot until it is switched off."""


class OwnController:
    """Postures and modes; times are whole microseconds.

    It starts released: its name is empty, and it commands nothing.
    """

    def __init__(self) -> None:
        self.name = ""
        """Name in the motion switcher; empty: released."""
        self.wedged = False
        """Neither service answers any more."""
        self._path: list[tuple[float, Array]] = []
        """Times [us] by which poses are reached, and the poses; empty: motors are damped."""
        self._start: tuple[int, Array] | None = None
        self._released = False
        self._command = new_command()

    @property
    def active(self) -> bool:
        """Whether it commands the motors."""
        return bool(self.name)

    # Requests to the motion switcher.

    def check_mode(self, _: str) -> Answer:
        """Tell which controller is active."""
        return OK, json.dumps({"form": "0", "name": self.name})

    def select_mode(self, parameter: str) -> Answer:
        """Become active."""
        name = parse_object(parameter).get("name")
        if name == _BLOCKING_MODE:
            self.wedged = True
        if name != OWN_CONTROLLER:
            return BAD_PARAMETER, ""
        self.activate()
        return OK, ""

    def activate(self) -> None:
        """Become active with damped motors, unless it is."""
        if not self.active:
            self.name, self._path = OWN_CONTROLLER, []

    def release_mode(self, _: str) -> Answer:
        """Leave the motors to others; a robot that stands sinks."""
        self._released = self.active
        self.name, self._path = "", []
        return OK, ""

    # Requests to the sport service.

    def damp(self, _: str = "") -> Answer:
        """Damp all motors; a robot that stands drops."""
        return self._go([])

    def stand_up(self, _: str = "") -> Answer:
        """Fold the legs and stretch them, unless it stands already."""
        stands = bool(self._path) and self._path[-1][1] is STANDING
        return (OK, "") if stands else self._go([(_UP, FOLDED), (2 * _UP, STANDING)])

    def stand_down(self, _: str = "") -> Answer:
        """Lie down and hold the legs folded."""
        return self._go([(_DOWN, LYING)])

    def stop_move(self, _: str = "") -> Answer:
        """Stay: it never moves on."""
        return (OK, "") if self.active else (NOT_ACTIVE, "")

    def _go(self, path: list[tuple[float, Array]]) -> Answer:
        if not self.active:
            return NOT_ACTIVE, ""
        self._path, self._start = [(1e6 * at, pose) for at, pose in path], None
        return OK, ""

    def command(self, now: int, angles: Array) -> Record | None:
        """Return the command of a moment, for motors at `angles` (12,) [rad]; None if it is not active.

        The first one after its release damps the motors. The message stays the same object.
        """
        released, self._released = self._released, False
        if not self.active and not released:
            return None
        motors = self._command["motor_cmd"][:12]
        motors["dq"] = 0.0
        if not self._path:
            motors["kp"], motors["kd"] = 0.0, _DAMPING
            return self._command
        if self._start is None:
            self._start = now, angles.copy()
        begun, pose = self._start
        before = 0.0
        for at, target in self._path:
            share = min(max((now - begun - before) / (at - before), 0.0), 1.0)
            pose, before = pose + share * (target - pose), at
        motors["q"], motors["kp"], motors["kd"] = pose, KP, KD
        return self._command
