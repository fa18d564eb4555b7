"""The doctor: every check of a policy, a link and a robot, in the order in which they may be done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surefoot.deploy.checks import check_contract
from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.doctor.computer import NAMES as COMPUTER
from surefoot.deploy.doctor.computer import STEPS, check_computer, time_inference, time_loop
from surefoot.deploy.doctor.ground import NAMES as GROUND
from surefoot.deploy.doctor.ground import tilt_robot
from surefoot.deploy.doctor.link import PINGS, check_link, measure_link
from surefoot.deploy.doctor.rack import wiggle_motors
from surefoot.deploy.doctor.rest import Sample, check_rest, watch
from surefoot.deploy.findings import Finding
from surefoot.deploy.link import LinkLostError
from surefoot.deploy.realtime import undisturbed
from surefoot.deploy.safety_limits import SafetyLimits
from surefoot.errors import SurefootError, choices
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

RACK = ("motors, one by one", "control latency", "servo response")
PATIENCE = 5
"""How often a robot that is not at rest is looked at, for a second each time."""
_ON_RACK = "hang the robot free, legs in the air, and run with --rack"
_ON_GROUND = "put the robot on flat ground and run with --ground"
Motion = Callable[[StopSignals], list[Finding]]


@dataclass(frozen=True)
class Examination:
    """What is to be looked at."""

    rack: bool = False
    """Wiggle the motors: the robot hangs free, its legs in the air."""
    ground: bool = False
    """Stand up and tilt: the robot sits on flat ground."""
    pings: int = PINGS
    """Pings of the link's check."""
    steps: int = STEPS
    """Steps of the control loop's check, and inferences."""


def examine(
    connection: RobotConnection,
    policy: PolicyRuntime,
    robot: RobotDescription,
    what: Examination,
    tell: Callable[[Finding], None],
) -> list[Finding]:
    """Do all checks; nothing moves unless everything before it passed.

    Args:
        connection: to the robot, not greeted yet.
        policy: the policy.
        robot: the data sheet that it is for.
        what: which checks.
        tell: called with each finding when it is there.

    Raises:
        SurefootError: no robot, or one that does not answer or arm.
    """
    found: list[Finding] = []

    def add(findings: list[Finding]) -> None:
        for finding in findings:
            found.append(finding)
            tell(finding)

    try:
        _look(connection, policy, robot, what, found, add)
    except LinkLostError as error:
        todo = "check plug and cable; the robot damps its motors by itself"
        add([Finding("link", False, f"{error}; all further checks are left out", todo)])
    return found


def _look(
    connection: RobotConnection,
    policy: PolicyRuntime,
    robot: RobotDescription,
    what: Examination,
    found: list[Finding],
    add: Callable[[list[Finding]], None],
) -> None:
    contract, limits = policy.contract, SafetyLimits()
    handshake = connection.connect()
    add(check_contract(contract, handshake, robot, policy.digest))
    figures = measure_link(connection, what.pings)
    add(check_link(figures, connection.lead, contract.control_step, connection.lockstep))
    for _ in range(PATIENCE):
        # A robot that was just put down, or switched on, is given some time to come to rest.
        samples = watch(connection)
        at_rest = check_rest(samples, robot, handshake, limits)
        if all(finding.passed for finding in at_rest):
            break
    add(at_rest)
    if connection.lockstep:
        why = "in lockstep nothing depends on how fast this computer is"
        add([Finding(name, None, why, "run without --lockstep") for name in COMPUTER])
    else:
        inference = time_inference(policy, what.steps)
        late, missed = time_loop(policy, connection, what.steps)
        add(check_computer(inference, late, missed, contract.control_step))
    bias = gyro_bias(samples)
    motions: tuple[tuple[bool, tuple[str, ...], str, Motion], ...] = (
        (what.rack, RACK, _ON_RACK, lambda operator: wiggle_motors(connection, contract, robot, operator)),
        (what.ground, GROUND, _ON_GROUND, lambda operator: tilt_robot(connection, contract, robot, operator, bias)),
    )
    failed = [finding.name for finding in found if finding.passed is False]
    for wanted, names, need, motion in motions:
        if not wanted:
            add([Finding(name, None, "needs motors that move", need) for name in names])
        elif failed:
            why = f"nothing moves while a check fails ({choices(failed)})"
            add([Finding(name, None, why, "mend that first") for name in names])
        else:
            add(_move(motion, names))


def _move(motion: Motion, names: tuple[str, ...]) -> list[Finding]:
    with undisturbed(), StopSignals() as operator:
        try:
            return motion(operator)
        except SurefootError as error:
            first = Finding(names[0], False, str(error), "switch the robot off and on, and run it again")
            return [first, *(Finding(name, None, "nothing has moved", "mend that first") for name in names[1:])]


def gyro_bias(samples: list[Sample]) -> np.ndarray:
    """Mean of the gyro (3,) [rad/s] over states of a robot at rest; 0 without any."""
    if not samples:
        return np.zeros(3)
    bias: np.ndarray = np.mean([sample.state.angular_velocity_base for sample in samples], axis=0)
    return bias
