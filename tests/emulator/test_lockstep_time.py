"""Robot time that follows frames."""

from __future__ import annotations

from surefoot.emulator.lockstep_time import LockstepTime


def test_it_begins_with_the_first_frame_and_goes_on_as_they_do():
    time = LockstepTime()
    assert time.follow(5_000_000, 0, 0) == 0
    assert time.follow(5_100_000, 7, 0) == 100_000
    assert time.follow(5_250_000, 7, 7) == 250_000
    assert time.follow(5_300_000, 0, 7) == 300_000


def test_it_never_goes_back():
    time = LockstepTime()
    time.follow(0, 7, 0)
    assert time.follow(500, 7, 7) == 500
    assert time.follow(400, 7, 7) == 500
    assert time.follow(600, 7, 7) == 600


def test_another_operators_clock_is_put_to_the_present():
    time = LockstepTime()
    time.follow(0, 7, 0)
    time.follow(9_000, 7, 7)
    assert time.follow(100, 8, 7) == 9_000
    assert time.follow(150, 8, 7) == 9_050
    # Pings name nobody: they are the owner's, whoever that is.
    assert time.follow(9_060, 0, 7) == 9_060
    assert time.follow(200, 0, 8) == 9_100
