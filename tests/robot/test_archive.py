"""Robot archives: round trips, and malicious archives, of which nothing is written."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path

import pytest

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot import archive as module
from surefoot.robot.archive import copy_robot, pack_robot, read_archive, unpack_robot

MINITAUR = RobotDescription.load("minitaur").folder


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    folder = tmp_path / "my robots" / "mine"
    shutil.copytree(MINITAUR, folder)
    (folder / "robot.png").write_bytes(b"a picture is not carried")
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "surefoot" / "robots"


def zipped(*members: tuple[str | zipfile.ZipInfo, bytes], kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return buffer.getvalue()


def test_archive_round_trip_preserves_all_files(mine: Path, cache: Path):
    os.utime(mine / "robot.toml", (1, 1))
    data = pack_robot(mine)
    assert data == pack_robot(MINITAUR)
    folder = unpack_robot(data)
    assert folder.parent == cache
    assert unpack_robot(data) == folder
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    expected = {path.relative_to(MINITAUR).as_posix() for path in MINITAUR.rglob("*") if path.is_file()}
    assert names == expected
    assert all((folder / name).read_bytes() == (MINITAUR / name).read_bytes() for name in names)
    assert RobotDescription.load(folder).name == "minitaur"


def test_built_in_robots_are_not_archived(mine: Path):
    assert RobotDescription.load("minitaur").archive == b""
    assert RobotDescription.load(MINITAUR).location == "minitaur"
    own = RobotDescription.load(mine)
    assert own.archive == pack_robot(mine)
    assert own.location == str(mine)


def test_old_key_looks_loads_from_an_archive_and_is_rejected_in_a_folder(mine: Path):
    sheet = mine / "robot.toml"
    files = [(path.relative_to(mine).as_posix(), path.read_bytes()) for path in (mine / "minitaur.urdf",)]
    old = sheet.read_text().replace('visuals = "visuals.npz"', 'looks = "looks.npz"')
    visuals = ("looks.npz", (mine / "visuals.npz").read_bytes())
    robot = RobotDescription.load(unpack_robot(zipped(("robot.toml", old.encode()), visuals, *files)))
    assert len(robot.appearance().parts) == len(RobotDescription.load("minitaur").appearance().parts)
    sheet.write_text(old)
    with pytest.raises(SurefootError, match=r"robot.toml: looks is named visuals now; rename this key"):
        RobotDescription.load(mine)


def test_modified_or_missing_cache_files_are_restored(mine: Path):
    folder = unpack_robot(pack_robot(mine))
    (folder / "robot.toml").write_text("name = 'another'")
    (folder / "minitaur.urdf").unlink()
    assert RobotDescription.load(unpack_robot(pack_robot(mine))).name == "minitaur"


def test_concurrent_unpacking_gives_every_process_a_complete_robot(mine: Path, tmp_path: Path):
    file = tmp_path / "archive"
    file.write_bytes(pack_robot(mine))
    code = (
        "import sys; from surefoot.robot import RobotDescription; from surefoot.robot.archive import unpack_robot\n"
        "print(RobotDescription.load(unpack_robot(open(sys.argv[1], 'rb').read())).name)"
    )
    running = [subprocess.Popen([sys.executable, "-c", code, file], stdout=subprocess.PIPE) for _ in range(4)]
    assert [process.communicate()[0] for process in running] == [b"minitaur\n"] * 4


def test_unpacking_uses_a_temporary_folder_if_the_cache_is_not_writable(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "cache").write_text("a file where the folder should be")
    folder = unpack_robot(pack_robot(mine))
    assert not folder.is_relative_to(tmp_path / "cache")
    assert RobotDescription.load(folder).name == "minitaur"


def test_a_cache_of_another_user_is_not_used(mine: Path, cache: Path, monkeypatch: pytest.MonkeyPatch):
    own = unpack_robot(pack_robot(mine))
    user = os.geteuid()
    monkeypatch.setattr(module.os, "geteuid", lambda: user + 1)
    # The temporary folder also belongs to the other user, so nothing can be written.
    with pytest.raises(SurefootError, match="temporary folder: can't be written"):
        unpack_robot(pack_robot(mine))
    assert stat.S_IMODE(own.stat().st_mode) == 0o700


SHEET = ("robot.toml", b"")
LINK = zipfile.ZipInfo("link.urdf")
LINK.external_attr = (stat.S_IFLNK | 0o777) << 16


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "damaged"),
        (b"PK\x03\x04 and no more", "damaged"),
        (pack_robot(MINITAUR)[:-40], "damaged"),
        (zipped(("other.urdf", b"")), "it has no robot.toml"),
        (zipped(SHEET, ("../robot.urdf", b"")), "'../robot.urdf' does not belong to a robot's folder"),
        (zipped(SHEET, ("/etc/robot.urdf", b"")), "does not belong to a robot's folder"),
        (zipped(SHEET, ("tasks/../../robot.urdf", b"")), "does not belong to a robot's folder"),
        (zipped(SHEET, ("tasks\\x.yaml", b"")), "does not belong to a robot's folder"),
        (zipped(SHEET, (".hidden.toml", b"")), "does not belong to a robot's folder"),
        (zipped(SHEET, ("a/b/c.yaml", b"")), "does not belong to a robot's folder"),
        (zipped(SHEET, ("run.py", b"")), "does not belong to a robot's folder"),
        (zipped(SHEET, ("tasks/", b"")), "does not belong to a robot's folder"),
        (zipped(SHEET, *((f"tasks/{k}.yaml", b"") for k in range(200))), "it has 201 files; at most 200"),
        (zipped(SHEET, ("bomb.urdf", bytes(9 << 20))), "over 8 MiB"),
        (zipped(SHEET, ("robot.urdf", b"x"), kind=zipfile.ZIP_LZMA), "has an unsupported compression method"),
        (os.urandom(9 << 20), "over 8 MiB"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_malicious_archives_are_rejected_and_nothing_is_written(data: bytes, message: str, cache: Path):
    with pytest.raises(SurefootError, match="its robot") as error:
        unpack_robot(data)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert not cache.exists()


def test_an_understated_archive_size_is_rejected():
    data = bytearray(zipped(SHEET, ("bomb.urdf", bytes(9 << 20))))
    place = data.rindex(b"PK\x01\x02") + 24
    data[place : place + 4] = (100).to_bytes(4, "little")
    with pytest.raises(SurefootError, match="its robot"):
        read_archive(bytes(data))


def test_a_link_in_an_archive_becomes_a_plain_file(cache: Path):
    folder = unpack_robot(zipped(SHEET, (LINK, b"/etc/passwd")))
    assert not (folder / "link.urdf").is_symlink()
    assert (folder / "link.urdf").read_bytes() == b"/etc/passwd"


def test_a_data_sheet_that_names_a_file_outside_the_folder_is_rejected(mine: Path):
    sheet = (mine / "robot.toml").read_text()
    for name in ("../minitaur.urdf", "/etc/passwd"):
        (mine / "robot.toml").write_text(sheet.replace('"minitaur.urdf"', f'"{name}"'))
        with pytest.raises(SurefootError, match="it must be a file in the robot's folder"):
            RobotDescription.load(mine)


def secret(tmp_path: Path) -> Path:
    """Return a private file outside of the robot's folder."""
    folder = tmp_path / "private"
    folder.mkdir(exist_ok=True)
    (folder / "notes.csv").write_text("a secret")
    return folder / "notes.csv"


