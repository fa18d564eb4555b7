"""Emulation of a Go2's own motion controller: postures, and commands on rt/lowcmd.

It stands up, stands, lies down and damps the motors, but does not walk. Poses, times and gains are from the vendor's
stand-up example, since the real ones are not published. While active, it commands the motors at 500 Hz even if another
program does as well. Motors follow the last command, so they twitch between the two, as owners report.
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
"""Gains from the same example [N m/rad, N m s/rad]."""
_DAMPING = 3.0
"""Gain of damped motors [N m s/rad], from the vendor's passive state in unitree_rl_lab."""
_UP, _DOWN = 1.0, 1.8
"""Durations of folding and of stretching the legs, and of lying down [s], from the same example."""
NOT_ACTIVE = 4202
"""Error code of a sport service that is not initialized (unitree_sdk2_python, `go2/sport/sport_api.py`)."""
_BLOCKING_MODE = "normal"
"""Mode of older software. Owners report that selecting it blocks a new robot until it is switched off."""


class OwnController:
    """Modes and postures of the controller. Times are whole microseconds. It starts released."""

    def __init__(self) -> None:
        self.name = ""
        """Name in the motion switcher; "" while it is released."""
        self.blocked = False
        """Whether both services have stopped answering."""
        self._path: list[tuple[float, Array]] = []
        """Poses and the times at which they are reached [us]; empty while motors are damped."""
        self._start: tuple[int, Array] | None = None
        self._released = False
        self._command = new_command()

    @property
    def active(self) -> bool:
        """Whether it commands the motors."""
        return bool(self.name)

    # Requests to the motion switcher.

    def check_mode(self, _: str) -> Answer:
        """Return the name of the active controller."""
        return OK, json.dumps({"form": "0", "name": self.name})

    def select_mode(self, parameter: str) -> Answer:
        """Activate the controller."""
        name = parse_object(parameter).get("name")
        if name == _BLOCKING_MODE:
            self.blocked = True
        if name != OWN_CONTROLLER:
            return BAD_PARAMETER, ""
        self.activate()
        return OK, ""

    def activate(self) -> None:
        """Activate the controller with damped motors, unless it is active."""
        if not self.active:
            self.name, self._path = OWN_CONTROLLER, []

    def release_mode(self, _: str) -> Answer:
        """Release the controller; a standing robot sinks."""
        self._released = self.active
        self.name, self._path = "", []
        return OK, ""

    # Requests to the sport service.

    def damp(self, _: str = "") -> Answer:
        """Damp all motors; a standing robot drops."""
        return self._go([])

    def stand_up(self, _: str = "") -> Answer:
        """Fold the legs and stretch them, unless the robot already stands."""
        stands = bool(self._path) and self._path[-1][1] is STANDING
        return (OK, "") if stands else self._go([(_UP, FOLDED), (2 * _UP, STANDING)])

    def stand_down(self, _: str = "") -> Answer:
        """Lie down, and hold the legs folded."""
        return self._go([(_DOWN, LYING)])

    def stop_move(self, _: str = "") -> Answer:
        """Do nothing, since the controller never walks."""
        return (OK, "") if self.active else (NOT_ACTIVE, "")

    def _go(self, path: list[tuple[float, Array]]) -> Answer:
        if not self.active:
            return NOT_ACTIVE, ""
        self._path, self._start = [(1e6 * at, pose) for at, pose in path], None
        return OK, ""

    def command(self, now: int, angles: Array) -> Record | None:
        """Return the motor command at time `now`, with motors at `angles` (12,) [rad]; None if it is not active.

        The first command after its release damps the motors. The message is always the same object.
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
        start, pose = self._start
        previous = 0.0
        for at, target in self._path:
            phase = min(max((now - start - previous) / (at - previous), 0.0), 1.0)
            pose, previous = pose + phase * (target - pose), at
        motors["q"], motors["kp"], motors["kd"] = pose, KP, KD
        return self._command
