"""Whether MuJoCo can compile a URDF that surefoot did not write, tried in a process of its own.

A robot's folder may be a stranger's. Its URDF may ask MuJoCo for anything, by an element <mujoco> or by meshes: for
more memory than there is, or for what never ends. A file with only the elements that surefoot writes needs no trial.
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

LIMITS = Limits(memory=2 << 30, time=5.0, patience=20.0)
_OWN = frozenset(
    {
        *("robot", "link", "inertial", "mass", "inertia", "origin", "visual", "collision", "geometry"),
        *("box", "cylinder", "sphere", "material", "color", "joint", "parent", "child", "axis", "limit"),
    }
)
"""Elements of the URDFs that surefoot writes and of the robots that ship: none takes more than its text."""


def check_urdf(path: Path, limits: Limits = LIMITS) -> None:
    """Refuse a URDF that MuJoCo can't compile within limits; one that was tried before is not tried again.

    Raises:
        SurefootError: it can't be read or compiled.
    """
    if any(element.tag not in _OWN for element in read_xml(path).iter()):
        _compile_confined(path, path.read_bytes(), limits)


@functools.lru_cache(maxsize=64)
def _compile_confined(path: Path, content: bytes, limits: Limits) -> None:
    """Compile a file in a process of its own; what it holds is the key of the results that are kept."""
    ending = sandbox.run_module(__name__, [str(path), str(limits.memory), str(limits.time)], limits)
    if ending.code == 2:
        raise SurefootError(ending.message)
    if ending.code:
        raise SurefootError(
            f"{path}: MuJoCo can't compile it within {limits.memory / 2**30:g} GiB and {limits.time:g} s "
            f"({ending.reason}); the description of a robot needs much less: leave out what is no part of the robot"
        )


def main(words: Sequence[str]) -> int:
    """Compile the file of the first word within limits; 2 after an error, which is printed."""
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
