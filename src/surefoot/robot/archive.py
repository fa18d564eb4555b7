"""Archive of a robot's folder, which policies, traces and recordings embed.

The archive is a ZIP file with the data sheet, the URDF and visuals that the data sheet names, and the robot's own
tasks, ranges and parameter files. It is unpacked into `$XDG_CACHE_HOME/surefoot/robots/DIGEST` (`~/.cache`, if the
variable is not set). If that folder can't be written, a temporary folder is used and removed when the process ends.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from functools import cache
from io import BytesIO
from pathlib import Path

from surefoot.configuration import read_toml
from surefoot.errors import SurefootError, describe_os_errors, quote
from surefoot.files import atomic_write, check_readable

DATA_SHEET = "robot.toml"
ROBOT_ARRAY = "robot"
"""Name of the array that holds the archive in traces and recordings."""
MAX_BYTES = 1 << 23
"""Maximum size of an archive, and of all its files unpacked [byte]."""
MAX_FILES = 200
_OPTIONAL_FILES = ("*.toml", "tasks/*.yaml", "tasks/*.csv", "tasks/*.npz", "ranges/*.yaml", "ranges/*.toml")
"""Patterns of further files that are archived, in addition to the files that the data sheet names."""
_FILE_NAME = re.compile(r"(?:\w[\w .+-]*/)?\w[\w .+-]*\.(?:toml|urdf|xml|npz|yaml|csv)", re.ASCII)
"""Allowed file names in an archive: no path out of the folder, no hidden file."""


def robot_files(folder: Path) -> dict[str, bytes]:
    """Read the files of a robot's folder that belong into an archive, by name in sorted order.

    Symbolic links are followed only within the folder, so that a downloaded folder can't put other files of this
    computer into a policy.

    Raises:
        SurefootError: a file can't be read, a link leads out of the folder, there are too many or too large files, or
            an archive can't hold a file of that name.
    """
    data, _ = read_toml(folder / DATA_SHEET)
    named = [name for key in ("urdf", "visuals") if isinstance(name := data.get(key), str)]
    own = (path.relative_to(folder).as_posix() for pattern in _OPTIONAL_FILES for path in folder.glob(pattern))
    files: dict[str, bytes] = {}
    for name in sorted({*named, *filter(_FILE_NAME.fullmatch, own)}):
        path = _resolve_inside(folder, name)
        with describe_os_errors(folder / name):
            check_readable(path, MAX_BYTES)
            files[name] = path.read_bytes()
    try:
        _check_files(files)
    except SurefootError as error:
        raise SurefootError(f"robot {folder}: {error}, so a policy can't embed it") from None
    return files


def pack_robot(folder: Path) -> bytes:
    """Pack a robot's folder into an archive; equal files give equal bytes. See `robot_files` for errors."""
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in robot_files(folder).items():
            info = zipfile.ZipInfo(name)
            info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
            archive.writestr(info, content)
    return buffer.getvalue()


def read_archive(data: bytes) -> dict[str, bytes]:
    """Return the files of an archive by name, after checking that a robot's folder may contain them.

    Raises:
        SurefootError: the bytes are no robot archive, or it has too many or too large files.
    """
    files: dict[str, bytes] = {}
    if len(data) > MAX_BYTES:
        raise SurefootError(f"its robot has over {MAX_BYTES >> 20} MiB")
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            members = archive.infolist()
            _check_files({member.filename: b"" for member in members}, len(members))
            left = MAX_BYTES
            for member in members:
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"{member.filename} has an unsupported compression method")
                with archive.open(member) as file:
                    # The stated size may be wrong, so read only as much as is allowed.
                    files[member.filename] = content = file.read(left + 1)
                if len(content) > left:
                    raise SurefootError(f"its files have over {MAX_BYTES >> 20} MiB")
                left -= len(content)
    except SurefootError as error:
        raise SurefootError(f"its robot can't be unpacked: {error}") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError) as error:
        raise SurefootError(f"its robot is damaged: {' '.join(str(error).split())}") from error
    if DATA_SHEET not in files:
        raise SurefootError(f"its robot is damaged: it has no {DATA_SHEET}")
    return files


