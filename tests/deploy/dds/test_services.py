"""Requests and responses on the loopback interface."""

from __future__ import annotations

import os
import threading

import pytest

from surefoot.errors import SurefootError

pytest.importorskip("cyclonedds")
from surefoot.deploy.dds import services
from surefoot.deploy.dds.bus import Bus

DOMAIN = 40 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])


def test_a_client_gets_the_answers_of_a_server() -> None:
    bus, mode, done = Bus("lo", DOMAIN), ["mcf"], threading.Event()

    def select(parameter: str) -> services.Answer:
        name = services.parse_object(parameter).get("name")
        if name != "mcf":
            return services.BAD_PARAMETER, ""
        mode[0] = name
        return services.OK, ""

    def release(_: str) -> services.Answer:
        mode[0] = ""
        return services.OK, ""

    handlers = {
        services.CHECK_MODE: lambda _: (services.OK, f'{{"form":"0","name":"{mode[0]}"}}'),
        services.SELECT_MODE: select,
        services.RELEASE_MODE: release,
    }
    server = services.Server(bus, services.MOTION_SWITCHER, handlers)

    def serve() -> None:
        while not done.wait(0.001):
            server.serve()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        client = services.Client(bus, services.MOTION_SWITCHER)
        assert services.mode_name(client.call(services.CHECK_MODE)) == "mcf"
        client.call(services.RELEASE_MODE)
        assert services.mode_name(client.call(services.CHECK_MODE)) == ""
        with pytest.raises(SurefootError, match="call 1002 with error 3204"):
            client.call(services.SELECT_MODE, {"name": "normal"})
        client.call(services.SELECT_MODE, {"name": services.OWN_CONTROLLER})
        assert services.mode_name(client.call(services.CHECK_MODE)) == "mcf"
        with pytest.raises(SurefootError, match="error 3203"):
            client.call(1099)
        with pytest.raises(SurefootError, match=r"service sport of the robot does not answer within 0\.1 s"):
            services.Client(bus, services.SPORT).call(services.STAND_DOWN, timeout=0.1)
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("data", ["", "null", "[1]", '{"name": 3}', "{" * 9000, '{"name": ""}', "\ud800"])
def test_data_without_a_controller_name(data: str) -> None:
    assert services.mode_name(data) == ""
