"""The fit of drives in time: of a joint that moved alone, a leg or an arm, by one function.

The simulator itself is the model. Residuals are weighted differences between simulated and measured
positions at the timestamps of the log, and `scipy.optimize.least_squares` minimizes their squares.
Dry friction, which changes the response with the amplitude, and the delay are fitted with the
gains, so that neither passes for stiffness or damping.

`fit_drives` takes these steps:

1. Choose the start: fit the delay alone, with the nominal drive, from `Parameter.start` or from a
   larger nominal delay. The search then begins at this delay and at the nominal value of every
   other parameter, or at its `Parameter.start` where the nominal value is smaller.
2. Fit everything from there, and also from half and twice these gains where that settles badly.
3. Find how well each parameter is known, from repeats, or from blocks of time where nothing was
   repeated. Parameters that are not known are flagged, held at their nominal value, or refused.
4. Fit again without the samples that `training_samples` keeps out, and compare there with the
   nominal gains, the nominal gains with the best delay, and a plain fit: of `PLAIN`, those
   parameters that the match fits.

Several joints of a chain are fitted together. The parameters of a joint move its own position far
more than its neighbours', so the Jacobian is taken block-diagonal: one simulation for each
parameter, in which that of every joint is changed at once. The delay is one for the chain: its
commands go out together, and a joint without gravity cannot separate a delay from stiffer gains.

What differs between a joint that moved alone and joints that moved together (weights, the mean,
repeats or blocks) is a matter of their recordings: `pronk.identify.match.recordings` says why. A
torque channel gives the same parameters by another equation, which is linear in them and needs no
simulation: `pronk.identify.match.torque_fit`, with the same result.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Literal

import numpy as np

from pronk.arrays import Array, Mask
from pronk.errors import IdentifiabilityError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.least_squares import (
    EVALUATIONS,
    DriveVector,
    Optimum,
    Ranges,
    Residuals,
    minimize_residuals,
)
from pronk.identify.match.nominal_gains import gains_on_drive
from pronk.identify.match.parameters import (
    FREE,
    GAINS,
    PARAMETERS,
    SearchRange,
    checked_names,
    search_range,
)
from pronk.identify.match.recordings import training_samples
from pronk.identify.match.replay import Replay
from pronk.identify.match.result import HELD_OUT, DriveFit, amplitude_flags, held_out_flags
from pronk.identify.match.uncertainty import (
    Estimate,
    block_moves,
    estimate_parameters,
    jackknife,
    repeat_moves,
    total_intervals,
    widen_by_misfit,
)
from pronk.identify.simulators.chain import DriveValues, published
from pronk.robots.robot import RobotSpec

PLAIN = ("stiffness", "damping", "delay")
"""Parameters of the plain fit that the match is compared with. Those that the match does not fit,
as the stiffness in mode `drive`, have their nominal value."""
OTHER_STARTS = (0.5, 2.0)
"""Factors on the nominal gains from which a fit begins again where it settled badly."""
SETTLED_WELL = 0.9
"""Error in time, over that of the nominal gains with the best delay, below which a fit settled
well. On the sweeps of a leg of the virtual robot it is 0.26 to 0.52."""
MOST_HELD = 2
"""Most parameters of a joint, the delay apart, that are held at their nominal value."""
HOLD_FIRST = ("stribeck", "armature", "stiffness", "delay", "offset", "frictionloss", "damping")
"""Of several parameters that cannot be distinguished, the first of these is held."""
BLIND_RATIO = 0.07
"""Singular value of the scaled Jacobian, over its largest, below which its parameters only move
together. Finite differences of 2 to 3 % leave about as much of a direction without any effect: on
sweeps of the virtual robot it is 0.02 where stiffness, damping and armature are fitted together,
and 0.1 to 0.3 where one of them is known."""
NEGLIGIBLE_FRICTION = 0.05
"""Dry friction, over stiffness times amplitude, below which it need not be known any better: a
relay of that share changes the response outside of the resonance by less than 0.3 dB."""
EXPLAINED_LEAD = 0.02
"""Error in time, as a share of the amplitude, up to which a match explains the motion so well that
a negative delay is one of the log. Honest joints leave 0.001 to 0.008 unexplained."""
NOT_WORSE = 0.01
"""Error on the held-out samples that a match may have beside that of less fitting, as a share of
the amplitude of the command: 0.1 dB, a tenth of what counts as no match."""
BLIND_SHARE = 0.3
"""Component of such a direction from which on a parameter takes part in it."""

Unidentified = Literal["flag", "hold", "refuse"]


def fit_drives(
    replay: Replay,
    *,
    parameters: Sequence[str],
    nominal: DriveValues,
    unidentified: Unidentified = "flag",
    progress: Callable[[float], None] | None = None,
) -> dict[str, DriveFit]:
    """Fit parameters of the drives of all joints of some recordings.

    Args:
        replay: Recordings of a joint that moved alone, or of a chain whose joints moved together.
        parameters: Names out of `PARAMETERS`; those that the simulator cannot set are left out.
            `stribeck` is fitted with `frictionloss` by `ChainReplay` alone, where the drive has a
            Stribeck speed.
        nominal: All parameters of each joint, as published, with the gains that were on its drive.
        unidentified: What becomes of a parameter that the recordings do not identify. `flag`: its
            value stays with a flag. `hold`: it is held at the nominal value, up to `MOST_HELD` of a
            joint. `refuse`: it is an error.
        progress: Called with the share that is done, 0 to 1.

    Returns:
        The drive of each joint.

    Raises:
        PronkError: A parameter is unknown, or there is none.
        IdentifiabilityError: A parameter is not identified and cannot be held; the message says
            which, and what to record.
    """
    parameters = checked_names(parameters, [name for name in PARAMETERS if name != "stribeck"])
    if progress is not None:
        replay = CountedReplay(replay, 2 * EVALUATIONS * (1 + len(parameters)), progress)
    free = {joint: replay.fittable(joint, parameters) for joint in replay.joints}
    held_names: dict[str, tuple[str, ...]] = dict.fromkeys(replay.joints, ())
    everything = [np.ones(len(recording.time), dtype=bool) for recording in replay.recordings]

    ranges = search_ranges(replay, nominal)
    best = _fit_from_nominal(replay, everything, free, nominal, ranges)
    while True:
        estimates = _estimates(best)
        not_known = _parameters_to_hold(best, estimates, held_names, unidentified)
        if not not_known:
            break
        start = best.drives()
        fitted = dict(best.vector.fitted)
        for joint, name in not_known:
            held_names[joint] = (*held_names[joint], name)
            start[joint][name] = nominal[joint][name]
            fitted[joint] = tuple(other for other in fitted[joint] if other != name)
        vector = DriveVector(fitted, start, ranges)
        best = minimize_residuals(Residuals(replay, everything, vector))

    held_out = _held_out_errors(replay, best, nominal, ranges)
    fits = {}
    for joint in replay.joints:
        fits[joint] = _drive_fit(
            joint, best, estimates[joint], nominal, held_names[joint], held_out.get(joint, {})
        )
    return fits


def nominal_drives(
    logs: Sequence[JointLog], joints: Sequence[str], robot: RobotSpec
) -> dict[str, dict[str, float]]:
    """Give the published drive of some joints the gains that were on it when it was recorded."""
    drives = {}
    for joint in joints:
        log = next(log for log in logs if joint in log.joints)
        stiffness, damping = gains_on_drive(log, joint, robot)
        drives[joint] = published(robot, joint) | {
            "stiffness": stiffness,
            "damping": damping,
            "effort_limit": robot.joint(joint).drive.effort_limit,
        }
    return drives


LEAST_AMPLITUDE_RAD = 1e-3
"""Motion by which the torques of a joint are sized at least, so that one that stands still has
bounds above zero: twice the step of an encoder of 14 bits [rad]."""


def search_ranges(replay: Replay, nominal: DriveValues) -> dict[str, dict[str, SearchRange]]:
    """Return where the parameters of each joint are searched, by the size of the joint.

    Args:
        replay: Recordings, whose largest amplitude counts. Where joints moved together, half of
            the largest travel of the position stands for it.
        nominal: All parameters of each joint.
    """
    ranges: dict[str, dict[str, SearchRange]] = {}
    for joint in replay.joints:
        amplitude = LEAST_AMPLITUDE_RAD
        for recording in replay.recordings:
            if recording.joint != joint:
                continue
            size = recording.amplitude
            if np.isnan(size):
                size = 0.5 * float(np.ptp(recording.position))
            amplitude = max(amplitude, size)
        torque_scale = nominal[joint]["stiffness"] * amplitude
        ranges[joint] = {}
        for name in PARAMETERS:
            if name in nominal[joint]:
                ranges[joint][name] = search_range(name, nominal[joint][name], torque_scale)
    return ranges


class CountedReplay(Replay):
    """A replay that reports the share of its simulations that is done."""

    def __init__(self, replay: Replay, expected: int, progress: Callable[[float], None]) -> None:
        self.joints = replay.joints
        self.recordings = replay.recordings
        self.delay_step_s = replay.delay_step_s
        self.step_s = replay.step_s
        self.uncertain_s = replay.uncertain_s
        self._replay = replay
        self._expected = expected
        self._progress = progress
        self._done = 0

    def fittable(self, joint: str, parameters: Sequence[str]) -> tuple[str, ...]:
        """Choose the parameters that a joint's simulation can be given."""
        return self._replay.fittable(joint, parameters)

    def remarks(self, joint: str) -> tuple[str, ...]:
        """Say what of a joint's recordings is not used."""
        return self._replay.remarks(joint)

    def positions(self, sets: Sequence[DriveValues]) -> list[list[Array]]:
        """Simulate all recordings, and report."""
        positions = self._replay.positions(sets)
        self._done += len(sets)
        self._progress(min(self._done / self._expected, 0.99))
        return positions


