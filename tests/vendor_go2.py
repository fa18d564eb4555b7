"""Independent simulated Go2: the vendor's messages, checksums and services, and another model in plain MuJoCo.

    python tests/vendor_go2.py [--variant fitted] [--domain 3] [--record FILE.npz] [--controller]

It serves tests and benchmarks of `--link dds` and imports nothing of surefoot. It runs until its standard input ends.
Each input line is a fault that starts at once (`FAULTS`; `none` ends it), or `report`, which prints the events since
the start of the last fault as JSON. `--record` writes every received command and the start times of faults.

The model is from MuJoCo Menagerie, based on the vendor's (`vendor_go2.xml`, with its licence). `fitted` uses the
values of dim-go2-sim 0.5.1 (Apache-2.0), which were fitted to runs of a real Go2. Temperatures, battery and counters
are from a message recorded on a real Go2.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import math
import os
import select
import struct
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import Qos
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from unitree_sdk2py.core import channel
from unitree_sdk2py.go2.sport import sport_api
from unitree_sdk2py.idl import default
from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_, SportModeState_
from unitree_sdk2py.rpc.server import Server
from unitree_sdk2py.utils.crc import CRC

MODEL = Path(__file__).with_name("vendor_go2.xml")
LEGS = ("FR", "FL", "RR", "RL")
MOTORS = [f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh", "calf")]
PERIOD, PHYSICS_STEP = 0.002, 0.001
POS_STOP, VEL_STOP = 2.146e9, 16000.0
LYING, STANDING = np.tile([0.0, 1.36, -2.65], 4), np.tile([0.0, 0.67, -1.3], 4)
TORQUE_LAG = 0.0151
"""Time constant of torques in the fitted variant [s]."""
MOTOR = 4
"""Index of the motor in faults of a single motor."""
FAULTS = (
    *("late", "frozen", "damaged", "nan", "restart", "motor-off", "lost", "hot", "battery", "tilt"),
    *("stop", "stick", "controller", "writer"),
)
"""States stop, repeat, have a wrong checksum, a number that is none, ticks from 0; a motor is off, loses messages, is
hot; cells are empty; the IMU reads a roll of 1.2 rad; L2 + B; a stick; the own controller is back; another writer."""
REMOTE = struct.Struct("<2BH5f16x")
_OWN, _OTHER = 1, 2
"""Values of `reserve` in commands of the own controller and of another writer, which are not recorded."""
_RECORD = [(name, "u8") for name in ("time", "written")]
_RECORD += [(name, "f4") for name in ("kp", "kd", "x", "y", "z", "forward")]
"""Columns of the record of commands: when taken and when written [ns], on the computer's monotonic and its real-time
clock; greatest kp and least kd; the base's place [m] and forward speed [m/s] then."""


