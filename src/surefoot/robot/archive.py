"""A robot's folder as bytes, which policies, traces and recordings carry, and its unpacking into the user's cache.

The archive is a ZIP file of the sheet, the URDF and the looks that it names, and the robot's own tasks, ranges and
files of parameters. It is unpacked into `$XDG_CACHE_HOME/surefoot/robots/DIGEST` (`~/.cache`, if that is not set) or,
where nothing can be written there, into a temporary folder that the process removes at its end.
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

SHEET = "robot.toml"
ROBOT = "robot"
"""Array with the archive in files of traces and recordings."""
MAX_BYTES = 1 << 23
"""Size of all files together, unpacked, and of an archive."""
MAX_FILES = 200
_OWN = ("*.toml", "tasks/*.yaml", "tasks/*.csv", "tasks/*.npz", "ranges/*.yaml", "ranges/*.toml")
"""What a robot's folder may hold besides the files that its sheet names."""
_NAME = re.compile(r"(?:\w[\w .+-]*/)?\w[\w .+-]*\.(?:toml|urdf|xml|npz|yaml|csv)", re.ASCII)
"""Names of files in an archive: none leads out of the folder, none is hidden."""


def robot_files(folder: Path) -> dict[str, bytes]:
    """Return the files of a robot's folder by name, in order.

    Links are followed only to files that are in the folder too: a stranger's folder must not put other files of this
    computer into a policy.

    Raises:
        SurefootError: a file that can't be read, a link that leads out of the folder, too many or too large files, or
            a name that an archive can't hold.
    """
    data, _ = read_toml(folder / SHEET)
    named = [name for key in ("urdf", "looks") if isinstance(name := data.get(key), str)]
    own = (path.relative_to(folder).as_posix() for pattern in _OWN for path in folder.glob(pattern))
    files: dict[str, bytes] = {}
    for name in sorted({*named, *filter(_NAME.fullmatch, own)}):
        path = _resolve_inside(folder, name)
        with describe_os_errors(folder / name):
            check_readable(path, MAX_BYTES)
            files[name] = path.read_bytes()
    try:
        _check(files)
    except SurefootError as error:
        raise SurefootError(f"robot {folder}: {error}, so that a policy can't carry it") from None
    return files


def pack_robot(folder: Path) -> bytes:
    """Return the archive of a robot's folder: the same files give the same bytes; errors as of `robot_files`."""
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in robot_files(folder).items():
            info = zipfile.ZipInfo(name)
            info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
            archive.writestr(info, content)
    return buffer.getvalue()


def read_archive(data: bytes) -> dict[str, bytes]:
    """Return the files of an archive by name, each checked to be one that a robot's folder may have.

    Raises:
        SurefootError: bytes that are no archive of a robot, or too many or too large files.
    """
    files: dict[str, bytes] = {}
    if len(data) > MAX_BYTES:
        raise SurefootError(f"its robot has over {MAX_BYTES >> 20} MiB")
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            members = archive.infolist()
            _check({member.filename: b"" for member in members}, len(members))
            left = MAX_BYTES
            for member in members:
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"{member.filename} is packed in another way than surefoot does")
                with archive.open(member) as file:
                    # The stated size may be wrong: no more than allowed is unpacked.
                    files[member.filename] = content = file.read(left + 1)
                if len(content) > left:
                    raise SurefootError(f"its files have over {MAX_BYTES >> 20} MiB")
                left -= len(content)
    except SurefootError as error:
        raise SurefootError(f"its robot can't be unpacked: {error}") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError) as error:
        raise SurefootError(f"its robot is damaged: {' '.join(str(error).split())}") from error
    if SHEET not in files:
        raise SurefootError(f"its robot is damaged: it has no {SHEET}")
    return files


def unpack_robot(data: bytes) -> Path:
    """Return the folder in the user's cache that holds an archive's robot; make it, if it is not there.

    Several processes may do so at once: each writes the files that are missing or different, whole, and uses the
    folder only when all are there.

    Raises:
        SurefootError: as of `read_archive`, or no folder can be written.
    """
    files = read_archive(data)
    digest = folder_digest(files)
    try:
        return _write(_cache_folder() / digest, files)
    except (OSError, RuntimeError):  # pathlib's error where a user has no home
        with describe_os_errors("temporary folder", "written"):
            return _write(_temporary_folder() / digest, files)


def folder_digest(files: Mapping[str, bytes]) -> str:
    """Return the SHA-256 of a robot's files, which does not depend on how they are packed."""
    total = hashlib.sha256()
    for name in sorted(files):
        total.update(f"{name}\0{len(files[name])}\0".encode() + files[name])
    return total.hexdigest()


def copy_robot(folder: Path, target: Path) -> None:
    """Copy what an archive of a robot's folder would hold into another folder; errors as of `robot_files`."""
    for name, content in robot_files(folder).items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        atomic_write(target / name, content)


def _resolve_inside(folder: Path, name: str) -> Path:
    """Return the path of a folder's file without links; refuse one that is not in the folder."""
    # RuntimeError: a circle of links, before Python 3.13.
    try:
        path, top = (folder / name).resolve(), folder.resolve()
    except RuntimeError:
        raise SurefootError(f"{folder / name}: is a link to itself; remove it") from None
    if not path.is_relative_to(top):
        raise SurefootError(
            f"{folder / name}: leads out of the robot's folder, to {path}; a policy carries files of the folder only: "
            "put a copy of the file there, or remove the link"
        )
    return path


def _check(files: Mapping[str, bytes], count: int | None = None) -> None:
    if (count or len(files)) > MAX_FILES:
        raise SurefootError(f"it has {count or len(files)} files; at most {MAX_FILES} are allowed")
    if count is not None and count > len(files):
        raise SurefootError("it has a file twice")
    if odd := [name for name in files if not _NAME.fullmatch(name)]:
        raise SurefootError(f"its file {quote(odd[0])} is none of a robot's folder")
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
        # Another user could change the files while they are read.
        if path.lstat().st_uid != os.geteuid() or path.is_symlink():
            raise PermissionError(f"{path} is of another user")
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(mode=0o700, exist_ok=True)
        if not path.is_file() or path.read_bytes() != content:
            atomic_write(path, content)
    return folder
