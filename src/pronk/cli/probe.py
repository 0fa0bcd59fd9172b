"""`pronk probe`: what a simulator makes of a joint's settings, or an actuator network as gains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from pronk.cli import console
from pronk.errors import PronkError
from pronk.tables import Cell, Column, Table

if TYPE_CHECKING:
    from pronk.identify.simulators.actuator_network import NetworkDrive
    from pronk.identify.simulators.info import SimulatorInfo
    from pronk.identify.simulators.probe.result import Probe
    from pronk.robots.robot import Joint

_NETWORK_SUFFIXES = (".pt", ".pth", ".jit", ".torchscript")
"""Endings of files that hold a network."""
_INERTIAS = (0.01, 0.02, 0.05)
"""Inertias of joints of a quadruped of 10 to 15 kg, with their rotors [kg m^2]."""


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """How an actuator network is used."""

    history: float | None = None
    """Time between two samples that the network was trained with, in s."""
    step: float | None = None
    """Time between two samples that it is used with, in s; as in training if left out."""
    order: Literal["position-first", "velocity-first"] = "position-first"
    """What comes first in its input, the position errors or the velocities."""
    ages: str | None = None
    """Ages of the samples in the order of the input; 0,1,2,... if left out."""
    error: Literal["auto", "target-less-position", "position-less-target"] = "auto"
    """What a position error of its input is; auto: that whose torque acts towards the target."""
    position_scale: float = 1.0
    """Factor on the position errors in rad."""
    velocity_scale: float = 1.0
    """Factor on the velocities in rad/s."""
    torque_scale: float = 1.0
    """Factor on the output, which makes it N m."""
    drive_gains: str | None = None
    """STIFFNESS,DAMPING on the drive that it was trained on, to compare with."""
    inertia: tuple[float, ...] = ()
    """Inertia of a joint in kg m^2, rotor included, for the comparison; repeat it."""


def probe(
    simulator: tyro.conf.Positional[str],
    robot: str | None = None,
    joint: str | None = None,
    simulator_python: Path | None = None,
    network: NetworkOptions = NetworkOptions(),
) -> console.Outcome:
    """Name the drive law of a simulator's joint, or read an actuator network as gains.

    One joint of a simulator is excited: its drive law, and what acts otherwise than it is set. An
    actuator network (TorchScript) is read as a drive: stiffness, damping, delay and limits.

    Example:
        pronk probe mujoco --robot mini_cheetah --joint FR_knee
        pronk probe NET.pt --history 0.02 --step 0.005 --drive-gains 20,.5

    Args:
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator; or NET.pt, an
            actuator network.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; of a simulator.
        joint: The joint; the first one that moves no other if left out.
        simulator_python: Python that the simulator runs in (3.11 or later, with NumPy).
        network: How an actuator network is used.
    """
    is_network = simulator.lower().endswith(_NETWORK_SUFFIXES)
    if is_network:
        if robot is not None or joint is not None or simulator_python is not None:
            raise PronkError(
                f"{simulator} is an actuator network, which is read without a robot; leave out "
                "--robot, --joint and --simulator-python."
            )
        return probe_network_file(Path(simulator), network)
    if network != NetworkOptions():
        raise PronkError(
            f"--history, --step and the other options of networks are of a file that ends in "
            f"{', '.join(_NETWORK_SUFFIXES)}, and {simulator} is a simulator; leave them out."
        )
    if robot is None:
        raise PronkError(
            f"--robot is missing: a name, or a path to a robot.yaml, MJCF or URDF, whose joint is "
            f"probed in {simulator}."
        )
    return probe_simulator(simulator, robot, joint, simulator_python)


def probe_simulator(
    simulator: str, robot: str, joint: str | None, simulator_python: Path | None
) -> console.Outcome:
    """Excite one joint of a simulator, and print what acts beside what is set."""
    from pronk.identify.simulators.load import load_simulator
    from pronk.identify.simulators.probe.probe import probe_joint
    from pronk.robots import load_robot

    robot_spec = load_robot(robot)
    engine = load_simulator(simulator, robot_spec, threads=1, python=simulator_python)
    result = probe_joint(engine, robot_spec, joint)
    console.show(acting_table(result, robot_spec.joint(result.joint), engine.info))
    for sentence in result.faults.values():
        console.warn(f"{result.joint}: {sentence}.")
    return console.Outcome(figures={"probe": asdict(result)})


def acting_table(probe: Probe, joint: Joint, info: SimulatorInfo) -> Table:
    """Return what acts at a joint beside what is set; of a law that was not found, its hold alone.

    Args:
        probe: What the joint responds like.
        joint: The joint with what is set.
        info: The simulator.
    """
    law_name = probe.law.label
    for other in probe.alike:
        law_name += f" or {other.label}"
    # Adding 0 makes -0 a 0.
    viscous_damping = round(probe.viscous_damping, 4) + 0.0
    delay_ms = round(1e3 * probe.delay_s, 4) + 0.0
    acting: list[Cell] = [
        joint.stiffness * probe.gains.stiffness_factor,
        joint.damping * probe.gains.damping_factor,
        probe.armature,
        viscous_damping,
        probe.frictionloss,
        max(probe.gravity, 0.0),
        delay_ms,
    ]
    if not probe.law_found:
        # Values of a law that does not explain the motion are no measurement.
        law_name = "none of the laws" if probe.complete else "not found"
        acting = [None] * len(acting)
    drive = joint.drive
    settings: list[tuple[str, Cell]] = [
        ("stiffness [N m/rad]", joint.stiffness),
        ("damping [N m s/rad]", joint.damping),
        ("armature [kg m^2]", drive.armature),
        ("passive damping [N m s/rad]", drive.viscous_damping),
        ("dry friction [N m]", drive.frictionloss),
        ("gravity [of the model's]", 1.0),
        ("delay [ms]", 0.0),
    ]
    rows: list[tuple[Cell, ...]] = [("law", info.drive_law.label, law_name)]
    for (name, set_value), acting_value in zip(settings, acting, strict=True):
        rows.append((name, set_value, acting_value))
    rows.append(("hold [steps]", 1, probe.hold))
    return Table(
        title=f"{probe.joint} in {info.engine} {info.version}",
        columns=(
            Column(heading="of the joint"),
            Column(heading="set", digits=4),
            Column(heading="acts", digits=4),
        ),
        rows=tuple(rows),
        notes=(
            f"Steps of {1e3 * info.timestep_s:g} ms. {100.0 * probe.residual:.2g} % of the "
            "motion is not explained.",
        ),
    )


def probe_network_file(path: Path, options: NetworkOptions) -> console.Outcome:
    """Read an actuator network as a drive, and print its gains."""
    from pronk.identify.simulators.actuator_network import (
        NetworkInput,
        compared_db,
        network_faults,
        probe_network,
    )

    if options.history is None:
        raise PronkError(
            "--history is missing: the time between two samples that the network was trained with, "
            "in s. The network does not say it; it is the rate of the log of its training, as in "
            "--history 0.02 for 50 Hz."
        )
    other_gains = None if options.drive_gains is None else _two_numbers(options.drive_gains)
    if options.inertia and other_gains is None:
        raise PronkError("--inertia is for a comparison: give --drive-gains STIFFNESS,DAMPING too.")
    for inertia in options.inertia:
        if not 0.0 < inertia < 1e3:
            raise PronkError(f"--inertia {inertia:g}; expected kg m^2 above 0, as in 0.02.")
    step_s = options.history if options.step is None else options.step
    drive = probe_network(
        path,
        history_s=options.history,
        step_s=step_s,
        network_input=NetworkInput(
            order=options.order,
            ages=_ages(options.ages),
            error=options.error,
            position_scale=options.position_scale,
            velocity_scale=options.velocity_scale,
            torque_scale=options.torque_scale,
        ),
    )
    faults = network_faults(drive)
    console.show(gains_by_step_table(path.name, drive))
    console.show(away_from_rest_table(drive))
    figures = network_figures(drive)
    figures["faults"] = faults
    if other_gains is not None:
        rows: list[tuple[Cell, ...]] = []
        for inertia in options.inertia or _INERTIAS:
            trained_db = compared_db(drive.gains, other_gains, inertia, drive.trained.step_s)
            used_db = compared_db(drive.gains, other_gains, inertia, drive.used.step_s)
            rows.append((inertia, trained_db, used_db))
        console.show(compared_table(drive, other_gains, rows))
        figures["compared"] = []
        for inertia_cell, trained_cell, used_cell in rows:
            figures["compared"].append(
                {"inertia": inertia_cell, "trained_db": trained_cell, "used_db": used_cell}
            )
    for sentence in faults.values():
        console.warn(f"{path.name}: {sentence}.")
    used = drive.used
    following = []
    if used.damping >= 0.0:
        # The torque of a network is computed from the state at the start of a step: law E.
        following.append(
            f"pronk translate --robot ROBOT --from mjlab,timestep_s={step_s:g} --drive-gains "
            f"JOINT={used.stiffness:.4g},{used.damping:.3g} --to isaaclab-implicit   "
            f"# and a delay of {1e3 * used.delay_s:.3g} ms"
        )
    return console.Outcome(figures=figures, following=following)


def _ages(text: str | None) -> tuple[int, ...]:
    """Return the ages of samples of `--ages`; empty if it was left out."""
    if text is None:
        return ()
    words = text.split(",")
    if not all(word.strip().isdecimal() and len(word) < 6 for word in words):
        raise PronkError(f"--ages {text!r}; expected whole numbers with commas, as in 0,1,2.")
    return tuple(int(word) for word in words)


def _two_numbers(text: str) -> tuple[float, float]:
    """Return stiffness and damping of `--drive-gains`."""
    from pronk.cli.options import drive_gains

    gains = drive_gains([f"drive={text}"])
    assert isinstance(gains, dict)
    return gains["drive"]


def gains_by_step_table(name: str, drive: NetworkDrive) -> Table:
    """Return the table of a network's drive at several times between two samples."""
    rows: list[tuple[Cell, ...]] = []
    for gains in drive.by_step:
        roles = []
        if gains.step_s == drive.trained.step_s:
            roles.append("as trained")
        if gains.step_s == drive.used.step_s:
            roles.append("as used")
        rows.append(
            (
                1e3 * gains.step_s,
                ", ".join(roles),
                gains.stiffness,
                gains.damping,
                1e3 * gains.delay_s,
            )
        )
    linear = "over a turn"
    if math.isfinite(drive.linear_to_rad):
        linear = f"to an error of {drive.linear_to_rad:.2f} rad"
    return Table(
        title=f"{name} as a drive, near rest",
        columns=(
            Column(heading="samples apart", unit="ms", digits=2),
            Column(heading=""),
            Column(heading="stiffness", unit="N m/rad", digits=2),
            Column(heading="damping", unit="N m s/rad", digits=3),
            Column(heading="delay", unit="ms", digits=2),
        ),
        rows=tuple(rows),
        notes=(
            f"Errors in its input are {drive.error.replace('-', ' ')}.",
            f"Torque at rest {drive.lowest_torque:.1f} to {drive.highest_torque:.1f} N m, linear "
            f"{linear}; {drive.offset:.3f} N m without an error.",
        ),
    )


