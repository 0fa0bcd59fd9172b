"""LCM messages of the Mini Cheetah and of the walk-these-ways bridge, byte by byte.

Layouts. `cheetah` is Cheetah-Software on the robot with MiniCheetahSpi_Controller, which reads
q_des, kp_joint and kd_joint of its commands. `wtw` is the bridge of walk-these-ways (Go1, and the
Go2 forks that kept its messages).

Joints. All three orders agree: legs FR FL HR HL (RR and RL in the stacks), then abad, hip, knee.
Signs: Cheetah-Software's are pronk's own. Unitree's hip pitch and knee axes point the other way
(thigh +0.8, calf -1.6 where pronk has -0.8, +1.6); the abduction axes are the same.

The knee's gains. Cheetah-Software converts the knee's angle, speed and torque by its extra ratio
6 / 9.33, but not its gains (`rt_spi.cpp`): a wire gain k acts as k / 0.6429^2 = 2.42 k at the
joint. Hence a command's knee gains are multiplied by 0.6429^2 on their way to the wire.

Sources: the `lcm-types` of Cheetah-Software (MIT Biomimetics) and of walk-these-ways
(Improbable AI), both MIT licence; `lcmgen.c` for the fingerprint.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.errors import HardwareError
from pronk.links.machine import RefusedError, TorqueKind

Array = NDArray[np.float64]

# --- Messages -----------------------------------------------------------------------------------

_KINDS = {
    "int8_t": ">i1",
    "int32_t": ">i4",
    "int64_t": ">i8",
    "float": ">f4",
    "double": ">f8",
}
_WORD = (1 << 64) - 1


class Message:
    """A type of message: its fingerprint (8 bytes), then its fields, big-endian without padding.

    The fingerprint is a hash of the fields' names, types and lengths. Two stacks use the same names
    and channels for different layouts, so the fingerprint alone identifies a message.
    """

    def __init__(self, name: str, channel: str, layout: str) -> None:
        """Read a layout in LCM's own language, `float q[12]; int64_t id`; `name` is STACK.NAME."""
        self.name, self.channel, self.layout = name, channel, layout
        columns: list[Any] = [("_fingerprint", ">u8")]
        value = 0x12345678
        for kind, field, count in re.findall(r"(\w+) (\w+)(?:\[(\d+)\])?", layout):
            columns.append((field, _KINDS[kind], (int(count),) if count else ()))
            # Texts with their lengths, the number of dimensions, and 0 for a constant one.
            dimensions = b"\1\0" + _text(count) if count else b"\0"
            for byte in _text(field) + _text(kind) + dimensions:
                signed = value - (1 << 64) if value >> 63 else value
                value = ((value << 8) ^ (signed >> 55)) + byte & _WORD
        self.fingerprint = (value << 1 | value >> 63) & _WORD
        self.dtype = np.dtype(columns)
        """The whole message as a NumPy record."""

    def encode(self, **values: ArrayLike) -> bytes:
        """Encode a message; fields that are not named are 0, scalars fill arrays."""
        record = np.zeros((), self.dtype)
        record["_fingerprint"] = self.fingerprint
        for name, value in values.items():
            record[name] = value
        return record.tobytes()

    def decode(self, data: bytes) -> NDArray[np.void]:
        """Decode the fields of a message; RefusedError `fingerprint` or `length`."""
        found, size = int.from_bytes(data[:8], "big"), self.dtype.itemsize
        if len(data) < 8 or found != self.fingerprint:
            known = [f" ({other.name})" for other in MESSAGES if other.fingerprint == found]
            raise RefusedError(
                "fingerprint",
                f"a message has fingerprint {found:#018x}{''.join(known)}, expected "
                f"{self.fingerprint:#018x} ({self.name}); its sender uses another layout.",
            )
        if len(data) != size:
            raise RefusedError(
                "length",
                f"{self.name} is {len(data)} bytes long, expected {size}; it was cut or padded on "
                "the way.",
            )
        return np.frombuffer(data, self.dtype)[0]  # type: ignore[no-any-return]


def _text(text: str) -> bytes:
    return bytes([len(text)]) + text.encode()


