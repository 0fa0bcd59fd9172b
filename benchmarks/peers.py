"""The peers of a match: mujoco.sysid, and a CMA-ES fit in the time domain in the manner of PACE.

Both are used through their public interface with their defaults, and can also be given the delay
parameter that they have of their own.

- `mujoco.sysid` (in MuJoCo, Apache-2.0): nonlinear least squares on the positions, intervals from
  the Jacobian at the optimum with residuals taken for independent.
- PACE (leggedrobotics/pace-sim2real) runs CMA-ES on the mean squared position error of 4,096
  simulations at once, on a GPU in Isaac Lab, and fits other parameters (armature, friction, bias
  and a delay in whole steps). What is run here is its manner: CMA-ES from the `cma` package,
  bounds mapped to [-1, 1], sigma 0.5, mean squared position error, a stop at a small relative
  spread of the population; but a population of 32, this MuJoCo model on the CPU, and the two gains
  as the parameters. It does not show PACE's own speed.
"""

from __future__ import annotations

import copy
import io
import time
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.robots.model import bench_spec, set_drive_gains
from pronk.robots.robot import RobotSpec

Bounds = tuple[tuple[float, float], tuple[float, float]]
"""Lowest and highest stiffness, lowest and highest damping."""

POPULATION = 32
"""Candidates in a generation; PACE has as many as simulated environments, 4,096."""
SIGMA = 0.5
"""First step of CMA-ES as a share of half the bounds (PACE)."""
GENERATIONS = 200
"""Most generations of CMA-ES (PACE)."""
SPREAD = 1e-4
"""CMA-ES stops when the costs of a generation spread by less than this share of their mean."""
SAME = 1e-9
"""Commands and sample intervals that differ by less are the same [rad, s]."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Result of one tool for one log."""

    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    interval: Bounds | None = None
    """95 % intervals of stiffness and of damping; None if the tool has none."""
    seconds: float
    """Wall time of the fit [s]."""
    delay_s: float | None = None
    """Delay, where it was fitted [s]."""


def import_peers() -> tuple[Any, Any]:
    """Return the packages mujoco.sysid and cma.

    Raises:
        PronkError: One of them, or a dependency of it, is not installed.
    """
    try:
        import cma
        from mujoco import sysid
    except ImportError as error:
        raise PronkError(
            "this benchmark needs the extra packages mujoco.sysid and cma (CMA-ES), "
            f"but {error.name} is not installed; `pip install pronk[bench]` brings it."
        ) from None
    return sysid, cma


