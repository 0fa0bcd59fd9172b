"""Exports: the text runs where it is meant to, and the torque is the PD law."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pronk.actuator.model import torque_limits
from pronk.errors import PronkError
from pronk.logs.joint_log import JointLog
from pronk.match.export import EXPORTS, export_text, group_drives
from pronk.match.gains import JointGains, MatchedGains
from pronk.match.predict import drives_of
from pronk.match.randomization import group_gains
from pronk.robots import load_robot
from pronk.simulators.chain import ChainSimulation
from pronk.simulators.simulator import SimulatorInfo

ROBOT = load_robot("mini_cheetah")


def matched(robot_name: str = "mini_cheetah", **extra: float) -> MatchedGains:
    robot = load_robot(robot_name)
    joints = {}
    for i, joint in enumerate(robot.joints):
        kp, kd = joint.stiffness + 0.3 * i, joint.damping + 0.004 * i
        joints[joint.name] = JointGains(
            stiffness=kp,
            damping=kd,
            stiffness_ci95=(kp - 0.3, kp + 0.3),
            damping_ci95=(kd - 0.02, kd + 0.02),
            covariance=((0.02, 0.0), (0.0, 1e-4)),
            armature=joint.drive.armature,
            **extra,
        )
    return MatchedGains(
        robot=robot.name,
        simulator=SimulatorInfo(version=mujoco.__version__),
        joints=joints,
        groups=group_gains(robot, joints),
        logs={"FR_knee.mcap": "ab" * 32},
        virtual=True,
    )


@pytest.mark.train
def test_mjlab_text_builds_the_actuators_and_events() -> None:
    pytest.importorskip("mjlab")
    space: dict[str, object] = {}
    exec(export_text(matched(frictionloss=0.15, delay_s=0.011), "mjlab"), space)
    actuators, events = space["ACTUATORS"], space["EVENTS"]
    assert isinstance(actuators, tuple)
    assert isinstance(events, dict)
    groups = matched().groups
    assert len(actuators) == len(events) == len(groups)
    for i, (cfg, event, (name, group)) in enumerate(
        zip(actuators, events.values(), groups.items(), strict=True)
    ):
        drive = ROBOT.group(name)[0].drive
        assert cfg.target_names_expr == tuple(j.name for j in ROBOT.group(name))
        assert (cfg.stiffness, cfg.damping) == (group.stiffness, group.damping)
        assert cfg.armature == pytest.approx(drive.armature)
        assert cfg.frictionloss == 0.15
        assert cfg.effort_limit == pytest.approx(drive.effort_limit)
        assert cfg.saturation_effort == pytest.approx(drive.stall_torque)
        assert cfg.velocity_limit == pytest.approx(drive.no_load_speed)
        assert (cfg.delay_min_lag, cfg.delay_max_lag) == (2, 2)
        assert event.params["asset_cfg"].actuator_ids == [i]
        assert event.params["operation"] == "abs"
        low, high = event.params["kp_range"]
        assert (low + high) / 2 == pytest.approx(group.stiffness)
        assert high - low == pytest.approx(2 * group.stiffness_range)


@pytest.mark.train
def test_mjlab_actuators_attach_to_the_robot() -> None:
    pytest.importorskip("mjlab")
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
    from mjlab.entity.entity import Entity

    from pronk.robots.model import free_spec

    space: dict[str, object] = {}
    exec(export_text(matched(), "mjlab"), space)
    entity = Entity(
        EntityCfg(
            spec_fn=lambda: free_spec(ROBOT),
            articulation=EntityArticulationInfoCfg(actuators=space["ACTUATORS"]),  # type: ignore[arg-type]
        )
    )
    model = entity.spec.compile()
    assert model.nu == 12
    assert {model.actuator(i).name.split("/")[-1] for i in range(12)} == set(ROBOT.joint_names)


@pytest.mark.parametrize("robot", ["mini_cheetah", "so101"])
def test_mjcf_compiles_and_its_torque_is_the_clipped_pd_law(robot: str) -> None:
    gains = matched(robot)
    machine = load_robot(robot)
    model = mujoco.MjModel.from_xml_string(export_text(gains, "mjcf"))
    assert model.opt.timestep == machine.timestep_s
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)
    for scale in (0.1, 3.0):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = random.normal(0.0, 3.0 * scale, model.nv)
        data.ctrl[:] = random.normal(0.0, scale, model.nu)
        mujoco.mj_forward(model, data)
        for joint in machine.joints:
            group = gains.groups[joint.group]
            at = model.joint(joint.name)
            q, speed = data.qpos[at.qposadr[0]], data.qvel[at.dofadr[0]]
            torque = group.stiffness * (data.actuator(joint.name).ctrl[0] - q)
            torque -= group.damping * speed
            drive = joint.drive
            limits = drive.stall_torque, drive.no_load_speed, drive.effort_limit
            expected = np.clip(torque, *torque_limits(speed, *limits))
            assert data.actuator(joint.name).force[0] == pytest.approx(float(expected), abs=1e-4)
            assert model.dof_armature[at.dofadr[0]] == pytest.approx(drive.armature, rel=1e-4)


@pytest.mark.parametrize("target", list(EXPORTS))
def test_every_export_names_its_simulator_and_logs(target: str) -> None:
    text = export_text(matched(), target)
    for words in (f"mujoco {mujoco.__version__}", "0.005", "dc_motor_pd", "virtual", "ab" * 32):
        assert words in text
    if target == "isaaclab":
        assert text.startswith("# NOT MATCHED")
        compile(text, target, "exec")


def test_unknown_target_and_foreign_robot_are_refused() -> None:
    with pytest.raises(PronkError, match="mjlab, mjcf, isaaclab"):
        export_text(matched(), "gazebo")
    with pytest.raises(PronkError, match="so101"):
        group_drives(matched(), load_robot("so101"))


def test_friction_that_falls_with_speed_is_in_the_mjcf_and_named_elsewhere() -> None:
    arm, gains = load_robot("so101"), matched("so101", frictionloss=0.2, stribeck=0.6)
    model = mujoco.MjModel.from_xml_string(export_text(gains, "mjcf"))
    drives = drives_of(arm, gains)
    for name, group in gains.groups.items():
        drives[name] |= {"stiffness": group.stiffness, "damping": group.damping}
    start = np.array([joint.default_position for joint in arm.joints])
    time = arm.timestep_s * np.arange(400)
    command = start + 0.2 * np.sin(2.0 * np.pi * time[:, None] * np.linspace(0.5, 1.0, len(start)))
    log = JointLog(
        robot="so101",
        joints=arm.joint_names,
        time=time,
        command=command,
        position=np.tile(start, (len(time), 1)),
    )
    with ChainSimulation(arm, [log], threads=1) as chain:
        expected = chain.run([drives])[0][0]
    data = mujoco.MjData(model)
    data.qpos[:] = start
    for target, position in zip(command, expected, strict=True):
        assert data.qpos == pytest.approx(position, abs=1e-5)
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
    for target in ("mjlab", "isaaclab"):
        assert "elbow_flex 0.6" in export_text(gains, target)
        assert "elbow_flex 0.6" not in export_text(matched("so101"), target)
