"""The torque column of a log beside the torque that matched gains ask for.

A motion tells stiffness, damping and inertia up to a common factor: a link that is twice as heavy,
with a drive of twice the gains, moves alike, also under gravity. Matched gains hold for the inertia
of the robot's file. Where a log has the torque that the drive measured, the factor shows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pronk.identify.logs.joint_log import Excitation
from pronk.identify.match.checks import TORQUE_COMPUTED
from pronk.identify.match.result import DriveFit

OTHER_TORQUE = 1.3
"""Factor between measured torque and that of the matched gains from which on it is said: torque
constants of drives are off by up to 20 %, and inertias of models by a few per cent more."""
CORRELATED = 0.9
"""Least correlation of the two torques. Below it the column is that of something else, or is so
noisy that its scale is not known."""
OPPOSED = -0.5
"""Correlation of the two torques up to which the column has the opposite sign. Noise makes a
correlation smaller and does not turn it, so that the threshold is lower than for a scale."""
EXPLAINED = 0.05
"""Error in time of a match, as a share of the amplitude, up to which its gains tell a torque."""


def torque_scale(excitations: Sequence[Excitation], fit: DriveFit) -> tuple[float, float]:
    """Compare the measured torque of a drive with that of the matched gains.

    The torque of the gains is `stiffness (u(t - delay) - q) - damping v`, for the recorded command
    u, position q and its derivative v. Both are taken about their means; the scale is the square
    root of the ratio of their variances, so that noise counts on neither side more.

    Args:
        excitations: Excitations of one joint.
        fit: The fit of the joint.

    Returns:
        Measured torque over that of the gains, and their correlation; NaN where no excitation has
        a measured torque.
    """
    measured_parts = []
    asked_parts = []
    for excitation in excitations:
        torque = excitation.torque
        if torque is None or excitation.log.origin.metadata.get("torque") == TORQUE_COMPUTED:
            continue
        time = excitation.time
        command = np.interp(time - fit.values["delay"], time, excitation.command)
        velocity = np.gradient(excitation.position, time)
        stretch = command - excitation.position
        asked = fit.values["stiffness"] * stretch - fit.values["damping"] * velocity
        measured_parts.append(torque - np.mean(torque))
        asked_parts.append(asked - np.mean(asked))
    if not measured_parts:
        return float("nan"), float("nan")
    measured = np.concatenate(measured_parts)
    asked = np.concatenate(asked_parts)
    sizes = float(np.sqrt(np.sum(measured**2) * np.sum(asked**2)))
    if sizes == 0.0:
        return float("nan"), float("nan")
    correlation = float(np.sum(measured * asked)) / sizes
    return float(np.sqrt(np.sum(measured**2) / np.sum(asked**2))), correlation


def check_torque_scale(excitations: Sequence[Excitation], fit: DriveFit) -> tuple[str, ...]:
    """Say that the measured torque of a drive is another than that of its matched gains.

    Args:
        excitations: Excitations of one joint.
        fit: The fit of the joint.

    Returns:
        A flag with the factor or the sign and what would look so; none where the torques agree
        within `OTHER_TORQUE`, where none was measured, and where the match does not explain the
        motion.
    """
    amplitude = max(excitation.amplitude for excitation in excitations)
    if not fit.rmse <= EXPLAINED * amplitude or "stiffness" not in fit.sd:
        return ()
    scale, correlation = torque_scale(excitations, fit)
    if correlation <= OPPOSED:
        return (
            "torque column: it has the opposite sign of the torque that the matched gains ask for "
            f"(correlation {correlation:.2f}); negate it before you match with --mode drive",
        )
    if not correlation >= CORRELATED or 1.0 / OTHER_TORQUE < scale < OTHER_TORQUE:
        return ()
    return (
        f"torque column: it is {scale:.2g} times the torque that the matched gains ask for "
        f"(correlation {correlation:.2f}). A motion tells gains over inertia alone. So would "
        f"look an inertia that is {scale:.2g} times that of the robot's file, as of a payload (the "
        f"gains of the drive are then {scale:.2g} times larger), and a torque column or a torque "
        "constant of another scale; weigh the link, or check the torque constant",
    )
