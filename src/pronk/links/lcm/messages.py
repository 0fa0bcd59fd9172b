"""LCM messages of the Mini Cheetah and of the walk-these-ways bridge, from their fields.

A message on the wire is its fingerprint (8 bytes) and then its fields, big-endian and without
padding. The fingerprint is a hash of the fields' names, types and dimensions by the rule of
lcm-gen (`lcmgen.c`). The name of the type is not hashed, nor is the channel. Two stacks use the
same names and channels for different layouts, so the fingerprint alone identifies a message. A
table whose fingerprint is not the one lcm-gen gives is refused when this module is imported.

Sources: the `lcm-types` of Cheetah-Software (MIT Biomimetics) and of walk-these-ways
(Improbable AI), both MIT licence.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.errors import HardwareError
from pronk.links.machine import RefusedError

_WORD = (1 << 64) - 1
# LCM's primitive types as numpy sees them, big-endian.
_KINDS = {
    "int8_t": ">i1",
    "int16_t": ">i2",
    "int32_t": ">i4",
    "int64_t": ">i8",
    "float": ">f4",
    "double": ">f8",
}
_NAMES: dict[int, str] = {}
"""Of the messages made so far, by fingerprint: to say what came where another was expected."""
_FIELD = re.compile(r"\s*(\w+)\s+(\w+)(?:\[(\d+)\])?\s*")


class Message:
    """A type of message."""

    def __init__(self, name: str, fingerprint: int, layout: str) -> None:
        """Read a layout and check its fingerprint.

        Args:
            name: Its stack and its name there, for instance cheetah.spi_data_t.
            fingerprint: As lcm-gen 1.5.3 gives it.
            layout: Fields in LCM's own language and in wire order, `float q[12]; int64_t id`.

        Raises:
            HardwareError: A field cannot be read, or the fields hash to another fingerprint.
        """
        self.name, self.fingerprint, self.layout = name, fingerprint, layout
        columns: list[Any] = [("_fingerprint", ">u8")]
        value = 0x12345678
        for text in layout.split(";"):
            found = _FIELD.fullmatch(text)
            if found is None or found[1] not in _KINDS:
                raise HardwareError(
                    f"{name}: field {text.strip()!r} is not `type name` or `type name[count]` "
                    f"of {', '.join(_KINDS)}."
                )
            kind, field, count = found.groups()
            columns.append((field, _KINDS[kind], () if count is None else (int(count),)))
            value = _hash_text(_hash_text(value, field), kind)
            value = _hash(value, 0 if count is None else 1)
            if count is not None:
                # 0: the dimension is a constant.
                value = _hash_text(_hash(value, 0), count)
        computed = (value << 1 | value >> 63) & _WORD
        if computed != fingerprint:
            raise HardwareError(
                f"{name}: the fields hash to {computed:#018x}, expected {fingerprint:#018x}; a "
                "name, type or length in the table is wrong."
            )
        self.dtype = np.dtype(columns)
        """The whole message, fingerprint included, as a NumPy record."""
        self.size = self.dtype.itemsize
        """Length on the wire, fingerprint included [bytes]."""
        _NAMES.setdefault(fingerprint, name)

    def encode(self, **values: ArrayLike) -> bytes:
        """Encode a message; fields that are not named are 0, scalars fill arrays."""
        record = np.zeros((), self.dtype)
        record["_fingerprint"] = self.fingerprint
        for name, value in values.items():
            record[name] = value
        return record.tobytes()

    def decode(self, data: bytes) -> NDArray[np.void]:
        """Decode the fields of a message, by name; numbers keep their wire types.

        Raises:
            RefusedError: `fingerprint` or `length`.
        """
        met = int.from_bytes(data[:8], "big")
        if len(data) < 8 or met != self.fingerprint:
            got = f"{met:#018x}" + (f" ({_NAMES[met]})" if met in _NAMES else "")
            raise RefusedError(
                "fingerprint",
                f"a message has fingerprint {got}, expected {self.fingerprint:#018x} "
                f"({self.name}); its sender uses another layout.",
            )
        if len(data) != self.size:
            raise RefusedError(
                "length",
                f"{self.name} is {len(data)} bytes long, expected {self.size}; it was cut or "
                "padded on the way.",
            )
        return np.frombuffer(data, self.dtype)[0]  # type: ignore[no-any-return]


def _hash(value: int, byte: int) -> int:
    """One byte into lcm-gen's hash: v' = ((v << 8) ^ (v >> 55)) + byte, v signed, 64 bits."""
    signed = value - (1 << 64) if value >> 63 else value
    return ((value << 8) ^ (signed >> 55)) + byte & _WORD


def _hash_text(value: int, text: str) -> int:
    """A length and then its characters into the hash."""
    value = _hash(value, len(text))
    for byte in text.encode():
        value = _hash(value, byte)
    return value


# --- Cheetah-Software ---------------------------------------------------------------------------
# Arrays of 12 are leg by leg (FR FL HR HL), abad, hip, knee; arrays of 4 are by leg.

SPI_DATA = Message(
    "cheetah.spi_data_t",
    0x3A5F506B524D7E4F,
    "float q_abad[4]; float q_hip[4]; float q_knee[4];"
    "float qd_abad[4]; float qd_hip[4]; float qd_knee[4];"
    "int32_t flags[4]; int32_t spi_driver_status",
)
LEG_CONTROL_COMMAND = Message(
    "cheetah.leg_control_command_lcmt",
    0x277F792B531376CF,
    "float tau_ff[12]; float f_ff[12]; float q_des[12]; float qd_des[12]; float p_des[12];"
    "float v_des[12]; float kp_cartesian[12]; float kd_cartesian[12]; float kp_joint[12];"
    "float kd_joint[12]",
)
MICROSTRAIN = Message(
    "cheetah.microstrain_lcmt",
    0xE21531EA1392FAAA,
    "float quat[4]; float rpy[3]; float omega[3]; float acc[3];"
    "int64_t good_packets; int64_t bad_packets",
)
CONTROL_PARAMETER = Message(
    # Request and response (control_parameter_respones_lcmt) have the same fields, hence the same
    # fingerprint; the channel distinguishes them.
    "cheetah.control_parameter_request_lcmt",
    0xD04FD3ECA4A52D73,
    "int8_t name[64]; int64_t requestNumber; int8_t value[64]; int8_t parameterKind;"
    "int8_t requestKind",
)

# --- walk-these-ways ----------------------------------------------------------------------------
# Arrays of 12 are leg by leg (FR FL RR RL), hip, thigh, calf, in Unitree's signs.

WTW_LEG_CONTROL_DATA = Message(
    "wtw.leg_control_data_lcmt",
    0x5352516A697F890F,
    "float q[12]; float qd[12]; float p[12]; float v[12]; float tau_est[12];"
    "int64_t timestamp_us; int64_t id; int64_t robot_id",
)
WTW_PD_TAU_TARGETS = Message(
    "wtw.pd_tau_targets_lcmt",
    0xDB10251DE2523982,
    "double q_des[12]; double qd_des[12]; double tau_ff[12]; double kp[12]; double kd[12];"
    "int64_t timestamp_us; int64_t id; int64_t robot_id; double se_contactState[4]",
)
WTW_STATE_ESTIMATOR = Message(
    "wtw.state_estimator_lcmt",
    0xD50F90505DFFCB6D,
    "float p[3]; float vWorld[3]; float vBody[3]; float rpy[3]; float omegaBody[3];"
    "float omegaWorld[3]; float quat[4]; float contact_estimate[4]; float aBody[3];"
    "float aWorld[3]; int64_t timestamp_us; int64_t id; int64_t robot_id",
)

# --- pronk's own, of the virtual robot alone ----------------------------------------------------

VIRTUAL_ROBOT = Message(
    "pronk.virtual_robot_lcmt", 0x23FC8EF4C8F343CB, "int64_t request; int8_t clamped[12]"
)
"""To the virtual robot: joints to hold. From it: joints held, and the last request met."""

MESSAGES = (
    SPI_DATA,
    LEG_CONTROL_COMMAND,
    MICROSTRAIN,
    CONTROL_PARAMETER,
    WTW_LEG_CONTROL_DATA,
    WTW_PD_TAU_TARGETS,
    WTW_STATE_ESTIMATOR,
    VIRTUAL_ROBOT,
)
