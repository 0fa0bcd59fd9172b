"""The Mini Cheetah at rest, its virtual robot, and parameters with perfect sensors."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import AttitudeParams, SimParams, load_sim_params
from pronk.robots import load_robot
from pronk.robots.machine import State

ROBOT = load_robot("mini_cheetah")
POSE = np.array([joint.default_position for joint in ROBOT.joints])
KP = np.array([joint.stiffness for joint in ROBOT.joints])
KD = np.array([joint.damping for joint in ROBOT.joints])
SIM_PARAMS = load_sim_params()
_ERRORS = (
    "sampling_jitter_s",
    "timestamp_error_s",
    "velocity_noise",
    "position_noise",
    "torque_noise",
    "gyro_noise",
    "accelerometer_noise",
    "command_delay_s",
    "measurement_delay_s",
)


def still(**changes: Any) -> State:
    """A state of the robot at rest in its default pose, with changes."""
    whole: dict[str, Any] = {
        "time": 0.0,
        "sequence": 0,
        "position": POSE,
        "velocity": np.zeros(12),
        "torque": np.zeros(12),
        "gyro": np.zeros(3),
        "accelerometer": np.array([0.0, 0.0, 9.81]),
        "bus_voltage": 24.0,
    }
    return State(**(whole | changes))


def rolled(angle: float) -> np.ndarray:
    """Quaternion of a trunk that leans to its side [rad]."""
    return np.array([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])


def quiet(**machine: Any) -> SimParams:
    """The shipped parameters with perfect sensors and no delays, and changes of the machine."""
    nothing: dict[str, Any] = dict.fromkeys(_ERRORS, 0.0)
    nothing |= dict.fromkeys(("gyro_bias", "accelerometer_bias"), (0.0, 0.0, 0.0))
    changed = replace(SIM_PARAMS.machine, **nothing | machine)
    return replace(SIM_PARAMS, machine=changed, attitude=AttitudeParams())


def with_joints(sim_params: SimParams, *names: str, **values: float) -> SimParams:
    """Parameters with other numbers of these joints, or of all."""
    known = sim_params.joints
    changed = {name: replace(known[name], **values) for name in names or known}
    return replace(sim_params, joints={**known, **changed})


def connected(sim_params: SimParams = SIM_PARAMS, **options: Any) -> VirtualRobot:
    machine = VirtualRobot(ROBOT, sim_params, **options)
    machine.connect()
    return machine


@contextmanager
def meanwhile(act: Callable[[], object], period_s: float) -> Iterator[None]:
    """Repeat something in another thread."""
    done = threading.Event()

    def loop() -> None:
        while not done.wait(period_s):
            act()

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def gains(stiffness: float = 17.0, damping: float = 0.4) -> dict[str, Any]:
    """Equal gains of all joints for a Command."""
    return {"stiffness": np.full(12, stiffness), "damping": np.full(12, damping)}
