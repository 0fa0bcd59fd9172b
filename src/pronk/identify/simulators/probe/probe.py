"""Name how a simulator drives a joint, from the response of the joint alone.

`experiments` has what is done with the joint. Chirps with one pair of gains are not enough:
explicit drives of inertia `J + h kd` respond as drives of inertia `J` with implicit damping do. How
the response changes with the gains separates the laws of `pronk.robots.drive_law`, an implicit
drive that acts beside the explicit torque, and a torque of a position that is some steps old.

A joint with friction is fitted to each law (`law_search`); the law with the smallest residual is
the answer, with those that explain the motion as well. Fits are limited by the steps that they
simulate and not by their time, so that a slow machine gives the same answer. Gravity and the
inertia of the links are the robot's, which is what makes the gains absolute.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pronk.errors import PronkError
from pronk.identify.simulators.probe.experiments import SHORT_FIRST_STEP, Bench
from pronk.identify.simulators.probe.faults import find_faults
from pronk.identify.simulators.probe.law_fit import LawFit, ProbeRuns, StepCount
from pronk.identify.simulators.probe.law_search import (
    CLEAR,
    EXACT_RESIDUAL,
    alike_laws,
    best_laws,
    gain_scale,
)
from pronk.identify.simulators.probe.result import (
    LARGE_RESIDUAL,
    ActingGains,
    ActingLaw,
    Clip,
    Probe,
)
from pronk.identify.simulators.simulator import Simulator
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import Joint, RobotSpec

MOST_STEPS = 4_000_000
"""Integration steps after which no further law is tried. A core takes 17 s for 1,200,000; of 750
random simulators (`python -m benchmarks probe`, seeds 0 to 14) the longest takes 16 s."""
_SHARE_OF_STEPS = 0.4
"""Share of the steps that are left in which laws are tried with one share of the gains."""
_LIMIT_ERROR = 0.1
"""Largest relative error of a limit that is found; of random simulators it is up to 0.07."""
_CLEAR_OF_CLIP = 0.35
"""Amplitude of the chirps over the height of a step that is clipped."""


@dataclass(frozen=True, kw_only=True)
class _Answer:
    """The best law at one share of the gains."""

    doubt: float
    """Residual over that of the next law, and more where the answer is poor; the least counts."""
    fit: LawFit
    alike: tuple[ActingLaw, ...]
    """Other laws that explain the motion as well."""
    scale: float
    """Gains that act over those that are set."""
    hold: int
    runs: ProbeRuns
    complete: bool
    """False if the steps were over before all laws were fitted."""


def probe_joint(
    simulator: Simulator,
    robot: RobotSpec,
    joint: str | None = None,
    *,
    most_steps: int = MOST_STEPS,
) -> Probe:
    """Name the drive law and the parameters that act at one joint, whose gains are the robot's.

    Args:
        simulator: The simulator.
        robot: The robot whose joint it is.
        joint: The joint; the first one that moves no other if None.
        most_steps: Integration steps of the fits after which no further law is tried.

    Raises:
        PronkError: There is no such joint, it does not move, or the simulator diverges even with
            small gains.
    """
    if joint is None:
        joint = min(robot.joints, key=lambda robot_joint: len(robot_joint.chain)).name
    robot.joint(joint)
    if joint not in simulator.joints:
        raise PronkError(
            f"the simulator has no joint {joint!r}; its joints are {', '.join(simulator.joints)}."
        )
    bench = Bench(simulator, robot, joint)
    stable_share = bench.stable_share()
    clip = bench.clip(stable_share)
    if clip is not None:
        bench.lower_amplitude(_CLEAR_OF_CLIP * clip.acting * clip.height)
    answers = _answers(bench, simulator.info.drive_law, stable_share, StepCount(most_steps))
    if not answers:
        raise PronkError(
            f"{joint} moves by less than {1e-3 * bench.amplitude:.1g} rad when it is commanded by "
            f"chirps of {bench.amplitude:.2g} rad; check friction and limits of the simulator."
        )
    # With some shares of the gains a joint may follow its law, with others not.
    answer = min(
        answers,
        key=lambda candidate: (candidate.fit.residual > LARGE_RESIDUAL, candidate.doubt),
    )
    fit = answer.fit
    scale = answer.scale
    limit = None
    if clip is not None:
        limit = _fault_limit(clip, answer, robot.joint(joint), stable_share)
    if limit is None:
        clip = None
    probe = Probe(
        joint=joint,
        law=replace(fit.law, clip=limit),
        gains=ActingGains(
            stiffness_factor=scale,
            damping_factor=scale * fit.value("damping"),
            stable_share=stable_share,
        ),
        armature=scale * fit.value("inertia") - answer.runs.inertia,
        armature_applied=scale * fit.value("applied") if bench.armature_settable else None,
        viscous_damping=scale * fit.value("viscous"),
        frictionloss=scale * fit.value("friction"),
        gravity=scale * fit.value("gravity"),
        delay_s=fit.value("delay") * answer.runs.timestep,
        hold=answer.hold,
        residual=fit.residual,
        complete=answer.complete,
        alike=answer.alike,
    )
    return replace(probe, faults=find_faults(probe, clip, simulator, robot, answer.runs))


def _answers(
    bench: Bench, stated: DriveLaw, stable_share: float, steps: StepCount
) -> list[_Answer]:
    """Find the best law at the largest stable share of the gains, and at others where it is unsure.

    Args:
        bench: The experiments.
        stated: Law that the simulator states.
        stable_share: Largest share of the gains with which the joint is stable.
        steps: Integration steps of the fits.

    Raises:
        PronkError: The joint does not move with the first share.
    """
    answers: list[_Answer] = []
    shares = [stable_share]
    while shares:
        share = shares.pop(0)
        try:
            delay, hold, phase = bench.latency(share)
        except PronkError:
            if answers:
                # Friction holds the joint against smaller gains.
                break
            raise
        # Other shares of the gains need steps as well.
        last_step = steps.simulated + round(_SHARE_OF_STEPS * steps.remaining)
        runs = bench.chirps(share, hold, phase, steps, last_step)
        if runs.motion < 1e-3 * bench.amplitude:
            # Friction, or a defect, holds the joint.
            break
        ranking = best_laws(runs, delay, stated, bench.armature_settable)
        best = ranking[0]
        alike = alike_laws(ranking)
        next_residual = np.inf
        for fit in ranking[1:]:
            if fit.law not in alike:
                next_residual = min(next_residual, fit.residual)
        scale = gain_scale(runs, best, bench.armature_settable)
        doubt = best.residual / max(next_residual, 1e-15)
        more_shares: list[float] = []
        if best.residual > LARGE_RESIDUAL:
            doubt += best.residual
            if answers:
                more_shares = shares
            else:
                # Gravity moves a joint far whose gains act per degree; of a limit of the torque
                # smaller gains stay clear.
                larger_share = share * 180.0 / math.pi
                if bench.stable(larger_share):
                    more_shares.append(larger_share)
                more_shares += [share / 8.0, share / 64.0]
        elif share * scale < 0.2:
            # Laws differ by step times gains over inertia: with so soft a joint, by nothing.
            doubt = 1.0
            more_shares = [share / scale]
        elif doubt > CLEAR and share <= stable_share and bench.stable(4.0 * share):
            # Rounding hides by how many iterations laws differ; of larger gains less.
            more_shares = [4.0 * share]
        shares = more_shares if steps.remaining else []
        answers.append(
            _Answer(
                doubt=doubt,
                fit=best,
                alike=alike,
                scale=scale,
                hold=hold,
                runs=runs,
                complete=not runs.exhausted or best.residual < EXACT_RESIDUAL,
            )
        )
    return answers


def _fault_limit(clip: Clip, answer: _Answer, joint: Joint, stable_share: float) -> float | None:
    """Return the torque [N m] or the command [rad] at which a drive is clipped.

    Args:
        clip: The limit that was found in steps of the command.
        answer: The law that acts.
        joint: The joint.
        stable_share: Share of the gains with which the limit was found.

    Returns:
        The limit; None where it is the effort limit, or one of the engine's iterations.
    """
    if answer.fit.law.drive.kind == "implicit" and answer.scale > 1.5:
        # Within the iterations of a step much larger gains meet other limits of an engine too.
        return None
    if not clip.of_torque:
        return clip.height
    # In its first step a command acts for the share of the step that the delay leaves.
    delay_steps = answer.fit.value("delay")
    acting = 1.0 - (delay_steps - math.floor(delay_steps + 1e-3))
    if acting < 1.0 / (SHORT_FIRST_STEP - 2.0):
        acting = 1.0
    limit = min(acting, 1.0) * joint.stiffness * stable_share * clip.height
    if answer.fit.residual < LARGE_RESIDUAL:
        limit *= answer.scale
    if limit > (1.0 - _LIMIT_ERROR) * min(joint.drive.effort_limit, joint.drive.stall_torque):
        # Of larger gains than are set the effort limit is met earlier; it is no fault.
        return None
    return float(limit)
