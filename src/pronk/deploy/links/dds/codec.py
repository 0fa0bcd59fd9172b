"""States and commands to Unitree's DDS messages and back.

Joints. Slots 0 to 11 are FR, FL, RR, RL, each hip, thigh, calf: pronk's own order, FR FL HR HL,
each hip_roll, hip_pitch, knee (`leg_axes` refuses a model with another order); slots 12 to 19 drive
nothing. On a Go2 the hip turns about +x, thigh and calf about +y, all zero with the leg straight
down. The Mini Cheetah's hip_pitch and knee turn about -y, with the same zeros, so behind these
messages (which only its virtual robot has)

    hip = hip_roll,  thigh = -hip_pitch,  calf = -knee

and likewise for speeds and torques; gains are the same. Trunk frame and quaternion agree.

A `Command` with no stiffness goes out as PosStopF, one with no damping as VelStopF, which is how
Unitree's drives are made to leave that part out.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.deploy.links.dds.image import c_image_dtype, deserialize_image, serialize_image
from pronk.deploy.links.dds.messages import LowCmd, LowState
from pronk.deploy.links.leg_axes import axis_signs
from pronk.deploy.links.numbering import StateNumbering, unit_quaternion
from pronk.errors import HardwareError
from pronk.robots.machine import Command, RefusedError, State, check_command
from pronk.robots.robot import RobotSpec

HEAD = (0xFE, 0xEF)
LOW_LEVEL = 0xFF
"""`level_flag` of a command to the motors."""
SERVO = 0x01
"""`mode` of a motor that is on."""
POS_STOP = 2.146e9
"""`q` of a motor whose position is not controlled (PosStopF)."""
VEL_STOP = 16000.0
"""`dq` of a motor whose speed is not controlled (VelStopF)."""
VIRTUAL_SERIAL = (0x4E4F5250, 0x4D49534B)
"""`sn` that identifies a virtual robot: `PRONKSIM`."""
TICKS_PER_S = 1000
_TICKS = 2**32
"""Number of ticks after which the robot's clock begins at zero again: 49.7 days."""
STATE_RATE_HZ = 500.0
_JOINTS = 12
# Plausible targets and gains: no joint turns twice, and these gains are ten times the usual ones.
_MAX_POSITION = 4.0 * math.pi  # [rad]
_MAX_STIFFNESS = 1000.0  # [N m/rad]
_MAX_DAMPING = 100.0  # [N m s/rad]


@dataclass(frozen=True, kw_only=True, eq=False)
class JointMap:
    """How a robot's joints and the motors of a message correspond."""

    sign: Array
    """A motor's angle is sign times the joint's, shape (12,)."""
    sink_damping: float
    """Damping with which the joints sink softly [N m s/rad]."""
    virtual_only: bool
    """Whether no real robot of this name uses these messages."""


_SINK_DAMPING = {"go2": 3.0, "mini_cheetah": 1.0}
"""Damping with which each robot sinks softly [N m s/rad]. Unitree's own deployments damp a Go2 with
3 to 8."""
_VIRTUAL_ONLY = ("mini_cheetah",)
"""Robots of which only the virtual one uses these messages."""


def joint_map(robot: RobotSpec) -> JointMap:
    """Return the map of a robot.

    Raises:
        HardwareError: The robot does not fit behind Unitree's messages, or its legs have another
            order.
    """
    if robot.name not in _SINK_DAMPING or len(robot.joints) != _JOINTS:
        raise HardwareError(
            f"{robot.name} with {len(robot.joints)} joints has no place in Unitree's messages; the "
            f"robots that have are {', '.join(_SINK_DAMPING)}, with {_JOINTS} joints."
        )
    return JointMap(
        sign=axis_signs(robot),
        sink_damping=_SINK_DAMPING[robot.name],
        virtual_only=robot.name in _VIRTUAL_ONLY,
    )