def _fit_from_nominal(
    replay: Replay,
    samples: Sequence[Mask],
    fitted: Mapping[str, Sequence[str]],
    nominal: DriveValues,
    ranges: Ranges,
) -> Optimum:
    """Fit from the nominal drive with the best delay, and again where that settles badly.

    These are steps 1 and 2 of this module. A fit settles badly if it runs out of evaluations, ends
    at a bound of the search, or is hardly better than where it began. It then begins at
    `OTHER_STARTS` too, and the best counts.
    """
    delay = _restricted(fitted, ["delay"])
    vector = DriveVector(delay, _raised(nominal, delay, ranges), ranges)
    delayed = minimize_residuals(Residuals(replay, samples, vector))
    undelayed = _restricted(fitted, [name for name in PARAMETERS if name != "delay"])
    start = _raised(delayed.drives(), undelayed, ranges)
    best = minimize_residuals(Residuals(replay, samples, DriveVector(fitted, start, ranges)))
    at_bound = any(best.at_bound(joint) for joint in fitted)
    if best.settled and not at_bound and best.cost < SETTLED_WELL**2 * delayed.cost:
        return best
    for factor in OTHER_STARTS:
        other_start = copy.deepcopy(start)
        for joint, names in _restricted(fitted, GAINS).items():
            for name in names:
                other_start[joint][name] *= factor
        vector = DriveVector(fitted, other_start, ranges)
        optimum = minimize_residuals(Residuals(replay, samples, vector))
        if optimum.cost < best.cost:
            best = optimum
    return best


