"""The LCM messages of Cheetah-Software, of the walk-these-ways bridge and of the virtual robot.

Sources: the `lcm-types` of Cheetah-Software (MIT Biomimetics) and of walk-these-ways
(Improbable AI), both MIT licence; `lcmgen.c` for the fingerprint.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.robots.machine import RefusedError

LcmNumber = Literal["int8_t", "int32_t", "int64_t", "float", "double"]

_NUMPY_TYPES: dict[LcmNumber, str] = {
    "int8_t": ">i1",
    "int32_t": ">i4",
    "int64_t": ">i8",
    "float": ">f4",
    "double": ">f8",
}
_FINGERPRINT_SEED = 0x12345678
"""Start of the hash, as in `lcmgen.c`."""
_WORD = (1 << 64) - 1
"""Mask of 64 bits."""


@dataclass(frozen=True)
class LcmField:
    """One field of a message."""

    number: LcmNumber
    """Type of its numbers in LCM's own language."""
    name: str
    count: int | None = None
    """Length of the array; None for a single number."""


class LcmMessage:
    """A type of message: its fingerprint (8 bytes), then its fields, big-endian without padding.

    The fingerprint is a hash of the fields' names, types and lengths. Two stacks use the same names
    and channels for different layouts, so only the fingerprint identifies a message.
    """

    def __init__(self, name: str, channel: str, fields: tuple[LcmField, ...]) -> None:
        """Describe a message.

        Args:
            name: Name of the type, with its package.
            channel: Channel on which it is published.
            fields: Fields in the order of the wire.
        """
        self.name = name
        self.channel = channel
        self.fields = fields
        self.fingerprint = _fingerprint(fields)
        columns: list[Any] = [("_fingerprint", ">u8")]
        for field in fields:
            shape = () if field.count is None else (field.count,)
            columns.append((field.name, _NUMPY_TYPES[field.number], shape))
        self.dtype = np.dtype(columns)

    def encode(self, values: Mapping[str, ArrayLike]) -> bytes:
        """Encode values by field; absent fields are 0, and a scalar fills an array."""
        record = np.zeros((), self.dtype)
        record["_fingerprint"] = self.fingerprint
        for name, value in values.items():
            record[name] = value
        return record.tobytes()

    def decode(self, data: bytes) -> NDArray[np.void]:
        """Decode a message to a record of its fields; RefusedError `fingerprint` or `length`."""
        fingerprint = int.from_bytes(data[:8], "big")
        if len(data) < 8 or fingerprint != self.fingerprint:
            sender = ""
            for message in LCM_MESSAGES:
                if message.fingerprint == fingerprint:
                    sender = f" ({message.name})"
            raise RefusedError(
                "fingerprint",
                f"a message has fingerprint {fingerprint:#018x}{sender}, expected "
                f"{self.fingerprint:#018x} ({self.name}); its sender uses another layout.",
            )
        size = self.dtype.itemsize
        if len(data) != size:
            raise RefusedError(
                "length",
                f"{self.name} is {len(data)} bytes long, expected {size}; it was cut or padded on "
                "the way.",
            )
        return np.frombuffer(data, self.dtype)[0]  # type: ignore[no-any-return]


def _fingerprint(fields: tuple[LcmField, ...]) -> int:
    """Hash the fields as `lcmgen.c` does."""
    fingerprint = _FINGERPRINT_SEED
    for field in fields:
        hashed = _counted_text(field.name) + _counted_text(field.number)
        if field.count is None:
            hashed += b"\0"  # no dimension
        else:
            hashed += b"\1\0" + _counted_text(str(field.count))  # one dimension, constant
        for byte in hashed:
            signed = fingerprint - (1 << 64) if fingerprint >> 63 else fingerprint
            fingerprint = ((fingerprint << 8) ^ (signed >> 55)) + byte & _WORD
    return (fingerprint << 1 | fingerprint >> 63) & _WORD


def _counted_text(text: str) -> bytes:
    """Encode a text after its length, one byte."""
    return bytes([len(text)]) + text.encode()


# Arrays of 12 are leg by leg (FR FL HR HL, or FR FL RR RL), then abad, hip, knee (hip, thigh, calf
# in Unitree's signs); arrays of 4 are by leg.

