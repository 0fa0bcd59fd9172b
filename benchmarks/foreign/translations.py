"""Gains translated between drive laws beside gains matched to the same joint.

A joint of a public robot answers chirps in one framework without noise, delay and encoder, by
pronk's simulator of that framework. The log is matched for another framework, and the gains behind
it are translated to that framework. Both must end at the same stiffness and damping, or the
translation must say why they differ. Both by the same simulators: whether a simulator is right is
measured elsewhere (`python -m benchmarks frameworks`).
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.foreign.population import Candidate, copy_model
from pronk.errors import PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.match import match
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.translate import NOT_ALIKE, NOT_UNIQUE, stated_gains, translate
from pronk.identify.simulators.profiles import profile
from pronk.identify.simulators.stability import stability_share
from pronk.robots import load_robot
from pronk.robots.bare import yaml_of_model
from pronk.robots.model import bench_inertia, bench_spec
from pronk.robots.robot import RobotSpec
from tests.synthetic_log import Excitation, synthetic_log

Row = dict[str, Any]
AGREE = 0.02
"""Largest relative difference of gains that agree."""
FRAMEWORKS = (
    "mjlab",
    "mjlab-builtin",
    "isaaclab-implicit",
    "isaaclab-newton",
    "playground",
    "genesis",
)
"""Frameworks with dry friction in N m; the others have another friction, so another motion."""
AMPLITUDES = (0.05, 0.3)
"""Least and largest amplitude of the larger chirp [rad]."""
SHARE_OF_LIMIT = 0.25
"""Largest torque of a step of the command by the amplitude, as a share of the effort limit."""
SHARE_OF_RANGE = 0.15
"""Largest amplitude as a share of the joint's range."""
FRICTION_SHARES = (0.0, 0.5, 0.98)
"""Dry friction of the joints that are held over the torque of gravity on them: joints of the last
share stick just below what gravity asks of them."""
MOST_FRICTION = 0.05
"""Largest dry friction of the excited joint over stiffness times amplitude."""
LEAST_RATIO = 0.3
"""Least damping ratio of the drives: some models have none, and ring."""
NOISE_RAD = 1e-6
"""Standard deviation of the noise [rad]: the checks of a match want some."""
LENGTH_S = 12.0
"""Length of a chirp [s]."""
DRAWS = 20
"""Pairs of frameworks that are tried until the gains are stable in both."""


def translation_trial(
    seed: int, number: int, packages: Path, drawn: Sequence[tuple[Candidate, str]], scratch: Path
) -> Row:
    """Match and translate the gains of one drawn joint.

    Args:
        seed: Of the benchmark.
        number: Of the robot; `FRICTION_SHARES` go round by it.
        packages: Folder that the packages are installed in.
        drawn: Robots with their joints.
        scratch: Folder to work in; it is removed.

    Returns:
        Gains of both ways, their differences, the flags of the translation; or a refusal.
    """
    begin = time.perf_counter()
    candidate, joint = drawn[number]
    row: Row = {"number": number, "robot": candidate.label, "joint": joint, "refusal": ""}
    row |= {"defect": "", "from": "", "to": "", "flags": [], "match_flags": []}
    try:
        model = copy_model(packages, candidate.path, scratch)
        robot_file = model.with_name("robot.yaml")
        robot_file.write_text(yaml_of_model(model), encoding="utf-8")
        row |= _compared(seed, number, load_robot(str(robot_file)), joint)
    except PronkError as error:
        row["refusal"] = str(error).replace(str(scratch), "")
    except Exception as error:  # a defect of pronk, which the table shows
        row["defect"] = f"{type(error).__name__}: {error}"
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    row["seconds"] = time.perf_counter() - begin
    return row


