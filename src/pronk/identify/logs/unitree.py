"""Unitree's messages in ROS: their definitions, and the order of the joints in them.

A bag of ROS 2 up to Humble may come without definitions of its messages. Those here are of the
packages `unitree_go` (quadrupeds) and `unitree_hg` (humanoids) of Unitree's `unitree_ros2`; angles
are in rad, speeds in rad/s, torques in N m, all at the joint.
"""

from __future__ import annotations

from collections.abc import Sequence

from pronk.errors import LogError
from pronk.robots.robot import RobotSpec

STATE_TYPES = (
    "unitree_go/msg/LowState",
    "unitree_hg/msg/LowState",
    "unitree_legged_msgs/msg/LowState",
)
"""Types of the states; the last one is of ROS 1."""
COMMAND_TYPES = (
    "unitree_go/msg/LowCmd",
    "unitree_hg/msg/LowCmd",
    "unitree_legged_msgs/msg/LowCmd",
)
"""Types of the commands to the motors."""
DEFINITIONS = {
    "unitree_go/msg/MotorState": (
        "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\nfloat32 q_raw\n"
        "float32 dq_raw\nfloat32 ddq_raw\nuint8 temperature\nuint32 lost\nuint32[2] reserve\n"
    ),
    "unitree_go/msg/IMUState": (
        "float32[4] quaternion\nfloat32[3] gyroscope\nfloat32[3] accelerometer\nfloat32[3] rpy\n"
        "uint8 temperature\n"
    ),
    "unitree_go/msg/BmsState": (
        "uint8 version_high\nuint8 version_low\nuint8 status\nuint8 soc\nint32 current\n"
        "uint16 cycle\nuint8[2] bq_ntc\nuint8[2] mcu_ntc\nuint16[15] cell_vol\n"
    ),
    "unitree_go/msg/LowState": (
        "uint8[2] head\nuint8 level_flag\nuint8 frame_reserve\nuint32[2] sn\nuint32[2] version\n"
        "uint16 bandwidth\nIMUState imu_state\nMotorState[20] motor_state\nBmsState bms_state\n"
        "int16[4] foot_force\nint16[4] foot_force_est\nuint32 tick\nuint8[40] wireless_remote\n"
        "uint8 bit_flag\nfloat32 adc_reel\nuint8 temperature_ntc1\nuint8 temperature_ntc2\n"
        "float32 power_v\nfloat32 power_a\nuint16[4] fan_frequency\nuint32 reserve\nuint32 crc\n"
    ),
    "unitree_go/msg/MotorCmd": (
        "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\n"
        "uint32[3] reserve\n"
    ),
    "unitree_go/msg/BmsCmd": "uint8 off\nuint8[3] reserve\n",
    "unitree_go/msg/LowCmd": (
        "uint8[2] head\nuint8 level_flag\nuint8 frame_reserve\nuint32[2] sn\nuint32[2] version\n"
        "uint16 bandwidth\nMotorCmd[20] motor_cmd\nBmsCmd bms_cmd\nuint8[40] wireless_remote\n"
        "uint8[12] led\nuint8[2] fan\nuint8 gpio\nuint32 reserve\nuint32 crc\n"
    ),
    "unitree_hg/msg/MotorState": (
        "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\nint16[2] temperature\n"
        "float32 vol\nuint32[2] sensor\nuint32 motorstate\nuint32[4] reserve\n"
    ),
    "unitree_hg/msg/IMUState": (
        "float32[4] quaternion\nfloat32[3] gyroscope\nfloat32[3] accelerometer\nfloat32[3] rpy\n"
        "int16 temperature\n"
    ),
    "unitree_hg/msg/LowState": (
        "uint32[2] version\nuint8 mode_pr\nuint8 mode_machine\nuint32 tick\nIMUState imu_state\n"
        "MotorState[35] motor_state\nuint8[40] wireless_remote\nuint32[4] reserve\nuint32 crc\n"
    ),
    "unitree_hg/msg/MotorCmd": (
        "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\nuint32 reserve\n"
    ),
    "unitree_hg/msg/LowCmd": (
        "uint8 mode_pr\nuint8 mode_machine\nMotorCmd[35] motor_cmd\nuint32[4] reserve\nuint32 crc\n"
    ),
}
"""Definitions by type, in ROS's own notation."""

