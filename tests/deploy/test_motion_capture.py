"""Motion capture resampled at the rows of a trace."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.deploy.motion_capture import base_and_feet, read_capture
from surefoot.errors import SurefootError
from surefoot.rotations import quat_yaw

LEGS = ("left", "right")
HEAD = "time,x,y,z,qw,qx,qy,qz"


def rotation(yaw: float) -> list[float]:
    return [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]


@pytest.fixture
def straight(tmp_path):
    """A robot that moves at 1 m/s in the direction of 30 degrees, from (5, 7), captured at 200 Hz."""
    path, yaw = tmp_path / "capture.csv", np.pi / 6
    lines = [HEAD + ",contact_left"]
    for k in range(401):
        time = 0.005 * k
        row = [time, 5 + time * np.cos(yaw), 7 + time * np.sin(yaw), 0.2 + 0.01 * time, *rotation(yaw), k % 2]
        lines.append(",".join(map(str, row)))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_run_starts_at_the_origin_and_goes_forward(straight):
    seen = base_and_feet(read_capture(straight), 0.5, 0.006, 100, LEGS)
    position = seen["base_position_world"]
    assert position.shape == (101, 3)
    assert position[:, 0] == pytest.approx(0.006 * np.arange(101), abs=1e-12)
    assert position[:, 1] == pytest.approx(0.0, abs=1e-12)
    assert position[0, 2] == pytest.approx(0.205)
    assert seen["base_quat_world"] == pytest.approx(np.tile([1.0, 0, 0, 0], (101, 1)), abs=1e-12)


def test_feet_without_switches_have_no_contacts(straight):
    contact = base_and_feet(read_capture(straight), 0.5, 0.005, 10, LEGS)["foot_contact"]
    assert contact[:, 0] == pytest.approx([1, 0] * 5, abs=1e-9)
    assert np.isnan(contact[:, 1]).all()


def test_a_rotation_is_preserved(tmp_path):
    path = tmp_path / "capture.csv"
    lines = [HEAD] + [",".join(map(str, [0.1 * k, 0, 0, 0, *rotation(1.0 + 0.1 * k)])) for k in range(11)]
    path.write_text("\n".join(lines))
    quat = base_and_feet(read_capture(path), 0.0, 0.1, 10, LEGS)["base_quat_world"]
    assert [quat_yaw(row) for row in quat] == pytest.approx(0.1 * np.arange(11))
    assert np.linalg.norm(quat, axis=1) == pytest.approx(1.0)


def test_quaternions_of_either_sign_give_the_same_motion(tmp_path):
    path = tmp_path / "capture.csv"
    rows = [[0.1 * k, 0, 0, 0, *((-1) ** k * np.array(rotation(0.01 * k)))] for k in range(11)]
    path.write_text("\n".join([HEAD, *(",".join(map(str, row)) for row in rows)]))
    quat = base_and_feet(read_capture(path), 0.0, 0.05, 20, LEGS)["base_quat_world"]
    assert [quat_yaw(row) for row in quat] == pytest.approx(0.005 * np.arange(21), abs=1e-6)


def test_the_tilt_at_the_start_is_preserved(tmp_path):
    """A pitch of 0.2 rad and a yaw of 1 rad: after removing the yaw, only the pitch remains."""
    path = tmp_path / "capture.csv"
    w, y = np.cos(0.1), np.sin(0.1)
    c, s = np.cos(0.5), np.sin(0.5)
    quat = [c * w, -s * y, c * y, s * w]
    path.write_text("\n".join([HEAD, *(",".join(map(str, [0.1 * k, 0, 0, 0, *quat])) for k in range(3))]))
    quats = base_and_feet(read_capture(path), 0.0, 0.1, 1, LEGS)["base_quat_world"]
    assert quats[0] == pytest.approx([w, 0.0, y, 0.0])


def test_an_incomplete_last_line_is_skipped(straight):
    rows = len(read_capture(straight)["time"])
    with straight.open("a") as file:
        file.write("2.005,5.0,7")
    assert len(read_capture(straight)["time"]) == rows


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "has no column time; it needs time, x, y, z"),
        ("time,x,y\n1,2,3\n", "has no column z"),
        (HEAD + "\n0,0,0,0,1,0,0,0\n", "has 1 complete rows; it needs 2 or more"),
        (HEAD + "\n0,0,0,nan,1,0,0,0\n1,a,0,0,1,0,0,0\n", "has 0 complete rows"),
    ],
)
def test_a_file_without_the_columns_or_two_rows_is_rejected(text, match, tmp_path):
    path = tmp_path / "capture.csv"
    path.write_text(text)
    with pytest.raises(SurefootError, match=match):
        read_capture(path)


def test_a_missing_file_is_rejected(tmp_path):
    with pytest.raises(SurefootError, match="can't be read: No such file"):
        read_capture(tmp_path / "none.csv")


@pytest.mark.parametrize("start", [-0.2, 1.8])
def test_a_file_that_does_not_cover_the_run_is_rejected(start, straight):
    with pytest.raises(SurefootError, match=r"covers 0.000 to 2.000 s on the robot's clock; the run lasted from"):
        base_and_feet(read_capture(straight), start, 0.006, 100, LEGS)


def test_a_gap_within_the_run_is_rejected(straight):
    capture = read_capture(straight)
    seen = (capture["time"] < 0.7) | (capture["time"] > 0.9)
    capture = {name: values[seen] for name, values in capture.items()}
    with pytest.raises(SurefootError, match=r"no rows from 0\.695 to 0\.905 s on the robot's clock, within the run"):
        base_and_feet(capture, 0.5, 0.006, 100, LEGS)
    base_and_feet(capture, 1.0, 0.006, 100, LEGS)  # the gap is before this run


def test_quaternions_with_a_wrong_norm_are_rejected(tmp_path):
    path = tmp_path / "capture.csv"
    path.write_text(HEAD + "\n0,0,0,0,0,0,0,0\n1,0,0,0,0,0,0,0\n")
    with pytest.raises(SurefootError, match="its quaternions are not of length 1"):
        base_and_feet(read_capture(path), 0.0, 0.1, 10, LEGS)
