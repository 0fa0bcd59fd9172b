"""What is missing or contradicts itself in a robot: its numbers and those of its model."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pronk.robots import MODEL_SUFFIXES, robot_file_path
from pronk.robots.bare import describe_model
from pronk.robots.load import read_robot_file
from pronk.robots.model import free_spec
from pronk.robots.robot import Joint, RobotSpec
from pronk.robots.servos import JointServo, joint_servos
from pronk.robots.source_model import SourceModel, read_source

SMALL_ANGLE = 0.1
"""Angle that a drive should be able to correct with less than its effort limit [rad]."""
END_OF_RANGE = 1e-3
"""Distance from a stop within which a pose lies at the end of its range [rad]."""
SERVOS = {"velocity": "a velocity servo", "motor": "a motor", "none": "no actuator"}
"""What a model has in place of a position servo, in words."""
SAME = 0.01
"""Relative difference up to which two limits are the same."""


@dataclass(frozen=True, kw_only=True)
class JointFinding:
    """What is missing or inconsistent about one joint, as a sentence in three parts."""

    beginning: str
    """Words before the joint, the same for all joints with this finding."""
    joint: str
    """Name of the joint, with its numbers where there are any."""
    ending: str
    """Words behind the joint, the same for all joints with this finding."""


def marked_lines(text: str) -> int:
    """Return the number of lines of a robot.yaml that are marked CHECK."""
    return sum("# CHECK" in line for line in text.splitlines())


def unchecked_lines(robot: RobotSpec) -> int:
    """Return how many lines of the robot's file are still marked CHECK; 0 for a bare model."""
    path = robot_file_path(robot.source)
    if path.suffix in MODEL_SUFFIXES:
        return 0
    return marked_lines(path.read_text(encoding="utf-8"))


def problems_of(robot: RobotSpec) -> list[str]:
    """List what is missing or inconsistent about a robot, a sentence for each kind of finding.

    Compared are each effort limit with 0.1 rad of stiffness, with the torque of gravity in the
    default pose and with the limit of the model; the speed limit with that of a URDF; the pose
    with the ranges. Named are numbers of a bare model that are assumed, rotor inertia and dry
    friction of 0, and joints without a position servo in the model. The lines of a robot.yaml that
    are marked CHECK are no problems of this list (`unchecked_lines`).
    """
    path = robot_file_path(robot.source)
    model_path = path
    problems = []
    if path.suffix in MODEL_SUFFIXES:
        problems.extend(_assumed(path))
    else:
        model_path = path.parent / read_robot_file(path).model
    source = read_source(model_path)
    problems.extend(source.notes)
    gravity = _gravity(robot)
    servos = joint_servos(source.model, source.model.qpos0)
    findings = []
    for joint in robot.joints:
        findings.extend(_joint_findings(joint, gravity[joint.name]))
        if joint.name in source.joint_names:
            servo = servos[source.joint_names.index(joint.name)]
            findings.extend(_limit_findings(joint, source, servo))
    problems.extend(_sentences(findings))
    by_type: dict[str, list[str]] = {}
    for joint in robot.joints:
        if joint.servo != "position":
            by_type.setdefault(joint.servo, []).append(joint.name)
    for servo_type, names in by_type.items():
        problems.append(
            f"the model has {SERVOS[servo_type]} and no position servo for {', '.join(names)}: "
            "give the gains of the real drives and remove `servo`"
        )
    return problems


def _assumed(path: Path) -> list[str]:
    """Name the numbers of a bare model that are assumed, by number."""
    by_number: dict[str, list[str]] = {}
    for (name, number), remark in describe_model(path).remarks.items():
        if remark.mark == "CHECK":
            by_number.setdefault(number, []).append(name)
    sentences = []
    for number, names in by_number.items():
        sentences.append(f"{number} is assumed for {', '.join(names)}")
    if sentences:
        # Part of the last one, so that there are as many sentences as numbers.
        sentences[-1] += f"; correct such numbers in the file of `pronk robot new {path}`"
    return sentences


