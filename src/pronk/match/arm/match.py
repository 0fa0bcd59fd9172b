"""`pronk match` for recordings in which several joints moved at once.

What the recordings identify is fitted; what they do not is held at the published value, and the
gains say so. The result is the same `gains.yaml` as everywhere: stiffness and damping of every
joint, with the dry friction, armature and delay that belong to them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError, PronkError
from pronk.logs.joint_log import SweepLog
from pronk.match.arm.fit import DriveFit, DriveJoint, fit_drive
from pronk.match.gains import JointGains, MatchedGains
from pronk.match.identifiability import EXPERIMENTS
from pronk.match.parameters import DRIVE_MODE, GAINS_MODE, PARAMETERS, gains_covariance
from pronk.match.ranges import matched_gains
from pronk.match.result import JointMatch
from pronk.response.estimate import estimate
from pronk.response.response import FrequencyResponse
from pronk.robots.robot import Robot
from pronk.simulators.chain import ChainSimulation, Drives, JointDrive
from pronk.simulators.mujoco import mujoco_info

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
Mode = Literal["gains", "drive"]

COHERENCE_MIN = 0.8
"""Frequencies whose coherence is lower do not count towards an error in dB."""
_HOLD_FIRST = ("armature", "stiffness", "delay", "offset", "frictionloss", "damping")
"""Of several parameters that cannot be told apart, the one to hold: best known otherwise first."""
_STAGES = 3


@dataclass(frozen=True, kw_only=True)
class ArmMatch:
    """A matched arm: the gains and what they rest on."""

    gains: MatchedGains
    fit: DriveFit
    mode: Mode
    held: Mapping[str, tuple[str, ...]]
    """Parameters that were asked but held, by joint, because the recordings do not tell them."""
    joints: Mapping[str, JointMatch] = field(default_factory=dict)
    """Measured and simulated responses, for the page. There was no grid, so those arrays are
    empty. Several joints moved at once, so a response may hold what one joint did to another; it
    does so alike for the recording and the simulations."""


def match_arm(
    logs: Sequence[SweepLog],
    robot: Robot,
    *,
    mode: Mode = "gains",
    threads: int = 2,
    progress: Progress | None = None,
) -> ArmMatch:
    """Match all joints of an arm that moved together.

    Args:
        logs: Recordings of one arm.
        robot: The robot.
        mode: `gains` fits stiffness, damping, dry friction and delay with the armature known;
            `drive` fits damping, armature, dry friction and delay with the stiffness known.
        threads: Threads of the simulator.
        progress: Told the stage in words and the share of it that is done, 0 to 1.

    Raises:
        PronkError: The mode is unknown.
        LogError: Nothing moves in radians, or the recordings are too short.
        IdentifiabilityError: A joint's damping cannot be told even with all else held.
    """
    if mode not in ("gains", "drive"):
        raise PronkError(f"mode {mode!r}; expected gains or drive.")
    asked = GAINS_MODE if mode == "gains" else DRIVE_MODE
    fit, held = _fit_what_can_be_told(logs, robot, asked, threads, progress)
    joints = _responses(logs, robot, fit, threads)
    gains = {
        name: _gains(robot, joint, joints.get(name), held.get(name, ()))
        for name, joint in fit.joints.items()
    }
    return ArmMatch(
        gains=matched_gains(robot, gains, logs, mujoco_info(robot)),
        fit=fit,
        mode=mode,
        held=held,
        joints=joints,
    )


def drives_of(robot: Robot, gains: MatchedGains) -> dict[str, JointDrive]:
    """Drives of the matched joints, from the artefact."""
    out = {}
    for name, joint in gains.joints.items():
        known = robot.joint(name).drive
        dry = known.frictionloss if np.isnan(joint.frictionloss) else joint.frictionloss
        out[name] = JointDrive(
            stiffness=joint.stiffness,
            damping=joint.damping,
            armature=joint.armature,
            frictionloss=dry,
            delay=joint.delay_s,
        )
    return out


def _fit_what_can_be_told(
    logs: Sequence[SweepLog],
    robot: Robot,
    asked: tuple[str, ...],
    threads: int,
    progress: Progress | None,
) -> tuple[DriveFit, dict[str, tuple[str, ...]]]:
    """Fit, hold one parameter of each joint that is not identified, and fit again."""
    wanted: Sequence[str] | Mapping[str, Sequence[str]] = asked
    held: dict[str, tuple[str, ...]] = {}
    start: Drives = {}
    for stage in range(_STAGES):
        fit = fit_drive(
            logs,
            robot,
            parameters=wanted,
            start=start,
            strict=stage == _STAGES - 1,
            threads=threads,
            progress=progress,
        )
        doubts = {name: joint.unidentified for name, joint in fit.joints.items()}
        if not any(doubts.values()):
            break
        start = fit.drives
        for name, unknown in doubts.items():
            if unknown:
                worst = min(unknown, key=_HOLD_FIRST.index)
                held[name] = (*held.get(name, ()), worst)
                value = getattr(JointDrive.published(robot, name), worst)
                start = {**start, name: replace(start[name], **{worst: value})}
        wanted = {
            name: [p for p in PARAMETERS if p in asked and p not in held.get(name, ())]
            for name in fit.joints
        }
    return fit, held


def _gains(
    robot: Robot, joint: DriveJoint, match: JointMatch | None, held: tuple[str, ...]
) -> JointGains:
    """One joint as the artefact has it."""
    drive = joint.drive
    nan = float("nan")
    covariance = gains_covariance(joint.fitted, joint.covariance)
    flags = [
        f"{name} held at {getattr(drive, name):.4g}: these recordings do not tell it; "
        f"{EXPERIMENTS[name]}"
        for name in held
    ]
    if np.isfinite(joint.trusted_hz):
        flags.append(
            f"believed up to {joint.trusted_hz:.2g} Hz, where the coherence falls "
            f"({100 * joint.trusted_share:.0f} % of the samples)"
        )
    return JointGains(
        stiffness=drive.stiffness,
        damping=drive.damping,
        grid_stiffness=nan,
        grid_damping=nan,
        stiffness_ci95=joint.ci95.get("stiffness", (drive.stiffness, drive.stiffness)),
        damping_ci95=joint.ci95.get("damping", (drive.damping, drive.damping)),
        covariance=covariance,
        band_hz=match.band_hz if match else (nan, nan),
        error_db=match.error_db if match else nan,
        naive_error_db=match.naive_error_db if match else nan,
        coherence_min=_coherence_min(match) if match else nan,
        armature=drive.armature,
        frictionloss=drive.frictionloss,
        delay_s=drive.delay,
        flags=(*flags, *joint.flags),
    )


def _coherence_min(match: JointMatch) -> float:
    response = match.responses[0]
    return float(response.coherence[response.band(*match.band_hz, COHERENCE_MIN)].min())


def _responses(
    logs: Sequence[SweepLog], robot: Robot, fit: DriveFit, threads: int
) -> dict[str, JointMatch]:
    """Responses of the recording that says most about each joint, and of its simulations."""
    with ChainSimulation(robot, logs, threads=threads) as rig:
        matched, naive = rig.run([fit.drives, {}])
        joints = rig.joints
    out = {}
    for i, name in enumerate(joints):
        best = None
        for k, log in enumerate(logs):
            band = _band(robot, fit.joints[name], name)
            try:
                measured = estimate(log, name)[0]
            except LogError:
                continue  # not asked, or stuck, in this recording
            inside = measured.band(*band, COHERENCE_MIN)
            if best is None or inside.sum() > best[1].sum():
                best = (k, inside, measured)
        if best is None or not best[1].any():
            continue
        k, inside, measured = best
        answers = [_answer(logs[k], name, traces[k][:, i]) for traces in (matched, naive)]
        out[name] = JointMatch(
            joint=name,
            responses=(measured,),
            grid_stiffness=np.empty(0),
            grid_damping=np.empty(0),
            grid_error=np.empty((0, 0)),
            stiffness=fit.joints[name].drive.stiffness,
            damping=fit.joints[name].drive.damping,
            covariance=np.zeros((2, 2)),
            band_hz=_band(robot, fit.joints[name], name),
            matched=answers[0].response,
            naive=answers[1].response,
            error_db=_error_db(answers[0], measured, inside),
            naive_error_db=_error_db(answers[1], measured, inside),
        )
    return out


def _band(robot: Robot, joint: DriveJoint, name: str) -> tuple[float, float]:
    """The robot's band for the joint, up to where the recordings were believed [Hz]."""
    low, high = robot.joint(name).band_hz
    return low, min(high, joint.trusted_hz)


def _answer(log: SweepLog, joint: str, position: Array) -> FrequencyResponse:
    """Response of a simulated position, through the same estimator as the recording's."""
    positions = log.position.copy()
    positions[:, log.column(joint)] = position
    return estimate(replace(log, position=positions), joint)[0]


def _error_db(
    answer: FrequencyResponse, measured: FrequencyResponse, inside: NDArray[np.bool_]
) -> float:
    """Root mean square gain error [dB]."""
    ratio = answer.gain[inside] / measured.gain[inside]
    return float(np.sqrt(np.mean((20.0 * np.log10(ratio)) ** 2)))
