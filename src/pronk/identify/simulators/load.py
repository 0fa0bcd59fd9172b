"""Simulators by name, path or entry point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pronk.errors import PronkError
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.identify.simulators.remote import RemoteSimulator
from pronk.identify.simulators.simulator import JointRigs, RolloutRigs, Simulator, factory
from pronk.robots.robot import RobotSpec


def load_simulator(
    choice: str,
    robot: RobotSpec,
    *,
    threads: int = 2,
    device: str = "cpu",
    python: Path | None = None,
) -> Simulator:
    """Make a simulator of a robot.

    The choice is `mujoco`, `FILE.py:NAME`, or an entry point in `pronk.simulators`; what it names
    is called with the robot and returns a `Simulator`. Threads are those of MuJoCo; its large runs
    are simulated on `device`, one of `pronk.identify.simulators.mujoco.DEVICES`. With `python`, the
    path of an interpreter, the simulator is made there (`pronk.identify.simulators.remote`). A
    PronkError says that there is no such simulator, or that it lacks what the protocol needs.
    """
    if choice == "mujoco":
        if python is not None:
            raise PronkError(
                "simulator mujoco runs in this Python only; leave --simulator-python out, or name "
                "another with --simulator."
            )
        return MujocoSimulator(robot, threads=threads, device=device)
    if device != "cpu":
        raise PronkError(f"device {device!r} is for simulator mujoco; {choice} has its own.")
    simulator: Simulator = (
        RemoteSimulator(choice, robot, python) if python else factory(choice)(robot)
    )
    members = ("info", "joints", "parameters", "rollout")
    if lacking := [name for name in members if not hasattr(simulator, name)]:
        raise PronkError(f"simulator {choice} has no {', '.join(lacking)}; see Simulator.")
    if not {"stiffness", "damping"} <= set(simulator.parameters):
        raise PronkError(
            f"simulator {choice} sets {', '.join(sorted(simulator.parameters)) or 'nothing'}; "
            "expected at least stiffness and damping."
        )
    return simulator


def joint_rigs(choice: str, robot: RobotSpec, **options: Any) -> JointRigs:
    """Rigs of a robot's joints in a simulator; options and errors are `load_simulator`'s."""
    simulator = load_simulator(choice, robot, **options)
    return simulator if isinstance(simulator, MujocoSimulator) else RolloutRigs(simulator, robot)