def _gravity(robot: RobotSpec) -> dict[str, float]:
    """Return the torque that holds each joint in the default pose [N m]."""
    model = free_spec(robot).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    torque = np.abs(data.qfrc_bias - data.qfrc_passive)
    gravity = {}
    for joint in robot.joints:
        gravity[joint.name] = float(torque[model.joint(joint.name).dofadr[0]])
    return gravity


def _sentences(findings: Iterable[JointFinding]) -> list[str]:
    """Write each finding once, with the names of all joints that have it."""
    joints: dict[tuple[str, str], list[str]] = {}
    for finding in findings:
        joints.setdefault((finding.beginning, finding.ending), []).append(finding.joint)
    sentences = []
    for (beginning, ending), names in joints.items():
        sentences.append(f"{beginning} {', '.join(names)}{ending}")
    return sentences


def _finding(joint: Joint, beginning: str, ending: str, numbers: str = "") -> JointFinding:
    """Return a finding about a joint, with its numbers where there are any."""
    text = f"{joint.name} ({numbers})" if numbers else joint.name
    return JointFinding(beginning=beginning, joint=text, ending=ending)


def _joint_findings(joint: Joint, gravity: float) -> list[JointFinding]:
    """List what is missing or inconsistent about the numbers of a joint."""
    findings = []

    def add(beginning: str, ending: str, numbers: str = "") -> None:
        findings.append(_finding(joint, beginning, ending, numbers))

    drive = joint.drive
    low, high = joint.range
    pose = joint.default_position
    if pose < low - END_OF_RANGE or pose > high + END_OF_RANGE:
        add("poses.default is outside of the range of", "")
    elif min(pose - low, high - pose) <= END_OF_RANGE:
        add("poses.default is at the end of its range for", "; a sweep has no room there")
    if drive.armature <= 0.0:
        add("the rotor inertia (armature) is 0 for", "")
    if drive.frictionloss <= 0.0:
        add("the dry friction (frictionloss) is 0 for", "")
    torque = joint.stiffness * SMALL_ANGLE
    if torque > drive.effort_limit:
        add(
            "the stiffness of",
            f" gives more than the effort limit at {SMALL_ANGLE:g} rad: the drive would be at "
            "its limit nearly always; one of the two is wrong, or of another unit",
            f"{joint.stiffness:.4g} N m/rad, {torque:.3g} N m of {drive.effort_limit:.4g}",
        )
    if gravity > drive.effort_limit:
        add(
            "in the default pose the torque of gravity is above the effort limit of",
            ": it cannot hold the pose",
            f"{gravity:.3g} N m of {drive.effort_limit:.4g}",
        )
    if drive.effort_limit > drive.stall_torque * (1.0 + SAME):
        add(
            "the effort limit is above the stall torque of",
            "",
            f"{drive.effort_limit:.4g} N m, {drive.stall_torque:.4g} N m",
        )
    return findings


def _limit_findings(joint: Joint, source: SourceModel, servo: JointServo) -> list[JointFinding]:
    """Compare the limits of a drive with those of its model."""
    findings = []
    effort_limit = joint.drive.effort_limit
    place = "the URDF" if source.is_urdf else "the model"
    has_limit = 0.0 < servo.effort_limit < np.inf
    if has_limit and not np.isclose(effort_limit, servo.effort_limit, rtol=SAME):
        numbers = f"{effort_limit:.4g} N m, there {servo.effort_limit:.4g}"
        findings.append(_finding(joint, "the effort limit of", f" is not that of {place}", numbers))
    speed_limit = source.speed_limits.get(joint.name)
    speed = joint.drive.no_load_speed
    if speed_limit is not None and speed < speed_limit * (1.0 - SAME):
        numbers = f"{speed:.4g} rad/s, there {speed_limit:.4g}"
        findings.append(
            _finding(
                joint, "the no-load speed of", f" is below the velocity limit of {place}", numbers
            )
        )
    return findings
