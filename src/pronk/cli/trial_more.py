"""What `pronk trial` can do beside the paper's jumps: walk, cross, vary the body, other bodies.

Each writes a sheet into the trial's folder, where `pronk report` finds it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pronk.cli import console

if TYPE_CHECKING:
    from pronk.evaluation.outcome.table_text import Sheet
    from pronk.evaluation.unseen.bodies import Bodies
    from pronk.evaluation.variation import Variation
    from pronk.robots.robot import Robot
    from pronk.virtual.sim_params import SimParams


def more(
    policies: Sequence[Path],
    out: Path,
    *,
    robot: Robot,
    sim_params: SimParams,
    about: Mapping[str, Any],
    seed: int,
    processes: int,
    report: console.Reporter,
    walk: bool = False,
    crossing: bool = False,
    variation: bool = False,
    bodies: bool = False,
    own: Sequence[Sequence[Path]] = (),
    jumps: int = 20,
) -> tuple[list[Sheet], list[Path]]:
    """Do what was asked for, each with its own defaults.

    Args:
        policies: Of the trial.
        out: Its folder.
        robot: What they are for.
        sim_params: Body of the virtual robot.
        about: Where the parameters come from.
        seed: Of all draws.
        processes: How many runs at once.
        report: Told what is done, and the share of it.
        walk: 20 walks of 20 s with each velocity.
        crossing: Gaps and steps of growing size.
        variation: Mass, friction, delay and bus voltage, one by one, 5 jumps a point.
        bodies: Three bodies never seen, each matched anew.
        own: Policies that were trained with each body's gains.
        jumps: With each command on each body.

    Returns:
        Tables to show, and the files that were written.
    """
    from pronk.evaluation import variation as variation_file
    from pronk.evaluation import walk as walk_file
    from pronk.evaluation.run import Plan
    from pronk.evaluation.terrain import crossing as crossing_file
    from pronk.evaluation.terrain.climbing import Plan as Climbs
    from pronk.evaluation.terrain.climbing import add_crossings
    from pronk.evaluation.unseen import bodies as bodies_file
    from pronk.report.trial import crossing as trial_crossing
    from pronk.report.trial import walk as trial_walk

    kept: dict[str, Any] = {
        "robot": robot,
        "sim_params": sim_params,
        "out": out,
        "about": about,
        "processes": processes,
    }
    sheets: list[Sheet] = []
    wrote: list[Path] = []
    if walk:
        walks = walk_file.add_walks(policies, seed=seed, progress=report.bar("walking"), **kept)
        sheets += [on_virtual("walking", one) for one in trial_walk.tables(walks)]
        wrote.append(out / walk_file.FILE)
    if crossing:
        crossed = add_crossings(
            policies, Climbs(seed=seed), progress=report.bar("crossing"), **kept
        )
        sheets.append(on_virtual("crossing", trial_crossing.table(crossed)))
        wrote.append(out / crossing_file.FILE)
    if variation:
        plan = Plan(jumps=5, seed=seed)
        varied = variation_file.add_variation(
            policies, plan, progress=report.bar("varying the body"), **kept
        )
        sheets.append(variation_sheet(varied))
        wrote.append(out / variation_file.FILE)
    if bodies:
        plan = Plan(jumps=jumps, seed=seed)
        found = bodies_file.add_bodies(policies, plan, own=own, seed=seed, progress=report, **kept)
        sheets.append(bodies_sheet(found))
        wrote += [out / bodies_file.FILE, out / bodies_file.FOLDER]
    return sheets, wrote


def on_virtual(what: str, sheet: Sheet) -> Sheet:
    """A table of the page with a title that says what it is where no heading does."""
    return replace(sheet, title=f"Virtual robot, {what}: {sheet.title}")


def variation_sheet(varied: Variation) -> Sheet:
    """Landings and heights at every value, all commands together."""
    import numpy as np

    from pronk.evaluation.outcome.table_text import Sheet, number

    rows = []
    for each in varied.parameters:
        for value in sorted({*each.values, varied.own[each.name]}):
            for subject in varied.origin.subjects:
                points = [
                    point
                    for case in varied.cases
                    for point in varied.line(each.name, subject.name, case.name)
                    if point.value == value
                ]
                means = (
                    np.array([point.figures[name].mean for point in points if point.found])
                    for name in ("height", "distance")
                )
                rows.append(
                    (
                        f"{each.says}, {subject.name}",
                        f"{value:g} {each.unit}".removesuffix(" 1"),
                        f"{sum(p.succeeded for p in points)}/{sum(p.n for p in points)}",
                        *(number(float(all_.mean()) if len(all_) else np.nan) for all_ in means),
                    )
                )
    return Sheet(
        title="Virtual robot, one number of its body varied at a time",
        columns=("number, policy", "value", "landed", "height [m]", "distance [m]"),
        rows=tuple(rows),
        notes=("Means of the commands' means, over the jumps that there were.",),
    )


def bodies_sheet(bodies: Bodies) -> Sheet:
    """Every body: its gains by group, how wrong gains are on it, and the jumps."""
    from pronk.evaluation.outcome.table_text import Sheet, number
    from pronk.evaluation.unseen.bodies import MATCHED

    rows = []
    for body in bodies.bodies:
        errors = {one.gains: one.rms_db for one in body.errors}
        groups = ", ".join(
            f"{name} {gains.stiffness:g}/{gains.damping:g}" for name, gains in body.groups.items()
        )
        for subject in body.trial.subjects:
            cells = [cell for cell in body.trial.cells if cell.policy == subject.name]
            best = max((c.figures["height"].mean for c in cells if c.found), default=float("nan"))
            rows.append(
                (
                    f"{body.name}: {subject.name}",
                    groups,
                    number(errors[MATCHED], 3),
                    number(errors[f"training gains of {subject.name}"], 3),
                    f"{sum(c.succeeded for c in cells)}/{sum(c.n for c in cells)}",
                    number(best),
                )
            )
    return Sheet(
        title="Virtual robots never seen, each matched anew by its own sweep",
        columns=(
            "body: policy",
            "matched anew, by group",
            "error of its match [dB]",
            "error of the policy's training gains [dB]",
            "landed",
            "best mean height [m]",
        ),
        rows=tuple(rows),
        notes=(
            "The policies were trained with the gains of the robot they were made for, not with "
            "those of these bodies; the drives of all bodies have their own gains, 17 / 0.4.",
        ),
    )
