"""Layouts: the LCM messages of a stack, and how their numbers become pronk's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pronk.arrays import Array
from pronk.deploy.links.lcm.messages import (
    LEG_CONTROL_COMMAND,
    MICROSTRAIN,
    SPI_DATA,
    WTW_LEG_CONTROL_DATA,
    WTW_PD_TAU_TARGETS,
    WTW_STATE_ESTIMATOR,
    LcmMessage,
)
from pronk.deploy.links.leg_axes import axis_signs
from pronk.errors import HardwareError
from pronk.robots.machine import TorqueKind
from pronk.robots.robot import RobotSpec

JOINT_COUNT = 12
MINI_CHEETAH_AXES = np.tile([1.0, -1.0, -1.0], 4)
"""`leg_axes.axis_signs` of the Mini Cheetah."""
KNEE_RATIO = 0.6429
"""Motor to joint beyond the hips' 6:1, as `rt_spi.cpp` has it (6 / 9.33 = .6431)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LcmLayout:
    """Messages of a stack, and how their numbers become pronk's.

    Common to all: `q_des` of a command; `q`, `qd`, `tau_est` of the joints, of which `SPI_DATA` has
    the first two by joint; `quat` of the attitude.
    """

    name: str
    command: LcmMessage
    joints: LcmMessage
    attitude: LcmMessage
    stiffness_field: str
    """Field of the stiffness in a command."""
    damping_field: str
    """Field of the damping in a command."""
    gyro_field: str
    """Field of the angular velocity in the trunk's frame in an attitude."""
    accelerometer_field: str
    """Field of the specific force in the trunk's frame in an attitude."""
    numbered: bool
    """Whether commands and states carry `timestamp_us` and `id`."""
    obeys_feed_forward: bool
    """Whether the robot obeys the speeds and torques of a command."""
    signs: Array
    """pronk's angles are signs times the wire's, shape (12,); here those of the Mini Cheetah."""
    gain_ratios: Array
    """The wire's stiffness and damping divided by the joint's own, shape (12,)."""
    torque_kind: TorqueKind
    state_rate_hz: float = 500.0


CHEETAH = LcmLayout(
    name="cheetah",
    command=LEG_CONTROL_COMMAND,
    joints=SPI_DATA,
    attitude=MICROSTRAIN,
    stiffness_field="kp_joint",
    damping_field="kd_joint",
    gyro_field="omega",
    accelerometer_field="acc",
    numbered=False,
    obeys_feed_forward=False,
    signs=np.ones(JOINT_COUNT),
    gain_ratios=np.tile([1.0, 1.0, KNEE_RATIO**2], 4),
    # spi_data_t carries none, and what leg_control_data_lcmt calls tau_est is computed from the
    # command on the host, on the knee wrongly.
    torque_kind="absent",
)
WTW = LcmLayout(
    name="wtw",
    command=WTW_PD_TAU_TARGETS,
    joints=WTW_LEG_CONTROL_DATA,
    attitude=WTW_STATE_ESTIMATOR,
    stiffness_field="kp",
    damping_field="kd",
    gyro_field="omegaBody",
    accelerometer_field="aBody",
    numbered=True,
    obeys_feed_forward=True,
    signs=np.tile([1.0, -1.0, -1.0], 4),
    gain_ratios=np.ones(JOINT_COUNT),
    # Unitree's tauEst, which the motor board computes from its current.
    torque_kind="measured",
)
LAYOUTS = {"cheetah": CHEETAH, "spi": CHEETAH, "wtw": WTW}


def layout_for(robot: RobotSpec, name: str) -> LcmLayout:
    """Return the layout of a robot, with the signs of its joints.

    Args:
        robot: The robot.
        name: Name of the layout.

    Raises:
        HardwareError: The layout is unknown, or its messages are for another number of joints, or
            for legs in another order.
    """
    layout = find_layout(name)
    if len(robot.joints) != JOINT_COUNT:
        raise HardwareError(
            f"{robot.name} has {len(robot.joints)} joints; the LCM messages of {name} are for "
            f"{JOINT_COUNT}."
        )
    signs = layout.signs * MINI_CHEETAH_AXES * axis_signs(robot)
    if np.array_equal(signs, layout.signs):
        return layout
    return replace(layout, signs=signs)


def find_layout(name: str) -> LcmLayout:
    """Return the layout of a name for the Mini Cheetah; HardwareError for an unknown name."""
    if name not in LAYOUTS:
        raise HardwareError(f"no LCM layout {name!r}; there are {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]
