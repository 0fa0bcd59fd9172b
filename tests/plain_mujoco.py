"""An excitation in plain MuJoCo: position actuators, implicitfast, one small step after another."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec

TIMESTEP_S = 1e-4
"""Physics step [s]."""
REST_S = 0.5
"""Time for which the joints hold their pose before the excitation, as in a forecast [s]."""


@dataclass(frozen=True, kw_only=True)
class Peaks:
    """Peaks of the excited joint."""

    torque: float
    """Greatest torque of its actuator [N m]."""
    speed: float
    """Greatest speed [rad/s]."""
    reach: float
    """Greatest distance from the pose [rad]."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What the excited joint did at the start of each physics step, shape (steps,) each."""

    position: Array
    """Position [rad]."""
    speed: Array
    """Speed [rad/s]."""
    torque: Array
    """Torque of its actuator during the step [N m]."""
    timestep_s: float
    """Physics step [s]."""


def motion_in_mujoco(
    robot: RobotSpec, joint: str, offsets: Array, timestep_s: float = TIMESTEP_S
) -> Motion:
    """Excite one joint of a robot on a fixed base, the others of its chain held.

    Args:
        robot: The robot, with the gains of its drives.
        joint: The joint.
        offsets: Command offsets about the pose at each tick of the robot [rad], shape (ticks,).
        timestep_s: Physics step [s]; a tick is cut into whole steps.
    """
    spec = bench_spec(robot, joint)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for key in list(spec.keys):
        spec.delete(key)
    chain = robot.joint(joint).chain
    for name in chain:
        drive_joint = robot.joint(name)
        actuator = spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True
        )
        actuator.set_to_position(kp=drive_joint.stiffness, kv=drive_joint.damping)
        limit = drive_joint.drive.effort_limit
        actuator.forcerange = [-limit, limit]
    steps = max(1, round(1.0 / (robot.policy_rate_hz * timestep_s)))
    spec.option.timestep = 1.0 / (robot.policy_rate_hz * steps)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    data = mujoco.MjData(model)
    pose = np.zeros(model.nu)
    for name in chain:
        position = robot.joint(name).default_position
        pose[model.actuator(name).id] = position
        data.qpos[model.joint(name).qposadr[0]] = position
    excited = model.actuator(joint).id
    place = model.joint(joint).qposadr[0]
    rate = model.joint(joint).dofadr[0]
    rest_ticks = round(REST_S * robot.policy_rate_hz)
    data.ctrl[:] = pose
    rows = []
    for offset in [*np.zeros(rest_ticks), *offsets]:
        data.ctrl[excited] = pose[excited] + offset
        for _ in range(steps):
            before = (float(data.qpos[place]), float(data.qvel[rate]))
            mujoco.mj_step(model, data)
            # The force of the step that was done.
            rows.append((*before, float(data.actuator_force[excited])))
    position, speed, torque = np.array(rows).T
    return Motion(
        position=position, speed=speed, torque=torque, timestep_s=float(model.opt.timestep)
    )


def peaks_in_mujoco(
    robot: RobotSpec, joint: str, offsets: Array, timestep_s: float = TIMESTEP_S
) -> Peaks:
    """Return the peaks of `motion_in_mujoco` from the end of the rest on."""
    motion = motion_in_mujoco(robot, joint, offsets, timestep_s)
    rest = round(REST_S / motion.timestep_s)
    pose = robot.joint(joint).default_position
    return Peaks(
        torque=float(np.abs(motion.torque[rest:]).max()),
        speed=float(np.abs(motion.speed[rest:]).max()),
        reach=float(np.abs(motion.position[rest:] - pose).max()),
    )