def encode_dds_command(joints: JointMap, command: Command) -> bytes:
    """Encode a `LowCmd` with its checksum; HardwareError for an impossible command."""
    check_command(command, _JOINTS)
    _check_size("position", command.position, _MAX_POSITION)
    _check_size("stiffness", command.stiffness, _MAX_STIFFNESS)
    _check_size("damping", command.damping, _MAX_DAMPING)
    stiffness = np.asarray(command.stiffness)
    damping = np.asarray(command.damping)
    record = _record_with_head(LowCmd)
    all_motors = record["motor_cmd"]
    all_motors["mode"] = SERVO
    all_motors["q"] = POS_STOP
    all_motors["dq"] = VEL_STOP
    motors = all_motors[0, :_JOINTS]
    motors["q"] = np.where(stiffness > 0.0, joints.sign * command.position, POS_STOP)
    motors["dq"] = np.where(damping > 0.0, 0.0, VEL_STOP)
    motors["kp"] = stiffness
    motors["kd"] = damping
    return serialize_image(LowCmd, record)


def _check_size(quantity: str, values: Array, largest: float) -> None:
    """Raise HardwareError for a quantity of a command that is larger than plausible."""
    size = np.abs(values).max()
    if size > largest:
        raise HardwareError(
            f"command.{quantity} is up to {size:g}, expected at most {largest:g}; it was not sent."
        )


def decode_dds_command(joints: JointMap, data: bytes) -> Command:
    """Decode a `LowCmd`. A position that is not controlled reads as 0.

    Args:
        joints: How the robot's joints and the motors correspond.
        data: The message.

    Raises:
        RefusedError: As of `deserialize_image`, or `head`, `level`, `mode`, `not finite`,
            `out of range`, `feed-forward` (a target speed or torque, which a `Command` does not
            have).
    """
    record = deserialize_image(LowCmd, data)
    head = record["head"][0]
    if tuple(head) != HEAD:
        raise RefusedError("head", f"LowCmd.head is {head}, expected {HEAD}.")
    level_flag = record["level_flag"][0]
    if level_flag != LOW_LEVEL:
        raise RefusedError("level", f"level_flag is {level_flag}, expected 255.")
    motors = record["motor_cmd"][0, :_JOINTS]
    mode = motors["mode"]
    if mode.max() > SERVO:
        raise RefusedError(
            "mode", f"a motor's mode is {mode.max()}, expected 1 (servo) or 0 (off)."
        )
    q = motors["q"]
    dq = motors["dq"]
    tau = motors["tau"]
    kp = motors["kp"]
    kd = motors["kd"]
    _check_finite("motor_cmd", (q, dq, tau, kp, kd))
    # A motor that is off ignores the rest, and a part that is stopped has no gain.
    stiffness = kp.astype(np.float64) * mode * (q != np.float32(POS_STOP))
    damping = kd.astype(np.float64) * mode * (dq != VEL_STOP)
    position = np.where(stiffness > 0.0, joints.sign * q, 0.0)
    _check_range("position", abs(position), _MAX_POSITION)
    _check_range("stiffness", stiffness, _MAX_STIFFNESS)
    _check_range("damping", damping, _MAX_DAMPING)
    if (tau * mode).any() or (damping * dq).any():
        raise RefusedError(
            "feed-forward",
            "LowCmd commands a speed or a torque; only positions, stiffness and damping are "
            "understood.",
        )
    return Command(position=position, stiffness=stiffness, damping=damping)


def _check_range(quantity: str, values: Array, largest: float) -> None:
    """Raise RefusedError for a received quantity that is negative or larger than plausible."""
    low = values.min()
    high = values.max()
    if low < 0.0 or high > largest:
        raise RefusedError(
            "out of range",
            f"{quantity} is {low:g} to {high:g}, expected 0 to {largest:g}.",
        )


