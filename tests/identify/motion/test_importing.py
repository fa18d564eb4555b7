"""Import of third-party logs: columns, units and signs; missing readings stay missing."""

from __future__ import annotations

import codecs
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.motion import column_table as log_table
from surefoot.identify.motion.column_table import read_table
from surefoot.identify.motion.importing import import_log
from surefoot.identify.motion.traces import motion_from_trace, trace_from_motion
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace


def mapping(path: Path, robot: RobotDescription, command: str, angle: str, first: str = "", head: str = "") -> Path:
    lines = [head, "motors:"]
    for k, name in enumerate(robot.motor_names):
        more = first if k == 0 else ""
        lines.append(f'  {name}: {{command: "{command.format(k)}", angle: "{angle.format(k)}"{more}}}')
    path.write_text("\n".join(lines))
    return path


def test_import_applies_units_signs_and_offsets(tmp_path: Path, pupper: RobotDescription):
    names = ["ms", *(f"c{k}" for k in range(12)), *(f"q{k}" for k in range(12))]
    rows = [[10 * t, *[t] * 12, *[-t] * 11, ""] for t in (1, 2, 2, 4)]
    lines = [",".join(names), *(",".join(map(str, row)) for row in rows)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    head = "time: {column: ms, unit: ms}\nunit: deg"
    which = mapping(tmp_path / "m.yaml", pupper, "c{}", "q{}", ", sign: -1, offset: 0.5", head)
    motion = import_log(tmp_path / "log.csv", pupper, which)
    trace = trace_from_motion(motion, pupper)
    np.testing.assert_allclose(trace.time, [0.01, 0.02, 0.02, 0.04])
    degree = np.pi / 180
    np.testing.assert_allclose(trace.target[:, 0], 0.5 - degree * np.array([1, 2, 2, 4]))
    np.testing.assert_allclose(trace.target[:, 1], degree * np.array([1, 2, 2, 4]))
    np.testing.assert_allclose(trace.motor_angle[:, 0], 0.5 + degree * np.array([1, 2, 2, 4]))
    assert np.isnan(trace.motor_angle[:, 11]).all()
    assert motion.missing() == ["motor_velocity", "motor_torque", "roll_pitch_yaw", "angular_velocity_base"]
    # The result is an ordinary trace, which can be saved and replayed.
    again = EpisodeTrace.load(trace.save(tmp_path / "trace.npz"))
    np.testing.assert_array_equal(again.target, trace.target)
    assert motion_from_trace("log", again).timing()["repeated_times"] == pytest.approx(1 / 3)


def test_import_reads_pickles_of_rows_and_of_arrays(tmp_path: Path, pupper: RobotDescription):
    time, angles = np.array([0.0, 0.01, 0.02]), np.arange(36.0).reshape(3, 12).astype(np.float32)
    (tmp_path / "arrays.pkl").write_bytes(pickle.dumps({"time": time, "command": angles, "motor_angle": 2 * angles}))
    rows = [{"t": float(t), "c": a.tolist(), "q": 2 * a} for t, a in zip(time, angles, strict=True)]
    (tmp_path / "rows.pkl").write_bytes(pickle.dumps(rows, protocol=5))
    which = mapping(tmp_path / "m.yaml", pupper, "c[{}]", "q[{}]", head="time: {column: t}")
    for motion in (import_log(tmp_path / "arrays.pkl", pupper), import_log(tmp_path / "rows.pkl", pupper, which)):
        np.testing.assert_array_equal(motion.command, angles)
        np.testing.assert_array_equal(motion.motor_angle, 2 * angles)


def test_a_log_of_states_needs_no_commands(tmp_path: Path, pupper: RobotDescription):
    angles = np.arange(36.0).reshape(3, 12)
    np.savez(tmp_path / "log.npz", t=[0.0, 0.01, 0.02], q=angles)
    lines = [f"  {name}: {{angle: 'q[{k}]'}}" for k, name in enumerate(pupper.motor_names)]
    (tmp_path / "m.yaml").write_text("\n".join(["time: {column: t}", "motors:", *lines]))
    motion = import_log(tmp_path / "log.npz", pupper, tmp_path / "m.yaml")
    assert np.isnan(motion.command).all()
    np.testing.assert_array_equal(motion.motor_angle, angles)
    # The trace can be shown and evaluated, but not replayed.
    trace = EpisodeTrace.load(trace_from_motion(motion, pupper).save(tmp_path / "trace.npz"))
    np.testing.assert_array_equal(trace.motor_angle, angles)
    with pytest.raises(SurefootError, match="has no two consecutive rows with commands"):
        motion_from_trace("log", trace)
    # A mapping with commands for some motors only is a mistake.
    lines[3] = lines[3].replace("{angle", "{command: 'q[3]', angle")
    (tmp_path / "m.yaml").write_text("\n".join(["time: {column: t}", "motors:", *lines]))
    with pytest.raises(SurefootError, match=r"m.yaml: motors.rightFrontLegMotor has no command, but other motors have"):
        import_log(tmp_path / "log.npz", pupper, tmp_path / "m.yaml")
    lines = [f"  {name}: {{torque: 'q[{k}]'}}" for k, name in enumerate(pupper.motor_names)]
    (tmp_path / "m.yaml").write_text("\n".join(["time: {column: t}", "motors:", *lines]))
    with pytest.raises(SurefootError, match=r"motors.rightFrontLegMotor has neither command nor angle"):
        import_log(tmp_path / "log.npz", pupper, tmp_path / "m.yaml")
    lines = [f"  {name}: {{command: 'q[{k}]', angle: 'q[{k}]'}}" for k, name in enumerate(pupper.motor_names)]
    (tmp_path / "m.yaml").write_text("\n".join(["time: {column: t}", "motors:", *lines]))
    with pytest.raises(SurefootError, match=r"motors.\w+: command and angle are both 'q\[\d+\]'"):
        import_log(tmp_path / "log.npz", pupper, tmp_path / "m.yaml")
    np.savez(tmp_path / "one.npz", time=[0.0], command=angles[:1])
    with pytest.raises(SurefootError, match="has 1 rows; a log has 2 or more"):
        import_log(tmp_path / "one.npz", pupper)


class Hostile:
    def __reduce__(self):
        return os.system, ("exit 1",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("motors: {wheel: {command: c}}", "motors names 'wheel', which pupper_v2 does not have; it has rightFront"),
        ("motors: {rightFrontLegMotor: {command: c}}", "motors lacks rightFrontUpperLegMotor"),
        ("motors: {}\nunit: turns", "unit is 'turns'"),
    ],
)
def test_import_rejects_a_mapping_of_another_robot(tmp_path: Path, pupper: RobotDescription, text: str, message: str):
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(SurefootError, match=message):
        import_log(tmp_path / "log.csv", pupper, tmp_path / "m.yaml")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time": np.array([0.0, 0.02, 0.01])}, "time goes backwards in row 2, from 0.02 to 0.01 s"),
        ({"command": np.zeros((3, 13))}, r"has a column 'command\[12\]'; pupper_v2 has 12 motors"),
        ({"command": np.zeros((3, 8))}, r"has no column 'command\[8\]'"),
        ({"command": np.full((3, 12), np.nan)}, "row 0 has no command for rightFrontLegMotor"),
    ],
)
def test_import_rejects_a_log_of_another_shape(tmp_path: Path, pupper: RobotDescription, changes: dict, message: str):
    np.savez(tmp_path / "log.npz", **{"time": np.arange(3.0), "command": np.zeros((3, 12)), **changes})
    with pytest.raises(SurefootError, match=message):
        import_log(tmp_path / "log.npz", pupper)


