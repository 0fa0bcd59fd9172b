"""`python -m benchmarks transfer`: a policy in training simulators of other drive laws.

Walks and jumps of the evaluation, with the gains that the policy was trained with as they are, and
translated (`pronk translate`). The body, the noise and the timing are those of training with
randomization `noise`: one nominal robot many times.

An implicit law is computed at its own substep. The drive's torque then has the stiffness alone;
the damping is a bias of MuJoCo's actuator, whose derivative implicitfast takes into account.
"""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import mujoco
import numpy as np
import tyro
from mjlab.actuator import DcMotorActuator, DcMotorActuatorCfg
from mjlab.envs import ManagerBasedRlEnv

from benchmarks.runner import machine
from pronk.cli import console
from pronk.identify.match.gains import FittedValue, MatchedGains
from pronk.identify.match.translate import stated_gains, translate
from pronk.identify.simulators.profiles import Profile, profile
from pronk.jump.train.devices import find_devices
from pronk.jump.train.gains import TrainingGains, training_gains
from pronk.jump.train.mdp import actions
from pronk.jump.train.phases import TASKS
from pronk.jump.train.tasks import load_task
from pronk.jump.train.tasks.jump_env_cfg import (
    DELAY_STEPS,
    decimation_spread,
    set_decimation_spread,
)
from pronk.jump.trial.training_sim import adapter
from pronk.jump.trial.training_sim.evaluation import JUMPS, WALKS, Evaluation, EvaluationPlan
from pronk.jump.trial.training_sim.run import evaluate_policy
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from mjlab.entity import Entity

LAWS = ("mjlab-builtin", "isaaclab-implicit", "drake")
_UNLIMITED = 1e6
"""Limit of the part of the torque that stiffness gives [N m]; the actuator limits the sum."""


@dataclass(kw_only=True)
class ImplicitDriveCfg(DcMotorActuatorCfg):  # type: ignore[misc]
    """A drive whose damping MuJoCo integrates implicitly."""

    bias: float
    """Damping that with the substep gives the law [N m s/rad]."""
    limit: float
    """Largest torque of the drive [N m]."""

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> DcMotorActuator:
        """Build the actuator of an entity."""
        return ImplicitDrive(self, entity, target_ids, target_names)


class ImplicitDrive(DcMotorActuator):  # type: ignore[misc]
    """See `ImplicitDriveCfg`."""

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Give the actuators a bias that is linear in the speed."""
        super().edit_spec(spec, target_names)
        for actuator in self._mjs_actuators:
            assert isinstance(self.cfg, ImplicitDriveCfg)
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.biasprm[2] = -self.cfg.bias
            actuator.forcerange[:] = np.array([-self.cfg.limit, self.cfg.limit])


def environment(
    subject: adapter.EvaluatedPolicy,
    gains: TrainingGains,
    plan: EvaluationPlan,
    framework: Profile,
    device: str,
) -> ManagerBasedRlEnv:
    """The evaluation's environment with the drives of a framework."""
    task = load_task(subject.robot)
    robot = framework.robot(task.robot)
    law = framework.drive_law
    parts = law.iterations
    fine = replace(
        robot,
        timestep_s=law.substep(robot.timestep_s),
        decimation=parts * robot.decimation,
        law=DriveLaw(),
    )
    cfg = task.env_cfg(fine, gains, iterations=TASKS["all"], seed=plan.seed)
    adapter.set_task_numbers(cfg, subject)
    # What is drawn in physics steps of training.
    set_decimation_spread(cfg, parts * decimation_spread(cfg))
    cfg = adapter.evaluation_cfg(cfg, plan, "noise")
    action: Any = cfg.actions[actions.NAME]
    middle = action.delay_steps[1] - DELAY_STEPS
    action.delay_steps = (max(0, middle - parts * DELAY_STEPS), middle + parts * DELAY_STEPS)
    articulation: Any = cfg.scene.entities["robot"].articulation
    if law.kind != "explicit":
        drives = [implicit(drive, law, fine.timestep_s) for drive in articulation.actuators]
        articulation.actuators = tuple(drives)
    return ManagerBasedRlEnv(cfg=cfg, device=device)


def implicit(drive: DcMotorActuatorCfg, law: DriveLaw, substep: float) -> ImplicitDriveCfg:
    """A drive of training as one of an implicit law."""
    drive_fields = {field.name: getattr(drive, field.name) for field in fields(drive)}
    drive_fields["damping"] = 0.0
    drive_fields["effort_limit"] = _UNLIMITED
    drive_fields["saturation_effort"] = _UNLIMITED
    return ImplicitDriveCfg(
        **drive_fields,
        bias=law.damping(drive.stiffness, drive.damping, substep),
        limit=drive.effort_limit,
    )


