"""Time-domain fits that pronk is compared with: simulated less recorded position, no more.

Free are stiffness, damping and a command delay; armature and dry friction are the model's as they
are. Residuals are at the physics steps, over all segments alike, the mean of equal repeats: it has
the same optimum as every repeat by itself.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from benchmarks.peers import SIGMA, Estimate, fit_sysid, import_peers
from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.segment import Segment
from pronk.identify.match.least_squares import DriveVector, Residuals, minimize_residuals
from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.match.replay import ChainReplay
from pronk.identify.simulators.chain import ChainSimulation, DriveValues, published
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec

FREE = ("stiffness", "damping", "delay")
MAX_DELAY_S = 0.04
BOUNDS = {"stiffness": (2.0, 80.0), "damping": (0.01, 2.0), "delay": (0.0, MAX_DELAY_S)}
"""Bounds far outside of what 17 N m/rad and 0.4 N m s/rad respond like [N m/rad, N m s/rad, s]."""
START_DELAY_S = 0.005
STEP = {"stiffness": 0.02, "damping": 0.002, "delay": 1e-4}
"""Steps of the forward differences: about a thousandth of each parameter."""
POPULATION = 10
"""Candidates in a generation of CMA-ES."""
GENERATIONS = 60
"""Most generations of CMA-ES."""
SPREAD = 1e-3
"""CMA-ES stops when the costs of a generation spread by less than this share of their mean."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One command to a joint and the position that it caused."""

    trace: CommandTrace
    positions: Array
    """At the start of each physics step [rad], shape (repeats, steps)."""


def recordings(log: JointLog, joint: str, robot: RobotSpec) -> list[Recording]:
    """Excitations of a joint in order of time, those of the same kind and amplitude together."""
    by_signal: dict[tuple[str, float], list[tuple[CommandTrace, Array]]] = {}
    for excitation in sorted(
        log.excitations(joint), key=lambda excitation: excitation.segment.start
    ):
        trace = command_trace(excitation, robot)
        position = np.interp(trace.time, excitation.time, excitation.position)
        signal = (excitation.segment.kind, excitation.amplitude)
        by_signal.setdefault(signal, []).append((trace, position))
    grouped = []
    for repeats in by_signal.values():
        steps = min(len(position) for _, position in repeats)
        first = repeats[0][0]
        trace = replace(first, command=first.command[:steps])
        positions = np.array([position[:steps] for _, position in repeats])
        grouped.append(Recording(trace=trace, positions=positions))
    return grouped


def simulated(rigs: JointRigs, recording: Recording, sets: Sequence[Mapping[str, float]]) -> Array:
    """Positions at the start of each step with sets of drive parameters [rad], (b, steps).

    A set has stiffness, damping, armature, frictionloss and delay. The joint begins at rest and
    does not change with time, so a delay of the command is one of the position: a cubic spline
    through the steps is read that much earlier.
    """
    trace = recording.trace
    values = {}
    for name in ("stiffness", "damping", "armature", "frictionloss"):
        values[name] = np.array([drive[name] for drive in sets])
    # A cubic spline needs finite positions; a run that diverged is as wrong as a joint can be.
    undelayed = np.nan_to_num(rigs.play(trace, values), nan=np.pi)
    positions = np.empty_like(undelayed)
    for row, drive in enumerate(sets):
        earlier = np.maximum(trace.time - drive["delay"], trace.time[0])
        positions[row] = CubicSpline(trace.time, undelayed[row])(earlier)
    return positions


