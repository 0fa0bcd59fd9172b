"""The result of a match, joint by joint, and its file `match.npz`.

`gains.yaml` beside it holds what training needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pronk.arrays import Array, ComplexArray
from pronk.errors import ArtefactError
from pronk.files import load_artefact, save_artefact
from pronk.frames import data_frame
from pronk.identify.match.compared import ComparedResponses
from pronk.identify.match.gains import (
    NAN,
    UNKNOWN,
    FittedValue,
    GroupGains,
    JointGains,
    MatchedGains,
    MatchQuality,
    TorqueParameter,
)
from pronk.identify.match.parameters import GAINS, PARAMETERS
from pronk.identify.simulators.info import SimulatorInfo
from pronk.robots.model import bench_inertia
from pronk.robots.robot import Joint, RobotSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

SCHEMA = "pronk/match/4"
NO_MATCH = "no match: "
"""Beginning of the flag on gains with which the simulated response is not the measured one."""
NOT_BETTER = "not better: "
"""Beginning of the flag on a match that is no better than less fitting on what was held out of the
fit: the last repeat of each command, or blocks of time where nothing was repeated."""
_NOT_BETTER = 1.02
"""Held-out error over that of the best of the other drives from which on a match is not better:
where the model's friction is right all fits are equal but for noise."""
_LESS_FITTING = {
    "nominal": "the nominal gains",
    "nominal_delayed": "the nominal gains with the best delay",
    "plain": "a plain fit of the gains and the delay",
}
HELD_OUT = (*_LESS_FITTING, "matched")
"""Drives whose errors on what was held out are compared."""
DAMPING_RATIO_SD_MAX = 0.025
"""Standard deviation of a damping over the critical damping up to which it counts as identified
however small it is. At 95 % the damping ratio is then known to 0.05, a tenth of what servos of
legged robots have."""
SPREAD_MAX = 0.05
"""Relative change of stiffness between amplitudes that is worth a flag; the paper's own
randomization is 2 N m/rad on 20 (D3), twice that."""


def _no_numbers(*shape: int) -> Array:
    return np.full(shape, np.nan)


@dataclass(frozen=True, kw_only=True)
class DriveFit:
    """Parameters of one joint's drive with what they rest on."""

    joint: str
    """Name of the joint."""
    values: Mapping[str, float]
    """Every parameter by name, fitted or held. A delay may be below zero."""
    sd: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of each fitted parameter: relative, of delay and offset in [s], [rad]."""
    ci95: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """95 % interval of each fitted parameter by the repeats alone; where nothing was repeated, by
    blocks of time, or by the coherence with method `paper`."""
    total95: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """95 % interval of each fitted parameter with what the model does not explain: the change
    between amplitudes and between parts of the log. That of joints that moved together is `ci95`,
    by blocks of time; empty with method `paper`."""
    covariance: Array = field(default_factory=lambda: _no_numbers(2, 2))
    """Covariance of (stiffness, damping) by what `ci95` is by, zero for what was held,
    shape (2, 2)."""
    held: tuple[str, ...] = ()
    """Parameters held at their nominal value because the logs do not identify them."""
    at_bound: tuple[str, ...] = ()
    """Fitted parameters that ended at a bound of the search."""
    held_out: Mapping[str, float] = field(default_factory=dict)
    """Root mean square error of the drives `HELD_OUT` on the samples that `training_samples` keeps
    out of the fit, repeats or blocks of time [rad]."""
    amplitude_gains: Array = field(default_factory=lambda: _no_numbers(0, 3))
    """(amplitude, stiffness, damping) of each amplitude, the largest first, shape (m, 3): by one
    linear step from the common optimum of a fit in time, fitted by itself with method `paper`."""
    rmse: float = NAN
    """Root mean square error of the position in time, weighted as the fit weights it [rad]."""
    nominal_rmse: float = NAN
    """Root mean square error of the position in time with the nominal gains [rad]."""
    settled: bool = True
    """False if the search ended without reaching its tolerance."""
    torque: Mapping[str, TorqueParameter] = field(default_factory=dict)
    """Parameters of the drive by a torque channel."""
    flags: tuple[str, ...] = ()
    """Sentences that warn of this fit."""

    @property
    def moved_together(self) -> bool:
        """True if the joint was fitted in time while other joints moved."""
        return bool(np.isfinite(self.rmse)) and len(self.amplitude_gains) == 0

    def __post_init__(self) -> None:
        """Refuse arrays of other shapes."""
        if np.shape(self.covariance) != (2, 2):
            raise ValueError(f"covariance of {self.joint} has no shape (2, 2)")
        if np.ndim(self.amplitude_gains) != 2 or np.shape(self.amplitude_gains)[1] != 3:
            raise ValueError(f"amplitude_gains of {self.joint} have no shape (m, 3)")


@dataclass(frozen=True, kw_only=True)
class GridSearch:
    """Error over the paper's grid of gains, and its best node."""

    stiffness: Array
    """Axis [N m/rad], shape (a,)."""
    damping: Array
    """Axis [N m s/rad], shape (b,)."""
    error: Array
    """Mean squared error of the gain in the band [dB^2], shape (a, b)."""

    def __post_init__(self) -> None:
        """Refuse a map that does not fit its axes."""
        expected = (len(self.stiffness), len(self.damping))
        if np.shape(self.error) != expected:
            raise ValueError(f"error has shape {np.shape(self.error)}; expected {expected}")

    @property
    def cell(self) -> tuple[int, int]:
        """Indices of the best node."""
        row, column = np.unravel_index(int(np.argmin(self.error)), self.error.shape)
        return int(row), int(column)

    @property
    def gains(self) -> tuple[float, float]:
        """Stiffness [N m/rad] and damping [N m s/rad] of the best node."""
        row, column = self.cell
        return float(self.stiffness[row]), float(self.damping[column])

    @property
    def error_db(self) -> float:
        """Root mean square error at the best node [dB]."""
        return float(np.sqrt(np.min(self.error)))

    @property
    def at_edge(self) -> bool:
        """True if the best node lies on the border: the optimum may lie beyond."""
        row, column = self.cell
        rows, columns = self.error.shape
        return row in (0, rows - 1) or column in (0, columns - 1)


