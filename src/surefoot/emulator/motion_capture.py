"""What a motion capture system and foot switches would see of the emulated robot, as a growing CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surefoot.emulator.plant import Plant
from surefoot.errors import SurefootError

PERIOD = 5_000
"""Time between two rows [us]: 200 Hz."""
COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")


class MotionCapture:
    """Writes rows of time [s] on the robot's clock, base link's origin [m], unit quaternion and contacts.

    The contact of a foot is the share of the time since the row before in which it touched the ground.

    Args:
        path: file to write (.csv); it must not be there yet.
        plant: the body.

    Raises:
        SurefootError: the file exists, or its folder does not.
    """

    def __init__(self, path: Path, plant: Plant) -> None:
        try:
            # Line after line: whoever reads along, or when all stands still in lockstep, finds every row.
            self._file = path.open("x", encoding="utf-8", buffering=1)
        except FileExistsError:
            raise SurefootError(f"motion capture {path} exists; give another name") from None
        except OSError as error:
            raise SurefootError(f"motion capture {path}: {error.strerror}") from error
        self._plant = plant
        self._last = plant.capture().contact_ticks, plant.ticks
        self._file.write(",".join([*COLUMNS, *(f"contact_{leg}" for leg in plant.robot.leg_names)]) + "\n")

    def see(self, now: int) -> None:
        """A servo step has ended at this time [us]."""
        if now % PERIOD:
            return
        seen, ticks = self._plant.capture(), self._plant.ticks
        before, ticks_before = self._last
        contact = (seen.contact_ticks - before) / max(ticks - ticks_before, 1)
        self._last = seen.contact_ticks, ticks
        quat = seen.quat / np.linalg.norm(seen.quat)
        row = [now / 1e6, *seen.position.tolist(), *quat.tolist(), *contact.tolist()]
        self._file.write(",".join(map(repr, row)) + "\n")

    def close(self) -> None:
        """End the file."""
        self._file.close()
