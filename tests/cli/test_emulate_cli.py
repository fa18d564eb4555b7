"""`surefoot emulate`: its parameters, files, summary and faults."""

from __future__ import annotations

import re

import numpy as np
import pytest
from processes import surefoot

pytest.importorskip("mujoco")

from surefoot.cli import emulate
from surefoot.emulator.fault_table import FAULTS
from surefoot.robot.params_file import read_params


def test_the_faults_are_listed():
    lines = surefoot("emulate", "--fault", "help").stdout.splitlines()
    assert [re.split("[=:@]", line)[0] for line in lines] == list(FAULTS)


def test_emulate_runs_for_a_duration_and_prints_a_summary(tmp_path):
    file = tmp_path / "seen.csv"
    done = surefoot("emulate", "--duration", "0.1", "--out", file, "--rack")
    assert done.returncode == 0
    assert re.fullmatch(r"robot on /dev/pts/\d+\n", done.stdout)
    summary = r"surefoot: 0\.1\d* s of robot time in 0\.\d s; \d+ % of a processor; "
    assert re.match(summary, done.stderr.splitlines()[-1])
    assert len(file.read_text().splitlines()) == 21


def test_hidden_parameters_are_written_only_to_the_file(robot, tmp_path):
    file = tmp_path / "hidden.toml"
    done = surefoot("emulate", "--hidden-seed", "5", "--out", file, "--duration", "0.01")
    assert done.returncode == 0
    file_params = read_params(file, robot)
    assert file_params.tables["origin"] == {"hidden_seed": 5}
    assert 14.0 <= file_params.params.voltage[0] <= 16.8
    assert f"{file_params.params.voltage[0]:.2f}" not in done.stdout + done.stderr
    # The file reproduces the same robot.
    assert surefoot("emulate", "--params", file, "--set", "voltage=15.5", "--duration", "0.01").returncode == 0


def test_parameters_are_set_by_a_file_and_by_options(robot, tmp_path):
    file = tmp_path / "p.toml"
    file.write_text("[params]\nmotor_strength = 0.9\nvoltage = 15\n")
    command = emulate.EmulateCommand(params=file, settings=(("voltage=14.5", "servo_kp=0.9"),))
    params = emulate._params(command, robot)
    assert (params.voltage[0], params.servo_kp[0].tolist()) == (14.5, [0.9] * 8)
    np.testing.assert_array_equal(params.motor_strength, np.full((1, 8), 0.9))


def test_the_viewer_draws_the_robot_at_its_position(robot):
    from surefoot.cli.helpers.viewer import pose_of

    drawn = pose_of(robot, [1.0, 2.0, 0.3, 1.0, 0.0, 0.0, 0.0, *robot.resting_angles])
    np.testing.assert_allclose(drawn[robot.base][0, :3, 3], [1.0, 2.0, 0.3])
    assert len(drawn) == len(robot.urdf.links)
