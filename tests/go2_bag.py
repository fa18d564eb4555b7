"""Writer of a Go2's messages in recorders' formats: ROS 2 bags, and the output of `ros2 topic echo --csv`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.deploy.dds.low_level import LOW_COMMAND, LOW_STATE

_NUMBERS = {"u1": "uint8", "u2": "uint16", "u4": "uint32", "i2": "int16", "i4": "int32", "f4": "float32"}
_PARTS = {"imu_state": "IMUState", "motor_state": "MotorState", "bms_state": "BmsState", "motor_cmd": "MotorCmd"}
_PARTS["bms_cmd"] = "BmsCmd"


def type_store() -> Any:
    """Return rosbags' type store, extended by the types of the vendor's package unitree_go."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    def define(kind: np.dtype[Any], name: str) -> None:
        lines = []
        for field, (part, *_) in kind.fields.items():
            size = f"[{part.shape[0]}]" if part.shape else ""
            if part.base.fields:
                define(part.base, _PARTS[field])
            number = _PARTS[field] if part.base.fields else _NUMBERS[part.base.str[1:]]
            lines.append(f"{number}{size} {field}")
        types.update(get_types_from_msg("\n".join(lines), f"unitree_go/msg/{name}"))

    types: dict[str, Any] = {}
    define(LOW_STATE, "LowState")
    define(LOW_COMMAND, "LowCmd")
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(types)
    return store


def write_bag(folder: Path, messages: Iterable[tuple[str, int, bytes]], mcap: bool = False) -> Path:
    """Write messages (topic, time [ns], serialized bytes) to a bag, and return its folder."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    store, topics = type_store(), {}
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        for topic, time, data in messages:
            if topic not in topics:
                kind = "unitree_go/msg/LowCmd" if topic.endswith("cmd") else "unitree_go/msg/LowState"
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], time, data)
    return folder


def csv_line(data: bytes) -> str:
    """Return the values of a state in the order of its fields, in the format of `ros2 topic echo --csv`."""

    def numbers(value: Any) -> Iterable[float]:
        if hasattr(value, "__dataclass_fields__"):
            for name in value.__dataclass_fields__:
                if not name.startswith("__"):
                    yield from numbers(getattr(value, name))
        elif isinstance(value, list | np.ndarray):
            for one in value:
                yield from numbers(one)
        else:
            yield value

    return ",".join(map(str, numbers(type_store().deserialize_cdr(data, "unitree_go/msg/LowState"))))
