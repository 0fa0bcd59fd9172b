"""Logs whose truth is known: a simulated joint, chirped, with noise and one named trouble.

The truth is the training simulator itself with gains that the tools must find, so a tool that
models what happened can be exactly right; what is left is noise, and the trouble of the scenario.
Logs are sampled at the physics steps (200 Hz), so that no tool has to interpolate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from pronk.errors import PronkError
from pronk.excitation.signals import Chirp
from pronk.logs.joint_log import JointLog, Segment
from pronk.robots.robot import Robot
from pronk.simulators.command_trace import CommandTrace
from pronk.simulators.mujoco import simulate

Array = NDArray[np.float64]

JOINT = "FR_knee"
"""The joint asked: thigh clamped, hip_roll held by its drive."""
HOLD_S = 0.5
"""Rest before the chirp and after it [s]."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What the tools are up against."""

    name: str
    words: str
    """One line for the table."""
    noise_rad: float = 3e-3
    """Standard deviation of the measurement noise [rad]."""
    noise_corner_hz: float = 2.0
    """Corner of the first-order noise [Hz]."""
    delay_s: float = 0.0
    """From a command to its effect [s]; no tool is told."""
    friction_factor: float = 1.0
    """Dry friction of the truth over that of the model which every tool is given."""
    gain_spread: float = 0.0
    """Relative standard deviation of stiffness and damping, each, from one repeat to the next."""

    def __post_init__(self) -> None:
        """Refuse impossible scenarios.

        Raises:
            PronkError: Noise, delay, friction or spread is negative, or the corner is not positive.
        """
        for name in ("noise_rad", "delay_s", "friction_factor", "gain_spread"):
            if not getattr(self, name) >= 0.0:
                raise PronkError(f"Scenario.{name} is {getattr(self, name)}; expected 0 or more.")
        if not self.noise_corner_hz > 0.0:
            raise PronkError(
                f"Scenario.noise_corner_hz is {self.noise_corner_hz}; expected a positive number."
            )


