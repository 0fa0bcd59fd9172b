"""Drive laws: closed forms on a pendulum, whole legs, and the linearized response."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pronk.actuator.law import DriveLaw
from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.robots import load_robot
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec
from pronk.simulators.command_trace import CommandTrace
from pronk.simulators.linear import plant
from pronk.simulators.mujoco import Chain, JointTestRig

LAWS = [
    DriveLaw(),
    DriveLaw(passive_damping="explicit"),
    DriveLaw(kind="implicit_damping"),
    *(DriveLaw(kind="implicit", iterations=n) for n in (1, 4, 10)),
]
STEP = 0.005


def on_law(robot: RobotSpec, law: DriveLaw, *, linear: bool = True) -> RobotSpec:
    """A robot with a drive law; `linear` without dry friction and torque limits."""
    joints = robot.joints
    if linear:
        joints = tuple(
            replace(
                joint,
                drive=replace(
                    joint.drive,
                    **{"frictionloss": 0.0, "effort_limit": 1e4, "stall_torque": 1e4},
                    no_load_speed=1e4,
                ),
            )
            for joint in joints
        )
    return replace(robot, law=law, joints=joints)


def integrated(robot: RobotSpec, joint: str, command: Array, start: Array) -> Array:
    """The equations of `pronk.actuator.law` with the mass matrix of a chain, step by step."""
    law, model = robot.law, bench_spec(robot, joint).compile()
    data, h = mujoco.MjData(model), law.substep(robot.timestep_s)
    joints = [robot.joint(model.joint(i).name) for i in range(model.nv)]
    kp, kd = (np.array([getattr(j, n) for j in joints]) for n in ("stiffness", "damping"))
    data.qpos[:] = start
    mass, out = np.zeros((model.nv, model.nv)), []
    passive = model.dof_damping
    for target in command:
        out.append(data.qpos.copy())
        for _ in range(law.iterations):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_makeM(model, data)
            mujoco.mj_rne(model, data, 0, data.qfrc_bias)
            mujoco.mj_fullM(model, data, mass)
            matrix = mass.copy()
            if law.passive_damping == "implicit":
                matrix += h * np.diag(passive)
            force = -kd * data.qvel - passive * data.qvel - data.qfrc_bias
            if law.kind != "explicit":
                matrix = matrix + h * np.diag(kd)
            if law.kind == "implicit":
                matrix = matrix + h * h * np.diag(kp)
                force = force - h * kp * data.qvel
            force = force + kp * (target - data.qpos)
            data.qvel[:] += h * np.linalg.solve(matrix, force)
            data.qpos[:] += h * data.qvel
    return np.array(out)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.label)
@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_leg_follows_the_equations(name: str, law: DriveLaw) -> None:
    robot = on_law(load_robot(name), law)
    joint = max(robot.joints, key=lambda one: len(one.chain))
    assert len(joint.chain) == 3
    with Chain(robot, joint.name, threads=1) as chain:
        rest = np.array([robot.joint(n).default_position for n in chain.joints])
        time = STEP * np.arange(400)
        command = np.tile(rest, (400, 1))
        command[:, chain.joints.index(joint.name)] += 0.2 * np.sin(
            2.0 * np.pi * (1.0 + 4.0 * time) * time
        )
        got = chain.rollout(command[None], [{}], rest[None])[0, :-1]
    expected = integrated(robot, joint.name, command, rest)
    assert np.ptp(got, axis=0).min() > 1e-3
    assert np.abs(got - expected).max() < 1e-9


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.label)
def test_the_linearized_response_is_that_of_a_sine(law: DriveLaw) -> None:
    robot = on_law(load_robot("mini_cheetah"), law)
    pose, hz = np.array([j.default_position for j in robot.joints]), 5.0
    amplitude, gains = 0.01, {"stiffness": np.array([17.0]), "damping": np.array([0.4])}
    with JointTestRig(robot, "FR_knee", threads=1) as rig:
        count = round(4.0 / STEP)
        time = STEP * np.arange(count)
        wave = pose[robot.joint_names.index("FR_knee")] + amplitude * np.sin(
            2.0 * np.pi * hz * time
        )
        trace = CommandTrace(
            **{"joint": "FR_knee", "command": wave, "timestep": STEP, "pose": pose},
            **{"start": 0.0, "amplitude": amplitude},
        )
        [(_, position)] = list(rig.run([trace], gains, count))
        chain_pose = trace.excitation(robot)[0]
        linear = plant(rig, chain_pose, np.array([2.0 * np.pi * hz]))
        expected = linear.response(17.0, 0.4)[0, 0]
    tail = slice(count // 2, count)  # 10 whole periods, after the transient
    spin = np.exp(-2j * np.pi * hz * time[tail])
    half = np.pi * hz * STEP
    hold = np.exp(-1j * half) * np.sinc(half / np.pi)
    got = (position[0, tail] @ spin) / ((wave[tail] - wave[tail].mean()) @ spin) / hold
    assert abs(20.0 * np.log10(abs(got / expected))) < 0.01
    assert abs(np.angle(got / expected)) < 1e-3


def test_a_law_takes_only_what_it_has() -> None:
    with pytest.raises(PronkError, match="iterations"):
        DriveLaw(kind="implicit_damping", iterations=4)
    with pytest.raises(PronkError, match="explicit, implicit_damping, implicit"):
        DriveLaw(kind="implicit_stiffness")  # type: ignore[arg-type]
    with pytest.raises(PronkError, match="passive_damping"):
        DriveLaw(kind="implicit", passive_damping="explicit")
