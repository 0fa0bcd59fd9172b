"""The response of a matched joint beside the responses of its simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pronk.arrays import Array, ComplexArray, Mask
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.measured import DB, MeasuredJoint, rms
from pronk.identify.response.estimate import estimate_response
from pronk.identify.response.response import Estimator, FrequencyResponse
from pronk.robots.robot import RobotSpec

COHERENCE_MIN = 0.8
"""Coherence below which a frequency of a joint that moved with others is not compared."""


@dataclass(frozen=True, kw_only=True)
class ComparedResponses:
    """Measured and simulated responses of one joint, all at the f frequencies of the first."""

    measured: tuple[FrequencyResponse, ...]
    """Measured responses, one an amplitude; the first, of the largest amplitude, is compared."""
    matched: ComplexArray
    """Response simulated with the matched gains, shape (f,)."""
    nominal: ComplexArray
    """Response simulated with the nominal gains, those on the real drive, shape (f,)."""
    band_hz: tuple[float, float]
    """Lowest and highest frequency that is compared [Hz]."""
    error_db: float
    """Root mean square gain error in the band with the matched gains [dB]."""
    nominal_error_db: float
    """Root mean square gain error in the band with the nominal gains [dB]."""
    coherence_min: float
    """Lowest coherence of the compared response, 0 to 1: in the whole band by `compare`, at the
    compared frequencies alone by `compare_recordings`."""


def compare(
    robot: RobotSpec,
    targets: Sequence[MeasuredJoint],
    matched: ComplexArray,
    nominal: ComplexArray,
) -> ComparedResponses:
    """Compare simulated responses with the measured one of the largest amplitude.

    Args:
        robot: The robot, which has the band of each joint.
        targets: Measured responses of one joint, the largest amplitude first.
        matched: Response simulated with the matched gains, shape (f,).
        nominal: Response simulated with the nominal gains, shape (f,).

    Returns:
        The responses with their errors at the frequencies of the fit.
    """
    target = targets[0]
    band_hz = robot.joint(target.joint).band_hz
    band = target.measured.band(*band_hz)
    return ComparedResponses(
        measured=tuple(one_amplitude.measured for one_amplitude in targets),
        matched=matched,
        nominal=nominal,
        band_hz=band_hz,
        error_db=target.rms_db(matched[target.fit_mask]),
        nominal_error_db=target.rms_db(nominal[target.fit_mask]),
        coherence_min=float(target.measured.coherence[band].min()),
    )


def gain_error_db(
    simulated: FrequencyResponse, measured: FrequencyResponse, compared: Mask
) -> float:
    """Return the root mean square gain error at some frequencies of two estimates [dB]."""
    return rms(DB * np.log(simulated.gain[compared] / measured.gain[compared]))


def compare_recordings(
    robot: RobotSpec,
    joint_name: str,
    logs: Sequence[JointLog],
    matched: Sequence[Array],
    nominal: Sequence[Array],
    *,
    highest_hz: float,
    estimator: Estimator | None = None,
) -> ComparedResponses | None:
    """Compare the responses of a joint that moved together with others.

    The recording whose response has the most coherent frequencies in the joint's band is compared.
    Simulated positions go through the same estimator as the recorded ones.

    Args:
        robot: The robot, which has the band of each joint.
        joint_name: The joint.
        logs: Recordings of the chain that the joint is in.
        matched: Positions of the joint with the matched gains, one array of shape (n,) a log [rad].
        nominal: Positions of the joint with the nominal gains [rad].
        highest_hz: Frequency from which on the drive could not follow [Hz].
        estimator: Segments, window and band; the defaults if None.

    Returns:
        The responses; None where no recording gives a response of the joint.
    """
    low_hz, high_hz = robot.joint(joint_name).band_hz
    band_hz = (low_hz, min(high_hz, highest_hz))
    best: FrequencyResponse | None = None
    best_number = 0
    compared = np.zeros(0, dtype=bool)
    for number, log in enumerate(logs):
        try:
            measured = estimate_response(log, joint_name, estimator)[0]
        except LogError:
            continue  # The joint was not excited, or was stuck, in this recording.
        coherent = measured.band(*band_hz, COHERENCE_MIN)
        if coherent.sum() > compared.sum():
            best = measured
            best_number = number
            compared = coherent
    if best is None:
        return None
    log = logs[best_number]
    simulated = []
    for position in (matched[best_number], nominal[best_number]):
        positions = log.position.copy()
        positions[:, log.column(joint_name)] = position
        moved = replace(log, position=positions)
        simulated.append(estimate_response(moved, joint_name, estimator)[0])
    return ComparedResponses(
        measured=(best,),
        matched=simulated[0].response,
        nominal=simulated[1].response,
        band_hz=band_hz,
        error_db=gain_error_db(simulated[0], best, compared),
        nominal_error_db=gain_error_db(simulated[1], best, compared),
        coherence_min=float(best.coherence[compared].min()),
    )
