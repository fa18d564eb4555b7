"""Files that a URDF or MJCF names: found, and checked before a parser opens them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import CONFIGURATION_BYTES, check_readable
from surefoot.robot.importing.copy_limits import check_copies
from surefoot.robot.urdf_file import read_xml

MAX_MESH_BYTES = 100_000_000
"""Size of the largest mesh, or file that a mesh names, that is read."""
_MAX_NESTED = 20
"""Files that may include or attach each other in a row."""
_MAX_PLACES = 10_000
"""Places where the files that a description names are looked for."""
_PARTS = ("include", "model")
"""Elements of an MJCF that name another one."""
_FOLDERS = ("meshdir", "texturedir", "assetdir")
"""Attributes of a compiler that name folders of files."""


def find_mesh(name: str, path: Path) -> Path:
    """Return the file of a URDF's mesh, beside the description or in a folder above it, as packages have it."""
    inside = Path(name.split("://", 1)[-1])
    # package://NAME/rest: the package's folder may have another name.
    parts = (inside, Path(*inside.parts[1:])) if len(inside.parts) > 1 else (inside,)
    for folder in path.resolve().parents[:6]:
        for part in parts:
            file = folder / part
            try:
                size = file.stat().st_size if file.is_file() else None
            except OSError:  # no name of a file
                continue
            if size is None:
                continue
            if size > MAX_MESH_BYTES:
                limit = f"at most {MAX_MESH_BYTES // 10**6} MB are read"
                raise SurefootError(f"{path}: mesh '{name}' has {size // 10**6} MB; {limit}")
            return file
    raise SurefootError(f"{path}: mesh '{name}' is not there; put it where the file names it")


def check_named_files(root: ElementTree.Element, path: Path) -> int:
    """Refuse an MJCF that names pipes, devices or files that are too large, or asks for too many copies of something.

    Files that it includes and models that it attaches count towards the limit of a description's size.

    Returns:
        size of the data that it names [byte].

    Raises:
        SurefootError: one of these, or models that attach each other in a circle.
    """
    search = _Search(path)
    search.add(root, path, ())
    return search.check_data()


class _Search:
    """Search for the files that an MJCF names, which sums up their sizes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.left = CONFIGURATION_BYTES - path.stat().st_size
        self.parts: set[Path] = set()
        """Files that are included or attached."""
        self.folders: set[Path] = set()
        """Folders of these and of their compilers: MuJoCo looks for data in some of them, wherever it is named."""
        self.data: set[str] = set()
        """Names of other files."""
        self.looked = 0
        """Places where a file was looked for."""

    def add(self, root: ElementTree.Element, file: Path, above: tuple[Path, ...]) -> None:
        """Take what a file names, and what the files name that it includes; `above` has those that lead to it."""
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
                for found in self._find(name, folders):
                    self._add_part(found, name, above)

    def check_data(self) -> int:
        """Check the files that are no descriptions; return their size [byte]."""
        sizes: dict[Path, int] = {}
        for name in self.data:
            for found in self._find(name, self.folders):
                with describe_os_errors(f"{self.path}: the file '{name}' that it names"):
                    check_readable(found, MAX_MESH_BYTES)
                if not (size := found.stat().st_size):
                    # Files in /proc report this; some never end.
                    raise SurefootError(f"{self.path}: the file '{name}' that it names is empty")
                sizes[found] = size
        return sum(sizes.values())

    def _find(self, name: str, folders: set[Path]) -> Iterator[Path]:
        """Yield the files that a name may mean: MuJoCo looks beside a model, or in a folder that a compiler names."""
        words = {name.strip(), Path(name.replace("\\", "/")).name}  # the last one: strippath
        self.looked += len(words) * len(folders)
        if self.looked > _MAX_PLACES:
            raise SurefootError(
                f"{self.path}: names files that may lie in over {_MAX_PLACES} places; name fewer files and folders"
            )
        for path in {folder / word for folder in folders for word in words}:
            try:
                found = path.resolve()
                if found.exists() and not found.is_dir():
                    yield found
            except (OSError, ValueError, RuntimeError):  # no name of a file, or a circle of links
                continue

    def _add_part(self, found: Path, name: str, above: tuple[Path, ...]) -> None:
        if found in above:
            raise SurefootError(
                f"{self.path}: the file '{name}' includes or attaches itself; a model can't hold itself"
            )
        if found in self.parts:
            return
        with describe_os_errors(f"{self.path}: the file '{name}' that it names"):
            check_readable(found, CONFIGURATION_BYTES)
            self.left -= found.stat().st_size
        if self.left < 0:
            limit = f"{CONFIGURATION_BYTES >> 10} KiB in all are read"
            raise SurefootError(f"{self.path}: includes and attaches files that are too large: at most {limit}")
        self.add(read_xml(found), found, above)
        self.parts.add(found)
