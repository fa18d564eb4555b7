"""Robot time that follows the times in the frames of its operators."""

from __future__ import annotations


class LockstepTime:
    """Robot time, in whole microseconds, for frames as they come.

    Robot time begins with the first frame, and goes on as the time in the frames does: a frame's time on the robot's
    clock is its own plus an offset. Another operator has a clock of its own, and so an offset: the clock of the
    operator who comes first is that of the frames that name no session (pings); the clock of any other one is put to
    the present when it is first seen. Time that does not go forward leaves the robot's where it is.
    """

    def __init__(self) -> None:
        self.now = 0
        self._anonymous: int | None = None
        self._offsets: dict[int, int] = {}

    def follow(self, sent: int, session: int, owner: int) -> int:
        """The time to run to before a frame is handled.

        Args:
            sent: time of the frame on its sender's clock.
            session: session that it names; 0: none.
            owner: session that the robot obeys; 0: none.
        """
        if self._anonymous is None:
            self._anonymous = self.now - sent
        if session and session not in self._offsets:
            self._offsets[session] = self._anonymous if not self._offsets else self.now - sent
        offset = self._offsets.get(session or owner, self._anonymous)
        self.now = max(self.now, sent + offset)
        return self.now