QUADRUPED_JOINTS = (
    "FR_hip_joint",
    "FR_thigh_joint",
    "FR_calf_joint",
    "FL_hip_joint",
    "FL_thigh_joint",
    "FL_calf_joint",
    "RR_hip_joint",
    "RR_thigh_joint",
    "RR_calf_joint",
    "RL_hip_joint",
    "RL_thigh_joint",
    "RL_calf_joint",
)
"""Motors 0 to 11 of A1, Go1, Go2, B1 and B2, by the names of Unitree's models (unitree_sdk2)."""
G1_JOINTS = (
    "left_hip_pitch_joint",
    "left_hip_roll_joint",
    "left_hip_yaw_joint",
    "left_knee_joint",
    "left_ankle_pitch_joint",
    "left_ankle_roll_joint",
    "right_hip_pitch_joint",
    "right_hip_roll_joint",
    "right_hip_yaw_joint",
    "right_knee_joint",
    "right_ankle_pitch_joint",
    "right_ankle_roll_joint",
    "waist_yaw_joint",
    "waist_roll_joint",
    "waist_pitch_joint",
    "left_shoulder_pitch_joint",
    "left_shoulder_roll_joint",
    "left_shoulder_yaw_joint",
    "left_elbow_joint",
    "left_wrist_roll_joint",
    "left_wrist_pitch_joint",
    "left_wrist_yaw_joint",
    "right_shoulder_pitch_joint",
    "right_shoulder_roll_joint",
    "right_shoulder_yaw_joint",
    "right_elbow_joint",
    "right_wrist_roll_joint",
    "right_wrist_pitch_joint",
    "right_wrist_yaw_joint",
)
"""Motors 0 to 28 of a G1, by the names of Unitree's models (unitree_sdk2, example/g1)."""
PARALLEL_MODE = 1
"""Value of `mode_pr` with which the motors of ankles and waist of a G1 are those of their linkages,
A and B (unitree_sdk2, example/g1: enumeration Mode)."""
_G1_ALONE = "waist_yaw_joint"
"""Joint that a G1 has and Unitree's other humanoids, whose order differs, do not."""


def motor_joints(
    message_type: str, used_motors: int, robot: RobotSpec | None, order: str | Sequence[str] | None
) -> tuple[str, ...]:
    """Name the joints of the first motors of Unitree's messages.

    Args:
        message_type: Type of the states.
        used_motors: Number of the motors up to the last one that reports anything.
        robot: The robot, if it is known.
        order: The order that the user states: see `ReadOptions.joint_order`.

    Returns:
        Names in the order of the messages, the user's, or those of Unitree's models.

    Raises:
        LogError: The order is not known; the message names the option.
    """
    if order == "default" and robot is not None:
        return robot.joint_names
    if order not in (None, "default"):
        return tuple(order.split(",")) if isinstance(order, str) else tuple(order or ())
    robot_joints: set[str] = set()
    if robot is not None:
        for joint in robot.joints:
            robot_joints.update((joint.name, joint.own_name))
    if message_type.startswith("unitree_hg/"):
        is_g1 = _G1_ALONE in robot_joints
        if is_g1:
            return G1_JOINTS
    else:
        of_quadruped = robot_joints.issuperset(QUADRUPED_JOINTS)
        if of_quadruped or (robot is None and used_motors <= len(QUADRUPED_JOINTS)):
            return QUADRUPED_JOINTS
    whose = "without --robot" if robot is None else f"for {robot.name}"
    raise LogError(
        f"the order of the joints in {message_type} is not known {whose}; give --joint-order "
        "NAME,NAME,... of the motors 0, 1, ..., or --joint-order default with --robot if that is "
        "the robot's own order."
    )
