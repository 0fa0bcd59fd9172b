"""`python -m benchmarks ak80`: the torque fit on real AK80-6 recordings beside published sets.

The double pendulum of shared/data/ak80. The fit uses three torque logs; compared on the fourth and
on a recording under position feedback, with each parameter set that DFKI publish for the design:
torque by inverse dynamics against the sensor, both low-passed at `FIT_HZ`, and position over
rollouts of 0.5 s driven by the measured torque, which begin at the measured state.

`FIT_HZ`, no offset of the torque sensor and links straight from joint to centre of mass were chosen
on these recordings, the two compared ones included; the parameters were fitted without those two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from benchmarks.runner import finish
from pronk.cli import console
from pronk.identify.match.torque_fit import BLOCK_S, FIT_HZ, UNITS, TorqueFit
from pronk.tables import Column, Table
from tests.ak80_pendulum import FITTED, HORIZON_S, Comparison, compare


def ak80() -> console.Outcome:
    """Torque fit on real AK80-6 recordings beside four published parameter sets."""
    fit, comparisons = compare()
    lower = sum(len(comparison.lower_than) for comparison in comparisons)
    cells = sum(len(comparison.errors) - 1 for comparison in comparisons)
    joints = {}
    for joint, parameters in fit.joints.items():
        joints[joint] = {name: asdict(parameter) for name, parameter in parameters.items()}
    figures = {
        "lower": lower,
        "cells": cells,
        "comparisons": [asdict(comparison) for comparison in comparisons],
        "fit": joints,
    }
    return finish(figures, _error_table(comparisons, lower, cells), _parameter_table(fit))


def _error_table(comparisons: Sequence[Comparison], lower: int, cells: int) -> Table:
    """One row a recording, quantity and joint; one column a parameter set."""
    names = list(comparisons[0].errors)
    rows = []
    for comparison in comparisons:
        digits = 3
        factor = 1.0
        if comparison.quantity == "position":
            digits = 1
            factor = 1e3
        numbers = [f"{factor * comparison.errors[name]:.{digits}f}" for name in names]
        rows.append((comparison.recording, comparison.quantity, comparison.joint, *numbers))
    columns = [Column(heading="recording"), Column(heading="quantity"), Column(heading="joint")]
    columns += [Column(heading=name) for name in names]
    return Table(
        title="AK80-6: torque fit and published sets",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(
            f"RMSE of torque below {FIT_HZ:g} Hz [N m] and of position over rollouts of "
            f"{HORIZON_S:g} s [mrad].",
            f"Fitted on {', '.join(FITTED)}; lower in {lower} of {cells} comparisons.",
        ),
    )


def _parameter_table(fit: TorqueFit) -> Table:
    """One row a joint and parameter of the fit."""
    rows = []
    for joint, parameters in fit.joints.items():
        for name, parameter in parameters.items():
            rows.append(
                (
                    joint,
                    f"{name} [{UNITS[name]}]",
                    parameter.value,
                    parameter.ci95,
                    "yes" if parameter.identified else f"no: {parameter.reason}",
                )
            )
    return Table(
        title="Fitted drives",
        columns=(
            Column(heading="joint"),
            Column(heading="parameter"),
            Column(heading="value", digits=5),
            Column(heading="95 %", digits=5),
            Column(heading="identified"),
        ),
        rows=tuple(rows),
        notes=(f"{fit.blocks} blocks of {BLOCK_S:g} s; one armature for both actuators.",),
    )
