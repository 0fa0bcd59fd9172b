"""Bodies never seen, each matched anew, as a part of a page: the same table for each."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pronk.evaluation.bodies import Bodies, Body
from pronk.evaluation.criteria import trial_checks
from pronk.evaluation.tables import Sheet, number, table_iii, verdict
from pronk.report import shell
from pronk.report.shell import Part
from pronk.report.trial.cells import Array, Values, cells
from pronk.report.trial.data import policies, published, values
from pronk.report.trial.extra import Block, part, place
from pronk.report.trial.sweeps import argument

_OF_POLICY = "training gains of "


def errors_db(bodies: Bodies) -> dict[str, float]:
    """Error of each policy's training gains on each body's own sweep [dB RMS].

    Returns:
        By `POLICY, BODY`.
    """
    return {
        f"{one.gains.removeprefix(_OF_POLICY)}, {body.name}": one.rms_db
        for body in bodies.bodies
        for one in body.errors
        if one.gains.startswith(_OF_POLICY)
    }


def by_body(bodies: Bodies, figure: str) -> Values:
    """One figure of every jump, by `POLICY, BODY` and command."""
    found: dict[str, Mapping[str, Array]] = {}
    for body in bodies.bodies:
        cases = [case.name for case in body.trial.cases]
        for policy, own in values(body.trial, figure, cases).items():
            found[f"{policy}, {body.name}"] = own
    return found


def _summary(bodies: Bodies) -> Sheet:
    """One row for each body and policy."""
    rows = []
    for body in bodies.bodies:
        errors = {one.gains: one.rms_db for one in body.errors}
        for name in policies(body.trial):
            own = [cell for cell in body.trial.cells if cell.policy == name]
            asked, landed = sum(cell.n for cell in own), sum(cell.succeeded for cell in own)
            stds = {
                figure: [cell.figures[figure].std for cell in own]
                for figure in ("height", "distance")
            }
            best = max((c.figures["height"].mean for c in own if c.found), default=math.nan)
            rows.append(
                (
                    f"{body.name}: {name}",
                    number(errors.get(f"{_OF_POLICY}{name}", math.nan), 2),
                    f"{landed}/{asked}",
                    number(best),
                    *(number(sum(each) / len(each)) for each in stds.values()),
                    _passed(body) if name == body.trial.subjects[0].name else "-",
                )
            )
    return Sheet(
        title="Every body",
        columns=(
            "body: policy",
            "gains [dB RMS]",
            "landed",
            "best height [m]",
            "height scatter [m]",
            "distance scatter [m]",
            "criteria",
        ),
        rows=tuple(rows),
        notes=(
            "gains: error of the policy's training gains on the body's own sweep. scatter: mean of "
            "the commands' standard deviations. criteria: passed by the first policy.",
            *(
                f"{body.name}: {verdict(body.trial, other.name)}"
                for body in bodies.bodies
                for other in body.trial.subjects[1:]
            ),
        ),
    )


def _passed(body: Body) -> str:
    found = trial_checks(body.trial)
    return f"{sum(check.passed for check in found)}/{len(found)}"


def _gains(bodies: Bodies) -> Sheet:
    """Error of every set of gains on each body's own sweep."""
    names = list(dict.fromkeys(one.gains for body in bodies.bodies for one in body.errors))
    found = [{one.gains: one.rms_db for one in body.errors} for body in bodies.bodies]
    return Sheet(
        title="Error of gains on each body's own sweep [dB RMS]",
        columns=("gains", *(body.name for body in bodies.bodies)),
        rows=tuple(
            (name, *(number(errors.get(name, math.nan), 2) for errors in found)) for name in names
        ),
        notes=(
            "drive's own: those set on the drives, put into the simulator as they are. Matched "
            "anew: by the sweep of this body; by group: as training would use them.",
        ),
    )


def bodies_part(bodies: Bodies, *, anchor: str, title: str = "Bodies never seen") -> Part:
    """The bodies as a part of a page."""
    where, count = place(bodies), len(bodies.bodies)
    blocks = [
        Block(
            anchor="summary",
            title="Every body, matched anew by its own sweep",
            lines=(
                "The policies were trained with the gains of the robot they were made for, not "
                "with those of these bodies. The match of a body says how far off those gains are; "
                "the jumps say what becomes of it.",
            ),
            sheets=(_summary(bodies), _gains(bodies)),
        )
    ]
    errors = errors_db(bodies)
    if len(errors) > 1:
        panels = {f"{name} [m]": by_body(bodies, name) for name in ("height", "distance")}
        blocks.append(
            Block(
                anchor="argument",
                title="Error of the training gains beside the scatter of the jumps",
                lines=("Every mark is a command of a policy on a body.",),
                picture=shell.picture(
                    argument(errors, panels, named=False),
                    f"Standard deviation of height and distance on each {where} over the error of "
                    "the training gains on its sweep",
                ),
            )
        )
    for figure in ("height", "distance"):
        shown = [
            (
                f"{body.name}\n{figure} [m]",
                values(body.trial, figure, [case.name for case in body.trial.cases]),
                published(figure),
            )
            for body in bodies.bodies
        ]
        blocks.append(
            Block(
                anchor=figure,
                title=f"{figure.capitalize()} on every body",
                picture=shell.picture(
                    cells(shown),
                    f"{figure.capitalize()} of every jump on each {where}, by command and policy, "
                    "with the paper's means and standard deviations",
                ),
                folded=tuple(_titled(body, figure) for body in bodies.bodies),
            )
        )
    landed = sum(c.succeeded for b in bodies.bodies for c in b.trial.cells)
    asked = sum(c.n for b in bodies.bodies for c in b.trial.cells)
    return part(
        blocks,
        anchor=anchor,
        title=title,
        says=f"{count} other {where}s: {landed} of {asked} jumps landed well.",
        origin=bodies,
        lines=(
            "Each was drawn within stated tolerances, asked by its own sweep and matched anew; its "
            f"folder ({', '.join(body.folder for body in bodies.bodies)}) has a page of its own: "
            "pronk report FOLDER.",
        ),
    )


def _titled(body: Body, figure: str) -> Sheet:
    sheet = table_iii(body.trial, figure)
    return Sheet(
        title=f"{body.name}: {sheet.title}",
        columns=sheet.columns,
        rows=sheet.rows,
        notes=sheet.notes[-1:],
    )
