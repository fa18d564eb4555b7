"""Shared by benchmarks: emulated robots in separate processes, and policies deployed on them in lockstep."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np

from surefoot.api.policies import find_policy, open_policy
from surefoot.studies.robot_identification import SUREFOOT_COMMAND, emulated_robot
from surefoot.task.trace import EpisodeTrace


def gain_options(policy: str) -> tuple[str, ...]:
    """Return options of `surefoot emulate` for a policy's servo gains; empty if they equal the data sheet's."""
    runtime, robot = open_policy(find_policy(policy))
    gains = {"servo_kp": runtime.contract.servo_kp, "servo_kd": runtime.contract.servo_kd}
    sheet = {"servo_kp": robot.actuator.kp, "servo_kd": robot.actuator.kd}
    if all(np.allclose(gains[name], sheet[name]) for name in gains):
        return ()
    return ("--set", *(f"{name}={float(np.mean(value))}" for name, value in gains.items()))


def deploy(policy: str, *options: object, robot: tuple[object, ...] = ()) -> list[EpisodeTrace]:
    """Return the runs of `surefoot deploy` on an emulated robot, with positions from motion capture.

    Args:
        policy: name or file of the policy.
        options: options of `surefoot deploy`.
        robot: options of `surefoot emulate`.
    """
    with tempfile.TemporaryDirectory() as folder:
        capture = f"{folder}/capture.csv"
        with emulated_robot(*robot, *gain_options(policy), "--out", capture) as port:
            words = ["--port", port, "--lockstep", "--motion-capture", capture, "--out", folder, *map(str, options)]
            done = subprocess.run(
                [*SUREFOOT_COMMAND, "deploy", policy, *words], capture_output=True, text=True, check=False
            )
        runs = sorted(Path(folder).glob("run_*.npz"))
        if not runs:
            raise SystemExit(f"deploy {policy}: {done.stderr.strip()}")
        return [EpisodeTrace.load(run) for run in runs]
