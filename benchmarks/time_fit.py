"""Time-domain fits that pronk is compared with: simulated less recorded position, no more.

Free are stiffness, damping and a command delay; armature and dry friction are the model's as they
are. Residuals are at the physics steps, over all segments alike, the mean of equal repeats: it has
the same optimum as every repeat by itself.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from benchmarks.peers import SIGMA, Estimate, fit_sysid, import_peers
from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog, group_repeats
from pronk.identify.logs.segment import Segment
from pronk.identify.match.arm import ArmProblem, trusted
from pronk.identify.match.fit import solve
from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.simulators.chain import ChainSimulation, DriveValues, published
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec

FREE = ("stiffness", "damping", "delay")
MAX_DELAY_S = 0.04
BOUNDS = {"stiffness": (2.0, 80.0), "damping": (0.01, 2.0), "delay": (0.0, MAX_DELAY_S)}
"""Far outside of what 17 N m/rad and .4 N m s/rad respond like [N m/rad, N m s/rad, s]."""
START_DELAY_S = 0.005
_STEP = {"stiffness": 0.02, "damping": 0.002, "delay": 1e-4}
"""Of the forward differences: about a thousandth of each."""
POPULATION, GENERATIONS = 10, 60
SPREAD = 1e-3
"""CMA-ES stops when the costs of a generation spread by less than this share of their mean."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One command to a joint and the position that it caused."""

    trace: CommandTrace
    positions: Array
    """At the start of each physics step [rad], shape (repeats, steps)."""


def recordings(log: JointLog, joint: str, robot: RobotSpec) -> list[Recording]:
    """Excitations of a joint, repeats together."""
    found = []
    for repeats in group_repeats(log.excitations(joint)):
        traces, positions = [], []
        for repeat in repeats:
            traces.append(command_trace(repeat, robot))
            positions.append(np.interp(traces[-1].time, repeat.time, repeat.position))
        steps = min(len(position) for position in positions)
        trace = replace(traces[0], command=traces[0].command[:steps])
        rows = np.array([position[:steps] for position in positions])
        found.append(Recording(trace=trace, positions=rows))
    return found


def simulated(rigs: JointRigs, recording: Recording, sets: Sequence[Mapping[str, float]]) -> Array:
    """Positions at the start of each step with sets of drive parameters [rad], (b, steps).

    A set has stiffness, damping, armature, frictionloss and delay. The joint begins at rest and
    does not change with time, so a delay of the command is one of the position: a cubic spline
    through the steps is read that much earlier.
    """
    trace = recording.trace
    names = ("stiffness", "damping", "armature", "frictionloss")
    undelayed = rigs.play(trace, {name: np.array([one[name] for one in sets]) for name in names})
    earlier = [np.maximum(trace.time - one["delay"], trace.time[0]) for one in sets]
    # A cubic spline needs finite positions; a run that diverged is as wrong as a joint can be.
    finite = np.nan_to_num(undelayed, nan=np.pi)
    rows = [CubicSpline(trace.time, row)(at) for row, at in zip(finite, earlier, strict=True)]
    return np.array(rows)


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
        self.rigs, self.parts, self.free, self.start = rigs, parts, tuple(free), dict(start)
        self.low, self.high = np.array([BOUNDS[name] for name in self.free]).T
        self.steps = np.array([_STEP[name] for name in self.free])

    def values(self, x: Array) -> dict[str, float]:
        """All parameters with these free ones."""
        return self.start | dict(zip(self.free, map(float, x), strict=True))

    def __call__(self, sets: Array) -> Array:
        """Residuals [rad] of free parameters of shape (b, p), shape (b, rows)."""
        named = [self.values(x) for x in sets]
        rows = [simulated(self.rigs, p, named) - p.positions.mean(axis=0) for p in self.parts]
        return np.asarray(np.clip(np.concatenate(rows, axis=1), -np.pi, np.pi))

    def jacobian(self, x: Array) -> Array:
        """Forward differences, shape (rows, p)."""
        step = np.where(x + self.steps <= self.high, self.steps, -self.steps)
        before, *after = self(np.vstack([x, x + np.diag(step)]))
        return np.asarray(((np.array(after) - before) / step[:, None]).T)


def start_values(robot: RobotSpec, joint: str) -> dict[str, float]:
    """Nominal gains with a delay to begin with, and the model's armature and dry friction."""
    known = published(robot, joint) | {"delay": START_DELAY_S}
    del known["offset"]
    return known


