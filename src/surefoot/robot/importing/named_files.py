"""Files that a URDF or MJCF names: found, and checked before a parser opens them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import CONFIGURATION_BYTES, check_readable
from surefoot.robot.urdf_file import read_xml

MAX_MESH_BYTES = 100_000_000
"""Size of the largest mesh, or file that a mesh names, that is read."""
_MAX_NESTED = 20
"""Files that may include or attach each other in a row."""
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
            if (file := folder / part).is_file():
                if (size := file.stat().st_size) > MAX_MESH_BYTES:
                    limit = f"at most {MAX_MESH_BYTES // 10**6} MB are read"
                    raise SurefootError(f"{path}: mesh '{name}' has {size // 10**6} MB; {limit}")
                return file
    raise SurefootError(f"{path}: mesh '{name}' is not there; put it where the file names it")


def check_named_files(root: ElementTree.Element, path: Path) -> int:
    """Refuse an MJCF that names pipes, devices or files that are too large; return the size of its data [byte].

    Files that it includes and models that it attaches count towards the limit of a description's size.

    Raises:
        SurefootError: one of these, or models that attach each other in a circle.
    """
    return _Search(path).add(root, path, ())


class _Search:
    """Search for the files that an MJCF names, which sums up their sizes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.left = CONFIGURATION_BYTES - path.stat().st_size
        self.seen: set[Path] = set()

    def add(self, root: ElementTree.Element, file: Path, above: tuple[Path, ...]) -> int:
        """Check what a file names, and return the size of data among it; `above` has the files that lead to it."""
        above = (*above, file.resolve())
        if len(above) > _MAX_NESTED:
            raise SurefootError(f"{self.path}: over {_MAX_NESTED} files include or attach each other in a row")
        folders = {self.path.parent, file.parent}
        compilers = list(root.iter("compiler"))
        folders |= {folder / item.get(key, "") for item in compilers for key in _FOLDERS for folder in folders}
        size = 0
        for element in root.iter():
            for name in (value for key, value in element.attrib.items() if key.startswith("file") and value):
                for found in _existing(folders, name):
                    if element.tag in _PARTS:
                        size += self._add_part(found, name, above)
                    elif found not in self.seen:
                        with describe_os_errors(f"{self.path}: the file '{name}' that it names"):
                            check_readable(found, MAX_MESH_BYTES)
                        size += found.stat().st_size
                        self.seen.add(found)
        return size

    def _add_part(self, found: Path, name: str, above: tuple[Path, ...]) -> int:
        if found in above:
            raise SurefootError(
                f"{self.path}: the file '{name}' includes or attaches itself; a model can't hold itself"
            )
        if found in self.seen:
            return 0
        with describe_os_errors(f"{self.path}: the file '{name}' that it names"):
            check_readable(found, CONFIGURATION_BYTES)
            self.left -= found.stat().st_size
        if self.left < 0:
            limit = f"{CONFIGURATION_BYTES >> 10} KiB in all are read"
            raise SurefootError(f"{self.path}: includes and attaches files that are too large: at most {limit}")
        size = self.add(read_xml(found), found, above)
        self.seen.add(found)
        return size


def _existing(folders: set[Path], name: str) -> Iterator[Path]:
    """Yield the files that a name may mean: MuJoCo looks beside the model, or in a folder that its compiler names."""
    words = {name.strip(), Path(name.replace("\\", "/")).name}  # the last one: strippath
    for path in {folder / word for folder in folders for word in words}:
        try:
            found = path.resolve()
            if found.exists() and not found.is_dir():
                yield found
        except (OSError, ValueError, RuntimeError):  # no name of a file, or a circle of links
            continue
