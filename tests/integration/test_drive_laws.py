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
    *(DriveLaw(kind="implicit", iterations=n) for n in (1, 4, 10)),
]
STEP = 0.005


def on_law(name: str, law: DriveLaw) -> RobotSpec:
    """A robot with a drive law, without dry friction and torque limits."""
    robot = load_robot(name)
    free = {"frictionloss": 0.0, "effort_limit": 1e4, "stall_torque": 1e4, "no_load_speed": 1e4}
    joints = tuple(replace(one, drive=replace(one.drive, **free)) for one in robot.joints)
    return replace(robot, law=law, joints=joints)


def integrated(robot: RobotSpec, joint: str, command: Array, start: Array) -> Array:
    """The equations of `pronk.robots.drive_law` with the mass matrix of a chain, step by step."""
    law, model = robot.law, bench_spec(robot, joint).compile()
    data, h = mujoco.MjData(model), law.substep(robot.timestep_s)
    joints = [robot.joint(model.joint(i).name) for i in range(model.nv)]
    kp, kd = (np.array([getattr(j, n) for j in joints]) for n in ("stiffness", "damping"))
    data.qpos[:] = start
    mass, out = np.zeros((model.nv, model.nv)), []
    spring = h * kp if law.kind == "implicit" else 0.0 * kp
    implicit = spring if law.kind == "explicit" else spring + kd
    if law.passive_damping == "implicit":
        implicit = implicit + model.dof_damping
    for target in command:
        out.append(data.qpos.copy())
        for _ in range(law.iterations):
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, data.qfrc_bias)
            mujoco.mj_fullM(model, data, mass)
            damping = (kd + model.dof_damping + spring) * data.qvel
            force = kp * (target - data.qpos) - damping - data.qfrc_bias
            data.qvel[:] += h * np.linalg.solve(mass + h * np.diag(implicit), force)
            data.qpos[:] += h * data.qvel
    return np.array(out)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.label)
@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_leg_follows_the_equations(name: str, law: DriveLaw) -> None:
    robot = on_law(name, law)
    joint = max(robot.joints, key=lambda one: len(one.chain))
    assert len(joint.chain) == 3
    with Chain(robot, joint.name, threads=1) as chain:
        rest = np.array([robot.joint(n).default_position for n in chain.joints])
        time = STEP * np.arange(400)
        command = np.tile(rest, (400, 1))
        wave = 0.2 * np.sin(2.0 * np.pi * (1.0 + 4.0 * time) * time)
        command[:, chain.joints.index(joint.name)] += wave
        got = chain.rollout(command[None], start=rest[None])[0, :-1]
    expected = integrated(robot, joint.name, command, rest)
    assert np.ptp(got, axis=0).min() > 1e-3
    assert np.abs(got - expected).max() < 1e-9


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.label)
def test_the_linearized_response_is_that_of_a_sine(law: DriveLaw) -> None:
    robot, count = on_law("mini_cheetah", law), round(4.0 / STEP)
    pose, omega = np.array([j.default_position for j in robot.joints]), 2.0 * np.pi * 5.0
    gains, time = (
        {"stiffness": np.array([17.0]), "damping": np.array([0.4])},
        STEP * np.arange(count),
    )
    wave = 0.01 * np.sin(omega * time)
    command = robot.joint("FR_knee").default_position + wave
    trace = CommandTrace(joint="FR_knee", start=0.0, timestep=STEP, command=command, pose=pose)
    with JointTestRig(robot, "FR_knee", threads=1) as rig:
        [(_, position)] = list(rig.run([trace], gains, count))
        linear = linearize(rig, trace.excitation(robot)[0], np.array([omega]))
        expected = linear.response(17.0, 0.4)[0, 0]
    tail = slice(count // 2, count)  # 10 whole periods, after the transient
    spin, half = np.exp(-1j * omega * time[tail]), omega * STEP / 2.0
    hold = np.exp(-1j * half) * np.sinc(half / np.pi)
    got = (position[0, tail] @ spin) / (wave[tail] @ spin) / hold
    assert abs(20.0 * np.log10(abs(got / expected))) < 0.01
    assert abs(np.angle(got / expected)) < 1e-3


def test_a_law_takes_only_what_it_has() -> None:
    with pytest.raises(PronkError, match="iterations"):
        DriveLaw(kind="implicit_damping", iterations=4)
    with pytest.raises(PronkError, match="explicit, implicit_damping, implicit"):
        DriveLaw(kind="implicit_stiffness")  # type: ignore[arg-type]
    with pytest.raises(PronkError, match="passive_damping"):
        DriveLaw(kind="implicit", passive_damping="explicit")
