"""From a log to responses: group the repeats of each excitation and choose the estimator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pronk.errors import LogError, PronkError
from pronk.identify.logs.checks import check_motion
from pronk.identify.logs.excitations import with_segments
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.response.diagnostics import fit_delay, third_harmonic
from pronk.identify.response.grid import analysis_rate
from pronk.identify.response.h1 import H1Operator, estimate_averaged
from pronk.identify.response.periodic import estimate_periodic, multisine_operator
from pronk.identify.response.response import Estimator, FrequencyResponse


def excited_joints(log: JointLog) -> tuple[str, ...]:
    """Joints of the log's segments, in the log's order."""
    named = {name for segment in with_segments(log).segments for name in segment.joints}
    return tuple(name for name in log.joints if name in named)


def excitations(log: JointLog, joint: str) -> list[list[JointLog]]:
    """Split a log into the excitations of one joint: groups of repeats, largest amplitude first.

    Excitations of the same kind, amplitude, period, band and clamping are repeats of one another.
    Those of a log without segments are found in its command (`with_segments`); an amplitude that is
    not known is read off the command. LogError for a joint that was not excited.
    """
    column, log = log.column(joint), with_segments(log)
    where = log.source or "log"
    segments = [segment for segment in log.segments if joint in segment.joints]
    if not segments:
        others = ", ".join(excited_joints(log)) or "no joints"
        raise LogError(f"{where}: {joint} was not excited; {others} were.")
    groups: dict[tuple[object, ...], list[JointLog]] = {}
    for segment in segments:
        part = log.cut(segment)
        travel = float(np.ptp(part.command[:, column]))
        if travel == 0.0:
            raise LogError(
                f"{where}: the command of {joint} stands still between {segment.start:.3f} and "
                f"{segment.stop:.3f} s; the joint was not excited."
            )
        if np.isnan(segment.amplitude):
            part = replace(part, segments=(replace(segment, amplitude=travel / 2.0),))
        s = part.segments[0]
        key = (round(s.amplitude, 6), s.kind, s.period_s, s.band_hz, s.clamped)
        groups.setdefault(key, []).append(part)
    return sorted(groups.values(), key=lambda parts: -parts[0].segments[0].amplitude)


def log_rate(groups: Sequence[Sequence[JointLog]]) -> float:
    """One rate of the analysis grid for all excitations, so that they share frequencies [Hz]."""
    return analysis_rate([part.time for parts in groups for part in parts])


def estimate(
    log: JointLog, joint: str, estimator: Estimator | None = None
) -> list[FrequencyResponse]:
    """Responses of one joint, from its held command to its position; largest amplitude first.

    Chirps and excitations of unknown kind are averaged over segments (Welch); multisines and sine
    steps are read line by line. Repeats are combined by averaging their spectra, and kept one by
    one in `repeats`. A single long excitation is one repeat: its segments are its averages. Several
    kinds of one amplitude are several responses. LogError for a joint that was not excited or did
    not move, and for segments that are too short.
    """
    settings = estimator or Estimator()
    groups = excitations(log, joint)
    rate_hz = log_rate(groups)
    found = []
    for parts in groups:
        for part in parts:
            check_motion(part, joint)
        periodic = parts[0].segments[0].kind in ("multisine", "sine_steps")
        average = estimate_periodic if periodic else estimate_averaged
        response = average(parts, joint, settings, rate_hz)
        third = np.array([third_harmonic(part, joint) for part in parts])
        known = third[np.isfinite(third)]
        mean = float(known.mean()) if len(known) else math.nan
        found.append(replace(response, delay_s=fit_delay(response), third_harmonic=mean))
    return found


def operator(part: JointLog, joint: str, estimator: Estimator, rate_hz: float) -> H1Operator:
    """The estimate of one excitation (a log of one segment) as a matrix; equal repeats share it.

    `rate_hz` is that of `log_rate`. PronkError for sine steps, which have no common grid.
    """
    segment, command = part.segments[0], part.command[:, part.column(joint)]
    if segment.kind == "sine_steps":
        raise PronkError(
            f"{part.source or 'log'}: sine steps cannot be matched through one matrix; "
            "match a chirp or a multisine and keep the steps to check it."
        )
    if segment.kind == "multisine" and segment.period_s is not None:
        return multisine_operator(part.time, command, segment.period_s, estimator, rate_hz)
    return H1Operator.build(part.time, command, estimator, rate_hz=rate_hz)


def operators(
    log: JointLog, joint: str, estimator: Estimator | None = None
) -> list[list[H1Operator]]:
    """Return the `operator` of every repeat of every response of `estimate`."""
    groups = excitations(log, joint)
    rate_hz, settings = log_rate(groups), estimator or Estimator()
    return [[operator(part, joint, settings, rate_hz) for part in parts] for parts in groups]
