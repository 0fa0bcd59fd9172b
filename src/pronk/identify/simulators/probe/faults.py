"""What acts otherwise than it is set, in words."""

from __future__ import annotations

import math

from pronk.identify.simulators.probe.law_fit import ProbeRuns
from pronk.identify.simulators.probe.result import LARGE_RESIDUAL, Clip, Probe
from pronk.identify.simulators.simulator import Simulator
from pronk.robots.robot import RobotSpec

_DELAY_SHOWS = 0.05
"""Share of a step from which on a delay is named."""


def find_faults(
    probe: Probe, clip: Clip | None, simulator: Simulator, robot: RobotSpec, runs: ProbeRuns
) -> dict[str, str]:
    """Name what acts otherwise than it is set; see `Probe.faults`."""
    faults = {}
    joint = robot.joint(probe.joint)
    drive = joint.drive
    stated_law = simulator.info.drive_law
    law = probe.law.drive
    if clip is not None and clip.of_torque:
        faults["clipped"] = (
            f"torque is clipped at {probe.law.clip:.2g} N m, the effort limit is "
            f"{drive.effort_limit:g} N m; the joint was probed below it"
        )
    elif clip is not None:
        faults["clipped"] = f"the command is clipped at {probe.law.clip:.3g} rad about the pose"
    if not probe.complete:
        faults["incomplete"] = (
            f"the fits ended after {runs.steps.simulated:,} integration steps, before all laws "
            "were fitted: the law may be another, and with it what acts"
        )
    if probe.residual > LARGE_RESIDUAL:
        unexplained = f"{100.0 * probe.residual:.1f} % of the motion is not explained"
        if probe.complete:
            unexplained += ": the joint follows none of the laws, or others move with it"
        faults["residual"] = unexplained
    if not probe.law_found:
        # What a law says that does not explain the motion, or may not be the best one, is no
        # finding.
        return faults
    labels = [law.label]
    for other in probe.alike:
        labels.append(other.label)
    if probe.law.stale_position:
        taken = probe.law.stale_position * runs.timestep * joint.stiffness
        stale_parts = "position and speed are" if probe.law.stale_speed else "the position is"
        steps = probe.law.stale_position
        age = "one step old" if steps == 1 else f"{steps} steps old"
        faults["stale"] = (
            f"{stale_parts} {age} where the torque is computed, which takes about {taken:.3g} "
            f"N m s/rad from the damping of {joint.damping:g}"
        )
        if law != stated_law:
            faults["law"] = f"law {stated_law.label} is stated, the joint responds by {law.label}"
    elif probe.law.beside_explicit:
        faults["beside"] = (
            f"a drive of law {law.label} acts beside the explicit torque; set the gains of the "
            "engine's own drive to 0"
        )
    elif law != stated_law:
        faults["law"] = (
            f"law {stated_law.label} is stated, the joint responds by {' or '.join(labels)}"
        )

    if _both_near(probe, 2.0):
        faults["twice"] = (
            "torques act twice: the effort is submitted two times, 2 times the gains that are set"
        )
    elif _both_near(probe, 180.0 / math.pi):
        faults["degrees"] = (
            "gains per degree act as if they were per radian, 57.3 times the gains that are set"
        )
    elif _both_near(probe, math.pi / 180.0):
        faults["degrees"] = (
            "gains per radian act as if they were per degree, 0.0175 times the gains that are set"
        )
    else:
        for name, factor in (
            ("stiffness", probe.gains.stiffness_factor),
            ("damping", probe.gains.damping_factor),
        ):
            if abs(factor - 1.0) > 0.05:
                faults[name] = f"the {name} that acts is {factor:.3g} times the one that is set"

    if probe.armature_applied is not None and probe.armature_applied < 0.5:
        faults["ignored"] = (
            "a change of the armature changes nothing: the engine ignores it, and "
            f"{probe.armature:.4g} kg m^2 acts"
        )
    elif abs(probe.armature - drive.armature) > 0.03 * (runs.inertia + drive.armature):
        faults["armature"] = (
            f"an armature of {probe.armature:.4g} kg m^2 acts, {drive.armature:.4g} is set"
        )

    tolerance = max(0.1 * drive.frictionloss, 0.005 * runs.torque)
    friction_differs = abs(probe.frictionloss - drive.frictionloss) > tolerance
    if friction_differs and "frictionloss" in simulator.parameters:
        faults["friction"] = (
            f"dry friction of {probe.frictionloss:.3g} N m acts, {drive.frictionloss:.3g} is set"
        )
    if abs(probe.gravity - 1.0) > 0.1 and runs.gravity_shows:
        share = max(probe.gravity, 0.0)
        faults["gravity"] = f"{share:.2f} of the gravity acts that the model has"
    if probe.hold > 1:
        faults["hold"] = f"the simulator holds each command for {probe.hold} steps"
    if probe.delay_s < -0.5 * runs.timestep:
        faults["early"] = "positions are those at the end of each step, one step early"
    elif probe.delay_s > _DELAY_SHOWS * runs.timestep:
        faults["delay"] = (
            f"commands act {1e3 * probe.delay_s:.3g} ms late ({probe.delay_s / runs.timestep:.3g} "
            "steps), or positions are read so late"
        )
    # The fit splits damping between the drive and the joint, to about this share of the drive's.
    acting_damping = joint.damping * max(probe.gains.damping_factor, 1.0)
    passive_tolerance = max(0.1 * drive.viscous_damping, 0.03 * acting_damping)
    if abs(probe.viscous_damping - drive.viscous_damping) > passive_tolerance:
        faults["passive"] = (
            f"passive damping of {probe.viscous_damping:.3g} N m s/rad acts, "
            f"{drive.viscous_damping:.3g} is set"
        )
    if probe.gains.stable_share < 1.0:
        faults["unstable"] = (
            "with its gains the joint diverges, or swings from step to step; it was probed "
            f"with {probe.gains.stable_share:g} of them"
        )
    return faults


def _both_near(probe: Probe, scale: float) -> bool:
    """Tell whether both gains act about `scale` times as they are set."""
    stiffness_near = abs(probe.gains.stiffness_factor / scale - 1.0) < 0.05
    damping_near = abs(probe.gains.damping_factor / scale - 1.0) < 0.05
    return stiffness_near and damping_near
