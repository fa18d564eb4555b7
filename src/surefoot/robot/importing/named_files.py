"""Search for the files that a URDF or MJCF refers to, and their checks before a parser opens them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import CONFIGURATION_BYTES, check_readable
from surefoot.robot.importing.copy_limits import check_copies
from surefoot.robot.urdf_file import read_xml

MAX_MESH_BYTES = 100_000_000
"""Maximum size of a mesh, and of a file that a mesh refers to."""
_MAX_NESTED = 20
"""Maximum nesting of files that include or attach each other."""
_MAX_PLACES = 10_000
"""Maximum number of paths that are tried for all files of a description together."""
_PARTS = ("include", "model")
"""Elements of an MJCF that refer to another MJCF."""
_FOLDERS = ("meshdir", "texturedir", "assetdir")
"""Attributes of <compiler> that name folders of assets."""


def find_mesh(name: str, path: Path) -> Path:
    """Find a URDF's mesh file next to the description or relative to a parent folder, as in ROS packages."""
    inside = Path(name.split("://", 1)[-1])
    # For package://NAME/PATH, also search PATH, because the package's folder may have another name.
    parts = (inside, Path(*inside.parts[1:])) if len(inside.parts) > 1 else (inside,)
    for folder in path.resolve().parents[:6]:
        for part in parts:
            file = folder / part
            try:
                size = file.stat().st_size if file.is_file() else None
            except OSError:  # an invalid file name
                continue
            if size is None:
                continue
            if size > MAX_MESH_BYTES:
                limit = f"at most {MAX_MESH_BYTES // 10**6} MB are read"
                raise SurefootError(f"{path}: mesh '{name}' has {size // 10**6} MB; {limit}")
            return file
    raise SurefootError(f"{path}: mesh '{name}' does not exist; put it where the file names it")


def check_named_files(root: ElementTree.Element, path: Path) -> int:
    """Reject an MJCF that refers to pipes, devices or too large files, or requests too many copies of an element.

    Included files and attached models count towards the size limit of a description.

    Returns:
        Total size of the assets that it refers to [byte].

    Raises:
        SurefootError: one of these problems, or files that include each other in a cycle.
    """
    search = _Search(path)
    search.add(root, path, ())
    return search.check_data()


class _Search:
    """Recursive search for the files that an MJCF refers to, which adds up their sizes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.left = CONFIGURATION_BYTES - path.stat().st_size
        self.parts: set[Path] = set()
        """Files that are included or attached."""
        self.folders: set[Path] = set()
        """Folders of these files, and folders that their <compiler> names, in which MuJoCo searches for assets."""
        self.data: set[str] = set()
        """Names of all other files, the assets."""
        self.tried = 0
        """Number of paths that were tried."""

    def add(self, root: ElementTree.Element, file: Path, above: tuple[Path, ...]) -> None:
        """Collect the references of a file and, recursively, of its included files; `above` are the including files."""
        above = (*above, file.resolve())
        if len(above) > _MAX_NESTED:
            raise SurefootError(f"{self.path}: over {_MAX_NESTED} files include or attach each other in a row")
        check_copies(root, self.path)
        folders = {self.path.parent, file.parent}
        named = {item.get(key, "") for item in root.iter("compiler") for key in _FOLDERS}
        folders |= {folder / name for folder in folders for name in named}
        self.folders |= folders
        for element in root.iter():
            names = {value for key, value in element.attrib.items() if key.startswith("file") and value}
            if element.tag not in _PARTS:
                self.data |= names
                continue
            for name in names:
                for part in self._find(name, folders):
                    self._add_part(part, name, above)

    def check_data(self) -> int:
        """Check all assets; return their total size [byte]."""
        sizes: dict[Path, int] = {}
        for name in self.data:
            for asset in self._find(name, self.folders):
                with describe_os_errors(f"{self.path}: the file '{name}' that it names"):
                    check_readable(asset, MAX_MESH_BYTES)
                if not (size := asset.stat().st_size):
                    # Files in /proc report size 0, and some of them never end.
                    raise SurefootError(f"{self.path}: the file '{name}' that it names is empty")
                sizes[asset] = size
        return sum(sizes.values())

    def _find(self, name: str, folders: set[Path]) -> Iterator[Path]:
        """Yield the existing files to which a name may refer, next to a model or in a folder of its <compiler>."""
        words = {name.strip(), Path(name.replace("\\", "/")).name}  # the second is for the option strippath
        self.tried += len(words) * len(folders)
        if self.tried > _MAX_PLACES:
            raise SurefootError(
                f"{self.path}: names files that may lie in over {_MAX_PLACES} places; name fewer files and folders"
            )
        for path in {folder / word for folder in folders for word in words}:
            try:
                file = path.resolve()
                if file.exists() and not file.is_dir():
                    yield file
            except (OSError, ValueError, RuntimeError):  # an invalid file name, or a cycle of links
                continue

    def _add_part(self, part: Path, name: str, above: tuple[Path, ...]) -> None:
        if part in above:
            raise SurefootError(
                f"{self.path}: the file '{name}' includes or attaches itself; a model can't contain itself"
            )
        if part in self.parts:
            return
        with describe_os_errors(f"{self.path}: the file '{name}' that it names"):
            check_readable(part, CONFIGURATION_BYTES)
            self.left -= part.stat().st_size
        if self.left < 0:
            limit = f"{CONFIGURATION_BYTES >> 10} KiB in total are read"
            raise SurefootError(f"{self.path}: includes and attaches files that are too large: at most {limit}")
        self.add(read_xml(part), part, above)
        self.parts.add(part)