def translated(
    gains: TrainingGains, robot: RobotSpec, trained: Profile, to: Profile
) -> TrainingGains:
    """Training gains of a framework as those of another."""
    pairs = {}
    for joint in robot.joints:
        group = gains.groups[joint.group]
        pairs[joint.name] = (group.stiffness, group.damping)
    stated: MatchedGains = stated_gains(robot, pairs, trained)
    joints = {}
    for joint in robot.joints:
        frictionloss = gains.groups[joint.group].frictionloss
        if np.isnan(frictionloss):
            frictionloss = joint.drive.frictionloss
        joints[joint.name] = replace(
            stated.joints[joint.name],
            delay_s=FittedValue(value=gains.delay_s),
            frictionloss=FittedValue(value=frictionloss),
        )
    stated = replace(stated, joints=joints, groups=gains.groups)
    other_gains, _ = translate(stated, robot, to)
    delay = float(np.mean([joint.delay_s.value for joint in other_gains.joints.values()]))
    return replace(gains, groups=other_gains.groups, delay_s=delay)


def summary(evaluation: Evaluation) -> dict[str, float]:
    """Landings of all jumps, falls and velocity errors of all walks."""
    return {
        "jumped": float(np.mean([jump["found"].mean for jump in evaluation.jumps])),
        "landed": float(np.mean([jump["upright"].mean for jump in evaluation.jumps])),
        "fell": float(np.mean([walk["fell"].mean for walk in evaluation.walks])),
        "speed_error": float(np.mean([walk["speed_error"].mean for walk in evaluation.walks])),
    }


def transfer(
    policy: Path = Path("policies/matched/policy.onnx"),
    gains: Path = Path("policies/gains.yaml"),
    frameworks: Annotated[tuple[str, ...], tyro.conf.arg(name="for")] = LAWS,
    robots: int = 200,
    seed: int = 0,
    device: str = "auto",
) -> console.Outcome:
    """A policy in training simulators of other drive laws.

    Args:
        policy: The policy.
        gains: The gains that it was trained with.
        frameworks: Profiles, as `pronk profiles` lists them.
        robots: Robots for each command.
        seed: Seed of all draws.
        device: auto takes a GPU if there is one.
    """
    torch_device = "cuda:0" if find_devices(device) else "cpu"
    subject = adapter.load_evaluated_policy(policy, torch_device)
    robot = load_task(subject.robot).robot
    trained_profile = profile("mjlab")
    trained_gains = training_gains(gains, robot)
    plan = EvaluationPlan(robot=robot, robots=robots, seed=seed, walks=WALKS, jumps=JUMPS)
    runs = [("mjlab", "its own", trained_profile, trained_gains)]
    for name in frameworks:
        framework = profile(name)
        translated_gains = translated(trained_gains, robot, trained_profile, framework)
        runs.append((name, "as they are", framework, trained_gains))
        runs.append((name, "translated", framework, translated_gains))
    rows: list[dict[str, Any]] = []
    with console.progress() as report:
        for name, gains_kind, framework, run_gains in runs:
            run_progress = report.bar(f"{name} {gains_kind}")
            # mjlab and Warp print to standard output.
            with redirect_stdout(io.StringIO()):
                env = environment(subject, run_gains, plan, framework, torch_device)
                try:
                    evaluation = evaluate_policy(subject.act, env, plan, progress=run_progress)
                finally:
                    env.close()
            first_group = next(iter(run_gains.groups.values()))
            row = {
                "framework": name,
                "law": framework.drive_law.label,
                "gains": gains_kind,
                "stiffness": first_group.stiffness,
                "damping": first_group.damping,
            }
            rows.append({**row, **summary(evaluation)})
    result_table = Table(
        title=f"{policy} with {robots} robots a command, seed {seed}",
        columns=(
            Column(heading="framework"),
            Column(heading="law"),
            Column(heading="gains"),
            Column(heading="hip roll stiffness", unit="N m/rad", digits=2),
            Column(heading="hip roll damping", unit="N m s/rad"),
            Column(heading="jumped", digits=4),
            Column(heading="landed", digits=4),
            Column(heading="fell walking", digits=4),
            Column(heading="speed error", unit="m/s"),
        ),
        rows=tuple(tuple(row.values()) for row in rows),
    )
    console.show(result_table)
    return console.Outcome(figures={"rows": rows, "machine": machine()})
