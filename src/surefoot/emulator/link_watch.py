"""What a microcontroller knows of its link: frame numbers, age of frames, whether the link is clean."""

from __future__ import annotations

from surefoot.deploy.clock import ClockSync


class LinkWatch:
    """One operator's frames, seen from the robot. All times are whole microseconds on the robot's clock.

    Args:
        clean_gap: longest silence on a clean link.
    """

    def __init__(self, clean_gap: int) -> None:
        self.clean_gap = clean_gap
        self.last_number = 0
        """Highest number of a frame that was taken."""
        self.last_heard = 0
        self.old_numbers = 0
        """Frames dropped because their number was not above the last one taken."""
        self._clean_since: int | None = None
        self._sync = ClockSync(second=1_000_000)

    def restart(self) -> None:
        """Begin another session: its numbers and its clock are new."""
        self.last_number = 0
        self._sync.forget()
        self._clean_since = None

    def takes(self, number: int) -> bool:
        """Return whether a frame's number is above all before; if so, it is the last one from now on."""
        if number <= self.last_number:
            self.old_numbers += 1
            return False
        self.last_number = number
        return True

    def heard(self, now: int) -> None:
        """Take note that the operator was heard."""
        if self._clean_since is None or now - self.last_heard > self.clean_gap:
            self._clean_since = now
        self.last_heard = now

    def damaged(self) -> None:
        """Take note of a damaged frame: at best, the link is clean from the next good one on."""
        self._clean_since = None

    def clean_for(self, now: int) -> int:
        """Return how long the link has been clean."""
        if self._clean_since is None or now - self.last_heard > self.clean_gap:
            return 0
        return now - self._clean_since

    def age(self, now: int, sent: int) -> float:
        """Return the age of a frame that was sent at `sent` on the operator's clock; see `ClockSync`."""
        self._sync.add(sent, now)
        return self._sync.age(sent, now)
