"""`pronk match` and `pronk profiles`: gains, and the frameworks that they can be matched for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from pronk.cli import console, options
from pronk.cli.options import Reading
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.identify.match.result import MatchResult

Mode = Literal["gains", "drive"]
Method = Literal["time", "paper"]
WARNING_STATUS = 3
"""Exit status of a match that is no better than less fitting, on what was kept aside."""


def match(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str,
    out: Path = Path("gains.yaml"),
    mode: Mode = "gains",
    method: Method = "time",
    exhaustive: bool = False,
    drive_gains: tuple[str, ...] = (),
    zero_armature: bool = True,
    free: Annotated[tuple[str, ...], tyro.conf.arg(name="fit")] = (),
    simulator: str = "mujoco",
    simulator_python: Path | None = None,
    frameworks: Annotated[tuple[str, ...], tyro.conf.arg(name="for")] = (),
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Find the gains with which the simulator responds like the robot.

    Args:
        paths: Logs, or folders of logs.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        out: The gains file.
        mode: gains: stiffness and damping (the paper's). drive: damping, armature, friction and
            delay at known stiffness; by a torque channel armature, friction and torque scale.
        method: time: gains, dry friction and delay in the time domain, all amplitudes together.
            paper: gains by the magnitude of the largest amplitude.
        exhaustive: Simulate every pair of the paper's grid.
        drive_gains: Gains on the real drives if the logs do not have them: JOINT=STIFFNESS,DAMPING
            or GROUP=STIFFNESS,DAMPING, repeat it; or default, those of the robot's file.
        zero_armature: Repeat the paper's search without rotor inertia (--method paper).
        free: drive: fit this instead; repeat it. What the sweeps cannot separate is refused.
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator.
        simulator_python: Python that the simulator runs in (3.11 or later, with NumPy).
        frameworks: Match for this framework too, into a folder of its name beside the gains file;
            repeat it. A name of `pronk profiles`, or NAME,timestep_s=S,iterations=N,friction=none.
        reading: How logs are read.
    """
    from pronk.identify.match import gains as gains_file
    from pronk.identify.match import result as result_file
    from pronk.identify.match.pipeline import match_frameworks
    from pronk.identify.match.result import NOT_BETTER
    from pronk.identify.match.settings import MatchSettings
    from pronk.report.match_page import write_page
    from pronk.robots import load_robot

    known = load_robot(robot)
    if out.suffix not in (".yaml", ".yml"):
        raise PronkError(f"--out {out}: expected a name that ends in .yaml, as in gains.yaml.")
    if free and mode != "drive":
        raise PronkError("--fit names what --mode drive fits; give --mode drive as well.")
    given, logs = options.drive_gains(drive_gains), reading.read(paths, known)
    settings = MatchSettings(
        method=method,
        exhaustive=exhaustive,
        zero_armature=zero_armature,
        simulator=simulator,
        simulator_python=simulator_python,
    )
    with console.progress() as report:
        results = match_frameworks(
            logs,
            known,
            frameworks,
            mode=mode,
            free=free,
            drive_gains=given,
            settings=settings,
            progress=report,
        )
        result, wrote, pages = results[""], [], []
        for name, one in results.items():
            folder = out.parent / name
            gains_file.save_gains(folder / out.name, one.gains)
            result_file.save(folder / "match.npz", one)
            report(f"{name} page".strip(), 0.0)
            pages.append(write_page(folder, gains=out.name))
            report(f"{name} page".strip(), 1.0)
            wrote += [folder / out.name, folder / "match.npz", pages[-1][0]]
    page, part = pages[0]
    found = part.figures
    errors = (
        f" Gain error in the compared band, RMS over the joints: {found['naive_error_db']:.2f} dB "
        f"with the nominal gains of the real drive, {found['error_db']:.2f} dB with the matched "
        "gains."
    )
    console.say(part.summary + errors * bool(np.isfinite(found["error_db"])))
    for name, flags in found["flags"].items():
        console.say(f"{name}: {'; '.join(flags)}")
    shown = {"gains_table": "Matched gains", "ranges_table": "Training ranges"}
    if mode == "drive":
        # By torque alone no gains are matched.
        shown = {"drives": "Fitted drives"} | (shown if result.joints else {})
    for name, title in shown.items():
        console.show_sheet(part.content[name], title)
    figures = summary(result)
    joints = result.joints.items()
    if any(np.isfinite(joint.rmse) for joint in result.joints.values()):
        rows = [(name, joint.published_rmse, joint.rmse) for name, joint in joints]
        columns = "joint | RMSE published [rad];4 | RMSE matched [rad];4"
        title = "Several joints moved at once, so the whole arm was fitted in time"
        console.show_table(columns, rows, title=title)
        for name, reason in result.excluded.items():
            console.say(f"left out: {reason if name in reason else f'{name}: {reason}'}")
        figures["mode"] = mode
        figures["held"] = {name: joint.held for name, joint in joints if joint.held}
        figures["rmse"] = {name: {"published": a, "matched": b} for name, a, b in rows}
    if frameworks:
        means = framework_rows(results)
        columns = "framework | group | stiffness [N m/rad] | damping [N m s/rad]"
        console.show_table(
            f"{columns} | friction [N m] | delay [s];4 | error [dB] | flagged",
            [list(row.values()) for row in means],
            title="The same joints in every framework, means of each group",
        )
        figures["frameworks"] = means
    following = [
        f"open {page} in a browser",
        f"pronk predict FRESH_LOG --robot {robot} --gains {out}",
        f"pronk export {out} --to mjlab --out actuators.py",
    ]
    flags = [f for one in results.values() for j in one.joints.values() for f in j.flags]
    worse = any(flag.startswith(NOT_BETTER) for flag in flags)
    status = WARNING_STATUS if worse else 0
    return console.Outcome(figures=figures, wrote=wrote, following=following, status=status)


