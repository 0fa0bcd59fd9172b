"""Exports: the text runs where it is meant to, and the torque is the drive law's."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import mujoco
import numpy as np
import pytest

from pronk.arrays import Array
from pronk.cli.export import TargetName
from pronk.errors import PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.export.actuators import Actuator, exported_actuators
from pronk.identify.match.export.targets import TARGETS, export
from pronk.identify.match.gains import FittedValue, JointGains, MatchedGains
from pronk.identify.match.parameters import GAINS
from pronk.identify.match.predict import drives_of
from pronk.identify.match.ranges import group_gains
from pronk.identify.simulators.chain import ChainSimulation
from pronk.identify.simulators.mujoco import Chain
from pronk.identify.simulators.profiles import load_profiles, profile
from pronk.identify.simulators.stability import stability_share
from pronk.robots import load_robot
from pronk.robots.model import free_spec
from pronk.robots.robot import RobotSpec

ROBOT = load_robot("mini_cheetah")
_ISAACLAB = {"joint_names_expr", "stiffness", "damping", "armature"} | {
    *("friction", "dynamic_friction", "viscous_friction"),
    *("saturation_effort", "min_delay", "max_delay"),
}
ISAACLAB = {
    # actuator_base_cfg.py and actuator_pd_cfg.py of v2.3.2.
    "2.3": _ISAACLAB | {"effort_limit", "velocity_limit", "effort_limit_sim", "velocity_limit_sim"},
    # The same files of release 3.0.0; names that it deprecates are left out.
    "3.0": _ISAACLAB
    | {"actuator_effort_limit", "actuator_velocity_limit"}
    | {"joint_effort_limit", "joint_velocity_limit"},
}


def matched(
    robot_name: str = "mini_cheetah", simulator: str = "mjlab", only: str = "", **extra: float
) -> MatchedGains:
    robot = load_robot(robot_name)
    extra_values = {}
    for name, value in extra.items():
        extra_values[name] = FittedValue(value=value)
    joints = {}
    for i, joint in enumerate(robot.joints):
        if joint.name.endswith(only):
            joints[joint.name] = JointGains(
                stiffness=FittedValue(value=joint.stiffness + 0.3 * i),
                damping=FittedValue(value=joint.damping + 0.004 * i),
                armature=FittedValue(value=joint.drive.armature),
                **extra_values,
            )
    return MatchedGains(
        robot=robot.name,
        simulator=profile(simulator).info,
        joints=joints,
        groups=group_gains(robot, joints),
        logs={"FR_knee.mcap": "ab" * 32},
        virtual=True,
    )


def evaluated(text: str) -> dict[str, Any]:
    space: dict[str, Any] = {}
    exec(text, space)
    return space


def for_target(target: str, **extra: Any) -> MatchedGains:
    return matched(simulator=TARGETS[target].profile or "isaaclab-implicit", **extra)


def entity_model(robot: RobotSpec, text: str) -> mujoco.MjModel:
    """The robot with the actuators that mjlab makes of an export."""
    pytest.importorskip("mjlab")
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
    from mjlab.entity.entity import Entity

    articulation = EntityArticulationInfoCfg(actuators=evaluated(text)["ACTUATORS"])
    entity = Entity(EntityCfg(spec_fn=lambda: free_spec(robot), articulation=articulation))
    return entity.spec.compile()


def driven_joints(model: mujoco.MjModel) -> list[str]:
    return [model.actuator(i).name.split("/")[-1] for i in range(model.nu)]


@pytest.mark.train
@pytest.mark.parametrize("target", ["mjlab", "mjlab-idealpd", "mjlab-builtin"])
def test_mjlab_text_builds_the_actuators_and_events(target: str) -> None:
    gains = for_target(target, frictionloss=0.15, delay_s=0.011)
    text = export(gains, target)
    assert {*driven_joints(entity_model(ROBOT, text))} == {*ROBOT.joint_names}
    space = evaluated(text)
    assert list(space["EVENTS"]) == [f"{name}_gains" for name in gains.groups]
    assert len(space["ACTUATORS"]) == len(gains.groups)
    for index, (name, group) in enumerate(gains.groups.items()):
        cfg = space["ACTUATORS"][index]
        event = space["EVENTS"][f"{name}_gains"]
        joints = ROBOT.group(name)
        drive = joints[0].drive
        assert type(cfg).__name__ == TARGETS[target].config_class
        assert cfg.target_names_expr == tuple(joint.name for joint in joints)
        assert (cfg.stiffness, cfg.damping) == (group.stiffness, group.damping)
        assert cfg.armature == pytest.approx(drive.armature)
        assert cfg.frictionloss == 0.15
        assert cfg.effort_limit == pytest.approx(drive.effort_limit)
        if target == "mjlab":
            assert cfg.saturation_effort == pytest.approx(drive.stall_torque)
            assert cfg.velocity_limit == pytest.approx(drive.no_load_speed)
        assert (cfg.delay_min_lag, cfg.delay_max_lag) == (2, 2)
        assert event.params["asset_cfg"].actuator_ids == [index]
        assert event.params["operation"] == "abs"
        softest = group.stiffness - group.stiffness_range
        stiffest = group.stiffness + group.stiffness_range
        assert event.params["kp_range"] == pytest.approx((softest, stiffest))


@pytest.mark.parametrize("target", [name for name in TARGETS if name.startswith("isaaclab")])
def test_isaaclab_text_has_the_arguments_of_its_release(target: str) -> None:
    gains = for_target(target, frictionloss=0.15, delay_s=0.011)
    text = export(gains, target)
    calls = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            calls.append(node)
    assert len(calls) == len(gains.groups)
    for call, group in zip(calls, gains.groups.values(), strict=True):
        values = {}
        for keyword in call.keywords:
            values[keyword.arg] = ast.literal_eval(keyword.value)
        assert set(values) <= ISAACLAB["2.3" if target.endswith("2.3") else "3.0"]
        assert "effort_limit" in " ".join(map(str, values))
        assert values["stiffness"] == group.stiffness
        assert values["friction"] == 0.15
        assert values.get("dynamic_friction", 0.15) == 0.15
        assert values.get("max_delay", 2) == 2
        damping = group.damping
        if target == "isaaclab-newton":  # without viscous friction of its own
            damping += 0.01
        assert values["damping"] == pytest.approx(damping)
    assert ("2.2 steps" in text.replace("\n# ", " ")) == (not target.startswith("isaaclab-delayed"))


def test_genesis_text_sets_every_parameter_of_every_joint() -> None:
    gains = for_target("genesis", robot_name="go2")
    space = evaluated(export(gains, "genesis", per="joint"))
    called = {}

    class Robot:
        def get_joint(self, name: str) -> Any:
            index = list(space["JOINTS"]).index(name)
            return type("Joint", (), {"dofs_idx_local": [6 + index]})

        def __getattr__(self, name: str) -> Any:
            return lambda *values: called.update({name: values})

    space["apply"](Robot())
    robot = load_robot("go2")
    assert list(space["JOINTS"])[:3] == ["FR_hip_joint", "FL_hip_joint", "RR_hip_joint"]
    assert called["set_dofs_kp"][1] == list(range(6, 18))
    stiffness = []
    armature = []
    for part in robot.groups:
        for leg in robot.legs:
            joint_gains = gains.joints[f"{leg}_{part}"]
            stiffness.append(joint_gains.stiffness.value)
            armature.append(joint_gains.armature.value)
    assert called["set_dofs_kp"][0] == pytest.approx(stiffness)
    assert called["set_dofs_armature"][0] == pytest.approx(armature)
    low, high, _ = called["set_dofs_force_range"]
    assert high == np.negative(low).tolist()
    assert {*called} == {f"set_dofs_{name}" for name in TARGETS["genesis"].arguments}


def test_playground_text_gives_a_model_the_explicit_law() -> None:
    gains = for_target("playground", only="knee")
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><inertial mass="0.2" pos="0 0 -0.1" diaginertia="1e-3 1e-3
        1e-3"/><joint name="FR_knee" axis="0 1 0" damping="3"/></body></worldbody>
        <actuator><position joint="FR_knee" kp="1" kv="2"/></actuator></mujoco>"""
    )
    space = evaluated(export(gains, "playground", per="joint"))
    space["JOINTS"] = {"FR_knee": space["JOINTS"]["FR_knee"] | {"frictionloss": 0.0}}
    space["apply"](model)
    knee = gains.joints["FR_knee"]
    drive = ROBOT.joint("FR_knee").drive
    data = mujoco.MjData(model)
    speed = 0.0
    angle = 0.0
    inertia = 1e-3 + 0.2 * 0.1**2 + drive.armature
    data.ctrl[:] = 0.3
    for _ in range(100):
        torque = (
            np.clip(knee.stiffness.value * (0.3 - angle), -26.435, 26.435)
            - (knee.damping.value + drive.viscous_damping) * speed
        )
        speed += 0.004 * (torque - 0.2 * 9.81 * 0.1 * np.sin(angle)) / inertia
        angle += 0.004 * speed
        mujoco.mj_step(model, data)
        assert data.qpos[0] == pytest.approx(angle, abs=1e-6)


