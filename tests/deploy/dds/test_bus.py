"""Topics on the loopback interface: messages between two processes, own messages ignored, invalid interfaces."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time

import pytest

from surefoot.deploy.dds import low_level
from surefoot.deploy.dds.low_level import LOW_COMMAND, LOW_STATE
from surefoot.errors import SurefootError

pytest.importorskip("cyclonedds")
from surefoot.deploy.dds import bus, types

DOMAIN = 20 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
OTHER = """
import sys, time
from surefoot.deploy.dds import bus, low_level, types
with_ = bus.Bus("lo", int(sys.argv[1]))
states = with_.reader(bus.LOW_STATE_TOPIC, types.LowState, 64)
commands = with_.writer(bus.LOW_COMMAND_TOPIC, types.LowCmd)
end = time.monotonic() + 60
while time.monotonic() < end:
    for data in states.take():
        command = low_level.new_command()
        command["motor_cmd"]["q"][3] = low_level.decode(low_level.LOW_STATE, data)["tick"]
        commands.write(low_level.encode(command))
    time.sleep(0.001)
"""


def test_two_processes_exchange_states_and_commands() -> None:
    here = bus.Bus("lo", DOMAIN)
    states = here.writer(bus.LOW_STATE_TOPIC, types.LowState)
    answers = here.reader(bus.LOW_COMMAND_TOPIC, types.LowCmd, 64, others=True)
    own = here.writer(bus.LOW_COMMAND_TOPIC, types.LowCmd)
    other = subprocess.Popen([sys.executable, "-c", OTHER, str(DOMAIN)])
    try:
        state, ticks, end = low_level.new_record(LOW_STATE), [], time.monotonic() + 50
        while len(ticks) < 20 and time.monotonic() < end:
            state["tick"] += 1
            assert states.write(low_level.encode(state))
            assert own.write(low_level.encode(low_level.new_command()))  # not among the answers: its q is PosStopF
            time.sleep(0.002)
            ticks += [float(low_level.decode(LOW_COMMAND, data)["motor_cmd"]["q"][3]) for data in answers.take()]
    finally:
        other.kill()
        other.wait()
    assert len(ticks) >= 20
    assert all(b > a for a, b in itertools.pairwise(ticks))
    assert ticks[-1] <= state["tick"]


@pytest.mark.parametrize("name", ["eth9", "", "lo; rm", "x" * 300])
def test_an_unknown_interface_is_rejected(name: str) -> None:
    with pytest.raises(SurefootError, match=r"must be one of .*lo"):
        bus.check_interface(name)


def test_the_address_of_the_loopback() -> None:
    assert bus.check_interface("lo") == "127.0.0.1"
