"""Virtual robots drawn at random, and their logs on the bench, cached on disk.

They are Mini Cheetahs, or those of another robot. Ranges are those of issue 27. Every factor is
relative to the shipped parameters of the virtual robot, apart from the torque constant, which is
relative to the model's. Uniform draws, but the belts', whose logarithm is uniform.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from pronk.arrays import Array
from pronk.cli.sweep import AMPLITUDES
from pronk.deploy.runtime.sweep import SweepTask
from pronk.deploy.runtime.sweep_recorder import record_sweep
from pronk.identify.excitation.plan import PlannedExcitation, SweepPlan, make_plan
from pronk.identify.excitation.signals import Chirp, Multisine, Signal
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_log
from pronk.jump.virtual.plant import legs_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import JointParams, SimParams, load_sim_params
from pronk.robots import load_robot

ROBOT = "mini_cheetah"
FRICTION = (0.0, 3.0)
BREAKAWAY = (1.0, 1.5)
"""Stribeck peak over Coulomb friction; shipped: 1.15 to 1.45."""
STRIBECK_SPEED = (0.05, 0.5)
"""Speed at which the peak has fallen to 1/e [rad/s]; shipped: 0.11 to 0.18."""
BELT = (0.25, 2.0)
DELAY_S = (0.0, 0.015)
TORQUE = (0.75, 1.25)
ROTOR = (0.7, 1.3)
ENCODER_BITS = (12, 16)

REPEATS = 3
"""Repeats of each amplitude, as `pronk sweep` makes them."""
THIRD_AMPLITUDE = 0.18
"""Amplitude of the sweep without noise: about the geometric mean of the two of `pronk sweep`
[rad]."""
HELD_OUT = ("chirp", "multisine", "steps")
"""Signals that no method sees."""


@dataclass(frozen=True, kw_only=True)
class FallingChirp(Chirp):
    """A linear chirp from the highest frequency to the lowest."""

    def _samples(self, rate_hz: float) -> Array:
        return super()._samples(rate_hz)[::-1]

    def frequency(self, rate_hz: float = 50.0) -> Array:
        """Instantaneous frequency at the ticks [Hz], shape (ticks,)."""
        return super().frequency(rate_hz)[::-1]


@dataclass(frozen=True, kw_only=True)
class Steps(Signal):
    """Steps to random positions within the amplitude, each held for `hold_s`."""

    kind = "unknown"

    amplitude: float = 0.1
    hold_s: float = 0.5
    steps: int = 20
    seed: int = 0

    @property
    def band_hz(self) -> tuple[float, float]:
        """From one step in the whole signal to one each `hold_s` [Hz]."""
        return 1.0 / (self.hold_s * self.steps), 1.0 / self.hold_s

    def _samples(self, rate_hz: float) -> Array:
        levels = np.random.default_rng(self.seed).uniform(-1.0, 1.0, self.steps)
        positions = self.amplitude * levels / np.abs(levels).max()
        samples = np.repeat(positions, round(self.hold_s * rate_hz))
        return np.concatenate([[0.0], samples, [0.0]])

    def frequency(self, rate_hz: float = 50.0) -> Array:
        """NaN at the ticks, shape (ticks,)."""
        return np.full(self.steps * round(self.hold_s * rate_hz) + 2, np.nan)


def held_out_signals() -> dict[str, Signal]:
    """Signals of `HELD_OUT`; amplitudes and directions differ from those of the sweep."""
    signals = (FallingChirp(amplitude=0.15), Multisine(amplitude=0.2, periods=1), Steps())
    return dict(zip(HELD_OUT, signals, strict=True))


def draw(seed: int, number: int, robot: str = ROBOT) -> SimParams:
    """Draw robot `number` of a seed; the same numbers for the same arguments."""
    rng = np.random.default_rng([seed, number])
    shipped = load_sim_params(None, load_robot(robot))
    machine = replace(
        shipped.machine,
        command_delay_s=rng.uniform(*DELAY_S),
        encoder_bits=int(rng.integers(*ENCODER_BITS, endpoint=True)),
    )
    joints = {name: _draw_joint(rng, joint) for name, joint in shipped.joints.items()}
    return replace(shipped, machine=machine, joints=joints)


def _draw_joint(rng: np.random.Generator, joint: JointParams) -> JointParams:
    friction = rng.uniform(*FRICTION)
    belt = np.exp(rng.uniform(*np.log(BELT)))
    rotor = rng.uniform(*ROTOR)
    coulomb = friction * joint.coulomb
    # Bristles break away at the same deflection, and rotor and link stay as damped as they were.
    return replace(
        joint,
        coulomb=coulomb,
        load_friction=friction * joint.load_friction,
        breakaway=coulomb * rng.uniform(*BREAKAWAY),
        stribeck_speed=rng.uniform(*STRIBECK_SPEED),
        presliding_stiffness=friction * joint.presliding_stiffness,
        presliding_damping=np.sqrt(friction) * joint.presliding_damping,
        belt_stiffness=belt * joint.belt_stiffness,
        belt_damping=np.sqrt(belt) * joint.belt_damping,
        torque_scale=rng.uniform(*TORQUE),
        rotor_inertia=rotor * joint.rotor_inertia,
    )


def without_noise(params: SimParams) -> SimParams:
    """The same robot with exact sensors and clocks: what its gains are without noise."""
    machine = replace(
        params.machine,
        sampling_jitter_s=0.0,
        timestamp_error_s=0.0,
        position_noise=0.0,
        encoder_bits=30,
    )
    return replace(params, machine=machine)


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Logs of one joint."""

    joint: str
    sweep: JointLog
    """The paper's chirp at `AMPLITUDES`, `REPEATS` times each."""
    held_out: JointLog
    """A segment for each of `signals`, in that order."""
    signals: tuple[str, ...] = HELD_OUT
    """Names of the held-out signals."""
    exact: JointLog | None = None
    """The sweep's chirp at `THIRD_AMPLITUDE` without noise, once; None if it was not recorded."""


