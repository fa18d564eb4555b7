"""Types of a Go2's topics, as DDS must have them to match writers and readers of others.

Only their names and layouts matter: messages of 500 Hz are packed by `low_level`. Names of fields are the vendor's
(IDL files of unitree_sdk2). cyclonedds reads the annotations, so they must not be strings.
"""

from dataclasses import dataclass, field

from cyclonedds import idl
from cyclonedds.idl import annotations, types

u8, u16, u32, i16, i32, i64, f32 = (
    types.uint8,
    types.uint16,
    types.uint32,
    types.int16,
    types.int32,
    types.int64,
    types.float32,
)
GO = "unitree_go.msg.dds_."
API = "unitree_api.msg.dds_."
GO_LOW_STATE = "unitree_go::msg::dds_::LowState_"
"""Name of the type of rt/lowstate as DDS shows it."""


@dataclass
@annotations.final
@annotations.autoid("sequential")
class IMUState(idl.IdlStruct, typename=GO + "IMUState_"):
    """Inertial measurement unit."""

    quaternion: types.array[f32, 4]
    gyroscope: types.array[f32, 3]
    accelerometer: types.array[f32, 3]
    rpy: types.array[f32, 3]
    temperature: u8


@dataclass
@annotations.final
@annotations.autoid("sequential")
class MotorState(idl.IdlStruct, typename=GO + "MotorState_"):
    """State of a motor."""

    mode: u8
    q: f32
    dq: f32
    ddq: f32
    tau_est: f32
    q_raw: f32
    dq_raw: f32
    ddq_raw: f32
    temperature: u8
    lost: u32
    reserve: types.array[u32, 2]


@dataclass
@annotations.final
@annotations.autoid("sequential")
class BmsState(idl.IdlStruct, typename=GO + "BmsState_"):
    """State of the battery."""

    version_high: u8
    version_low: u8
    status: u8
    soc: u8
    current: i32
    cycle: u16
    bq_ntc: types.array[u8, 2]
    mcu_ntc: types.array[u8, 2]
    cell_vol: types.array[u16, 15]


@dataclass
@annotations.final
@annotations.autoid("sequential")
class LowState(idl.IdlStruct, typename=GO + "LowState_"):
    """State of the robot, on rt/lowstate."""

    head: types.array[u8, 2]
    level_flag: u8
    frame_reserve: u8
    sn: types.array[u32, 2]
    version: types.array[u32, 2]
    bandwidth: u16
    imu_state: IMUState
    motor_state: types.array[MotorState, 20]
    bms_state: BmsState
    foot_force: types.array[i16, 4]
    foot_force_est: types.array[i16, 4]
    tick: u32
    wireless_remote: types.array[u8, 40]
    bit_flag: u8
    adc_reel: f32
    temperature_ntc1: u8
    temperature_ntc2: u8
    power_v: f32
    power_a: f32
    fan_frequency: types.array[u16, 4]
    reserve: u32
    crc: u32


@dataclass
@annotations.final
@annotations.autoid("sequential")
class MotorCmd(idl.IdlStruct, typename=GO + "MotorCmd_"):
    """Command for a motor."""

    mode: u8
    q: f32
    dq: f32
    tau: f32
    kp: f32
    kd: f32
    reserve: types.array[u32, 3]


@dataclass
@annotations.final
@annotations.autoid("sequential")
class BmsCmd(idl.IdlStruct, typename=GO + "BmsCmd_"):
    """Command for the battery."""

    off: u8
    reserve: types.array[u8, 3]


@dataclass
@annotations.final
@annotations.autoid("sequential")
class LowCmd(idl.IdlStruct, typename=GO + "LowCmd_"):
    """Command for the robot, on rt/lowcmd."""

    head: types.array[u8, 2]
    level_flag: u8
    frame_reserve: u8
    sn: types.array[u32, 2]
    version: types.array[u32, 2]
    bandwidth: u16
    motor_cmd: types.array[MotorCmd, 20]
    bms_cmd: BmsCmd
    wireless_remote: types.array[u8, 40]
    led: types.array[u8, 12]
    fan: types.array[u8, 2]
    gpio: u8
    reserve: u32
    crc: u32


@dataclass
@annotations.final
@annotations.autoid("sequential")
class TimeSpec(idl.IdlStruct, typename=GO + "TimeSpec_"):
    """A time."""

    sec: i32 = 0
    nanosec: u32 = 0


@dataclass
@annotations.final
@annotations.autoid("sequential")
class PathPoint(idl.IdlStruct, typename=GO + "PathPoint_"):
    """A point of a path."""

    t_from_start: f32 = 0.0
    x: f32 = 0.0
    y: f32 = 0.0
    yaw: f32 = 0.0
    vx: f32 = 0.0
    vy: f32 = 0.0
    vyaw: f32 = 0.0


@dataclass
@annotations.final
@annotations.autoid("sequential")
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


@dataclass
@annotations.final
@annotations.autoid("sequential")
class RequestIdentity(idl.IdlStruct, typename=API + "RequestIdentity_"):
    """Number of a request, and of what it asks for."""

    id: i64 = 0
    api_id: i64 = 0


@dataclass
@annotations.final
@annotations.autoid("sequential")
class RequestLease(idl.IdlStruct, typename=API + "RequestLease_"):
    """Lease of a client."""

    id: i64 = 0


@dataclass
@annotations.final
@annotations.autoid("sequential")
class RequestPolicy(idl.IdlStruct, typename=API + "RequestPolicy_"):
    """How a request is treated."""

    priority: i32 = 0
    noreply: bool = False


@dataclass
@annotations.final
@annotations.autoid("sequential")
class RequestHeader(idl.IdlStruct, typename=API + "RequestHeader_"):
    """Header of a request."""

    identity: RequestIdentity = field(default_factory=RequestIdentity)
    lease: RequestLease = field(default_factory=RequestLease)
    policy: RequestPolicy = field(default_factory=RequestPolicy)


@dataclass
@annotations.final
@annotations.autoid("sequential")
class Request(idl.IdlStruct, typename=API + "Request_"):
    """Request to a service, on rt/api/NAME/request."""

    header: RequestHeader
    parameter: str
    binary: types.sequence[u8] = field(default_factory=list)


@dataclass
@annotations.final
@annotations.autoid("sequential")
class ResponseStatus(idl.IdlStruct, typename=API + "ResponseStatus_"):
    """Error code of a response; 0: none."""

    code: i32 = 0


@dataclass
@annotations.final
@annotations.autoid("sequential")
class ResponseHeader(idl.IdlStruct, typename=API + "ResponseHeader_"):
    """Header of a response."""

    identity: RequestIdentity
    status: ResponseStatus = field(default_factory=ResponseStatus)


@dataclass
@annotations.final
@annotations.autoid("sequential")
class Response(idl.IdlStruct, typename=API + "Response_"):
    """Response of a service, on rt/api/NAME/response."""

    header: ResponseHeader
    data: str
    binary: types.sequence[u8] = field(default_factory=list)
