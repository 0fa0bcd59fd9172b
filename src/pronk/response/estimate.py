"""From a log to responses: which questions belong together, and which estimator reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError, PronkError
from pronk.logs.joint_log import JointLog, Segment
from pronk.response.delay import fit_delay
from pronk.response.distortion import third_harmonic
from pronk.response.estimator import Estimator
from pronk.response.grid import analysis_rate, grid_over, held_mean, interpolate
from pronk.response.operator import H1Operator
from pronk.response.periodic import estimate_multisine, multisine_operator
from pronk.response.response import FrequencyResponse
from pronk.response.spectra import Sums, layout, rests, segment_spectra, sums, total
from pronk.response.steps import estimate_steps

Array = NDArray[np.float64]

_UNMOVED = 0.01
"""Share of the command's travel below which a joint did not move."""


def questions(log: JointLog, joint: str) -> list[list[JointLog]]:
    """Split a log into the excitations of one joint, gathered into repeats.

    Questions of the same kind, amplitude, period, band and clamping are repeats of one another.
    A log without segments is one question of unknown kind; an amplitude that is not known is read
    off the command.

    Returns:
        Groups of repeats, largest amplitude first.

    Raises:
        LogError: There is no such joint, it was not excited, or its command is constant.
    """
    column = log.column(joint)
    where = log.source or "log"
    segments = [segment for segment in log.segments if joint in segment.joints]
    if not log.segments:
        start, stop = float(log.time[0]), float(log.time[-1])
        segments = [
            Segment(
                kind="unknown", joints=log.joints, start=start, stop=stop, amplitude=float("nan")
            )
        ]
    if not segments:
        excited = sorted({name for segment in log.segments for name in segment.joints})
        raise LogError(f"{where}: {joint} was not excited; {', '.join(excited)} were.")
    groups: dict[tuple[object, ...], list[JointLog]] = {}
    for segment in segments:
        part = log.cut(segment)
        command = part.command[:, column]
        travel = float(np.ptp(command))
        if travel == 0.0:
            raise LogError(
                f"{where}: the command of {joint} stands still between {segment.start:.3f} and "
                f"{segment.stop:.3f} s; there is nothing to answer."
            )
        if np.isnan(segment.amplitude):
            part = replace(part, segments=(replace(segment, amplitude=travel / 2.0),))
        known = part.segments[0]
        key = (
            round(known.amplitude, 6),
            known.kind,
            known.period_s,
            known.band_hz,
            known.clamped,
        )
        groups.setdefault(key, []).append(part)
    return sorted(groups.values(), key=lambda parts: -parts[0].segments[0].amplitude)


def log_rate(parts: Sequence[JointLog]) -> float:
    """One rate of the analysis grid for all questions, so that they share their frequencies [Hz].

    The mean rate inside the questions, to four significant digits; what was logged, or not, between
    them does not count.
    """
    steps = sum(len(part.time) - 1 for part in parts)
    span = sum(float(part.time[-1] - part.time[0]) for part in parts)
    return float(f"{steps / span:.4g}")


def _check_moved(part: JointLog, joint: str) -> None:
    column = part.column(joint)
    moved = float(np.ptp(part.position[:, column]))
    commanded = float(np.ptp(part.command[:, column]))
    if moved < _UNMOVED * commanded:
        raise LogError(
            f"{part.source or 'log'}: {joint} moved {moved:.3g} while its command travelled "
            f"{commanded:.3g}; check that its drive was enabled and the joint free."
        )


