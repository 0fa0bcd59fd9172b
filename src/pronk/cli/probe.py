"""`pronk probe`: what a simulator makes of the settings of a joint."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import tyro

from pronk.cli import console
from pronk.tables import Column, Table


def probe(
    simulator: tyro.conf.Positional[str],
    robot: str,
    joint: str | None = None,
    simulator_python: Path | None = None,
) -> console.Outcome:
    """Excite one joint of a simulator; name its drive law and what acts otherwise than it is set.

    Example:
        pronk probe mujoco --robot mini_cheetah --joint FR_knee

    Args:
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        joint: The joint; the first one that moves no other if left out.
        simulator_python: Python that the simulator runs in (3.11 or later, with NumPy).
    """
    from pronk.identify.simulators.load import load_simulator
    from pronk.identify.simulators.probe import probe_joint
    from pronk.robots import load_robot

    robot_spec = load_robot(robot)
    engine = load_simulator(simulator, robot_spec, threads=1, python=simulator_python)
    result = probe_joint(engine, robot_spec, joint)
    info = engine.info
    probed_joint = robot_spec.joint(result.joint)
    drive = probed_joint.drive
    acting_law = result.law.label
    for other in result.alike:
        acting_law += f" or {other.label}"
    if "residual" in result.faults:
        acting_law = "none of the laws"
    acting_stiffness = probed_joint.stiffness * result.gains.stiffness_factor
    acting_damping = probed_joint.damping * result.gains.damping_factor
    # Adding 0 makes -0 a 0.
    viscous_damping = round(result.viscous_damping, 4) + 0.0
    delay_ms = round(1e3 * result.delay_s, 4) + 0.0
    table = Table(
        title=f"{result.joint} in {info.engine} {info.version}",
        columns=(
            Column(heading="of the joint"),
            Column(heading="set", digits=4),
            Column(heading="acts", digits=4),
        ),
        rows=(
            ("law", info.drive_law.label, acting_law),
            ("stiffness [N m/rad]", probed_joint.stiffness, acting_stiffness),
            ("damping [N m s/rad]", probed_joint.damping, acting_damping),
            ("armature [kg m^2]", drive.armature, result.armature),
            ("passive damping [N m s/rad]", drive.viscous_damping, viscous_damping),
            ("dry friction [N m]", drive.frictionloss, result.frictionloss),
            ("gravity [of the model's]", 1.0, max(result.gravity, 0.0)),
            ("delay [ms]", 0.0, delay_ms),
            ("hold [steps]", 1, result.hold),
        ),
        notes=(
            f"Steps of {1e3 * info.timestep_s:g} ms. {100.0 * result.residual:.2g} % of the "
            "motion is not explained.",
        ),
    )
    console.show(table)
    for sentence in result.faults.values():
        console.warn(f"{result.joint}: {sentence}.")
    return console.Outcome(figures={"probe": asdict(result)})