# Name, channel and fields. Arrays of 12 are leg by leg (FR FL HR HL, or FR FL RR RL), abad, hip,
# knee (hip, thigh, calf in Unitree's signs); of 4, by leg. pronk's own: joints to hold, to the
# virtual robot; from it, joints held and the last request received.
_TABLE = """
cheetah.spi_data_t spi_data
    float q_abad[4]; float q_hip[4]; float q_knee[4];
    float qd_abad[4]; float qd_hip[4]; float qd_knee[4];
    int32_t flags[4]; int32_t spi_driver_status;
cheetah.leg_control_command_lcmt spi_debug_cmd
    float tau_ff[12]; float f_ff[12]; float q_des[12]; float qd_des[12]; float p_des[12];
    float v_des[12]; float kp_cartesian[12]; float kd_cartesian[12]; float kp_joint[12];
    float kd_joint[12];
cheetah.microstrain_lcmt microstrain
    float quat[4]; float rpy[3]; float omega[3]; float acc[3];
    int64_t good_packets; int64_t bad_packets;
cheetah.control_parameter_request_lcmt interface_request
    int8_t name[64]; int64_t requestNumber; int8_t value[64]; int8_t parameterKind;
    int8_t requestKind;
wtw.leg_control_data_lcmt leg_control_data
    float q[12]; float qd[12]; float p[12]; float v[12]; float tau_est[12];
    int64_t timestamp_us; int64_t id; int64_t robot_id;
wtw.pd_tau_targets_lcmt pd_plustau_targets
    double q_des[12]; double qd_des[12]; double tau_ff[12]; double kp[12]; double kd[12];
    int64_t timestamp_us; int64_t id; int64_t robot_id; double se_contactState[4];
wtw.state_estimator_lcmt state_estimator_data
    float p[3]; float vWorld[3]; float vBody[3]; float rpy[3]; float omegaBody[3];
    float omegaWorld[3]; float quat[4]; float contact_estimate[4]; float aBody[3];
    float aWorld[3]; int64_t timestamp_us; int64_t id; int64_t robot_id;
pronk.virtual_robot_lcmt pronk_bench
    int64_t request; int8_t clamped[12];
"""
MESSAGES = tuple(
    Message(*found) for found in re.findall(r"^(\S+) (\w+)\n((?: .*\n)+)", _TABLE, re.MULTILINE)
)
(
    SPI_DATA,
    LEG_CONTROL_COMMAND,
    MICROSTRAIN,
    CONTROL_PARAMETER,
    WTW_LEG_CONTROL_DATA,
    WTW_PD_TAU_TARGETS,
    WTW_STATE_ESTIMATOR,
    VIRTUAL_ROBOT,
) = MESSAGES
# Responses (control_parameter_respones_lcmt) and beacons have the fields of the requests.
RESPONSE_CHANNEL, BEACON_CHANNEL = "interface_response", "pronk_virtual"

# --- Layouts ------------------------------------------------------------------------------------

KNEE_RATIO = 0.6429
"""Motor to joint beyond the hips' 6:1, as `rt_spi.cpp` has it (6 / 9.33 = .6431)."""
JOINTS = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Messages of a stack, and how their numbers become pronk's."""

    name: str
    command: Message
    joints: Message
    attitude: Message
    fields: Mapping[str, str]
    """Names on the wire."""
    numbered: bool
    """Commands and states carry `timestamp_us` and `id`."""
    signs: Array
    """pronk's angles are signs times the wire's, shape (12,)."""
    gains: Array
    """The wire's stiffness and damping per the joint's own [1], shape (12,)."""
    torque_kind: TorqueKind
    state_rate_hz: float = 500.0


_FIELDS = {"position": "q", "velocity": "qd", "torque": "tau_est", "orientation": "quat"}
CHEETAH = Layout(
    name="cheetah",
    command=LEG_CONTROL_COMMAND,
    joints=SPI_DATA,
    attitude=MICROSTRAIN,
    fields=_FIELDS
    | {"stiffness": "kp_joint", "damping": "kd_joint", "gyro": "omega", "accelerometer": "acc"},
    numbered=False,
    signs=np.ones(JOINTS),
    gains=np.tile([1.0, 1.0, KNEE_RATIO**2], 4),
    # spi_data_t carries none, and what leg_control_data_lcmt calls tau_est is computed from the
    # command on the host, on the knee wrongly.
    torque_kind="absent",
)
WTW = Layout(
    name="wtw",
    command=WTW_PD_TAU_TARGETS,
    joints=WTW_LEG_CONTROL_DATA,
    attitude=WTW_STATE_ESTIMATOR,
    fields=_FIELDS
    | {"stiffness": "kp", "damping": "kd", "gyro": "omegaBody", "accelerometer": "aBody"},
    numbered=True,
    signs=np.tile([1.0, -1.0, -1.0], 4),
    gains=np.ones(JOINTS),
    # Unitree's tauEst, which the motor board computes from its current.
    torque_kind="measured",
)
LAYOUTS = {"cheetah": CHEETAH, "spi": CHEETAH, "wtw": WTW}
"""By name; `spi` is another name of `cheetah`."""


def layout_of(name: str) -> Layout:
    """Look a layout up; HardwareError for an unknown name."""
    if name not in LAYOUTS:
        raise HardwareError(f"no LCM layout {name!r}; there are {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]
