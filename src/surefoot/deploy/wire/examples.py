"""One frame of each kind with its values, for a robot of eight motors: test vectors of the wire protocol."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.deploy.wire.frames import encode_frame
from surefoot.deploy.wire.messages import (
    Arm,
    Bye,
    Codec,
    Damp,
    Disarm,
    Fault,
    Handshake,
    Hello,
    Message,
    Mode,
    Ping,
    Pong,
    Position,
    Pwm,
    Reason,
    State,
)

MOTORS = 8


@dataclass(frozen=True)
class Example:
    """A frame; every value is one that the numbers on the line tell exactly."""

    sequence: int
    """Number of the frame."""
    time: float
    """When it was sent [s]."""
    message: Message
    """What it says."""

    def frame(self) -> bytes:
        """The bytes on the line."""
        return encode_frame(Codec(MOTORS), self.message, self.sequence, self.time)


_ANGLES = np.array([2.0, 1.5, 1.75, 2.25, 2.0, 1.625, 1.875, 2.125])
_HANDSHAKE = Handshake(
    session=4660,
    robot="minitaur",
    firmware="example 1.0",
    motor_names=tuple(f"motor_{number}" for number in range(1, MOTORS + 1)),
    motor_signs=np.array([-1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0]),
    servo_period=0.001,
    servo_kp=1.0,
    servo_kd=0.015625,
    command_period_min=0.002,
    command_period_max=0.05,
    angle_low=np.full(MOTORS, -0.5),
    angle_high=np.full(MOTORS, 3.75),
    tilt_limit=1.0,
    voltage_min=12.5,
    temperature_max=90.0,
    command_timeout=0.05,
    rearm_after=0.5,
)
_STATE = State(
    session=4660,
    mode=Mode.POSITION,
    reason=Reason.NONE,
    command=4,
    command_age=0.003,
    dropped=0,
    motor_angle=_ANGLES - 0.03125,
    motor_velocity=np.array([0.0, 1.5, -1.5, 12.25, -12.25, 0.5, -0.5, 3.0]),
    motor_torque=np.array([0.0, 0.5, -0.5, 3.5, -3.5, 0.001, -0.001, 1.234]),
    roll_pitch_yaw=np.array([0.0625, -0.125, 3.0]),
    angular_velocity_base=np.array([0.5, -0.25, 0.0]),
    energy=17.5,
    voltage=16.0,
    temperature=np.array([25.0, 26.0, 27.0, 28.0, 29.0, 30.0, 31.0, 90.0]),
)
EXAMPLES = (
    Example(1, 0.0, Hello(session=4660, state_period=0.01)),
    Example(2, 0.001, Ping(token=1)),
    Example(3, 0.5, Arm(session=4660, mode=Mode.POSITION, command_period=0.006, report_after=0.003)),
    Example(4, 0.506, Position(session=4660, target=_ANGLES)),
    Example(300, 2.25, Pwm(session=4660, duty=np.array([0.0, 0.25, -0.25, 1.0, -1.0, 0.5, -0.5, 0.125]))),
    Example(65536, 400.0, Damp(session=4660)),
    Example(65537, 401.0, Disarm(session=4660)),
    Example(4294967295, 86400.0, Bye(session=4660)),
    Example(1, 12.5, _HANDSHAKE),
    Example(2, 12.501, Pong(token=1)),
    Example(254, 13.009, _STATE),
    Example(255, 13.06, Fault(session=4660, reason=Reason.TIMEOUT, text="no command for 0.05 s")),
)
