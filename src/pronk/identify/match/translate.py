"""Translation of gains from one framework to another in which the joint responds alike.

No log is needed: both responses are closed forms of the robot's own model
(`pronk.identify.simulators.linear`). Stiffness and damping give the magnitude in the band; the
phase that remains is a delay. Dry friction has to be a torque in both frameworks. It goes with the
stiffness: where friction stops a joint, and how it damps a motion of given amplitude, depend on the
ratio of both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.match.export.actuators import exported_actuators, profile_held
from pronk.identify.match.gains import (
    ZERO,
    FittedValue,
    GroupGains,
    Interval,
    JointGains,
    MatchedGains,
    require_matched,
)
from pronk.identify.match.match import file_of_robot
from pronk.identify.match.measured import DB, rms
from pronk.identify.match.nominal_gains import Pair
from pronk.identify.simulators.linear import LinearJoint, linearize
from pronk.identify.simulators.mujoco import JointTestRig
from pronk.identify.simulators.profiles import Profile
from pronk.identify.simulators.stability import require_stable
from pronk.robots.robot import RobotSpec

LOW_HZ = 1.0
"""Lowest frequency compared [Hz]: below it a joint follows its command in every drive law."""
DELAY_SCALE_S = 0.01
"""Unit of the delay in the search with phase [s]."""
SEEN_DB = 0.02
"""Difference of magnitudes that a good match leaves between drive laws [dB], root mean square."""
UNSEEN_SHARE_MAX = 0.02
"""`JointTranslation.unseen_share` above which the joint is flagged."""
MOST_CHANGE = 100.0
"""Largest factor between translated gains and those before; drive laws that are stable differ by
less, and where a joint follows every command the response tells no gains apart."""
LEAST_DAMPING_S = 1e-6
"""Least damping in the search, over the stiffness [s]: no joint responds otherwise at 0."""
POINTS = 60
"""Frequencies compared, evenly spaced."""
NOT_ALIKE_DB = 0.5
"""Error above which the joints are not alike [dB]: what a match of a good log stays below."""
NOT_ALIKE = "not alike"
"""Beginning of the flag of a joint that the other framework cannot give."""
CRITERIA_SPREAD_MAX = 0.01
"""Relative difference of gains by magnitude alone and by magnitude and phase from which on the
joint is flagged: a match, which weighs phase and frequencies by its log, ends between them."""
NOT_UNIQUE = "gains depend on what is compared"
"""Beginning of the flag of a joint whose gains differ by more than `CRITERIA_SPREAD_MAX`."""


@dataclass(frozen=True, kw_only=True)
class JointTranslation:
    """Gains of one joint in both frameworks, and how alike the responses are."""

    before: Pair
    """Stiffness [N m/rad] and damping [N m s/rad] in the first framework."""
    after: Pair
    """Stiffness [N m/rad] and damping [N m s/rad] in the other framework."""
    before_db: float
    """Magnitude of the other joint over the first with the same gains, root mean square [dB]."""
    after_db: float
    """Magnitude of the other joint over the first with the translated gains, root mean square
    [dB]."""
    lead_s: float
    """Time by which the other joint responds earlier with the translated gains [s]."""
    rest_s: float
    """Part of the lead that remains because a delay cannot be negative [s]; 0 or less."""
    with_phase: Pair
    """Stiffness and damping with which magnitude and phase together are most alike, whatever the
    delay. Laws that can be alike give the same gains as `after`."""
    unseen_share: float = 0.0
    """Relative change of the gains, in the direction seen least, that changes the magnitude by
    `SEEN_DB`."""
    at_bound: bool = False
    """Whether a gain ran to `MOST_CHANGE` times what it was."""
    stuck: Pair | None = None
    """Gains where dry friction holds the other joints of the chain; None if they have none."""

    @property
    def scales(self) -> Pair:
        """Translated stiffness and damping over those before; 1 for a damping that was 0."""
        damping_scale = self.after[1] / self.before[1] if self.before[1] else 1.0
        return self.after[0] / self.before[0], damping_scale

    @property
    def criteria_spread(self) -> float:
        """Largest relative difference between `after` and `with_phase`."""
        stiffness_spread = abs(self.with_phase[0] / self.after[0] - 1.0)
        damping_difference = abs(self.with_phase[1] - self.after[1])
        return max(stiffness_spread, damping_difference / max(self.after[1], 1e-300))

    @property
    def stuck_spread(self) -> float:
        """Largest relative difference between `after` and `stuck`."""
        if self.stuck is None:
            return 0.0
        stiffness_spread = abs(self.stuck[0] / self.after[0] - 1.0)
        damping_difference = abs(self.stuck[1] - self.after[1])
        return max(stiffness_spread, damping_difference / max(self.after[1], 1e-300))


def translate(
    gains: MatchedGains, robot: RobotSpec, to: Profile, *, allow_unmatched: bool = False
) -> tuple[MatchedGains, dict[str, JointTranslation]]:
    """Translate gains for another framework.

    Args:
        gains: Matched gains, which hold for a framework with a profile.
        robot: The robot that they were matched for.
        to: Profile of the other framework.
        allow_unmatched: Also translate joints that are no match; they stay marked.

    Returns:
        The gains for the other framework, and what changed by joint.

    Raises:
        UnmatchedError: A joint is no match.
        PronkError: The gains hold for no profile, are of another robot or not stable in the other
            framework, or the robot cannot be commanded at the profile's step.
    """
    if gains.robot != robot.name:
        raise PronkError(
            f"the gains are those of {gains.robot}, not of {robot.name}; give the robot that they "
            "were matched for (--robot)."
        )
    require_matched(gains, allow_unmatched)
    begin = profile_held(gains)
    source = begin.robot(robot)
    target = to.robot(robot)
    keeps_friction = begin.friction == "N m" and to.friction == "N m"

    joints: dict[str, JointGains] = {}
    translations: dict[str, JointTranslation] = {}
    for name, joint in gains.joints.items():
        translation = translated(
            _linear_joint(source, name, joint),
            _linear_joint(target, name, joint),
            (joint.stiffness.value, joint.damping.value),
            joint.delay_s.value,
        )
        chain = robot.joint(name).chain
        if any(robot.joint(other).drive.frictionloss > 0.0 for other in chain if other != name):
            stuck = translated(
                _linear_joint(source, name, joint, others_stick=True),
                _linear_joint(target, name, joint, others_stick=True),
                (joint.stiffness.value, joint.damping.value),
            )
            translation = replace(translation, stuck=stuck.after)
        if not keeps_friction:
            joint = replace(joint, frictionloss=ZERO, stribeck=ZERO)
        elif math.isnan(joint.frictionloss.value):
            published = source.joint(name).drive.frictionloss
            joint = replace(joint, frictionloss=FittedValue(value=published))
        translations[name] = translation
        joints[name] = _translated_joint(joint, translation, begin.name)

    groups: dict[str, GroupGains] = {}
    for name, group in gains.groups.items():
        member_translations = []
        frictions = []
        for member in robot.group(name):
            if member.name in joints:
                member_translations.append(translations[member.name])
                frictions.append(joints[member.name].frictionloss.value)
        groups[name] = _translated_group(group, member_translations, frictions)

    simulator = replace(to.info, decimation=target.decimation)
    translated_gains = replace(gains, simulator=simulator, joints=joints, groups=groups)
    actuators = exported_actuators(translated_gains, target, "joint")
    require_stable(to, target, actuators)
    return translated_gains, translations


def translated(
    first: LinearJoint, other: LinearJoint, gains: Pair, delay_s: float = 0.0
) -> JointTranslation:
    """Find the gains with which one linear joint responds like another.

    Args:
        first: The joint in the first framework.
        other: The joint in the other framework, at the same frequencies.
        gains: Stiffness [N m/rad] and damping [N m s/rad] in the first framework.
        delay_s: Delay of the command that goes with them [s].

    Returns:
        Gains in both frameworks, errors and lead.
    """
    goal = first.response(*gains)[0]

    def error_db(log_gains: Array) -> Array:
        with np.errstate(over="ignore"):
            stiffness, damping = np.exp(log_gains)
            response = other.response(stiffness, damping)[0]
            return np.asarray(DB * np.log(np.abs(response / goal)))

    # Damping 0 has no logarithm.
    start = np.log([gains[0], max(gains[1], LEAST_DAMPING_S * gains[0])])
    most = np.log(MOST_CHANGE)
    lowest = np.array([start[0] - most, np.log(0.5 * LEAST_DAMPING_S) + start[0] - most])
    highest = start + most
    solution = least_squares(
        error_db, start, bounds=(lowest, highest), x_scale=0.1, xtol=1e-10, ftol=1e-12
    )
    stiffness = float(np.exp(solution.x[0]))
    damping = float(np.exp(solution.x[1]))
    if damping < LEAST_DAMPING_S * stiffness:
        damping = 0.0

    def complex_error(point: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):
            gain_pair = np.exp(point[:2])
            turned = np.exp(-1j * other.omega * DELAY_SCALE_S * point[2])
            difference = other.response(gain_pair[0], gain_pair[1])[0] * turned - goal
        return np.concatenate([difference.real, difference.imag])

    phase_solution = least_squares(complex_error, np.append(solution.x, 0.0), x_scale=0.1)
    with_phase = np.exp(phase_solution.x[:2])
    if with_phase[1] < LEAST_DAMPING_S * with_phase[0]:
        with_phase[1] = 0.0
    phase = np.unwrap(np.angle(other.response(stiffness, damping)[0] / goal))
    # Slope of a straight line through zero by least squares.
    lead_s = float(phase @ first.omega / (first.omega @ first.omega))
    return JointTranslation(
        before=gains,
        after=(stiffness, damping),
        before_db=rms(error_db(start)),
        after_db=rms(solution.fun),
        lead_s=lead_s,
        rest_s=min(delay_s + lead_s, 0.0),
        with_phase=(float(with_phase[0]), float(with_phase[1])),
        unseen_share=_unseen_share(np.asarray(solution.jac)),
        at_bound=bool(
            abs(solution.x[0] - start[0]) > 0.95 * most or highest[1] - solution.x[1] < 0.1
        ),
    )


def _unseen_share(jacobian: Array) -> float:
    """Return the relative change of gains, seen least, that changes the magnitude by `SEEN_DB`.

    Args:
        jacobian: Of the magnitudes [dB] by the logarithms of both gains, shape (f, 2).
    """
    slopes = np.linalg.svd(jacobian, compute_uv=False) / math.sqrt(len(jacobian))
    return float(SEEN_DB / max(slopes[-1], 1e-12))


def stated_gains(robot: RobotSpec, by_joint: Mapping[str, Pair], begin: Profile) -> MatchedGains:
    """Make gains of a framework that no log was matched with; they are taken for exact.

    Args:
        robot: The robot.
        by_joint: Stiffness [N m/rad] and damping [N m s/rad] by joint.
        begin: Profile of the framework that they hold for.

    Returns:
        Gains whose groups have the mean of their joints.
    """
    joints = {}
    for name, (stiffness, damping) in by_joint.items():
        joints[name] = JointGains(
            stiffness=FittedValue(value=stiffness),
            damping=FittedValue(value=damping),
            armature=FittedValue(value=robot.joint(name).drive.armature),
        )
    groups = {}
    for group in robot.groups:
        pairs = [by_joint[joint.name] for joint in robot.group(group) if joint.name in by_joint]
        if pairs:
            stiffness, damping = np.mean(pairs, axis=0).tolist()
            stiffness_range, damping_range = (np.ptp(pairs, axis=0) / 2.0).tolist()
            groups[group] = GroupGains(
                stiffness=stiffness,
                damping=damping,
                stiffness_range=stiffness_range,
                damping_range=damping_range,
            )
    simulator = replace(begin.info, decimation=begin.robot(robot).decimation)
    return MatchedGains(
        robot=robot.name,
        simulator=simulator,
        joints=joints,
        groups=groups,
        robot_path=file_of_robot(robot),
    )


def _linear_joint(
    robot: RobotSpec, name: str, gains: JointGains, *, others_stick: bool = False
) -> LinearJoint:
    """Linearize a joint about the default pose, with its matched armature and no dry friction."""
    original = robot.joint(robot.joint(name).original[0])
    rotor_inertia = gains.armature.value / original.drive.gear_ratio**2
    drive = replace(original.drive, rotor_inertia=rotor_inertia, frictionloss=0.0)
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, drive=drive) if joint.name == original.name else joint)
    changed = replace(robot, joints=tuple(joints))

    low, high = gains.quality.band_hz
    if not (math.isfinite(low) and math.isfinite(high)):
        low, high = robot.joint(name).band_hz
    hz = np.linspace(max(low, min(LOW_HZ, 0.5 * high)), high, POINTS)
    pose = np.array([robot.joint(joint).default_position for joint in original.chain])
    with JointTestRig(changed, original.name, threads=1) as rig:
        order = [original.chain.index(joint) for joint in rig.joints]
        return linearize(rig, pose[order], 2.0 * np.pi * hz, others_stick=others_stick)


def _translated_joint(joint: JointGains, translation: JointTranslation, begin: str) -> JointGains:
    """Return the gains of a joint in the other framework; `begin` names the first one.

    Intervals are scaled as their gain is, the dry friction as the stiffness is.
    """
    stiffness_scale, damping_scale = translation.scales
    flags = [flag for flag in joint.flags if not flag.startswith((NOT_ALIKE, NOT_UNIQUE))]
    if translation.after_db > NOT_ALIKE_DB:
        flags.append(f"{NOT_ALIKE}: {translation.after_db:.2f} dB from {begin}")
    elif translation.at_bound:
        flags.append(
            f"{NOT_ALIKE}: gains of any size give the response in {begin}, since the joint follows "
            "its command at every frequency compared; keep the gains as they are, or take a wider "
            "band"
        )
    elif translation.stuck_spread > CRITERIA_SPREAD_MAX and translation.stuck is not None:
        flags.append(
            f"{NOT_UNIQUE}: {translation.after[0]:.4g} N m/rad and {translation.after[1]:.4g} "
            f"N m s/rad where the other joints of its chain move, {translation.stuck[0]:.4g} and "
            f"{translation.stuck[1]:.4g} where dry friction holds them"
        )
    elif translation.after[1] == 0.0:
        flags.append(
            f"{NOT_ALIKE}: the drive law damps the joint as much as that of {begin} or more, so "
            "that the damping is 0"
        )
    elif translation.unseen_share > UNSEEN_SHARE_MAX:
        flags.append(
            f"{NOT_UNIQUE}: gains that differ by {100.0 * translation.unseen_share:.0f} % respond "
            f"alike within {SEEN_DB:g} dB in this band; a match of logs may end at any of them"
        )
    elif translation.criteria_spread > CRITERIA_SPREAD_MAX:
        stiffness_with_phase, damping_with_phase = translation.with_phase
        flags.append(
            f"{NOT_UNIQUE}: {translation.after[0]:.4g} N m/rad and {translation.after[1]:.4g} "
            f"N m s/rad by the magnitude, {stiffness_with_phase:.4g} and {damping_with_phase:.4g} "
            f"by magnitude and phase: with the held joints of its chain no gains of this drive law "
            f"answer quite as those of {begin}; a match of logs may end at either"
        )
    stiffness = replace(joint.stiffness.scaled(stiffness_scale), value=translation.after[0])
    damping = replace(joint.damping.scaled(damping_scale), value=translation.after[1])
    return replace(
        joint,
        stiffness=stiffness,
        damping=damping,
        frictionloss=joint.frictionloss.scaled(stiffness_scale),
        delay_s=FittedValue(value=max(joint.delay_s.value + translation.lead_s, 0.0)),
        covariance=_scaled_matrix(joint.covariance, stiffness_scale, damping_scale),
        flags=tuple(flags),
    )


def _translated_group(
    group: GroupGains, translations: list[JointTranslation], frictions: list[float]
) -> GroupGains:
    """Return the training gains of a group, scaled by the mean of its joints."""
    scales = [joint.scales for joint in translations]
    stiffness_scale, damping_scale = np.mean(scales, axis=0).tolist()
    center = group.ellipsoid_center
    return GroupGains(
        stiffness=stiffness_scale * group.stiffness,
        damping=damping_scale * group.damping,
        stiffness_range=stiffness_scale * group.stiffness_range,
        damping_range=damping_scale * group.damping_range,
        frictionloss=float(np.mean(frictions)),
        ellipsoid=_scaled_matrix(group.ellipsoid, stiffness_scale, damping_scale),
        ellipsoid_center=(stiffness_scale * center[0], damping_scale * center[1]),
    )


def _scaled_matrix(
    matrix: tuple[Interval, Interval], stiffness_scale: float, damping_scale: float
) -> tuple[Interval, Interval]:
    """Return a covariance or shape matrix of (stiffness, damping) of scaled gains."""
    mixed_scale = stiffness_scale * damping_scale
    stiffness_row = (stiffness_scale**2 * matrix[0][0], mixed_scale * matrix[0][1])
    damping_row = (mixed_scale * matrix[1][0], damping_scale**2 * matrix[1][1])
    return stiffness_row, damping_row