class Residual:
    """Simulated less recorded position of some recordings as a function of free parameters."""

    def __init__(
        self,
        rigs: JointRigs,
        parts: Sequence[Recording],
        free: Sequence[str],
        start: Mapping[str, float],
    ) -> None:
        """Fit the parameters `free` of `start`; the others stay."""
        self.rigs = rigs
        self.parts = parts
        self.free = tuple(free)
        self.start = dict(start)
        self.low = np.array([BOUNDS[name][0] for name in self.free])
        self.high = np.array([BOUNDS[name][1] for name in self.free])
        self.steps = np.array([STEP[name] for name in self.free])

    def values(self, x: Array) -> dict[str, float]:
        """All parameters with these free ones."""
        return self.start | dict(zip(self.free, map(float, x), strict=True))

    def __call__(self, sets: Array) -> Array:
        """Residuals [rad] of free parameters of shape (b, p), shape (b, rows)."""
        named = [self.values(x) for x in sets]
        differences = []
        for part in self.parts:
            differences.append(simulated(self.rigs, part, named) - part.positions.mean(axis=0))
        return np.asarray(np.clip(np.concatenate(differences, axis=1), -np.pi, np.pi))

    def jacobian(self, x: Array) -> Array:
        """Forward differences, shape (rows, p)."""
        step = np.where(x + self.steps <= self.high, self.steps, -self.steps)
        before, *after = self(np.vstack([x, x + np.diag(step)]))
        return np.asarray(((np.array(after) - before) / step[:, None]).T)


def start_values(robot: RobotSpec, joint: str) -> dict[str, float]:
    """Nominal gains with a delay to begin with, and the model's armature and dry friction."""
    drive = published(robot, joint) | {"delay": START_DELAY_S}
    del drive["offset"]
    return drive


def fit_plain(
    rigs: JointRigs, log: JointLog, joint: str, free: Sequence[str] = FREE
) -> dict[str, float]:
    """Nonlinear least squares; with `free` the delay alone, nominal gains with the best delay."""
    parts = recordings(log, joint, rigs.robot)
    problem = Residual(rigs, parts, free, start_values(rigs.robot, joint))
    first = np.array([problem.start[name] for name in free])

    def residual(x: Array) -> Array:
        return np.asarray(problem(x[None])[0])

    result = least_squares(
        residual,
        first,
        jac=problem.jacobian,
        bounds=(problem.low, problem.high),
        x_scale=np.maximum(first, 1e-3),
        xtol=1e-6,
        ftol=1e-6,
    )
    return problem.values(result.x)


def arm_residuals(arm: ChainSimulation, free: Sequence[str], start: DriveValues) -> Residuals:
    """Residuals of a whole arm in time, over the samples that pronk uses."""
    replay = ChainReplay(arm)
    samples = [np.ones(len(recording.time), dtype=bool) for recording in replay.recordings]
    vector = DriveVector(dict.fromkeys(arm.joints, tuple(free)), start)
    return Residuals(replay, samples, vector)


def fit_arm(arm: ChainSimulation, free: Sequence[str], start: DriveValues) -> DriveValues:
    """Nonlinear least squares over parameters of all joints of an arm."""
    residuals = arm_residuals(arm, free, start)
    return minimize_residuals(residuals, tolerance=1e-4, evaluations=30).drives()


class UnitBounds:
    """Searched numbers of a drive between -1 and 1, as CMA-ES wants them."""

    def __init__(self, free: Sequence[str]) -> None:
        """Map the bounds of some parameters to -1 and 1."""
        self.free = free
        self.low = np.array([PARAMETERS[name].scaled(PARAMETERS[name].low) for name in free])
        self.high = np.array([PARAMETERS[name].scaled(PARAMETERS[name].high) for name in free])

    def unit(self, drive: Mapping[str, float]) -> Array:
        """Numbers of a drive, shape (p,)."""
        scaled = np.array([PARAMETERS[name].scaled(drive[name]) for name in self.free])
        return np.asarray(2.0 * (scaled - self.low) / (self.high - self.low) - 1.0)

    def values(self, unit: Array) -> dict[str, float]:
        """Parameters that some numbers stand for."""
        share = 0.5 * (np.clip(unit, -1.0, 1.0) + 1.0)
        scaled = self.low + share * (self.high - self.low)
        values = {}
        for name, number in zip(self.free, scaled, strict=True):
            values[name] = PARAMETERS[name].unscaled(float(number))
        return values


