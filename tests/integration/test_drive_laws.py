"""Drive laws: closed forms on a pendulum, whole legs, and the linearized response."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.command_trace import CommandTrace
from pronk.identify.simulators.linear import linearize
from pronk.identify.simulators.mujoco import Chain, JointTestRig
from pronk.robots import load_robot
from pronk.robots.drive_law import DriveLaw
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec

LAWS = [
    DriveLaw(),
    DriveLaw(passive_damping="explicit"),
    DriveLaw(kind="implicit_damping"),
    DriveLaw(kind="implicit", iterations=1),
    DriveLaw(kind="implicit", iterations=4),
    DriveLaw(kind="implicit", iterations=10),
]
STEP = 0.005


def on_law(name: str, law: DriveLaw) -> RobotSpec:
    """A robot with a drive law, without dry friction and torque limits."""
    robot = load_robot(name)
    joints = []
    for joint in robot.joints:
        drive = replace(
            joint.drive, frictionloss=0.0, effort_limit=1e4, stall_torque=1e4, no_load_speed=1e4
        )
        joints.append(replace(joint, drive=drive))
    return replace(robot, law=law, joints=tuple(joints))


def integrated(robot: RobotSpec, joint: str, command: Array, start: Array) -> Array:
    """The equations of `pronk.robots.drive_law` with the mass matrix of a chain, step by step."""
    law = robot.law
    h = law.substep(robot.timestep_s)
    model = bench_spec(robot, joint).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = start
    kp = np.zeros(model.nv)
    kd = np.zeros(model.nv)
    for index in range(model.nv):
        chain_joint = robot.joint(model.joint(index).name)
        kp[index] = chain_joint.stiffness
        kd[index] = chain_joint.damping
    spring = np.zeros(model.nv)
    if law.kind == "implicit":
        spring = h * kp
    implicit_damping = spring.copy()
    if law.kind != "explicit":
        implicit_damping += kd
    if law.passive_damping == "implicit":
        implicit_damping += model.dof_damping
    mass = np.zeros((model.nv, model.nv))
    positions = []
    for target in command:
        positions.append(data.qpos.copy())
        for _ in range(law.iterations):
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, data.qfrc_bias)
            mujoco.mj_fullM(model, data, mass)
            damping = (kd + model.dof_damping + spring) * data.qvel
            force = kp * (target - data.qpos) - damping - data.qfrc_bias
            data.qvel[:] += h * np.linalg.solve(mass + h * np.diag(implicit_damping), force)
            data.qpos[:] += h * data.qvel
    return np.array(positions)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.label)
@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_leg_follows_the_equations(name: str, law: DriveLaw) -> None:
    robot = on_law(name, law)
    joint = max(robot.joints, key=lambda robot_joint: len(robot_joint.chain))
    assert len(joint.chain) == 3
    with Chain(robot, joint.name, threads=1) as chain:
        start = np.array([robot.joint(link).default_position for link in chain.joints])
        time = STEP * np.arange(400)
        command = np.tile(start, (400, 1))
        wave = 0.2 * np.sin(2.0 * np.pi * (1.0 + 4.0 * time) * time)
        command[:, chain.joints.index(joint.name)] += wave
        position = chain.rollout(command[None], start=start[None])[0, :-1]
    expected = integrated(robot, joint.name, command, start)
    assert np.ptp(position, axis=0).min() > 1e-3
    assert np.abs(position - expected).max() < 1e-9


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.label)
def test_the_linearized_response_is_that_of_a_sine(law: DriveLaw) -> None:
    robot = on_law("mini_cheetah", law)
    pose = np.array([joint.default_position for joint in robot.joints])
    omega = 2.0 * np.pi * 5.0
    count = round(4.0 / STEP)
    time = STEP * np.arange(count)
    wave = 0.01 * np.sin(omega * time)
    gains = {"stiffness": np.array([17.0]), "damping": np.array([0.4])}
    command = robot.joint("FR_knee").default_position + wave
    trace = CommandTrace(joint="FR_knee", start=0.0, timestep=STEP, command=command, pose=pose)
    with JointTestRig(robot, "FR_knee", threads=1) as rig:
        [(_, position)] = list(rig.run([trace], gains, count))
        linear = linearize(rig, trace.excitation(robot)[0], np.array([omega]))
        expected = linear.response(17.0, 0.4)[0, 0]
    # Ten whole periods, after the transient.
    tail = slice(count // 2, count)
    spin = np.exp(-1j * omega * time[tail])
    half_turn = omega * STEP / 2.0
    hold = np.exp(-1j * half_turn) * np.sinc(half_turn / np.pi)
    response = (position[0, tail] @ spin) / (wave[tail] @ spin) / hold
    assert abs(20.0 * np.log10(abs(response / expected))) < 0.01
    assert abs(np.angle(response / expected)) < 1e-3


def test_a_law_takes_only_what_it_has() -> None:
    with pytest.raises(PronkError, match="iterations"):
        DriveLaw(kind="implicit_damping", iterations=4)
    with pytest.raises(PronkError, match="explicit, implicit_damping, implicit"):
        DriveLaw(kind="implicit_stiffness")  # type: ignore[arg-type]
    with pytest.raises(PronkError, match="passive_damping"):
        DriveLaw(kind="implicit", passive_damping="explicit")
