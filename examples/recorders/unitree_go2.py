"""Send chirps to one joint of a hanging Unitree Go2 by Unitree's SDK alone, and write a CSV file.

    python unitree_go2.py eth0 FR_calf_joint chirp.csv
    pronk match chirp.csv --robot go2 --unit rad --drive-gains default --out gains.yaml

docs/from-your-go2.md says what to do before. Run on the virtual Go2, not yet on hardware.
"""

import bisect
import csv
import math
import sys
import time
from pathlib import Path

from unitree_sdk2py.comm.motion_switcher.motion_switcher_client import MotionSwitcherClient
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
POSE = [0.0, 0.9, -1.8] * 4  # [rad]
GAINS = (20.0, 0.5)  # of the excited joint [N m/rad, N m s/rad]: what --drive-gains is to say
HOLD = (60.0, 3.0)  # of the others
AMPLITUDES = (0.25, 0.25, 0.125, 0.125)  # of the chirps, one after another [rad]
LOW_HZ, HIGH_HZ, CHIRP_S, PAUSE_S, RISE_S = 0.2, 15.0, 20.0, 1.0, 3.0


def excitation(t):
    """Return the command relative to the pose [rad], a time after the rise [s]."""
    number, t = divmod(t - PAUSE_S, CHIRP_S + PAUSE_S)
    if not 0 <= number < len(AMPLITUDES) or t > CHIRP_S:
        return 0.0
    phase = 2.0 * math.pi * (LOW_HZ * t + 0.5 * (HIGH_HZ - LOW_HZ) / CHIRP_S * t * t)
    return AMPLITUDES[int(number)] * min(1.0, t, CHIRP_S - t) * math.sin(phase)


def record(interface, joint, path, domain=0):
    """Record the chirps of a joint."""
    excited = JOINTS.index(joint)
    ChannelFactoryInitialize(domain, interface)
    switcher = MotionSwitcherClient()
    switcher.Init()
    code, mode = switcher.CheckMode()
    if code != 0 or mode["name"]:
        sys.exit(f"the motion service is on or silent ({code}, {mode}): release it first")
    measured, states, sent = [], [], []

    def on_state(state):
        measured[:] = [motor.q for motor in state.motor_state[:12]]
        states.append((time.perf_counter(), 0.001 * state.tick, measured[excited]))

    subscriber = ChannelSubscriber("rt/lowstate", LowState_)
    subscriber.Init(on_state)
    publisher = ChannelPublisher("rt/lowcmd", LowCmd_)
    publisher.Init()
    message, checksum = unitree_go_msg_dds__LowCmd_(), CRC()
    message.head, message.level_flag = [0xFE, 0xEF], 0xFF

    def send(targets, share):
        for number, motor in enumerate(message.motor_cmd[:12]):
            kp, kd = GAINS if number == excited else HOLD
            motor.mode, motor.q, motor.kp, motor.kd = 1, targets[number], share * kp, kd
        message.crc = checksum.Crc(message)
        publisher.Write(message)
        time.sleep(0.002)

    while not measured:
        time.sleep(0.01)
    start, begin = list(measured), time.perf_counter() + RISE_S
    end = PAUSE_S + len(AMPLITUDES) * (CHIRP_S + PAUSE_S)
    try:
        now = -RISE_S
        while now < end:
            now = time.perf_counter() - begin
            share = min(1.0, 1.0 + now / RISE_S)  # of the way to the pose, and of the stiffness
            targets = [a + share * (b - a) for a, b in zip(start, POSE, strict=True)]
            if now > 0.0:
                targets[excited] += excitation(now)
                sent.append((time.perf_counter(), targets[excited]))
                if abs(measured[excited] - targets[excited]) > 0.6:
                    sys.exit(f"{joint} is 0.6 rad from its command: damped")
            send(targets, share)
    finally:
        for _ in range(500):
            send(measured, 0.0)  # damping
        # States by the robot's clock, for this program may be late; each with the command in force.
        offset = min(arrived - tick for arrived, tick, _ in states)
        times = [moment for moment, _ in sent]
        with Path(path).open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["time", f"command.{joint}", f"position.{joint}"])
            for _, tick, position in states:
                number = bisect.bisect(times, tick + offset) - 1
                if number >= 0 and tick + offset < times[-1]:
                    writer.writerow([f"{tick:.3f}", sent[number][1], position])


if __name__ == "__main__":
    record(*sys.argv[1:4])
