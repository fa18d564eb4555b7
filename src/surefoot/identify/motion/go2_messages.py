"""Reader of Unitree Go2 logs: topics /lowstate and /lowcmd of a ROS 2 bag, or a CSV file of states.

A bag holds the messages byte for byte as the robot sent them. The first line of a CSV file names the fields of a state,
such as `motor_state[3].q` or `/lowstate/motor_state.3/q`; a file without names must be written by
`ros2 topic echo --csv /lowstate`.

Each row of the resulting motion is a state, at the time of the robot's own tick. Its target is the newest command that
was recorded before it. Unitree's control law tau + kp (q* - q) + kd (dq* - dq) is equivalent to a PD servo with the
target q* + (tau + kd dq*) / kp.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.deploy.dds.low_level import (
    LOW_COMMAND,
    LOW_STATE,
    MOTOR_NAMES,
    POS_STOP,
    SERVO,
    VEL_STOP,
    BadMessageError,
    decode,
)
from surefoot.deploy.dds.state_monitor import MAX_QUATERNION_ERROR, MOTORS, TICK_RESTART
from surefoot.errors import SurefootError, choices, describe_os_errors, prefix_errors
from surefoot.files import check_readable
from surefoot.identify.motion.column_table import FILE_BYTES, ColumnTable, is_bag, open_bag, read_csv
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.robot import RobotDescription
from surefoot.robot.params import GAINS
from surefoot.rotations import quat_rpy

MAX_MESSAGES = 1_000_000
"""Maximum number of states and commands in a bag: 16 minutes of both at 500 Hz."""
MAX_GAP = 0.05
"""Gap between states [s] above which commands may be missing, so that the row after it has no target."""
_STATE, _COMMAND = ("q", "dq", "tau_est"), ("mode", "q", "dq", "tau", "kp", "kd")
_ROW = np.dtype(
    [
        *(("tick", "f8"), ("quaternion", "f8", 4), ("gyroscope", "f8", 3)),
        ("state", [(name, "f8", MOTORS) for name in _STATE]),
        ("command", [(name, "f8", MOTORS) for name in _COMMAND]),
    ]
)
"""Record of a state with the newest command before it; NaN where a value is missing."""
_TICKS = 2**32
_NON_WORD = re.compile(r"[^a-z0-9]+")
_FIELD = re.compile(r"(?:^|_)((?:motor_state|motor_cmd|imu_state)_.*|tick)$")
"""Field name at the end of a normalized column name, independent of the recorder's topic and punctuation."""


def is_go2(robot: RobotDescription) -> bool:
    """Return whether a robot has the motors of a Go2."""
    return tuple(robot.motor_names) == MOTOR_NAMES


def read_go2(path: Path, any_checksum: bool = False) -> RecordedMotion | None:
    """Return the motion in a Go2 log, or None if the file is of another kind.

    Args:
        path: bag or CSV file.
        any_checksum: whether to accept messages with a wrong checksum.

    Raises:
        SurefootError: the file has no states, or states without time.
    """
    with prefix_errors(f"log {path}"):
        if is_bag(path):
            return _motion(*_read_bag(path, any_checksum), path.name)
        if path.suffix.lower() != ".csv":
            return None
        with describe_os_errors("it"):
            check_readable(path, FILE_BYTES)
            table = _read_csv(path)
        return None if "command[0]" in table.columns else _motion(_from_table(table), 0, path.name)


def field_names(kind: np.dtype[Any], prefix: str = "") -> Iterator[str]:
    """Yield the names of all numbers of a message in order, such as `motor_state[3].q`."""
    for name, (part, *_) in (kind.fields or {}).items():
        for place in np.ndindex(part.shape):
            label = f"{prefix}{name}" + "".join(f"[{k}]" for k in place)
            if part.base.fields:
                yield from field_names(part.base, f"{label}.")
            else:
                yield label


