"""Check that MuJoCo can compile a URDF, tried in a separate process with limits of memory and time.

The folder of a robot may come from a third party. With an element <mujoco> or with meshes, its URDF may make MuJoCo use
too much memory or run indefinitely. Files that contain only the elements that surefoot writes are not tried.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from pathlib import Path

from surefoot import sandbox
from surefoot.errors import SurefootError
from surefoot.native_output import mujoco_errors
from surefoot.robot.urdf_file import read_xml
from surefoot.sandbox import Limits

LIMITS = Limits(memory=2 << 30, time=5.0, timeout=20.0)
_KNOWN_ELEMENTS = frozenset(
    {
        *("robot", "link", "inertial", "mass", "inertia", "origin", "visual", "collision", "geometry"),
        *("box", "cylinder", "sphere", "material", "color", "joint", "parent", "child", "axis", "limit"),
    }
)
"""Elements in URDFs that surefoot writes and ships. They need no more resources than their text."""


def check_urdf(path: Path, limits: Limits = LIMITS) -> None:
    """Check that MuJoCo can compile a URDF within limits; results are cached.

    Raises:
        SurefootError: a file that can't be read, or not compiled within the limits.
    """
    if any(element.tag not in _KNOWN_ELEMENTS for element in read_xml(path).iter()):
        _compile_confined(path, path.read_bytes(), limits)


@functools.lru_cache(maxsize=64)
def _compile_confined(path: Path, content: bytes, limits: Limits) -> None:
    """Compile a file in a separate process. Its content is part of the key of the cache."""
    ending = sandbox.run_module(__name__, [str(path), str(limits.memory), str(limits.time)], limits)
    if ending.code == 2:
        raise SurefootError(ending.message)
    if ending.code:
        raise SurefootError(
            f"{path}: MuJoCo can't compile it within {limits.memory / 2**30:g} GiB and {limits.time:g} s "
            f"({ending.reason}); the description of a robot needs much less: remove everything that is not part of it"
        )


def main(words: Sequence[str]) -> int:
    """Compile a file within limits and return the exit code, 2 after an error, which is printed.

    Args:
        words: path of the file, limit of memory [bytes] and limit of time [s].
    """
    file, memory, time = words
    import mujoco

    sandbox.limit_resources(Limits(int(memory), float(time), 0.0))
    try:
        with mujoco_errors(Path(file)):
            mujoco.MjSpec.from_file(file).compile()
    except SurefootError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