SCENARIOS = (
    Scenario(name="noise", words="coloured noise: 3 mrad, 2 Hz corner"),
    # 7 ms is between one and two physics steps, so that whole steps cannot express it.
    Scenario(name="delay", words="noise, and commands act 7 ms late", delay_s=0.007),
    Scenario(name="friction", words="noise, and twice the modelled friction", friction_factor=2.0),
    # A warming drive. Repeat runs of one Go2 gave parameters that vary by 3 to 14 % (issue 8 of
    # iit-DLSLab/sim2real-robot-identification); the mildest of these.
    Scenario(name="repeats", words="noise, and gains 3 % apart between repeats", gain_spread=0.03),
)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What the tools must find."""

    stiffness: float = 21.8
    """[N m/rad], FR knee in Table I of the paper."""
    damping: float = 0.541
    """[N m s/rad], FR knee in Table I of the paper."""


def coloured_noise(
    rng: np.random.Generator, count: int, *, deviation: float, corner_hz: float, rate_hz: float
) -> Array:
    """Stationary first-order autoregressive noise.

    `x[k+1] = a x[k] + sqrt(1 - a^2) deviation w[k]`, `a = exp(-2 pi corner / rate)`, begun in its
    stationary distribution.

    Args:
        rng: Source of the white noise.
        count: Samples.
        deviation: Standard deviation [rad].
        corner_hz: Frequency of half power [Hz].
        rate_hz: Sample rate [Hz].

    Returns:
        Noise [rad], shape (count,).
    """
    a = float(np.exp(-2.0 * np.pi * corner_hz / rate_hz))
    white = rng.standard_normal(count)
    white[1:] *= np.sqrt(1.0 - a * a)
    return np.asarray(deviation * lfilter([1.0], [1.0, -a], white))


class KnownTruth:
    """Makes logs of one scenario."""

    def __init__(
        self,
        robot: Robot,
        scenario: Scenario,
        *,
        truth: Truth | None = None,
        repeats: int = 5,
        length_s: float = 20.0,
        threads: int = 2,
    ) -> None:
        """Prepare the question, and the clean answer where all repeats share it.

        Args:
            robot: The robot; it needs a joint called `JOINT`.
            scenario: The trouble.
            truth: Gains of the truth.
            repeats: Chirps in each log.
            length_s: Length of each chirp [s].
            threads: Threads of the simulator.
        """
        self.robot = robot
        self.scenario = scenario
        self.truth = truth or Truth()
        self.repeats = repeats
        self._threads = threads
        self._signal = Chirp(length_s=length_s)
        joint = robot.joint(JOINT)
        rest = np.zeros(round(HOLD_S * robot.policy_rate_hz))
        ticks = np.concatenate([rest, self._signal.samples(robot.policy_rate_hz), rest])
        self._question = CommandTrace(
            joint=JOINT,
            start=0.0,
            timestep=robot.timestep_s,
            command=joint.default_position + np.repeat(ticks, robot.decimation),
            pose=np.array([j.default_position for j in robot.joints]),
            amplitude=self._signal.amplitude,
        )
        self._clean = None if scenario.gain_spread else self.answer(np.ones((1, 2)))

    def answer(self, factor: Array) -> Array:
        """Clean positions of joints whose gains are the truth times some factors.

        Args:
            factor: Of stiffness and damping, shape (b, 2).

        Returns:
            Position at each physics step [rad], shape (b, steps).
        """
        position = simulate(
            self.robot,
            self._question,
            self.truth.stiffness * factor[:, 0],
            self.truth.damping * factor[:, 1],
            frictionloss=self.scenario.friction_factor * self.robot.joint(JOINT).drive.frictionloss,
            threads=self._threads,
        )
        return delayed(position, self.scenario.delay_s, self.robot.timestep_s)

    def log(self, rng: np.random.Generator) -> JointLog:
        """One log: the same chirp `repeats` times, with noise of its own on each sample."""
        robot, scenario = self.robot, self.scenario
        joint = robot.joint(JOINT)
        if self._clean is None:
            deviation = scenario.gain_spread * rng.standard_normal((self.repeats, 2))
            clean = self.answer(1.0 + deviation).ravel()
        else:
            clean = np.tile(self._clean[0], self.repeats)
        command = np.tile(self._question.command, self.repeats)
        span = len(self._question.command) * robot.timestep_s
        noise = coloured_noise(
            rng,
            len(command),
            deviation=scenario.noise_rad,
            corner_hz=scenario.noise_corner_hz,
            rate_hz=1.0 / robot.timestep_s,
        )
        segments = tuple(
            Segment(
                kind="chirp",
                joints=(JOINT,),
                start=k * span,
                stop=(k + 1) * span - robot.timestep_s,
                amplitude=self._signal.amplitude,
                repeat=k,
                band_hz=self._signal.band_hz,
                clamped=joint.clamped,
            )
            for k in range(self.repeats)
        )
        return JointLog(
            robot=robot.name,
            joints=(JOINT,),
            time=np.arange(len(command), dtype=np.float64) * robot.timestep_s,
            command=command[:, None],
            position=(clean + noise)[:, None],
            segments=segments,
            stiffness=np.array([joint.stiffness]),
            damping=np.array([joint.damping]),
            pose=np.array([joint.default_position]),
            virtual=True,
            source=f"known truth ({scenario.name})",
        )


def delayed(position: Array, delay_s: float, timestep: float) -> Array:
    """The answer to commands that act later: time-invariant, so the answer itself is later.

    Args:
        position: At the physics steps, at rest in the beginning [rad], shape (..., n).
        delay_s: Delay [s], not necessarily whole steps.
        timestep: Physics step [s].

    Returns:
        Shape (..., n).
    """
    if delay_s == 0.0:
        return position
    time = np.arange(position.shape[-1]) * timestep
    return np.asarray(CubicSpline(time, position, axis=-1)(np.maximum(time - delay_s, 0.0)))