def _restricted(
    fitted: Mapping[str, Sequence[str]], allowed: Collection[str]
) -> dict[str, tuple[str, ...]]:
    """Choose of the fitted parameters of each joint those that are allowed."""
    restricted = {}
    for joint, names in fitted.items():
        restricted[joint] = tuple(name for name in names if name in allowed)
    return restricted


def _raised(
    drives: DriveValues, fitted: Mapping[str, Sequence[str]], ranges: Ranges
) -> dict[str, dict[str, float]]:
    """Raise fitted parameters to where their search begins where they are smaller (step 1)."""
    raised = {}
    for joint, values in drives.items():
        raised[joint] = dict(values)
        for name in fitted.get(joint, ()):
            raised[joint][name] = max(raised[joint][name], ranges[joint][name].start)
    return raised


def _estimates(optimum: Optimum) -> dict[str, Estimate]:
    """How well the parameters of each joint are known.

    The unit is a repeat where commands were repeated, and a block of time where none was.
    """
    residuals = optimum.residuals
    repeats = repeat_moves(
        optimum.jacobian, optimum.residual, residuals.command, residuals.recording
    )
    covariance = np.zeros((len(optimum.x), len(optimum.x)))
    freedom = 0
    for moves in repeats:
        covariance += jackknife(moves)
        freedom += len(moves) - 1
    if not repeats:
        moves = block_moves(optimum.jacobian, optimum.residual, residuals.block)
        covariance = jackknife(moves)
        freedom = len(moves) - 1
    estimates = {}
    for joint, values in optimum.drives().items():
        columns = optimum.vector.columns[joint]
        estimates[joint] = estimate_parameters(
            optimum.vector.fitted[joint],
            optimum.x[columns],
            covariance[np.ix_(columns, columns)],
            freedom,
            values,
        )
    return estimates


