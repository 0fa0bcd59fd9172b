"""`python -m benchmarks coverage`: how often the 95 % intervals hold the known gains.

Each trial is a log of known gains with noise of its own, coloured at 2 Hz; everything after the
noise is what a real log goes through. All trials share one clean simulation and one operator,
which is exact because the H1 estimate is linear in the position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binom

from benchmarks.runner import Progress
from pronk.arrays import Array
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.magnitude import gain_interval, refine
from pronk.identify.match.measured import measured_joints
from pronk.identify.match.parameters import GAINS
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.estimate import operators
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.report.paper import TABLE_I
from pronk.robots import load_robot
from pronk.tables import Cell, Column, Table
from tests.synthetic_log import Excitation, coloured_noise, synthetic_log

ROBOT = "mini_cheetah"
JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
NOISE_RAD = 0.003
"""Standard deviation of the noise on the position [rad]."""
NOISE_CORNER_HZ = 2.0
REPEATS = 3
"""Chirps of each log."""
LENGTH_S = 20.0
"""Length of a chirp [s], and the rest before and after it."""
REST_S = 0.5
RATE_HZ = 500.0
BATCH = 50
"""Trials whose noise is drawn at once."""


@dataclass(frozen=True, kw_only=True)
class JointCoverage:
    """What some trials of one joint found; arrays are for (stiffness, damping), shape (2,)."""

    known: tuple[float, float]
    """Known gains [N m/rad], [N m s/rad]."""
    trials: int
    """Number of logs."""
    covered: Array
    """Number of trials whose interval holds the known gain."""
    bias_percent: Array
    """Mean of the matched gains over the known ones, less one [%]."""
    deviation_percent: Array
    """Standard deviation of the matched gains [%]."""
    half_width_percent: Array
    """Mean half-width of the intervals [%]."""


def run_joint(name: str, trials: int, rng: np.random.Generator, threads: int) -> JointCoverage:
    """Fit the logs of one joint.

    Args:
        name: The joint.
        trials: Number of logs.
        rng: Source of the noise.
        threads: Threads of the simulator.
    """
    robot = load_robot(ROBOT)
    settings = MatchSettings(threads=threads)
    known = TABLE_I[name]
    chirp = Excitation(offsets=Chirp(length_s=LENGTH_S).samples(), repeats=REPEATS, settle_s=REST_S)
    samples = round((LENGTH_S + 2.0 * REST_S + 1.0) * RATE_HZ)

    def noise(shape: tuple[int, ...]) -> Array:
        return coloured_noise(
            rng, shape, deviation=NOISE_RAD, corner_hz=NOISE_CORNER_HZ, rate_hz=RATE_HZ
        )

    log = synthetic_log(robot, name, [chirp], *known, noise=list(noise((REPEATS, samples))))
    noisy = measured_joints([log], name, robot, settings)[0]
    quiet_log = synthetic_log(robot, name, [replace(chirp, repeats=1)], *known)
    quiet = measured_joints([quiet_log], name, robot, settings)[0].measured.response
    operator = operators(log, name, settings.estimator)[0][0]
    to_response = operator.matrix(operator.time)
    gains = np.empty((trials, 2))
    low = np.empty((trials, 2))
    high = np.empty((trials, 2))
    with MujocoSimulator(robot, threads=threads) as simulator:
        for begin in range(0, trials, BATCH):
            count = min(BATCH, trials - begin)
            errors = noise((count, REPEATS, len(operator.time))) @ to_response
            for trial, repeats in enumerate(quiet + errors, start=begin):
                response = replace(noisy.measured, response=repeats.mean(axis=0), repeats=repeats)
                fit = refine(simulator, replace(noisy, measured=response), known)
                gains[trial] = fit.gains
                interval = gain_interval(fit)
                for column, parameter in enumerate(GAINS):
                    low[trial, column], high[trial, column] = interval.ci95[parameter]
    expected = np.array(known)
    return JointCoverage(
        known=known,
        trials=trials,
        covered=((low <= expected) & (expected <= high)).sum(axis=0),
        bias_percent=100.0 * (gains.mean(axis=0) / expected - 1.0),
        deviation_percent=100.0 * gains.std(axis=0, ddof=1) / expected,
        half_width_percent=50.0 * (high - low).mean(axis=0) / expected,
    )


def run(
    trials: int, seed: int, progress: Progress, *, threads: int = 2
) -> dict[str, JointCoverage]:
    """Fit `trials` logs for one joint of each group.

    Args:
        trials: Logs of each joint.
        seed: Of the noise.
        progress: Called with a stage and its share that is done.
        threads: Threads of the simulator.

    Returns:
        Coverage by joint.

    Raises:
        PronkError: No trials.
    """
    if trials < 1:
        raise PronkError(f"{trials} trials; expected 1 or more.")
    joints = {}
    for index, name in enumerate(JOINTS):
        joints[name] = run_joint(name, trials, np.random.default_rng([seed, index]), threads)
        progress("joints", len(joints) / len(JOINTS))
    return joints


def coverage(trials: int = 200, seed: int = 0) -> console.Outcome:
    """How often the 95 % intervals hold the known gains under coloured noise.

    Args:
        trials: Logs of each joint.
        seed: Of the noise.
    """
    with console.progress() as report:
        joints = run(trials, seed, report)
    rows: list[tuple[Cell, ...]] = []
    for name, joint in joints.items():
        rows.append(
            (
                name,
                "{} / {} of {}".format(*joint.covered, trials),
                "{:+.3f} / {:+.3f}".format(*joint.bias_percent),
                "{:.3f} / {:.3f}".format(*joint.deviation_percent),
                "{:.3f} / {:.3f}".format(*joint.half_width_percent),
            )
        )
    low, high = binom(trials, 0.95).interval(0.95)
    note = (
        f"{trials} logs a joint of {REPEATS} chirps each, noise {1e3 * NOISE_RAD:g} mrad coloured "
        f"at {NOISE_CORNER_HZ:g} Hz; an exact interval would hold {low:.0f} to {high:.0f} "
        "(95 % of such benchmarks)"
    )
    columns = (
        Column(heading="joint"),
        Column(heading="hold the known value"),
        Column(heading="bias", unit="%"),
        Column(heading="scatter", unit="%"),
        Column(heading="half-width", unit="%"),
    )
    title = "95 % intervals under coloured noise (stiffness / damping)"
    console.show(Table(title=title, columns=columns, rows=tuple(rows), notes=(note,)))
    return console.Outcome(figures=dict(joints))