@dataclass(frozen=True, kw_only=True)
class ZeroArmature:
    """Best match without rotor inertia (paper F13)."""

    error_db: float
    """Smallest root mean square gain error over the grid [dB]."""
    response: ComplexArray
    """Simulated response with the gains of that error, shape (f,)."""
    ruled_out: bool
    """True if no gains match without rotor inertia. A light rotor on a heavy link is not ruled
    out: other gains make up for it."""


@dataclass(frozen=True, kw_only=True)
class JointResult:
    """How one joint was matched."""

    joint: str
    """Name of the joint."""
    gains: JointGains
    """Gains that training needs, with their errors and flags."""
    fit: DriveFit
    """Fit of the drive that the gains are from."""
    drive_gains: tuple[float, float] | None = None
    """Stiffness [N m/rad] and damping [N m s/rad] that were on the real drive, as the logs or the
    options state them; None where torque alone was fitted."""
    responses: ComparedResponses | None = None
    """Measured and simulated responses; None where no response could be estimated."""
    grid: GridSearch | None = None
    """Search of the grid; None but with method `paper`."""
    zero_armature: ZeroArmature | None = None
    """Search without rotor inertia; None where it was not searched."""

    def __repr__(self) -> str:
        """Describe the joint in a line."""
        return (
            f"JointResult({self.joint}: {self.gains.stiffness.value:.4g} N m/rad, "
            f"{self.gains.damping.value:.4g} N m s/rad, "
            f"error {self.gains.quality.error_db:.2f} dB, "
            f"{len(self.gains.flags)} flags)"
        )


