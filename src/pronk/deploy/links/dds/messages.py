"""Unitree's DDS messages as IDL types: `unitree_go` and `unitree_api` of unitree_sdk2.

Every type is final, with its members in the order of the wire. Joint quantities are at the joint,
in rad, rad/s and N m; x is forwards, y left, z up; quaternions are w, x, y, z.
"""

# Without `from __future__ import annotations`: the library reads the annotations as objects.
# mypy does not follow cyclonedds and takes IdlStruct for Any.
# mypy: disable-error-code="call-arg, misc"

from dataclasses import dataclass

from pronk.errors import HardwareError

try:
    from cyclonedds.idl import IdlStruct, types
except ImportError:
    raise HardwareError(
        "the DDS link needs the package cyclonedds, which is not installed; "
        "install it with: pip install 'pronk[hardware]'."
    ) from None

# --- Commands to the motors ---------------------------------------------------------------------


@dataclass
class MotorCmd(IdlStruct, typename="unitree_go.msg.dds_.MotorCmd_"):
    """Command to a motor, which gives tau + kp (q - its angle) + kd (dq - its speed)."""

    mode: types.uint8
    """1 (servo) or 0 (off)."""
    q: types.float32
    """Target angle [rad]."""
    dq: types.float32
    """Target speed [rad/s]."""
    tau: types.float32
    """Torque that is added [N m]."""
    kp: types.float32
    """Stiffness [N m/rad]."""
    kd: types.float32
    """Damping [N m s/rad]."""
    reserve: types.array[types.uint32, 3]


@dataclass
class BmsCmd(IdlStruct, typename="unitree_go.msg.dds_.BmsCmd_"):
    """Command to the battery."""

    off: types.uint8
    reserve: types.array[types.uint8, 3]


@dataclass
class LowCmd(IdlStruct, typename="unitree_go.msg.dds_.LowCmd_"):
    """Command to all motors."""

    head: types.array[types.uint8, 2]
    level_flag: types.uint8
    """255 for commands to the motors."""
    frame_reserve: types.uint8
    sn: types.array[types.uint32, 2]
    version: types.array[types.uint32, 2]
    bandwidth: types.uint16
    motor_cmd: types.array[MotorCmd, 20]
    bms_cmd: BmsCmd
    wireless_remote: types.array[types.uint8, 40]
    led: types.array[types.uint8, 12]
    fan: types.array[types.uint8, 2]
    gpio: types.uint8
    reserve: types.uint32
    crc: types.uint32
    """Checksum of the C image before it."""


# --- State of the robot -------------------------------------------------------------------------


@dataclass
class IMUState(IdlStruct, typename="unitree_go.msg.dds_.IMUState_"):
    """State of the inertial unit."""

    quaternion: types.array[types.float32, 4]
    """Trunk to world, w, x, y, z."""
    gyroscope: types.array[types.float32, 3]
    """Angular velocity of the trunk in its own frame [rad/s]."""
    accelerometer: types.array[types.float32, 3]
    """Specific force of the trunk in its own frame [m/s^2]."""
    rpy: types.array[types.float32, 3]
    temperature: types.uint8


@dataclass
class MotorState(IdlStruct, typename="unitree_go.msg.dds_.MotorState_"):
    """State of a motor."""

    mode: types.uint8
    """1 (servo) or 0 (off)."""
    q: types.float32
    """Angle [rad]."""
    dq: types.float32
    """Speed [rad/s]."""
    ddq: types.float32
    """Acceleration [rad/s^2]."""
    tau_est: types.float32
    """Torque that the drive computes from its current [N m]."""
    q_raw: types.float32
    dq_raw: types.float32
    ddq_raw: types.float32
    temperature: types.uint8
    """Temperature [deg C]."""
    lost: types.uint32
    reserve: types.array[types.uint32, 2]


@dataclass
class BmsState(IdlStruct, typename="unitree_go.msg.dds_.BmsState_"):
    """State of the battery."""

    version_high: types.uint8
    version_low: types.uint8
    status: types.uint8
    soc: types.uint8
    current: types.int32
    cycle: types.uint16
    bq_ntc: types.array[types.uint8, 2]
    mcu_ntc: types.array[types.uint8, 2]
    cell_vol: types.array[types.uint16, 15]


@dataclass
class LowState(IdlStruct, typename="unitree_go.msg.dds_.LowState_"):
    """State of the robot."""

    head: types.array[types.uint8, 2]
    level_flag: types.uint8
    frame_reserve: types.uint8
    sn: types.array[types.uint32, 2]
    """Serial number; the virtual robot's is `codec.VIRTUAL_SERIAL`."""
    version: types.array[types.uint32, 2]
    bandwidth: types.uint16
    imu_state: IMUState
    motor_state: types.array[MotorState, 20]
    bms_state: BmsState
    foot_force: types.array[types.int16, 4]
    foot_force_est: types.array[types.int16, 4]
    tick: types.uint32
    """The robot's clock [ms]."""
    wireless_remote: types.array[types.uint8, 40]
    bit_flag: types.uint8
    adc_reel: types.float32
    temperature_ntc1: types.uint8
    temperature_ntc2: types.uint8
    power_v: types.float32
    """Voltage of the battery [V]."""
    power_a: types.float32
    """Current of the battery [A]."""
    fan_frequency: types.array[types.uint16, 4]
    reserve: types.uint32
    crc: types.uint32
    """Checksum of the C image before it."""


# --- Requests and responses of services ---------------------------------------------------------


@dataclass
class RequestIdentity(IdlStruct, typename="unitree_api.msg.dds_.RequestIdentity_"):
    """Number of a request, and of the function that it calls."""

    id: types.int64
    api_id: types.int64


@dataclass
class RequestLease(IdlStruct, typename="unitree_api.msg.dds_.RequestLease_"):
    """Lease under which a request is sent; 0 without one."""

    id: types.int64


@dataclass
class RequestPolicy(IdlStruct, typename="unitree_api.msg.dds_.RequestPolicy_"):
    """How a request is handled."""

    priority: types.int32
    noreply: bool


@dataclass
class RequestHeader(IdlStruct, typename="unitree_api.msg.dds_.RequestHeader_"):
    """Header of a request."""

    identity: RequestIdentity
    lease: RequestLease
    policy: RequestPolicy


@dataclass
class Request(IdlStruct, typename="unitree_api.msg.dds_.Request_"):
    """Call of a function of a service."""

    header: RequestHeader
    parameter: str
    """Argument of the function, in JSON."""
    binary: types.sequence[types.uint8]


@dataclass
class ResponseStatus(IdlStruct, typename="unitree_api.msg.dds_.ResponseStatus_"):
    """Result of a call."""

    code: types.int32
    """0 when done."""


@dataclass
class ResponseHeader(IdlStruct, typename="unitree_api.msg.dds_.ResponseHeader_"):
    """Header of a response, with the identity of its request."""

    identity: RequestIdentity
    status: ResponseStatus


@dataclass
class Response(IdlStruct, typename="unitree_api.msg.dds_.Response_"):
    """Response of a function of a service."""

    header: ResponseHeader
    data: str
    """Result of the function, in JSON."""
    binary: types.sequence[types.uint8]
