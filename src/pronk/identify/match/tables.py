"""Tables of a match, for the terminal and the page alike."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from pronk.identify.match.gains import FittedValue
from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.match.ranges import range_notes
from pronk.identify.match.result import MatchResult
from pronk.identify.match.torque_fit import UNITS
from pronk.tables import Cell, Column, Table


def gains_table(result: MatchResult) -> Table:
    """Make the table of the matched gains, one joint a row; columns without a value are left out.

    Intervals by the repeats alone (`FittedValue.repeat95`) are followed by those with what the
    model does not explain.
    """
    has_total = False
    has_friction = False
    has_stribeck = False
    has_delay = False
    has_grid = False
    for joint in result.joints.values():
        gains = joint.gains
        has_total = has_total or bool(np.isfinite(gains.stiffness.total95).all())
        has_friction = has_friction or bool(np.isfinite(gains.frictionloss.value))
        has_stribeck = has_stribeck or gains.stribeck.value > 0.0
        has_delay = has_delay or gains.delay_s.value > 0.0
        has_grid = has_grid or joint.grid is not None

    columns = [Column(heading="joint")]
    stiffnesses = [joint.gains.stiffness.value for joint in result.joints.values()]
    dampings = [joint.gains.damping.value for joint in result.joints.values()]
    for name, unit, values, fewest in (
        ("stiffness", "N m/rad", stiffnesses, 2),
        ("damping", "N m s/rad", dampings, 3),
    ):
        digits = decimals(values, fewest)
        columns.append(Column(heading=name, unit=unit, digits=digits))
        columns.append(Column(heading="repeat 95 %" if has_total else "95 %", digits=digits))
        if has_total:
            columns.append(Column(heading="total 95 %", digits=digits))
    if has_friction:
        columns.append(Column(heading="friction", unit="N m"))
    if has_stribeck:
        columns.append(Column(heading="in motion", unit="N m"))
    if has_delay:
        columns.append(Column(heading="delay", unit="ms", digits=1))
    if has_grid:
        columns.append(Column(heading="best of the grid"))
    columns.append(Column(heading="nominal error", unit="dB", digits=2))
    columns.append(Column(heading="error", unit="dB", digits=2))
    columns.append(Column(heading="lowest coherence"))

    rows = []
    for name, joint in result.joints.items():
        gains = joint.gains
        quality = gains.quality
        row: list[Cell] = [f"{name} (flagged)" if gains.flags else name]
        for fitted in (gains.stiffness, gains.damping):
            row.append(fitted.value)
            row.append(fitted.repeat95)
            if has_total:
                row.append(fitted.total95)
        if has_friction:
            row.append(gains.frictionloss.value)
        if has_stribeck:
            row.append(gains.frictionloss.value * (1.0 - gains.stribeck.value))
        if has_delay:
            row.append(1000.0 * gains.delay_s.value)
        if has_grid:
            row.append(None if joint.grid is None else "{:.2f} / {:.3f}".format(*joint.grid.gains))
        row.append(quality.nominal_error_db)
        row.append(quality.error_db)
        row.append(quality.coherence_min)
        rows.append(tuple(row))

    simulator = result.simulator
    notes = [
        f"Equivalent gains of {simulator.engine} at a step of {1000.0 * simulator.timestep_s:g} ms "
        "and with the inertia of this model, not the gains of the drive itself."
    ]
    if has_total:
        notes.append(
            "repeat: spread of the repeats. total: also the change between amplitudes and between "
            "parts of the excitation."
        )
    notes.extend(dead_band_notes(result))
    return Table(
        title="Matched gains", columns=tuple(columns), rows=tuple(rows), notes=tuple(notes)
    )


def decimals(values: Sequence[float], fewest: int) -> int:
    """Return how many decimals show three significant digits of the smallest of some values."""
    positive = [value for value in values if value > 0.0]
    if not positive:
        return fewest
    return max(fewest, 2 - int(np.floor(np.log10(min(positive)))))


OF_STATED_INERTIA = (
    "Gains and intervals hold for the inertia in the robot's file: a motion tells gains over "
    "inertia alone."
)
"""What no motion shows: with a heavier link and larger gains by the same factor it is the same."""


def gains_summary_table(result: MatchResult) -> Table:
    """Make the table of the matched gains that fits a terminal of 80 columns.

    Values are with half the width of their total 95 % interval, or of that by repeats where there
    is no total one.
    """
    rows: list[tuple[Cell, ...]] = []
    for name, joint in result.joints.items():
        gains = joint.gains
        row = (
            name,
            value_and_interval(gains.stiffness),
            value_and_interval(gains.damping),
            value_and_interval(gains.frictionloss),
            value_and_interval(gains.delay_s.scaled(1000.0), digits=1),
            gains.quality.error_db,
        )
        rows.append(row)
    columns = (
        Column(heading="joint"),
        Column(heading="stiffness", unit="N m/rad"),
        Column(heading="damping", unit="N m s/rad"),
        Column(heading="friction", unit="N m"),
        Column(heading="delay", unit="ms"),
        Column(heading="error", unit="dB", digits=2),
    )
    return Table(
        title="Matched gains",
        columns=columns,
        rows=tuple(rows),
        notes=(OF_STATED_INERTIA, *dead_band_notes(result)),
    )


def dead_band_notes(result: MatchResult) -> tuple[str, ...]:
    """Say how far each joint stays from its command by its dry friction alone, one sentence.

    A joint stops anywhere within `friction / stiffness` of its command, on either side. Backlash
    gives the same band; another stiffness changes the band of friction and leaves that of backlash.
    """
    joints = []
    for name, joint in result.joints.items():
        gains = joint.gains
        if gains.frictionloss.value > 0.0 and gains.stiffness.value > 0.0:
            band = np.rad2deg(2.0 * gains.frictionloss.value / gains.stiffness.value)
            joints.append(f"{name} {band:.2g}")
    if not joints:
        return ()
    return (
        f"Dead band by dry friction, 2 x friction / stiffness [deg]: {', '.join(joints)}. Logs "
        "with two stiffnesses tell it from backlash, whose band does not change.",
    )


def value_and_interval(fitted: FittedValue, digits: int | None = None) -> str:
    """Return a value with half the width of its 95 % interval, as in `25.20 +- 0.18`.

    Args:
        fitted: The value with its intervals.
        digits: Digits after the point; two significant digits of the interval if None, or four
            significant digits of a value without one.
    """
    if not math.isfinite(fitted.value):
        return "-"
    half_width = math.nan
    for low, high in (fitted.total95, fitted.repeat95):
        if not math.isfinite(half_width):
            half_width = 0.5 * (high - low)
    if not math.isfinite(half_width):
        return f"{fitted.value:.4g}" if digits is None else f"{fitted.value:.{digits}f}"
    if digits is None:
        size = half_width if half_width > 0.0 else 1e-3 * abs(fitted.value)
        digits = 3
        if size > 0.0:
            digits = min(max(1 - math.floor(math.log10(size)), 0), 6)
    return f"{fitted.value:.{digits}f} +- {half_width:.{digits}f}"


def ranges_table(result: MatchResult, members: Mapping[str, Sequence[str]]) -> Table:
    """Make the table of what training draws from, one joint group a row.

    Args:
        result: The match.
        members: Names of the matched joints of each group.
    """
    rows: list[tuple[Cell, ...]] = []
    for name, group in result.groups.items():
        stiffness = f"{group.stiffness:.4g} ± {group.stiffness_range:.3g}"
        damping = f"{group.damping:.4g} ± {group.damping_range:.3g}"
        rows.append((name, stiffness, damping, ", ".join(members[name])))
    columns = (
        Column(heading="group"),
        Column(heading="stiffness", unit="N m/rad"),
        Column(heading="damping", unit="N m s/rad"),
        Column(heading="joints"),
    )
    notes = range_notes(result.groups, members, result.gains.joints)
    return Table(title="Training ranges", columns=columns, rows=tuple(rows), notes=notes)


def drives_table(result: MatchResult) -> Table:
    """Make the table of every fitted parameter of each drive, by position and by torque.

    By position a drive has physical values where they are known, and their equivalents in the law
    of the simulator.
    """
    rows: list[tuple[Cell, ...]] = []
    unidentified: list[str] = []
    has_torque = False
    has_physical = False
    has_equivalent = False
    for joint_name, joint in result.joints.items():
        fit = joint.fit
        for name, parameter in PARAMETERS.items():
            if name not in fit.ci95:
                continue
            has_equivalent = True
            label = f"{name} [{parameter.unit}]"
            equivalent = f"{fit.values[name]:.3g}"
            physical = joint.gains.physical.get(name)
            if physical is None:
                low, high = fit.total95.get(name, fit.ci95[name])
                interval = f"{low:.3g} to {high:.3g} (equivalent)"
                rows.append((joint_name, label, None, interval, equivalent, "position"))
                continue
            has_physical = True
            low, high = physical.total95
            value = f"{physical.value:.3g}"
            interval = f"{low:.3g} to {high:.3g}"
            rows.append((joint_name, label, value, interval, equivalent, "position"))
        for term, by_torque in joint.gains.torque.items():
            has_torque = True
            label = f"{term} [{UNITS[term]}]"
            if by_torque.identified:
                low, high = by_torque.ci95
                value = f"{by_torque.value:.3g}"
                rows.append((joint_name, label, value, f"{low:.3g} to {high:.3g}", None, "torque"))
            else:
                rows.append((joint_name, label, None, "not identified", None, "torque"))
                unidentified.append(
                    f"{joint_name}, {term}: not identified by torque: {by_torque.reason}"
                )
    columns = (
        Column(heading="joint"),
        Column(heading="parameter"),
        Column(heading="value"),
        Column(heading="95 %"),
        Column(heading="equivalent"),
        Column(heading="by"),
    )
    notes = unidentified
    simulator = result.simulator
    if has_equivalent:
        notes.append(
            f"equivalent: what {simulator.engine} needs in its {simulator.law} law at a step of "
            f"{1000.0 * simulator.timestep_s:g} ms to move alike; no property of the drive."
        )
    if has_physical:
        notes.append(
            "value: of the drive itself, for the stated stiffness and the links of the model. 95 % "
            f"counts that stiffness and torque constant may be {100.0 * result.gain_uncertainty:g} "
            "% off (--gain-uncertainty; recordings of AK80-6 drives: 20 %)."
        )
    if has_torque:
        notes.append(
            "scale: torque column over the joint's torque. dry and viscous: friction of the joint. "
            "Where the scale is not identified, values by torque are in the column's unit of "
            "torque. The column is taken for measured torque; a commanded one is not what the "
            "drive gave.",
        )
    return Table(title="Fitted drives", columns=columns, rows=tuple(rows), notes=tuple(notes))


def positions_table(result: MatchResult) -> Table:
    """Make the table of position errors where several joints moved at once."""
    rows: list[tuple[Cell, ...]] = []
    for name, joint in result.joints.items():
        if joint.fit.moved_together:
            rows.append((name, joint.fit.nominal_rmse, joint.fit.rmse))
    columns = (
        Column(heading="joint"),
        Column(heading="RMSE nominal", unit="rad", digits=4),
        Column(heading="RMSE matched", unit="rad", digits=4),
    )
    title = "Several joints moved at once, so the whole arm was fitted in time"
    return Table(title=title, columns=columns, rows=tuple(rows))


def simulators_table(
    results: Mapping[str, MatchResult], members: Mapping[str, Sequence[str]]
) -> Table:
    """Make the table of the means of each joint group in several simulators.

    Args:
        results: Matches of the same logs by the name of the simulator.
        members: Names of the matched joints of each group.
    """
    rows: list[tuple[Cell, ...]] = []
    for simulator, result in results.items():
        for group, names in members.items():
            values = []
            flagged = 0
            for name in names:
                gains = result.joints[name].gains
                values.append(
                    (
                        gains.stiffness.value,
                        gains.damping.value,
                        gains.frictionloss.value,
                        gains.delay_s.value,
                        gains.quality.error_db,
                    )
                )
                flagged += bool(gains.flags)
            rows.append((simulator, group, *np.mean(values, axis=0).tolist(), flagged))
    columns = (
        Column(heading="framework"),
        Column(heading="group"),
        Column(heading="stiffness", unit="N m/rad"),
        Column(heading="damping", unit="N m s/rad"),
        Column(heading="friction", unit="N m"),
        Column(heading="delay", unit="s", digits=4, is_detail=True),
        Column(heading="error", unit="dB", digits=2),
        Column(heading="flagged", is_detail=True),
    )
    title = "The same joints in every framework, means of each group"
    return Table(title=title, columns=columns, rows=tuple(rows))
