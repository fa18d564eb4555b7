"""Malicious descriptions that crash a parser, fill memory or never end: one error line within limits, no files."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from contextlib import suppress
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from surefoot.cli.main import main
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.importing import isolated_reader, reader
from surefoot.robot.importing.copy_limits import check_copies
from surefoot.robot.importing.isolated_reader import decode, encode, read_robot
from surefoot.sandbox import Limits
from surefoot.world import urdf_probe
from surefoot.world.mujoco_model import build_model

pytestmark = pytest.mark.slow

QUICK = Limits(memory=1 << 30, time=3.0, timeout=60.0)
BODY = '<body><freejoint/><geom size=".1"/></body>'
WORLD = f"<worldbody>{BODY}</worldbody>"


def attach(file: str, times: int = 1) -> str:
    bodies = "".join(f'<body><attach model="m" prefix="p{k}"/></body>' for k in range(times))
    return f'<mujoco><asset><model name="m" file="{file}"/></asset><worldbody>{bodies}</worldbody></mujoco>'


def nested_replicates(levels: int) -> str:
    text = '<geom size=".1"/>'
    for level in range(levels):
        text = f'<replicate count="100" offset="1 0 0" sep="s{level}">{text}</replicate>'
    return f"<mujoco><worldbody>{text}</worldbody></mujoco>"


def grid(number: int) -> str:
    return f'<flexcomp name="f{number}" type="grid" count="10 10 10" spacing=".1 .1 .1" mass="1" dim="3"/>'


def mesh(attributes: str) -> str:
    asset = f'<asset><mesh name="m" {attributes}/></asset>'
    return f'<mujoco>{asset}<worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>'


LIMITED = {
    "nuser_geom": f'<mujoco><size nuser_geom="2000000000"/>{WORLD}</mujoco>',
    "flex grids": f"<mujoco><worldbody>{''.join(map(grid, range(300)))}</worldbody></mujoco>",
    "supersphere": mesh('builtin="supersphere" params="100000 1 1"'),
    "height field": (
        '<mujoco><asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>'
        '<worldbody><geom type="hfield" hfield="h"/></worldbody></mujoco>'
    ),
}
"""Models that MuJoCo expands until memory or time is exhausted."""


@pytest.mark.parametrize("text", LIMITED.values(), ids=LIMITED)
def test_expanding_models_end_within_limits(text: str, tmp_path: Path):
    path = tmp_path / "dog.xml"
    path.write_text(text)
    start = time.monotonic()
    with pytest.raises(
        SurefootError, match=r"dog\.xml: can't be read within 1 GiB and 3 s \((it ran out of time|its memory)"
    ) as error:
        read_robot(path, limits=QUICK)
    assert "\n" not in str(error.value)
    assert time.monotonic() - start < 30  # mostly the start of Python on a busy computer


def test_doubling_attachments_end_within_limits(tmp_path: Path):
    for level in range(15):
        (tmp_path / f"{level}.xml").write_text(attach(f"{level + 1}.xml", 3))
    (tmp_path / "15.xml").write_text(f"<mujoco>{WORLD}</mujoco>")
    with pytest.raises(SurefootError, match=r"can't be read within"):
        read_robot(tmp_path / "0.xml", limits=QUICK)


COPIES = {
    "nkey": ('<mujoco><size nkey="2000000000"/></mujoco>', "nkey of <size> is 2000000000;"),
    "flex grid": (
        f"<mujoco><worldbody>{grid(0).replace('10', '1000')}</worldbody></mujoco>",
        "count of <flexcomp> is 1000000000;",
    ),
    "replicate": (nested_replicates(1).replace("100", "1001"), "count of <replicate> is 1001;"),
    "nested replicates": (
        nested_replicates(12),
        "count of <replicate> is 100, or 10000 with its enclosing replicates;",
    ),
    "no number around": (
        '<mujoco><replicate count="nan"><replicate count="1001"/></replicate></mujoco>',
        "count of <replicate> is 1001;",
    ),
    "in an include": ('<mujoco><include file="copies.xml"/></mujoco>', "nkey of <size> is 1e+30;"),
}


@pytest.mark.parametrize(("text", "message"), COPIES.values(), ids=COPIES)
def test_copies_are_counted_before_parsing(text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(isolated_reader.sandbox, "run_module", None)
    (tmp_path / "dog.xml").write_text(text)
    (tmp_path / "copies.xml").write_text('<mujoco><size nkey=" 1e30 "/></mujoco>')
    with pytest.raises(SurefootError, match=rf"dog\.xml: .*{re.escape(message)} it must be 1000 or less"):
        read_robot(tmp_path / "dog.xml")


@pytest.mark.parametrize(
    "text",
    [
        '<mujoco><size nkey="1000"/></mujoco>',
        nested_replicates(1),
        '<mujoco><size nkey="-5"/><size nkey="x"/><size nkey="nan"/><size nkey=""/></mujoco>',
        '<mujoco><replicate count="100"/><replicate count="100"/></mujoco>',
    ],
)
def test_small_counts_and_non_numbers_are_left_to_the_parser(text: str):
    check_copies(ElementTree.fromstring(text), Path("dog.xml"))


@pytest.mark.timeout(30)
def test_too_many_names_and_folders_are_rejected_before_the_search(tmp_path: Path):
    folders = "".join(f'<compiler meshdir="d{k}"/>' for k in range(4000))
    files = "".join(f'<mesh name="{k}" file="{k}"/>' for k in range(4000))
    (tmp_path / "dog.xml").write_text(f"<mujoco>{folders}<asset>{files}</asset></mujoco>")
    with pytest.raises(SurefootError, match=r"dog\.xml: names files that may lie in over 10000 places"):
        read_robot(tmp_path / "dog.xml")


LARGE = "<mujoco><worldbody>" + 20_000 * '<geom size=".1"/>' + "</worldbody></mujoco>"
REFUSED = {
    "attaches itself": (attach("dog.xml"), r"'dog\.xml' includes or attaches itself"),
    "includes itself": ('<mujoco><include file="dog.xml"/></mujoco>', r"'dog\.xml' includes or attaches itself"),
    "attach in a circle": (attach("circle.xml"), r"'circle\.xml' includes or attaches itself"),
    "large include": ('<mujoco><include file="large.xml"/></mujoco>', r"large\.xml.*at most 262144 are read"),
    "large attachment": (attach("large.xml"), r"large\.xml.*at most 262144 are read"),
    "many includes": (
        f"<mujoco>{''.join(f'<include file={chr(34)}part{k}.xml{chr(34)}/>' for k in range(5))}</mujoco>",
        "includes and attaches files that are too large: at most 256 KiB in total",
    ),
    "include of a pipe": (
        '<mujoco><include file="pipe"/></mujoco>',
        "'pipe' that it names: can't be read: not a regular",
    ),
    "pipe in meshdir": (
        '<mujoco><compiler meshdir="sub"/><asset><mesh name="m" file="pipe.stl"/></asset></mujoco>',
        r"'pipe\.stl' that it names: can't be read: not a regular file",
    ),
    "pipe in an included meshdir": (
        '<mujoco><include file="sub.xml"/><asset><mesh name="m" file="pipe.stl"/></asset></mujoco>',
        r"'pipe\.stl' that it names: can't be read: not a regular file",
    ),
    "endless file": (mesh('file="/proc/kmsg"'), "'/proc/kmsg' that it names is empty"),
    "device": (mesh('file="/dev/zero"'), "'/dev/zero' that it names: can't be read: not a regular file"),
    "long row of includes": (
        '<mujoco><include file="row0.xml"/></mujoco>',
        "over 20 files include or attach each other",
    ),
}


@pytest.mark.timeout(30)
@pytest.mark.parametrize(("text", "message"), REFUSED.values(), ids=REFUSED)
def test_unsafe_referenced_files_are_rejected_before_parsing(text: str, message: str, tmp_path: Path):
    (tmp_path / "dog.xml").write_text(text)
    (tmp_path / "large.xml").write_text(LARGE)
    (tmp_path / "circle.xml").write_text(attach("back.xml"))
    (tmp_path / "back.xml").write_text(attach("circle.xml"))
    for k in range(5):
        (tmp_path / f"part{k}.xml").write_text("<mujoco>" + 60_000 * " " + "</mujoco>")
    for k in range(30):
        (tmp_path / f"row{k}.xml").write_text(f'<mujoco><include file="row{k + 1}.xml"/></mujoco>')
    (tmp_path / "sub.xml").write_text('<mujoco><compiler meshdir="sub"/></mujoco>')
    (tmp_path / "sub").mkdir()
    os.mkfifo(tmp_path / "pipe")
    os.mkfifo(tmp_path / "sub" / "pipe.stl")
    with pytest.raises(SurefootError, match=message) as error:
        read_robot(tmp_path / "dog.xml")
    assert "\n" not in str(error.value)


@pytest.mark.timeout(30)
def test_a_pipe_is_rejected_as_description(tmp_path: Path):
    os.mkfifo(tmp_path / "dog.urdf")
    with pytest.raises(SurefootError, match=r"dog\.urdf: can't be read: not a regular file"):
        read_robot(tmp_path / "dog.urdf")


INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def nested_urdf() -> str:
    return f'<robot name="dog"><link name="a">{INERTIAL}</link>{2000 * "<link>"}{2000 * "</link>"}</robot>'


def chained_urdf(count: int) -> str:
    links = "".join(f'<link name="l{k}">{INERTIAL}</link>' for k in range(count + 1))
    joints = "".join(
        f'<joint name="j{k}" type="continuous"><parent link="l{k}"/><child link="l{k + 1}"/><axis xyz="0 1 0"/></joint>'
        for k in range(count)
    )
    return f'<robot name="dog">{links}{joints}</robot>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (nested_urdf(), "nests over 200 elements"),
        (chained_urdf(400), "has a chain of 40. joints; robot new reads quadrupeds"),
        (chained_urdf(1060), "depth limit exceeded|has a chain of"),
    ],
    ids=["elements", "chain of joints", "long chain of joints"],
)
def test_a_deeply_nested_urdf_is_rejected_in_one_line(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dog.urdf").write_text(text)
    assert main(["robot", "new", "dog.urdf"]) == 2
    output = capsys.readouterr()
    assert output.err.startswith("surefoot: error: dog.urdf: ")
    assert output.err.count("\n") == 1
    assert re.search(message, output.err)
    assert [path.name for path in tmp_path.iterdir()] == ["dog.urdf"]


def test_ctrl_c_ends_a_compilation(tmp_path: Path):
    (tmp_path / "dog.xml").write_text(LIMITED["flex grids"])
    command = [sys.executable, "-m", "surefoot", "robot", "new", "dog.xml"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 60
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")

        def compilers() -> list[str]:
            with suppress(OSError):
                lines = {child: Path(f"/proc/{child}/cmdline").read_text() for child in children.read_text().split()}
                return [child for child, line in lines.items() if "isolated_reader" in line]
            return []

        while not (child := compilers()) and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, "surefoot: interrupted\n")
    assert child
    while Path(f"/proc/{child[0]}").exists() and time.monotonic() < deadline:
        time.sleep(0.02)  # until its new parent has reaped it
    assert not Path(f"/proc/{child[0]}").exists()


@pytest.mark.parametrize("name", ["go2", "pupper_v2", "solo8"])
def test_the_isolated_reader_returns_the_same_robot(name: str):
    path = RobotDescription.load(name).urdf.path
    expected = reader.read_robot(path)
    for robot in (decode(encode(expected), path), read_robot(path)):
        for item in fields(expected):
            if item.name not in ("base", "base_box", "bodies", "parts", "poses"):
                np.testing.assert_array_equal(getattr(robot, item.name), getattr(expected, item.name))
        np.testing.assert_array_equal(robot.base_box, expected.base_box)
        bodies = [[one.base, *sum(one.bodies, ())] for one in (robot, expected)]
        for mine, theirs in zip(*bodies, strict=True):
            assert mine.mass == theirs.mass
            np.testing.assert_array_equal(mine.centre, theirs.centre)
            np.testing.assert_array_equal(mine.inertia, theirs.inertia)
        for mine, theirs in zip(robot.parts, expected.parts, strict=True):
            assert (mine.link, mine.color) == (theirs.link, theirs.color)
            np.testing.assert_array_equal(mine.vertices, theirs.vertices)
            np.testing.assert_array_equal(mine.faces, theirs.faces)
            assert (mine.vertices.dtype, mine.faces.dtype) == (theirs.vertices.dtype, theirs.faces.dtype)


def own_robot(folder: Path, text: str) -> RobotDescription:
    """Return a robot with a modified URDF, as a third party may write it."""
    from shutil import copytree

    copytree(RobotDescription.load("solo8").folder, folder)
    path = folder / "solo8.urdf"
    path.write_text(path.read_text().replace("</robot>", f"{text}</robot>"))
    return RobotDescription.load(folder)


def test_a_third_party_urdf_is_probed_within_limits(tmp_path: Path):
    robot = own_robot(tmp_path / "dog", '<mujoco><size nuser_geom="2000000000"/></mujoco>')
    with pytest.raises(SurefootError, match=r"solo8\.urdf: MuJoCo can't compile it within 1 GiB and 3 s") as error:
        urdf_probe.check_urdf(robot.urdf.path, QUICK)
    assert "\n" not in str(error.value)
    with pytest.raises(SurefootError, match=r"solo8\.urdf: "):
        build_model(robot)


def test_only_robots_that_are_not_built_in_are_probed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tried = []
    run = urdf_probe.sandbox.run_module
    monkeypatch.setattr(urdf_probe.sandbox, "run_module", lambda *words: tried.append(words) or run(*words))
    for name in RobotDescription.available():
        build_model(RobotDescription.load(name))
    assert tried == []
    robot = own_robot(tmp_path / "dog", "<gazebo/>")
    assert build_model(robot).nbody == build_model(robot).nbody == build_model(RobotDescription.load("solo8")).nbody
    assert len(tried) == 1
