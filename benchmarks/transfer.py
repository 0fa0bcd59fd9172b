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
from dataclasses import dataclass, replace
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
from pronk.jump.train.tasks.jump_env_cfg import DELAY_STEPS
from pronk.jump.trial.tables import table
from pronk.jump.trial.training_sim import adapter
from pronk.jump.trial.training_sim.evaluation import JUMPS, WALKS, Evaluation, Plan
from pronk.jump.trial.training_sim.run import evaluate_policy
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

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
    subject: adapter.Subject, gains: TrainingGains, plan: Plan, framework: Profile, device: str
) -> ManagerBasedRlEnv:
    """The evaluation's environment with the drives of a framework."""
    task = load_task(subject.robot)
    robot, law = framework.robot(task.robot), framework.drive_law
    parts = law.iterations
    fine = replace(
        robot,
        timestep_s=law.substep(robot.timestep_s),
        decimation=parts * robot.decimation,
        law=DriveLaw(),
    )
    cfg = task.env_cfg(fine, gains, iterations=TASKS["all"], seed=plan.seed)
    cfg = adapter.evaluation_cfg(cfg, plan, "noise")
    # What is drawn in physics steps of training.
    cfg.events["decimation"].params["added"] = (-2 * parts, 2 * parts)
    action: Any = cfg.actions[actions.NAME]
    middle = action.delay_steps[1] - DELAY_STEPS
    action.delay_steps = (max(0, middle - parts * DELAY_STEPS), middle + parts * DELAY_STEPS)
    articulation: Any = cfg.scene.entities["robot"].articulation
    if law.kind != "explicit":
        articulation.actuators = tuple(
            implicit(drive, law, fine.timestep_s) for drive in articulation.actuators
        )
    return ManagerBasedRlEnv(cfg=cfg, device=device)


def implicit(drive: DcMotorActuatorCfg, law: DriveLaw, substep: float) -> ImplicitDriveCfg:
    """A drive of training as one of an implicit law."""
    own = {name: getattr(drive, name) for name in drive.__dataclass_fields__}
    own |= {"damping": 0.0, "effort_limit": _UNLIMITED, "saturation_effort": _UNLIMITED}
    bias = law.damping(drive.stiffness, drive.damping, substep)
    return ImplicitDriveCfg(**own, bias=bias, limit=drive.effort_limit)


def translated(
    gains: TrainingGains, robot: RobotSpec, trained: Profile, to: Profile
) -> TrainingGains:
    """Training gains of a framework as those of another."""
    by_joint = {
        joint.name: (gains.groups[joint.group].stiffness, gains.groups[joint.group].damping)
        for joint in robot.joints
    }
    stated: MatchedGains = stated_gains(robot, by_joint, trained)
    joints = {}
    for name, one in stated.joints.items():
        dry, drive = gains.groups[robot.joint(name).group].frictionloss, robot.joint(name).drive
        dry = drive.frictionloss if np.isnan(dry) else dry
        joints[name] = replace(
            one,
            delay_s=FittedValue(value=gains.delay_s),
            frictionloss=FittedValue(value=dry),
        )
    stated = replace(stated, joints=joints, groups=gains.groups)
    found, _ = translate(stated, robot, to)
    delay = float(np.mean([joint.delay_s.value for joint in found.joints.values()]))
    return replace(gains, groups=found.groups, delay_s=delay)


def summary(found: Evaluation) -> dict[str, float]:
    """Landings of all jumps, falls and velocity errors of all walks."""
    walks, jumps = found.walks, found.jumps
    return {
        "jumped": float(np.mean([one["found"].mean for one in jumps])),
        "landed": float(np.mean([one["upright"].mean for one in jumps])),
        "fell": float(np.mean([one["fell"].mean for one in walks])),
        "speed_error": float(np.mean([one["speed_error"].mean for one in walks])),
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
        gains: Those it was trained with.
        frameworks: Profiles, as `pronk profiles` lists them.
        robots: Robots for each command.
        seed: Of all draws.
        device: auto: a GPU if there is one.
    """
    where = "cuda:0" if find_devices(device) else "cpu"
    subject = adapter.load_subject(policy, where)
    robot, trained = load_task(subject.robot).robot, profile("mjlab")
    own = training_gains(gains, robot)
    plan = Plan(robot=robot, robots=robots, seed=seed, walks=WALKS, jumps=JUMPS)
    runs = [("mjlab", "its own", trained, own)]
    for name in frameworks:
        other = profile(name)
        runs += [
            (name, "as they are", other, own),
            (name, "translated", other, translated(own, robot, trained, other)),
        ]
    rows: list[dict[str, Any]] = []
    with console.progress() as report:
        for name, which, framework, drives in runs:
            done = report.bar(f"{name} {which}")
            with redirect_stdout(io.StringIO()):
                env = environment(subject, drives, plan, framework, where)
                try:
                    found = evaluate_policy(
                        subject.act,
                        env,
                        plan,
                        progress=done,
                    )
                finally:
                    env.close()
            first = next(iter(drives.groups.values()))
            rows.append(
                {"framework": name, "law": framework.drive_law.label, "gains": which}
                | {"stiffness": first.stiffness, "damping": first.damping}
                | summary(found)
            )
    columns = "framework | law | gains | hip roll stiffness;2 | damping | jumped | landed;4"
    sheet = table(
        f"{columns} | fell walking;4 | speed error [m/s]",
        [list(row.values()) for row in rows],
        title=f"{policy} with {robots} robots a command, seed {seed}",
    )
    console.show_sheet(sheet)
    return console.Outcome(figures={"rows": rows, "machine": machine()})
