"""Try a policy that was trained elsewhere on the virtual robot; look for the change it needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pronk.arrays import Array
from pronk.errors import ArtefactError, HardwareError
from pronk.jump.trial.jumps import fallen_at
from pronk.jump.virtual.capture import Capture
from pronk.jump.virtual.ground import Start
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams
from pronk.policy.deploy_yaml import COMMAND_TERMS, DeployFile, Term
from pronk.policy.foreign import ForeignPolicy, poses_out_of_range, run_foreign
from pronk.policy.script import Velocity
from pronk.robots.legged import legged
from pronk.robots.robot import RobotSpec

STAND_S = 1.0
"""Time at which a run's command begins, after standing [s]."""
ACCELERATION = 2.0
"""Rate at which the command rises, as a person moves a joystick [m/s^2, rad/s^2]."""
RESTS_S = 0.5
"""Time with more than feet on the ground, or leaning, without a break after which a robot has
fallen [s]: one that lies on its thighs is neither low nor on its side."""
LEANS_COSINE = math.cos(math.radians(20.0))
"""Cosine of the tilt beyond which a robot leans [1]: a Go2 on three feet, its fourth leg folded,
leans by 26 degrees, one that runs 4 m/s by 14 at most."""
CAPTURE_RATE_HZ = 200.0
USUAL_SCALES: dict[str, tuple[tuple[float, ...], ...]] = {
    "base_ang_vel": ((1.0,), (0.25,), (0.2,)),
    "velocity_commands": ((1.0,), (2.0, 2.0, 0.25)),
    "joint_vel": ((1.0,), (0.05,)),
    "joint_vel_rel": ((1.0,), (0.05,)),
    "joint_pos": ((1.0,),),
    "joint_pos_rel": ((1.0,),),
    "projected_gravity": ((1.0,),),
    "last_action": ((1.0,),),
}
"""Scales of observations in legged_gym, unitree_rl_gym and Isaac Lab; one number is for all."""
USUAL_ACTION_SCALES = (0.25, 0.5, 1.0)


@dataclass(frozen=True, kw_only=True)
class ForeignRun:
    """What a policy did on the virtual robot."""

    fell_s: float | None
    """Time of the fall since the policy took over [s], or of half a second on other parts than the
    feet or leaning; None without either."""
    lasted_s: float
    """Time until the fall or the end [s]."""
    velocity: tuple[float, float, float]
    """Mean forward and left velocity in the heading's frame [m/s] and yaw rate [rad/s] over the
    second half of the run, or NaN where it fell before."""
    foot_depth: float
    """Greatest depth to which a foot was pressed into the floor [m], NaN where it is not known."""


@dataclass(frozen=True, kw_only=True)
class DeployChange:
    """One change of a `deploy.yaml`."""

    text: str
    """What is changed, for a person."""
    deploy: DeployFile
    """The file with the change."""


@dataclass(frozen=True, kw_only=True)
class TriedChange:
    """A change, and what the policy did with it."""

    text: str
    """What is changed, for a person."""
    run: ForeignRun
    """What the policy did."""


def run_on_virtual_robot(
    robot: RobotSpec,
    sim_params: SimParams,
    policy: ForeignPolicy,
    command: Velocity,
    *,
    seconds: float,
    seed: int = 0,
) -> ForeignRun:
    """Let a policy stand, then walk with one command.

    Args:
        robot: The robot.
        sim_params: Parameters of the virtual robot.
        policy: The policy.
        command: Forward and left [m/s], yaw rate [rad/s], to which the command rises.
        seconds: How long the policy runs [s].
        seed: Seed of all noise.
    """
    positions = []
    for joint, position in zip(robot.joints, policy.start_position, strict=True):
        low, high = joint.range
        positions.append(min(max(position, low), high) - joint.default_position)
    machine = VirtualRobot(
        robot,
        sim_params,
        seed=seed,
        base="ground",
        start=Start(joint_offset=tuple(positions)),
        capture_rate_hz=CAPTURE_RATE_HZ,
    )
    machine.connect()
    largest = max(abs(value) for value in command)

    def commanded(time: float) -> Array:
        if largest == 0.0:
            return np.zeros(3)
        share = min(1.0, max(0.0, ACCELERATION * (time - STAND_S) / largest))
        return share * np.array(command)

    stood_at = machine.now()

    def is_upright() -> bool:
        nonlocal stood_at
        snapshot = machine.snapshot()
        _, x, y, _ = snapshot.orientation[-1]
        leans = 1.0 - 2.0 * (x * x + y * y) < LEANS_COSINE
        if not (leans or snapshot.other_contact.any()):
            stood_at = machine.now()
        return fallen_at(snapshot) > 0 and machine.now() - stood_at <= RESTS_S

    try:
        lasted_s = run_foreign(machine, policy, commanded, seconds=seconds, running=is_upright)
    except HardwareError:  # The numbers ran away.
        return _lost_run(machine.now())
    fell_s = None if lasted_s >= seconds - 1e-9 and is_upright() else lasted_s
    capture = machine.capture()
    machine.close()
    return ForeignRun(
        fell_s=fell_s,
        lasted_s=lasted_s,
        velocity=_mean_velocity(capture, 0.5 * seconds),
        foot_depth=_foot_depth(capture, robot, sim_params.ground.floor),
    )


