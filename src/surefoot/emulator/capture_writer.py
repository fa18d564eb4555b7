"""What a motion capture system and foot switches see of the emulated robot, as a growing CSV file."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path

import numpy as np

from surefoot.deploy.motion_capture import COLUMNS
from surefoot.emulator.plant import Plant
from surefoot.errors import SurefootError

PERIOD = 5_000
"""Time between two rows [us]: 200 Hz."""
_WRITE_EVERY = 0.05


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
            self._file = path.open("x", encoding="utf-8", buffering=1)
        except FileExistsError:
            raise SurefootError(f"motion capture {path} exists; give another name") from None
        except OSError as error:
            raise SurefootError(f"motion capture {path}: {error.strerror}") from error
        self._plant = plant
        self._last = plant.capture().contact_ticks, plant.ticks
        self._file.write(",".join([*COLUMNS, *(f"contact_{leg}" for leg in plant.robot.leg_names)]) + "\n")
        self._rows: deque[str] = deque()
        self._ended = threading.Event()
        self.failed: str | None = None
        """Why writing stopped, if it did."""
        self._writer = threading.Thread(target=self._write_on, daemon=True) if later else None
        if self._writer is not None:
            self._writer.start()

    def see(self, now: int) -> None:
        """Add a row if a servo step that ended at `now` [us] is due for one."""
        if now % PERIOD:
            return
        seen, ticks = self._plant.capture(), self._plant.ticks
        before, ticks_before = self._last
        contact = (seen.contact_ticks - before) / max(ticks - ticks_before, 1)
        self._last = seen.contact_ticks, ticks
        quat = seen.quat / np.linalg.norm(seen.quat)
        row = [now / 1e6, *seen.position.tolist(), *quat.tolist(), *contact.tolist()]
        self._rows.append(",".join(map(repr, row)) + "\n")
        if self._writer is None:
            self._write()

    def _write_on(self) -> None:
        while not self._ended.wait(_WRITE_EVERY):
            self._write()

    def _write(self) -> None:
        """Write the waiting rows; a full disk ends the recording, not the robot."""
        text = "".join(self._rows.popleft() for _ in range(len(self._rows)))
        if text and self.failed is None:
            try:
                self._file.write(text)
                self._file.flush()
            except OSError as error:
                self.failed = error.strerror or str(error)

    def close(self) -> None:
        """Write the rest and close the file."""
        self._ended.set()
        if self._writer is not None:
            self._writer.join()
        self._write()
        try:
            self._file.close()
        except OSError as error:
            self.failed = self.failed or error.strerror or str(error)