def make_model(variant: str) -> mujoco.MjModel:
    """Return the original model, or the variant fitted to a real robot."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    spec.option.timestep = PHYSICS_STEP
    if variant == "fitted":
        for motor in MOTORS:
            joint = spec.joint(f"{motor}_joint")
            joint.armature, joint.frictionloss, joint.damping = 0.00712, 0.365, [0.285, 0.0, 0.0]
        base = spec.body("base")
        base.mass *= 0.9412
        base.inertia = np.asarray(base.inertia) * 0.8601
        base.ipos = np.asarray(base.ipos) - (0.006845, 0.0, 0.0)
        for leg in LEGS:
            for part in ("thigh", "calf"):
                body = spec.body(f"{leg}_{part}")
                body.mass *= 1.616
                body.inertia = np.asarray(body.inertia) * 1.616
            spec.geom(leg).friction = [0.786, 0.006134, 0.01]
    return spec.compile()


class Body:
    """Simulated body of the robot, with servos that convert commands to torques."""

    def __init__(self, variant: str) -> None:
        self.model = make_model(variant)
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(f"{motor}_joint") for motor in MOTORS]
        self.angles = np.array([joint.qposadr[0] for joint in joints])
        self.speeds = np.array([joint.dofadr[0] for joint in joints])
        self._motors = np.array([self.model.actuator(motor).id for motor in MOTORS])
        self._limit = self.model.actuator_ctrlrange[self._motors, 1]
        self._share = PHYSICS_STEP / (TORQUE_LAG + PHYSICS_STEP) if variant == "fitted" else 1.0
        self.torque = np.zeros(12)
        self.on = np.zeros(12)
        """1 for motors that are commanded and have not failed."""
        self.q, self.dq, self.tau, self.kp, self.kd = np.zeros((5, 12))
        self.data.qpos[2], self.data.qpos[self.angles] = 0.12, LYING
        for _ in range(1000):
            mujoco.mj_step(self.model, self.data)

    def command(self, motors: list[Any]) -> None:
        """Apply the commands of the first twelve slots."""
        rows = np.array([(m.mode, m.q, m.dq, m.tau, m.kp, m.kd) for m in motors[:12]])
        self.on = (rows[:, 0] == 1).astype(float)
        self.q, self.dq, self.tau, self.kp, self.kd = rows[:, 1:].T.copy()
        self.kp[self.q >= POS_STOP] = 0.0
        self.kd[self.dq >= VEL_STOP] = 0.0

    def step(self, failed: int | None = None) -> None:
        """Advance by the period of states; the motor `failed` produces no torque."""
        data = self.data
        on = self.on.copy()
        if failed is not None:
            on[failed] = 0.0
        for _ in range(round(PERIOD / PHYSICS_STEP)):
            wanted = (
                self.tau + self.kp * (self.q - data.qpos[self.angles]) + self.kd * (self.dq - data.qvel[self.speeds])
            )
            self.torque += self._share * (on * np.clip(wanted, -self._limit, self._limit) - self.torque)
            data.ctrl[self._motors] = self.torque
            mujoco.mj_step(self.model, data)

    def forward_speed(self) -> float:
        """Return the base's speed along its own x axis [m/s]."""
        return float(self.data.body("base").xmat.reshape(3, 3)[:, 0] @ self.data.qvel[:3])

    def specific_force(self) -> np.ndarray:
        """Return the reading of an accelerometer [m/s²]."""
        rotation = self.data.body("base").xmat.reshape(3, 3)
        return rotation.T @ (self.data.qacc[:3] - self.model.opt.gravity)


class Service(Server):
    """Vendor's service whose calls are methods of the robot."""

    def __init__(self, name: str, calls: dict[int, Any]) -> None:
        super().__init__(name)
        self._SetApiVersion("1.0.0.1")
        for number, handler in calls.items():
            self._RegistHandler(number, handler, False)
        self.Start()


