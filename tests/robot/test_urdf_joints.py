"""Where joints are, as a URDF says it."""

from __future__ import annotations

from pathlib import Path

import pytest

from surefoot.errors import SurefootError
from surefoot.robot.urdf import read_urdf

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'


def urdf(folder: Path, joint: str) -> Path:
    path = folder / "two.urdf"
    links = "".join(f'<link name="{name}">{INERTIAL}</link>' for name in ("base", "arm"))
    path.write_text(
        f'<robot name="two">{links}<joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/>{joint}'
        "</joint></robot>"
    )
    return path


@pytest.mark.parametrize(
    ("joint", "origin"),
    [
        ('<origin xyz="0.1 -2 3e-1" rpy="0 0 0"/>', (0.1, -2.0, 0.3)),
        ('<origin rpy="1 0 0"/>', (0.0, 0.0, 0.0)),
        ("", (0.0, 0.0, 0.0)),
    ],
)
def test_a_joint_has_its_place_in_its_parents_frame(tmp_path: Path, joint: str, origin: tuple[float, float, float]):
    elbow = read_urdf(urdf(tmp_path, joint)).joints["elbow"]
    assert elbow.origin == origin
    assert (elbow.parent, elbow.child, elbow.axis) == ("base", "arm", (1.0, 0.0, 0.0))


@pytest.mark.parametrize("xyz", ["1 2", "a b c", "0 0 nan"])
def test_a_place_that_is_none_is_refused(tmp_path: Path, xyz: str):
    path = urdf(tmp_path, f'<origin xyz="{xyz}"/>')
    with pytest.raises(SurefootError, match=f"joint 'elbow': origin is '{xyz}'; it must be 3 finite numbers"):
        read_urdf(path)