@dataclass(frozen=True, kw_only=True)
class MatchResult:
    """Result of a match for one simulator."""

    robot: str
    """Name of the robot."""
    simulator: SimulatorInfo
    """Simulator that the gains hold for."""
    joints: Mapping[str, JointResult]
    """Results by joint, in the robot's order."""
    groups: Mapping[str, GroupGains]
    """Training gains and ranges by joint group."""
    logs: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 by file name of every log that went in."""
    virtual: bool = False
    """True if a log came from pronk's virtual robot."""
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Reasons by joint for joints that moved and were not matched."""
    robot_path: str = ""
    """File of the robot; empty for a robot that ships with pronk."""
    gain_uncertainty: float = NAN
    """Relative uncertainty of the stated gains in the intervals of physical values (mode `drive`).
    """
    notes: tuple[str, ...] = ()
    """Sentences on the logs: gaps, jitter, short excitations. They weaken no gain by themselves."""

    @property
    def gains(self) -> MatchedGains:
        """Gains as they are saved in `gains.yaml`, exported and predicted with."""
        return MatchedGains(
            robot=self.robot,
            simulator=self.simulator,
            joints={name: joint.gains for name, joint in self.joints.items()},
            groups=self.groups,
            logs=self.logs,
            virtual=self.virtual,
            robot_path=self.robot_path,
        )

    @property
    def flags(self) -> dict[str, tuple[str, ...]]:
        """Sentences that warn of a joint, by joint; joints without a warning are left out."""
        flags = {}
        for name, joint in self.joints.items():
            if joint.gains.flags:
                flags[name] = joint.gains.flags
        return flags

    @property
    def matched_joints(self) -> tuple[str, ...]:
        """Names of the joints that are a match (`JointGains.matched`)."""
        matched = []
        for name, joint in self.joints.items():
            if joint.gains.matched:
                matched.append(name)
        return tuple(matched)

    def joints_of_groups(self, robot_joints: Mapping[str, Joint]) -> dict[str, list[str]]:
        """Return the names of the matched joints of each joint group, in the robot's order.

        Args:
            robot_joints: The robot's joints by name. One that is not known, as of a robot whose
                file is gone, belongs to the group whose name its own ends with.
        """
        members: dict[str, list[str]] = {}
        for group in self.groups:
            members[group] = []
            for name in self.joints:
                if name in robot_joints:
                    belongs = robot_joints[name].group == group
                else:
                    belongs = name.endswith(group)
                if belongs:
                    members[group].append(name)
        return members

    @property
    def not_better(self) -> bool:
        """True if a joint is no better than less fitting on what was held out of its fit."""
        for flags in self.flags.values():
            if any(flag.startswith(NOT_BETTER) for flag in flags):
                return True
        return False

    @property
    def error_db(self) -> float:
        """Root mean square over the joints of the error with the matched gains [dB]."""
        errors_db = []
        for joint in self.joints.values():
            errors_db.append(joint.gains.quality.error_db)
        return rms_of_finite(errors_db)

    @property
    def nominal_error_db(self) -> float:
        """Root mean square over the joints of the error with the nominal gains [dB]."""
        errors_db = []
        for joint in self.joints.values():
            errors_db.append(joint.gains.quality.nominal_error_db)
        return rms_of_finite(errors_db)

    @property
    def worst_joint(self) -> str:
        """Name of the joint with the largest error in its band; empty where none is known."""
        errors = {}
        for name, joint in self.joints.items():
            if np.isfinite(joint.gains.quality.error_db):
                errors[name] = joint.gains.quality.error_db
        return max(errors, key=errors.__getitem__, default="")

    def summary(self) -> dict[str, Any]:
        """Return how many joints were matched, the errors over all joints, and every flag."""
        return {
            "robot": self.robot,
            "virtual": self.virtual,
            "joints": len(self.joints),
            "matched": len(self.matched_joints),
            "nominal_error_db": self.nominal_error_db,
            "error_db": self.error_db,
            "worst": self.worst_joint,
            "flags": self.flags,
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the match as a dictionary of numbers, text and dictionaries.

        The keys are `robot`, `virtual`, `simulator`, `joints`, `groups` and `excluded`;
        a joint has the fields of `JointGains`, its `held_out` errors and its `grid` optimum.
        """
        joints = {}
        for name, joint in self.joints.items():
            figures = asdict(joint.gains)
            figures["held_out"] = dict(joint.fit.held_out)
            figures["grid"] = None if joint.grid is None else joint.grid.gains
            figures["zero_armature_error_db"] = None
            if joint.zero_armature is not None:
                figures["zero_armature_error_db"] = joint.zero_armature.error_db
            joints[name] = figures
        return {
            "robot": self.robot,
            "virtual": self.virtual,
            "simulator": asdict(self.simulator),
            "joints": joints,
            "groups": {name: asdict(group) for name, group in self.groups.items()},
            "excluded": dict(self.excluded),
        }

    def to_dataframe(self) -> DataFrame:
        """Return the gains as a data frame of pandas, a row for each joint.

        Each gain has its value and the ends of its 95 % interval (`FittedValue.total95`); the names
        of the columns end with the unit.

        Raises:
            PronkError: pandas is not installed.
        """
        columns: dict[str, list[Any]] = {
            "joint": [],
            "matched": [],
            "error_db": [],
            "nominal_error_db": [],
        }
        for joint, result in self.joints.items():
            gains = result.gains
            columns["joint"].append(joint)
            columns["matched"].append(gains.matched)
            columns["error_db"].append(gains.quality.error_db)
            columns["nominal_error_db"].append(gains.quality.nominal_error_db)
            fitted_values = (
                ("stiffness", "_nm_per_rad", gains.stiffness),
                ("damping", "_nms_per_rad", gains.damping),
                ("armature", "_kgm2", gains.armature),
                ("frictionloss", "_nm", gains.frictionloss),
                ("stribeck", "", gains.stribeck),
                ("delay", "_s", gains.delay_s),
            )
            for name, unit, fitted in fitted_values:
                low, high = fitted.total95
                columns.setdefault(f"{name}{unit}", []).append(fitted.value)
                columns.setdefault(f"{name}_low{unit}", []).append(low)
                columns.setdefault(f"{name}_high{unit}", []).append(high)
        columns["coherence_min"] = []
        columns["flags"] = []
        for result in self.joints.values():
            columns["coherence_min"].append(result.gains.quality.coherence_min)
            columns["flags"].append(" ".join(result.gains.flags))
        return data_frame(columns)

    def plot(self, joint: str | None = None) -> Figure:
        """Draw the measured and the simulated gain and phase.

        Args:
            joint: The joint; all joints if None, their gain alone.

        Returns:
            A matplotlib figure; `figure.savefig("bode.svg")` writes it.

        Raises:
            ArtefactError: No response of the joint, or of any joint, was estimated.
        """
        from pronk.identify.match.plot import plot_all_gains, plot_response

        responses = {}
        for name, result in self.joints.items():
            if result.responses is not None and joint in (None, name):
                responses[name] = result.responses
        if not responses:
            raise ArtefactError(
                f"no response of {joint or 'any joint'} to draw; the joints of this match are "
                f"{', '.join(self.joints)}."
            )
        if joint is None:
            return plot_all_gains(responses)
        return plot_response(responses[joint], title=joint)

    def __repr__(self) -> str:
        """Describe the match in a line for each joint."""
        lines = [f"MatchResult of {self.robot} for {self.simulator.engine}:"]
        lines.extend(f"  {joint!r}" for joint in self.joints.values())
        return "\n".join(lines)