class Robot:
    """Robot on the DDS bus."""

    def __init__(self, variant: str, controller: bool) -> None:
        self.body, self.crc = Body(variant), CRC()
        participant = channel.ChannelFactory._ChannelFactory__participant
        qos = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(1))
        self._states, self._sport, self._commands = (
            DataWriter(participant, Topic(participant, name, kind), qos)
            for name, kind in (
                ("rt/lowstate", LowState_),
                ("rt/sportmodestate", SportModeState_),
                ("rt/lowcmd", LowCmd_),
            )
        )
        topic = Topic(participant, "rt/lowcmd", LowCmd_)
        self._reader = DataReader(participant, topic, Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(64)))
        self.state: LowState_ = default.unitree_go_msg_dds__LowState_()
        self._set_constants()
        self._sport_bytes = default.unitree_go_msg_dds__SportModeState_().serialize()
        self._last_bytes, self._last_sender, self._last_gains = b"", 0, (0.0, 0.0)
        self.bad = 0
        self.fault, self._fault_end = "none", 0
        self.faults: list[tuple[int, str]] = []
        self.rows: list[tuple[Any, ...]] = []
        self._tick0 = self._cycle = 0
        self._old = b""
        self.controller = controller
        """Whether the robot's own controller is active."""
        self._pose, self._goal = (STANDING, STANDING) if controller else (LYING, LYING)
        if controller:
            self.body.data.qpos[2], self.body.data.qpos[self.body.angles] = 0.33, STANDING
        self._own_bytes = self._command(self._pose, _OWN)
        self._other_bytes = self._command(LYING, _OTHER)

    def serve(self) -> None:
        """Start the services: the motion switcher and the robot's own controller."""
        ok = (0, "")

        def select(parameter: str) -> tuple[int, str]:
            if json.loads(parameter).get("name") != "mcf":
                return 3204, ""
            self.controller, self._pose = True, self.body.data.qpos[self.body.angles].copy()
            return ok

        def release(_: str) -> tuple[int, str]:
            self.controller = False
            return ok

        def go_to(pose: np.ndarray) -> Any:
            def call(_: str) -> tuple[int, str]:
                self._goal = pose
                return ok

            return call

        def check(_: str) -> tuple[int, str]:
            return 0, json.dumps({"form": "0", "name": "mcf" if self.controller else ""})

        Service("motion_switcher", {1001: check, 1002: select, 1003: release})
        sport = {sport_api.SPORT_API_ID_STANDUP: STANDING, sport_api.SPORT_API_ID_STANDDOWN: LYING}
        Service("sport", {number: go_to(pose) for number, pose in sport.items()})

    def _command(self, pose: np.ndarray, sender: int) -> bytes:
        command: LowCmd_ = default.unitree_go_msg_dds__LowCmd_()
        command.head, command.level_flag, command.reserve = [0xFE, 0xEF], 0xFF, sender
        for motor, angle in zip(command.motor_cmd, pose, strict=False):
            motor.mode, motor.q, motor.kp, motor.kd = 1, float(angle), 60.0, 5.0
        command.crc = self.crc.Crc(command)
        return _whole(command.serialize())

    def _set_constants(self) -> None:
        state = self.state
        state.head = [0xFE, 0xEF]
        for motor in state.motor_state[:12]:
            motor.mode, motor.temperature, motor.lost, motor.reserve = 1, 38, 7, [0, 525]
        state.imu_state.temperature = 79
        state.bms_state.soc, state.bms_state.cell_vol = 63, [3690] * 8 + [0] * 7
        state.power_v, state.power_a = 29.5, 1.2

    def begin(self, fault: str) -> None:
        """Start a fault, `NAME` or `NAME=VALUE`; `none` ends it."""
        name, _, value = fault.partition("=")
        if name != "none" and name not in FAULTS:
            raise SystemExit(f"'{name}' is no fault; it must be one of {', '.join(FAULTS)}, none")
        now = time.monotonic_ns()
        self.fault, self._fault_end = name, now + int(1e9 * float(value or "inf")) if value else 2**63
        self.faults.append((now, name))
        self._set_constants()
        self.state.wireless_remote = [0] * 40
        self.controller = self.controller and name != "none"
        state, motor = self.state, self.state.motor_state[MOTOR]
        if name == "motor-off":
            motor.mode = 0
        elif name == "hot":
            motor.temperature = 95
        elif name == "battery":
            state.bms_state.cell_vol, state.power_v, state.bms_state.soc = [2700] * 8 + [0] * 7, 21.6, 1
        elif name == "stop":
            state.wireless_remote = list(REMOTE.pack(0, 0, 1 << 5 | 1 << 9, 0.0, 0.0, 0.0, 0.0, 0.0))
        elif name == "stick":
            state.wireless_remote = list(REMOTE.pack(0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.8))
        elif name == "restart":
            self._tick0 = self._cycle
        elif name == "controller":
            self.controller, self._pose = True, self.body.data.qpos[self.body.angles].copy()
            self._goal = self._pose

    def report(self) -> dict[str, Any]:
        """Return the delay of permanent damping after the start of the last fault [ms], and the events since then."""
        begun, name = self.faults[-1]
        rows = np.array(self.rows, _RECORD)
        rows = rows[rows["time"] >= begun]
        active = np.flatnonzero(rows["kp"] > 0)
        rest = rows[active[-1] + 1 :] if len(active) else rows
        damping = rest["time"][(rest["kp"] == 0) & (rest["kd"] > 0)]
        damped = (int(damping[0]) - begun) / 1e6 if len(damping) else None
        return {"fault": name, "damped_ms": damped, "damping": len(damping), "others": len(rest) - len(damping)}

    def take_commands(self) -> None:
        """Apply the newest command with a valid checksum; record commands unless they are from the robot itself."""
        taken = ddspy_take(self._reader._ref, 64)
        if isinstance(taken, int):
            return
        now = time.monotonic_ns()
        place = (*self.body.data.qpos[:3], self.body.forward_speed())
        for data, info in taken:
            if not info.valid_data:
                continue
            if data != self._last_bytes:
                command = LowCmd_.deserialize(data)
                if command.crc != self.crc.Crc(command):
                    self.bad += 1
                    continue
                self._last_bytes, self._last_sender = data, command.reserve
                self.body.command(command.motor_cmd)
                self._last_gains = float(self.body.kp.max()), float(self.body.kd.min())
            if self._last_sender not in (_OWN, _OTHER):
                self.rows.append((now, info.source_timestamp, *self._last_gains, *place))

    def cycle(self) -> None:
        """Run one period: apply commands, simulate, write the state."""
        self._cycle += 1
        self.take_commands()
        self.body.step(MOTOR if self.fault == "motor-off" else None)
        if self.fault != "none" and time.monotonic_ns() > self._fault_end:
            self.begin("none")
        if self.controller:
            ddspy_write(self._sport._ref, _whole(self._sport_bytes))
            ddspy_write(self._commands._ref, self._own_bytes)
            if self._cycle % 5 == 0 and not np.array_equal(self._pose, self._goal):
                self._pose = self._pose + np.clip(self._goal - self._pose, -0.01, 0.01)
                self._own_bytes = self._command(self._pose, _OWN)
        if self.fault == "writer":
            ddspy_write(self._commands._ref, self._other_bytes)
        if self.fault == "late":
            return
        if not (self.fault == "frozen" and self._old):
            self._old = self._pack()
        data = self._old
        if self.fault == "damaged":
            data = data[:200] + bytes((data[200] ^ 4,)) + data[201:]
        ddspy_write(self._states._ref, data)

    def _pack(self) -> bytes:
        state, data = self.state, self.body.data
        if self.fault == "lost":
            state.motor_state[MOTOR].lost += 1
        q, dq = data.qpos[self.body.angles].tolist(), data.qvel[self.body.speeds].tolist()
        for motor, angle, speed, torque in zip(state.motor_state, q, dq, self.body.torque.tolist(), strict=False):
            motor.q, motor.dq, motor.tau_est = angle, speed, torque
        imu = state.imu_state
        w, x, y, z = imu.quaternion = data.qpos[3:7].tolist() if self.fault != "tilt" else [0.8253, 0.5646, 0.0, 0.0]
        imu.rpy = [
            math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
            math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
        imu.gyroscope = data.qvel[3:6].tolist() if self.fault != "nan" else [math.nan, 0.0, 0.0]
        imu.accelerometer = self.body.specific_force().tolist()
        state.tick = 2 * (self._cycle - self._tick0)
        state.crc = self.crc.Crc(state)
        return _whole(state.serialize())


def _whole(data: bytes) -> bytes:
    """Pad bytes to a multiple of four, as required by the raw writer."""
    return data + bytes(-len(data) % 4)


def run(robot: Robot) -> dict[str, Any]:
    """Run until standard input ends; return statistics of the robot's rate."""
    gc.collect()
    gc.disable()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
    begun, used, worst, cycles, skipped, text = time.monotonic(), time.process_time(), 0.0, 0, 0, ""
    due = begun
    while True:
        due += PERIOD
        if (left := due - time.monotonic()) > 0:
            time.sleep(left)
        late = time.monotonic() - due
        worst = max(worst, late)
        if late > 0.05:  # the computer was suspended or overloaded: lost time is not caught up
            skipped, due = skipped + 1, due + late
        robot.cycle()
        cycles += 1
        if select.select([sys.stdin], [], [], 0.0)[0]:
            data = os.read(0, 4096).decode()
            if not data:
                break
            *lines, text = (text + data).split("\n")
            for line in lines:
                if line == "report":
                    print(json.dumps(robot.report()), flush=True)
                else:
                    robot.begin(line)
    seconds = time.monotonic() - begun
    return {
        "rate": cycles / seconds,
        "late_max_ms": 1e3 * worst,
        "skipped": skipped,
        "load": (time.process_time() - used) / seconds,
        "bad_crc": robot.bad,
    }


def main() -> None:
    """Emulate the robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", choices=("vendor", "fitted"), default="vendor")
    parser.add_argument("--interface", default="lo")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--controller", action="store_true", help="the robot's own controller is active")
    parser.add_argument("--record", type=Path, help="file (.npz) for commands and faults")
    options = parser.parse_args()
    # The vendor's configuration writes a log into /tmp, which several robots would share.
    channel.ChannelConfigHasInterface = channel.ChannelConfigHasInterface.replace("config</Verb", "none</Verb").replace(
        "/tmp/cdds.LOG", os.devnull
    )
    with contextlib.redirect_stdout(sys.stderr):
        channel.ChannelFactoryInitialize(options.domain, options.interface)
        robot = Robot(options.variant, options.controller)
        robot.serve()
    print("robot is ready", flush=True)
    figures = run(robot)
    print(json.dumps(figures), flush=True)
    if options.record is not None:
        faults = np.array(robot.faults, [("time", "u8"), ("name", "U16")])
        np.savez(options.record, commands=np.array(robot.rows, _RECORD), faults=faults)
    os._exit(0)  # the vendor's threads never end


if __name__ == "__main__":
    main()
