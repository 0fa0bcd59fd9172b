"""Recordings simulated again: what joints would have done with other drives.

A `Replay` has recordings and simulates them with many sets of drives at once. A joint that was
excited alone is a chain with one moving joint, so one interface serves both: `JointReplay` runs on
the rigs of any simulator, `ChainReplay` on the whole chain in the training simulator.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from pronk.arrays import Array
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.match.recordings import Recording, chain_recordings, joint_recordings
from pronk.identify.simulators.chain import ChainSimulation, DriveValues, has_stribeck
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec


class Replay(ABC):
    """Recordings of joints, and their simulation with other drives."""

    joints: tuple[str, ...]
    """Joints whose drives can be fitted."""
    recordings: Sequence[Recording]
    delay_step_s = PARAMETERS["delay"].step
    """Finite difference of the delay [s]."""
    step_s: float
    """Physics step of the simulator [s]."""
    uncertain_s: tuple[float, float] = (0.0, 0.0)
    """How much earlier and later the commands may have been sent than they are simulated [s]: the
    delay of the drive is then longer or shorter."""

    @abstractmethod
    def fittable(self, joint: str, parameters: Sequence[str]) -> tuple[str, ...]:
        """Choose of some parameters those that the simulation of a joint can be given."""

    @abstractmethod
    def positions(self, sets: Sequence[DriveValues]) -> list[list[Array]]:
        """Simulate all recordings with several sets of drives.

        Args:
            sets: Every parameter of every joint, for each simulation.

        Returns:
            For each set, the position of each recording at its samples [rad], shape (n,); NaN
            where a simulation diverged.
        """

    def remarks(self, joint: str) -> tuple[str, ...]:
        """Say what of a joint's recordings is not used, one sentence each."""
        return ()


class JointReplay(Replay):
    """Excitations of one joint that moved alone, on the rigs of any simulator.

    The joint begins at rest and does not change with time, so a delay of its command is the same
    delay of its position. Simulations are kept without the delay, so another delay needs none.
    """

    delay_step_s = 1e-4
    """Finite difference of the delay [s]. It may be small, for the simulated position is a smooth
    function of time, without the chatter of dry friction in another simulation."""

    def __init__(self, rigs: JointRigs, excitations: Sequence[Excitation]) -> None:
        """Take the excitations of one joint; those with the same command are repeats.

        Raises:
            LogError: The unit of the joint is not radians.
        """
        self.joints = (excitations[0].joint,)
        self.step_s = rigs.robot.timestep_s
        self._rigs = rigs
        self._traces: list[CommandTrace] = []
        """The commands: of each the first, the largest amplitude first."""
        sorted_excitations = []
        sorted_traces = []
        commands = []
        for command, group in enumerate(_by_command(excitations, rigs.robot)):
            self._traces.append(group[0][1])
            for excitation, trace in group:
                sorted_excitations.append(excitation)
                sorted_traces.append(trace)
                commands.append(command)
        self.recordings = joint_recordings(sorted_excitations, sorted_traces, commands)
        earlier = max(trace.uncertain_s[0] for trace in sorted_traces)
        later = max(trace.uncertain_s[1] for trace in sorted_traces)
        self.uncertain_s = (earlier, later)
        self._names = []
        for name, parameter in PARAMETERS.items():
            if parameter.acts_on == "drive" and name in rigs.parameters:
                self._names.append(name)
        if rigs.sets_effort_limit:
            self._names.append("effort_limit")
        self._tracks: dict[tuple[float, ...], list[PPoly]] = {}

    def fittable(self, joint: str, parameters: Sequence[str]) -> tuple[str, ...]:
        """Choose the parameters that the simulator can set, and the delay."""
        return tuple(name for name in parameters if name == "delay" or name in self._names)

    def positions(self, sets: Sequence[DriveValues]) -> list[list[Array]]:
        """Simulate all recordings with several drives; see `Replay.positions`."""
        keys = []
        new_keys = []
        for drives in sets:
            drive = drives[self.joints[0]]
            key = tuple(drive[name] for name in self._names)
            keys.append(key)
            if key not in self._tracks and key not in new_keys:
                new_keys.append(key)
        self._simulate(new_keys)
        results = []
        for drives, key in zip(sets, keys, strict=True):
            delay = drives[self.joints[0]]["delay"]
            positions = []
            for recording in self.recordings:
                trace = self._traces[recording.command]
                end = (len(trace.command) - 1) * trace.timestep
                instants = np.clip(recording.time - delay, 0.0, end)
                positions.append(self._tracks[key][recording.command](instants))
            results.append(positions)
        return results

    def _simulate(self, keys: Sequence[tuple[float, ...]]) -> None:
        """Simulate every command with some drives, without delay, and keep the positions."""
        if not keys:
            return
        robot = self._rigs.robot
        joint = self.joints[0]
        centre = self._traces[0].pose[robot.joint_names.index(joint)]
        sign = robot.joint(joint).original[1]
        columns = np.repeat(np.array(keys), len(self._traces), axis=0).T
        values = dict(zip(self._names, columns, strict=True))
        runs = list(self._traces) * len(keys)
        steps = max(len(trace.command) for trace in self._traces)
        simulated = np.empty((len(runs), steps))
        for part, position in self._rigs.run(runs, values, steps):
            simulated[part] = position
        # A spline needs finite positions; a simulation that diverged is as wrong as can be.
        simulated = np.clip(np.nan_to_num(simulated, nan=np.pi), -np.pi, np.pi)
        simulated = centre + sign * simulated
        for key in keys:
            self._tracks[key] = []
        for number, trace in enumerate(self._traces):
            count = len(trace.command)
            instants = trace.timestep * np.arange(count)
            # Most of a spline's time is the call, so one call makes those of all drives.
            splines = CubicSpline(instants, simulated[number :: len(self._traces), :count], axis=1)
            for row, key in enumerate(keys):
                self._tracks[key].append(PPoly(splines.c[:, :, row], splines.x))


