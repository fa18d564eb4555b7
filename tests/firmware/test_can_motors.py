"""The driver of motors on a CAN bus, against drives that are simulated: the frames of docs and manuals, and a step."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest
from compiled_firmware import compiled, needs_gcc, needs_qemu

from surefoot.firmware.project import write_sources
from surefoot.robot import RobotDescription

pytestmark = needs_gcc
MOTORS, DT = 12, 0.002
MAX_ANGLE, MAX_SPEED, MAX_TORQUE, MAX_KP, MAX_KD = 12.5, 45.0, 24.0, 500.0, 5.0
BUS = """
#include <string.h>
#include "can_bus.h"
#include "hal.h"
static can_frame in[64], out[64];
static int arrived, taken, sent;
uint64_t now;
uint64_t hal_time(void) { return now; }
void can_start(void) {}
bool can_send(const can_frame *frame) { if (sent == 64) return false; out[sent++] = *frame; return true; }
bool can_receive(can_frame *frame) { if (taken == arrived) return false; *frame = in[taken++]; return true; }
void put(unsigned id, const uint8_t *data) { if (taken == arrived) taken = arrived = 0;
    in[arrived].id = (uint16_t)id; memcpy(in[arrived++].data, data, 8); }
int get(uint8_t *data) { if (sent == 0) return -1; memcpy(data, out[0].data, 8);
    int id = out[0].id; memmove(out, out + 1, (size_t)--sent * sizeof(out[0])); return id; }
"""


class Order(ctypes.Structure):
    _fields_ = [(name, ctypes.c_float) for name in ("effort", "target", "kp", "kd", "feedforward")]


class Drive:
    """A drive with its motor, an inertia of .02 kg m2: obeys the last frame, and answers it."""

    def __init__(self) -> None:
        self.angle = self.speed = self.torque = 0.0
        self.on = False
        self.error = 0

    def obey(self, data: bytes) -> bytes:
        if data == b"\xff" * 7 + b"\xfc":
            self.on = True
        else:
            bits = int.from_bytes(data, "big")
            fields = [bits >> 48, bits >> 36 & 4095, bits >> 24 & 4095, bits >> 12 & 4095, bits & 4095]
            angle, speed = fields[0] / 65535 * 25.0 - 12.5, fields[1] / 4095 * 90.0 - 45.0
            kp, kd, torque = fields[2] / 4095 * MAX_KP, fields[3] / 4095 * MAX_KD, fields[4] / 4095 * 48.0 - 24.0
            self.torque = (torque + kp * (angle - self.angle) + kd * (speed - self.speed)) * self.on
        return self.answer()

    def answer(self, number: int = 0) -> bytes:
        p = round((self.angle + 12.5) / 25.0 * 65535)
        v, t = round((self.speed + 45.0) / 90.0 * 4095), round((np.clip(self.torque, -24, 24) + 24.0) / 48.0 * 4095)
        return bytes([number, *(p << 24 | v << 12 | t).to_bytes(5, "big"), 31, self.error])

    def step(self) -> None:
        self.speed += DT * self.torque / 0.02
        self.angle += DT * self.speed


class Bus:
    """The driver and its drives."""

    def __init__(self, folder: Path) -> None:
        write_sources(folder, RobotDescription.load("go2"))
        (folder / "bus.c").write_text(BUS)
        words = ["gcc", "-std=c11", "-shared", "-fPIC", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
        words += [f"-I{folder / name}" for name in ("core", "drivers")]
        sources = folder / "drivers" / "can_motors.c", folder / "bus.c"
        subprocess.run([*words, *map(str, sources), "-o", str(folder / "driver.so")], check=True)
        self.c = ctypes.CDLL(str(folder / "driver.so"))
        self.c.get.restype = ctypes.c_int
        self.drives = [Drive() for _ in range(MOTORS)]
        self.silent: set[int] = set()
        self.c.start_motors()

    def exchange(self) -> int:
        """Carry the frames both ways; return how many the driver sent."""
        data, count = (ctypes.c_uint8 * 8)(), 0
        while (number := self.c.get(data)) >= 0:
            answer = self.drives[number - 1].obey(bytes(data))
            if number - 1 not in self.silent:
                self.c.put(0, bytes([number]) + answer[1:])
            count += 1
        return count

    def read(self) -> np.ndarray:
        """Angles, speeds and torques (3, M)."""
        seen = np.zeros((3, MOTORS), np.float32)
        self.c.hal_read_motors(*(row.ctypes.data_as(ctypes.c_void_p) for row in seen))
        return seen

    def drive(self, **changes: float) -> None:
        orders = (Order * MOTORS)(*(Order(**changes) for _ in range(MOTORS)))
        self.c.hal_drive_motors(orders)

    def hazard(self) -> tuple[int, str]:
        text = ctypes.c_char_p(b"")
        return self.c.hal_hazard(ctypes.byref(text)) & 255, (text.value or b"").decode()

    def wait(self, microseconds: int) -> None:
        now = ctypes.c_uint64.in_dll(self.c, "now")
        now.value += microseconds


@pytest.fixture
def bus(tmp_path: Path) -> Bus:
    return Bus(tmp_path)


def test_drives_are_switched_on_follow_a_step_and_are_read(bus):
    assert bus.hazard() == (18, "a motor's drive does not answer")
    bus.c.hal_enable_motors()
    assert bus.exchange() == MOTORS
    assert all(drive.on for drive in bus.drives)
    for _ in range(300):
        bus.drive(target=0.7, kp=20.0, kd=0.8)
        assert bus.exchange() == MOTORS
        seen = bus.read()
        np.testing.assert_allclose(seen[0], [drive.angle for drive in bus.drives], atol=25 / 65535)
        np.testing.assert_allclose(seen[1], [drive.speed for drive in bus.drives], atol=90 / 4095)
        np.testing.assert_allclose(seen[2], [drive.torque for drive in bus.drives], atol=48 / 4095)
        for drive in bus.drives:
            drive.step()
        bus.wait(2000)
    assert bus.hazard() == (0, "")
    assert seen[0] == pytest.approx(0.7, abs=0.002)
    # A torque without gains, and numbers that are none.
    bus.drive(feedforward=1.5)
    bus.exchange()
    assert bus.read()[2] == pytest.approx(1.5, abs=0.012)
    bus.drive(feedforward=np.nan, target=np.nan, kp=np.nan, kd=np.inf)
    bus.exchange()
    assert all(np.isfinite(drive.torque) for drive in bus.drives)


def test_a_drive_that_is_silent_or_reports_an_error_damps(bus):
    bus.c.hal_enable_motors()
    bus.exchange()
    bus.read()
    bus.silent = {7}
    for _ in range(6):
        bus.drive()
        bus.exchange()
        bus.read()
        assert bus.hazard() == (0, "")
        bus.wait(2000)
    assert bus.hazard() == (18, "a motor's drive does not answer")
    bus.silent, bus.drives[3].error = set(), 5
    bus.drive()
    bus.exchange()
    bus.read()
    assert bus.hazard() == (18, "a motor's drive reports an error")


def test_frames_of_others_on_the_bus_have_no_effect(bus):
    before = bus.read()
    for number, name in ((99, 0), (0, 0), (1, 5)):
        bus.c.put(name, bytes([number, *[255] * 7]))
    np.testing.assert_array_equal(bus.read(), before)


@needs_qemu
def test_it_fits_the_stm32f405_with_its_bus():
    drivers = "drivers/can_motors.c stm32f4/can_bus.c drivers/no_sensors.c"
    assert compiled(RobotDescription.load("go2"), None, None, "board.elf", f"DRIVERS={drivers}").exists()
