"""`surefoot emulate`: what it takes, and what it says when that does not fit."""

from __future__ import annotations

import re

import numpy as np
import pytest
from processes import refused, surefoot

pytest.importorskip("mujoco")

from surefoot.api.extras import install_command
from surefoot.cli import emulate
from surefoot.emulator.fault_table import FAULTS
from surefoot.robot.params_file import read_params

DDS = ["--link", "dds", "--interface", "lo"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--world", "gazebo"], "world 'gazebo' does not exist; choices: mujoco, bullet"),
        (["--robot", "cat"], "robot 'cat': no such robot"),
        (["--fault", "melt"], "'melt' is no fault; choices: corrupt, drop"),
        (["--fault", "drop=0.1", "--fault", "drop"], "fault drop is given twice"),
        (["--lockstep", "--fault", "overload"], "it does not go with --lockstep"),
        (["--terrain", "stairs:9"], "terrain stairs: size is 9 m; it must be 0.01 to 0.4"),
        (["--rack", "--fault", "tilt"], "it does not go with --rack"),
        (["--fault", "slow-servo=0.0025"], "fault slow-servo is 0.0025; it must be whole servo steps of 0.001 s"),
        (["--link", "dds"], "link dds needs the network interface of the topics; give --interface, such as lo"),
        (["--link", "tcp"], "dds"),
        (
            ["--interface", "lo"],
            "motion_service are those of a link over DDS; give --link dds too",
        ),
        ([*DDS, "--domain", "233"], "domain is 233; it must be 232 or less"),
        ([*DDS, "--lockstep"], "lockstep is about the serial link; it does not go with --link dds"),
        (
            [*DDS, "--fault", "garbage"],
            "fault garbage acts on bytes between messages; --link dds does not have that, give --link serial",
        ),
        (
            ["--fault", "remote-stop"],
            "fault remote-stop acts on the remote control; --link serial does not have that, give --link dds",
        ),
        (DDS, "link dds is that of a Unitree Go2; robot minitaur has other motors, give --robot go2"),
        (["--duration", "0"], "duration is 0; it must be over 0"),
        (["--baud", "-1"], "baud is -1; it must be 0 or more"),
        (["--baud", "300"], "baud is 300; it must be 9600 or more, or 0"),
        (["--hidden-seed", "-1"], "hidden_seed is -1; it must be 0 or more"),
        (["--out", "x.toml"], "out x.toml is for hidden parameters; give --hidden-seed too"),
        (["--hidden-seed", "1", "--set", "voltage=15"], "does not go with --params and --set"),
        (["--out", "x.txt"], "out x.txt: the name must end in .csv or .toml, with one file of each"),
        (["--out", "x.csv", "y.csv"], "out y.csv: the name must end in"),
        (["--set", "voltage=99"], "voltage is 99; minitaur allows 5 to 30"),
        (["--params", "missing.toml"], "missing.toml: can't be read: No such file"),
    ],
)
def test_emulate_reports_invalid_options_in_one_line(tmp_path, words, message):
    refused(surefoot("emulate", *words, cwd=tmp_path), message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("option", "name"), [("--out", "a.csv"), ("--out", "a.toml"), ("--symlink", "a")])
def test_emulate_refuses_to_overwrite_files(tmp_path, option, name):
    file = tmp_path / name
    file.write_text("mine")
    words = (option, file, "--hidden-seed", "1", "--duration", "0.01")
    refused(surefoot("emulate", *words), "exists; give another name")
    assert file.read_text() == "mine"


def test_emulate_refuses_a_viewer_without_a_display():
    refused(surefoot("emulate", "--viewer"), "viewer: there is no display here")


def test_emulate_reports_a_missing_engine_before_it_starts(monkeypatch):
    monkeypatch.setattr("surefoot.world.registry.find_spec", lambda name: None)
    refused(surefoot("emulate", "--world", "bullet"), install_command("bullet"))


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


def test_hidden_parameters_go_to_the_file_alone(robot, tmp_path):
    file = tmp_path / "hidden.toml"
    done = surefoot("emulate", "--hidden-seed", "5", "--out", file, "--duration", "0.01")
    assert done.returncode == 0
    file_params = read_params(file, robot)
    assert file_params.tables["origin"] == {"hidden_seed": 5}
    assert 14.0 <= file_params.params.voltage[0] <= 16.8
    assert f"{file_params.params.voltage[0]:.2f}" not in done.stdout + done.stderr
    # The file makes the same robot.
    assert surefoot("emulate", "--params", file, "--set", "voltage=15.5", "--duration", "0.01").returncode == 0


def test_parameters_come_from_a_file_and_from_words(robot, tmp_path):
    file = tmp_path / "p.toml"
    file.write_text("[params]\nmotor_strength = 0.9\nvoltage = 15\n")
    command = emulate.EmulateCommand(params=file, settings=(("voltage=14.5", "servo_kp=0.9"),))
    params = emulate._params(command, robot)
    assert (params.voltage[0], params.servo_kp[0].tolist()) == (14.5, [0.9] * 8)
    np.testing.assert_array_equal(params.motor_strength, np.full((1, 8), 0.9))


def test_what_the_viewer_draws_is_where_the_robot_is(robot):
    from surefoot.cli.helpers.viewer import pose_of

    drawn = pose_of(robot, [1.0, 2.0, 0.3, 1.0, 0.0, 0.0, 0.0, *robot.resting_angles])
    np.testing.assert_allclose(drawn[robot.base][0, :3, 3], [1.0, 2.0, 0.3])
    assert len(drawn) == len(robot.urdf.links)