def _by_command(
    excitations: Sequence[Excitation], robot: RobotSpec
) -> list[list[tuple[Excitation, CommandTrace]]]:
    """Group excitations of a joint, with their commands at the physics steps, by the command.

    The largest amplitude comes first.
    """
    groups: list[list[tuple[Excitation, CommandTrace]]] = []
    for excitation in excitations:
        trace = command_trace(excitation, robot)
        for group in groups:
            if group[0][1].same_as(trace, robot):
                group.append((excitation, trace))
                break
        else:
            groups.append([(excitation, trace)])
    return sorted(groups, key=lambda group: -group[0][1].amplitude)


class ChainReplay(Replay):
    """Joints of one chain (a leg, an arm) that moved together, in the training simulator."""

    def __init__(self, simulation: ChainSimulation) -> None:
        """Take what a chain's simulation has recorded.

        Raises:
            LogError: The logs are too short for intervals.
        """
        self.joints = simulation.joints
        self.simulation = simulation
        self.step_s = simulation.robot.timestep_s
        self._chain = chain_recordings(simulation)
        self.recordings = self._chain.recordings
        self.trusted_hz = self._chain.trusted_hz
        """Frequency up to which each joint's samples are used [Hz]; infinite if all are."""

    def fittable(self, joint: str, parameters: Sequence[str]) -> tuple[str, ...]:
        """Add the fall of the friction with speed where a drive's friction has a Stribeck speed."""
        if "frictionloss" in parameters and has_stribeck(self.simulation.robot, joint):
            return (*parameters, "stribeck")
        return tuple(parameters)

    def positions(self, sets: Sequence[DriveValues]) -> list[list[Array]]:
        """Simulate all recordings with several sets of drives; see `Replay.positions`."""
        results = []
        for logs in self.simulation.run(sets):
            positions = []
            for k, recording in enumerate(self.recordings):
                column = self.joints.index(recording.joint)
                positions.append(logs[self._chain.log[k]][self._chain.samples[k], column])
            results.append(positions)
        return results

    def remarks(self, joint: str) -> tuple[str, ...]:
        """Say up to which frequency the recordings of a joint are used."""
        limit_hz = self.trusted_hz[joint]
        if not np.isfinite(limit_hz):
            return ()
        percent = 100.0 * self._chain.trusted_share[joint]
        return (
            f"used up to {limit_hz:.2g} Hz, where the coherence falls "
            f"({percent:.0f} % of the samples)",
        )
