"""Simulators by name, path or entry point."""

from __future__ import annotations

from pathlib import Path

from pronk.errors import PronkError
from pronk.identify.simulators.factory import simulator_factory
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.identify.simulators.remote import RemoteSimulator
from pronk.identify.simulators.simulator import JointRigs, RolloutRigs, Simulator
from pronk.robots.robot import RobotSpec


def load_simulator(
    choice: str, robot: RobotSpec, *, threads: int = 2, python: Path | None = None
) -> Simulator:
    """Make a simulator of a robot.

    Args:
        choice: `mujoco`, `FILE.py:NAME`, or an entry point in `pronk.simulators`. What it names is
            called with the robot and returns a `Simulator`.
        robot: The robot.
        threads: Simulations of MuJoCo at the same time.
        python: Interpreter in which the simulator is made (`pronk.identify.simulators.remote`);
            this one if None.

    Raises:
        PronkError: There is no such simulator, or it lacks what the protocol needs.
    """
    if choice == "mujoco":
        if python is not None:
            raise PronkError(
                "simulator mujoco runs in this Python only; leave --simulator-python out, or name "
                "another with --simulator."
            )
        return MujocoSimulator(robot, threads=threads)
    simulator: Simulator
    if python is not None:
        simulator = RemoteSimulator(choice, robot, python)
    else:
        simulator = simulator_factory(choice)(robot)
    members = ("info", "joints", "parameters", "rollout")
    lacking = [name for name in members if not hasattr(simulator, name)]
    if lacking:
        raise PronkError(f"simulator {choice} has no {', '.join(lacking)}; see Simulator.")
    if not {"stiffness", "damping"} <= set(simulator.parameters):
        raise PronkError(
            f"simulator {choice} sets {', '.join(sorted(simulator.parameters)) or 'nothing'}; "
            "expected at least stiffness and damping."
        )
    return simulator


def joint_rigs(
    choice: str, robot: RobotSpec, *, threads: int = 2, python: Path | None = None
) -> JointRigs:
    """Make the rigs of a robot's joints in a simulator; see `load_simulator`."""
    simulator = load_simulator(choice, robot, threads=threads, python=python)
    if isinstance(simulator, MujocoSimulator):
        return simulator
    return RolloutRigs(simulator, robot)