def _parameters_to_hold(
    optimum: Optimum,
    estimates: Mapping[str, Estimate],
    held_names: Mapping[str, Sequence[str]],
    unidentified: Unidentified,
) -> list[tuple[str, str]]:
    """Joints and parameters to hold at the nominal value, because they are not identified.

    The delay is held for all joints at once. It is also held where it would be below zero by no
    more than its interval: no simulator has such a delay.

    Raises:
        IdentifiabilityError: Parameters are not identified and cannot be held: none may be, more
            than `MOST_HELD` of a joint would be, or all would be.
    """
    if unidentified == "flag":
        return []
    fitted = optimum.vector.fitted
    unknown: dict[str, list[str]] = {}
    early = False
    for joint, joint_estimate in estimates.items():
        names = list(joint_estimate.unidentified)
        if "frictionloss" in names and negligible_friction(optimum, joint, joint_estimate):
            names.remove("frictionloss")
        if unidentified == "refuse":
            for name in _confused_parameters(optimum, joint):
                if name not in names:
                    names.append(name)
        if names:
            unknown[joint] = sorted(names, key=fitted[joint].index)
        if "delay" in joint_estimate.ci95:
            low, high = joint_estimate.ci95["delay"]
            early = early or low < joint_estimate.values["delay"] < 0.0 < high
    if unidentified == "hold":
        delay = [(joint, "delay") for joint, names in fitted.items() if "delay" in names]
        delay_unknown = any("delay" in names for names in unknown.values())
        others_remain = all(len(fitted[joint]) > 1 for joint, _ in delay)
        if (delay_unknown or early) and others_remain:
            return delay
    if not unknown:
        return []
    cannot_hold = unidentified == "refuse"
    for joint in unknown:
        count = len({*held_names[joint]} - {"delay"})
        if count >= MOST_HELD or len(fitted[joint]) == 1:
            cannot_hold = True
    if cannot_hold:
        raise _not_identified(unknown, fitted)
    to_hold = []
    for joint, names in unknown.items():
        to_hold.append((joint, min(names, key=HOLD_FIRST.index)))
    return to_hold


def _not_identified(
    unknown: Mapping[str, Sequence[str]], fitted: Mapping[str, Sequence[str]]
) -> IdentifiabilityError:
    """The error that names parameters by joint, those that may be fitted, and what to record."""
    joints = []
    remedies: dict[str, str] = {}
    for joint, names in unknown.items():
        joints.append(f"{joint}: {', '.join(names)}")
        for name in names:
            remedies[name] = PARAMETERS[name].remedy
    remaining = []
    for name in FREE:
        in_all = all(name in names for names in fitted.values())
        if in_all and all(name not in names for names in unknown.values()):
            remaining.append(f"--fit {name}")
    fewer = "fit fewer parameters"
    if remaining:
        fewer = f"fit the others alone ({' '.join(remaining)})"
    return IdentifiabilityError(
        f"these recordings do not identify {'; '.join(joints)}; {fewer}, hold one "
        f"at a known value, or record more: {'; '.join(remedies.values())}."
    )


def _confused_parameters(optimum: Optimum, joint: str) -> list[str]:
    """Fitted parameters of a joint that moved alone and that its recordings cannot distinguish.

    Repeats of a sweep say how well it is repeated, not that other parameters would give it as well:
    stiffness, damping, armature and friction of a joint without gravity may all be twice as large.
    The Jacobian has no effect along such a direction, whatever the noise. Blocks of time of joints
    that moved together differ in pose and load, and show it in the deviation.
    """
    if np.isnan(optimum.residuals.amplitude).any():
        return []
    columns = optimum.jacobian[:, optimum.vector.columns[joint]]
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = 1.0
    _, singular, directions = np.linalg.svd(columns / size, full_matrices=False)
    blind = np.abs(directions[singular < BLIND_RATIO * singular[0]])
    confused = []
    for column, name in enumerate(optimum.vector.fitted[joint]):
        if (blind[:, column] > BLIND_SHARE).any():
            confused.append(name)
    return confused


