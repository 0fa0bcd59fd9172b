"""States and commands to and from the messages of `layout`.

The wire has no checksum: a number that no motor or sensor of such a machine can give is refused.

Cheetah-Software's parameter `control_mode` chooses which of the robot's own controllers holds the
joints. The virtual robot holds joints mechanically on request, and its beacon lists them.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.links.lcm.layout import (
    CONTROL_PARAMETER,
    JOINTS,
    VIRTUAL_ROBOT,
    WTW,
    Layout,
    Message,
)
from pronk.links.link import StateNumbering, unit_quaternion
from pronk.links.machine import Command, RefusedError, State, check_command

Array = NDArray[np.float64]

_SPI_JOINTS = ("abad", "hip", "knee")
_RANGES = {
    # What the motors' CAN messages can carry, motor firmware of bgkatz [rad, N m/rad, N m s/rad].
    "position": (-12.5, 12.5),
    "stiffness": (0.0, 500.0),
    "damping": (0.0, 5.0),
    # 65 rad/s is the fastest that they can carry, ten times 17 N m is more than any motor of this
    # size gives, 2000 deg/s and 16 g are the ranges of inertial units [rad/s, N m, rad/s, m/s^2].
    "velocity": (-65.0, 65.0),
    "torque": (-170.0, 170.0),
    "gyro": (-35.0, 35.0),
    "accelerometer": (-160.0, 160.0),
    "orientation": (-2.0, 2.0),
}
_OLDEST_ATTITUDE_S = 0.02


def encode_command(layout: Layout, command: Command) -> bytes:
    """Encode a command; HardwareError for an impossible one."""
    check_command(command, JOINTS)
    fields: dict[str, Any] = {
        "q_des": command.position * layout.signs,
        layout.fields["stiffness"]: command.stiffness * layout.gains,
        layout.fields["damping"]: command.damping * layout.gains,
    }
    if layout.numbered:
        fields |= {"timestamp_us": round(command.made * 1e6), "id": command.sequence}
    return layout.command.encode(**fields)


def decode_command(layout: Layout, data: bytes) -> Command:
    """Decode a command.

    Raises:
        RefusedError: `fingerprint`, `length`, `not finite`, `out of range`, or `feed-forward` (a
            target speed or torque, which a `Command` does not have).
    """
    message = layout.command
    fields = message.decode(data)
    position = _in_range("position", fields["q_des"], message)
    stiffness, damping = (
        _in_range(name, fields[layout.fields[name]], message) for name in ("stiffness", "damping")
    )
    # Of Cheetah-Software's message the robot reads nothing else.
    if layout is WTW and (np.any(fields["qd_des"]) or np.any(fields["tau_ff"])):
        raise RefusedError(
            "feed-forward",
            f"{message.name} commands a speed or a torque; only positions, stiffness and damping "
            "are understood.",
        )
    return Command(
        position=position * layout.signs,
        stiffness=stiffness / layout.gains,
        damping=damping / layout.gains,
        sequence=int(fields["id"]) if layout.numbered else 0,
        made=1e-6 * int(fields["timestamp_us"]) if layout.numbered else 0.0,
    )


def encode_state(layout: Layout, state: State) -> tuple[bytes, bytes]:
    """Encode a state as two messages: attitude, then joints, which complete a state."""
    w, x, y, z = state.orientation
    rpy = (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
    attitude: dict[str, Any] = {"quat": state.orientation, "rpy": rpy}
    attitude |= {layout.fields[name]: getattr(state, name) for name in ("gyro", "accelerometer")}
    joints: dict[str, Any] = {
        "q": state.position * layout.signs,
        "qd": state.velocity * layout.signs,
    }
    if layout.numbered:
        stamp = {"timestamp_us": round(1e6 * (state.robot_time or 0.0)), "id": state.sequence}
        attitude |= stamp
        joints |= {"tau_est": state.torque * layout.signs, **stamp}
    else:
        attitude |= {"good_packets": state.sequence}
        joints = {
            f"{kind}_{name}": values[k::3]
            for kind, values in joints.items()
            for k, name in enumerate(_SPI_JOINTS)
        }
    return layout.attitude.encode(**attitude), layout.joints.encode(**joints)


class StateDecoder(StateNumbering):
    """Makes states of the two messages, numbered by the robot's count where it is filled.

    `no attitude` counts joints without an attitude of the last 20 ms, which make no state. Neither
    layout carries the bus voltage: NaN.
    """

    def __init__(self, layout: Layout, counts: Counter[str]) -> None:
        super().__init__(counts, layout.state_rate_hz)
        self._layout = layout
        self._attitude: dict[str, Array] = {}
        self._attitude_came = -math.inf

    def attitude(self, data: bytes, now: float) -> None:
        """Take a message of the inertial unit that arrived at `now` [s].

        Raises:
            RefusedError: `fingerprint`, `length`, `not finite`, `out of range`, or `quaternion`
                (not of length 1).
        """
        names = ("orientation", "gyro", "accelerometer")
        found = self._decoded(self._layout.attitude, self._layout.attitude.decode(data), names)
        where = f"{self._layout.attitude.name}.quat"
        orientation = unit_quaternion(where, found["orientation"])
        self._attitude = found | {"orientation": orientation}
        self._attitude_came = now

    def joints(self, data: bytes, now: float) -> State | None:
        """Take a message of the joints that arrived at `now` [s]: it completes a state.

        Raises:
            RefusedError: `fingerprint`, `length`, `not finite` or `out of range`.
        """
        layout, names = self._layout, ("position", "velocity", "torque")
        fields: Any = layout.joints.decode(data)
        stamp = number = 0
        if layout.numbered:
            stamp, number = int(fields["timestamp_us"]), int(fields["id"])
        else:
            # By joint, then leg, on the wire; by leg, then joint, here.
            fields = {"tau_est": np.zeros(JOINTS)} | {
                kind: np.array([fields[f"{kind}_{name}"] for name in _SPI_JOINTS]).T.ravel()
                for kind in ("q", "qd")
            }
        found: dict[str, Any] = self._decoded(layout.joints, fields, names)
        if now - self._attitude_came > _OLDEST_ATTITUDE_S:
            self.counts["no attitude"] += 1
            return None
        values = {name: value * layout.signs for name, value in found.items()}
        values |= self._attitude | {"bus_voltage": math.nan}
        # The bridge of walk-these-ways itself leaves both at 0.
        values["robot_time"] = 1e-6 * stamp if stamp else None
        return self.number(values, number or None, now)

    def _decoded(self, message: Message, fields: Any, names: tuple[str, ...]) -> dict[str, Array]:
        wire = self._layout.fields
        return {name: _in_range(name, fields[wire[name]], message) for name in names}


def _in_range(name: str, values: NDArray[Any], message: Message) -> Array:
    """Convert to float64; refuse what is not finite or not in its range."""
    low, high = _RANGES[name]
    # Before the conversion, which warns of a signalling NaN; NaN is in no range.
    if ((values >= low) & (values <= high)).all():
        return np.asarray(values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise RefusedError("not finite", f"a {name} of {message.name} is not a finite number.")
    raise RefusedError(
        "out of range",
        f"{name} of {message.name} lies between {values.min():g} and {values.max():g}, expected "
        f"{low:g} to {high:g}, which is all that the motors and sensors can do.",
    )


# --- Requests -----------------------------------------------------------------------------------

MODES = {0: "", 1: "stand_up", 3: "balance_stand", 4: "locomotion", 6: "recovery_stand"}
"""`control_mode` (`FSM_State.h`); 0 is passive, the joints are free for others."""
_MODE = b"control_mode"
# ControlParameters.h: the value is a double. ControlParameterInterface.h: set a robot's parameter.
_DOUBLE, _SET = 1, 1


def mode_request(mode: int, number: int) -> bytes:
    """Encode the request of this number that sets `control_mode`; the same bytes confirm it."""
    # The robot copies memory here: little-endian, unlike everything else on this wire.
    value = struct.pack("<d", mode).ljust(64, b"\0")
    return CONTROL_PARAMETER.encode(
        name=np.frombuffer(_MODE.ljust(64, b"\0"), np.int8),
        requestNumber=number,
        value=np.frombuffer(value, np.int8),
        parameterKind=_DOUBLE,
        requestKind=_SET,
    )


def read_mode_request(data: bytes) -> str:
    """Name of the mode that a request sets; empty for passive.

    Raises:
        RefusedError: `fingerprint`, `length`, or `parameter` (not `control_mode`, or no mode).
    """
    fields = CONTROL_PARAMETER.decode(data)
    name = fields["name"].tobytes().split(b"\0")[0]
    kinds = (int(fields["parameterKind"]), int(fields["requestKind"]))
    (value,) = struct.unpack_from("<d", fields["value"].tobytes())
    if name != _MODE or kinds != (_DOUBLE, _SET) or value not in MODES:
        raise RefusedError(
            "parameter",
            f"a request sets {name!r} to {value}; only {_MODE.decode()} can be set here, to one "
            f"of {', '.join(map(str, MODES))}.",
        )
    return MODES[int(value)]


def clamp_message(names: tuple[str, ...], held: tuple[str, ...], number: int) -> bytes:
    """Encode a request for clamps, or the beacon: joints to hold, or held, of all `names`."""
    return VIRTUAL_ROBOT.encode(request=number, clamped=[int(n in held) for n in names])


def read_clamp_message(names: tuple[str, ...], data: bytes) -> tuple[int, tuple[str, ...]]:
    """Number of the request, and the joints that are or shall be held."""
    fields = VIRTUAL_ROBOT.decode(data)
    flags = zip(names, fields["clamped"].tolist(), strict=True)
    return int(fields["request"]), tuple(name for name, held in flags if held)
