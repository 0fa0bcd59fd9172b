"""The peers: mujoco.sysid, and a CMA-ES fit in the time domain in the manner of PACE.

Both get what pronk gets: the log, the bench model with armature and friction in it, the same two
free parameters inside the same bounds, and the same start. Both are used through their public
interface, with their defaults. Each can also be given the delay parameter that it has of its own,
since their authors would use it where they suspect a delay.

- `mujoco.sysid` (in MuJoCo, Apache-2.0): nonlinear least squares on the positions, intervals from
  the Jacobian at the optimum with residuals taken for independent.
- PACE (leggedrobotics/pace-sim2real) runs CMA-ES on the mean squared position error of 4,096
  simulations at once, on a GPU in Isaac Lab, and fits other parameters (armature, friction, bias
  and a delay in whole steps; gains are taken for known). What is run here is its manner: CMA-ES
  from the `cma` package, bounds mapped to [-1, 1], sigma 0.5, mean squared position error, a stop
  at a small relative spread of the population; but a population of 32, this MuJoCo model on the
  CPU, and the two gains as the parameters. It says nothing of PACE's own speed.
"""

from __future__ import annotations

import io
import time
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from benchmarks.replay import Replay
from pronk.errors import PronkError
from pronk.logs.joint_log import JointLog
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

POPULATION = 32
"""PACE: as many as simulated environments, 4,096."""
SIGMA = 0.5
"""First step of CMA-ES as a share of half the bounds (PACE)."""
GENERATIONS = 200
"""Most generations (PACE)."""
SPREAD = 1e-4
"""Stop when the costs of a generation spread by less than this share of their mean."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What one tool made of one log."""

    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    interval: tuple[tuple[float, float], tuple[float, float]] | None
    """95 % intervals of stiffness and of damping; None if the tool has none."""
    seconds: float
    """Wall time of the fit [s]."""
    delay_s: float | None = None
    """Delay, where it was fitted [s]."""


def _missing(package: str) -> PronkError:
    return PronkError(
        f"`python -m benchmarks match` compares with {package}, which is not installed (or lacks a "
        "dependency of its own); install it with `pip install pronk[bench]`."
    )


def import_sysid() -> Any:
    """The package mujoco.sysid.

    Raises:
        PronkError: It cannot be imported; its dependencies are an extra of MuJoCo.
    """
    try:
        from mujoco import sysid
    except ImportError as error:
        raise _missing(f"mujoco.sysid ({error.name})") from None
    return sysid


def import_cma() -> Any:
    """The package cma.

    Raises:
        PronkError: It is not installed.
    """
    try:
        import cma
    except ImportError:
        raise _missing("CMA-ES from the package cma") from None
    return cma


def fit_sysid(
    log: JointLog,
    joint: str,
    robot: Robot,
    *,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    start: tuple[float, float],
    delay_bounds_s: tuple[float, float] | None = None,
    threads: int = 2,
) -> Estimate:
    """Fit stiffness and damping with `mujoco.sysid.optimize`, its default optimizer.

    Args:
        log: The log, sampled at the physics steps; each repeat is one sequence.
        joint: The joint that was asked.
        robot: Gives the bench model.
        bounds: Lowest and highest stiffness, lowest and highest damping.
        start: Stiffness and damping to begin with.
        delay_bounds_s: Fit a measurement delay between these as well [s].
        threads: Threads of the simulator.

    Raises:
        PronkError: mujoco.sysid is not installed.
    """
    sysid = import_sysid()
    before = time.perf_counter()
    replay = Replay.of(log, joint, robot)
    # Observed as a state: mujoco.rollout's sensors are one step older than their timestamps.
    signal = f"{joint}_qpos"
    mapping = {signal: (sysid.SignalType.MjStateQPos, np.arange(1))}
    control = sysid.TimeSeries(replay.time, replay.control)
    count = len(replay.position)
    sequences = sysid.ModelSequences(
        joint,
        replay.spec,
        [f"repeat {k}" for k in range(count)],
        list(replay.initial),
        [control] * count,
        [sysid.TimeSeries(replay.time, one[:, None], mapping) for one in replay.position],
    )
    parameters = sysid.ParameterDict()
    for name, value, (low, high) in zip(("stiffness", "damping"), start, bounds, strict=True):
        parameters.add(sysid.Parameter(name, value, low, high))

    def build(values: Any, _spec: Any) -> Any:
        return replay.with_gains(
            float(values["stiffness"].value[0]), float(values["damping"].value[0])
        )

    # The log is at the physics steps already. (Resampled, a float's last digit can add a sample,
    # and the staircase of the command is then interpolated between its steps.)
    arguments: dict[str, Any] = {"resample_true": False, "n_threads": threads}
    if delay_bounds_s is None:
        arguments["enabled_observations"] = [(signal, sysid.SignalType.MjStateQPos)]
    else:
        parameters.add(sysid.Parameter("delay", float(np.mean(delay_bounds_s)), *delay_bounds_s))
        column = 1 + replay.column  # a state is time, positions, velocities
        arguments["modify_residual"] = _delayed_residual(sysid, column, delay_bounds_s)
    residual = sysid.build_residual_fn(models_sequences=[sequences], build_model=build, **arguments)
    # Its default optimizer writes its progress to standard output; take it aside.
    found, result = sysid.optimize(parameters, residual, verbose=False, output=io.StringIO())
    at_optimum, _, _ = residual(result.x, found)
    _, half = sysid.calculate_intervals(at_optimum, result.jac)
    seconds = time.perf_counter() - before
    kp, kd = float(result.x[0]), float(result.x[1])
    return Estimate(
        stiffness=kp,
        damping=kd,
        interval=((kp - half[0], kp + half[0]), (kd - half[1], kd + half[1])),
        seconds=seconds,
        delay_s=float(result.x[2]) if delay_bounds_s is not None else None,
    )


