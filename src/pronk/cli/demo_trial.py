"""The jumps of `pronk demo`: the shipped policies through a short trial, one jump filmed.

They are done beside the sweep and the match, in processes of their own that a thread waits for.
"""

from __future__ import annotations

import importlib.util
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pronk.cli import console
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.evaluation.result import Trial
    from pronk.robots.robot import Robot

FOLDER = "trial"
"""Below the demo's."""
FILMED = "forward 2"
"""The command that is shown."""


@dataclass(frozen=True, kw_only=True)
class Jumped:
    """What came of the jumps."""

    trial: Trial | None = None
    """None without policies."""
    videos: tuple[Path, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    """How long each part took [s]."""


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
    from pronk.evaluation.subjects import load_subjects

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


class _Reporter(console.Reporter):
    """Progress that ends its work once nobody wants it any more."""

    def __init__(self, report: console.Reporter, stop: threading.Event) -> None:
        self._report, self._stop = report, stop

    def __call__(self, stage: str, share: float) -> None:
        """Tell it.

        Raises:
            PronkError: The work is not wanted any more.
        """
        if self._stop.is_set():
            raise PronkError(f"{stage}: stopped with the rest of the demo.")
        self._report(stage, share)


@contextmanager
def beside(
    policies: Sequence[Path],
    out: Path,
    *,
    robot: Robot,
    jumps: int,
    seed: int,
    report: console.Reporter,
) -> Iterator[Callable[[], Jumped]]:
    """Jump and film while the block does something else.

    Args:
        policies: From `find`; without any, nothing is done.
        out: Folder of the trial.
        robot: What they are for.
        jumps: With each of the paper's commands.
        seed: Of starts and noise.
        report: Told the share done, from another thread.

    Yields:
        A function that waits for the end and gives what came of it, or raises what went wrong. A
        block that is left by an error stops the jumps.
    """
    stop = threading.Event()
    told = _Reporter(report, stop)

    def work() -> Jumped:
        if not policies:
            return Jumped()
        begun = time.perf_counter()
        found = jump(policies, out, robot=robot, jumps=jumps, seed=seed, report=told)
        jumped = time.perf_counter()
        videos = film(found, out, report=told)
        seconds = {"jump": jumped - begun, "video": time.perf_counter() - jumped}
        return Jumped(trial=found, videos=videos, seconds=seconds)

    with ThreadPoolExecutor(1) as thread:
        done = thread.submit(work)
        try:
            yield done.result
        except BaseException:
            stop.set()
            raise


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
    from pronk.evaluation.processes import cores
    from pronk.evaluation.run import Plan, run
    from pronk.files import sha256
    from pronk.virtual.sim_params import SHIPPED, load_sim_params

    return run(
        policies,
        Plan(jumps=jumps, seed=seed),
        robot=robot,
        sim_params=load_sim_params(SHIPPED),
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

    from pronk.cli.trial import painted

    first = replace(found, subjects=found.subjects[:1])
    # Half as slow as usual, which takes half as long to paint.
    return painted(first, out, report=report, at_once=1, cases=(FILMED,), slow=2.0)


def summary(found: Trial) -> None:
    """Print heights, distances and landings."""
    from pronk.cli.trial import show
    from pronk.evaluation.outcome import tables

    for figure in ("height", "distance"):
        show(tables.table_iii(found, figure))
    for subject in found.subjects:
        cells = [cell for cell in found.cells if cell.policy == subject.name]
        landed, asked = sum(cell.succeeded for cell in cells), sum(cell.n for cell in cells)
        console.say(
            f"{subject.name} policy on the virtual robot: {landed} of {asked} jumps landed well, "
            f"{cells[0].n} with each command; `pronk trial` does 20."
        )