def framework_rows(results: Mapping[str, MatchResult]) -> list[dict[str, Any]]:
    """Means over the joints of each group in each framework, for the table and for JSON."""
    from pronk.report.match_page import group_members

    rows = []
    for name, result in results.items():
        for group, members in group_members(result.gains).items():
            own = [result.gains.joints[member] for member in members]
            row = {
                "framework": name or "own",
                "group": group,
                "stiffness": float(np.mean([joint.stiffness.value for joint in own])),
                "damping": float(np.mean([joint.damping.value for joint in own])),
                "frictionloss": float(np.mean([joint.frictionloss.value for joint in own])),
                "delay_s": float(np.mean([joint.delay_s.value for joint in own])),
                "error_db": float(np.mean([joint.quality.error_db for joint in own])),
                "flagged": sum(1 for joint in own if joint.flags),
            }
            rows.append(row)
    return rows


def profiles() -> console.Outcome:
    """List the frameworks that gains can be matched for."""
    from pronk.identify.simulators import profiles as known

    found = known.load_profiles().values()
    fields = ("decimation", "delay", "friction", "source")
    rows = [
        [p.name, p.framework, p.drive_law.label, 1e3 * p.timestep_s]
        + [getattr(p, field) for field in fields]
        for p in found
    ]
    columns = "name | framework | law | step [ms];1 | decimation | delay | friction | source"
    laws = (
        "law E: explicit; IF: implicit damping; In: implicit stiffness and damping, n iterations.",
        "Gains of one law do not give the same joint in another; see docs/simulators.md.",
    )
    console.show_table(columns, rows, *laws, title="Frameworks")
    return console.Outcome(figures={"profiles": [vars(p) for p in found]})


def summary(result: MatchResult) -> dict[str, Any]:
    """Figures of a match, for JSON."""
    from pronk.report.match_page import verdict

    zero = {name: joint.zero_armature_error_db for name, joint in result.joints.items()}
    return verdict(result) | {
        "gains": {
            name: asdict(gains) | {"zero_armature_error_db": zero.get(name)}
            for name, gains in result.gains.joints.items()
        },
        "groups": {name: asdict(group) for name, group in result.gains.groups.items()},
        "seconds": dict(result.seconds),
        "grid_steps_per_second": result.grid_steps_per_second,
    }
