"""Send chirps to one joint of a Unitree Go2 through unitree_sdk2_python, and record it.

    python unitree_go2.py eth0 --joint FR_calf_joint --out chirp.csv

The robot hangs, its own controller is off (sport mode released), and all joints hold the pose that
they have at the start, with the gains below. `pronk sweep go2 --link dds` does the same with a
pre-flight, limits and a standby process. Not run on hardware by pronk's developers.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from chirp import command_at, write_csv
from unitree_sdk2py.core.channel import (
    ChannelFactoryInitialize,
    ChannelPublisher,
    ChannelSubscriber,
)
from unitree_sdk2py.idl.default import unitree_go_msg_dds__LowCmd_
from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_
from unitree_sdk2py.utils.crc import CRC

LEGS = ("FR", "FL", "RR", "RL")
JOINTS = [f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh", "calf")]
STIFFNESS, DAMPING = 20.0, 0.5
PERIOD_S = 0.002


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("interface")
    parser.add_argument("--joint", choices=JOINTS, required=True)
    parser.add_argument("--amplitudes", type=float, nargs="+", default=[0.1, 0.2, 0.2])
    parser.add_argument("--high-hz", type=float, default=15.0)
    parser.add_argument("--out", type=Path, default=Path("chirp.csv"))
    options = parser.parse_args()
    number = JOINTS.index(options.joint)

    states: list[LowState_] = []

    def keep_last(state: LowState_) -> None:
        states[:] = [state]

    ChannelFactoryInitialize(0, options.interface)
    publisher = ChannelPublisher("rt/lowcmd", LowCmd_)
    publisher.Init()
    subscriber = ChannelSubscriber("rt/lowstate", LowState_)
    subscriber.Init(keep_last, 10)
    while not states:
        time.sleep(0.01)
    pose = [motor.q for motor in states[0].motor_state[:12]]

    message = unitree_go_msg_dds__LowCmd_()
    message.head[0], message.head[1] = 0xFE, 0xEF
    message.level_flag = 0xFF
    checksum = CRC()
    rows: list[tuple[float, float, float]] = []
    begin = time.perf_counter()
    try:
        while True:
            now = time.perf_counter() - begin
            relative = command_at(now, options.amplitudes, options.high_hz)
            if relative is None:
                break
            for joint, motor in enumerate(message.motor_cmd[:12]):
                motor.mode = 0x01
                motor.q = pose[joint] + (relative if joint == number else 0.0)
                motor.kp, motor.dq, motor.kd, motor.tau = STIFFNESS, 0.0, DAMPING, 0.0
            message.crc = checksum.Crc(message)
            publisher.Write(message)
            rows.append((now, pose[number] + relative, states[0].motor_state[number].q))
            time.sleep(max(0.0, len(rows) * PERIOD_S - (time.perf_counter() - begin)))
    finally:
        for motor in message.motor_cmd[:12]:
            motor.kp, motor.kd = 0.0, 2.0
        message.crc = checksum.Crc(message)
        for _ in range(500):
            publisher.Write(message)
            time.sleep(PERIOD_S)
        write_csv(options.out, options.joint, rows)


if __name__ == "__main__":
    main()
