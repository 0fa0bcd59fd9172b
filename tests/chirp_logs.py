"""Logs of chirps to one joint that the training simulator answers with known gains."""

from __future__ import annotations

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
    delay_s: float = 0.0,
    armature: float | None = None,
    frictionloss: float | None = None,
    threads: int = 2,
) -> JointLog:
    """Return a log of chirps to one joint, with white noise on the position.

    Args:
        robot: The robot.
        joint: The joint to excite.
        gains: Stiffness [N m/rad] and damping [N m s/rad] of the joint.
        amplitudes: Amplitudes of the chirps [rad].
        repeats: Times each chirp is repeated.
        length_s: Length of a chirp [s].
        noise_rad: Standard deviation of the noise [rad].
        seed: Seed of the noise.
        delay_s: Delay from a command to its effect [s].
        armature: Armature of the joint [kg m^2]; the drive's if None.
        frictionloss: Dry friction of the joint [N m]; the drive's if None.
        threads: Simulations at the same time.
    """
    excitations = []
    for amplitude in amplitudes:
        chirp = Chirp(length_s=length_s, amplitude=amplitude)
        excitations.append(Excitation(offsets=chirp.samples(), repeats=repeats))
    rows = repeats * len(amplitudes)
    samples = 500 * round(length_s + 2.0)
    noise = noise_rad * np.random.default_rng(seed).standard_normal((rows, samples))
    stiffness, damping = gains
    return synthetic_log(
        robot,
        joint,
        excitations,
        stiffness,
        damping,
        noise=list(noise),
        delay_s=delay_s,
        armature=armature,
        frictionloss=frictionloss,
        threads=threads,
    )
