"""The plan of a sweep: its excitations, their order, and the worst case before anything moves.

Nothing moves before `SweepPlan.check` has passed. It refuses what could exceed a limit of the
robot in any corner of the robot's uncertainty, and names the amplitude that would fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PlanError
from pronk.excitation.signals import Chirp, Signal
from pronk.excitation.worst_case import Forecast, Uncertainty, forecast
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

POSE_RAMP_S = 2.0
"""Time to move softly to the pose before the questions of a joint [s]."""
_FIT_ROUNDS = 10
"""Rounds of shrinking an amplitude, at most by half each, until it fits."""
_BISECTIONS = 3
"""Rounds of growing it again towards the last one that did not fit."""


@dataclass(frozen=True, kw_only=True)
class Ask:
    """One question: a signal to each of one or several joints, at the same time."""

    joints: tuple[str, ...]
    signals: tuple[Signal, ...]
    """One a joint."""
    repeat: int = 0
    """Number of this repeat of the same question, from 0."""
    clamped: tuple[str, ...] = ()
    """Joints fixed mechanically meanwhile."""
    signs: tuple[float, ...] = ()
    """Sign of each joint's command. Mirror-image joints are excited mirrored, so that the match
    simulates each family once; all positive if empty."""

    def offsets(self, rate_hz: float) -> Array:
        """Command offsets about the pose [rad], shape (ticks, joints); shorter ones end early."""
        waves = [signal.samples(rate_hz) for signal in self.signals]
        offsets = np.zeros((max(len(wave) for wave in waves), len(waves)))
        for i, wave in enumerate(waves):
            offsets[: len(wave), i] = wave
        return np.asarray(offsets * np.array(self.signs or (1.0,) * len(waves)))

    def frequency(self, rate_hz: float) -> Array:
        """Instantaneous frequency [Hz], shape (ticks,); NaN where there is none."""
        return max((s.frequency(rate_hz) for s in self.signals), key=len)

    @property
    def amplitude(self) -> float:
        """Peak of the loudest command about the pose [rad]."""
        return max(signal.amplitude for signal in self.signals)


@dataclass(frozen=True, kw_only=True)
class SweepPlan:
    """Excitations in the order of the sweep. Build it with `make_plan`."""

    robot: Robot
    asks: tuple[Ask, ...]
    rate_hz: float
    """Rate of the commands."""
    settle_s: float
    """Rest after each question, logged as its part [s]."""
    stiffness: Array
    """Gains on the drives [N m/rad], shape (joints,)."""
    damping: Array
    """Gains on the drives [N m s/rad], shape (joints,)."""
    uncertainty: Uncertainty
    forecasts: tuple[Forecast, ...]
    """What the loudest question to each joint will do to it and to its neighbours, over every
    corner of the uncertainty; quieter ones of the same signal stay inside."""

    @property
    def pose(self) -> Array:
        """Positions the signals are centred on [rad], shape (joints,)."""
        return np.array([joint.default_position for joint in self.robot.joints])

    @property
    def sets(self) -> tuple[tuple[str, ...], ...]:
        """Joints that are excited together, in order; one log file each."""
        return tuple(dict.fromkeys(ask.joints for ask in self.asks))

    @property
    def joints(self) -> tuple[str, ...]:
        """Excited joints, in order."""
        return tuple(dict.fromkeys(name for joints in self.sets for name in joints))

    def ask_duration_s(self, ask: Ask) -> float:
        """Time of one question, its rest included [s]."""
        return len(ask.frequency(self.rate_hz)) / self.rate_hz + self.settle_s

    @property
    def duration_s(self) -> float:
        """Time of the whole sweep on the machine's clock [s]."""
        excited = sum(self.ask_duration_s(ask) for ask in self.asks)
        return excited + len(self.sets) * (POSE_RAMP_S + 2.0 * self.settle_s)

    def rows(self) -> list[dict[str, float | str]]:
        """The forecasts as a table: a row per joint, worst case over the uncertainty."""
        rows: list[dict[str, float | str]] = []
        for f in self.forecasts:
            if f.amplitude == 0.0:
                continue
            rows.append(
                {
                    "joint": f.joint,
                    "amplitude_rad": f.amplitude,
                    "lowest_rad": f.lowest,
                    "highest_rad": f.highest,
                    "range_low_rad": f.range[0],
                    "range_high_rad": f.range[1],
                    "speed_rad_s": f.speed,
                    "no_load_speed_rad_s": f.no_load_speed,
                    "torque_nm": f.torque,
                    "effort_limit_nm": f.effort_limit,
                    "torque_share": f.torque_share,
                    "mechanical_power_w": f.mechanical_power,
                    "electrical_power_w": f.electrical_power,
                    "bus_current_a": f.bus_current,
                }
            )
        return rows

    def check(self) -> None:
        """Refuse a sweep that could exceed a limit.

        Raises:
            PlanError: Names the joint, the number, the limit, and the amplitude that would fit
                (found by simulating it).
        """
        for worst in self.forecasts:
            if not worst.breaches():
                continue
            # The forecasts are of the largest amplitude, which comes first.
            ask = next(ask for ask in self.asks if ask.joints == worst.excited)
            words = worst.breaches()[0]
            fits = self._fit(ask)
            way_out = (
                f"an amplitude of {fits:.3g} rad fits"
                if fits > 0.0
                else "no amplitude fits, so choose other joints or another pose"
            )
            raise PlanError(
                f"{', '.join(ask.joints)}: excited with {ask.amplitude:g} rad, {worst.joint} could "
                f"{words} (inertia, gains and friction uncertain by "
                f"{100 * self.uncertainty.inertia:.0f}, {100 * self.uncertainty.stiffness:.0f} and "
                f"{100 * self.uncertainty.friction:.0f} %); {way_out}."
            )

    def _fit(self, ask: Ask) -> float:
        """Largest amplitude found by shrinking and simulating again [rad]; 0 if none is."""
        rest = dict(zip(self.robot.joint_names, self.pose, strict=True))

        def factor(share: float) -> float:
            """1 if this share of the amplitude fits, 0 if none can, else by what to shrink it."""
            signals = tuple(s.with_amplitude(s.amplitude * share) for s in ask.signals)
            quieter = replace(ask, signals=signals)
            ends = _forecast_ask(
                self.robot,
                quieter,
                self.rate_hz,
                self.stiffness,
                self.damping,
                self.uncertainty,
                {},
            )
            if not any(f.breaches() for f in ends):
                return 1.0
            linear = min(f.shrink(rest[f.joint]) for f in ends)
            # A saturated drive is far from linear, so never less than half at a time.
            return float(np.clip(linear, 0.5, 0.98)) if linear > 0.0 else 0.0

        share, too_much = 1.0, 1.0
        for _ in range(_FIT_ROUNDS):
            shrink = factor(share)
            if shrink == 1.0:
                break
            if shrink == 0.0:
                return 0.0
            too_much, share = share, share * shrink
        else:
            return 0.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (share + too_much)
            if factor(middle) == 1.0:
                share = middle
            else:
                too_much = middle
        return _floor(ask.amplitude * share)