def _read_bag(path: Path, any_checksum: bool) -> tuple[NDArray[Any], int]:
    """Return the rows (N,) of a bag and the number of damaged messages.

    If a bag has several topics of a message type, the topic with the most messages is read.
    """
    damaged, reason, count, last = 0, "", 0, np.full((), np.nan, _ROW["command"])
    with open_bag(path) as reader:
        topics = {kind: _topic(reader.connections, kind) for kind in ("LowState", "LowCmd")}
        if topics["LowState"] is None:
            names = sorted(f"{one.topic} ({one.msgtype})" for one in reader.connections)
            raise SurefootError(f"has no topic of Go2 states (unitree_go/msg/LowState); topics: {choices(names)}")
        chosen = [topic for topic in topics.values() if topic is not None]
        if (total := sum(one.msgcount for one in chosen)) > MAX_MESSAGES:
            raise SurefootError(f"has {total} states and commands; at most {MAX_MESSAGES} are read: split the bag")
        rows = np.empty(topics["LowState"].msgcount, _ROW)
        for connection, _, raw in reader.messages(chosen):
            is_state = connection.topic == topics["LowState"].topic
            try:
                record = decode(LOW_STATE if is_state else LOW_COMMAND, bytes(raw), check=not any_checksum)
            except BadMessageError as error:
                damaged, reason = damaged + 1, reason or str(error)
                continue
            if not is_state:
                for name in _COMMAND:
                    last[name] = record["motor_cmd"][name][:MOTORS]
                continue
            if count == len(rows):
                raise SurefootError(f"has more states than the {count} that its index lists")
            row = rows[count]
            row["tick"], row["command"] = record["tick"], last
            for name in ("quaternion", "gyroscope"):
                row[name] = record["imu_state"][name]
            for name in _STATE:
                row["state"][name] = record["motor_state"][name][:MOTORS]
            count += 1
    if not count:
        advice = "; --any-checksum accepts such messages" if "checksum" in reason else ""
        raise SurefootError(f"has no state that can be read: {reason or 'its topic is empty'}{advice}")
    return rows[:count], damaged


def _topic(connections: Any, kind: str) -> Any:
    """Return the connection of a message type with the most messages, or None."""
    fitting = [
        one for one in connections
        if one.msgtype.split("/")[0] == "unitree_go" and one.msgtype.split("/")[-1].rstrip("_") == kind
    ]  # fmt: skip
    return max(fitting, key=lambda one: int(one.msgcount), default=None)


