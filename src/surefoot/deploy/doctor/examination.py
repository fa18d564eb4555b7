"""The doctor: every check of a policy, a link and a robot, in the order in which they may be done."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from surefoot.deploy.checks import check_contract
from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.doctor import computer, ground, rack
from surefoot.deploy.doctor.link import PINGS, check_link, measure_link
from surefoot.deploy.doctor.rest import check_rest, watch
from surefoot.deploy.findings import Finding, undone
from surefoot.deploy.link import LinkLostError
from surefoot.deploy.realtime import undisturbed
from surefoot.deploy.safety import SafetyLimits
from surefoot.errors import SurefootError, choices
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

PATIENCE = 5
"""How often a robot that is not at rest is looked at, for a second each time."""
_ON_RACK = "hang the robot free, legs in the air, and run with --rack"
_ON_GROUND = "put the robot on flat ground and run with --ground"
Motion = Callable[[StopSignals], list[Finding]]


def examine(
    connection: RobotConnection,
    policy: PolicyRuntime,
    robot: RobotDescription,
    on_rack: bool = False,
    on_ground: bool = False,
    pings: int = PINGS,
    steps: int = computer.STEPS,
) -> Iterator[Finding]:
    """Do all checks, one after another; nothing moves unless everything before it passed.

    Args:
        connection: to the robot, not greeted yet.
        policy: the policy.
        robot: the data sheet that it is for.
        on_rack: wiggle the motors: the robot hangs free, its legs in the air.
        on_ground: stand up and tilt: the robot sits on flat ground.
        pings: of the link's check.
        steps: of the control loop's check, and inferences.

    Raises:
        SurefootError: no robot, or one that does not answer or arm.
    """
    contract = policy.contract
    failed: list[str] = []

    def kept(findings: list[Finding]) -> list[Finding]:
        failed.extend(finding.name for finding in findings if finding.passed is False)
        return findings

    try:
        handshake = connection.connect()
        yield from kept(check_contract(contract, handshake, robot, policy.digest))
        figures = measure_link(connection, pings)
        yield from kept(check_link(figures, connection.lead, contract.control_step, connection.lockstep))
        for _ in range(PATIENCE):
            # A robot that was just put down, or switched on, is given some time to come to rest.
            samples = watch(connection)
            at_rest = check_rest(samples, robot, handshake, SafetyLimits())
            if all(finding.passed for finding in at_rest):
                break
        yield from kept(at_rest)
        if connection.lockstep:
            why = "in lockstep nothing depends on how fast this computer is"
            yield from undone(computer.NAMES, why, "run without --lockstep")
        else:
            inference = computer.time_inference(policy, steps)
            late, missed = computer.time_loop(policy, connection, steps)
            yield from kept(computer.check_computer(inference, late, missed, contract.control_step))
        motions: tuple[tuple[bool, tuple[str, ...], str, Motion], ...] = (
            (on_rack, rack.NAMES, _ON_RACK, lambda operator: rack.wiggle_motors(connection, contract, robot, operator)),
            (
                on_ground,
                ground.NAMES,
                _ON_GROUND,
                lambda operator: ground.tilt_robot(connection, contract, robot, operator, samples),
            ),
        )
        for wanted, names, need, motion in motions:
            if not wanted:
                yield from undone(names, "needs motors that move", need)
            elif failed:
                yield from undone(names, f"nothing moves while a check fails ({choices(failed)})")
            else:
                yield from _move(motion, names)
    except LinkLostError as error:
        todo = "check plug and cable; the robot damps its motors by itself"
        yield Finding("link", False, f"{error}; all further checks are left out", todo)


def _move(motion: Motion, names: tuple[str, ...]) -> list[Finding]:
    with undisturbed(), StopSignals() as operator:
        try:
            return motion(operator)
        except SurefootError as error:
            first = Finding(names[0], False, str(error), "switch the robot off and on, and run it again")
            return [first, *undone(names[1:], "nothing has moved")]