def rms_of_finite(values: Sequence[float]) -> float:
    """Return the root mean square of the finite values; NaN without any."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.sqrt(np.mean(np.square(finite)))) if finite else NAN


def save_match(path: Path, result: MatchResult) -> None:
    """Write `match.npz`, whole or not at all."""
    save_artefact(path, result, SCHEMA)


def load_match(path: Path) -> MatchResult:
    """Read what `save_match` wrote.

    Raises:
        ArtefactError: Another file, or one of another schema.
    """
    return load_artefact(path, MatchResult, SCHEMA, what="a match file", writer="pronk match")


def joint_gains(
    fit: DriveFit,
    robot: RobotSpec,
    responses: ComparedResponses | None = None,
    flags: Sequence[str] = (),
) -> JointGains:
    """Return the part of a joint's result that training needs, and whether it is a match.

    A joint is no match if a flag says so (`NO_MATCH`), or if the logs do not identify one of its
    gains (`unidentified_gains`).

    Args:
        fit: The fit of the drive.
        robot: The robot.
        responses: Compared responses, if there are any.
        flags: Sentences that warn of this joint beside those of the fit.
    """
    spread = amplitude_spread(fit.amplitude_gains)
    quality = MatchQuality(amplitude_spread=spread)
    if responses is not None:
        quality = MatchQuality(
            band_hz=responses.band_hz,
            error_db=responses.error_db,
            nominal_error_db=responses.nominal_error_db,
            coherence_min=responses.coherence_min,
            amplitude_spread=spread,
        )
    all_flags = (*fit.flags, *flags)
    reasons = []
    for flag in all_flags:
        if flag.startswith(NO_MATCH):
            reasons.append(flag.removeprefix(NO_MATCH))
    for name in unidentified_gains(fit, robot):
        reasons.append(f"the logs do not identify its {name}")
    stiffness_row, damping_row = fit.covariance.tolist()
    return JointGains(
        stiffness=_fitted_value(fit, "stiffness"),
        damping=_fitted_value(fit, "damping"),
        armature=_fitted_value(fit, "armature"),
        frictionloss=_fitted_value(fit, "frictionloss"),
        stribeck=_fitted_value(fit, "stribeck"),
        delay_s=_delay_not_negative(_fitted_value(fit, "delay")),
        covariance=(tuple(stiffness_row), tuple(damping_row)),
        quality=quality,
        torque=fit.torque,
        flags=all_flags,
        matched=not reasons,
        reasons=tuple(reasons),
    )


def unidentified_gains(fit: DriveFit, robot: RobotSpec) -> list[str]:
    """Name the fitted gains of a joint that its logs do not identify.

    A gain is identified if its relative standard deviation is no more than `Parameter.sd_max`. A
    stiffness that was held at its nominal value is none, for the logs do not identify it. A
    damping is also identified if its deviation is small beside that of a critically damped joint,
    `2 sqrt(stiffness inertia)`: a drive may have no damping of its own.

    Args:
        fit: The fit of the drive, with the covariance of its gains.
        robot: The robot, which has the inertia of the joint.
    """
    unidentified = []
    if "stiffness" in fit.held:
        unidentified.append("stiffness")
    for index, name in enumerate(GAINS):
        if name not in fit.ci95:
            continue
        deviation = float(np.sqrt(fit.covariance[index, index]))
        if np.isnan(deviation) or deviation <= PARAMETERS[name].sd_max * fit.values[name]:
            continue
        if name == "damping":
            inertia, _ = bench_inertia(robot, robot.joint(fit.joint).original[0])
            critical = 2.0 * np.sqrt(fit.values["stiffness"] * inertia)
            if deviation <= DAMPING_RATIO_SD_MAX * critical:
                continue
        unidentified.append(name)
    return unidentified


def _fitted_value(fit: DriveFit, name: str) -> FittedValue:
    """Return a parameter of a fit with its intervals."""
    return FittedValue(
        value=fit.values[name],
        repeat95=fit.ci95.get(name, UNKNOWN),
        total95=fit.total95.get(name, UNKNOWN),
    )


def _delay_not_negative(fitted: FittedValue) -> FittedValue:
    """Return a delay that a simulator can have, with intervals that hold it.

    A fitted delay below zero becomes zero, and its intervals end there. An interval that is below
    zero as a whole is dropped: the delay of the gains is then set to zero and not fitted.

    Args:
        fitted: The delay as it was fitted [s].
    """
    intervals = []
    for low, high in (fitted.repeat95, fitted.total95):
        if high < 0.0:
            intervals.append(UNKNOWN)
        elif low < 0.0:
            intervals.append((0.0, high))
        else:
            intervals.append((low, high))
    repeat95, total95 = intervals
    return FittedValue(value=max(fitted.value, 0.0), repeat95=repeat95, total95=total95)


def amplitude_spread(gains: Array) -> float:
    """Return the largest relative change of stiffness from the largest amplitude.

    Args:
        gains: Rows of (amplitude, stiffness, damping), the largest amplitude first, shape (m, 3).

    Returns:
        The change; NaN with one amplitude.
    """
    if len(gains) < 2:
        return NAN
    return float(np.abs(gains[1:, 1] / gains[0, 1] - 1.0).max())


def amplitude_flags(gains: Array) -> tuple[str, ...]:
    """Warn of gains, shape (m, 3), that change with the amplitude, as dry friction makes them."""
    spread = amplitude_spread(gains)
    if not spread > SPREAD_MAX:
        return ()
    largest = gains[:, 0].max()
    smallest = gains[:, 0].min()
    change = "more than tenfold" if spread > 10.0 else f"by {100.0 * spread:.0f} %"
    return (
        f"amplitude: stiffness changes {change} between {smallest:.3g} and "
        f"{largest:.3g} rad, which this model of dry friction does not explain; match at the "
        "amplitude that the policy will use",
    )


def held_out_flags(errors: Mapping[str, float]) -> tuple[str, ...]:
    """Warn of a match that is no better on what was held out than less or no fitting.

    Args:
        errors: Root mean square error of each of the drives `HELD_OUT` on repeats or blocks of time
            that the fit did not see [rad]; empty where nothing was held out.
    """
    if not errors:
        return ()
    best = min(_LESS_FITTING, key=errors.__getitem__)
    if errors["matched"] <= _NOT_BETTER * errors[best]:
        return ()
    return (
        f"{NOT_BETTER}on what was kept aside it misses by {1e3 * errors['matched']:.2f} mrad, "
        f"{_LESS_FITTING[best]} by {1e3 * errors[best]:.2f} mrad; use those, or record more "
        "amplitudes",
    )