def away_from_rest_table(drive: NetworkDrive) -> Table:
    """Return the table of stiffness and damping at larger errors and speeds."""
    rows: list[tuple[Cell, ...]] = []
    for (error, stiffness), (speed, damping) in zip(
        drive.stiffness_at.items(), drive.damping_at.items(), strict=True
    ):
        rows.append((error, stiffness, speed, damping))
    return Table(
        title=f"Away from rest, samples {1e3 * drive.used.step_s:g} ms apart",
        columns=(
            Column(heading="error", unit="rad", digits=2),
            Column(heading="stiffness", unit="N m/rad", digits=2),
            Column(heading="speed", unit="rad/s", digits=1),
            Column(heading="damping", unit="N m s/rad", digits=3),
        ),
        rows=tuple(rows),
    )


def compared_table(
    drive: NetworkDrive, gains: tuple[float, float], rows: Sequence[tuple[Cell, ...]]
) -> Table:
    """Return the table of a joint with the network beside one with some gains."""
    return Table(
        title=f"The joint beside one with {gains[0]:g} N m/rad and {gains[1]:g} N m s/rad",
        columns=(
            Column(heading="inertia", unit="kg m^2", digits=4),
            Column(heading=f"{1e3 * drive.trained.step_s:g} ms, as trained", unit="dB", digits=2),
            Column(heading=f"{1e3 * drive.used.step_s:g} ms, as used", unit="dB", digits=2),
        ),
        rows=tuple(rows),
        notes=("RMS of the difference of the gains from 0.5 to 15 Hz, over log frequency.",),
    )


def network_figures(drive: NetworkDrive) -> dict[str, Any]:
    """Return the figures of a network for `--json`."""
    return {
        "error": drive.error,
        "ages": drive.gains.ages,
        "error_gains": drive.gains.error_gains,
        "velocity_gains": drive.gains.velocity_gains,
        "offset": drive.offset,
        "by_step": [asdict(gains) for gains in drive.by_step],
        "trained": asdict(drive.trained),
        "used": asdict(drive.used),
        "stiffness_at": drive.stiffness_at,
        "damping_at": drive.damping_at,
        "torque_limits": (drive.lowest_torque, drive.highest_torque),
        "linear_to_rad": drive.linear_to_rad,
    }