def _floor(value: float) -> float:
    """Three significant digits, rounded down."""
    scale = 10.0 ** (np.floor(np.log10(value)) - 2)
    return float(np.floor(value / scale * (1.0 + 1e-12)) * scale)


def _chain(robot: Robot, name: str) -> tuple[str, ...]:
    return robot.joint(name).chain or (name,)


def make_plan(
    robot: Robot,
    joints: Sequence[str] | None = None,
    signal: Signal | None = None,
    *,
    amplitudes: Sequence[float] = (0.25, 0.125),
    repeats: int | Sequence[int] = 3,
    settle_s: float = 0.5,
    stiffness: Mapping[str, float] | None = None,
    damping: Mapping[str, float] | None = None,
    uncertainty: Uncertainty | None = None,
) -> SweepPlan:
    """Plan a sweep, and forecast what it will do to the robot.

    One joint at a time (paper F1), in the order of the robot's files; each amplitude `repeats`
    times. Joints that the robot says must be clamped for a question are (paper F6), the others
    are held by their drives (paper F5).

    Args:
        robot: The robot.
        joints: Names; all of them if None.
        signal: What to ask; its own amplitude is replaced. The paper's chirp if None.
        amplitudes: Peaks of the command [rad]; two or more show friction.
        repeats: Repeats of each amplitude, one number for all or one each; three or more of
            the largest, which is the one matched, give honest intervals.
        settle_s: Rest after each question [s].
        stiffness: Gains on the drives by joint, instead of the robot's [N m/rad].
        damping: Gains on the drives by joint, instead of the robot's [N m s/rad].
        uncertainty: How far the robot may be from its model.

    Returns:
        The plan. Call its `check` before anything moves; `record` does.

    Raises:
        RobotError: A joint is unknown.
        PlanError: The plan is empty, or joints cannot be excited together.
    """
    names = robot.joint_names if joints is None else tuple(dict.fromkeys(joints))
    for name in (*names, *(stiffness or {}), *(damping or {})):
        robot.joint(name)
    counts = [repeats] * len(amplitudes) if isinstance(repeats, int) else list(repeats)
    if not names or not amplitudes or len(counts) != len(amplitudes) or min(counts) < 1:
        raise PlanError(
            f"a plan of {len(names)} joints, {len(amplitudes)} amplitudes and {repeats} repeats "
            "asks nothing; expected at least one of each, and one number of repeats for all or "
            "one an amplitude."
        )
    if not (np.isfinite(settle_s) and settle_s >= 0.0):
        raise PlanError(f"settle_s is {settle_s}; expected 0 s or more, for instance 0.5.")
    signal = Chirp() if signal is None else signal
    kp = np.array([(stiffness or {}).get(j.name, j.stiffness) for j in robot.joints])
    kd = np.array([(damping or {}).get(j.name, j.damping) for j in robot.joints])
    for label, values in (("stiffness", kp), ("damping", kd)):
        if not (np.isfinite(values).all() and (values >= 0.0).all()):
            raise PlanError(
                f"a {label} on the drives is negative or not finite; expected 0 or more."
            )
    times = dict(zip(amplitudes, counts, strict=True))
    loudest = dict(sorted(times.items(), reverse=True))
    asks = _one_by_one(robot, names, signal, loudest)
    rate = robot.policy_rate_hz
    uncertainty = uncertainty or Uncertainty()
    cache: dict[bytes, list[Forecast]] = {}
    forecasts = [
        f
        for ask in asks
        if ask.repeat == 0 and ask.amplitude == max(loudest)
        for f in _forecast_ask(robot, ask, rate, kp, kd, uncertainty, cache)
    ]
    return SweepPlan(
        robot=robot,
        asks=asks,
        rate_hz=rate,
        settle_s=settle_s,
        stiffness=kp,
        damping=kd,
        uncertainty=uncertainty,
        forecasts=tuple(forecasts),
    )


