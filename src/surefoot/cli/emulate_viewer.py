"""A window that shows the emulated robot, in a process of its own: it can't hold up the robot's."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from surefoot.cli.play import has_display
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

if TYPE_CHECKING:
    from surefoot.emulator.plant import Plant

Array = NDArray[np.float64]

PERIOD = 33_000
"""Time between two pictures [us]."""
_BASE = 7


class EmulateViewer:
    """Shows a robot while it runs.

    Args:
        robot: name or folder.
        plant: its body.

    Raises:
        SurefootError: there is no display.
    """

    def __init__(self, robot: str, plant: Plant) -> None:
        check_display()
        self._plant = plant
        context = multiprocessing.get_context("spawn")
        # Written here and read there without a lock: half a pose is drawn at worst, and for 1/60 s.
        self._shared = context.RawArray("d", _BASE + plant.robot.num_motors)
        self._next = 0
        self._write()
        self._process = context.Process(target=_show, args=(robot, self._shared), daemon=True)
        self._process.start()

    def see(self, now: int) -> None:
        """A servo step has ended at this time [us]."""
        if now >= self._next:
            self._next = now + PERIOD
            self._write()

    def _write(self) -> None:
        base = self._plant.capture()
        self._shared[:] = [*base.position, *base.quat, *self._plant.vitals().motor_angle]

    def close(self) -> None:
        """Close the window."""
        self._process.terminate()
        self._process.join()


def check_display() -> None:
    """Refuse to open a window where there is no display.

    Raises:
        SurefootError: there is none.
    """
    if not has_display():
        raise SurefootError("viewer: there is no display here (DISPLAY is not set); run without --viewer")


def pose_of(robot: RobotDescription, numbers: Any) -> dict[str, Array]:
    """Transforms of all links, by name, from base position, quaternion and motor angles in a row."""
    from surefoot.report.scene import poses

    row = np.array(numbers)
    return poses(robot, row[:3], row[3:_BASE], row[_BASE:])


def _show(name: str, shared: Any) -> None:
    """Draw what is shared until the window is closed."""
    import mujoco
    import mujoco.viewer

    from surefoot.cli.viewer import build_stage, set_stage
    from surefoot.report.scene import scene

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the emulator hears it too, and closes the window
    robot = RobotDescription.load(name)
    model = build_stage(scene(robot))
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as viewer:
        viewer.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        viewer.cam.trackbodyid = model.body(robot.base).id
        viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = 1.4, 120, -15
        while viewer.is_running():
            # Where a leg can't close its loop for a moment, the last picture stays.
            with contextlib.suppress(SurefootError):
                set_stage(model, data, pose_of(robot, shared), 0)
            viewer.sync()
            time.sleep(1e-6 * PERIOD)
