"""Faults by name: how they are requested, and the effects of some on a running robot.

`tests/deploy/test_fault_table.py` and `tests/cli/test_doctor_cli.py` test the others.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.deploy.messages import Handshake, Hello, Mode, Reason
from surefoot.emulator.board import BOOT_TIME
from surefoot.emulator.fault_table import FAULTS, LINKS, describe, parse_faults
from surefoot.emulator.faults import flip_bits
from surefoot.errors import SurefootError

ME = 7


def test_faults_are_parsed():
    faults = parse_faults(["drop=0.2", "unplug=1.5", "battery-low=13@3.5", "other-robot", "hang", "corrupt@2"])
    assert list(faults) == ["drop", "unplug", "battery-low", "other-robot", "hang", "corrupt"]
    assert (faults["drop"].value, faults["drop"].start) == (0.2, 0.0)
    assert faults["unplug"].start == 1.5
    assert (faults["battery-low"].value, faults["battery-low"].start) == (13.0, 3.5)
    assert math.isnan(faults["other-robot"].value)
    assert (faults["hang"].value, faults["hang"].start) == (FAULTS["hang"].value, 1.0)
    assert faults["corrupt"].start == 2.0


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("melt", "'melt' is not a fault; choices: corrupt, drop"),
        ("drop=2", r"fault drop is 2; it must be 0 to 1 \(unit: probability per frame\)"),
        ("drop=-1", "fault drop is -1; it must be 0 to 1"),
        ("drop=x", "fault 'drop=x' has no valid number; write NAME, NAME=VALUE or NAME=VALUE@TIME"),
        ("drop=nan", "has no valid number"),
        ("drop=", "has no valid number"),
        ("drop@-1", "fault drop begins at -1 s; it must be 0 or more"),
        ("unplug=-1", r"fault unplug is -1; it must be 0 or more \(unit: s after arming\)"),
        ("unplug@2", "fault unplug has its time as value, unplug=TIME; 'unplug@2' gives another"),
        ("other-robot=3", "fault other-robot has no value; 'other-robot=3' gives one"),
        ("flip-sign=8", "fault flip-sign is 8; it must be 0 to 7"),
        ("swap-motors=7", "fault swap-motors is 7; it must be 0 to 6"),
        ("flip-sign=0.5", "fault flip-sign is 0.5; it must be a whole number"),
    ],
)
def test_unknown_faults_and_values_out_of_range_are_rejected(word, message):
    with pytest.raises(SurefootError, match=message):
        parse_faults([word])


def test_duplicate_faults_and_faults_of_the_other_clock_are_rejected():
    with pytest.raises(SurefootError, match="fault drop is given twice"):
        parse_faults(["drop", "drop=0.1"])
    for name in ("batching", "overload"):
        with pytest.raises(SurefootError, match=f"fault {name} concerns real time; it cannot be used with --lockstep"):
            parse_faults([name], lockstep=True)


def test_a_link_supports_the_faults_of_its_targets():
    assert set(LINKS) == {"serial", "dds"}
    for name, kind in FAULTS.items():
        for link, targets in LINKS.items():
            if kind.target in targets:
                assert list(parse_faults([name], motors=12, link=link)) == [name]
            else:
                (other,) = kind.links
                message = f"fault {name} acts on {kind.target}, which --link {link} does not have; give --link {other}"
                with pytest.raises(SurefootError, match=message):
                    parse_faults([name], motors=12, link=link)


def test_one_to_three_bits_are_flipped_and_none_before_the_first():
    random, data = np.random.default_rng(3), bytes(range(40))
    counts = set()
    for _ in range(200):
        bits = np.unpackbits(np.frombuffer(flip_bits(data, random, first=32), np.uint8))
        flipped = np.flatnonzero(bits != np.unpackbits(np.frombuffer(data, np.uint8)))
        counts.add(len(flipped))
        assert flipped.min() >= 32
    assert counts == {1, 2, 3}


def test_every_fault_is_described():
    lines = describe()
    assert len(lines) == len(FAULTS)
    assert lines[1] == "drop=0.05 (probability per frame): frames are lost"


def test_each_line_fault_starts_at_its_time(rig):
    bench = rig("drop=1@0.1", "duplicate=1")
    bench.arm()
    bench.walk(16)
    assert bench.mode == (Mode.POSITION, Reason.NONE)
    assert not bench.line.inbound.counts["drop"]
    assert bench.walk(20)[1:] == []
    assert bench.mode == (Mode.FAULT, Reason.TIMEOUT)


def test_states_come_in_batches_as_some_adapters_deliver_them(rig):
    bench = rig("batching=0.016")
    bench.send(Hello(ME, 0.002))
    counts = [len(bench.run(1000)) for _ in range(160)]
    assert [at for at, count in enumerate(counts, 1) if count] == list(range(16, 161, 16))
    assert sum(counts) == 80  # a handshake, and a state every 2 ms


@pytest.mark.parametrize(("way", "signs"), [("0", None), ("1", (-1, 1)), ("2", (1, -1)), ("3", (-1, -1))])
def test_a_flipped_imu_exchanges_or_negates_roll_and_pitch(rig, way, signs):
    bench = rig(f"imu-flip={way}")
    bench.board.plant.params.imu_bias[0] = [0.1, 0.2]
    bench.arm()
    bench.walk(2)
    roll, pitch, _ = bench.states[-1].message.roll_pitch_yaw
    expected = (0.2, 0.1) if signs is None else (0.1 * signs[0], 0.2 * signs[1])
    np.testing.assert_allclose([roll, pitch], expected, rtol=1e-6)


def test_a_reboot_ends_the_session(rig):
    bench = rig("reboot=0.1")
    bench.arm()
    bench.walk(16)
    assert bench.mode == (Mode.POSITION, Reason.NONE)
    bench.walk(60)
    assert bench.board.reboots == 1
    assert bench.mode == (Mode.DISARMED, Reason.NONE)
    assert bench.board.firmware.owner == 0
    assert set(bench.reasons) == {Reason.SESSION}
    # It counts from one again, and can be connected again.
    assert bench.frames[-1].sequence < 20
    bench.send(Hello(ME, 0.01))
    assert isinstance(bench.frames[-1].message, Handshake)


def test_a_hang_makes_commands_stale_or_ends_with_a_restart(rig):
    bench = rig("hang=0.2@0.1")
    bench.arm()
    bench.walk(16)
    armed_at = bench.board.injector.armed_at
    sent = bench.walk(30)[2:]
    bench.walk(10)
    if bench.board.reboots:
        # The firmware in C has a watchdog: the motors are damped after 20 ms, and its operator is forgotten.
        assert bench.mode == (Mode.DISARMED, Reason.NONE)
        assert set(bench.reasons) == {Reason.SESSION}
        assert bench.board._booted - BOOT_TIME - armed_at - 100_000 == pytest.approx(21_000, abs=1000)
        return
    assert sent == []
    # Then all data that have arrived are processed at once: the oldest commands are too old.
    assert bench.board.firmware.mode == Mode.FAULT
    assert bench.board.firmware.reason in (Reason.STALE, Reason.TIMEOUT)