class Replay:
    """A log as time-domain tools need it: commands and positions at the physics steps."""

    def __init__(self, log: JointLog, joint: str, robot: RobotSpec) -> None:
        """Read a log whose segments have one and the same command; held joints do not move.

        Raises:
            LogError: It is not sampled at the physics steps, or its repeats differ in their
                commands.
        """
        self.robot = robot
        self.joint = joint
        self.spec = bench_spec(robot, joint)
        self.spec.add_sensor(
            name=joint,
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
        self.model = self.spec.compile()
        self.column = int(self.model.joint(joint).qposadr[0])
        parts = []
        for segment in log.segments:
            if joint in segment.joints:
                parts.append(log.cut(segment))
        if not parts:
            raise LogError(f"{log.source}: no segment excites {joint}.")
        commands = [part.command[:, part.column(joint)] for part in parts]
        for part, command in zip(parts, commands, strict=True):
            if np.abs(np.diff(part.time) - robot.timestep_s).max() > SAME:
                raise LogError(
                    f"{log.source}: sampled every {np.diff(part.time).mean():.6f} s; the peers "
                    f"replay row by row and need exactly the physics step of {robot.timestep_s} s."
                )
            if len(command) != len(commands[0]) or np.abs(command - commands[0]).max() > SAME:
                raise LogError(f"{log.source}: the repeats of {joint} differ in their commands.")
        names = [self.model.actuator(i).name for i in range(self.model.nu)]
        pose = [robot.joint(name).default_position for name in names]
        self.control = np.tile(pose, (len(commands[0]), 1))
        """Command of every drive at each step [rad], shape (steps, drives)."""
        self.control[:, names.index(joint)] = commands[0]
        self.position = np.array([part.position[:, part.column(joint)] for part in parts])
        """Measured positions of the joint [rad], shape (repeats, steps)."""
        # At rest until the command first changes: the mean of what was measured by then.
        still = max(int(np.argmax(commands[0] != commands[0][0])), 1)
        data = mujoco.MjData(self.model)
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self.initial = np.empty((len(parts), mujoco.mj_stateSize(self.model, full)))
        """Full physics state at rest where each repeat begins, shape (repeats, state)."""
        for row, start in zip(self.initial, self.position[:, :still].mean(axis=1), strict=True):
            for i in range(self.model.nq):
                data.qpos[i] = robot.joint(self.model.joint(i).name).default_position
            data.qpos[self.column] = start
            mujoco.mj_getState(self.model, data, row, full)
        self.time = np.arange(len(self.control)) * robot.timestep_s
        """Time of each step since the first [s], shape (steps,)."""

    def with_gains(self, stiffness: float, damping: float) -> Any:
        """Return a copy of the compiled model with other gains on the joint's drive."""
        model = copy.copy(self.model)
        set_drive_gains(model, self.joint, self.robot.joint(self.joint).drive, stiffness, damping)
        return model

    def positions(self, gains: Array, pool: Any, datas: list[Any]) -> Array:
        """Return simulated positions of gain pairs (b, 2 or more) from the mean initial state.

        `pool` is a `mujoco.rollout.Rollout`, with one `MjData` a thread. The result is at the start
        of each step [rad], (b, steps).
        """
        models = [self.with_gains(float(pair[0]), float(pair[1])) for pair in gains]
        begin = np.tile(self.initial.mean(axis=0), (len(models), 1))
        control = np.broadcast_to(self.control, (len(models), *self.control.shape))
        _, sensor = pool.rollout(models, datas, begin, np.ascontiguousarray(control))
        return np.asarray(sensor[:, :, self.model.sensor(self.joint).adr[0]])


def fit_sysid(
    log: JointLog,
    joint: str,
    robot: RobotSpec,
    *,
    bounds: Bounds,
    start: tuple[float, float],
    delay_bounds_s: tuple[float, float] | None = None,
    threads: int = 2,
) -> Estimate:
    """Fit stiffness and damping with `mujoco.sysid.optimize`, its default optimizer.

    Each repeat is one sequence; a measurement delay between `delay_bounds_s` is fitted if given.
    """
    sysid, _ = import_peers()
    before = time.perf_counter()
    replay = Replay(log, joint, robot)
    # Observed as a state: mujoco.rollout's sensors are one step older than their timestamps.
    signal = f"{joint}_qpos"
    mapping = {signal: (sysid.SignalType.MjStateQPos, np.arange(1))}
    count = len(replay.position)
    names = []
    measurements = []
    for repeat, position in enumerate(replay.position):
        names.append(f"repeat {repeat}")
        measurements.append(sysid.TimeSeries(replay.time, position[:, None], mapping))
    sequences = sysid.ModelSequences(
        joint,
        replay.spec,
        names,
        list(replay.initial),
        [sysid.TimeSeries(replay.time, replay.control)] * count,
        measurements,
    )
    parameters = sysid.ParameterDict()
    parameters.add(sysid.Parameter("stiffness", start[0], *bounds[0]))
    parameters.add(sysid.Parameter("damping", start[1], *bounds[1]))

    def build(values: Any, _spec: Any) -> Any:
        stiffness = float(values["stiffness"].value[0])
        damping = float(values["damping"].value[0])
        return replay.with_gains(stiffness, damping)

    def delayed(
        values: Any, _sensors: Any, measured: Any, _model: Any, _all: bool, *, state: Any, **_: Any
    ) -> tuple[Any, Any, Any]:
        column = 1 + replay.column  # a state is time, positions, velocities
        predicted = sysid.TimeSeries(state[:, 0], state[:, [column]], measured.signal_mapping)
        inside = sysid.apply_delayed_ts_window(measured, predicted, *(delay_bounds_s or ()))
        delay = float(values["delay"].value[0])
        late = sysid.apply_resample_and_delay(predicted, inside.times, delay)
        difference = sysid.weighted_diff(late.data, inside.data)
        return sysid.normalize_residual(difference, inside.data), late, inside

    # The log is at the physics steps already. (Resampled, a float's last digit can add a sample,
    # and the staircase of the command is then interpolated between its steps.)
    arguments: dict[str, Any] = {"resample_true": False, "n_threads": threads}
    if delay_bounds_s is None:
        arguments["enabled_observations"] = [(signal, sysid.SignalType.MjStateQPos)]
    else:
        parameters.add(sysid.Parameter("delay", float(np.mean(delay_bounds_s)), *delay_bounds_s))
        arguments["modify_residual"] = delayed
    residual = sysid.build_residual_fn(models_sequences=[sequences], build_model=build, **arguments)
    # Its default optimizer writes its progress to standard output.
    optimum, result = sysid.optimize(parameters, residual, verbose=False, output=io.StringIO())
    at_optimum, _, _ = residual(result.x, optimum)
    _, half = sysid.calculate_intervals(at_optimum, result.jac)
    stiffness = float(result.x[0])
    damping = float(result.x[1])
    return Estimate(
        stiffness=stiffness,
        damping=damping,
        interval=(
            (stiffness - half[0], stiffness + half[0]),
            (damping - half[1], damping + half[1]),
        ),
        seconds=time.perf_counter() - before,
        delay_s=float(result.x[2]) if delay_bounds_s is not None else None,
    )


def fit_cma(
    log: JointLog,
    joint: str,
    robot: RobotSpec,
    *,
    bounds: Bounds,
    start: tuple[float, float],
    delay_steps: int | None = None,
    population: int = POPULATION,
    seed: int = 1,
    threads: int = 2,
) -> Estimate:
    """Fit stiffness and damping by CMA-ES on the mean squared position error.

    A delay of 0 to `delay_steps` whole physics steps is fitted if given, truncated as PACE
    truncates it. `seed` is not 0, which `cma` takes for the clock.
    """
    _, cma = import_peers()
    before = time.perf_counter()
    replay = Replay(log, joint, robot)
    # The mean of the repeats has the same best fit as all of them, at a cost less by a constant;
    # the constant is put back for the relative spread.
    mean = replay.position.mean(axis=0)
    constant = float(replay.position.var(axis=0).mean())
    steps = len(mean)
    lows = np.array([low for low, _ in bounds])
    highs = np.array([high for _, high in bounds])
    first = np.array(start)
    if delay_steps is not None:
        lows = np.append(lows, 0.0)
        highs = np.append(highs, delay_steps + 1.0)
        first = np.append(first, 0.5 * (delay_steps + 1.0))

    def steps_late(candidates: Array) -> NDArray[np.int64]:
        if delay_steps is None:
            return np.zeros(len(candidates), dtype=np.int64)
        return np.minimum(candidates[:, 2].astype(np.int64), delay_steps)

    options = {
        "bounds": [-1.0, 1.0],
        "popsize": population,
        "maxiter": GENERATIONS,
        "seed": seed,
        "verbose": -9,
    }
    unit_start = list(2.0 * (first - lows) / (highs - lows) - 1.0)
    search = cma.CMAEvolutionStrategy(unit_start, SIGMA, options)
    datas = [mujoco.MjData(replay.model) for _ in range(threads)]
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        while not search.stop():
            unit = search.ask()
            candidates = lows + 0.5 * (np.array(unit) + 1.0) * (highs - lows)
            position = replay.positions(candidates, pool, datas)
            costs = np.full(len(candidates), constant)
            for row, lag in enumerate(steps_late(candidates)):
                error = mean[lag:] - position[row, : steps - lag]
                costs[row] += error @ error / (steps - lag)
            search.tell(unit, list(costs))
            if np.ptp(costs) < SPREAD * costs.mean():
                break
    best = lows + 0.5 * (np.clip(search.result.xfavorite, -1.0, 1.0) + 1.0) * (highs - lows)
    delay_s = None
    if delay_steps is not None:
        delay_s = float(steps_late(best[None])[0]) * robot.timestep_s
    return Estimate(
        stiffness=float(best[0]),
        damping=float(best[1]),
        seconds=time.perf_counter() - before,
        delay_s=delay_s,
    )
