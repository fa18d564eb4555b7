"""Motion capture and foot switches of the emulated robot, written to a growing CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surefoot.deploy.background_file import BackgroundFile
from surefoot.deploy.motion_capture import COLUMNS
from surefoot.emulator.plant import Plant
from surefoot.errors import SurefootError

PERIOD = 5_000
"""Period of the rows [us]: 200 Hz."""
_WRITE_PERIOD = 0.05


class CaptureWriter:
    """Writes rows with time on the robot's clock [s], origin of the base link [m], unit quaternion and contacts.

    The contact of a foot is the fraction of the time since the last row in which it touched the ground.

    Args:
        path: file to write (.csv); it must not exist.
        plant: simulated body of the robot.
        later: whether another process writes, 20 times per second, so that a slow disk does not delay the robot;
            otherwise each row is in the file when `update` returns.

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

    def update(self, now: int) -> None:
        """Add a row if one is due at `now` [us], the end of a servo step."""
        if now % PERIOD:
            return
        sample, ticks = self._plant.capture(), self._plant.ticks
        last_contact_ticks, last_ticks = self._last
        contact = (sample.contact_ticks - last_contact_ticks) / max(ticks - last_ticks, 1)
        self._last = sample.contact_ticks, ticks
        quat = sample.quat / np.linalg.norm(sample.quat)
        self._add([*map(repr, [now / 1e6, *sample.position.tolist(), *quat.tolist(), *contact.tolist()])])

    def close(self) -> None:
        """Write the remaining rows and close the file."""
        self.file.close()
