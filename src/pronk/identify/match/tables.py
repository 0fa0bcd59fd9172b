"""Tables of a match, for the terminal and the page alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pronk.identify.match.gains import JointGains
from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.match.result import MatchResult
from pronk.identify.match.torque_fit import UNITS
from pronk.tables import Cell, Column, Table


def gains_table(result: MatchResult) -> Table:
    """Make the table of the matched gains, one joint a row; columns that are empty are left out."""
    gains = [joint.gains for joint in result.joints.values()]
    has_total = any(np.isfinite(one.stiffness.total95).all() for one in gains)
    has_friction = any(np.isfinite(one.frictionloss.value) for one in gains)
    has_stribeck = any(one.stribeck.value > 0.0 for one in gains)
    has_delay = any(one.delay_s.value > 0.0 for one in gains)
    has_grid = any(joint.grid is not None for joint in result.joints.values())
    interval = "repeat 95 %" if has_total else "95 %"
    columns = [Column(heading="joint"), Column(heading="stiffness", unit="N m/rad", digits=2)]
    columns.append(Column(heading=interval, digits=2))
    if has_total:
        columns.append(Column(heading="total 95 %", digits=2))
    columns.append(Column(heading="damping", unit="N m s/rad"))
    columns.append(Column(heading=interval))
    if has_total:
        columns.append(Column(heading="total 95 %"))
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
        one = joint.gains
        row: list[Cell] = [f"{name} (flagged)" if one.flags else name]
        row.extend([one.stiffness.value, one.stiffness.repeat95])
        if has_total:
            row.append(one.stiffness.total95)
        row.extend([one.damping.value, one.damping.repeat95])
        if has_total:
            row.append(one.damping.total95)
        if has_friction:
            row.append(one.frictionloss.value)
        if has_stribeck:
            row.append(one.frictionloss.value * (1.0 - one.stribeck.value))
        if has_delay:
            row.append(1000.0 * one.delay_s.value)
        if has_grid:
            row.append(None if joint.grid is None else "{:.2f} / {:.3f}".format(*joint.grid.gains))
        quality = one.quality
        row.extend([quality.nominal_error_db, quality.error_db, quality.coherence_min])
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
    return Table(
        title="Matched gains", columns=tuple(columns), rows=tuple(rows), notes=tuple(notes)
    )


def ranges_table(result: MatchResult, members: Mapping[str, Sequence[str]]) -> Table:
    """Make the table of what training draws from, one joint group a row.

    Args:
        result: The match.
        members: Names of the matched joints of each group.
    """
    rows: list[tuple[Cell, ...]] = []
    for name, group in result.groups.items():
        stiffness = f"{group.stiffness:.2f} ± {group.stiffness_range:.2f}"
        damping = f"{group.damping:.3f} ± {group.damping_range:.3f}"
        rows.append((name, stiffness, damping, ", ".join(members[name])))
    columns = (
        Column(heading="group"),
        Column(heading="stiffness", unit="N m/rad"),
        Column(heading="damping", unit="N m s/rad"),
        Column(heading="joints"),
    )
    return Table(title="Training ranges", columns=columns, rows=tuple(rows))


def drives_table(result: MatchResult) -> Table:
    """Make the table of every fitted parameter of each drive, by position and by torque."""
    rows: list[tuple[Cell, ...]] = []
    has_torque = False
    for joint_name, joint in result.joints.items():
        fit = joint.fit
        for name, parameter in PARAMETERS.items():
            if name in fit.ci95:
                low, high = fit.total95.get(name, fit.ci95[name])
                label = f"{name} [{parameter.unit}]"
                value = f"{fit.values[name]:.4g}"
                rows.append((joint_name, label, value, f"{low:.4g} to {high:.4g}", "position"))
        for term, by_torque in joint.gains.torque.items():
            has_torque = True
            label = f"{term} [{UNITS[term]}]"
            if by_torque.identified:
                low, high = by_torque.ci95
                value = f"{by_torque.value:.4g}"
                rows.append((joint_name, label, value, f"{low:.4g} to {high:.4g}", "torque"))
            else:
                reason = f"not identified by torque: {by_torque.reason}"
                rows.append((joint_name, label, None, None, reason))
    columns = (
        Column(heading="joint"),
        Column(heading="parameter"),
        Column(heading="value"),
        Column(heading="95 %"),
        Column(heading="by"),
    )
    notes: tuple[str, ...] = ()
    if has_torque:
        notes = (
            "scale: torque column over the joint's torque. dry and viscous: friction of the joint. "
            "Where the scale is not identified, values by torque are in the column's unit of "
            "torque. The column is taken for measured torque; a commanded one is not what the "
            "drive gave.",
        )
    return Table(title="Fitted drives", columns=columns, rows=tuple(rows), notes=notes)


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
            gains = [result.joints[name].gains for name in names]
            flagged = sum(1 for one in gains if one.flags)
            rows.append((simulator, group, *group_means(gains), flagged))
    columns = (
        Column(heading="framework"),
        Column(heading="group"),
        Column(heading="stiffness", unit="N m/rad"),
        Column(heading="damping", unit="N m s/rad"),
        Column(heading="friction", unit="N m"),
        Column(heading="delay", unit="s", digits=4),
        Column(heading="error", unit="dB"),
        Column(heading="flagged"),
    )
    title = "The same joints in every framework, means of each group"
    return Table(title=title, columns=columns, rows=tuple(rows))


def group_means(gains: Sequence[JointGains]) -> tuple[float, float, float, float, float]:
    """Return the means of stiffness, damping, dry friction, delay and error of some joints."""
    values = []
    for one in gains:
        row = (
            one.stiffness.value,
            one.damping.value,
            one.frictionloss.value,
            one.delay_s.value,
            one.quality.error_db,
        )
        values.append(row)
    stiffness, damping, friction, delay, error = np.mean(values, axis=0).tolist()
    return stiffness, damping, friction, delay, error
