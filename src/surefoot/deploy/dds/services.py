"""Services of a Go2 over DDS: requests on rt/api/NAME/request, responses on rt/api/NAME/response.

Call numbers and error codes are from the vendor's SDK (unitree_sdk2_python: `comm/motion_switcher`, `go2/sport`,
`rpc/internal.py`). A call number has a different meaning in each service: 1001 asks the motion switcher for its mode,
but makes the sport service damp all motors, so that a standing robot drops.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Mapping
from typing import Any

from surefoot.deploy.dds import types
from surefoot.deploy.dds.bus import Bus
from surefoot.errors import SurefootError

MOTION_SWITCHER = "motion_switcher"
CHECK_MODE, SELECT_MODE, RELEASE_MODE = 1001, 1002, 1003
SPORT = "sport"
DAMP, BALANCE_STAND, STOP_MOVE, STAND_UP, STAND_DOWN, RECOVERY_STAND = 1001, 1002, 1003, 1004, 1005, 1006
OWN_CONTROLLER = "mcf"
"""Name of the robot's own controller in the motion switcher, since version 1.1.6 of the robot's software."""
OK, NOT_IMPLEMENTED, BAD_PARAMETER = 0, 3203, 3204
_QUEUE_DEPTH = 16
_RESEND_AFTER = 0.3
"""Time after which a request is repeated [s]; DDS discovery may have been incomplete when it was sent."""
_POLL_PERIOD = 0.002

Answer = tuple[int, str]
"""Error code (0: no error) and data of a response."""
Handler = Callable[[str], Answer]
"""Function from the parameter of a call to its answer."""


def _topics(service: str) -> tuple[str, str]:
    return f"rt/api/{service}/request", f"rt/api/{service}/response"


def parse_object(text: str) -> dict[str, Any]:
    """Parse a JSON object; return {} for anything else."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


class Server:
    """Server of a service. It has no thread: call `serve` frequently.

    Args:
        bus: DDS participant.
        service: name of the service.
        handlers: handlers by call number.
    """

    def __init__(self, bus: Bus, service: str, handlers: Mapping[int, Handler]) -> None:
        request, response = _topics(service)
        self._requests = bus.reader(request, types.Request, _QUEUE_DEPTH)
        self._responses = bus.writer(response, types.Response)
        self._handlers = handlers

    def serve(self) -> None:
        """Answer the requests that have arrived since the last call."""
        for request in self._requests.take_messages(_QUEUE_DEPTH):
            identity = request.header.identity
            handler = self._handlers.get(identity.api_id)
            if handler is not None:
                code, data = handler(request.parameter)
            else:
                # Call 1 of every service returns its version.
                code, data = (OK, "1.0.0.1") if identity.api_id == 1 else (NOT_IMPLEMENTED, "")
            if not request.header.policy.noreply:
                header = types.ResponseHeader(identity, types.ResponseStatus(code))
                self._responses.write_message(types.Response(header, data))


class Client:
    """Client of a service."""

    def __init__(self, bus: Bus, service: str) -> None:
        request, response = _topics(service)
        self.service = service
        self._requests = bus.writer(request, types.Request)
        self._responses = bus.reader(response, types.Response, _QUEUE_DEPTH)
        # Other clients receive the same responses, so numbers start at the present time, as in the vendor's clients.
        self._numbers = itertools.count(time.monotonic_ns())

    def send(self, call: int, parameter: Mapping[str, Any] | None = None, number: int | None = None) -> int:
        """Send a request and return its number; `number` is given to repeat an earlier request."""
        if number is None:
            number = next(self._numbers)
        header = types.RequestHeader(types.RequestIdentity(number, call))
        self._requests.write_message(types.Request(header, json.dumps(dict(parameter or {}))))
        return number

    def responses(self) -> dict[int, Answer]:
        """Return the responses since the last call, by number of the request, without waiting."""
        return {
            response.header.identity.id: (response.header.status.code, response.data)
            for response in self._responses.take_messages(_QUEUE_DEPTH)
        }

    def call(self, call: int, parameter: Mapping[str, Any] | None = None, timeout: float = 3.0) -> str:
        """Send a request, and return the data of its response; wait at most `timeout` [s].

        Raises:
            SurefootError: no response, or an error code.
        """
        number = self.send(call, parameter)
        sent = started = time.monotonic()
        while (now := time.monotonic()) - started < timeout:
            answer = self.responses().get(number)
            if answer is not None:
                code, data = answer
                if code:
                    raise SurefootError(f"service {self.service} of the robot answers call {call} with error {code}")
                return data
            if now - sent > _RESEND_AFTER:
                self.send(call, parameter, number)
                sent = now
            time.sleep(_POLL_PERIOD)
        raise SurefootError(f"service {self.service} of the robot does not answer within {timeout:g} s")


def mode_name(data: str) -> str:
    """Return the name of the active controller from the data of CHECK_MODE; "" if none is active."""
    name = parse_object(data).get("name", "")
    return name[:32] if isinstance(name, str) else ""