def search_cma_arm(
    arm: ChainSimulation, free: Sequence[str], start: DriveValues, seed: int
) -> DriveValues:
    """CMA-ES of each joint of an arm with its own residuals, all joints changed at once."""
    _, cma = import_peers()
    residuals = arm_residuals(arm, free, start)
    bounds = UnitBounds(free)
    searches: dict[str, Any] = {}
    for number, joint in enumerate(arm.joints):
        options = {"bounds": [-1.0, 1.0], "popsize": POPULATION, "verbose": -9}
        options["seed"] = seed + 1 + number
        unit = bounds.unit(start[joint])
        searches[joint] = cma.CMAEvolutionStrategy(unit, SIGMA, options)

    def drives(units: Mapping[str, Array]) -> dict[str, dict[str, float]]:
        changed = {}
        for joint, unit in units.items():
            changed[joint] = {**start[joint], **bounds.values(unit)}
        return changed

    for _ in range(GENERATIONS):
        candidates = {joint: search.ask() for joint, search in searches.items()}
        costs: dict[str, list[float]] = {joint: [] for joint in searches}
        for number in range(POPULATION):
            units = {joint: candidates[joint][number] for joint in searches}
            (positions,) = residuals.replay.positions([drives(units)])
            residual = residuals.compared(positions)
            for joint in searches:
                costs[joint].append(float(np.mean(residual[residuals.rows(joint)] ** 2)))
        settled = True
        for joint, search in searches.items():
            search.tell(candidates[joint], costs[joint])
            if np.ptp(costs[joint]) >= SPREAD * np.mean(costs[joint]):
                settled = False
        if settled:
            break
    return drives({joint: search.result.xfavorite for joint, search in searches.items()})


def search_cma(rigs: JointRigs, log: JointLog, joint: str, *, seed: int) -> dict[str, float]:
    """CMA-ES over the parameters and residuals of `fit_plain`, bounds mapped to -1 to 1."""
    _, cma = import_peers()
    parts = recordings(log, joint, rigs.robot)
    problem = Residual(rigs, parts, FREE, start_values(rigs.robot, joint))
    half = 0.5 * (problem.high - problem.low)
    first = np.array([problem.start[name] for name in FREE])
    options = {
        "bounds": [-1.0, 1.0],
        "popsize": POPULATION,
        "maxiter": GENERATIONS,
        "seed": seed + 1,
        "verbose": -9,
    }
    search = cma.CMAEvolutionStrategy((first - problem.low) / half - 1.0, SIGMA, options)
    while not search.stop():
        unit = search.ask()
        sets = problem.low + half * (np.clip(unit, -1.0, 1.0) + 1.0)
        costs = (problem(sets) ** 2).mean(axis=1)
        search.tell(unit, costs.tolist())
        if np.ptp(costs) < SPREAD * costs.mean():
            break
    best = np.clip(search.result.xfavorite, -1.0, 1.0)
    return problem.values(problem.low + half * (best + 1.0))


def fit_mujoco_sysid(log: JointLog, joint: str, robot: RobotSpec) -> Estimate:
    """Give mujoco.sysid the repeats of the largest amplitude at the physics steps, and a delay.

    Its sequences have one command each, so the smaller amplitude would be another call.
    """
    begin = time.perf_counter()
    largest = max(recordings(log, joint, robot), key=lambda recording: recording.trace.amplitude)
    repeats, steps = largest.positions.shape
    span = steps * robot.timestep_s
    segments = []
    for repeat in range(repeats):
        segments.append(
            Segment(
                kind="chirp",
                joints=(joint,),
                start=repeat * span,
                stop=(repeat + 1) * span - robot.timestep_s,
                amplitude=largest.trace.amplitude,
                repeat=repeat,
            )
        )
    at_steps = JointLog(
        robot=robot.name,
        joints=(joint,),
        time=np.arange(repeats * steps) * robot.timestep_s,
        command=np.tile(largest.trace.command, repeats)[:, None],
        position=largest.positions.reshape(-1, 1),
        segments=tuple(segments),
    )
    start = start_values(robot, joint)
    estimate = fit_sysid(
        at_steps,
        joint,
        robot,
        bounds=(BOUNDS["stiffness"], BOUNDS["damping"]),
        start=(start["stiffness"], start["damping"]),
        delay_bounds_s=BOUNDS["delay"],
        threads=1,
    )
    return replace(estimate, seconds=time.perf_counter() - begin)