def _delayed_residual(sysid: Any, column: int, bounds: tuple[float, float]) -> Any:
    """A residual callback for mujoco.sysid with the state's `column` later by its `delay`."""

    def residual(
        values: Any, _sensors: Any, measured: Any, _model: Any, _all: bool, *, state: Any, **_: Any
    ) -> tuple[Any, Any, Any]:
        predicted = sysid.TimeSeries(state[:, 0], state[:, [column]], measured.signal_mapping)
        inside = sysid.apply_delayed_ts_window(measured, predicted, *bounds)
        late = sysid.apply_resample_and_delay(
            predicted, inside.times, float(values["delay"].value[0])
        )
        difference = sysid.weighted_diff(late.data, inside.data)
        return sysid.normalize_residual(difference, inside.data), late, inside

    return residual


def fit_cma(
    log: JointLog,
    joint: str,
    robot: Robot,
    *,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    start: tuple[float, float],
    delay_steps: int | None = None,
    population: int = POPULATION,
    seed: int = 1,
    threads: int = 2,
) -> Estimate:
    """Fit stiffness and damping by CMA-ES on the mean squared position error.

    Args:
        log: The log, sampled at the physics steps; its repeats must share one command, which is
            then simulated once a candidate.
        joint: The joint that was asked.
        robot: Gives the bench model.
        bounds: Lowest and highest stiffness, lowest and highest damping.
        start: Stiffness and damping of the first mean.
        delay_steps: Fit a delay of 0 to this many whole physics steps as well, truncated as PACE
            truncates it.
        population: Simulations a generation.
        seed: Of the search; not 0, which `cma` takes for the clock.
        threads: Threads of the simulator.

    Raises:
        PronkError: cma is not installed.
    """
    cma = import_cma()
    before = time.perf_counter()
    replay = Replay.of(log, joint, robot)
    # The mean of the repeats has the same best fit as all of them, at a cost less by a constant;
    # the constant is put back for the relative spread.
    mean = replay.position.mean(axis=0)
    constant = float(replay.position.var(axis=0).mean())
    steps = len(mean)
    lows, highs = (np.array(side) for side in zip(*bounds, strict=True))
    first = np.array(start)
    if delay_steps is not None:
        lows, highs = np.append(lows, 0.0), np.append(highs, delay_steps + 1.0)
        first = np.append(first, 0.5 * (delay_steps + 1.0))
    options = {
        "bounds": [-1.0, 1.0],
        "popsize": population,
        "seed": seed,
        "verbose": -9,
        "maxiter": GENERATIONS,
    }
    search = cma.CMAEvolutionStrategy(
        list(2.0 * (first - lows) / (highs - lows) - 1.0), SIGMA, options
    )
    datas = [mujoco.MjData(replay.model) for _ in range(threads)]
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        while not search.stop():
            unit = search.ask()
            candidates = lows + 0.5 * (np.array(unit) + 1.0) * (highs - lows)
            position = replay.positions(candidates, pool, datas)
            costs = np.full(len(candidates), constant)
            for row, lag in enumerate(_steps_late(candidates, delay_steps)):
                error = mean[lag:] - position[row, : steps - lag]
                costs[row] += error @ error / (steps - lag)
            search.tell(unit, list(costs))
            if np.ptp(costs) < SPREAD * costs.mean():
                break
    best = lows + 0.5 * (np.clip(search.result.xfavorite, -1.0, 1.0) + 1.0) * (highs - lows)
    seconds = time.perf_counter() - before
    late = None
    if delay_steps is not None:
        late = float(_steps_late(best[None, :], delay_steps)[0]) * robot.timestep_s
    return Estimate(
        stiffness=float(best[0]),
        damping=float(best[1]),
        interval=None,
        seconds=seconds,
        delay_s=late,
    )


def _steps_late(candidates: Array, delay_steps: int | None) -> NDArray[np.int64]:
    """Delay of each candidate in whole steps, shape (b,)."""
    if delay_steps is None:
        return np.zeros(len(candidates), dtype=np.int64)
    return np.minimum(candidates[:, 2].astype(np.int64), delay_steps)