def link_file(mine: Path, file: Path) -> None:
    (mine / "tasks").mkdir(exist_ok=True)
    (mine / "tasks" / "notes.csv").symlink_to(file)


def link_over_the_parent(mine: Path, file: Path) -> None:
    link_file(mine, Path("../../../private") / file.name)


def link_chain(mine: Path, file: Path) -> None:
    (mine / "tasks").mkdir(exist_ok=True)
    (mine / "tasks" / "more.csv").symlink_to(file)
    link_file(mine, Path("more.csv"))


def link_folder(mine: Path, file: Path) -> None:
    shutil.rmtree(mine / "tasks", ignore_errors=True)
    (mine / "tasks").symlink_to(file.parent)


def link_sheet(mine: Path, file: Path) -> None:
    (mine / "robot.toml").rename(file.parent / "robot.toml")
    (mine / "robot.toml").symlink_to(file.parent / "robot.toml")


def link_description(mine: Path, file: Path) -> None:
    (mine / "minitaur.urdf").rename(file.parent / "minitaur.urdf")
    (mine / "minitaur.urdf").symlink_to(file.parent / "minitaur.urdf")


def link_to_a_like_name(mine: Path, file: Path) -> None:
    other = mine.with_name(f"{mine.name}-other")
    other.mkdir()
    file.rename(other / file.name)
    link_file(mine, other / file.name)


LEAKS = [
    *(link_file, link_over_the_parent, link_chain, link_folder),
    *(link_sheet, link_description, link_to_a_like_name),
]


@pytest.mark.parametrize("leak", LEAKS, ids=lambda leak: leak.__name__)
def test_links_out_of_the_folder_are_not_followed(leak, mine: Path, tmp_path: Path):
    leak(mine, secret(tmp_path))
    for archive in (pack_robot, lambda folder: copy_robot(folder, tmp_path / "copy")):
        with pytest.raises(SurefootError, match=r"leads out of the robot's folder, to /.*; a policy embeds") as error:
            archive(mine)
        assert "\n" not in str(error.value)
        assert not (tmp_path / "copy").exists()


def test_links_within_the_folder_are_followed(mine: Path, tmp_path: Path):
    (mine / "tasks" / "kept").mkdir(parents=True)
    (mine / "tasks" / "kept" / "one.yaml").write_text("name: one")
    (mine / "tasks" / "two.yaml").symlink_to("kept/one.yaml")
    (mine / "ranges" / "back.yaml").symlink_to(mine.resolve() / "tasks" / "two.yaml")
    folder = tmp_path / "a link to the folder"
    folder.symlink_to(mine)
    for place in (mine, folder):
        files = read_archive(pack_robot(place))
        assert files["tasks/two.yaml"] == files["ranges/back.yaml"] == b"name: one"


def test_cyclic_links_are_rejected(mine: Path):
    (mine / "tasks").mkdir(exist_ok=True)
    (mine / "tasks" / "a.yaml").symlink_to("b.yaml")
    (mine / "tasks" / "b.yaml").symlink_to("a.yaml")
    with pytest.raises(SurefootError, match=r"is a link to itself|can't be read: Too many levels"):
        pack_robot(mine)


@pytest.mark.timeout(20)
def test_pipes_and_devices_are_rejected_without_opening(mine: Path):
    (mine / "tasks").mkdir(exist_ok=True)
    os.mkfifo(mine / "tasks" / "pipe.csv")
    with pytest.raises(SurefootError, match=r"pipe\.csv: can't be read: not a regular file"):
        pack_robot(mine)
    (mine / "tasks" / "pipe.csv").unlink()
    (mine / "tasks" / "zero.csv").symlink_to("/dev/zero")
    with pytest.raises(SurefootError, match="leads out of the robot's folder, to /dev/zero"):
        pack_robot(mine)
