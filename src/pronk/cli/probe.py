"""`pronk probe`: what a simulator makes of the settings of a joint."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import tyro

from pronk.cli import console


def probe(
    simulator: tyro.conf.Positional[str],
    robot: str,
    joint: str | None = None,
    simulator_python: Path | None = None,
) -> console.Outcome:
    """Excite one joint of a simulator; name its drive law and what acts otherwise than it is set.

    Args:
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        joint: The joint; the first one that moves no other if left out.
        simulator_python: Python that the simulator runs in (3.11 or later, with NumPy).
    """
    from pronk.identify.simulators.load import load_simulator
    from pronk.identify.simulators.probe import probe_joint
    from pronk.robots import load_robot

    known = load_robot(robot)
    made = load_simulator(simulator, known, threads=1, python=simulator_python)
    found = probe_joint(made, known, joint)
    info, one = made.info, known.joint(found.joint)
    beside = "E, beside it " if found.beside_explicit else ""
    # Adding 0 makes -0 a 0.
    passive, delay_ms = round(found.viscous_damping, 6) + 0.0, round(1e3 * found.delay_s, 4) + 0.0
    rows: list[list[Any]] = [
        ["law", info.drive_law.label, beside + found.law.label],
        ["stiffness [N m/rad]", one.stiffness, one.stiffness * found.stiffness_factor],
        ["damping [N m s/rad]", one.damping, one.damping * found.damping_factor],
        ["armature [kg m^2]", found.armature_set, found.armature],
        ["passive damping [N m s/rad]", one.drive.viscous_damping, passive],
        ["dry friction [N m]", one.drive.frictionloss, found.frictionloss],
        ["gravity [of the model's]", 1.0, max(found.gravity, 0.0)],
        ["delay [ms]", 0.0, delay_ms],
        ["hold [steps]", 1, found.hold],
    ]
    console.show_table(
        "of the joint | set;4 | acts;4",
        rows,
        f"Steps of {1e3 * info.timestep_s:g} ms. {100.0 * found.residual:.2g} % of the motion is "
        "not explained.",
        title=f"{found.joint} in {info.engine} {info.version}",
    )
    for sentence in found.faults.values():
        console.warn(f"{found.joint}: {sentence}.")
    return console.Outcome(figures={"probe": asdict(found)})
