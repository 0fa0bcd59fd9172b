"""The two layouts of messages: which messages on which channels, and how their numbers are meant.

`cheetah` is Cheetah-Software on the robot with MiniCheetahSpi_Controller: states are spi_data_t
and microstrain_lcmt, commands are leg_control_command_lcmt on spi_debug_cmd, of which the robot
reads q_des, kp_joint and kd_joint. `wtw` is the bridge of walk-these-ways (Go1, and the Go2 forks
that kept its messages): states are leg_control_data_lcmt and state_estimator_lcmt, commands are
pd_tau_targets_lcmt.

Joints. All three orders agree: legs FR FL HR HL (RR and RL in the stacks), then abad, hip, knee.
Signs: Cheetah-Software's are pronk's own. Unitree's hip pitch and knee axes point the other way
(thigh +0.8, calf -1.6 where pronk has -0.8, +1.6); the abduction axes are the same.

The knee's gains. Cheetah-Software converts the knee's angle, speed and torque by its extra ratio
6 / 9.33, but not its gains (`rt_spi.cpp`): a wire gain k acts as k / 0.6429^2 = 2.42 k at the
joint. Hence a command's knee gains are multiplied by 0.6429^2 on their way to the wire.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.lcm import types
from pronk.links.lcm.message import Message
from pronk.links.machine import TorqueKind

Array = NDArray[np.float64]

KNEE_RATIO = 0.6429
"""Motor to joint beyond the hips' 6:1, as `rt_spi.cpp` has it (6 / 9.33 = .6431)."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which messages on which channels, and how their numbers become pronk's."""

    name: str
    command: Message
    command_channel: str
    joints: Message
    joints_channel: str
    attitude: Message
    attitude_channel: str
    sign: tuple[float, float, float]
    """Of a leg's three joints: pronk's angle is sign times the wire's."""
    gain: tuple[float, float, float]
    """Of a leg's three joints: the wire's stiffness and damping per the joint's own [1]."""
    torque_kind: TorqueKind
    state_rate_hz: float = 500.0

    @cached_property
    def signs(self) -> Array:
        """`sign` for every joint, shape (12,)."""
        return np.tile(self.sign, 4)

    @cached_property
    def gains(self) -> Array:
        """`gain` for every joint, shape (12,)."""
        return np.tile(self.gain, 4)


CHEETAH = Layout(
    name="cheetah",
    command=types.LEG_CONTROL_COMMAND,
    command_channel="spi_debug_cmd",
    joints=types.SPI_DATA,
    joints_channel="spi_data",
    attitude=types.MICROSTRAIN,
    attitude_channel="microstrain",
    sign=(1.0, 1.0, 1.0),
    gain=(1.0, 1.0, KNEE_RATIO**2),
    # spi_data_t carries none, and what leg_control_data_lcmt calls tau_est is computed from the
    # command on the host, on the knee wrongly.
    torque_kind="absent",
)
WTW = Layout(
    name="wtw",
    command=types.WTW_PD_TAU_TARGETS,
    command_channel="pd_plustau_targets",
    joints=types.WTW_LEG_CONTROL_DATA,
    joints_channel="leg_control_data",
    attitude=types.WTW_STATE_ESTIMATOR,
    attitude_channel="state_estimator_data",
    sign=(1.0, -1.0, -1.0),
    gain=(1.0, 1.0, 1.0),
    # Unitree's tauEst, which the motor board computes from its current.
    torque_kind="measured",
)
LAYOUTS = {layout.name: layout for layout in (CHEETAH, WTW)}


def layout_of(name: str) -> Layout:
    """The layout of that name.

    Raises:
        HardwareError: There is none.
    """
    if name not in LAYOUTS:
        raise HardwareError(f"no LCM layout {name!r}; there are {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]