def test_newton_text_is_a_usd_layer_in_radians_and_degrees(tmp_path: Any) -> None:
    gains = matched("go2", "isaaclab-explicit", delay_s=0.01)
    text = export(gains, "newton-usd")
    assert text.startswith("#usda 1.0\n")
    assert text.count("def NewtonActuator") == 12
    assert "rel newton:targets = </Robot/joints/FR_calf_joint>" in text
    assert f"float newton:kp = {gains.groups['hip_roll'].stiffness}" in text
    assert f"float newton:damping = {np.radians(0.1):.7g}" in text
    assert "int newton:delaySteps = 2" in text
    sdf = pytest.importorskip("pxr.Sdf")
    layer = sdf.Layer.CreateAnonymous(".usda")
    assert layer.ImportFromString(text)
    prim = layer.GetPrimAtPath("/Robot/Actuators/FR_calf_joint_actuator")
    assert prim.typeName == "NewtonActuator"


def smooth_arm() -> RobotSpec:
    """The SO-101 with dry friction that does not fall with speed."""
    arm = load_robot("so101")
    joints = []
    for joint in arm.joints:
        joints.append(replace(joint, drive=replace(joint.drive, stribeck_speed=0.0)))
    return replace(arm, joints=tuple(joints))


def motion(
    arm: RobotSpec, drives: dict[str, dict[str, float]], steps: int = 150
) -> tuple[Array, Array]:
    """Commands of all joints, and the positions with which a robot follows, (steps, 6)."""
    start = np.array([joint.default_position for joint in arm.joints])
    time = arm.timestep_s * np.arange(steps)
    command = start + 0.2 * np.sin(2.0 * np.pi * time[:, None] * np.linspace(0.5, 1.0, len(start)))
    log = JointLog(
        robot="so101",
        joints=arm.joint_names,
        time=time,
        command=command,
        position=np.tile(start, (len(time), 1)),
    )
    with ChainSimulation(arm, [log], threads=1) as chain:
        return command, chain.run([drives])[0][0]


