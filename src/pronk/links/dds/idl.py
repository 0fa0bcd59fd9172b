"""Unitree's messages as IDL types: what a Go2 says and hears over DDS.

Layouts: `unitree_go` and `unitree_api` of unitree_sdk2, every type final, members in wire order.
Joint quantities are at the joint, in rad, rad/s and N m; x is forwards, y left, z up; quaternions
are w, x, y, z. Slots 0 to 11 of the motors are FR, FL, RR, RL, each hip, thigh, calf; slots 12 to
19 drive nothing on a Go2.
"""

from __future__ import annotations

from typing import Any

from pronk.errors import HardwareError

try:
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import (
        array,
        float32,
        int16,
        int32,
        int64,
        sequence,
        uint8,
        uint16,
        uint32,
    )
except ImportError:
    raise HardwareError(
        "the DDS link needs the package cyclonedds, which is not installed; "
        "install it with: pip install 'pronk[hardware]'."
    ) from None

MOTORS = 20
"""Motor slots of a message."""


def _struct(module: str, name: str, **members: Any) -> Any:
    """The IDL type `MODULE::msg::dds_::NAME_`."""
    return make_idl_struct(name, f"{module}.msg.dds_.{name}_", members)


# --- rt/lowcmd ----------------------------------------------------------------------------------

# A motor gives tau + kp (q - q_now) + kd (dq - dq_now).
MotorCmd = _struct(
    "unitree_go",
    "MotorCmd",
    mode=uint8,  # 1: servo, 0: off
    q=float32,
    dq=float32,
    tau=float32,
    kp=float32,
    kd=float32,
    reserve=array[uint32, 3],
)
BmsCmd = _struct("unitree_go", "BmsCmd", off=uint8, reserve=array[uint8, 3])
LowCmd = _struct(
    "unitree_go",
    "LowCmd",
    head=array[uint8, 2],
    level_flag=uint8,  # 0xFF: low level
    frame_reserve=uint8,
    sn=array[uint32, 2],
    version=array[uint32, 2],
    bandwidth=uint16,
    motor_cmd=array[MotorCmd, MOTORS],
    bms_cmd=BmsCmd,
    wireless_remote=array[uint8, 40],
    led=array[uint8, 12],
    fan=array[uint8, 2],
    gpio=uint8,
    reserve=uint32,
    crc=uint32,
)

# --- rt/lowstate --------------------------------------------------------------------------------

IMUState = _struct(
    "unitree_go",
    "IMUState",
    quaternion=array[float32, 4],
    gyroscope=array[float32, 3],
    accelerometer=array[float32, 3],
    rpy=array[float32, 3],
    temperature=uint8,
)
MotorState = _struct(
    "unitree_go",
    "MotorState",
    mode=uint8,
    q=float32,
    dq=float32,
    ddq=float32,
    tau_est=float32,
    q_raw=float32,
    dq_raw=float32,
    ddq_raw=float32,
    temperature=uint8,
    lost=uint32,
    reserve=array[uint32, 2],
)
BmsState = _struct(
    "unitree_go",
    "BmsState",
    version_high=uint8,
    version_low=uint8,
    status=uint8,
    soc=uint8,
    current=int32,
    cycle=uint16,
    bq_ntc=array[uint8, 2],
    mcu_ntc=array[uint8, 2],
    cell_vol=array[uint16, 15],
)
LowState = _struct(
    "unitree_go",
    "LowState",
    head=array[uint8, 2],
    level_flag=uint8,
    frame_reserve=uint8,
    sn=array[uint32, 2],
    version=array[uint32, 2],
    bandwidth=uint16,
    imu_state=IMUState,
    motor_state=array[MotorState, MOTORS],
    bms_state=BmsState,
    foot_force=array[int16, 4],
    foot_force_est=array[int16, 4],
    tick=uint32,  # the robot's clock, ms
    wireless_remote=array[uint8, 40],
    bit_flag=uint8,
    adc_reel=float32,
    temperature_ntc1=uint8,
    temperature_ntc2=uint8,
    power_v=float32,
    power_a=float32,
    fan_frequency=array[uint16, 4],
    reserve=uint32,
    crc=uint32,
)

# --- rt/api/SERVICE/request and response --------------------------------------------------------

RequestIdentity = _struct("unitree_api", "RequestIdentity", id=int64, api_id=int64)
RequestLease = _struct("unitree_api", "RequestLease", id=int64)
RequestPolicy = _struct("unitree_api", "RequestPolicy", priority=int32, noreply=bool)
RequestHeader = _struct(
    "unitree_api",
    "RequestHeader",
    identity=RequestIdentity,
    lease=RequestLease,
    policy=RequestPolicy,
)
Request = _struct(
    "unitree_api", "Request", header=RequestHeader, parameter=str, binary=sequence[uint8]
)
ResponseStatus = _struct("unitree_api", "ResponseStatus", code=int32)  # 0: done
ResponseHeader = _struct(
    "unitree_api", "ResponseHeader", identity=RequestIdentity, status=ResponseStatus
)
Response = _struct(
    "unitree_api", "Response", header=ResponseHeader, data=str, binary=sequence[uint8]
)
