"""The model of a joint on its test rig: what it holds, and that it is the training simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.signal import chirp

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots import load_robot
from pronk.robots.model import bench_spec, free_spec, set_drive_gains, set_passive
from pronk.robots.motor import torque_limits
from pronk.robots.robot import RobotSpec

CHEETAH = load_robot("mini_cheetah")
ARM = load_robot("so101")


def held_chirp(robot: RobotSpec, seconds: float, amplitude: float) -> Array:
    """Linear chirp .1 to 25 Hz held at policy rate, one value a physics step."""
    ticks = np.arange(round(seconds * robot.policy_rate_hz)) / robot.policy_rate_hz
    signal = amplitude * chirp(ticks, 0.1, seconds, 25.0, phi=-90)
    return np.repeat(signal, robot.decimation)


def commands(model: mujoco.MjModel, joint: str, offset: Array) -> Array:
    """Default commands with one joint's offset added, shape (steps, nu)."""
    command = np.tile(model.key("default").ctrl, (len(offset), 1))
    command[:, model.actuator(joint).id] += offset
    return command


def start(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    return data


def simulate(model: mujoco.MjModel, command: Array) -> Array:
    """Positions at the start of each step, shape (steps, nq)."""
    data = start(model)
    positions = []
    for target in command:
        positions.append(data.qpos.copy())
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
    return np.array(positions)


def explicit_law(
    robot: RobotSpec, spec: mujoco.MjSpec, stiffness: float, damping: float, command: Array
) -> tuple[Array, float]:
    """The training law written out: PD clipped by drive.py, torque motors, implicitfast.

    Returns positions at the start of each step and the share of steps in which it was clipped.
    """
    names = [actuator.name for actuator in spec.actuators]
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in names:
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    model = spec.compile()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = start(model)
    data.ctrl[:] = 0.0
    drives = [robot.joint(name).drive for name in names]
    positions = []
    clipped_steps = 0
    for target in command:
        positions.append(data.qpos.copy())
        torque = stiffness * (target - data.qpos) - damping * data.qvel
        for index, drive in enumerate(drives):
            low, high = torque_limits(
                data.qvel[index], drive.stall_torque, drive.no_load_speed, drive.effort_limit
            )
            data.ctrl[index] = np.clip(torque[index], low, high)
        if np.any(data.ctrl != torque):
            clipped_steps += 1
        mujoco.mj_step(model, data)
    return np.array(positions), clipped_steps / len(command)


@pytest.mark.parametrize("name", ["FR_knee", "FR_hip_roll", "HL_hip_pitch"])
def test_bench_is_the_free_robot_with_its_base_held(name: str) -> None:
    """Gravity torque, inertia and foot position agree with the whole robot's."""
    figures = []
    for spec in (bench_spec(CHEETAH, name), free_spec(CHEETAH)):
        model = spec.compile()
        data = start(model)
        dof = model.joint(name).dofadr[0]
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        foot = data.site(f"{name[:2]}_foot").xpos
        figures.append(np.concatenate([[mass[dof, dof], data.qfrc_bias[dof]], foot]))
    np.testing.assert_allclose(figures[0], figures[1], rtol=1e-9, atol=1e-12)


def changed(
    name: str = "FR_knee",
    drive: Mapping[str, float] | None = None,
    clamped: tuple[str, ...] = (),
) -> RobotSpec:
    """The robot with other values of a drive, or with other joints clamped."""
    joints = []
    for joint in CHEETAH.joints:
        if joint.name == name:
            joint = replace(joint, drive=replace(joint.drive, **drive or {}))
            if clamped:
                joint = replace(joint, clamped=clamped)
        joints.append(joint)
    return replace(CHEETAH, joints=tuple(joints))


def assert_equal_models(a: mujoco.MjModel, b: mujoco.MjModel) -> None:
    for field in dir(a):
        value = getattr(a, field)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            np.testing.assert_array_equal(value, getattr(b, field), err_msg=field)


@pytest.mark.parametrize("name", ["FR_knee", "FR_hip_roll", "HL_hip_pitch"])
@pytest.mark.parametrize("rotor_inertia", [0.0, 63e-6])
def test_edited_model_is_the_recompiled_one(name: str, rotor_inertia: float) -> None:
    robot = changed(name, {"rotor_inertia": rotor_inertia, "frictionloss": 0.35})
    drive = robot.joint(name).drive
    model = bench_spec(CHEETAH, name).compile()
    set_drive_gains(model, name, drive, 21.8, 0.541)
    set_passive(model, name, armature=drive.armature, frictionloss=0.35)
    again = bench_spec(robot, name, stiffness={name: 21.8}, damping={name: 0.541}).compile()
    assert_equal_models(model, again)
    command = commands(model, name, held_chirp(CHEETAH, 1.0, 0.1))
    np.testing.assert_array_equal(simulate(model, command), simulate(again, command))


def test_a_joint_that_is_absent_or_not_in_the_chain_is_refused() -> None:
    model = bench_spec(CHEETAH, "FR_knee").compile()
    absent = CHEETAH.joint("FL_knee").drive
    with pytest.raises(RobotError, match="FR_knee"):
        set_drive_gains(model, "FL_knee", absent, 17.0, 0.4)
    with pytest.raises(RobotError, match="FR_knee"):
        set_passive(model, "FL_knee", armature=0.0)
    with pytest.raises(RobotError, match="FR_kneee"):
        bench_spec(CHEETAH, "FR_knee", stiffness={"FR_kneee": 1.0})
    with pytest.raises(RobotError, match="FR_hip_pitch"):
        bench_spec(changed(clamped=("FR_hip_roll",)), "FR_knee")


def test_knee_alone_is_the_second_order_joint_of_the_paper() -> None:
    """M2 at a fine step: I s^2 + (Kd + b) s + Kp, with I from the CAD figures by hand."""
    spec = bench_spec(changed(drive={"frictionloss": 0.0}), "FR_knee")
    spec.option.timestep = 1e-4
    spec.option.gravity = (0.0, 0.0, 0.0)
    model = spec.compile()
    inertia = 248e-6 + 0.064 * 0.061**2 + 72e-6 * 9.33**2
    stiffness = 17.0
    damping = 0.4 + 0.01
    steps = np.full(3000, 0.1)
    position = simulate(model, commands(model, "FR_knee", steps))[:, 0] - 1.6
    time = np.arange(len(steps)) * 1e-4
    decay = damping / (2 * inertia)
    natural = np.sqrt(stiffness / inertia)
    ringing = np.sqrt(natural**2 - decay**2)
    wave = np.cos(ringing * time) + decay / ringing * np.sin(ringing * time)
    expected = 0.1 * (1.0 - np.exp(-decay * time) * wave)
    np.testing.assert_allclose(position, expected, atol=3e-4)


WEAK = changed(drive={"stall_torque": 12.0, "no_load_speed": 10.0})
"""A weak motor, so that back-EMF rather than the effort limit is what saturates."""


@pytest.mark.parametrize(
    ("robot", "name", "amplitude", "stiffness", "saturates"),
    [
        (CHEETAH, "FR_knee", 0.25, 17.0, False),
        (CHEETAH, "FR_hip_pitch", 1.0, 90.0, True),
        (WEAK, "FR_knee", 0.5, 40.0, True),
        (ARM, "elbow_flex", 0.1, 17.8, False),
    ],
)
def test_native_model_is_the_explicit_law(
    robot: RobotSpec, name: str, amplitude: float, stiffness: float, saturates: bool
) -> None:
    chain = robot.joint(name).chain
    gains = {"stiffness": dict.fromkeys(chain, stiffness), "damping": dict.fromkeys(chain, 0.4)}
    model = bench_spec(robot, name, **gains).compile()
    command = commands(model, name, held_chirp(robot, 4.0, amplitude))
    spec = bench_spec(robot, name, **gains)
    expected, clipped = explicit_law(robot, spec, stiffness, 0.4, command)
    assert (clipped > 0.1) == saturates
    np.testing.assert_allclose(simulate(model, command), expected, atol=1e-9 if clipped else 1e-12)


@pytest.mark.parametrize(
    ("robot", "name"),
    [(robot, name) for robot in (CHEETAH, load_robot("go2")) for name in robot.joint_names],
    ids=lambda value: getattr(value, "name", value),
)
def test_mirror_claim_by_simulation(robot: RobotSpec, name: str) -> None:
    """position(self | command) == sign position(mirror | sign command), about the pose."""
    original, sign = robot.joint(name).original
    offset = held_chirp(robot, 2.0, 0.25)
    model = bench_spec(robot, name).compile()
    mirrored = bench_spec(robot, original).compile()
    position = simulate(model, commands(model, name, offset))
    mirrored_position = simulate(mirrored, commands(mirrored, original, sign * offset))
    column = robot.joint(name).chain.index(name)
    assert np.ptp(position[:, column]) > 0.1
    np.testing.assert_allclose(position[:, column], sign * mirrored_position[:, column], atol=1e-9)


@pytest.mark.train
@pytest.mark.slow
def test_bench_is_mjlab_with_its_dc_motor_actuator(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment's own loop (targets, write, step, update) on the Warp CPU simulator."""
    pytest.importorskip("mjlab")
    monkeypatch.setenv("MJLAB_WARP_QUIET", "1")
    import torch
    from mjlab.actuator import DcMotorActuatorCfg
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
    from mjlab.scene import Scene, SceneCfg
    from mjlab.sim.sim import MujocoCfg, Simulation, SimulationCfg

    name = "FR_hip_roll"
    chain = CHEETAH.joint(name).chain
    model = bench_spec(CHEETAH, name).compile()
    command = commands(model, name, held_chirp(CHEETAH, 4.0, 0.25))
    expected = simulate(model, command)

    def passive() -> mujoco.MjSpec:
        spec = bench_spec(CHEETAH, name)
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        for key in list(spec.keys):
            spec.delete(key)
        # The scene has its own options; unequal ones would be warned of.
        spec.option.timestep = 0.002
        spec.option.disableflags = 0
        return spec

    def motor(joint_name: str) -> DcMotorActuatorCfg:
        joint = CHEETAH.joint(joint_name)
        return DcMotorActuatorCfg(
            target_names_expr=(joint_name,),
            stiffness=joint.stiffness,
            damping=joint.damping,
            saturation_effort=joint.drive.stall_torque,
            velocity_limit=joint.drive.no_load_speed,
            armature=joint.drive.armature,
            frictionloss=joint.drive.frictionloss,
            viscous_damping=joint.drive.viscous_damping,
            effort_limit=joint.drive.effort_limit,
        )

    pose = {joint: CHEETAH.joint(joint).default_position for joint in chain}
    entity = EntityCfg(
        spec_fn=passive,
        init_state=EntityCfg.InitialStateCfg(joint_pos=pose, joint_vel={".*": 0.0}),
        articulation=EntityArticulationInfoCfg(actuators=tuple(map(motor, chain))),
    )
    scene = Scene(SceneCfg(num_envs=1, entities={"robot": entity}), device="cpu")
    config = SimulationCfg(mujoco=MujocoCfg(timestep=CHEETAH.timestep_s, integrator="implicitfast"))
    sim = Simulation(num_envs=1, cfg=config, model=scene.compile(), device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    robot = scene["robot"]
    angles = torch.tensor([list(pose.values())])
    robot.write_joint_state_to_sim(angles, torch.zeros_like(angles))
    sim.forward()
    positions = []
    for target in command:
        positions.append(robot.data.joint_pos[0].numpy().copy())
        robot.set_joint_position_target(torch.tensor(target[None], dtype=torch.float32))
        scene.write_data_to_sim()
        sim.step()
        scene.update(CHEETAH.timestep_s)
    np.testing.assert_allclose(np.array(positions), expected, atol=1e-5)