def encode_dds_state(joints: JointMap, state: State) -> bytes:
    """Encode the `LowState` of a virtual robot; what it does not have (cells) is zero."""
    record = _record_with_head(LowState)
    record["sn"] = VIRTUAL_SERIAL
    robot_time = state.time if state.robot_time is None else state.robot_time
    record["tick"] = round(robot_time * TICKS_PER_S) % _TICKS
    record["power_v"] = state.bus_voltage
    if state.remote:
        record["wireless_remote"] = np.frombuffer(state.remote, np.uint8)
    imu = record["imu_state"]
    imu["quaternion"] = state.orientation
    imu["gyroscope"] = state.gyro
    imu["accelerometer"] = state.accelerometer
    motors = record["motor_state"][0, :_JOINTS]
    motors["mode"] = SERVO
    motors["q"] = joints.sign * state.position
    motors["dq"] = joints.sign * state.velocity
    motors["tau_est"] = joints.sign * state.torque
    if state.temperature is not None:
        motors["temperature"] = np.clip(np.rint(state.temperature), 0, 255)
    return serialize_image(LowState, record)


class DdsStateDecoder(StateNumbering):
    """Makes states of `rt/lowstate`, numbered by the robot's clock, for they carry no number."""

    def __init__(self, joints: JointMap, counts: Counter[str]) -> None:
        """Begin without a state; `counts` gets what is dropped."""
        per_state = round(TICKS_PER_S / STATE_RATE_HZ)
        super().__init__(counts, STATE_RATE_HZ, per_state=per_state, bits=32)
        self.virtual = False
        """Whether the last message was a virtual robot's."""
        self._joints = joints
        self._ticks: int | None = None
        """The robot's clock, which goes on where that of the messages begins at zero again; None
        before a state."""

    def take(self, data: bytes, arrived: float) -> State | None:
        """Decode a message that arrived at a time [s]; temperatures that are all zero are none.

        RefusedError as of `deserialize_image`, or `not finite`, `quaternion` (not of length 1).
        """
        record = deserialize_image(LowState, data)
        motors = record["motor_state"][0, :_JOINTS]
        q = motors["q"]
        dq = motors["dq"]
        tau_est = motors["tau_est"]
        _check_finite("motor_state", (q, dq, motors["ddq"], tau_est))
        imu = record["imu_state"][0]
        quaternion = imu["quaternion"]
        gyroscope = imu["gyroscope"]
        accelerometer = imu["accelerometer"]
        _check_finite("imu_state", (quaternion, gyroscope, accelerometer))
        _check_finite("power_v", (record["power_v"],))
        serial = record["sn"][0]
        self.virtual = (int(serial[0]), int(serial[1])) == VIRTUAL_SERIAL
        tick = int(record["tick"][0])
        if self._ticks is None:
            self._ticks = tick
        self._ticks += (tick - self._ticks + _TICKS // 2) % _TICKS - _TICKS // 2
        temperature = None
        if motors["temperature"].any():
            temperature = motors["temperature"].astype(np.float64)
        sign = self._joints.sign
        measurement = State(
            time=arrived,
            sequence=0,
            position=sign * q,
            velocity=sign * dq,
            torque=sign * tau_est,
            gyro=gyroscope.astype(np.float64),
            accelerometer=accelerometer.astype(np.float64),
            bus_voltage=float(record["power_v"][0]),
            orientation=unit_quaternion("imu_state.quaternion", quaternion.astype(np.float64)),
            robot_time=self._ticks / TICKS_PER_S,
            temperature=temperature,
            remote=record["wireless_remote"][0].tobytes(),
        )
        return self.number(measurement, tick)


def _record_with_head(message: Any) -> NDArray[Any]:
    """Make a C image, shape (1,), of zeros but for what begins every message."""
    record = np.zeros(1, dtype=c_image_dtype(message))
    record["head"] = HEAD
    record["level_flag"] = LOW_LEVEL
    return record


def _check_finite(struct_name: str, members: tuple[NDArray[Any], ...]) -> None:
    """Refuse members that are not finite, before a conversion warns of a signalling NaN."""
    if not np.isfinite(np.concatenate(members)).all():
        raise RefusedError("not finite", f"{struct_name} holds a number that is not finite.")