def _compared(seed: int, number: int, robot: RobotSpec, joint: str) -> Row:
    """Return the gains of one joint by a match and by a translation."""
    rng = np.random.default_rng([seed, number, 5])
    excited = robot.joint(joint)
    low, high = excited.range
    amplitude = rng.uniform(*AMPLITUDES)
    amplitude = min(amplitude, SHARE_OF_RANGE * (high - low))
    amplitude = min(amplitude, SHARE_OF_LIMIT * excited.drive.effort_limit / excited.stiffness)
    robot = _with_damping(robot)
    excited = robot.joint(joint)
    robot = _with_friction(robot, joint, amplitude, FRICTION_SHARES[number % len(FRICTION_SHARES)])
    begin, target = _frameworks(rng, robot)
    pairs = {member.name: (member.stiffness, member.damping) for member in robot.joints}
    row: Row = {"from": begin, "to": target, "amplitude": amplitude, "given": pairs[joint]}
    first = stated_gains(robot, {joint: pairs[joint]}, profile(begin))
    gains, changes = translate(first, robot, profile(target))
    translated = gains.joints[joint]
    row["flags"] = list(translated.flags)
    row["explained"] = any(flag.startswith((NOT_ALIKE, NOT_UNIQUE)) for flag in translated.flags)
    row["after_db"] = changes[joint].after_db
    row["translated"] = (translated.stiffness.value, translated.damping.value)
    log = _log(profile(begin).robot(robot), joint, amplitude)
    result = match([log], robot, target, drive_gains=pairs, settings=MatchSettings(threads=1))
    matched = result.joints[joint].gains
    row["match_flags"] = list(matched.flags)
    row["matched"] = (matched.stiffness.value, matched.damping.value)
    row["error_db"] = matched.quality.error_db
    differences = np.divide(row["translated"], row["matched"]) - 1.0
    row["differences"] = differences.tolist()
    row["agree"] = bool(np.abs(differences).max() <= AGREE)
    return row


def _frameworks(rng: np.random.Generator, robot: RobotSpec) -> tuple[str, str]:
    """Draw two frameworks in which the gains of a robot are well below the limit of stability."""
    for _ in range(DRAWS):
        begin, target = rng.choice(FRAMEWORKS, 2, replace=False).tolist()
        shares = []
        for name in (begin, target):
            held_for = profile(name).robot(robot)
            drives = [_Drive(joint.name, robot) for joint in robot.joints]
            shares.append(stability_share(held_for, drives))
        if max(shares) < 0.5:
            return begin, target
    raise PronkError(f"the gains of {robot.name} are stable in no two frameworks.")


class _Drive:
    """The drive of one joint, as the stability limit takes it."""

    def __init__(self, name: str, robot: RobotSpec) -> None:
        joint = robot.joint(name)
        self.joints = (name,)
        self.stiffness = joint.stiffness
        self.damping = joint.damping
        self.armature = joint.drive.armature


def _with_damping(robot: RobotSpec) -> RobotSpec:
    """Return a robot whose drives have a damping ratio of `LEAST_RATIO` or more."""
    joints = []
    for joint in robot.joints:
        inertia, _ = bench_inertia(robot, joint.name)
        least = 2.0 * LEAST_RATIO * float(np.sqrt(joint.stiffness * inertia))
        joints.append(replace(joint, damping=max(joint.damping, least)))
    return replace(robot, joints=tuple(joints))


def _with_friction(robot: RobotSpec, joint: str, amplitude: float, share: float) -> RobotSpec:
    """Return a robot whose joints have a dry friction that is a share of gravity's torque."""
    model = bench_spec(robot, joint).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    chain = robot.joint(joint).chain or (joint,)
    joints = []
    for member in robot.joints:
        friction = member.drive.frictionloss
        if member.name in chain:
            weight = abs(float(data.qfrc_bias[model.joint(member.name).dofadr[0]]))
            friction = share * weight
        if member.name == joint:
            friction = min(friction, MOST_FRICTION * member.stiffness * amplitude)
        joints.append(replace(member, drive=replace(member.drive, frictionloss=friction)))
    return replace(robot, joints=tuple(joints))


def _log(robot: RobotSpec, joint: str, amplitude: float) -> JointLog:
    """Return the answer of a joint to chirps of two amplitudes in a framework."""
    low_hz, high_hz = robot.joint(joint).band_hz
    tick_hz = 1.0 / (robot.timestep_s * robot.decimation)
    excitations = []
    for factor in (1.0, 0.5):
        chirp = Chirp(
            start_hz=max(low_hz, 0.1),
            stop_hz=min(1.5 * high_hz, 0.45 * tick_hz),
            length_s=LENGTH_S,
            amplitude=factor * amplitude,
        )
        excitations.append(Excitation(offsets=chirp.samples(tick_hz), band_hz=chirp.band_hz))
    rng = np.random.default_rng(0)
    noise = [NOISE_RAD * rng.standard_normal(round(1000.0 * LENGTH_S)) for _ in excitations]
    stated = robot.joint(joint)
    return synthetic_log(
        robot, joint, excitations, stated.stiffness, stated.damping, noise=noise, threads=1
    )
