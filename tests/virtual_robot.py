"""The Mini Cheetah at rest, its virtual robot, and parameters with perfect sensors."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import AttitudeParams, ImuParams, SimParams, load_sim_params
from pronk.robots import load_robot
from pronk.robots.machine import State

ROBOT = load_robot("mini_cheetah")
POSE = np.array([joint.default_position for joint in ROBOT.joints])
KP = np.array([joint.stiffness for joint in ROBOT.joints])
KD = np.array([joint.damping for joint in ROBOT.joints])
SIM_PARAMS = load_sim_params()


def still(**changes: Any) -> State:
    """Return a state of the robot at rest in its default pose, with changes."""
    state = State(
        time=0.0,
        sequence=0,
        position=POSE,
        velocity=np.zeros(12),
        torque=np.zeros(12),
        gyro=np.zeros(3),
        accelerometer=np.array([0.0, 0.0, 9.81]),
        bus_voltage=24.0,
    )
    return replace(state, **changes)


def rolled(angle: float) -> np.ndarray:
    """Return the quaternion of a trunk that leans to its side [rad]."""
    return np.array([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])


def quiet(**machine: Any) -> SimParams:
    """Return the shipped parameters with perfect sensors, no delays, and changes of the machine."""
    perfect = replace(
        SIM_PARAMS.machine,
        sampling_jitter_s=0.0,
        timestamp_error_s=0.0,
        velocity_noise=0.0,
        position_noise=0.0,
        torque_noise=0.0,
        command_delay_s=0.0,
        measurement_delay_s=0.0,
    )
    imu = ImuParams(
        gyro_noise=0.0,
        gyro_bias=(0.0, 0.0, 0.0),
        accelerometer_noise=0.0,
        accelerometer_bias=(0.0, 0.0, 0.0),
    )
    return replace(
        SIM_PARAMS, machine=replace(perfect, **machine), imu=imu, attitude=AttitudeParams()
    )


def with_fixture(sim_params: SimParams, **fixture: float) -> SimParams:
    """Return parameters with changes of the fixture."""
    return replace(sim_params, fixture=replace(sim_params.fixture, **fixture))


def with_joints(sim_params: SimParams, *names: str, **values: float) -> SimParams:
    """Return parameters with other numbers of these joints, or of all."""
    joints = dict(sim_params.joints)
    for name in names or tuple(joints):
        joints[name] = replace(joints[name], **values)
    return replace(sim_params, joints=joints)


def connected(sim_params: SimParams = SIM_PARAMS, **options: Any) -> VirtualRobot:
    """Return a connected virtual robot; options are those of `VirtualRobot`."""
    machine = VirtualRobot(ROBOT, sim_params, **options)
    machine.connect()
    return machine


def gains(stiffness: float = 17.0, damping: float = 0.4) -> dict[str, Any]:
    """Return equal gains of all joints for a Command."""
    return {"stiffness": np.full(12, stiffness), "damping": np.full(12, damping)}