TOPICS = ("sent", "read")


def write_bag(path: Path, messages: list[tuple[int, str, float]]) -> None:
    """Write joint states: time [ms], topic, and the position of all twelve joints [rad]."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types["sensor_msgs/msg/JointState"]
    stamp, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {name: writer.add_connection(f"/{name}", kind.__msgtype__, typestore=store) for name in TOPICS}
        for moment, name, angle in messages:
            message = kind(header(stamp(0, 0), ""), [], np.full(12, angle, float), np.zeros(0), np.zeros(0))
            data = store.serialize_cdr(message, kind.__msgtype__)
            writer.write(topics[name], 1_000_000_000 + 1_000_000 * moment, data)


def test_import_reads_a_ros_bag(tmp_path: Path, pupper: RobotDescription):
    times = [(k, 10 * k) for k in range(3)]
    sent, read = ([(at + number, name, k + 10.0 * number) for k, at in times] for number, name in enumerate(TOPICS))
    write_bag(tmp_path / "bag", sorted(sent + read))
    which = mapping(tmp_path / "m.yaml", pupper, "sent.position[{}]", "read.position[{}]")
    (one,) = (tmp_path / "bag").glob("*.mcap")
    motion, same = (import_log(path, pupper, which) for path in (tmp_path / "bag", one))
    np.testing.assert_array_equal(motion.motor_angle, same.motor_angle)
    np.testing.assert_allclose(motion.time, [0.0, 0.001, 0.01, 0.011, 0.02, 0.021])
    np.testing.assert_array_equal(motion.command[:, 0], [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(motion.motor_angle[:, 5], [np.nan, 10, 10, 11, 11, 12])
    assert "notes" not in motion.meta


def test_a_bag_may_begin_before_the_first_command(tmp_path: Path, pupper: RobotDescription):
    write_bag(tmp_path / "bag", [(0, "read", 10.0), (5, "read", 11.0), (7, "sent", 1.0), (9, "read", 12.0)])
    which = mapping(tmp_path / "m.yaml", pupper, "sent.position[{}]", "read.position[{}]")
    motion = import_log(tmp_path / "bag", pupper, which)
    np.testing.assert_array_equal(motion.command[:, 3], [1, 1])
    np.testing.assert_array_equal(motion.motor_angle[:, 3], [11, 12])
    assert motion.meta["notes"] == ["2 messages before the first command are left out"]


def billion() -> list[object]:
    """Return nested lists that repeat a list a thousand times per level: 10^15 numbers in some kilobytes."""
    made: list[object] = [1.0]
    for _ in range(5):
        made = [made] * 1000
    return made


class Encoded:
    """Nested lists whose text would have 2^30 entries."""

    def __reduce__(self):
        made: list[object] = [1.0]
        for _ in range(30):
            made = [made, made]
        return codecs.encode, (made, "latin1")


class Zeros:
    """Pickles as an array with many more bytes than the file contains."""

    def __reduce__(self):
        return np.core.numeric._frombuffer, (1 << 40, np.dtype("f8"), (1 << 37,), "C")


class Beyond:
    """Pickles as numbers of one byte, each of which is 1000 numbers of eight bytes: memory that is not the file's."""

    def __reduce__(self):
        return np.dtype, ("u1", False, True), (3, "|", (np.dtype("f8"), (1000,)), None, None, 1, 1, 0)


