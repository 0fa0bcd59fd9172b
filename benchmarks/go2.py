"""`python -m benchmarks go2`: two policies that ran on real Go2s, on drives of several curves.

The policies of shared/data/go2_policies run in plain MuJoCo, on pronk's model with its default
contacts, for each torque-speed curve of the calf, and on the virtual Go2 for several commands.
Heading is not held: velocities are those in the frame of the heading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.runner import finish
from pronk.arrays import Array
from pronk.cli import console
from pronk.errors import PronkError
from pronk.jump.trial.foreign_check import ACCELERATION, STAND_S, run_on_virtual_robot
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.deploy_yaml import read_deploy_yaml
from pronk.policy.foreign import ForeignPolicy, load_foreign_network
from pronk.policy.observation import Measurement
from pronk.policy.rollout import projected_gravity
from pronk.policy.script import Velocity
from pronk.robots import load_robot
from pronk.robots.motor import torque_limits
from pronk.robots.robot import RobotSpec
from pronk.tables import Column, Table

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "go2_policies"
FAST = "go2_moe_cts_fast_flat_v4_fz_54k"
OTHER = "kaiwu2025_v6-2_124004"
TIMESTEP_S = 0.002
LARGE = 1e5
RUN_S = 9.0
"""Length of a run in plain MuJoCo, with a second of standing [s]."""
COMMANDS: Mapping[str, Velocity] = {
    "stand": (0.0, 0.0, 0.0),
    "forward 1": (1.0, 0.0, 0.0),
    "back 1": (-1.0, 0.0, 0.0),
    "left 0.5": (0.0, 0.5, 0.0),
    "turn 1.5": (0.0, 0.0, 1.5),
}


@dataclass(frozen=True, kw_only=True)
class CalfCurve:
    """Torque over speed of a calf, and its armature."""

    name: str
    effort_limit: float
    """[N m]"""
    stall_torque: float
    """Where the line meets standstill [N m]."""
    no_load_speed: float
    """[rad/s]"""
    armature: float
    """[kg m^2]"""


CURVES = (
    CalfCurve(
        name="Go1's, a line",
        effort_limit=35.55,
        stall_torque=35.55,
        no_load_speed=20.07,
        armature=0.0225,
    ),
    CalfCurve(
        name="a line",
        effort_limit=45.43,
        stall_torque=45.43,
        no_load_speed=15.70,
        armature=0.0367,
    ),
    CalfCurve(
        name="with a corner",
        effort_limit=45.43,
        stall_torque=70.2,
        no_load_speed=15.70,
        armature=0.0367,
    ),
    CalfCurve(
        name="no limit of speed",
        effort_limit=45.43,
        stall_torque=LARGE,
        no_load_speed=LARGE,
        armature=0.0367,
    ),
)


def go2(seeds: int = 5) -> console.Outcome:
    """Run the two policies on several curves in plain MuJoCo, and on the virtual Go2.

    Args:
        seeds: Runs of each policy with each curve; two fifths as many with each command on the
            virtual Go2, at least one.
    """
    if not FOLDER.exists():
        raise PronkError(f"{FOLDER}: no such folder; this benchmark needs the two policies.")
    robot = load_robot("go2")
    policies = {}
    for name in (FAST, OTHER):
        deploy = read_deploy_yaml(FOLDER / name / "deploy.yaml")
        network = load_foreign_network(FOLDER / name / "policy.onnx", deploy)
        policies[name] = ForeignPolicy(network, deploy)
    plain_rows = []
    for curve in CURVES:
        for name, forward in ((FAST, 4.5), (OTHER, 3.0)):
            plain_rows.append(_plain_row(robot, curve, name, policies[name], forward, seeds))
    virtual_rows = []
    for name, policy in policies.items():
        commands = dict(COMMANDS)
        if name == FAST:
            commands["forward 4"] = (4.0, 0.0, 0.0)
        for label, command in commands.items():
            for seed in range(max(1, (2 * seeds) // 5)):
                run = run_on_virtual_robot(
                    robot, load_sim_params(None, robot), policy, command, seconds=10.0, seed=seed
                )
                virtual_rows.append((name, label, str(seed), run.fell_s, *run.velocity))
    figures = {"plain": plain_rows, "virtual": virtual_rows, "seeds": seeds}
    return finish(figures, _plain_table(plain_rows), _virtual_table(virtual_rows))


def _plain_row(
    robot: RobotSpec,
    curve: CalfCurve,
    name: str,
    policy: ForeignPolicy,
    forward: float,
    seeds: int,
) -> tuple[Any, ...]:
    """Run one policy on one curve; return falls, mean speed and the fastest calf."""
    model = _model(robot, curve)
    falls = 0
    speeds = []
    fastest_calf = 0.0
    for seed in range(seeds):
        speed, calf = _plain_run(model, robot, curve, policy, forward, seed)
        fastest_calf = max(fastest_calf, calf)
        if np.isnan(speed):
            falls += 1
        else:
            speeds.append(speed)
    mean_speed = float(np.mean(speeds)) if speeds else float("nan")
    return curve.name, name, forward, falls, mean_speed, fastest_calf


def _model(robot: RobotSpec, curve: CalfCurve) -> Any:
    """Compile the robot on a floor, with a calf of the curve."""
    spec = robot.build_spec()
    for key in list(spec.keys):
        spec.delete(key)
    spec.option.timestep = TIMESTEP_S
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 1.0))
    floor.contype = 1
    floor.conaffinity = 1
    for joint in robot.joints:
        hinge = spec.joint(joint.name)
        is_calf = joint.group == "knee"
        hinge.armature = curve.armature if is_calf else joint.drive.armature
        hinge.frictionloss = joint.drive.frictionloss
        hinge.damping = [joint.drive.viscous_damping, 0.0, 0.0]
    return spec.compile()


def _plain_run(
    model: Any,
    robot: RobotSpec,
    curve: CalfCurve,
    policy: ForeignPolicy,
    forward: float,
    seed: int,
) -> tuple[float, float]:
    """Return the mean speed of a run, NaN if it fell, and the fastest calf [rad/s]."""
    data = mujoco.MjData(model)
    positions = [model.joint(name).qposadr[0] for name in robot.joint_names]
    speeds = [model.joint(name).dofadr[0] for name in robot.joint_names]
    calves = np.array([joint.group == "knee" for joint in robot.joints])
    start = policy.start_position + np.random.default_rng(seed).normal(0.0, 0.03, len(positions))
    data.qpos[positions] = start
    data.qpos[2] = 0.33
    limits = []
    for joint in robot.joints:
        drive = joint.drive
        limit = (drive.stall_torque, drive.no_load_speed, drive.effort_limit)
        if joint.group == "knee":
            limit = (curve.stall_torque, curve.no_load_speed, curve.effort_limit)
        elif curve.no_load_speed == LARGE:
            limit = (LARGE, LARGE, drive.effort_limit)
        elif curve.stall_torque == curve.effort_limit:
            limit = (drive.effort_limit, drive.no_load_speed, drive.effort_limit)
        limits.append(limit)
    stall, no_load, effort = np.array(limits).T
    policy.reset()
    along = []
    fastest = 0.0
    for tick in range(round(RUN_S / policy.deploy.step_s)):
        time = tick * policy.deploy.step_s
        command = min(forward, max(0.0, ACCELERATION * (time - STAND_S)))
        target = policy.step(_measured(data, positions, speeds), (command, 0.0, 0.0))
        for _ in range(round(policy.deploy.step_s / TIMESTEP_S)):
            speed = data.qvel[speeds]
            torque = policy.stiffness * (target - data.qpos[positions]) - policy.damping * speed
            low, high = torque_limits(speed, stall, no_load, effort)
            data.qfrc_applied[speeds] = np.clip(torque, low, high)
            mujoco.mj_step(model, data)
            fastest = max(fastest, float(np.abs(speed[calves]).max()))
        w, x, y, z = data.qpos[3:7]
        if 1.0 - 2.0 * (x * x + y * y) < 0.34 or data.qpos[2] < 0.08:
            return float("nan"), fastest
        if time > 0.5 * RUN_S:
            yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            along.append(np.cos(yaw) * data.qvel[0] + np.sin(yaw) * data.qvel[1])
    return float(np.mean(along)), fastest


def _measured(data: Any, positions: list[int], speeds: list[int]) -> Measurement:
    """Return what the sensors of a robot without errors measure."""
    orientation: Array = np.array(data.qpos[3:7])
    return Measurement(
        angular_velocity=data.qvel[3:6].copy(),
        projected_gravity=projected_gravity(orientation),
        position=data.qpos[positions],
        velocity=data.qvel[speeds],
    )


def _plain_table(rows: list[tuple[Any, ...]]) -> Table:
    """Make the table of plain MuJoCo."""
    columns = (
        Column(heading="calf"),
        Column(heading="policy"),
        Column(heading="commanded", unit="m/s", digits=1),
        Column(heading="falls", digits=0),
        Column(heading="speed", unit="m/s", digits=2),
        Column(heading="fastest calf", unit="rad/s", digits=1),
    )
    return Table(title="plain MuJoCo", columns=columns, rows=tuple(rows))


def _virtual_table(rows: list[tuple[Any, ...]]) -> Table:
    """Make the table of the virtual Go2."""
    columns = (
        Column(heading="policy"),
        Column(heading="command"),
        Column(heading="seed"),
        Column(heading="fell", unit="s", digits=1),
        Column(heading="forward", unit="m/s", digits=2),
        Column(heading="left", unit="m/s", digits=2),
        Column(heading="yaw rate", unit="rad/s", digits=2),
    )
    return Table(title="virtual Go2", columns=columns, rows=tuple(rows))
