"""What a robot does besides running a policy: arm, stand up, stop, sit down, and get over a fall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.arming import Arming
from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.controller import Controller
from surefoot.deploy.loop import ControlLoop
from surefoot.deploy.poses import between, lying, pose, sitting
from surefoot.deploy.safety import GO, Act, Verdict
from surefoot.deploy.wire.messages import Handshake, Mode, State
from surefoot.errors import SurefootError

Array = NDArray[np.float64]

FLAT, FOLD, PAUSE, RISE, HOLD = 1.0, 1.0, 0.3, 1.5, 0.5
"""Time [s] to lay the legs flat, to draw them in, to come to rest, to stand up, and to stand before the policy starts
(as long as a robot settles in simulation)."""
UP = FLAT + FOLD + PAUSE + RISE + HOLD
"""Time [s] from arming to the policy's start."""
DROP, REST = 0.2, 0.7
"""Time [s] to drop from a gait to sitting, and to come to rest."""
SIT = 1.5
"""Time [s] to sit down from standing, or from a fall."""
DOWN = max(DROP + REST, SIT)
"""Longest time [s] from the policy's end to disarming."""
STILL_SPEED = 0.5
"""Speed [rad/s] of motors and base below which a fallen robot lies still."""
_STILL_PATIENCE = 5.0


class Moves:
    """Moves of a greeted robot, each smooth, each watched by the loop's guard.

    Args:
        connection: to the robot.
        controller: the policy on it.
        loop: of this run.
        handshake: what the robot said of itself.
    """

    def __init__(
        self, connection: RobotConnection, controller: Controller, loop: ControlLoop, handshake: Handshake
    ) -> None:
        self.connection, self.controller, self.loop, self.handshake = connection, controller, loop, handshake
        self.robot, self.contract = controller.robot, controller.contract
        self.arming = Arming(connection, handshake, self.contract.control_step)
        self.standing = pose(self.robot, *self.contract.rest)
        self.risen = False
        """Whether the robot has begun to rise from sitting: only then does it need to sit down again."""

    def _state(self) -> State:
        return self.connection.last_state()

    # Arming and letting go.

    def arm(self) -> None:
        """Let the servos hold the present pose.

        Raises:
            SurefootError: the robot does not arm; says why.
        """
        self.loop.watch.phase("arm", 0.0)
        self.arming.arm()

    def disarm(self) -> Verdict:
        """End commands in good order."""
        self.loop.watch.phase("disarm", 0.0)
        if self.arming.ask_until(self.connection.disarm, lambda: self._state().mode != Mode.POSITION):
            return GO
        self.loop.damp()
        return Verdict(Act.DAMP, "disarm", "the robot does not say that it has disarmed")

    def confirm_damped(self) -> None:
        """Ask for damped motors until the robot says so; frames may be lost."""
        self.arming.ask_until(self.loop.damp, lambda: self._state().mode != Mode.POSITION)

    # Ways from pose to pose.

    def _within(self, target: Array) -> Array:
        """Within what the robot takes: it may be switched on in a pose beyond."""
        return np.clip(target, self.handshake.angle_low, self.handshake.angle_high)

    def _go(
        self, phase: str, start: Array, end: Array, duration: float, upright: bool = True, sitting: bool = False
    ) -> Verdict:
        steps = self.loop.steps_of(duration)

        def target(k: int, state: State, missed: int) -> Array:
            return self._within(between(start, end, (k + 1) / steps))

        return self.loop.follow(phase, steps, target, upright=upright, sitting=sitting)

    def stand_up(self) -> Verdict:
        """Rise from wherever the legs lie: a damped robot sinks onto its belly, and its legs slide out from under it.

        They are laid flat and drawn in first. Motors that pushed the body up at once, with the feet out at the side,
        would stall at full current and then leap.
        """
        found = self._state().motor_angle
        flat, drawn, stand = lying(self.robot, found), sitting(self.robot), self.standing
        for phase, start, end, duration in (
            ("lay legs flat", found, flat, FLAT),
            ("draw legs in", flat, drawn, FOLD),
            ("sit", drawn, drawn, PAUSE),
            ("stand up", drawn, stand, RISE),
            ("stand", stand, stand, HOLD),
        ):
            self.risen = self.risen or phase == "stand up"
            verdict = self._go(phase, start, end, duration)
            if verdict.act is not Act.GO:
                return verdict
        return GO

    def stop(self) -> Verdict:
        """Drop from a gait to sitting, and come to rest there.

        Low and with all feet on the ground a robot stops at any speed of its gaits. One that fades from the gait to
        standing stumbles over its own momentum when it is fast. A nod of more than the limit is no fall here: damped
        motors would do no better. The robot's own limit still holds.
        """
        start, drawn = self._last_target(), sitting(self.robot)
        verdict = self._go("drop", start, drawn, DROP, upright=False, sitting=True)
        return (
            verdict if verdict.act is not Act.GO else self._go("sit", drawn, drawn, REST, upright=False, sitting=True)
        )

    def _last_target(self) -> Array:
        return self.loop.target if self.loop.target is not None else self._state().motor_angle

    def sit_down(self, upright: bool = True) -> Verdict:
        """Sit slowly, from the pose that was asked for last."""
        return self._go("sit down", self._last_target(), sitting(self.robot), SIT, upright, True)

    def get_over_fall(self) -> str:
        """Wait until a damped robot lies still, then let it sit, if it is not on its side; says what came of it.

        Raises:
            LinkLostError: the robot is gone.
        """
        self.confirm_damped()
        self.loop.watch.phase("lie still", _STILL_PATIENCE)
        clock = self.connection.clock
        earliest = clock.now() + self.arming.clean_time

        def still() -> bool:
            state = self._state()
            speed = max(np.abs(state.motor_velocity).max(), np.abs(state.angular_velocity_base).max())
            return clock.now() >= earliest and bool(speed < STILL_SPEED)

        if not self.arming.keep_talking(still, _STILL_PATIENCE):
            return "it does not come to rest and stays damped"
        if np.abs(self._state().roll_pitch_yaw[:2]).max() > self.handshake.tilt_limit:
            return "it lies on its side and stays damped"
        try:
            self.arm()
        except SurefootError as error:
            return f"it stays damped: {error}"
        self.loop.target = None
        ending = self.sit_down(upright=False)
        if ending.act is Act.GO:
            ending = self.disarm()
        return "it has sat down" if ending.act is Act.GO else f"it stays damped: {ending.text}"