def _held_out_errors(
    replay: Replay, best: Optimum, nominal: DriveValues, ranges: Ranges
) -> dict[str, dict[str, float]]:
    """Errors of each joint on the samples that are kept out of the fit [rad], by `HELD_OUT`.

    Each drive is fitted to the training samples, from where the fit to everything ended.
    """
    training = training_samples(replay.recordings)
    judging = [~mask for mask in training]
    fitted = best.vector.fitted
    best_drives = best.drives()
    drives: list[DriveValues] = [nominal]
    for allowed in (("delay",), PLAIN, tuple(PARAMETERS)):
        chosen = _restricted(fitted, allowed)
        start = {}
        for joint, names in chosen.items():
            start[joint] = dict(nominal[joint])
            for name in names:
                start[joint][name] = best_drives[joint][name]
        residuals = Residuals(replay, training, DriveVector(chosen, start, ranges))
        drives.append(minimize_residuals(residuals).drives())
    judge = Residuals(replay, judging, best.vector)
    errors: dict[str, dict[str, float]] = {}
    for name, positions in zip(HELD_OUT, replay.positions(drives), strict=True):
        residual = judge.compared(positions)
        for joint in fitted:
            if judge.rows(joint).any():
                errors.setdefault(joint, {})[name] = judge.rmse(residual, joint)
    return errors


def _drive_fit(
    joint: str,
    best: Optimum,
    joint_estimate: Estimate,
    nominal: DriveValues,
    held_names: tuple[str, ...],
    held_out: Mapping[str, float],
) -> DriveFit:
    """Put the findings of one joint together."""
    residuals = best.residuals
    (nominal_positions,) = residuals.replay.positions([nominal])
    nominal_residual = residuals.compared(nominal_positions)
    by_amplitude = _gains_by_amplitude(joint, best)
    return DriveFit(
        joint=joint,
        values=joint_estimate.values,
        sd=joint_estimate.sd,
        ci95=joint_estimate.ci95,
        total95=_total95(joint, best, joint_estimate, by_amplitude),
        covariance=joint_estimate.covariance,
        held=held_names,
        at_bound=best.at_bound(joint),
        held_out=held_out,
        amplitude_gains=by_amplitude,
        rmse=residuals.rmse(best.residual, joint),
        nominal_rmse=residuals.rmse(nominal_residual, joint),
        settled=best.settled,
        flags=(
            *worse_than_less_fitting(held_out, float(np.max(residuals.amplitude))),
            *_parameter_flags(joint, best, joint_estimate, held_names),
            *residuals.replay.remarks(joint),
            *amplitude_flags(by_amplitude),
        ),
    )


def worse_than_less_fitting(held_out: Mapping[str, float], amplitude: float) -> tuple[str, ...]:
    """Warn of a match that is worse on what was held out than less fitting, where it matters.

    Args:
        held_out: Error of each of `HELD_OUT` [rad]; empty where nothing was held out.
        amplitude: Largest amplitude of the command [rad]; NaN where joints moved together.
    """
    if held_out and not np.isnan(amplitude):
        best = min(held_out.values())
        excess = np.sqrt(held_out["matched"] ** 2 - best**2)
        if excess < NOT_WORSE * amplitude:
            return ()
    return held_out_flags(held_out)


def _parameter_flags(
    joint: str, best: Optimum, joint_estimate: Estimate, held_names: Sequence[str]
) -> list[str]:
    """Say which parameters of a joint were held, are at a bound, uncertain or impossible."""
    values = joint_estimate.values
    flags = []
    for name in held_names:
        flags.append(
            f"{name} held at {values[name]:.4g}: these recordings do not identify it; "
            f"{PARAMETERS[name].remedy}"
        )
    at_bound = best.at_bound(joint)
    negligible = negligible_friction(best, joint, joint_estimate)
    for name in at_bound:
        unit = PARAMETERS[name].unit
        flags.append(f"{name} at the bound of the search, {values[name]:.3g} {unit}")
    for name in joint_estimate.unidentified:
        if name not in at_bound and not (name == "frictionloss" and negligible):
            flags.append(
                f"{name} is not identified (deviation {joint_estimate.sd[name]:.2g}); "
                f"{PARAMETERS[name].remedy}"
            )
    if "delay" in joint_estimate.ci95:
        flags.extend(_early_position(joint, best, joint_estimate.ci95["delay"]))
    if not best.settled:
        flags.append("the fit in time did not settle")
    return flags