@dataclass(frozen=True, kw_only=True)
class Plans:
    """Motions of one robot."""

    noisy: SweepPlan
    """Sweep, then the held-out signals, with the robot's own sensors."""
    exact: SweepPlan
    """Sweep at the third amplitude, once, without noise."""


@cache
def plans(leg: str, kinds: tuple[str, ...], robot_name: str = ROBOT) -> Plans:
    """Plan the motions of some joints of a leg."""
    robot = load_robot(robot_name)
    joints = [f"{leg}_{joint_kind}" for joint_kind in kinds]
    sweep = make_plan(robot, joints, amplitudes=AMPLITUDES, repeats=REPEATS)
    held_out = []
    for name in joints:
        joint = robot.joint(name)
        for signal in held_out_signals().values():
            held_out.append(
                PlannedExcitation(
                    joint=name, signal=signal, clamped=joint.clamped, sign=joint.original[1]
                )
            )
    exact = []
    for planned in sweep.excitations:
        if planned.repeat == 0 and planned.signal.amplitude == max(AMPLITUDES):
            signal = replace(planned.signal, amplitude=THIRD_AMPLITUDE)
            exact.append(replace(planned, signal=signal))
    return Plans(
        noisy=replace(sweep, excitations=(*sweep.excitations, *held_out)),
        exact=replace(sweep, excitations=tuple(exact)),
    )


def recorded(
    seed: int,
    number: int,
    kinds: Sequence[str],
    folder: Path | None = None,
    *,
    robot: str = ROBOT,
    leg: str | None = None,
    with_exact: bool = True,
) -> list[Recorded]:
    """Record robot `number` of a seed on the bench, or read its logs from the cache.

    Args:
        seed: Seed of the draw and of the noise.
        number: Number of the robot.
        kinds: Joints of the leg, such as `knee`.
        folder: Logs lie there under a hash of parameters, signals and seed; in the system's
            temporary folder if None.
        robot: Name of the robot.
        leg: The leg that is excited; one leg after the other by `number` if None.
        with_exact: Whether the chirp without noise is recorded too.
    """
    params = draw(seed, number, robot)
    legs = legs_of(load_robot(robot))
    excited = leg or legs[number % len(legs)]
    motions = plans(excited, tuple(kinds), robot)
    cache_folder = folder or Path(tempfile.gettempdir()) / "pronk-bench-match"
    prefix = f"{seed}-{number}-{excited}"
    noise_seed = 1000 * seed + number
    noisy_logs = _record(motions.noisy, params, excited, noise_seed, cache_folder, prefix)
    exact_logs: dict[str, JointLog] = {}
    if with_exact:
        exact_params = without_noise(params)
        exact_logs = _record(motions.exact, exact_params, excited, noise_seed, cache_folder, prefix)
    swept = len(AMPLITUDES) * REPEATS
    recordings = []
    for joint in motions.noisy.joints:
        noisy = noisy_logs[joint]
        recordings.append(
            Recorded(
                joint=joint,
                sweep=replace(noisy, segments=noisy.segments[:swept]),
                held_out=replace(noisy, segments=noisy.segments[swept:]),
                exact=exact_logs.get(joint),
            )
        )
    return recordings


def _record(
    plan: SweepPlan, params: SimParams, leg: str, noise_seed: int, cache_folder: Path, prefix: str
) -> dict[str, JointLog]:
    """Record a plan on the bench into a folder of the cache, if it is not there; read its logs."""
    robot = plan.robot
    key = repr((params, plan.excitations, plan.settle_s, noise_seed)).encode()
    out = cache_folder / f"{prefix}-{hashlib.sha256(key).hexdigest()[:12]}"
    if not out.exists():
        cache_folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache_folder) as partial:
            task = SweepTask(plan=plan, out_dir=Path(partial) / "logs")
            record_sweep(VirtualRobot(robot, params, seed=noise_seed, legs=(leg,)), task)
            (Path(partial) / "logs").rename(out)
    return {joint: read_log(out / f"{joint}.mcap", robot=robot) for joint in plan.joints}
