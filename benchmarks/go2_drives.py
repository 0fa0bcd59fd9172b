"""`python -m benchmarks go2-drives`: all twelve joints of virtual Go2s, swept, matched and judged.

The figure is that of `python -m benchmarks match`: RMSE of the simulator with the matched drives
against recordings that the match has not seen, over that of the nominal gains with the delay that
fits the sweep best, as the geometric mean over the held-out signals of a joint.

Without `--sweep`, virtual Go2s are drawn at random as the random Mini Cheetahs are, and swept on
the virtual clock. With it, the logs of one Go2 are judged, such as those that `pronk sweep go2
--link dds` wrote, by the recordings in `--held-out`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks.match import JOINTS, NOMINAL, PRONK, Row, compare, methods, summary, summary_table
from benchmarks.random_robots import Recorded, recorded
from benchmarks.runner import finish, in_parallel
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_log
from pronk.identify.simulators.load import joint_rigs
from pronk.jump.virtual.plant import legs_of
from pronk.robots import load_robot
from pronk.tables import Cell, Column, Table

GO2 = "go2"
METHODS = (NOMINAL, PRONK)


def drawn_leg(work: tuple[int, str], *, seed: int, folder: Path | None) -> list[Row]:
    """Return the rows of one leg of one Go2 that is drawn at random.

    Args:
        work: Number of the Go2, and the leg.
        seed: Seed of the draw and of the noise.
        folder: Folder of the recorded logs.
    """
    number, leg = work
    logs = recorded(seed, number, JOINTS, folder, robot=GO2, leg=leg, with_exact=False)
    return rows_of_logs(number, logs)


def rows_of_logs(number: int, logs: Sequence[Recorded]) -> list[Row]:
    """Return the rows of the recordings of some joints of one Go2."""
    every_method = methods()
    chosen = {}
    for name in METHODS:
        chosen[name] = every_method[name]
    rows = []
    with joint_rigs("mujoco", load_robot(GO2), threads=1) as rigs:
        for recording in logs:
            for row in compare(rigs, recording, chosen):
                rows.append({"robot": number} | row)
    return rows


def recordings_in(sweep: Path, held_out: Path) -> Iterator[Recorded]:
    """Yield the recordings of each joint that both folders have a log of.

    Raises:
        PronkError: They have no joint in common.
    """
    robot = load_robot(GO2)
    common = []
    for joint in robot.joint_names:
        if (sweep / f"{joint}.mcap").exists() and (held_out / f"{joint}.mcap").exists():
            common.append(joint)
    if not common:
        raise PronkError(
            f"{sweep} and {held_out} have no log of the same joint, such as FR_knee.mcap; `pronk "
            "sweep go2 --out FOLDER` writes them, the second with another --signal."
        )
    for joint in common:
        judge = read_log(held_out / f"{joint}.mcap", robot=robot)
        yield Recorded(
            joint=joint,
            sweep=read_log(sweep / f"{joint}.mcap", robot=robot),
            held_out=judge,
            signals=segment_names(judge),
        )


def segment_names(log: JointLog) -> tuple[str, ...]:
    """Return a name for each segment of a log: its number."""
    return tuple(f"segment {number + 1}" for number in range(len(log.segments)))


def ratio_rows(rows: Sequence[Row]) -> list[tuple[int, str, float]]:
    """Return the ratio of each joint as (robot, joint, ratio), by the summary of its rows alone."""
    by_joint: dict[tuple[int, str], list[Row]] = {}
    for row in rows:
        by_joint.setdefault((row["robot"], row["joint"]), []).append(row)
    ratios = []
    for (number, joint), joint_rows in by_joint.items():
        for entry in summary(joint_rows):
            if entry["method"] == PRONK:
                ratios.append((number, joint, entry["median"]))
    return sorted(ratios, key=joint_place)


def joint_place(ratio: tuple[int, str, float]) -> tuple[int, int]:
    """Return where a joint stands in a table: by robot, then in file order."""
    number, joint, _ = ratio
    return number, load_robot(GO2).joint_names.index(joint)


def ratio_table(ratios: Sequence[tuple[int, str, float]]) -> Table:
    """Make the table of the ratios of all joints, a column for each Go2."""
    numbers = sorted({number for number, _, _ in ratios})
    by_joint: dict[str, dict[int, float]] = {}
    for number, joint, ratio in ratios:
        by_joint.setdefault(joint, {})[number] = ratio
    columns = [Column(heading="joint")]
    for number in numbers:
        columns.append(Column(heading=f"Go2 {number}", digits=2))
    rows: list[tuple[Cell, ...]] = []
    for joint, of_robot in by_joint.items():
        cells: list[Cell] = [joint]
        for number in numbers:
            cells.append(of_robot.get(number, float("nan")))
        rows.append(tuple(cells))
    return Table(
        title="held-out RMSE, matched over nominal with delay",
        columns=tuple(columns),
        rows=tuple(rows),
    )


def go2_drives(
    robots: int = 3,
    seed: int = 44,
    legs: int = 4,
    sweep: Path | None = None,
    held_out: Path | None = None,
    cache: Path | None = None,
    jobs: int = 1,
) -> console.Outcome:
    """Sweep and match all joints of virtual Go2s; judge them by recordings not seen by the match.

    Args:
        robots: Number of Go2s that are drawn.
        seed: Of their parameters and of the noise.
        legs: Legs of each Go2 that are swept; fewer than four are others for each Go2, in turn.
        sweep: Folder of the sweep of one Go2, which is judged instead.
        held_out: Folder of the recordings that judge it.
        cache: Folder of the recorded logs; in the system's temporary folder if left out.
        jobs: Processes, a leg each.
    """
    begin = time.perf_counter()
    if (sweep is None) != (held_out is None):
        raise PronkError("--sweep and --held-out go together; give both or neither.")
    if robots < 1 or not 1 <= legs <= 4:
        raise PronkError(f"--robots {robots} --legs {legs}; expected 1 or more, and 1 to 4.")
    rows: list[Row] = []
    title = f"{robots} virtual Go2s, seed {seed}, all joints of {legs} legs each"
    with console.progress() as report:
        if sweep is not None and held_out is not None:
            title = f"one Go2, {sweep}, judged by {held_out}"
            logs = list(recordings_in(sweep, held_out))
            for done, recording in enumerate(logs, 1):
                rows += rows_of_logs(0, [recording])
                report("match", done / len(logs))
        else:
            leg_names = legs_of(load_robot(GO2))
            work = []
            for number in range(robots):
                for turn in range(legs):
                    work.append((number, leg_names[(number * legs + turn) % len(leg_names)]))
            one_leg = partial(drawn_leg, seed=seed, folder=cache)
            for done, leg_rows in enumerate(in_parallel(one_leg, work, jobs), 1):
                rows += leg_rows
                report("match", done / len(work))
    summaries: list[Mapping[str, object]] = list(summary(rows))
    ratios = ratio_rows(rows)
    figures = {
        "schema": "pronk/bench-go2-drives/1",
        "seed": seed,
        "ratios": ratios,
        "summary": summaries,
        "rows": rows,
        "seconds": time.perf_counter() - begin,
    }
    return finish(figures, ratio_table(ratios), summary_table(summaries, title, ()))
