"""`python -m benchmarks plan`: the forecast of a sweep beside plain MuJoCo.

The forecast of the model as it is (without uncertainty) and MuJoCo's own position actuators with
implicitfast at 0.1 ms get the same command: peak torque, peak speed and reach of the excited joint.
`planned_and_simulated` does so for any robot.
"""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from benchmarks.runner import finish
from pronk.cli import console
from pronk.errors import PlanError
from pronk.identify.excitation.plan import make_plan
from pronk.identify.excitation.signals import Chirp, Signal
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Column, Table
from tests.plain_mujoco import Peaks, peaks_in_mujoco
from tests.sized_joint import JOINT, SIZES, sized_robot

SHIPPED = (
    ("mini_cheetah", "FR_hip_roll"),
    ("mini_cheetah", "FR_hip_pitch"),
    ("mini_cheetah", "FR_knee"),
    ("go2", "FR_knee"),
    ("so101", "elbow_flex"),
)
"""Robots and joints that are compared beside those of `tests.sized_joint`."""


@dataclass(frozen=True, kw_only=True)
class PlanComparison:
    """Peaks of one joint, planned and simulated."""

    robot: str
    """Name of the robot."""
    joint: str
    """Name of the joint."""
    amplitude: float
    """Amplitude of the signal, the largest that the plan lets pass [rad]."""
    planned: Peaks
    """Peaks of the plan, of the model as it is."""
    simulated: Peaks
    """Peaks in plain MuJoCo."""

    @property
    def largest_difference(self) -> float:
        """The largest of the three differences, as a share of MuJoCo's number."""
        largest = 0.0
        for planned, simulated in (
            (self.planned.torque, self.simulated.torque),
            (self.planned.speed, self.simulated.speed),
            (self.planned.reach, self.simulated.reach),
        ):
            largest = max(largest, abs(planned - simulated) / simulated)
        return largest


def planned_and_simulated(
    robot: RobotSpec,
    joint: str,
    amplitude: float = 0.25,
    signal: Signal | None = None,
    timestep_s: float = 1e-4,
) -> PlanComparison:
    """Plan the excitation of one joint, and simulate it in plain MuJoCo.

    Args:
        robot: The robot.
        joint: The joint.
        amplitude: Largest amplitude [rad]; where it exceeds a limit, the largest that does not.
        signal: The signal; the paper's chirp if None.
        timestep_s: Physics step of plain MuJoCo [s].

    Raises:
        PlanError: No amplitude fits, or the excitation cannot be forecast.
    """
    signal = signal or Chirp()
    plan = make_plan(robot, [joint], signal, amplitudes=(amplitude,), repeats=1)
    fitting = plan.fitting_amplitude(joint)
    if fitting == 0.0:
        # It refuses, with the reason.
        plan.check()
        raise PlanError(f"{robot.name}: no amplitude of {joint} fits.")
    if fitting < amplitude:
        plan = make_plan(robot, [joint], signal, amplitudes=(fitting,), repeats=1)
    (row,) = plan.rows()
    pose = robot.joint(joint).default_position
    reach = max(float(row["nominal_highest_rad"]) - pose, pose - float(row["nominal_lowest_rad"]))
    planned = Peaks(
        torque=float(row["nominal_torque_nm"]),
        speed=float(row["nominal_speed_rad_s"]),
        reach=reach,
    )
    offsets = plan.excitations[0].offsets(plan.rate_hz)
    return PlanComparison(
        robot=robot.name,
        joint=joint,
        amplitude=fitting,
        planned=planned,
        simulated=peaks_in_mujoco(robot, joint, offsets, timestep_s),
    )


def plan(amplitude: float = 0.25) -> console.Outcome:
    """Compare plans with plain MuJoCo, on shipped robots and on own ones from 5 g to 50 kg.

    Args:
        amplitude: Largest amplitude [rad].
    """
    comparisons = []
    with console.progress() as report, tempfile.TemporaryDirectory() as folder:
        total = len(SIZES) + len(SHIPPED)
        for number, (name, size) in enumerate(SIZES.items()):
            robot_folder = Path(folder) / str(number)
            robot_folder.mkdir()
            robot = replace(sized_robot(size, robot_folder), name=name)
            comparisons.append(planned_and_simulated(robot, JOINT, amplitude))
            report("plan", len(comparisons) / total)
        for name, joint in SHIPPED:
            comparisons.append(planned_and_simulated(load_robot(name), joint, amplitude))
            report("plan", len(comparisons) / total)
    rows = []
    for comparison in comparisons:
        rows.append(
            (
                f"{comparison.robot}, {comparison.joint}",
                comparison.amplitude,
                comparison.planned.torque,
                comparison.simulated.torque,
                comparison.planned.speed,
                comparison.simulated.speed,
                comparison.planned.reach,
                comparison.simulated.reach,
                100.0 * comparison.largest_difference,
            )
        )
    table = Table(
        title="Planned, and in plain MuJoCo at 0.1 ms",
        columns=(
            Column(heading="joint"),
            Column(heading="amplitude", unit="rad"),
            Column(heading="torque", unit="N m"),
            Column(heading="MuJoCo"),
            Column(heading="speed", unit="rad/s"),
            Column(heading="MuJoCo"),
            Column(heading="reach", unit="rad"),
            Column(heading="MuJoCo"),
            Column(heading="difference", unit="%", digits=1),
        ),
        rows=tuple(rows),
    )
    figures = {}
    for comparison in comparisons:
        figures[f"{comparison.robot}/{comparison.joint}"] = asdict(comparison)
    return finish(figures, table)
