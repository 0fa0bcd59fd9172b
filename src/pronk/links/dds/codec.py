"""Unitree's messages to states and commands, and back, without a socket.

Joints. Slots 0 to 11 are FR, FL, RR, RL, each hip, thigh, calf: pronk's own order, FR FL HR HL,
each hip_roll, hip_pitch, knee. On a Go2 the hip turns about +x, thigh and calf about +y, all zero
with the leg straight down. The Mini Cheetah's hip_pitch and knee turn about -y, with the same
zeros, so behind these messages (where there is only its virtual double: the real one uses LCM)

    hip = hip_roll,  thigh = -hip_pitch,  calf = -knee

and likewise for speeds and torques; gains are the same. Trunk frame and quaternion agree.

A `Command` with no stiffness goes out as PosStopF, one with no damping as VelStopF, which is how
makes Unitree's drives leave that part out.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.dds import messages
from pronk.links.dds.messages import pack, record, unpack
from pronk.links.machine import Command, RefusedError, State, check_command
from pronk.robots.robot import RobotSpec

Array = NDArray[np.float64]

HEAD = (0xFE, 0xEF)
LOW_LEVEL = 0xFF
"""`level_flag` of a command to the motors."""
SERVO = 0x01
"""`mode` of a motor that obeys; 0 is off."""
POS_STOP = 2.146e9
"""`q` of a motor whose position is not controlled (Unitree's PosStopF)."""
VEL_STOP = 16000.0
"""`dq` of a motor whose speed is not controlled (Unitree's VelStopF)."""
VIRTUAL = (0x4E4F5250, 0x4D49534B)
"""`sn` that identifies a virtual robot: `PRONKSIM`."""
TICKS_PER_S = 1000
"""Of the robot's clock in its states."""
STATE_RATE_HZ = 500.0
"""Of `rt/lowstate`."""
# A robot's clock that is so much earlier than the last was started again; one that runs ahead of
# this computer's by more than this between two states has jumped [ms].
_TICKS_BACK, _TICKS_AHEAD = 1000, 500
_LEAST_STEP_S = 1e-6

_JOINTS = 12
_IMU = 10  # numbers: quaternion, gyroscope, accelerometer
_POS_STOP = float(np.float32(POS_STOP))
# Plausible targets and gains [rad, N m/rad, N m s/rad]: no joint turns twice, and these gains are
# ten times what anyone uses.
_MOST = {"position": 4.0 * math.pi, "stiffness": 1000.0, "damping": 100.0}


@dataclass(frozen=True, kw_only=True, eq=False)
class JointMap:
    """How a robot's joints and the motors of a message correspond."""

    sign: Array
    """A motor's angle is sign times the joint's, shape (12,)."""
    sink_damping: float
    """Damping with which the joints sink softly [N m s/rad]."""
    virtual_only: bool = False
    """True where no real robot of this name uses these messages."""


_MAPS = {
    # Unitree's own deployments damp a Go2 with 3 to 8.
    "go2": JointMap(sign=np.ones(_JOINTS), sink_damping=3.0),
    # It sinks in about a second.
    "mini_cheetah": JointMap(
        sign=np.tile([1.0, -1.0, -1.0], 4), sink_damping=1.0, virtual_only=True
    ),
}


def joint_map(robot: RobotSpec) -> JointMap:
    """The map of a robot; refuse one that does not fit behind Unitree's messages."""
    if robot.name not in _MAPS:
        raise HardwareError(
            f"{robot.name} has no place in Unitree's messages; "
            f"the robots that have are {', '.join(_MAPS)}."
        )
    return _MAPS[robot.name]


def encode_command(joints: JointMap, command: Command) -> bytes:
    """Encode a `LowCmd` with its checksum; refuse a command that no drive could follow."""
    check_command(command, _JOINTS)
    for name, most in _MOST.items():
        if (size := np.abs(getattr(command, name)).max()) > most:
            raise HardwareError(
                f"command.{name} is up to {size:g}, expected at most {most:g}; it was not sent."
            )
    position, stiffness, damping = (np.asarray(getattr(command, name)) for name in _MOST)
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
    for name, values in (
        ("position", abs(position)),
        ("stiffness", stiffness),
        ("damping", damping),
    ):
        if not 0.0 <= values.min() <= values.max() <= _MOST[name]:
            raise RefusedError(
                "out of range",
                f"{name} is {values.min():g} to {values.max():g}, expected 0 to {_MOST[name]:g}.",
            )
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


class StateDecoder:
    """Numbers the states of `rt/lowstate` by the robot's clock in ms, for they carry no number.

    No state is made, and the reason counted, of a clock that went back or stood still (`out of
    order`), and of values that repeat to the last bit, as no live sensor's do (`repeated`);
    `clock jumps` are counted. A refused message raises RefusedError.
    """

    def __init__(self, joints: JointMap, counts: Counter[str]) -> None:
        self.counts = counts
        self.virtual = False
        """Whether the last state was a virtual robot's."""
        self._joints = joints
        self._tick: int | None = None
        self._time = -math.inf
        self._sequence = -1
        self._measured = b""

    def take(self, data: bytes, arrived: float) -> State | None:
        """Decode a message that arrived at a time [s]; states that came together are 1 us apart."""
        message = unpack(messages.LowState, data)
        tick, steps = int(message["tick"][0]), 1
        if self._tick is not None:
            ahead = (tick - self._tick + 2**31) % 2**32 - 2**31
            if -_TICKS_BACK < ahead <= 0:
                self.counts["out of order"] += 1
                return None
            if ahead < 0 or ahead > 1e3 * (arrived - self._time) + _TICKS_AHEAD:
                self.counts["clock jumps"] += 1
            else:
                steps = max(1, round(ahead * STATE_RATE_HZ / TICKS_PER_S))
        arrived = max(arrived, self._time + _LEAST_STEP_S)
        sequence = self._sequence + steps
        state = state_of(self._joints, message, time=arrived, sequence=sequence)
        self._tick, self._time, self._sequence = tick, arrived, sequence
        measured = message["imu_state"].tobytes() + message["motor_state"].tobytes()
        if measured == self._measured:
            self.counts["repeated"] += 1
            return None
        self._measured = measured
        self.virtual = tuple(int(word) for word in message["sn"][0]) == VIRTUAL
        return state


def state_of(joints: JointMap, message: NDArray[Any], *, time: float, sequence: int) -> State:
    """Convert a `LowState` record (1,); temperatures that all read zero are left out.

    Raises:
        RefusedError: `not finite`, or `quaternion` (not of length 1).
    """
    motors = message["motor_state"]
    q, dq, _, tau = _finite("motor_state", _columns(motors, "q", "tau_est")).T
    imu = message["imu_state"].view("<f4")[:_IMU]
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
        position=joints.sign * q,
        velocity=joints.sign * dq,
        torque=joints.sign * tau,
        gyro=gyro,
        accelerometer=accelerometer,
        bus_voltage=float(message["power_v"][0]),
        orientation=orientation / length,
        robot_time=int(message["tick"][0]) / TICKS_PER_S,
        temperature=temperature if temperature.any() else None,
    )


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
