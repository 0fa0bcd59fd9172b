"""The LCM messages of the Mini Cheetah and of the walk-these-ways bridge, as one table.

A message whose fingerprint is not the one lcm-gen gives is refused when this module is imported.
Two stacks use the same names and channels for different layouts, so a message is told by its
fingerprint alone.

Sources: the `lcm-types` of Cheetah-Software (MIT Biomimetics) and of walk-these-ways
(Improbable AI), both MIT licence.
"""

from __future__ import annotations

from pronk.links.lcm.message import Message, RefusedError

# --- Cheetah-Software ---------------------------------------------------------------------------
# Arrays of 12 are leg by leg (FR FL HR HL), abad, hip, knee; arrays of 4 are by leg.

SPI_DATA = Message(
    "cheetah.spi_data_t",
    0x3A5F506B524D7E4F,
    "float q_abad[4]; float q_hip[4]; float q_knee[4];"
    "float qd_abad[4]; float qd_hip[4]; float qd_knee[4];"
    "int32_t flags[4]; int32_t spi_driver_status",
)
SPI_COMMAND = Message(
    "cheetah.spi_command_t",
    0xD991D54C6D3782CF,
    "float q_des_abad[4]; float q_des_hip[4]; float q_des_knee[4];"
    "float qd_des_abad[4]; float qd_des_hip[4]; float qd_des_knee[4];"
    "float kp_abad[4]; float kp_hip[4]; float kp_knee[4];"
    "float kd_abad[4]; float kd_hip[4]; float kd_knee[4];"
    "float tau_abad_ff[4]; float tau_hip_ff[4]; float tau_knee_ff[4]; int32_t flags[4]",
)
SPI_TORQUE = Message(
    "cheetah.spi_torque_t",
    0x508E263BB0CB6A4F,
    "float tau_abad[4]; float tau_hip[4]; float tau_knee[4]",
)
LEG_CONTROL_COMMAND = Message(
    "cheetah.leg_control_command_lcmt",
    0x277F792B531376CF,
    "float tau_ff[12]; float f_ff[12]; float q_des[12]; float qd_des[12]; float p_des[12];"
    "float v_des[12]; float kp_cartesian[12]; float kd_cartesian[12]; float kp_joint[12];"
    "float kd_joint[12]",
)
LEG_CONTROL_DATA = Message(
    "cheetah.leg_control_data_lcmt",
    0x4FA4EEB480FBD94F,
    "float q[12]; float qd[12]; float p[12]; float v[12]; float tau_est[12]",
)
STATE_ESTIMATOR = Message(
    "cheetah.state_estimator_lcmt",
    0x86530874C8755CB7,
    "float p[3]; float vWorld[3]; float vBody[3]; float rpy[3]; float omegaBody[3];"
    "float omegaWorld[3]; float quat[4]",
)
MICROSTRAIN = Message(
    "cheetah.microstrain_lcmt",
    0xE21531EA1392FAAA,
    "float quat[4]; float rpy[3]; float omega[3]; float acc[3];"
    "int64_t good_packets; int64_t bad_packets",
)
VECTORNAV = Message(
    "cheetah.vectornav_lcmt", 0xEAF20DBD97EFD7B9, "float q[4]; float w[3]; float a[3]"
)
GAMEPAD = Message(
    "cheetah.gamepad_lcmt",
    0x6F8E39912AF60B9E,
    "int32_t leftBumper; int32_t rightBumper; int32_t leftTriggerButton;"
    "int32_t rightTriggerButton; int32_t back; int32_t start; int32_t a; int32_t b; int32_t x;"
    "int32_t y; int32_t leftStickButton; int32_t rightStickButton; float leftTriggerAnalog;"
    "float rightTriggerAnalog; float leftStickAnalog[2]; float rightStickAnalog[2]",
)
CONTROL_PARAMETER = Message(
    # Request and response (control_parameter_respones_lcmt) have the same fields, hence the same
    # fingerprint; the channel tells them apart.
    "cheetah.control_parameter_request_lcmt",
    0xD04FD3ECA4A52D73,
    "int8_t name[64]; int64_t requestNumber; int8_t value[64]; int8_t parameterKind;"
    "int8_t requestKind",
)
VISUALIZATION = Message(
    "cheetah.cheetah_visualization_lcmt",
    0xD3D2413766DE929F,
    "float q[12]; float x[3]; float quat[4]; float rgba[4]",
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
WTW_RC_COMMAND = Message(
    "wtw.rc_command_lcmt",
    0x8EE4D605D87CFBC5,
    "int16_t mode; float left_stick[2]; float right_stick[2]; float knobs[2];"
    "int16_t left_upper_switch; int16_t left_lower_left_switch; int16_t left_lower_right_switch;"
    "int16_t right_upper_switch; int16_t right_lower_left_switch; int16_t right_lower_right_switch",
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
"""From the bench: joints to hold. From the virtual robot: joints held, and the request answered."""

MESSAGES = {
    message.fingerprint: message
    for message in (
        SPI_DATA,
        SPI_COMMAND,
        SPI_TORQUE,
        LEG_CONTROL_COMMAND,
        LEG_CONTROL_DATA,
        STATE_ESTIMATOR,
        MICROSTRAIN,
        VECTORNAV,
        GAMEPAD,
        CONTROL_PARAMETER,
        VISUALIZATION,
        WTW_LEG_CONTROL_DATA,
        WTW_PD_TAU_TARGETS,
        WTW_RC_COMMAND,
        WTW_STATE_ESTIMATOR,
        VIRTUAL_ROBOT,
    )
}
"""Every message, by fingerprint."""


def identify(data: bytes) -> Message:
    """The type of a message.

    Raises:
        RefusedError: No message that pronk knows begins with these bytes, or its length is another.
    """
    message = MESSAGES.get(int.from_bytes(data[:8], "big")) if len(data) >= 8 else None
    if message is None:
        raise RefusedError(
            "fingerprint",
            f"a message begins with {data[:8].hex() or 'nothing'}, the fingerprint of none of "
            f"{', '.join(known.name for known in MESSAGES.values())}.",
        )
    message.decode(data)
    return message