def fit_plain(
    rigs: JointRigs, log: JointLog, joint: str, free: Sequence[str] = FREE
) -> dict[str, float]:
    """Nonlinear least squares; with `free` the delay alone, nominal gains with the best delay."""
    parts = recordings(log, joint, rigs.robot)
    problem = Residual(rigs, parts, free, start_values(rigs.robot, joint))
    first = np.array([problem.start[name] for name in free])

    def residual(x: Array) -> Array:
        return np.asarray(problem(x[None])[0])

    found = least_squares(
        residual,
        first,
        jac=problem.jacobian,
        bounds=(problem.low, problem.high),
        x_scale=np.maximum(first, 1e-3),
        xtol=1e-6,
        ftol=1e-6,
    )
    return problem.values(found.x)


def arm_problem(arm: ChainSimulation, free: Sequence[str], start: DriveValues) -> ArmProblem:
    """Residuals of a whole arm in time, over the samples that pronk uses."""
    fitted = dict.fromkeys(arm.joints, tuple(free))
    return ArmProblem(arm, trusted(arm)[0], fitted, start, start, lambda _: None)


def fit_arm(arm: ChainSimulation, free: Sequence[str], start: DriveValues) -> DriveValues:
    """Nonlinear least squares over parameters of all joints of an arm."""
    problem = arm_problem(arm, free, start)
    return problem.values(solve(problem, tolerance=1e-4, rounds=30).x)


def search_cma_arm(
    arm: ChainSimulation, free: Sequence[str], start: DriveValues, seed: int
) -> DriveValues:
    """CMA-ES of each joint of an arm with its own residuals, all joints changed at once."""
    _, cma = import_peers()
    problem, kinds = arm_problem(arm, free, start), [PARAMETERS[name] for name in free]
    low, high = (np.array([k.scaled(getattr(k, end)) for k in kinds]) for end in ("low", "high"))

    def drives(units: Sequence[Array]) -> dict[str, dict[str, float]]:
        points = [low + 0.5 * (high - low) * (np.clip(unit, -1.0, 1.0) + 1.0) for unit in units]
        return {
            joint: {
                **start[joint],
                **{n: k.unscaled(v) for n, k, v in zip(free, kinds, at, strict=True)},
            }
            for joint, at in zip(arm.joints, points, strict=True)
        }

    options = {"bounds": [-1.0, 1.0], "popsize": POPULATION, "verbose": -9}
    searches = []
    for k, joint in enumerate(arm.joints):
        first = np.array([one.scaled(start[joint][n]) for n, one in zip(free, kinds, strict=True)])
        unit = 2.0 * (first - low) / (high - low) - 1.0
        searches.append(cma.CMAEvolutionStrategy(unit, SIGMA, options | {"seed": seed + 1 + k}))
    for _ in range(GENERATIONS):
        candidates = [search.ask() for search in searches]
        costs = []
        for units in zip(*candidates, strict=True):
            residual = problem.residuals(arm.run([drives(units)])[0])
            costs.append([float(np.mean(residual[problem.block(j)] ** 2)) for j in arm.joints])
        for search, units, column in zip(searches, candidates, np.transpose(costs), strict=True):
            search.tell(units, column.tolist())
        if all(np.ptp(column) < SPREAD * np.mean(column) for column in np.transpose(costs)):
            break
    return drives([search.result.xfavorite for search in searches])


def search_cma(rigs: JointRigs, log: JointLog, joint: str, *, seed: int) -> dict[str, float]:
    """CMA-ES over the parameters and residuals of `fit_plain`, bounds mapped to -1 to 1."""
    _, cma = import_peers()
    problem = Residual(
        rigs, recordings(log, joint, rigs.robot), FREE, start_values(rigs.robot, joint)
    )
    half = 0.5 * (problem.high - problem.low)
    first = np.array([problem.start[name] for name in FREE])
    options = {"bounds": [-1.0, 1.0], "popsize": POPULATION, "maxiter": GENERATIONS}
    options |= {"seed": seed + 1, "verbose": -9}
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
    largest = max(recordings(log, joint, robot), key=lambda one: one.trace.amplitude)
    repeats, steps = largest.positions.shape
    span = steps * robot.timestep_s
    segments = [
        Segment(
            kind="chirp",
            joints=(joint,),
            start=k * span,
            stop=(k + 1) * span - robot.timestep_s,
            amplitude=largest.trace.amplitude,
            repeat=k,
        )
        for k in range(repeats)
    ]
    at_steps = JointLog(
        robot=robot.name,
        joints=(joint,),
        time=np.arange(repeats * steps) * robot.timestep_s,
        command=np.tile(largest.trace.command, repeats)[:, None],
        position=largest.positions.reshape(-1, 1),
        segments=tuple(segments),
    )
    start = start_values(robot, joint)
    found = fit_sysid(
        at_steps,
        joint,
        robot,
        bounds=(BOUNDS["stiffness"], BOUNDS["damping"]),
        start=(start["stiffness"], start["damping"]),
        delay_bounds_s=BOUNDS["delay"],
        threads=1,
    )
    return replace(found, seconds=time.perf_counter() - begin)
