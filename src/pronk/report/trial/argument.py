"""How far each policy's training gains are from the sweep, read off the maps of a match.

The match keeps, for every joint, the error of the simulated gain at every node of a grid of
stiffness and damping. The error at a policy's training gains is that map between its nodes: no
simulation, and exactly the error that the match minimized. What the gains in `match.npz` were
matched to is the sweep of one robot; on another robot the number means nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pronk.errors import ArtefactError
from pronk.evaluation.results import Results, Subject
from pronk.evaluation.tables import Sheet, number
from pronk.match import gains as gains_file
from pronk.match import result as result_file
from pronk.match.result import JointFit, MatchResult
from pronk.report import style
from pronk.report.page import find_gains


def joint_error_db(joint: JointFit, stiffness: float, damping: float) -> float:
    """Error of a joint's simulated gain with these gains, RMS over its band [dB].

    Args:
        joint: Its map: mean squares in dB^2 over a grid.
        stiffness: [N m/rad]
        damping: [N m s/rad]

    Returns:
        NaN outside of the grid, or without a map.
    """
    from scipy.interpolate import RectBivariateSpline

    k, d = joint.grid_stiffness, joint.grid_damping
    if not joint.grid_error.size or min(len(k), len(d)) < 2:
        return float("nan")
    if not (k[0] <= stiffness <= k[-1] and d[0] <= damping <= d[-1]):
        return float("nan")
    # The error is smooth between nodes, its square root has a cusp at a match.
    kx, ky = min(3, len(k) - 1), min(3, len(d) - 1)
    surface = RectBivariateSpline(k, d, joint.grid_error, kx=kx, ky=ky)
    square = float(surface.ev([stiffness], [damping])[0])
    return float(np.sqrt(max(square, 0.0)))


def errors_db(result: MatchResult, subject: Subject) -> dict[str, float]:
    """Error of a policy's training gains for each joint of a match [dB]; NaN if it is unknown."""
    told = (subject.contract.get(name, ()) for name in ("joint_names", "stiffness", "damping"))
    gains = {name: (stiffness, damping) for name, stiffness, damping in zip(*told, strict=False)}
    return {
        name: joint_error_db(joint, *gains.get(name, (np.nan, np.nan)))
        for name, joint in result.joints.items()
    }


def bode_error_db(result: MatchResult, subject: Subject) -> float:
    """Error of a policy's training gains, RMS over the joints [dB]; NaN if one is unknown."""
    errors = list(errors_db(result, subject).values())
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")


def joint_errors(trial: Results, result: MatchResult) -> Sheet:
    """Errors of every policy's training gains, and of the matched gains of each joint by itself."""
    found = {subject.name: errors_db(result, subject) for subject in trial.subjects}
    return Sheet(
        title="Error of the training gains on the sweep [dB RMS over the joint's band]",
        columns=("joint", *found, "its own matched gains"),
        rows=tuple(
            (
                style.joint_words(name),
                *(number(errors[name], 2) for errors in found.values()),
                number(joint.error_db, 2),
            )
            for name, joint in result.joints.items()
        ),
        notes=(
            "Training has one pair of gains for each group of joints, so even matched gains miss a "
            "joint that differs from its group.",
        ),
    )


def match_near(folder: Path, root: Path) -> MatchResult | None:
    """The match that lies nearest to a trial: in its folder or one above it, down from `root`."""
    for place in (folder, *folder.parents):
        if (place / "match.npz").exists():
            try:
                return result_file.load(place / "match.npz", gains_file.load(find_gains(place)))
            except ArtefactError:
                # The page says so where the match itself is shown.
                return None
        if place == root:
            return None
    return None


def bode_errors_db(trial: Results, result: MatchResult) -> Mapping[str, float]:
    """By policy; empty unless every policy's is known."""
    found = {subject.name: bode_error_db(result, subject) for subject in trial.subjects}
    return found if all(np.isfinite(value) for value in found.values()) else {}
