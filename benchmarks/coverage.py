"""`python -m benchmarks coverage`: how often the 95 % intervals hold the known gains.

Each trial is a log of known gains with noise of its own, coloured at 2 Hz; everything after the
noise is what a real log goes through. All trials share one clean simulation and one operator,
which is exact because the H1 estimate is linear in the position.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import binom

from benchmarks.runner import Progress, finish
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
from tests.synthetic_log import Excitation, coloured_noise, synthetic_log

ROBOT = "mini_cheetah"
JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
NOISE_RAD, NOISE_CORNER_HZ = 0.003, 2.0
REPEATS, LENGTH_S, REST_S, RATE_HZ = 3, 20.0, 0.5, 500.0
BATCH = 50


def run(trials: int, seed: int, progress: Progress, *, threads: int = 2) -> dict[str, Any]:
    """Fit `trials` logs for one joint of each group.

    Returns:
        By joint, pairs for stiffness and damping: `covered` (trials whose interval holds the known
        value), bias, standard deviation and mean half-width of the interval.

    Raises:
        PronkError: No trials.
    """
    if trials < 1:
        raise PronkError(f"{trials} trials; expected 1 or more.")
    robot, settings = load_robot(ROBOT), MatchSettings(threads=threads)
    chirp = Excitation(offsets=Chirp(length_s=LENGTH_S).samples(), repeats=REPEATS, settle_s=REST_S)
    samples = round((LENGTH_S + 2.0 * REST_S + 1.0) * RATE_HZ)
    noise = partial(coloured_noise, deviation=NOISE_RAD, corner_hz=NOISE_CORNER_HZ, rate_hz=RATE_HZ)
    found = {}
    for index, name in enumerate(JOINTS):
        rng, known = np.random.default_rng([seed, index]), TABLE_I[name]
        log = synthetic_log(
            robot, name, [chirp], *known, noise=list(noise(rng, (REPEATS, samples)))
        )
        noisy = measured_joints([log], name, robot, settings)[0]
        quiet = synthetic_log(robot, name, [replace(chirp, repeats=1)], *known)
        clean = measured_joints([quiet], name, robot, settings)[0].measured.response
        operator = operators(log, name, settings.estimator)[0][0]
        to_response = operator.matrix(operator.time)
        gains, low, high = (np.empty((trials, 2)) for _ in range(3))
        with MujocoSimulator(robot, threads=threads) as simulator:
            for begin in range(0, trials, BATCH):
                count = min(BATCH, trials - begin)
                errors = noise(rng, (count, REPEATS, len(operator.time))) @ to_response
                for trial, repeats in enumerate(clean + errors, start=begin):
                    measured = replace(
                        noisy.measured, response=repeats.mean(axis=0), repeats=repeats
                    )
                    fit = refine(simulator, replace(noisy, measured=measured), known)
                    ci95 = gain_interval(fit).ci95
                    gains[trial] = fit.gains
                    for column, parameter in enumerate(GAINS):
                        low[trial, column], high[trial, column] = ci95[parameter]
                progress("trials", (index + (begin + count) / trials) / len(JOINTS))
        expected = np.array(known)
        found[name] = {
            "known": known,
            "trials": trials,
            "covered": ((low <= expected) & (expected <= high)).sum(axis=0),
            "bias_percent": 100.0 * (gains.mean(axis=0) / expected - 1.0),
            "deviation_percent": 100.0 * gains.std(axis=0, ddof=1) / expected,
            "half_width_percent": 50.0 * (high - low).mean(axis=0) / expected,
        }
    return found


def coverage(trials: int = 200, seed: int = 0) -> console.Outcome:
    """How often the 95 % intervals hold the known gains under coloured noise.

    Args:
        trials: Logs of each joint.
        seed: Of the noise.
    """
    with console.progress() as report:
        found = run(trials, seed, report)
    rows = [
        (
            joint,
            "{} / {} of {}".format(*one["covered"], trials),
            "{:+.3f} / {:+.3f}".format(*one["bias_percent"]),
            "{:.3f} / {:.3f}".format(*one["deviation_percent"]),
            "{:.3f} / {:.3f}".format(*one["half_width_percent"]),
        )
        for joint, one in found.items()
    ]
    low, high = binom(trials, 0.95).interval(0.95)
    caption = (
        f"{trials} logs a joint of {REPEATS} chirps each, noise {1e3 * NOISE_RAD:g} mrad coloured "
        f"at {NOISE_CORNER_HZ:g} Hz; an exact interval would hold {low:.0f} to {high:.0f} "
        "(95 % of such benchmarks)"
    )
    title = "95 % intervals under coloured noise (stiffness / damping)"
    columns = ("joint", "hold the known value", "bias [%]", "scatter [%]", "half-width [%]")
    return finish(found, console.table(title, columns, rows, caption))