def assert_moves(
    model: mujoco.MjModel,
    command: Array,
    expected: Array,
    *,
    steps: int = 1,
    columns: Sequence[int] = range(6),
    within: float = 1e-6,
) -> None:
    """Hold each command for some steps; the positions before it are those expected."""
    data = mujoco.MjData(model)
    data.qpos[:] = expected[0]
    if model.nhistory:
        length = int(model.actuator_history[0, 0])
        past = model.opt.timestep * np.arange(-length, 0)
        for i in range(model.nu):
            mujoco.mj_initCtrlHistory(model, data, i, past, np.full(length, command[0, i]))
    for target, position in zip(command, expected, strict=True):
        assert data.qpos == pytest.approx(position, abs=within)
        data.ctrl[:] = target[columns]
        mujoco.mj_step(model, data, steps)


@pytest.mark.parametrize("name", list(load_profiles()))
def test_the_mjcf_moves_as_the_profile_does(name: str) -> None:
    framework = profile(name)
    arm = smooth_arm()
    # A history of parts of a step is interpolated between the parts.
    delay = 2.0 * framework.timestep_s if framework.iterations > 1 else 0.0123
    gains = matched("so101", name, delay_s=delay)
    model = mujoco.MjModel.from_xml_string(export(gains, "mjcf", arm, per="joint"))
    snippet = export(gains, "mjcf-snippet", arm, per="joint")
    for joint in arm.joint_names:
        assert f'joint="{joint}"' in snippet
    simulated_arm = framework.robot(arm)
    command, expected = motion(simulated_arm, drives_of(simulated_arm, gains))
    assert_moves(model, command, expected, steps=framework.iterations)


@pytest.mark.train
def test_joints_of_mjlab_move_as_its_profile_does() -> None:
    arm = smooth_arm()
    gains = matched("so101", "mjlab-builtin")
    simulated_arm = profile("mjlab-builtin").robot(arm)
    model = entity_model(arm, export(gains, "mjlab-builtin", arm, per="joint"))
    # As mjlab's SimulationCfg sets them.
    model.opt.timestep = simulated_arm.timestep_s
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    columns = [arm.joint_names.index(joint) for joint in driven_joints(model)]
    command, expected = motion(simulated_arm, drives_of(simulated_arm, gains))
    assert_moves(model, command, expected, columns=columns)


def test_friction_that_falls_with_speed_is_in_the_mjcf_and_named_elsewhere() -> None:
    arm = load_robot("so101")
    gains = matched("so101", frictionloss=0.2, stribeck=0.6)
    model = mujoco.MjModel.from_xml_string(export(gains, "mjcf"))
    drives = drives_of(arm, gains)
    for name, group in gains.groups.items():
        drives[name] |= {"stiffness": group.stiffness, "damping": group.damping}
    command, expected = motion(arm, drives, 400)
    assert_moves(model, command, expected, within=1e-5)
    assert "elbow_flex 0.6" in export(gains, "mjlab").replace("\n# ", " ")
    assert "elbow_flex" not in export(matched("so101"), "mjlab").partition("import")[0]
    static = export(gains, "isaaclab-dcmotor")
    assert "friction=0.2,\n        dynamic_friction=0.08," in static


