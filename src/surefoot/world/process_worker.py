"""One process of a `ProcessWorld`, or of one after another: makes its robots and answers requests until they end.

Requests come in on stdin and answers go out on what was stdout, pickled. What anything else prints goes to stderr.
The process ends when stdin does: when the world is closed, or when the process that owns it has ended, for any reason.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import traceback
from typing import Any, BinaryIO, NoReturn

from surefoot.errors import SurefootError
from surefoot.world.sim_world import SimWorld


def _answer(world: SimWorld, method: str, arguments: tuple[Any, ...]) -> Any:
    """Return the world's answer; after a step or a reset with the truth, which is nearly always requested next."""
    value = getattr(world, method)(*arguments)
    if method in ("step", "reset"):
        return value, world.truth(), world.divergences
    if method == "set_state":
        return world.divergences
    return value


def _serve(requests: BinaryIO, answers: BinaryIO) -> None:
    world: SimWorld | None = None
    while True:
        try:
            method, arguments = pickle.load(requests)
        except EOFError:
            return
        reply: tuple[bool, Any]
        try:
            if method == "make":
                world = None  # what the one before held is free then
                world, reply = SimWorld(**arguments), (True, None)
            else:
                assert world is not None
                reply = True, _answer(world, method, arguments)
        except Exception as error:
            if not isinstance(error, SurefootError):
                error.add_note(f"in a process of the world:\n{traceback.format_exc()}")
            reply = False, error
        pickle.dump(reply, answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()


def main() -> NoReturn:
    """Serve until stdin ends."""
    # Interrupts are meant for the owner; it closes its pipe when it has done what it does then.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    answers, status = os.fdopen(os.dup(1), "wb"), 1
    os.dup2(2, 1)
    with contextlib.suppress(BrokenPipeError):
        _serve(sys.stdin.buffer, answers)
        status = 0
    # There is nothing to save, and to take down all that is loaded takes a second.
    os._exit(status)


if __name__ == "__main__":
    main()
