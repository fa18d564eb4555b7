"""Worker process of a `ProcessWorld`: makes simulated robots and answers requests.

Pickled requests arrive on stdin, and pickled answers leave on the original stdout. Other output is redirected to
stderr. The process exits when stdin closes: when its world is closed, or when the owner process has ended for any
reason.
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
    """Return the world's answer; for steps and resets with the true state, which is almost always requested next."""
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
                world = None  # frees the memory of the previous world first
                world, reply = SimWorld(**arguments), (True, None)
            else:
                assert world is not None
                reply = True, _answer(world, method, arguments)
        except Exception as error:
            if not isinstance(error, SurefootError):
                error.add_note(f"in a worker process of the world:\n{traceback.format_exc()}")
            reply = False, error
        pickle.dump(reply, answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()


def main() -> NoReturn:
    """Answer requests until stdin closes."""
    # Interrupts are handled by the owner, which closes the pipe when it is done.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    answers, status = os.fdopen(os.dup(1), "wb"), 1
    os.dup2(2, 1)
    with contextlib.suppress(BrokenPipeError):
        _serve(sys.stdin.buffer, answers)
        status = 0
    # Exit without cleanup, which would take a second: there is nothing to save.
    os._exit(status)


if __name__ == "__main__":
    main()