SPI_DATA = LcmMessage(
    name="cheetah.spi_data_t",
    channel="spi_data",
    fields=(
        LcmField("float", "q_abad", 4),
        LcmField("float", "q_hip", 4),
        LcmField("float", "q_knee", 4),
        LcmField("float", "qd_abad", 4),
        LcmField("float", "qd_hip", 4),
        LcmField("float", "qd_knee", 4),
        LcmField("int32_t", "flags", 4),
        LcmField("int32_t", "spi_driver_status"),
    ),
)
"""The Mini Cheetah's joints."""
LEG_CONTROL_COMMAND = LcmMessage(
    name="cheetah.leg_control_command_lcmt",
    channel="spi_debug_cmd",
    fields=(
        LcmField("float", "tau_ff", 12),
        LcmField("float", "f_ff", 12),
        LcmField("float", "q_des", 12),
        LcmField("float", "qd_des", 12),
        LcmField("float", "p_des", 12),
        LcmField("float", "v_des", 12),
        LcmField("float", "kp_cartesian", 12),
        LcmField("float", "kd_cartesian", 12),
        LcmField("float", "kp_joint", 12),
        LcmField("float", "kd_joint", 12),
    ),
)
"""A command to the Mini Cheetah, of which it reads q_des, kp_joint and kd_joint."""
MICROSTRAIN = LcmMessage(
    name="cheetah.microstrain_lcmt",
    channel="microstrain",
    fields=(
        LcmField("float", "quat", 4),
        LcmField("float", "rpy", 3),
        LcmField("float", "omega", 3),
        LcmField("float", "acc", 3),
        LcmField("int64_t", "good_packets"),
        LcmField("int64_t", "bad_packets"),
    ),
)
"""The Mini Cheetah's inertial unit."""
CONTROL_PARAMETER = LcmMessage(
    name="cheetah.control_parameter_request_lcmt",
    channel="interface_request",
    fields=(
        LcmField("int8_t", "name", 64),
        LcmField("int64_t", "requestNumber"),
        LcmField("int8_t", "value", 64),
        LcmField("int8_t", "parameterKind"),
        LcmField("int8_t", "requestKind"),
    ),
)
"""A request to set a parameter of Cheetah-Software."""
WTW_LEG_CONTROL_DATA = LcmMessage(
    name="wtw.leg_control_data_lcmt",
    channel="leg_control_data",
    fields=(
        LcmField("float", "q", 12),
        LcmField("float", "qd", 12),
        LcmField("float", "p", 12),
        LcmField("float", "v", 12),
        LcmField("float", "tau_est", 12),
        LcmField("int64_t", "timestamp_us"),
        LcmField("int64_t", "id"),
        LcmField("int64_t", "robot_id"),
    ),
)
"""The joints behind the walk-these-ways bridge."""
WTW_PD_TAU_TARGETS = LcmMessage(
    name="wtw.pd_tau_targets_lcmt",
    channel="pd_plustau_targets",
    fields=(
        LcmField("double", "q_des", 12),
        LcmField("double", "qd_des", 12),
        LcmField("double", "tau_ff", 12),
        LcmField("double", "kp", 12),
        LcmField("double", "kd", 12),
        LcmField("int64_t", "timestamp_us"),
        LcmField("int64_t", "id"),
        LcmField("int64_t", "robot_id"),
        LcmField("double", "se_contactState", 4),
    ),
)
"""A command to the walk-these-ways bridge."""
WTW_STATE_ESTIMATOR = LcmMessage(
    name="wtw.state_estimator_lcmt",
    channel="state_estimator_data",
    fields=(
        LcmField("float", "p", 3),
        LcmField("float", "vWorld", 3),
        LcmField("float", "vBody", 3),
        LcmField("float", "rpy", 3),
        LcmField("float", "omegaBody", 3),
        LcmField("float", "omegaWorld", 3),
        LcmField("float", "quat", 4),
        LcmField("float", "contact_estimate", 4),
        LcmField("float", "aBody", 3),
        LcmField("float", "aWorld", 3),
        LcmField("int64_t", "timestamp_us"),
        LcmField("int64_t", "id"),
        LcmField("int64_t", "robot_id"),
    ),
)
"""The inertial unit behind the walk-these-ways bridge."""
VIRTUAL_ROBOT = LcmMessage(
    name="pronk.virtual_robot_lcmt",
    channel="pronk_bench",
    fields=(
        LcmField("int64_t", "request"),
        LcmField("int8_t", "clamped", 12),
    ),
)
"""To the virtual robot: joints to clamp. From it: joints clamped, and the last request received."""

LCM_MESSAGES = (
    SPI_DATA,
    LEG_CONTROL_COMMAND,
    MICROSTRAIN,
    CONTROL_PARAMETER,
    WTW_LEG_CONTROL_DATA,
    WTW_PD_TAU_TARGETS,
    WTW_STATE_ESTIMATOR,
    VIRTUAL_ROBOT,
)
RESPONSE_CHANNEL = "interface_response"
"""Channel of `control_parameter_respones_lcmt`, which has the fields of the request."""
BEACON_CHANNEL = "pronk_virtual"
"""Channel of the virtual robot's beacon, a `VIRTUAL_ROBOT`."""
