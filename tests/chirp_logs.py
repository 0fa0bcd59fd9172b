"""Logs of chirps to one joint that the training simulator answers with known gains."""

from __future__ import annotations

from typing import Any

import numpy as np

from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog
from pronk.robots.robot import RobotSpec
from synthetic_log import Excitation, synthetic_log


def chirp_log(
    robot: RobotSpec,
    joint: str,
    gains: tuple[float, float],
    amplitudes: tuple[float, ...] = (0.25, 0.125),
    *,
    repeats: int = 1,
    length_s: float = 8.0,
    noise_rad: float = 0.0,
    seed: int = 0,
    **more: Any,
) -> JointLog:
    """Chirps of some amplitudes [rad], white noise on the position; `more` of `synthetic_log`."""
    chirps = [Chirp(length_s=length_s, amplitude=amplitude).samples() for amplitude in amplitudes]
    excitations = [Excitation(offsets=one, repeats=repeats) for one in chirps]
    rows = repeats * len(amplitudes), 500 * round(length_s + 2.0)
    noise = noise_rad * np.random.default_rng(seed).standard_normal(rows)
    return synthetic_log(robot, joint, excitations, *gains, noise=list(noise), **more)