@pytest.mark.parametrize("target", list(TARGETS))
def test_every_export_says_what_it_holds_for(target: str) -> None:
    text = export(for_target(target, only="_knee"), target)
    text = text.replace("\n# ", " ").replace("\n", " ")
    framework = profile(TARGETS[target].profile or "isaaclab-implicit")
    law = f"drive law {framework.drive_law.label}, timestep {framework.timestep_s:g}"
    for words in (framework.name, law, "virtual", "ab" * 32, "NOT MATCHED"):
        assert words in text
    assert ("stability limit" in text) == (framework.law != "implicit")


def test_unmatched_joints_have_the_gains_of_their_group() -> None:
    gains = matched(only="FR_knee")
    (knee,) = exported_actuators(gains, ROBOT)
    assert knee.unmatched == ("FL_knee", "HR_knee", "HL_knee")
    group = gains.groups["knee"]
    for actuator in exported_actuators(gains, ROBOT, "joint"):
        expected = (group.stiffness, group.damping)
        if actuator.name == "FR_knee":
            joint = gains.joints["FR_knee"]
            expected = (joint.stiffness.value, joint.damping.value)
        assert (actuator.stiffness, actuator.damping) == expected


def test_gains_of_another_drive_law_are_refused() -> None:
    for name, target in (("mjlab", "mjlab-builtin"), ("isaaclab-implicit", "isaaclab-dcmotor")):
        with pytest.raises(PronkError, match=r"pronk translate GAINS --to"):
            export(matched(simulator=name), target)
    assert "DCMotorCfg" in export(matched(simulator="mjlab"), "isaaclab-dcmotor")


@pytest.mark.parametrize("name", ["mjlab", "mjlab-builtin", "newton-featherstone"])
def test_stability_share_is_one_where_the_law_diverges(name: str) -> None:
    arm = load_robot("so101")
    joints = []
    for joint in arm.joints:
        unlimited = replace(
            joint.drive,
            frictionloss=0.0,
            stribeck_speed=0.0,
            effort_limit=1e6,
            stall_torque=1e6,
            no_load_speed=1e6,
        )
        joints.append(replace(joint, drive=unlimited))
    robot = replace(profile(name).robot(arm), joints=tuple(joints))
    drives = exported_actuators(matched("so101", name), robot, "joint")

    def scaled(scale: float) -> list[Actuator]:
        actuators = []
        for drive in drives:
            # Only a large stiffness makes the law with implicit damping diverge.
            if name == "mjlab-builtin":
                actuators.append(replace(drive, stiffness=scale * drive.stiffness))
            else:
                actuators.append(replace(drive, damping=scale * drive.damping))
        return actuators

    low = 0.1
    high = 1e3
    while high / low > 1.001:
        scale = np.sqrt(low * high)
        if stability_share(robot, scaled(scale)) > 1:
            high = scale
        else:
            low = scale
    with Chain(robot, "gripper", threads=1) as chain:
        pose = np.array([robot.joint(name).default_position for name in chain.joints])
        values = {name: np.empty((2, len(pose))) for name in GAINS}
        start = []
        for run, share in enumerate((0.97, 1.03)):
            for actuator in scaled(share * low):
                column = chain.joints.index(actuator.name)
                values["stiffness"][run, column] = actuator.stiffness
                values["damping"][run, column] = actuator.damping
            start.append(chain.rest_position(pose, values["stiffness"][run]))
        command = np.broadcast_to(pose, (2, 400, len(pose)))
        moved = chain.rollout(command, values, np.array(start) + 1e-7) - np.array(start)[:, None]
    assert np.abs(moved[0, -1]).max() < 1e-6
    assert not np.abs(moved[1, -1]).max() < 1e-5


def test_unstable_gains_are_refused() -> None:
    gains = matched("go2")
    joints = {}
    for name, joint_gains in gains.joints.items():
        joints[name] = replace(joint_gains, damping=FittedValue(value=25.0))
    groups = group_gains(load_robot("go2"), joints)
    with pytest.raises(PronkError, match="times the limit of drive law E"):
        export(replace(gains, joints=joints, groups=groups), "mjlab")


def test_unknown_target_and_foreign_robot_are_refused() -> None:
    assert get_args(TargetName) == tuple(TARGETS)
    with pytest.raises(PronkError, match="mjcf-snippet"):
        export(matched(), "gazebo")
    with pytest.raises(PronkError, match="so101"):
        exported_actuators(matched(), load_robot("so101"))
    bullet = replace(matched().simulator, profile="", engine="bullet")
    with pytest.raises(PronkError, match="simulator bullet, whose drive law"):
        export(replace(matched(), simulator=bullet), "mjlab")
    with pytest.raises(PronkError, match="--robot PATH"):
        export(replace(matched(), robot="mine"), "mjlab")