BAD_TABLES = {
    "text only": ("npz", {"name": np.array(["a"])}, "holds no arrays of numbers"),
    "no rows": ("npz", {"time": np.zeros(0), "command": np.zeros((0, 12))}, "holds no arrays of numbers"),
    "no columns": ("npz", {"command": np.zeros((5, 0))}, "holds no arrays of numbers"),
    "too wide": ("npz", {"command": np.zeros((2, 5000))}, r"command has shape \(2, 5000\), which is too large"),
    "empty pickle": ("pkl", b"", "Ran out of input"),
    "rows of nothing": ("pkl", [{}, {}], "holds no numbers"),
    "text": ("pkl", "hello", "is not a table: could not convert"),
    "uneven": ("pkl", [[1.0, 2.0], [3.0]], "is not a table: setting an array element"),
    "objects": ("pkl", {"command": np.array([None, 1], object)}, "objects are not read"),
    "structure": ("pkl", {"command": np.zeros(3, [("a", "f8")])}, "objects are not read"),
    "beyond the file": ("pkl", Beyond(), "objects are not read"),
    "huge": ("pkl", [[10**400]], "is not a table: int too large"),
    "huge in a row": ("pkl", [{"a": 10**400}], "is not a table: int too large"),
    "deep": ("pkl", {"command": [[[[[[[[[[1.0]]]]]]]]]]}, "nested too deeply"),
    "a repeated list": ("pkl", billion(), "it holds more than 1000 items"),
    "text of a repeated list": ("pkl", Encoded(), "it encodes something other than text"),
    "missing bytes": ("pkl", Zeros(), "arrays of objects are not read"),
    "code": ("pkl", Hostile(), r"is not a pickle of numbers: it refers to (posix|nt)\.system"),
    "empty text": ("csv", "", "has 0 columns and 0 rows"),
    "names only": ("csv", "a,b\n", "has 2 columns and 0 rows"),
    "repeated name": ("csv", "a,a\n1,2\n", "several columns with the same name"),
    "short line": ("csv", "a,b\n1,2\n\n3\n", "line 3 has 1 values; the first line names 2"),
    "endless": ("csv", '"' + "x" * 200_000, "is not a CSV file: field larger"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_table_rejects_malformed_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str):
    kind, data, message = BAD_TABLES[name]
    path = tmp_path / f"log.{kind}"
    if kind == "npz":
        np.savez(path, **data)
    elif kind == "csv":
        path.write_text(data)
    else:
        path.write_bytes(data if isinstance(data, bytes) else pickle.dumps(data))
    monkeypatch.setattr(log_table, "MAX_ITEMS", 1000)
    with pytest.raises(SurefootError, match=message):
        read_table(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [("log.xlsx", r"is of kind '.xlsx'; kinds: .npz"), ("log.csv", "No such file"), ("log.mcap", "does not exist")],
)
def test_table_rejects_missing_files_and_other_kinds(tmp_path: Path, name: str, message: str):
    with pytest.raises(SurefootError, match=message):
        read_table(tmp_path / name)


@pytest.mark.parametrize("name", ["log.mcap", "log.bag"])
def test_table_rejects_a_damaged_bag(tmp_path: Path, name: str):
    pytest.importorskip("rosbags")
    (tmp_path / name).write_bytes(b"junk")
    with pytest.raises(SurefootError, match="is not a bag: File magic is invalid"):
        read_table(tmp_path / name)


def test_table_reads_all_numbers_that_numpy_pickles(tmp_path: Path):
    turned = np.asfortranarray(np.arange(6.0).reshape(3, 2))
    rows = [{"a": np.float64(2.5), "b": (1, True)}, {"a": np.int32(4)}]
    for protocol in (0, 2, 5):
        (tmp_path / "log.pkl").write_bytes(pickle.dumps({"q": turned, "n": np.float64(3)}, protocol))
        table = read_table(tmp_path / "log.pkl")
        assert {name: column.tolist() for name, column in table.columns.items()} == {
            "q[0]": [0, 2, 4],
            "q[1]": [1, 3, 5],
        }
        (tmp_path / "log.pkl").write_bytes(pickle.dumps(rows, protocol))
        table_columns = read_table(tmp_path / "log.pkl").columns
        np.testing.assert_equal(
            {k: v.tolist() for k, v in table_columns.items()},
            {"a": [2.5, 4.0], "b[0]": [1.0, np.nan], "b[1]": [1.0, np.nan]},
        )
    other = {"time": np.arange(3, dtype=">f8"), "n": np.arange(3, dtype=">i2"), "b": np.array([True, False, True])}
    (tmp_path / "log.pkl").write_bytes(pickle.dumps(other))
    columns = {name: column.tolist() for name, column in read_table(tmp_path / "log.pkl").columns.items()}
    assert columns == {"time": [0, 1, 2], "n": [0, 1, 2], "b": [1, 0, 1]}
    (tmp_path / "log.pkl").write_bytes(pickle.dumps([1, 2, 3]))
    assert read_table(tmp_path / "log.pkl").columns["data"].tolist() == [1, 2, 3]


def test_import_rejects_a_missing_or_broken_clock(tmp_path: Path, pupper: RobotDescription):
    np.savez(tmp_path / "log.npz", time=np.array([0.0, np.nan, 0.02]), command=np.zeros((3, 12)))
    with pytest.raises(SurefootError, match="time is not finite in row 1"):
        import_log(tmp_path / "log.npz", pupper)
    which = mapping(tmp_path / "m.yaml", pupper, "command[{}]", "motor_angle[{}]")
    with pytest.raises(SurefootError, match="has no time stamps of its own"):
        import_log(tmp_path / "log.npz", pupper, which)
