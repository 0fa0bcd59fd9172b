"""Gains of one framework as gains of another in which the joint responds alike, without a log.

Both responses are closed forms of the robot's own model (`pronk.identify.simulators.linear`).
Stiffness and damping give the magnitude in the band; the phase that is left is a delay. Dry
friction has to be a torque in both frameworks. It goes with the stiffness: where friction stops a
joint, and how it damps a motion of given amplitude, depend on the ratio of both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.match.export import actuators, profile_held, require_stable
from pronk.identify.match.gains import NAN, GroupGains, JointGains, MatchedGains
from pronk.identify.match.measured_joint import DB, Pair, rms
from pronk.identify.simulators.linear import Plant, plant
from pronk.identify.simulators.mujoco import JointTestRig
from pronk.identify.simulators.profiles import Profile
from pronk.robots.robot import RobotSpec

T = TypeVar("T", JointGains, GroupGains)

LOW_HZ = 1.0
"""Lowest frequency compared: below it a joint follows its command in every drive law."""
POINTS = 60
"""Frequencies compared, evenly spaced."""
NOT_ALIKE_DB = 0.5
"""Error above which the joints are not alike: what a match should reach (`NO_MATCH_DB` / 2)."""
NOT_ALIKE = "not alike"
"""Beginning of the flag of a joint that the other framework cannot give."""


@dataclass(frozen=True, kw_only=True)
class JointTranslation:
    """One joint in both frameworks."""

    before: Pair
    """Stiffness [N m/rad] and damping [N m s/rad] in the first framework."""
    after: Pair
    """The same in the other one."""
    before_db: float
    """Magnitude of the other joint over the first with the same gains, root mean square [dB]."""
    after_db: float
    """The same with the translated gains."""
    lead_s: float
    """How much earlier the other joint responds with the translated gains [s]."""
    rest_s: float
    """What is left of it because a delay cannot be negative [s]; below 0."""


def translate(
    gains: MatchedGains, robot: RobotSpec, to: Profile
) -> tuple[MatchedGains, dict[str, JointTranslation]]:
    """Translate gains for another framework, and what changed by joint.

    Raises:
        PronkError: The gains hold for no profile, are of another robot or not stable there, or the
            robot cannot be commanded at the profile's step.
    """
    if gains.robot != robot.name:
        raise PronkError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    begin = profile_held(gains)
    source, target = begin.robot(robot), to.robot(robot)
    dry = begin.friction == to.friction == "N m"
    joints, found = {}, {}
    for name, joint in gains.joints.items():
        first, other = (_plant(one, name, joint) for one in (source, target))
        pair = joint.stiffness, joint.damping
        found[name] = one = translated(first, other, pair, joint.delay_s)
        flags = tuple(flag for flag in joint.flags if not flag.startswith(NOT_ALIKE))
        if one.after_db > NOT_ALIKE_DB:
            flags += (f"{NOT_ALIKE}: {one.after_db:.2f} dB from {begin.name}",)
        friction = joint.frictionloss
        if np.isnan(friction):
            friction = source.joint(name).drive.frictionloss
        scale = one.after[0] / pair[0], one.after[1] / pair[1]
        joints[name] = replace(
            _scaled(joint, *scale),
            stiffness=one.after[0],
            damping=one.after[1],
            grid_stiffness=NAN,
            grid_damping=NAN,
            frictionloss=scale[0] * friction if dry else 0.0,
            stribeck=joint.stribeck if dry else 0.0,
            delay_s=max(joint.delay_s + one.lead_s, 0.0),
            flags=flags,
        )
    info = replace(to.info, decimation=target.decimation)
    groups = {}
    for name, group in gains.groups.items():
        members = [joint.name for joint in robot.group(name) if joint.name in found]
        scales = [np.divide(found[one].after, found[one].before) for one in members]
        friction = float(np.mean([joints[one].frictionloss for one in members]))
        scaled = _scaled(group, *np.mean(scales, axis=0).tolist())
        groups[name] = replace(scaled, frictionloss=friction)
    out = replace(gains, simulator=info, joints=joints, groups=groups)
    require_stable(to, target, actuators(out, target, "joint"))
    return out, found


def translated(first: Plant, other: Plant, gains: Pair, delay_s: float = 0.0) -> JointTranslation:
    """Find the gains with which one plant responds like another, at the same frequencies."""
    goal = first.response(*gains)[0]

    def error(x: Array) -> Array:
        with np.errstate(over="ignore"):
            return np.asarray(DB * np.log(np.abs(other.response(*np.exp(x))[0] / goal)))

    start = np.log(np.maximum(gains, 1e-6))
    best = least_squares(error, start, x_scale=0.1, xtol=1e-10, ftol=1e-12)
    after = float(np.exp(best.x[0])), float(np.exp(best.x[1]))
    phase = np.unwrap(np.angle(other.response(*after)[0] / goal))
    lead = float(phase @ first.omega / (first.omega @ first.omega))
    return JointTranslation(
        before=gains,
        after=after,
        before_db=rms(error(start)),
        after_db=rms(best.fun),
        lead_s=lead,
        rest_s=min(delay_s + lead, 0.0),
    )


def stated_gains(robot: RobotSpec, by_joint: Mapping[str, Pair], begin: Profile) -> MatchedGains:
    """Gains of a framework that no log was matched with, by joint; they are taken for exact."""
    known = begin.robot(robot)
    joints = {
        name: JointGains(
            stiffness=kp,
            damping=kd,
            armature=robot.joint(name).drive.armature,
            band_hz=robot.joint(name).band_hz,
        )
        for name, (kp, kd) in by_joint.items()
    }
    groups = {}
    for group in robot.groups:
        if pairs := [by_joint[one.name] for one in robot.group(group) if one.name in by_joint]:
            stiffness, damping = np.mean(pairs, axis=0).tolist()
            spread = (np.ptp(pairs, axis=0) / 2.0).tolist()
            groups[group] = GroupGains(
                stiffness=stiffness,
                damping=damping,
                stiffness_range=spread[0],
                damping_range=spread[1],
            )
    info = replace(begin.info, decimation=known.decimation)
    return MatchedGains(robot=robot.name, simulator=info, joints=joints, groups=groups)


def _plant(robot: RobotSpec, name: str, gains: JointGains) -> Plant:
    """Linearize a joint about the default pose, with its matched armature."""
    first = robot.joint(robot.joint(name).original[0])
    drive = replace(
        first.drive, rotor_inertia=gains.armature / first.drive.gear_ratio**2, frictionloss=0.0
    )
    changed = {first.name: replace(first, drive=drive)}
    own = replace(robot, joints=tuple(changed.get(one.name, one) for one in robot.joints))
    low, high = gains.band_hz if np.isfinite(gains.band_hz).all() else first.band_hz
    hz = np.linspace(max(low, min(LOW_HZ, 0.5 * high)), high, POINTS)
    pose = np.array([robot.joint(joint).default_position for joint in first.chain])
    with JointTestRig(own, first.name, threads=1) as rig:
        order = [first.chain.index(joint) for joint in rig.joints]
        return plant(rig, pose[order], 2.0 * np.pi * hz)


def _scaled(gains: T, kp: float, kd: float) -> T:
    """Gains of a joint or a group with the fields of stiffness and damping times two factors."""
    out: dict[str, Any] = {}
    for name, value in vars(gains).items():
        if name.startswith(("stiffness", "damping")):
            factor = kp if name.startswith("stiffness") else kd
            scaled = (factor * np.array(value)).tolist()
            out[name] = tuple(scaled) if isinstance(value, tuple) else scaled
        elif name in ("covariance", "ellipsoid"):
            (kk, kv), (vk, vv) = value
            out[name] = (kp * kp * kk, kp * kd * kv), (kp * kd * vk, kd * kd * vv)
        elif name == "ellipsoid_center":
            out[name] = kp * value[0], kd * value[1]
    return replace(gains, **out)
