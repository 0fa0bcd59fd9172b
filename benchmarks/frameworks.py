"""`python -m benchmarks frameworks`: matched gains in the engines themselves, beside the logs.

Every joint of the logs is matched for each framework with pronk's own computation of its drive law.
Then the engine simulates the recorded command with these gains, the response is estimated as the
log's was, and the two are compared over the band of the match: magnitude, and the phase that the
matched delay leaves, as a time. Of engines without dry friction in N m the frameworks are matched
without it, by the magnitude of the largest amplitude.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, machine
from pronk.cli import console
from pronk.errors import PronkError
from pronk.evaluation.tables import table
from pronk.logs.readers import read_logs
from pronk.match.measured_joint import DB, MeasuredJoint, logs_by_joint, measured_joints, merged
from pronk.match.pipeline import match_frameworks
from pronk.match.result import MatchResult
from pronk.match.settings import MatchSettings
from pronk.match.simulated import SimRequest, responses
from pronk.robots import load_robot
from pronk.simulators.profiles import profile
from pronk.simulators.simulator import joint_rigs

ENGINES = {
    "mjlab": "mujoco",
    "isaaclab-explicit,friction=none": "sapien-explicit",
    "isaaclab-implicit,friction=none": "isaaclab-physx",
    "isaaclab-newton,friction=none": "newton",
    "playground,friction=none": "mjx",
    "maniskill": "sapien",
    "drake": "drake",
    "newton-featherstone": "newton-featherstone",
}
"""Framework, and the simulator of pronk that runs its engine."""
SETTINGS = MatchSettings(method="paper", zero_armature=False)


def compared(
    goals: list[MeasuredJoint], result: MatchResult, engine: str, python: Path | None, robot: Any
) -> list[dict[str, float]]:
    """Errors of each joint in an engine with the gains that were matched for it."""
    with joint_rigs(engine, robot, python=python) as rigs:
        rows = []
        for goal in goals:
            gains = result.gains.joints[goal.joint]
            request = SimRequest(goal, gains.stiffness, gains.damping, delay=gains.delay_s)
            [simulated] = responses(rigs, [request])
            ratio = simulated / goal.measured.response[goal.fit_mask]
            phase, omega = np.unwrap(np.angle(ratio)), goal.omega
            rows.append(
                {
                    "rms_db": float(np.sqrt(np.mean((DB * np.log(np.abs(ratio))) ** 2))),
                    "late_ms": float(-1e3 * (phase @ omega) / (omega @ omega)),
                    "phase_ms": float(1e3 * np.sqrt(np.mean(phase**2) / np.mean(omega**2))),
                }
            )
    return rows


def frameworks(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str = "mini_cheetah",
    simulator_python: tuple[Path, ...] = (),
) -> console.Outcome:
    """Gains matched for frameworks, in the engines themselves, beside the logs.

    Args:
        paths: Logs, or folders of logs, as `pronk sweep` writes them.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        simulator_python: Pythons that have the engines, if this one lacks them; repeat it.
    """
    known = load_robot(robot)
    logs = read_logs(paths, robot=known)
    rows: list[dict[str, Any]] = []
    with console.progress() as report:
        progress: Progress = report
        found = match_frameworks(logs, known, list(ENGINES), settings=SETTINGS, progress=progress)
        for name, engine in ENGINES.items():
            framework = profile(name)
            own = framework.robot(known)
            by_joint = logs_by_joint(logs, own)
            goals = [
                merged([measured_joints(log, joint, own, SETTINGS) for log in sources])[0]
                for joint, sources in by_joint.items()
            ]
            errors = []
            for python in (None, *simulator_python):
                try:
                    errors = compared(goals, found[name], engine, python, own)
                    break
                except PronkError as error:
                    reason = str(error)
            if not errors:
                console.warn(f"{name}: {reason}")
                continue
            columns = {key: [one[key] for one in errors] for key in errors[0]}
            rows.append(
                {"framework": name, "law": framework.drive_law.label, "engine": engine}
                | {"joints": len(errors), "rms_db": float(np.mean(columns["rms_db"]))}
                | {"worst_db": max(columns["rms_db"])}
                | {key: max(map(abs, columns[key])) for key in ("late_ms", "phase_ms")}
            )
            report(name, 1.0)
    columns_ = "framework | law | engine | joints | mean [dB] | worst [dB]"
    sheet = table(
        f"{columns_} | late, worst [ms];2 | phase, worst [ms];2",
        [list(row.values()) for row in rows],
        title="Engines with matched gains, beside the log"
        + " of the virtual robot" * any(log.virtual for log in logs),
    )
    console.show_sheet(sheet)
    return console.Outcome(figures={"rows": rows, "machine": machine()})
