"""Programs for a Go2 that use the vendor's SDKs; nothing of surefoot is imported.

    python tests/vendor_clients.py read COUNT           C++ SDK: read COUNT states, domain 0
    python tests/vendor_clients.py stand                C++ SDK: stand up, domain 0
    python tests/vendor_clients.py count DOMAIN COUNT   Python SDK: count COUNT states, check their checksums
    python tests/vendor_clients.py stand-up DOMAIN      Python SDK: release the motion service, stand up, lie down
    python tests/vendor_clients.py bad-crc DOMAIN       Python SDK: a second of commands with wrong checksums

Each prints one JSON object as its last line; before it the C++ SDK prints a line for each wrong checksum.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

PERIOD = 0.002
FOLDED, STANDING = [0.0, 1.36, -2.65] * 4, [0.0, 0.67, -1.3] * 4
LYING = [-0.35, 1.36, -2.65, 0.35, 1.36, -2.65, -0.5, 1.36, -2.65, 0.5, 1.36, -2.65]
KP, KD = 60.0, 5.0
STAND_UP = [(1.0, FOLDED), (1.0, STANDING), (2.0, STANDING), (1.8, LYING)]
"""Poses of the vendor's example, go2_stand_example, and the time to each [s]."""


def wait(condition: Callable[[], Any], seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise SystemExit("nothing came")
        time.sleep(0.001)


def follow(
    first: list[float], path: list[tuple[float, list[float]]], send: Callable[[list[float]], None]
) -> list[float]:
    """Send poses at 500 Hz, interpolated linearly between the poses of a path; return the sending times."""
    due, sent = time.monotonic(), []
    for duration, last in path:
        steps = round(duration / PERIOD)
        for step in range(steps):
            share = (step + 1) / steps
            send([a + (b - a) * share for a, b in zip(first, last, strict=True)])
            sent.append(time.monotonic())
            due += PERIOD
            time.sleep(max(due - time.monotonic(), 0.0))
        first = last
    return sent


def _cpp() -> Any:
    import unitree_interface

    return unitree_interface.create_robot("lo", unitree_interface.RobotType.GO2, unitree_interface.MessageType.GO2)


def _be_punctual() -> None:
    """Set a real-time priority, since states that arrive while this program does not run would not be counted."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


def read(count: int) -> dict[str, Any]:
    """Read states until `count` different ones have arrived; because of noise all states differ."""
    _be_punctual()  # the SDK keeps the last state only
    robot = _cpp()
    wait(lambda: any(robot.read_low_state().motor.q))
    times, before = [], None
    end = time.monotonic() + count * PERIOD * 1.5 + 5
    while len(times) < count and time.monotonic() < end:
        state = robot.read_low_state()
        if (seen := tuple(state.motor.dq)) != before:
            times.append(time.monotonic())
            before = seen
        time.sleep(0.0002)
    gaps = sorted(b - a for a, b in itertools.pairwise(times))
    return {
        "states": len(times),
        "seconds": times[-1] - times[0],
        "hz": (len(times) - 1) / (times[-1] - times[0]),
        "gap_ms": {
            "median": 1e3 * gaps[len(gaps) // 2],
            "p99": 1e3 * gaps[int(0.99 * len(gaps))],
            "max": 1e3 * gaps[-1],
        },
        "accelerometer": list(state.imu.accel),
        "temperature": list(state.motor.temperature),
    }


def stand() -> dict[str, Any]:
    """Stand up by the C++ SDK's commands, whose frames have head 0 0 and level flag 0."""
    robot = _cpp()
    wait(lambda: any(robot.read_low_state().motor.q))

    def send(pose: list[float]) -> None:
        command = robot.create_zero_command()
        command.q_target, command.kp, command.kd = pose, [KP] * 12, [KD] * 12
        robot.write_low_command(command)

    follow(list(robot.read_low_state().motor.q), STAND_UP[:2], send)
    time.sleep(0.5)
    return {"q": list(robot.read_low_state().motor.q)}


class PythonSdk:
    """States and commands with the vendor's Python classes."""

    def __init__(self, domain: int) -> None:
        from unitree_sdk2py.core.channel import ChannelFactoryInitialize, ChannelPublisher, ChannelSubscriber
        from unitree_sdk2py.idl.default import unitree_go_msg_dds__LowCmd_
        from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_
        from unitree_sdk2py.utils.crc import CRC

        ChannelFactoryInitialize(domain, "lo")
        self.crc, self.state, self.damaged = CRC(), None, 0
        self.seen: list[tuple[float, int]] = []
        """Time [s] and tick [ms] of each state."""
        self.command = unitree_go_msg_dds__LowCmd_()
        self.command.head, self.command.level_flag = [0xFE, 0xEF], 0xFF
        for motor in self.command.motor_cmd:
            motor.mode, motor.q, motor.dq = 1, 2.146e9, 16000.0
        self._publisher = ChannelPublisher("rt/lowcmd", LowCmd_)
        self._publisher.Init()
        self._subscriber = ChannelSubscriber("rt/lowstate", LowState_)
        self._subscriber.Init(self._receive, 10)
        wait(lambda: self.state)

    def _receive(self, state: Any) -> None:
        self.state = state
        self.seen.append((time.monotonic(), state.tick))
        self.damaged += state.crc != self.crc.Crc(state)

    def angles(self) -> list[float]:
        return [motor.q for motor in self.state.motor_state[:12]]

    def send(self, pose: list[float], error: int = 0) -> None:
        for motor, angle in zip(self.command.motor_cmd, pose, strict=False):
            motor.q, motor.dq, motor.kp, motor.kd = angle, 0.0, KP, KD
        self.command.crc = self.crc.Crc(self.command) ^ error
        self._publisher.Write(self.command)


def count(domain: int, number: int) -> dict[str, Any]:
    """Count states with a callback, which the Python SDK calls for each state."""
    _be_punctual()
    sdk = PythonSdk(domain)
    begun = len(sdk.seen)
    wait(lambda: len(sdk.seen) >= begun + number, number * PERIOD * 1.5 + 5)
    seen = sdk.seen[begun : begun + number]
    (first, first_tick), (last, last_tick) = seen[0], seen[-1]
    return {
        "states": len(seen),
        "hz": (len(seen) - 1) / (last - first),
        "missing": (last_tick - first_tick) // round(1e3 * PERIOD) + 1 - len(seen),
        "damaged": sdk.damaged,
    }


def stand_up(domain: int) -> dict[str, Any]:
    """Run the sequence of the vendor's go2_stand_example.py: release the motion service, stand up, lie down."""
    from unitree_sdk2py.comm.motion_switcher.motion_switcher_client import MotionSwitcherClient
    from unitree_sdk2py.go2.sport.sport_client import SportClient

    sdk = PythonSdk(domain)
    sport, switcher = SportClient(), MotionSwitcherClient()
    for client in (sport, switcher):
        client.SetTimeout(5.0)
        client.Init()
    names = []
    _, mode = switcher.CheckMode()
    while mode["name"]:
        names.append(mode["name"])
        sport.StandDown()
        switcher.ReleaseMode()
        _, mode = switcher.CheckMode()
        time.sleep(1)
    sent = follow(sdk.angles(), STAND_UP, sdk.send)
    return {
        "modes": [*names, mode["name"]],
        "q": sdk.angles(),
        "commands_hz": (len(sent) - 1) / (sent[-1] - sent[0]),
        "states": len(sdk.seen),
        "damaged": sdk.damaged,
        "soc": sdk.state.bms_state.soc,
        "cells": list(sdk.state.bms_state.cell_vol[:8]),
    }


def bad_crc(domain: int) -> dict[str, Any]:
    """Command the standing pose with checksums with one wrong bit."""
    sdk = PythonSdk(domain)
    before = sdk.angles()
    follow(STANDING, [(1.0, STANDING)], lambda pose: sdk.send(pose, 1 << 7))
    return {"moved": max(abs(a - b) for a, b in zip(before, sdk.angles(), strict=True)), "sent": 500}


PROGRAMS: dict[str, Callable[..., dict[str, Any]]] = {
    "read": read,
    "stand": stand,
    "count": count,
    "stand-up": stand_up,
    "bad-crc": bad_crc,
}

if __name__ == "__main__":
    name, *numbers = sys.argv[1:]
    print(json.dumps(PROGRAMS[name](*map(int, numbers))), flush=True)