def _averaged(
    parts: Sequence[JointLog], joint: str, amplitude: float, estimator: Estimator, rate_hz: float
) -> FrequencyResponse:
    """H1 over the segments of all repeats."""
    each: list[Sums] = []
    omega = np.empty(0)
    padded = []
    for part in parts:
        column = part.column(joint)
        grid = grid_over(part.time, rate_hz)
        command = held_mean(part.time, part.command[:, column], grid)
        position = interpolate(part.time, part.position[:, column], grid)
        padded.append(rests(command, rate_hz))
        where = layout(grid, estimator, padded=padded[-1])
        spectra = [segment_spectra(x, where, estimator) for x in (command, position)]
        each.append(sums(spectra[0], spectra[1], where))
        omega = where.omega
    whole = total(each)
    ends = "reaching over the ends at rest" if all(padded) else "inside the question"
    return FrequencyResponse(
        joint=joint,
        amplitude=amplitude,
        omega=omega,
        response=whole.response(omega, rate_hz),
        coherence=whole.coherence(),
        averages=whole.averages(),
        repeats=np.array([one.response(omega, rate_hz) for one in each]),
        estimator="H1",
        window=f"{estimator.words()}, {ends}, mean of each segment removed",
        segment_s=estimator.segment_s,
        virtual=parts[0].virtual,
        source=parts[0].source,
    )


def estimate(
    log: JointLog, joint: str, estimator: Estimator | None = None
) -> list[FrequencyResponse]:
    """Responses of one joint, from its held command to its position.

    Chirps and questions of unknown kind are averaged over segments (Welch); multisines and sine
    steps are read line by line. Repeats are combined by averaging their spectra, and kept one by
    one in `repeats`. A single long question is one repeat: its segments are its averages.

    Args:
        log: The log.
        joint: The joint.
        estimator: Settings; the defaults if not given.

    Returns:
        One response per amplitude (and per kind, if there are several), largest amplitude first.

    Raises:
        LogError: The joint is unknown, was not excited, or did not move; or a segment is too short.
    """
    settings = estimator or Estimator()
    groups = questions(log, joint)
    rate_hz = log_rate([part for parts in groups for part in parts])
    found = []
    for parts in groups:
        for part in parts:
            _check_moved(part, joint)
        segment = parts[0].segments[0]
        read = {"multisine": estimate_multisine, "sine_steps": estimate_steps}.get(
            segment.kind, _averaged
        )
        response = read(parts, joint, segment.amplitude, settings, rate_hz)
        third = np.array([third_harmonic(part, joint) for part in parts])
        known = third[np.isfinite(third)]
        found.append(
            replace(
                response,
                delay_s=fit_delay(response).delay_s,
                third_harmonic=float(known.mean()) if len(known) else float("nan"),
            )
        )
    return found


def operator(part: JointLog, joint: str, estimator: Estimator, rate_hz: float) -> H1Operator:
    """Return the estimate of one question as a matrix; equal repeats share it.

    Args:
        part: A log of one segment.
        joint: The joint.
        estimator: Settings.
        rate_hz: Rate of the analysis grid, from `log_rate`.

    Raises:
        PronkError: Sine steps, which have no common grid.
    """
    segment, command = part.segments[0], part.command[:, part.column(joint)]
    if segment.kind == "sine_steps":
        raise PronkError(
            f"{part.source or 'log'}: sine steps cannot be matched through one matrix; "
            "match a chirp or a multisine and keep the steps to check it."
        )
    if segment.kind == "multisine" and segment.period_s is not None:
        return multisine_operator(part.time, command, segment.period_s, estimator, rate_hz=rate_hz)
    return H1Operator.build(part.time, command, estimator, rate_hz=rate_hz)


def operators(
    log: JointLog, joint: str, estimator: Estimator | None = None
) -> list[list[H1Operator]]:
    """Return the `operator` of every repeat of every response of `estimate`."""
    groups = questions(log, joint)
    rate_hz = log_rate([part for parts in groups for part in parts])
    settings = estimator or Estimator()
    return [[operator(part, joint, settings, rate_hz) for part in parts] for parts in groups]


__all__ = [
    "Estimator",
    "analysis_rate",
    "estimate",
    "log_rate",
    "operator",
    "operators",
    "questions",
]
