"""IDL types of a Go2's topics, which DDS needs to match other programs' writers and readers.

Only their names and layouts matter: messages at 500 Hz are encoded by `low_level`, and their types are derived from its
records. Field names are the vendor's (IDL files of unitree_sdk2). cyclonedds evaluates the annotations, so they must
not be strings.
"""

from dataclasses import dataclass, field
from types import new_class
from typing import TypeVar

import numpy as np
from cyclonedds import idl
from cyclonedds.idl import annotations, types

from surefoot.deploy.dds import low_level

u8, u32, i16, i32, i64, f32 = types.uint8, types.uint32, types.int16, types.int32, types.int64, types.float32
T = TypeVar("T")
GO = "unitree_go.msg.dds_."
API = "unitree_api.msg.dds_."
GO_LOW_STATE = "unitree_go::msg::dds_::LowState_"
"""Type name of rt/lowstate in DDS."""


def _message(kind: T) -> T:
    """Make an IDL type of a class: final and with sequential field numbers, like the vendor's compiler."""
    return dataclass(annotations.final(annotations.autoid("sequential")(kind)))


def _from_record(name: str, record: np.dtype) -> type[idl.IdlStruct]:
    """Derive the IDL type of a numpy record; the types of nested records must be derived before."""

    def annotation(part: np.dtype):
        kind = _PARTS.get(part.base) or getattr(types, part.base.name)
        return types.array[kind, part.shape[0]] if part.shape else kind

    parts = {field: annotation(record.fields[field][0]) for field in record.names}
    body = {"__annotations__": parts, "__module__": __name__}
    _PARTS[record] = _message(
        new_class(name, (idl.IdlStruct,), {"typename": f"{GO}{name}_"}, lambda own: own.update(body))
    )
    return _PARTS[record]


_PARTS = {}
"""IDL types by record."""
IMUState = _from_record("IMUState", low_level.IMU)
MotorState = _from_record("MotorState", low_level.MOTOR_STATE)
BmsState = _from_record("BmsState", low_level.BMS_STATE)
LowState = _from_record("LowState", low_level.LOW_STATE)
MotorCmd = _from_record("MotorCmd", low_level.MOTOR_COMMAND)
BmsCmd = _from_record("BmsCmd", low_level.BMS_COMMAND)
LowCmd = _from_record("LowCmd", low_level.LOW_COMMAND)


@_message
class TimeSpec(idl.IdlStruct, typename=GO + "TimeSpec_"):
    """Point in time."""

    sec: i32 = 0
    nanosec: u32 = 0


@_message
class PathPoint(idl.IdlStruct, typename=GO + "PathPoint_"):
    """Point on a path."""

    t_from_start: f32 = 0.0
    x: f32 = 0.0
    y: f32 = 0.0
    yaw: f32 = 0.0
    vx: f32 = 0.0
    vy: f32 = 0.0
    vyaw: f32 = 0.0


@_message
class SportModeState(idl.IdlStruct, typename=GO + "SportModeState_"):
    """State of the robot's own motion controller, on rt/sportmodestate."""

    stamp: TimeSpec
    error_code: u32
    imu_state: IMUState
    mode: u8
    progress: f32
    gait_type: u8
    foot_raise_height: f32
    position: types.array[f32, 3]
    body_height: f32
    velocity: types.array[f32, 3]
    yaw_speed: f32
    range_obstacle: types.array[f32, 4]
    foot_force: types.array[i16, 4]
    foot_position_body: types.array[f32, 12]
    foot_speed_body: types.array[f32, 12]
    path_point: types.array[PathPoint, 10]


@_message
class RequestIdentity(idl.IdlStruct, typename=API + "RequestIdentity_"):
    """Number of a request, and of its call."""

    id: i64 = 0
    api_id: i64 = 0


@_message
class RequestLease(idl.IdlStruct, typename=API + "RequestLease_"):
    """Lease of a client."""

    id: i64 = 0


@_message
class RequestPolicy(idl.IdlStruct, typename=API + "RequestPolicy_"):
    """Priority of a request, and whether it needs no response."""

    priority: i32 = 0
    noreply: bool = False


@_message
class RequestHeader(idl.IdlStruct, typename=API + "RequestHeader_"):
    """Header of a request."""

    identity: RequestIdentity = field(default_factory=RequestIdentity)
    lease: RequestLease = field(default_factory=RequestLease)
    policy: RequestPolicy = field(default_factory=RequestPolicy)


@_message
class Request(idl.IdlStruct, typename=API + "Request_"):
    """Request to a service, on rt/api/NAME/request."""

    header: RequestHeader
    parameter: str
    binary: types.sequence[u8] = field(default_factory=list)


@_message
class ResponseStatus(idl.IdlStruct, typename=API + "ResponseStatus_"):
    """Error code of a response; 0: no error."""

    code: i32 = 0


@_message
class ResponseHeader(idl.IdlStruct, typename=API + "ResponseHeader_"):
    """Header of a response."""

    identity: RequestIdentity
    status: ResponseStatus = field(default_factory=ResponseStatus)


@_message
class Response(idl.IdlStruct, typename=API + "Response_"):
    """Response of a service, on rt/api/NAME/response."""

    header: ResponseHeader
    data: str
    binary: types.sequence[u8] = field(default_factory=list)
