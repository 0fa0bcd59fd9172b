"""`python -m benchmarks coverage`: how often the 95 % intervals hold the known gains.

Each trial is a log of known truth with noise of its own, coloured at 2 Hz; everything after the
noise is what a real log goes through, but that all trials share one clean simulation and one
operator, which is exact because the H1 estimate is linear in the position.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text
from scipy.signal import lfilter
from scipy.stats import binom

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.errors import PronkError
from pronk.excitation.signals import Chirp
from pronk.match.measured_joint import measured_joints
from pronk.match.refine import refine
from pronk.match.settings import MatchSettings
from pronk.match.uncertainty import interval
from pronk.report.paper import published
from pronk.response.estimate import operators
from pronk.robots import load_robot
from pronk.simulators.mujoco import MujocoSimulator

ROBOT = "mini_cheetah"
JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
NOISE_RAD = 0.003
NOISE_CORNER_HZ = 2.0
LOG_RATE_HZ = 500.0
_BATCH = 50
_REST_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Trials of one joint."""

    joint: str
    truth: tuple[float, float]
    trials: int
    repeats: int
    covered: tuple[int, int]
    """Trials whose interval of stiffness, of damping, holds the truth."""
    bias_percent: tuple[float, float]
    deviation_percent: tuple[float, float]
    half_width_percent: tuple[float, float]
    """Mean half-width of the interval."""


def coloured(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """AR(1) noise with its corner at 2 Hz, sampled at 500 Hz [rad], shape (..., samples)."""
    pole = np.exp(-2.0 * np.pi * NOISE_CORNER_HZ / LOG_RATE_HZ)
    settle = 1000
    white = rng.standard_normal((*shape[:-1], shape[-1] + settle))
    noise = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], white, axis=-1)
    return np.asarray(NOISE_RAD * noise[..., settle:])


def run(
    trials: int = 200,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
    *,
    repeats: int = 3,
    length_s: float = 20.0,
    threads: int = 2,
) -> tuple[Coverage, ...]:
    """Trials for one joint of each group.

    Args:
        trials: Logs of each joint.
        seed: Of the noise.
        progress: Told the stage and the share done, 0 to 1.
        repeats: Chirps in each log.
        length_s: Length of the chirp [s].
        threads: Threads of the simulator.

    Raises:
        PronkError: Fewer than one trial or than two repeats.
    """
    if trials < 1 or repeats < 2:
        raise PronkError(f"{trials} trials of {repeats} repeats; expected at least 1 of 2.")
    told = progress or (lambda _stage, _share: None)
    return tuple(
        _joint(
            name,
            trials,
            np.random.default_rng([seed, k]),
            repeats,
            length_s,
            threads,
            lambda share, k=k: told("trials", (k + share) / len(JOINTS)),  # type: ignore[misc]
        )
        for k, name in enumerate(JOINTS)
    )


def _joint(
    name: str,
    trials: int,
    rng: np.random.Generator,
    repeats: int,
    length_s: float,
    threads: int,
    told: Callable[[float], None],
) -> Coverage:
    robot, settings = load_robot(ROBOT), MatchSettings(threads=threads)
    paper = published(ROBOT)
    assert paper is not None
    truth = paper.joints[name]
    chirp = Excitation(
        offsets=Chirp(length_s=length_s).samples(), repeats=repeats, settle_s=_REST_S
    )
    samples = round((length_s + 2.0 * _REST_S + 1.0) * LOG_RATE_HZ)
    log = synthetic_log(robot, name, [chirp], *truth, noise=list(coloured(rng, (repeats, samples))))
    noisy = measured_joints(log, name, robot, settings)[0]
    quiet = synthetic_log(robot, name, [replace(chirp, repeats=1)], *truth)
    clean = measured_joints(quiet, name, robot, settings)[0].measured.response
    operator = operators(log, name, settings.estimator)[0][0]
    gains, low, high = (np.empty((trials, 2)) for _ in range(3))
    with MujocoSimulator(robot, threads=threads) as simulator:
        for begin in range(0, trials, _BATCH):
            count = min(_BATCH, trials - begin)
            shaken = operator.apply(coloured(rng, (count, repeats, len(operator.time))))
            goals = [
                replace(
                    noisy,
                    measured=replace(noisy.measured, response=answer.mean(axis=0), repeats=answer),
                )
                for answer in clean + shaken
            ]
            for k, fit in enumerate(refine(simulator, goals, [truth] * count), start=begin):
                bounds = interval(fit)
                gains[k] = fit.stiffness, fit.damping
                for i in range(2):
                    low[k, i], high[k, i] = bounds.around(gains[k, i], i)
            told((begin + count) / trials)
    true = np.array(truth)
    inside = ((low <= true) & (true <= high)).sum(axis=0)
    bias = 100.0 * (gains.mean(axis=0) / true - 1.0)
    deviation = 100.0 * gains.std(axis=0, ddof=1) / true
    width = 50.0 * (high - low).mean(axis=0) / true
    return Coverage(
        joint=name,
        truth=truth,
        trials=trials,
        repeats=repeats,
        covered=(int(inside[0]), int(inside[1])),
        bias_percent=(float(bias[0]), float(bias[1])),
        deviation_percent=(float(deviation[0]), float(deviation[1])),
        half_width_percent=(float(width[0]), float(width[1])),
    )


def table(rows: tuple[Coverage, ...]) -> Table:
    """A row a joint, stiffness / damping."""
    made = Table(title=Text("95 % intervals under coloured noise (stiffness / damping)"))
    made.title_justify = made.caption_justify = "left"
    made.add_column("joint")
    for column in ("hold the truth", "bias [%]", "scatter [%]", "half-width [%]"):
        made.add_column(Text(column), justify="right")
    for one in rows:
        made.add_row(
            one.joint,
            "{} / {} of {}".format(*one.covered, one.trials),
            "{:+.3f} / {:+.3f}".format(*one.bias_percent),
            "{:.3f} / {:.3f}".format(*one.deviation_percent),
            "{:.3f} / {:.3f}".format(*one.half_width_percent),
        )
    if rows:
        chance = binom(rows[0].trials, 0.95).interval(0.95)
        made.caption = Text(
            f"{rows[0].trials} logs a joint of {rows[0].repeats} chirps each, noise "
            f"{1e3 * NOISE_RAD:g} mrad coloured at {NOISE_CORNER_HZ:g} Hz; an exact interval would "
            f"hold {chance[0]:.0f} to {chance[1]:.0f} (95 % of such benches)"
        )
    return made