def _one_by_one(
    robot: Robot, names: Sequence[str], signal: Signal, times: Mapping[float, int]
) -> tuple[Ask, ...]:
    return tuple(
        Ask(
            joints=(name,),
            signals=(signal.with_amplitude(amplitude),),
            repeat=repeat,
            clamped=robot.joint(name).clamped,
            signs=(robot.joint(name).original[1],),
        )
        for name in names
        for amplitude, count in times.items()
        for repeat in range(count)
    )


def _forecast_ask(
    robot: Robot,
    ask: Ask,
    rate_hz: float,
    stiffness: Array,
    damping: Array,
    uncertainty: Uncertainty,
    cache: dict[bytes, list[Forecast]],
) -> list[Forecast]:
    """Forecasts of every joint that a question moves; mirror-image legs are simulated once."""
    kp = dict(zip(robot.joint_names, stiffness.tolist(), strict=True))
    kd = dict(zip(robot.joint_names, damping.tolist(), strict=True))
    offsets = dict(zip(ask.joints, ask.offsets(rate_hz).T, strict=True))
    found: list[Forecast] = []
    left = list(ask.joints)
    while left:
        # The longest chain first: it contains the other excited joints of its leg.
        lead = max(left, key=lambda name: len(set(_chain(robot, name)) & set(left)))
        own = _chain(robot, lead)
        excited = [name for name in left if name in own]
        left = [name for name in left if name not in own]
        originals = _chain(robot, robot.joint(lead).original[0])
        sign = {
            name: robot.joint(name).original[1] * robot.joint(first).original[1]
            for name, first in zip(own, originals, strict=True)
        }
        mirror = dict(zip(own, originals, strict=True))
        command = {mirror[name]: sign[name] * offsets[name] for name in excited}
        gains = [{mirror[name]: g[name] for name in own} for g in (kp, kd)]
        key = repr((sorted(gains[0].items()), sorted(gains[1].items()))).encode() + b"".join(
            name.encode() + wave.tobytes() for name, wave in sorted(command.items())
        )
        if key not in cache:
            cache[key] = list(
                forecast(
                    robot,
                    command,
                    rate_hz=rate_hz,
                    stiffness=gains[0],
                    damping=gains[1],
                    uncertainty=uncertainty,
                ).values()
            )
        back = {first: name for name, first in mirror.items()}
        for f in cache[key]:
            name = back[f.joint]
            found.append(replace(f.mirrored(robot, name, sign[name]), excited=ask.joints))
    return found
