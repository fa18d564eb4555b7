"""Programs that use the vendor's SDKs (`vendor_clients.py`), with an emulated Go2 in another process."""

from __future__ import annotations

import fcntl
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cyclonedds")

from processes import Emulator

pytestmark = pytest.mark.sdk
DOMAIN = 60 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
CLIENTS = Path(__file__).parents[2] / "vendor_clients.py"


def client(*words: object) -> dict[str, Any]:
    """Run a program; return its output, and the number of wrong checksums reported by the C++ SDK."""
    command = [sys.executable, CLIENTS, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return {**json.loads(done.stdout.splitlines()[-1]), "crc_errors": (done.stdout + done.stderr).count("CRC Error")}


@pytest.fixture
def go2(emulate: Callable[..., Emulator]) -> Callable[..., Emulator]:
    """Start emulated Go2s that end with the test."""
    return lambda domain, *words: emulate(
        "--robot", "go2", "--link", "dds", "--interface", "lo", "--domain", domain, *words
    )


@pytest.fixture
def domain_0() -> Iterator[int]:
    """Reserve the only domain that the C++ SDK supports for one test at a time on this computer."""
    with (Path(tempfile.gettempdir()) / "surefoot-dds-domain-0.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield 0


@pytest.mark.realtime
def test_the_vendors_cpp_sdk_reads_states_and_stands_the_robot_up(go2, domain_0: int) -> None:
    pytest.importorskip("unitree_interface")
    robot = go2(domain_0)
    read = client("read", 500)
    assert (read["crc_errors"], read["states"]) == (0, 500)
    # The SDK keeps only the newest state: some are lost between polls, which hardly affects the median.
    assert read["gap_ms"]["median"] == pytest.approx(2.0, abs=0.2)
    np.testing.assert_allclose(read["accelerometer"], [0, 0, 9.81], atol=0.3)
    q = client("stand")["q"]
    np.testing.assert_allclose(q, [0.0, 0.67, -1.3] * 4, atol=0.15)  # its frames have head 0 0 and level flag 0
    _, output = robot.stop()
    assert re.search(r"commands received \d{3,}, damaged 0", output)


@pytest.mark.realtime
def test_the_vendors_python_sdk_releases_the_robot_and_stands_it_up(go2, tmp_path: Path) -> None:
    pytest.importorskip("unitree_sdk2py")
    seen = tmp_path / "seen.csv"
    robot = go2(DOMAIN, "--motion-service", "standing", "--out", seen)
    done = client("stand-up", DOMAIN)
    assert done["modes"] == ["mcf", ""]
    assert done["damaged"] == 0
    assert done["states"] > 2000
    bad = client("bad-crc", DOMAIN)
    assert bad["moved"] < 0.02
    _, output = robot.stop()
    assert f"damaged {bad['sent']}" in output
    heights = np.genfromtxt(seen, delimiter=",", names=True)["z"]
    assert heights.max() > 0.33
    assert heights[-1] < 0.15


def test_a_service_that_does_not_answer_is_an_error(go2) -> None:
    from surefoot.deploy.dds.bus import Bus
    from surefoot.deploy.dds.services import CHECK_MODE, MOTION_SWITCHER, Client
    from surefoot.errors import SurefootError

    go2(DOMAIN, "--fault", "no-service")
    with pytest.raises(SurefootError, match="does not answer within 1 s"):
        Client(Bus("lo", DOMAIN), MOTION_SWITCHER).call(CHECK_MODE, timeout=1.0)
