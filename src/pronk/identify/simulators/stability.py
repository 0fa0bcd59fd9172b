"""The stability limit of a drive law: how large gains may be at a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import mujoco
import numpy as np
import scipy.linalg

from pronk.errors import PronkError
from pronk.identify.simulators.profiles import Profile
from pronk.robots.model import bench_inertia, free_spec
from pronk.robots.robot import RobotSpec

SMALLEST_STEP_S = 1e-5
"""Smallest step of a profile [s]."""


class JointDrives(Protocol):
    """Joints whose drives have the same parameters."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""

    @property
    def stiffness(self) -> float:
        """Stiffness of each drive [N m/rad]."""

    @property
    def damping(self) -> float:
        """Damping of each drive [N m s/rad]."""

    @property
    def armature(self) -> float:
        """Rotor inertia at each joint [kg m^2]."""


def stability_share(robot: RobotSpec, drives: Sequence[JointDrives]) -> float:
    """Compute how much of the drive law's stability limit the drives use; 1 is the limit.

    With mass matrix M, damping D and stiffness K of all joints together, and the step h of the
    law, a pole reaches -1 where the largest eigenvalue of (2 h D + h^2 K) x = l B x is 4; B is M,
    and M + h D where damping is implicit. For one joint of law E this is
    2 h kd / J + h^2 kp / J < 4. Law I has no limit.

    Args:
        robot: The robot with the law and the step of its simulator. It floats in its default pose,
            where its joints feel the least inertia.
        drives: Drives of its joints.
    """
    model = free_spec(robot).compile()
    law = robot.law
    step = law.substep(robot.timestep_s)
    stiffness = np.zeros(model.nv)
    damping = np.zeros(model.nv)
    for drive in drives:
        for name in drive.joints:
            dof = model.joint(name).dofadr[0]
            model.dof_armature[dof] = drive.armature
            stiffness[dof] = drive.stiffness
            damping[dof] = law.damping(drive.stiffness, drive.damping, step)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    implicit = np.zeros(model.nv)
    if law.kind != "explicit":
        implicit += damping
    if law.passive_damping == "explicit":
        damping = damping + model.dof_damping
    else:
        implicit += model.dof_damping
    eigenvalues = scipy.linalg.eigh(
        np.diag(2.0 * step * damping + step**2 * stiffness),
        mass + step * np.diag(implicit),
        eigvals_only=True,
    )
    return float(eigenvalues[-1] / 4.0)


def joint_stability_share(robot: RobotSpec, joint: str, values: Mapping[str, float]) -> float:
    """Compute how much of the drive law's stability limit a joint alone uses; 1 is the limit.

    It is `stability_share` for one joint: its base is fixed and its neighbours stand still, so that
    it feels more inertia than in a robot that floats.

    Args:
        robot: The robot with the law and the step of its simulator.
        joint: Name of the joint.
        values: `stiffness`, `damping` and `armature` of its drive.
    """
    drive = robot.joint(joint).drive
    inertia, _ = bench_inertia(robot, robot.joint(joint).original[0])
    inertia += values["armature"] - drive.armature
    law = robot.law
    step = law.substep(robot.timestep_s)
    damping = law.damping(values["stiffness"], values["damping"], step)
    if law.kind != "explicit":
        inertia += step * damping
    if law.passive_damping == "explicit":
        damping += drive.viscous_damping
    else:
        inertia += step * drive.viscous_damping
    return (2.0 * step * damping + step**2 * values["stiffness"]) / (4.0 * inertia)


def require_stable(profile: Profile, robot: RobotSpec, drives: Sequence[JointDrives]) -> float:
    """Return `stability_share` of drives in a framework.

    Raises:
        PronkError: The drives are at the limit or above it.
    """
    share = stability_share(robot, drives)
    if share >= 1.0:
        stable_step = _stable_step(robot, drives)
        if stable_step > 0.0:
            way_out = f"take a smaller step, as {profile.name},timestep_s={stable_step:g}"
        else:
            way_out = (
                f"no step down to {1000.0 * SMALLEST_STEP_S:g} ms is stable; lower the damping, "
                "raise the armature, or take a framework whose drives are implicit"
            )
        raise PronkError(
            f"the gains of {robot.name} are not stable in {profile.name}: at "
            f"{1000.0 * profile.timestep_s:g} ms they are {share:.3g} times the limit of drive law "
            f"{profile.drive_law.label}; {way_out}."
        )
    return share


def _stable_step(robot: RobotSpec, drives: Sequence[JointDrives]) -> float:
    """Find the largest step, a half of the robot's, a quarter and so on, that is stable [s].

    It is 0 where none is.
    """
    step = 0.5 * robot.timestep_s
    while step >= SMALLEST_STEP_S:
        if stability_share(replace(robot, timestep_s=step), drives) < 1.0:
            return step
        step *= 0.5
    return 0.0