def _read_csv(path: Path) -> ColumnTable:
    """Read a CSV file. If its first line has only numbers, each line holds the numbers of a state in order."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline(1 << 20).split(",")
    if not all(re.fullmatch(r"\s*[-+.\deE]+\s*", text) for text in first):
        return read_csv(path)
    names = list(field_names(LOW_STATE))
    if len(first) == len(list(field_names(LOW_COMMAND))):
        raise SurefootError("holds commands, which have no time: record /lowstate and /lowcmd in a bag")
    if len(first) != len(names):
        raise SurefootError(f"has no column names, and {len(first)} numbers per line; a Go2 state has {len(names)}")
    return read_csv(path, names)


def _from_table(table: ColumnTable) -> NDArray[Any]:
    """Return the states of a table as rows (N,); each table row may have a state, a command, or both."""
    columns: dict[str, list[str]] = {}
    for name in table.columns:
        if match := _FIELD.search(_NON_WORD.sub("_", name.lower()).strip("_")):
            columns.setdefault(match[1], []).append(name)

    def column(field: str, needed: bool = False) -> Array:
        names = columns.get(_NON_WORD.sub("_", field).strip("_"), [])
        if len(names) > 1:
            raise SurefootError(f"has {len(names)} columns for {field}: {choices(names)}; keep one topic")
        if needed and not names:
            raise table.lacks(f"for {field}")
        return table.columns[names[0]] if names else np.full(table.rows, np.nan)

    def motor_columns(part: str, name: str, needed: bool = False) -> Array:
        return np.stack([column(f"{part}[{motor}].{name}", needed) for motor in range(MOTORS)], axis=1)

    tick = column("tick", needed=True)
    states = np.flatnonzero(np.isfinite(tick))
    if not len(states):
        raise SurefootError("has no row with a tick, the robot's time [ms]")
    commands = {name: motor_columns("motor_cmd", name) for name in _COMMAND}
    sent = np.isfinite(commands["q"])
    for name, usual in (("mode", SERVO), ("dq", 0.0), ("tau", 0.0)):
        if not np.isfinite(commands[name]).any():
            commands[name] = np.where(sent, usual, np.nan)
    newest = np.maximum.accumulate(np.where(sent.any(axis=1), np.arange(table.rows), -1))[states]
    rows = np.empty(len(states), _ROW)
    rows["tick"] = tick[states]
    for name, width in (("quaternion", 4), ("gyroscope", 3)):
        rows[name] = np.stack([column(f"imu_state.{name}[{k}]") for k in range(width)], axis=1)[states]
    for name in _STATE:
        rows["state"][name] = motor_columns("motor_state", name, name == "q")[states]
    for name, values in commands.items():
        rows["command"][name] = np.where(newest[:, None] >= 0, values[newest], np.nan)
    return rows


def _motion(rows: NDArray[Any], damaged: int, name: str) -> RecordedMotion:
    kept, time, notes = _times(rows["tick"])
    rows = rows[kept]
    if damaged:
        notes.insert(0, f"{damaged} messages were left out: wrong length or wrong checksum")
    target, gains = _targets(rows["command"])
    target[1:][np.diff(time) > MAX_GAP] = np.nan
    if gains is not None and (missing := int(np.isnan(target).any(axis=1).sum())):
        notes.append(f"{missing} of {len(rows)} rows have no target: no command, a motor without gain, or other gains")
    elif gains is None:
        notes.append("no row has a target: replay also needs /lowcmd")
    quaternion = rows["quaternion"].copy()
    with np.errstate(invalid="ignore", over="ignore"):
        wrong = ~(np.abs(np.linalg.norm(quaternion, axis=1) - 1) <= MAX_QUATERNION_ERROR)
    quaternion[wrong] = np.nan
    return RecordedMotion(
        name,
        time,
        target,
        time,
        _nan_if_not_finite(rows["state"]["q"]),
        _nan_if_not_finite(rows["state"]["dq"]),
        _nan_if_not_finite(rows["state"]["tau_est"]),
        np.array([quat_rpy(*one) for one in quaternion.tolist()]),
        _nan_if_not_finite(rows["gyroscope"]),
        gains={} if gains is None else dict(zip(GAINS, map(tuple, gains.tolist()), strict=True)),
        meta={"notes": notes},
    )


def _nan_if_not_finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)


def _times(tick: Array) -> tuple[NDArray[np.int64], Array, list[str]]:
    """Return indices (T,) and times [s] (T,) of states with rising ticks, and notes.

    States that repeat a tick or arrive late are skipped. If the robot's tick restarts, the longest part is used.
    """
    if bad := np.flatnonzero(~((tick >= 0) & (tick < _TICKS))).tolist():
        raise SurefootError(f"state {bad[0]} has tick {tick[bad[0]]:g}; ticks must be 0 to {_TICKS - 1} ms")
    parts: list[list[tuple[int, int]]] = [[]]
    now = 0
    for state, value in enumerate(tick.astype(np.int64).tolist()):
        rise = (value - now + _TICKS // 2) % _TICKS - _TICKS // 2
        if not parts[-1] or rise > 0:
            pass
        elif rise > -TICK_RESTART:
            continue  # a repeated or late state
        else:
            parts.append([])
        now = value
        parts[-1].append((state, parts[-1][-1][1] + rise if parts[-1] else 0))
    rows, times = np.array(max(parts, key=len), np.int64).T
    if len(rows) < 2:
        raise SurefootError(f"has {len(tick)} states, but no two with rising ticks")
    notes = []
    if repeats := len(tick) - sum(map(len, parts)):
        notes.append(f"{repeats} states were left out: they repeat a tick or arrived late")
    if len(parts) > 1:
        notes.append(f"the robot's tick restarted {len(parts) - 1} times: only the longest part is used")
    return rows, 1e-3 * times, notes


def _targets(commands: NDArray[Any]) -> tuple[Array, Array | None]:
    """Return servo targets (T, M) [rad] and the gains (kp, kd) of most commands (2, M), or None without commands.

    Targets are NaN where there is no command, a motor is off or has no position gain, or the gains differ.
    """
    mode, q, dq, tau, kp, kd = (commands[name] for name in _COMMAND)
    kp = np.where((mode == SERVO) & (q != POS_STOP), kp, 0.0)
    kd = np.where(dq != VEL_STOP, kd, 0.0)
    sent = np.isfinite([q, dq, tau, kp, kd]).all(axis=(0, 2)) & (kp > 0).all(axis=1)
    target = np.full(q.shape, np.nan)
    if not sent.any():
        return target, None
    values, counts = np.unique(np.hstack([kp, kd])[sent], axis=0, return_counts=True)
    gains = values[np.argmax(counts)].reshape(2, -1)
    sent &= (np.hstack([kp, kd]) == gains.ravel()).all(axis=1)
    target[sent] = (q + (tau + kd * dq) / np.where(kp > 0, kp, 1.0))[sent]
    return target, gains