def _lost_run(fell_s: float) -> ForeignRun:
    """Return a run that ended without numbers."""
    return ForeignRun(fell_s=fell_s, lasted_s=fell_s, velocity=(math.nan,) * 3, foot_depth=math.nan)


def _foot_depth(capture: Capture, robot: RobotSpec, floor: float) -> float:
    """Return how deep a foot was pressed into the floor at most, 0 without contact [m]."""
    depth = floor + legged(robot.source).foot_radius - capture.foot_position[:, :, 2]
    return float(depth.max(initial=0.0))


def _mean_velocity(capture: Capture, begin_s: float) -> tuple[float, float, float]:
    """Return the mean velocity of a trunk from a time on, in the frame of its heading."""
    late = capture.time > begin_s
    if not late.any():
        return math.nan, math.nan, math.nan
    w, x, y, z = capture.orientation[late].T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    along_x, along_y, _ = capture.velocity[late].T
    forward = np.cos(yaw) * along_x + np.sin(yaw) * along_y
    left = np.cos(yaw) * along_y - np.sin(yaw) * along_x
    yaw_rate = capture.angular_velocity[late][:, 2]
    return float(forward.mean()), float(left.mean()), float(yaw_rate.mean())


def try_changes(
    changes: Sequence[DeployChange],
    run: Callable[[DeployFile], ForeignRun],
) -> tuple[TriedChange, ...]:
    """Run a policy with each of some changes.

    Args:
        changes: The changes.
        run: Runs the policy by a changed file.
    """
    tried = []
    for change in changes:
        try:
            tried.append(TriedChange(text=change.text, run=run(change.deploy)))
        except ArtefactError:  # An action that is not finite: no remedy.
            tried.append(TriedChange(text=change.text, run=_lost_run(0.0)))
    return tuple(tried)


def remedies(tried: Sequence[TriedChange], command: Velocity) -> tuple[TriedChange, ...]:
    """Return the changes with which the policy did not fall, the nearest to the command first."""
    upright = [change for change in tried if change.run.fell_s is None]

    def error(change: TriedChange) -> float:
        return math.dist(change.run.velocity, command)

    return tuple(sorted(upright, key=error))


def single_changes(deploy: DeployFile, robot: RobotSpec) -> tuple[DeployChange, ...]:
    """List the changes that people most often need: each is one, and none is in the file."""
    changes = [
        DeployChange(text="gravity with the other sign", deploy=replace(deploy, gravity_sign=-1.0))
    ]
    for text, joint_ids in _orders(robot):
        reordered = replace(deploy, joint_ids=joint_ids)
        # A robot may lie still in a pose that its joints cannot have: no remedy.
        if joint_ids != deploy.joint_ids and not poses_out_of_range(reordered, robot):
            changes.append(DeployChange(text=f"joint_ids_map {text}", deploy=reordered))
    inverse = tuple(int(place) for place in np.argsort(deploy.joint_ids))
    known_orders = [deploy.joint_ids, *(joint_ids for _, joint_ids in _orders(robot))]
    inverted = replace(deploy, joint_ids=inverse)
    if inverse not in known_orders and not poses_out_of_range(inverted, robot):
        changes.append(DeployChange(text="joint_ids_map inverted", deploy=inverted))
    lengths = {term.history_length for term in deploy.terms}
    if max(lengths) > 1:
        order = "oldest" if deploy.newest_first else "newest"
        reversed_deploy = replace(deploy, newest_first=not deploy.newest_first)
        changes.append(
            DeployChange(text=f"history with the {order} sample first", deploy=reversed_deploy)
        )
        if len(lengths) == 1:
            layout = "term after term" if deploy.by_sample else "sample after sample"
            other_layout = replace(deploy, by_sample=not deploy.by_sample)
            changes.append(
                DeployChange(text=f"history {layout} (use_gym_history)", deploy=other_layout)
            )
    changes += _gain_changes(deploy, robot)
    changes += _scale_changes(deploy)
    if deploy.action_offset != deploy.default_position:
        changes.append(
            DeployChange(
                text="actions.offset as default_joint_pos",
                deploy=replace(deploy, action_offset=deploy.default_position),
            )
        )
    return tuple(changes)