def unpack_robot(data: bytes) -> Path:
    """Unpack an archive into the user's cache, unless it is already there, and return the robot's folder.

    Several processes may unpack at the same time: each writes missing or different files atomically, and returns the
    folder only when it is complete.

    Raises:
        SurefootError: see `read_archive`, or no folder can be written.
    """
    files = read_archive(data)
    # Archives of earlier versions have data sheets with the former name of the key `visuals`.
    files[DATA_SHEET] = re.sub(rb"(?m)^looks(?=\s*=)", b"visuals", files[DATA_SHEET])
    digest = folder_digest(files)
    try:
        return _write(_cache_folder() / digest, files)
    except (OSError, RuntimeError):  # pathlib raises RuntimeError for a user without a home folder
        with describe_os_errors("temporary folder", "written"):
            return _write(_temporary_folder() / digest, files)


def folder_digest(files: Mapping[str, bytes]) -> str:
    """Return the SHA-256 digest of a robot's files, which does not depend on how they are packed."""
    total = hashlib.sha256()
    for name in sorted(files):
        total.update(f"{name}\0{len(files[name])}\0".encode() + files[name])
    return total.hexdigest()


def copy_robot(folder: Path, target: Path, data_sheet: str | None = None) -> None:
    """Copy the files that an archive would contain to another folder; see `robot_files` for errors.

    Only missing or different files are written, each atomically, so several threads and processes may make the same
    copy at once.

    Args:
        folder: the robot's folder.
        target: folder of the copy.
        data_sheet: content of the copy's data sheet; defaults to the robot's own.
    """
    files = robot_files(folder)
    if data_sheet is not None:
        files[DATA_SHEET] = data_sheet.encode()
    for name, content in files.items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        _write_changed(target / name, content)


def _resolve_inside(folder: Path, name: str) -> Path:
    """Resolve the path of a file, and reject a file outside of the folder."""
    # Before Python 3.13, a cycle of links raises RuntimeError.
    try:
        path, top = (folder / name).resolve(), folder.resolve()
    except RuntimeError:
        raise SurefootError(f"{folder / name}: is a link to itself; remove it") from None
    if not path.is_relative_to(top):
        raise SurefootError(
            f"{folder / name}: leads out of the robot's folder, to {path}; a policy embeds only files of the folder: "
            "put a copy of the file there, or remove the link"
        )
    return path


def _check_files(files: Mapping[str, bytes], count: int | None = None) -> None:
    if (count or len(files)) > MAX_FILES:
        raise SurefootError(f"it has {count or len(files)} files; at most {MAX_FILES} are allowed")
    if count is not None and count > len(files):
        raise SurefootError("it has a file twice")
    if odd := [name for name in files if not _FILE_NAME.fullmatch(name)]:
        raise SurefootError(f"its file {quote(odd[0])} does not belong to a robot's folder")
    if sum(map(len, files.values())) > MAX_BYTES:
        raise SurefootError(f"its files have over {MAX_BYTES >> 20} MiB")


def _cache_folder() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "surefoot" / "robots"


@cache
def _temporary_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="surefoot-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _write(folder: Path, files: Mapping[str, bytes]) -> Path:
    for path in (folder.parent, folder):
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Reject a folder of another user, who could change files while they are read.
        if path.lstat().st_uid != os.geteuid() or path.is_symlink():
            raise PermissionError(f"{path} belongs to another user")
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(mode=0o700, exist_ok=True)
        _write_changed(path, content)
    return folder


def _write_changed(path: Path, content: bytes) -> None:
    """Write a file atomically unless it already has this content."""
    if not path.is_file() or path.read_bytes() != content:
        atomic_write(path, content)
