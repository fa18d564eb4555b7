"""What a motion capture system and foot switches see of the emulated robot, as a growing CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surefoot.deploy.background_file import BackgroundFile
from surefoot.deploy.motion_capture import COLUMNS
from surefoot.emulator.plant import Plant
from surefoot.errors import SurefootError

PERIOD = 5_000
"""Time between two rows [us]: 200 Hz."""
_WRITE_PERIOD = 0.05


class CaptureWriter:
    """Writes rows of time [s] on the robot's clock, base link's origin [m], unit quaternion and contacts.

    The contact of a foot is the share of the time since the row before in which it touched the ground.

    Args:
        path: file to write (.csv); it must not exist yet.
        plant: the body.
        later: let a thread write, 20 times per second, so that a slow disk does not delay the robot; otherwise every
            row is in the file when `see` returns.

    Raises:
        SurefootError: the file exists, or its folder does not.
    """

    def __init__(self, path: Path, plant: Plant, later: bool = False) -> None:
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            raise SurefootError(f"motion capture {path} exists; give another name") from None
        except OSError as error:
            raise SurefootError(f"motion capture {path}: {error.strerror}") from error
        self.file = BackgroundFile(path, _WRITE_PERIOD if later else None)
        self._plant = plant
        self._last = plant.capture().contact_ticks, plant.ticks
        self._add([*COLUMNS, *(f"contact_{leg}" for leg in plant.robot.leg_names)])

    def _add(self, words: list[str]) -> None:
        self.file.add((",".join(words) + "\n").encode())

    def see(self, now: int) -> None:
        """Add a row if a servo step that ended at `now` [us] is due for one."""
        if now % PERIOD:
            return
        seen, ticks = self._plant.capture(), self._plant.ticks
        before, ticks_before = self._last
        contact = (seen.contact_ticks - before) / max(ticks - ticks_before, 1)
        self._last = seen.contact_ticks, ticks
        quat = seen.quat / np.linalg.norm(seen.quat)
        self._add([*map(repr, [now / 1e6, *seen.position.tolist(), *quat.tolist(), *contact.tolist()])])

    def close(self) -> None:
        """Write the rest and close the file."""
        self.file.close()
