"""`pronk shape`: filter commands so that a real drive responds like a simulated joint."""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tyro

from pronk.cli import console, options
from pronk.cli.options import Reading
from pronk.errors import PronkError


def shape(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str,
    out: Path = Path("shape.yaml"),
    gains: Path | None = None,
    like: str = "mjlab",
    sim_gains: tuple[str, ...] = (),
    verify: bool = False,
    sim_params: Path | None = None,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Find filters of the commands with which real joints respond like simulated ones.

    Args:
        paths: Logs of the real drives, or folders of logs.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        out: The file of filters to write.
        gains: gains.yaml of the simulated joints.
        like: Framework of the simulated joints, where --sim-gains has their gains.
        sim_gains: Gains of the simulated joints: JOINT=STIFFNESS,DAMPING or
            GROUP=STIFFNESS,DAMPING, repeat it; or default, those of the robot's file.
        verify: Excite the virtual robot with filtered commands and measure what is left.
        sim_params: Parameters of the virtual robot, instead of the shipped ones.
        reading: How logs are read.
    """
    from pronk.deploy.bench.virtual_sweep import sweep_virtual
    from pronk.identify.logs.readers import read_logs
    from pronk.identify.match import gains as gains_file
    from pronk.identify.match import shape as shaping
    from pronk.identify.match.measured_joint import gains_by_joint, gains_on_drive
    from pronk.identify.match.translate import stated_gains
    from pronk.identify.simulators.profiles import profile, profile_of
    from pronk.jump.virtual.sim_params import load_sim_params
    from pronk.robots import load_robot

    known, stated = load_robot(robot), options.drive_gains(sim_gains, "--sim-gains")
    if (gains is None) == (stated is None):
        raise PronkError(
            "expected either --gains FILE of the simulated joints, or --like FRAMEWORK and "
            "--sim-gains NAME=STIFFNESS,DAMPING."
        )
    if gains is not None:
        simulated = gains_file.load(gains)
    elif stated is not None:
        simulated = stated_gains(known, gains_by_joint(known, stated), profile(like))
    logs = reading.read(paths, known)
    virtual = any(log.virtual for log in logs)
    if verify and not virtual:
        raise PronkError("--verify excites the virtual robot, and these logs are of another one.")
    params = load_sim_params(sim_params, known) if verify else None
    rows: list[list[Any]] = []
    joints, figures = {}, {}
    with console.progress() as report, tempfile.TemporaryDirectory() as folder:
        done = report.bar("shape")
        found = shaping.goals_of(logs, known, simulated)
        for i, (name, (goal, response)) in enumerate(found.items()):
            sources = [log for log in logs if name in log.joints]
            on_drive = gains_on_drive(sources[0], name, known)
            one, plan = shaping.shaped_plan(goal, response, known, on_drive)
            joints[name], left = one, None
            cost = next(row for row in plan.rows() if row["joint"] == name)
            if params is not None:
                written = sweep_virtual(plan, params, Path(folder), seed=1)
                signals = {name: shaping.Shaped(prefilter=one)}
                fresh = [
                    shaping.as_requested(log, signals, known)
                    for log in read_logs(written, robot=known)
                ]
                left = shaping.distance(*shaping.goals_of(fresh, known, simulated)[name])
            figures[name] = asdict(one) | {"measured_after": left, "worst_case": cost}
            after = (one.after_db, one.after_error, one.delay_s) if left is None else left
            errors = 100.0 * one.before_error, 100.0 * after[1]
            torque = one.peak_db, cost["torque_nm"], cost["effort_limit_nm"]
            rows.append([name, one.before_db, after[0], *errors, 1000.0 * after[2], *torque])
            done((i + 1) / len(found))
    used = profile_of(simulated.simulator).name
    shaping.save(
        out,
        shaping.Shape(
            robot=known.name,
            rate_hz=known.policy_rate_hz,
            simulator=used,
            gains={n: (simulated.joints[n].stiffness, simulated.joints[n].damping) for n in joints},
            joints=joints,
            logs={Path(log.source or "log").name: log.sha256 for log in logs},
            virtual=virtual,
        ),
    )
    console.show_table(
        "joint | before [dB] | after [dB] | error before [%];1 | after [%];1 | late [ms];2 | "
        "filter up to [dB];1 | torque [N m];1 | of limit [N m];1",
        rows,
        "dB: RMS of the magnitude over that of the simulated joint. Error: distance of the "
        "responses over that of the simulated joint, delay included.",
        f"After: {'measured on the virtual robot' if verify else 'computed; --verify measures it'}."
        " Torque: worst case of the measured chirp, filtered, over what is uncertain of the robot.",
        title=f"Filtered commands, to respond like {used}" + ", virtual robot" * virtual,
    )
    return console.Outcome(figures={"joints": figures}, wrote=[out])
