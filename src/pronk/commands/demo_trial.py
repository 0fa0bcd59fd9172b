"""The jumps of `pronk demo`: the shipped policies through a short trial, one of them filmed."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pronk.commands import console
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.robots.robot import Robot
    from pronk.trial.result import Trial

FOLDER = "trial"
"""Below the demo's."""
FILMED = "forward 2"
"""The command that is shown."""


def shipped() -> Path:
    """Where the policies lie that are kept with pronk's source; not in an installed package."""
    import pronk

    return Path(pronk.__file__).parents[2] / "policies"


def find(folder: Path | None, robot: Robot) -> tuple[list[Path], str]:
    """The policies to try, a matched one first, opened and checked before anything moves.

    Args:
        folder: Where to look, in it and in the folders in it; the shipped ones if None.
        robot: Whom they must fit.

    Returns:
        The files, and in one sentence why there are none, where the demo goes on without.

    Raises:
        PronkError: A folder was given and has none, or one of them cannot be used.
    """
    from pronk.trial.subjects import load_subjects

    place = folder or shipped()
    found = [*place.glob("policy.onnx"), *place.glob("*/policy.onnx")]
    found.sort(key=lambda path: (path.parent.name != "matched", path.parent.name))
    if folder is not None and not found:
        raise PronkError(
            f"--policies {folder}: no policy.onnx in it or in a folder in it; give one that "
            "`pronk train` wrote to, or leave the option out."
        )
    if not found:
        return [], (
            f"no jumps: no policies in {place}, they lie in the folder `policies` of pronk's "
            "source; --policies DIR names another."
        )
    if folder is None and importlib.util.find_spec("onnxruntime") is None:
        return [], (
            "no jumps: a policy needs onnxruntime; install it with `pip install 'pronk[policy]'`."
        )
    load_subjects(found, robot)
    return found, ""


def jump(
    policies: Sequence[Path],
    out: Path,
    *,
    robot: Robot,
    jumps: int,
    seed: int,
    report: console.Reporter,
) -> Trial:
    """A short trial on the shipped virtual robot.

    Args:
        policies: From `find`.
        out: Folder of the trial; one that is there is replaced.
        robot: What they are for.
        jumps: With each of the paper's commands.
        seed: Of starts and noise.
        report: Told the share done.
    """
    from pronk.files import sha256
    from pronk.hardware.truth import SHIPPED, load_truth
    from pronk.trial.processes import cores
    from pronk.trial.run import Plan, run

    return run(
        policies,
        Plan(jumps=jumps, seed=seed),
        robot=robot,
        truth=load_truth(SHIPPED),
        out=out,
        about={"file": "shipped with pronk", "sha256": sha256(SHIPPED)},
        overwrite=True,
        processes=cores(),
        progress=report.bar("jump"),
    )


def film(found: Trial, out: Path, *, report: console.Reporter) -> tuple[Path, ...]:
    """Paint one jump of the first policy, where this machine can; returns the files.

    Args:
        found: From `jump`.
        out: Its folder.
        report: Told the share that is painted.
    """
    from dataclasses import replace

    from pronk.commands.trial import painted

    first = replace(found, subjects=found.subjects[:1])
    # Half as slow as usual, which takes half as long to paint.
    return painted(first, out, report=report, at_once=1, cases=(FILMED,), slow=2.0)


def summary(found: Trial) -> None:
    """Print heights, distances and landings."""
    from pronk.commands.trial import show
    from pronk.trial import tables

    for figure in ("height", "distance"):
        show(tables.table_iii(found, figure))
    for subject in found.subjects:
        cells = [cell for cell in found.cells if cell.policy == subject.name]
        landed, asked = sum(cell.succeeded for cell in cells), sum(cell.n for cell in cells)
        console.say(
            f"{subject.name} policy on the virtual robot: {landed} of {asked} jumps landed well, "
            f"{cells[0].n} with each command; `pronk trial` does 20."
        )