def _orders(robot: RobotSpec) -> list[tuple[str, tuple[int, ...]]]:
    """Return the usual orders of the joints of a robot with legs, as places in its messages."""
    count = len(robot.joints)
    orders = [("in the order of the messages", tuple(range(count)))]
    legs = robot.legs
    if len(legs) != 4 or count % len(legs):
        return orders
    pairs_swapped = (legs[1], legs[0], legs[3], legs[2])
    rear_first = (legs[2], legs[3], legs[0], legs[1])
    for leg_order in (pairs_swapped, legs, rear_first):
        by_leg = []
        for leg in leg_order:
            members = []
            for index, name in enumerate(robot.joint_names):
                if name.startswith(f"{leg}_"):
                    members.append(index)
            by_leg.append(members)
        names = ", ".join(leg_order)
        leg_after_leg = tuple(index for members in by_leg for index in members)
        if len(leg_after_leg) != count:
            return orders
        if leg_order != legs:
            orders.append((f"of legs {names}", leg_after_leg))
        # Isaac Lab numbers the joints breadth first: all hips, all thighs, all calves.
        joint_after_joint = tuple(int(place) for place in np.array(by_leg).T.ravel())
        orders.append((f"joint after joint of {names}, as Isaac Lab's", joint_after_joint))
    return orders


def _gain_changes(deploy: DeployFile, robot: RobotSpec) -> list[DeployChange]:
    """Return the changes of the gains of the drives."""
    changes = []
    stiffness = tuple(joint.stiffness for joint in robot.joints)
    damping = tuple(joint.damping for joint in robot.joints)
    if (stiffness, damping) != (deploy.stiffness, deploy.damping):
        changes.append(
            DeployChange(
                text=f"gains of {robot.name}'s file",
                deploy=replace(deploy, stiffness=stiffness, damping=damping),
            )
        )
    places = np.argsort(deploy.joint_ids)
    moved_stiffness = tuple(float(value) for value in np.array(deploy.stiffness)[places])
    moved_damping = tuple(float(value) for value in np.array(deploy.damping)[places])
    if (moved_stiffness, moved_damping) != (deploy.stiffness, deploy.damping):
        changes.append(
            DeployChange(
                text="stiffness and damping in the order of the network",
                deploy=replace(deploy, stiffness=moved_stiffness, damping=moved_damping),
            )
        )
    return changes


def _scale_changes(deploy: DeployFile) -> list[DeployChange]:
    """Return the changes of one scale to another usual one."""
    changes = []
    for index, term in enumerate(deploy.terms):
        usual = "velocity_commands" if term.name in COMMAND_TERMS else term.name
        for scale in USUAL_SCALES[usual]:
            width = len(term.scale)
            full_scale = scale * width if len(scale) == 1 else scale
            if full_scale == term.scale:
                continue
            changed_term = replace(term, scale=full_scale)
            text = f"scale of {term.name} {_short(full_scale)} in place of {_short(term.scale)}"
            terms: tuple[Term, ...] = (
                *deploy.terms[:index],
                changed_term,
                *deploy.terms[index + 1 :],
            )
            changes.append(DeployChange(text=text, deploy=replace(deploy, terms=terms)))
    for action_scale in USUAL_ACTION_SCALES:
        full_scale = (action_scale,) * len(deploy.action_scale)
        if full_scale != deploy.action_scale:
            text = f"scale of the action {action_scale:g} in place of {_short(deploy.action_scale)}"
            changes.append(DeployChange(text=text, deploy=replace(deploy, action_scale=full_scale)))
    return changes


def _short(values: Sequence[float]) -> str:
    """Return one number where all are equal."""
    if len(set(values)) == 1:
        return f"{values[0]:g}"
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"
