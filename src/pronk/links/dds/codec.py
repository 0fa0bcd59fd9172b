"""Bytes to states and commands, and back, in Unitree's messages: pure functions, no sockets.

Joints. Slots 0 to 11 are FR, FL, RR, RL, each hip, thigh, calf: pronk's own order, FR FL HR HL,
each hip_roll, hip_pitch, knee. On a Go2 the hip turns about +x, thigh and calf about +y, all zero
with the leg straight down. The Mini Cheetah's hip_pitch and knee turn about -y, with the same
zeros, so behind these messages (where there is only its virtual double: the real one speaks LCM)

    hip = hip_roll,  thigh = -hip_pitch,  calf = -knee

and likewise for speeds and torques; gains are the same. Trunk frame and quaternion agree.

A `Command` with no stiffness goes out as PosStopF, one with no damping as VelStopF, which is how
makes Unitree's drives leave that part out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.dds import messages
from pronk.links.dds.messages import pack, record, unpack
from pronk.links.machine import Command, RefusedError, State, check_command
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

HEAD = (0xFE, 0xEF)
LOW_LEVEL = 0xFF
"""`level_flag` of a command to the motors."""
SERVO, OFF = 0x01, 0x00
"""`mode` of a motor."""
POS_STOP = 2.146e9
"""`q` of a motor whose position is not controlled (Unitree's PosStopF)."""
VEL_STOP = 16000.0
"""`dq` of a motor whose speed is not controlled (Unitree's VelStopF)."""
VIRTUAL = (0x4E4F5250, 0x4D49534B)
"""`sn` that identifies a virtual robot: `PRONKSIM`."""
TICKS_PER_S = 1000
"""Of the robot's clock in its states."""

_JOINTS = 12
_IMU = 10  # numbers: quaternion, gyroscope, accelerometer
_POS_STOP = float(np.float32(POS_STOP))
_MOST_POSITION = 4.0 * math.pi
"""Farthest target that is believed [rad]: no joint turns twice."""
_MOST_STIFFNESS, _MOST_DAMPING = 1000.0, 100.0
"""Largest gains that are believed, ten times what anyone uses [N m/rad, N m s/rad]."""
# Of a leg's three joints, and how softly they sink [N m s/rad]: Unitree's own deployments damp a
# Go2 with 3 to 8, pronk's Mini Cheetah sinks in about a second with 1.
_SIGNS = {"go2": (1.0, 1.0, 1.0), "mini_cheetah": (1.0, -1.0, -1.0)}
_SINK = {"go2": 3.0, "mini_cheetah": 1.0}
_VIRTUAL_ONLY = ("mini_cheetah",)


@dataclass(frozen=True, kw_only=True)
class JointMap:
    """How a robot's joints and the motors of a message correspond."""

    robot: str
    sign: Array
    """A motor's angle is sign times the joint's, shape (12,)."""
    sink_damping: float
    """Damping with which the joints sink softly [N m s/rad]."""
    virtual_only: bool
    """True where no real robot of this name speaks these messages."""


def joint_map(robot: Robot) -> JointMap:
    """The map of a robot; refuse one that does not fit behind Unitree's messages."""
    if robot.name not in _SIGNS:
        raise HardwareError(
            f"{robot.name} has no place in Unitree's messages; "
            f"the robots that have are {', '.join(_SIGNS)}."
        )
    return JointMap(
        robot=robot.name,
        sign=np.tile(_SIGNS[robot.name], _JOINTS // 3),
        sink_damping=_SINK[robot.name],
        virtual_only=robot.name in _VIRTUAL_ONLY,
    )


def encode_command(joints: JointMap, command: Command) -> bytes:
    """Encode a `LowCmd` with its checksum; refuse a command that no drive could follow."""
    check_command(command, _JOINTS)
    position, stiffness, damping = (
        np.asarray(getattr(command, name), dtype=np.float64)
        for name in ("position", "stiffness", "damping")
    )
    for name, values, most in (
        ("position", position, _MOST_POSITION),
        ("stiffness", stiffness, _MOST_STIFFNESS),
        ("damping", damping, _MOST_DAMPING),
    ):
        if (size := np.abs(values).max()) > most:
            raise HardwareError(
                f"command.{name} is up to {size:g}, expected at most {most:g}; it was not sent."
            )
    message = idle_command()
    q, dq, _, kp, kd = _columns(message["motor_cmd"], "q", "kd").T
    q[:] = np.where(stiffness > 0.0, joints.sign * position, POS_STOP)
    dq[:] = np.where(damping > 0.0, 0.0, VEL_STOP)
    kp[:], kd[:] = stiffness, damping
    return pack(messages.LowCmd, message)


def idle_command() -> NDArray[Any]:
    """A `LowCmd` record that commands nothing, shape (1,)."""
    message = np.zeros(1, dtype=record(messages.LowCmd))
    message["head"] = HEAD
    message["level_flag"] = LOW_LEVEL
    motors = message["motor_cmd"]
    motors["mode"], motors["q"], motors["dq"] = SERVO, POS_STOP, VEL_STOP
    return message


def decode_command(joints: JointMap, data: bytes) -> Command:
    """Decode a `LowCmd`. A position that is not controlled reads as 0.

    Raises:
        RefusedError: `header`, `length`, `checksum`, `head`, `level`, `mode`, `not finite`,
            `out of range`, or `feed-forward` (a target speed or torque, which a `Command` does
            not have).
    """
    message = unpack(messages.LowCmd, data)
    if tuple(message["head"][0]) != HEAD:
        raise RefusedError("head", f"LowCmd.head is {message['head'][0]}, expected {HEAD}.")
    if message["level_flag"][0] != LOW_LEVEL:
        raise RefusedError("level", f"level_flag is {message['level_flag'][0]}, expected 255.")
    on = message["motor_cmd"]["mode"][0, :_JOINTS]
    if on.max() > SERVO:
        raise RefusedError("mode", f"a motor's mode is {on.max()}, expected 1 (servo) or 0 (off).")
    # A motor that is off obeys nothing, and a part that is stopped has no gain.
    q, dq, tau, kp, kd = _finite("motor_cmd", _columns(message["motor_cmd"], "q", "kd")).T
    tau = tau * on
    stiffness, damping = kp * on * (q != _POS_STOP), kd * on * (dq != VEL_STOP)
    position = np.where(stiffness > 0.0, joints.sign * q, 0.0)
    for name, gains, most in (("kp", stiffness, _MOST_STIFFNESS), ("kd", damping, _MOST_DAMPING)):
        if not 0.0 <= gains.min() <= gains.max() <= most:
            raise RefusedError(
                "out of range",
                f"{name} is from {gains.min():g} to {gains.max():g}, expected 0 to {most:g}.",
            )
    if np.abs(position).max() > _MOST_POSITION:
        far = np.abs(position).max()
        raise RefusedError("out of range", f"a motor is commanded to {far:g} rad.")
    if tau.any() or (damping * dq).any():
        raise RefusedError(
            "feed-forward",
            "LowCmd commands a speed or a torque; only positions, stiffness and damping are "
            "understood.",
        )
    return Command(position=position, stiffness=stiffness, damping=damping)


def encode_state(joints: JointMap, state: State) -> bytes:
    """The `LowState` of a virtual robot, identified by its `sn`.

    What the virtual robot does not know (battery cells, foot forces, remote) is zero.
    """
    message = np.zeros(1, dtype=record(messages.LowState))
    message["head"] = HEAD
    message["level_flag"] = LOW_LEVEL
    message["sn"] = VIRTUAL
    stamp = state.time if state.robot_time is None else state.robot_time
    message["tick"] = round(stamp * TICKS_PER_S) % 2**32
    message["power_v"] = state.bus_voltage
    trunk = (state.orientation, state.gyro, state.accelerometer)
    message["imu_state"].view("<f4")[:_IMU] = np.concatenate(trunk)
    motors = message["motor_state"]
    motors["mode"][0, :_JOINTS] = SERVO
    q, dq, _, tau = _columns(motors, "q", "tau_est").T
    q[:], dq[:] = joints.sign * state.position, joints.sign * state.velocity
    tau[:] = joints.sign * state.torque
    if state.temperature is not None:
        motors["temperature"][0, :_JOINTS] = np.clip(np.rint(state.temperature), 0, 255)
    return pack(messages.LowState, message)


@dataclass(frozen=True, kw_only=True)
class LowState:
    """A state that arrived, before this computer has given it a time and a number."""

    joints: JointMap
    message: NDArray[Any]
    """One record, shape (1,)."""

    @property
    def tick(self) -> int:
        """The robot's clock [ms], modulo 2^32."""
        return int(self.message["tick"][0])

    @property
    def virtual(self) -> bool:
        """Whether a virtual robot sent it."""
        return tuple(int(word) for word in self.message["sn"][0]) == VIRTUAL

    @property
    def measured(self) -> bytes:
        """What was measured of joints and trunk; real sensors never say the same twice."""
        message = self.message
        return bytes(message["imu_state"].tobytes() + message["motor_state"].tobytes())

    def state(self, *, time: float, sequence: int) -> State:
        """Convert to pronk's terms, without temperatures where all of them read zero.

        Args:
            time: When it arrived, on the local clock [s].
            sequence: Its number.

        Raises:
            RefusedError: `not finite`, or `quaternion` (not of length 1).
        """
        motors = self.message["motor_state"]
        q, dq, _, tau = _finite("motor_state", _columns(motors, "q", "tau_est")).T
        imu = self.message["imu_state"].view("<f4")[:_IMU]
        orientation, gyro, accelerometer = np.split(_finite("imu_state", imu), (4, 7))
        length = math.sqrt(orientation @ orientation)
        if not abs(length - 1.0) <= 0.02:
            raise RefusedError(
                "quaternion",
                f"imu_state.quaternion has length {length:.3f}, expected 1 within .02; the "
                "inertial unit is not running.",
            )
        temperature = motors["temperature"][0, :_JOINTS].astype(np.float64)
        return State(
            time=time,
            sequence=sequence,
            position=self.joints.sign * q,
            velocity=self.joints.sign * dq,
            torque=self.joints.sign * tau,
            gyro=gyro,
            accelerometer=accelerometer,
            bus_voltage=float(self.message["power_v"][0]),
            orientation=orientation / length,
            robot_time=self.tick / TICKS_PER_S,
            temperature=temperature if temperature.any() else None,
        )


def decode_state(joints: JointMap, data: bytes) -> LowState:
    """Decode a `LowState`; refuse a wrong `header`, `length` or `checksum`."""
    return LowState(joints=joints, message=unpack(messages.LowState, data))


def _columns(motors: NDArray[Any], first: str, last: str) -> NDArray[np.float32]:
    """The numbers from one member of the twelve motors to another, shape (12, members); a view."""
    fields = motors.dtype.fields
    assert fields is not None
    words = motors.view("<f4").reshape(messages.MOTORS, -1)
    return words[:_JOINTS, fields[first][1] // 4 : fields[last][1] // 4 + 1]


def _finite(name: str, values: NDArray[np.float32]) -> Array:
    """Numbers as float64; refuse those that are not finite."""
    if not np.isfinite(values).all():
        raise RefusedError("not finite", f"{name} holds a number that is not finite.")
    return values.astype(np.float64)