def _early_position(joint: str, best: Optimum, ci95: tuple[float, float]) -> tuple[str, ...]:
    """Say that the position leads its command, and why where that can be told.

    The timestamps of a log are right to a sample, and the drive laws of two simulators, or of one
    and a real drive, differ by up to a step of the simulator: an explicit step answers half a step
    later than a drive without steps. So the delay counts as negative where it is so by a sample
    and a step more than its interval. A fit that leaves some of the motion unexplained shifts in
    time to make up for it; then nothing is said of the cause.

    Args:
        joint: The joint.
        best: The fit.
        ci95: Interval of the delay [s].
    """
    residuals = best.residuals
    samples = [recording for recording in residuals.replay.recordings if recording.joint == joint]
    period_s = max(float(np.median(np.diff(recording.time))) for recording in samples)
    if ci95[1] + period_s + residuals.replay.step_s >= 0.0:
        return ()
    delay_s = best.drives()[joint]["delay"]
    lead = (
        f"lead: the position leads the command of the log by {-1e3 * delay_s:.1f} ms; the delay of "
        "the gains is 0, and they hold for commands that are logged as late"
    )
    amplitude = float(np.max(residuals.amplitude))
    explained = residuals.rmse(best.residual, joint) < EXPLAINED_LEAD * amplitude
    if explained and "effort_limit" not in best.vector.fitted[joint]:
        return (f"{lead}: the command column was delayed or filtered before it was logged",)
    return (lead,)


def negligible_friction(best: Optimum, joint: str, joint_estimate: Estimate) -> bool:
    """Tell whether the dry friction of a joint that moved alone is too little to matter.

    Its relative deviation says nothing then: of a joint without friction it is large, although the
    friction is known to be next to nothing. Its value and two deviations are compared with the
    torque that the largest command asks for.
    """
    amplitude = float(np.max(best.residuals.amplitude))
    if "frictionloss" not in joint_estimate.sd or np.isnan(amplitude):
        return False
    values = joint_estimate.values
    largest = values["frictionloss"] * (1.0 + 2.0 * joint_estimate.sd["frictionloss"])
    return largest < NEGLIGIBLE_FRICTION * values["stiffness"] * amplitude


def _gains_by_amplitude(joint: str, best: Optimum) -> Array:
    """Amplitude, stiffness and damping of each amplitude, the largest first, shape (m, 3).

    By one linear step from the common optimum, with the residuals of this amplitude alone and all
    other parameters held. Empty for joints that moved together.
    """
    amplitudes = best.residuals.amplitude
    if np.isnan(amplitudes).any():
        return np.empty((0, 3))
    columns = []
    for name in GAINS:
        if name in best.vector.fitted[joint]:
            columns.append(best.vector.column(joint, name))
    gains = []
    for amplitude in dict.fromkeys(amplitudes.tolist()):
        rows = amplitudes == amplitude
        x = best.x.copy()
        inverse = np.linalg.pinv(best.jacobian[rows][:, columns])
        x[columns] -= inverse @ best.residual[rows]
        drive = best.vector.drives(x)[joint]
        gains.append((amplitude, drive["stiffness"], drive["damping"]))
    return np.array(gains)


def _total95(
    joint: str, best: Optimum, joint_estimate: Estimate, by_amplitude: Array
) -> dict[str, tuple[float, float]]:
    """95 % intervals of a joint that cover what the model does not explain.

    Those of joints that moved together are by blocks of time, and total already.
    """
    residuals = best.residuals
    if len(by_amplitude) == 0:
        return dict(joint_estimate.ci95)
    columns = best.vector.columns[joint]
    moves = block_moves(best.jacobian, best.residual, residuals.block)
    intervals = total_intervals(
        best.vector.fitted[joint],
        best.x[columns],
        joint_estimate.ci95,
        moves[:, columns],
        by_amplitude,
    )
    misfit = residuals.misfit(best.residual, joint) / float(np.max(residuals.amplitude))
    intervals = widen_by_misfit(intervals, joint_estimate.values, misfit)
    if "delay" in intervals:
        low, high = intervals["delay"]
        earlier, later = residuals.replay.uncertain_s
        intervals["delay"] = (low - later, high + earlier)
    return intervals
