"""Import of recorded Go2 messages from bags and CSV files, including damaged and hostile files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("rosbags")

from emulated_go2 import GO2, STANDING, Robot
from go2_bag import csv_line, write_bag

from surefoot.cli.main import main
from surefoot.deploy.dds import low_level
from surefoot.deploy.dds.low_level import LOW_COMMAND, LOW_STATE, POS_STOP, encode
from surefoot.errors import SurefootError
from surefoot.identify.motion import go2_messages as go2
from surefoot.identify.motion.importing import import_log
from surefoot.identify.motion.recorded import common_gains
from surefoot.identify.motion.traces import motion_from_trace, trace_from_motion
from surefoot.task.trace import EpisodeTrace

RECORDED = Path(__file__).parents[2] / "deploy" / "dds" / "recorded_messages.json"
KP, KD = 60.0, 5.0
Messages = list[tuple[str, int, bytes]]


def fill(record: Any, table: dict[str, Any]) -> None:
    for name, value in table.items():
        if isinstance(value, dict):
            fill(record[name], value)
        elif isinstance(value, list) and isinstance(value[0], dict):
            for k, one in enumerate(value):
                fill(record[name][k], one)
        else:
            record[name] = value


def recorded(kind: str) -> Any:
    record = low_level.new_record(LOW_STATE if kind == "low_state" else LOW_COMMAND)
    fill(record, json.loads(RECORDED.read_text())[kind])
    return record


def state(tick: int, **motors: float) -> bytes:
    record = recorded("low_state")
    record["tick"] = tick
    for name, value in motors.items():
        record["motor_state"][name][:12] = value
    return encode(record)


def command(**fields: Any) -> bytes:
    record = low_level.new_command()
    for name, value in {"q": 0.5, "dq": 0.0, "kp": KP, "kd": KD, **fields}.items():
        record["motor_cmd"][name][:12] = value
    return encode(record)


def log(*rows: bytes | int) -> Messages:
    """Return messages 1 ms apart; a number means a state with this tick."""
    data = [state(row) if isinstance(row, int) else row for row in rows]
    return [("/lowcmd" if len(one) < 1000 else "/lowstate", 10**6 * k, one) for k, one in enumerate(data, 1)]


def imported(folder: Path, messages: Messages, **options: Any) -> EpisodeTrace:
    return trace_from_motion(import_log(write_bag(folder / "bag", messages), GO2, **options), GO2)


@pytest.fixture(scope="module")
def run() -> tuple[Messages, np.ndarray]:
    """Return the messages of a robot on a rack that moves its legs, and the commanded angles."""
    robot, messages, targets = Robot(rack=True), [], []
    robot.run(0.002)
    for step in range(500):
        time = 0.002 * step
        angles = STANDING + np.tile([0.0, 0.15, -0.2], 4) * np.sin(12 * time) * min(time / 0.2, 1.0)
        robot.command(q=angles, kp=KP, kd=KD)
        sent = robot.wire.inbound[-1]
        messages.append(("/lowcmd", robot.board.now * 1000 + 1_500_000, encode(sent)))
        targets.append(sent["motor_cmd"]["q"][:12].astype(float))
        robot.run(0.002)
        messages.append(("/lowstate", robot.board.now * 1000 + 200_000, robot.wire.sent[-1][1]))
    return messages, np.array(targets)


@pytest.mark.parametrize("mcap", [False, True])
def test_a_bag_has_what_the_robot_sent(tmp_path: Path, run: tuple[Messages, np.ndarray], mcap: bool) -> None:
    messages, targets = run
    bag = write_bag(tmp_path / "bag", messages, mcap)
    trace = trace_from_motion(import_log(next(bag.glob("*.mcap")) if mcap else bag, GO2), GO2)
    states = [low_level.decode(LOW_STATE, data) for topic, _, data in messages if topic == "/lowstate"]
    np.testing.assert_allclose(trace.time, 0.002 * np.arange(500), atol=1e-9)
    np.testing.assert_allclose(trace.target, targets, atol=1e-6)
    np.testing.assert_array_equal(trace.motor_angle, [one["motor_state"]["q"][:12] for one in states])
    np.testing.assert_array_equal(trace.motor_torque, [one["motor_state"]["tau_est"][:12] for one in states])
    np.testing.assert_allclose(trace.roll_pitch_yaw, [one["imu_state"]["rpy"] for one in states], atol=1e-6)
    assert trace.meta["params"] == {"servo_kp": [KP] * 12, "servo_kd": [KD] * 12}


def test_a_log_replays_exactly_on_the_robot_that_recorded_it(
    tmp_path: Path, run: tuple[Messages, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    bag, trace = write_bag(tmp_path / "bag", run[0]), tmp_path / "trace.npz"
    assert main(["identify", "import", str(bag), "--robot", "go2", "--out", str(trace)]) == 0
    assert "500 rows, 1.00 s; steps of 2.00 to 2.00 ms" in capsys.readouterr().out
    # Its readings have no delay. Gains are sent with the commands.
    assert main(["identify", "replay", str(trace), "--rack", "--set", "control_latency=0", "--json"]) == 0
    exact = json.loads(capsys.readouterr().out)
    assert exact["rms"] < 2e-3
    assert (
        main(["identify", "replay", str(trace), "--rack", "--set", "control_latency=0", "servo_kp=40", "--json"]) == 0
    )
    assert json.loads(capsys.readouterr().out)["rms"] > 5 * exact["rms"]


def test_csv_of_states_without_names_and_with(tmp_path: Path) -> None:
    rows = [state(tick, dq=0.1 * k) for k, tick in enumerate((5, 7, 9))]
    (tmp_path / "echo.csv").write_text("\n".join(map(csv_line, rows)) + "\n")
    trace = trace_from_motion(import_log(tmp_path / "echo.csv", GO2), GO2)
    np.testing.assert_allclose(trace.time, [0.0, 0.002, 0.004], atol=1e-12)
    np.testing.assert_allclose(trace.motor_velocity[:, 3], [0.0, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(trace.motor_angle[1], recorded("low_state")["motor_state"]["q"][:12], atol=1e-6)
    np.testing.assert_allclose(trace.roll_pitch_yaw[1], recorded("low_state")["imu_state"]["rpy"], atol=1e-3)
    assert np.isnan(trace.target).all()
    assert trace.meta["notes"] == ["no row has a target: replay also needs /lowcmd"]
    with pytest.raises(SurefootError, match="no two consecutive rows with commands; replay and"):
        motion_from_trace("log", trace)
    # As plotting tools write it: names with topics, and one row per message of either topic.
    names = ["time", "/lowstate/tick"]
    names += [f"/lowstate/motor_state[{k}]/q" for k in range(12)]
    names += [f"/lowcmd/motor_cmd[{k}]/{name}" for k in range(12) for name in ("q", "kp", "kd")]
    blank, sent = [""] * 36, [0.5, KP, KD] * 12
    lines = [names, [0, 5, *[0.4] * 12, *blank], [1, "", *[""] * 12, *sent], [2, 7, *[0.4] * 12, *blank]]
    (tmp_path / "plot.csv").write_text("\n".join(",".join(map(str, line)) for line in lines))
    motion = import_log(tmp_path / "plot.csv", GO2)
    np.testing.assert_array_equal(motion.command[:, 0], [np.nan, 0.5])
    assert np.isnan(motion.roll_pitch_yaw).all()


def test_targets_follow_the_vendors_law(tmp_path: Path) -> None:
    rows: list[bytes | int] = [2, command(), 4, command(tau=6.0, dq=2.0), 6, command(q=POS_STOP), 8]
    rows += [command(kp=0.0), 10, command(mode=0), 12, command(kp=30.0), 14, command(q=np.nan), 16]
    messages = log(*rows, command(dq=low_level.VEL_STOP, kd=KD), 18, command(), 20, 22)
    motion = import_log(write_bag(tmp_path / "bag", messages), GO2)
    # tau + kp (q - angle) + kd (dq - speed) is kp (target - angle) - kd speed
    moved = 0.5 + (6.0 + KD * 2.0) / KP
    targets = [np.nan, 0.5, moved, *[np.nan] * 6, 0.5, 0.5]
    np.testing.assert_allclose(motion.command[:, 4], targets, atol=1e-6)
    assert motion.meta["notes"] == [
        "7 of 11 rows have no target: no command, a motor without gain, or other gains",
    ]
    assert motion.crop(0.002, 0.004).command[:, 0].tolist() == pytest.approx([0.5, moved], abs=1e-6)
    with pytest.raises(SurefootError, match=r"--between 1 2 has 0 rows; the log is 0\.02 s long"):
        motion.crop(1.0, 2.0)


def test_the_longest_part_with_commands_is_replayed(tmp_path: Path) -> None:
    rows: list[bytes | int] = []
    for tick in range(2, 42, 2):
        rows += [command(q=0.01 * tick) if tick not in (2, 10, 12) else command(kp=0.0), tick]
    first = motion_from_trace("log", imported(tmp_path, log(*rows)))
    np.testing.assert_allclose(first.time, 0.001 * np.arange(12, 40, 2))
    np.testing.assert_array_equal(first.read_time, first.time)
    assert first.gains == {"servo_kp": [KP] * 12, "servo_kd": [KD] * 12}
    (tmp_path / "other").mkdir()
    rows = [row if isinstance(row, int) else command(q=0.1 * k, kp=30.0) for k, row in enumerate(rows)]
    other = motion_from_trace("other", imported(tmp_path / "other", log(*rows)))
    assert common_gains([first, first]) == first.gains
    with pytest.raises(SurefootError, match="logs log and other have commands with different gains"):
        common_gains([first, other])


def test_ticks_are_the_clock(tmp_path: Path) -> None:
    # Repeated, late and wrapped ticks, a gap in which commands are unknown, and a restart of the robot.
    ticks = [2**32 - 4, 2**32 - 2, 2**32 - 2, 0, 2**32 - 4, 4, 104, 106, 108, 2, 4]
    trace = imported(tmp_path, log(2**32 - 4, command(), *ticks[1:]))
    np.testing.assert_allclose(trace.time, [0, 0.002, 0.004, 0.008, 0.108, 0.110, 0.112], atol=1e-9)
    assert np.isnan(trace.target[:, 0]).tolist() == [True, False, False, False, True, False, False]
    assert trace.meta["notes"][:2] == [
        "2 states were left out: they repeat a tick or arrived late",
        "the robot's tick restarted 1 times: only the longest part is used",
    ]


def test_damaged_messages_are_left_out(tmp_path: Path) -> None:
    good, flipped = state(4), bytearray(state(6))
    flipped[100] ^= 1
    bad = recorded("low_state")
    bad["imu_state"]["quaternion"], bad["tick"] = 0.0, 10
    bad["motor_state"]["q"][0] = np.inf
    messages = log(2, good, bytes(flipped), good[:-4] + bytes(4), state(8)[:-2], command()[:-1], encode(bad))
    trace = imported(tmp_path, messages)
    assert trace.meta["notes"][0] == "4 messages were left out: wrong length or wrong checksum"
    assert np.isnan(trace.roll_pitch_yaw[-1]).all()
    assert np.isnan(trace.motor_angle[-1]).tolist() == [True] + [False] * 11
    (tmp_path / "all").mkdir()
    assert imported(tmp_path / "all", messages, any_checksum=True).num_steps == 4  # 2, 4, 6 and 10


NAMES = ["tick", *(f"motor_state[{k}].q" for k in range(12))]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([["1"] * 100] * 2, "has no column names, and 100 numbers per line; a Go2 state has 349"),
        ([["1"] * 250] * 2, "holds commands, which have no time: record /lowstate and /lowcmd in a bag"),
        ([NAMES[1:], ["1"] * 12], "has no column for tick; columns: motor_state"),
        ([NAMES[:-1], ["1"] * 12], r"has no column for motor_state\[11\]\.q"),
        ([[*NAMES, "other/tick"], ["1"] * 14], "has 2 columns for tick: tick, other/tick; keep one topic"),
        ([NAMES, ["x"] * 13], "has no row with a tick"),
        ([NAMES, ["1"] * 13], "has 1 states, but no two with rising ticks"),
        ([NAMES, ["-1"] * 13], "state 0 has tick -1; ticks must be 0 to 4294967295 ms"),
        ([NAMES, ["1e300"] * 13], "state 0 has tick 1e.300; ticks must be"),
    ],
)
def test_a_csv_that_is_not_a_log_is_rejected(tmp_path: Path, lines: Sequence[Sequence[str]], message: str) -> None:
    (tmp_path / "log.csv").write_text("\n".join(map(",".join, lines)))
    with pytest.raises(SurefootError, match=message):
        import_log(tmp_path / "log.csv", GO2)


def test_a_bag_that_is_not_a_log_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = state(2)[:-4] + bytes(4)
    for name, messages, error in [
        ("commands", log(command()), r"has no topic of Go2 states .* topics: /lowcmd \(unitree_go/msg/LowCmd\)"),
        ("wrong", log(wrong), "the checksum is 0; it must be [0-9]*; --any-checksum accepts such messages"),
        ("short", log(state(2)[:-1]), "the message has 1179 bytes; it must have 1180"),
    ]:
        with pytest.raises(SurefootError, match=error):
            import_log(write_bag(tmp_path / name, messages), GO2)
    monkeypatch.setattr(go2, "MAX_MESSAGES", 2)
    bag = write_bag(tmp_path / "long", log(2, 4, 6))
    assert main(["identify", "import", str(bag), "--robot", "go2", "--out", str(tmp_path / "trace.npz")]) == 2
    assert capsys.readouterr().err.endswith("has 3 states and commands; at most 2 are read: split the bag\n")
