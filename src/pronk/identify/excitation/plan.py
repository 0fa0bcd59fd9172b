"""The plan of a sweep: its excitations, their order, and the worst case before anything moves.

Nothing moves before `SweepPlan.check` has passed. It refuses what could exceed a limit of the
robot in any corner of the robot's uncertainty, and names the amplitude that would fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.errors import PlanError
from pronk.identify.excitation.signals import Chirp, Signal
from pronk.identify.excitation.worst_case import Forecast, Uncertainty, forecast
from pronk.robots.robot import RobotSpec

POSE_RAMP_S = 2.0
"""Time to move softly to the pose before the excitations of a joint [s]."""
_BISECTIONS = 6
"""Of an amplitude that is too large, to find one that fits: 1.6 % of it are left."""


@dataclass(frozen=True, kw_only=True)
class PlannedExcitation:
    """A signal to one joint; repeats of it are numbered from 0."""

    joint: str
    signal: Signal
    repeat: int = 0
    clamped: tuple[str, ...] = ()
    """Joints fixed mechanically meanwhile."""
    sign: float = 1.0
    """Mirror-image joints are excited mirrored, so that the match simulates each family once."""

    def offsets(self, rate_hz: float) -> Array:
        """Command offsets about the pose [rad], shape (ticks,)."""
        return np.asarray(self.sign * self.signal.samples(rate_hz))


@dataclass(frozen=True, kw_only=True)
class SweepPlan:
    """Excitations in the order of the sweep. Build it with `make_plan`."""

    robot: RobotSpec
    excitations: tuple[PlannedExcitation, ...]
    rate_hz: float
    """Rate of the commands."""
    settle_s: float
    """Rest after each excitation, logged as its part [s]."""
    stiffness: Array
    damping: Array
    """Gains on the drives [N m/rad], [N m s/rad], shape (joints,)."""
    uncertainty: Uncertainty
    forecasts: tuple[Forecast, ...] = ()
    """Worst case of the loudest excitation of each joint, for it and its neighbours, over every
    corner of the uncertainty; quieter ones of the same signal stay inside."""

    @property
    def pose(self) -> Array:
        """Positions the signals are centred on [rad], shape (joints,)."""
        return np.array([joint.default_position for joint in self.robot.joints])

    @property
    def joints(self) -> tuple[str, ...]:
        """Excited joints, in order; one log file each."""
        return tuple(dict.fromkeys(each.joint for each in self.excitations))

    def seconds(self, excitation: PlannedExcitation) -> float:
        """Time of one excitation, its rest included [s]."""
        return excitation.signal.duration_s(self.rate_hz) + self.settle_s

    @property
    def duration_s(self) -> float:
        """Time of the whole sweep on the machine's clock [s]."""
        excited = sum(self.seconds(each) for each in self.excitations)
        return excited + len(self.joints) * (POSE_RAMP_S + 2.0 * self.settle_s)

    def rows(self) -> list[dict[str, Any]]:
        """The forecasts as a table: a row per joint, worst case over the uncertainty."""
        units = {
            **dict.fromkeys(("amplitude", "lowest", "highest"), "rad"),
            **dict.fromkeys(("speed", "no_load_speed"), "rad_s"),
            **dict.fromkeys(("torque", "effort_limit"), "nm"),
            **dict.fromkeys(("mechanical_power", "electrical_power"), "w"),
            "bus_current": "a",
        }
        return [
            {"joint": f.joint, "torque_share": f.torque_share}
            | {"range_low_rad": f.range[0], "range_high_rad": f.range[1]}
            | {f"{name}_{unit}": getattr(f, name) for name, unit in units.items()}
            for f in self.forecasts
            if f.amplitude > 0.0
        ]

    def check(self) -> None:
        """Refuse a sweep that could exceed a limit.

        The PlanError names joint, number, limit, and the amplitude that fits in simulation.
        """
        for worst in self.forecasts:
            if not (breach := next(worst.breaches(), "")):
                continue
            # The forecasts are of the largest amplitude, which comes first.
            loudest = next(each for each in self.excitations if each.joint == worst.excited)
            fits, unsure = self._fit(loudest), self.uncertainty
            way_out = "no amplitude fits, so choose other joints or another pose"
            if fits > 0.0:
                way_out = f"an amplitude of {fits:.3g} rad fits"
            raise PlanError(
                f"{worst.excited}: excited with {loudest.signal.amplitude:g} rad, {worst.joint} "
                f"could {breach} (inertia, gains and friction uncertain by "
                f"{100 * unsure.inertia:.0f}, {100 * unsure.stiffness:.0f} and "
                f"{100 * unsure.friction:.0f} %); {way_out}."
            )

    def _fit(self, excitation: PlannedExcitation) -> float:
        """Largest amplitude that fits, by bisection [rad], rounded down; 0 if none does."""
        fits, too_much = 0.0, 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (fits + too_much)
            amplitude = share * excitation.signal.amplitude
            quieter = replace(excitation, signal=replace(excitation.signal, amplitude=amplitude))
            exceeds = any(any(found.breaches()) for found in self._worst(quieter, {}))
            fits, too_much = (fits, share) if exceeds else (share, too_much)
        amplitude = fits * excitation.signal.amplitude
        # Three significant digits.
        scale = 10.0 ** (np.floor(np.log10(amplitude or 1.0)) - 2)
        return float(np.floor(amplitude / scale * (1.0 + 1e-12)) * scale)

    def _worst(
        self, excitation: PlannedExcitation, cache: dict[tuple[object, ...], list[Forecast]]
    ) -> list[Forecast]:
        """Forecasts of every joint of the chain; mirror-image legs are simulated once."""
        robot, joint = self.robot, self.robot.joint(excitation.joint)
        original, sign = joint.original
        own = joint.chain or (joint.name,)
        firsts = robot.joint(original).chain or (original,)
        columns = [robot.joint_names.index(name) for name in own]
        stiffness, damping = (
            dict(zip(firsts, gains[columns].tolist(), strict=True))
            for gains in (self.stiffness, self.damping)
        )
        offsets = sign * robot.joint(original).original[1] * excitation.offsets(self.rate_hz)
        key = original, str((stiffness, damping)), offsets.tobytes()
        if key not in cache:
            cache[key] = forecast(
                robot,
                original,
                offsets,
                rate_hz=self.rate_hz,
                stiffness=stiffness,
                damping=damping,
                uncertainty=self.uncertainty,
            )
        names = dict(zip(firsts, own, strict=True))
        return [
            replace(found.mirrored(robot, names[found.joint]), excited=excitation.joint)
            for found in cache[key]
        ]


def make_plan(
    robot: RobotSpec,
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
    """Plan a sweep, and forecast its effect on the robot; call its `check` before anything moves.

    One joint at a time (paper F1), in the order given, all in the robot's order if None. Joints
    that the robot's file clamps for an excitation are clamped (paper F6), the others are held by
    their drives (paper F5), with gains by joint instead of the robot's [N m/rad], [N m s/rad].

    The `signal`, the paper's chirp if None, has each of `amplitudes` [rad] as its peak, `repeats`
    times: one number for all or one each. Two amplitudes show friction; intervals need three
    repeats of the largest, which is the one matched. Each excitation ends with a rest.
    """
    names = robot.joint_names if joints is None else tuple(dict.fromkeys(joints))
    for name in (*names, *(stiffness or {}), *(damping or {})):
        robot.joint(name)
    counts = [repeats] * len(amplitudes) if isinstance(repeats, int) else list(repeats)
    if not names or not amplitudes or len(counts) != len(amplitudes) or min(counts) < 1:
        raise PlanError(
            f"a plan of {len(names)} joints, {len(amplitudes)} amplitudes and {repeats} repeats "
            "excites nothing; expected at least one of each, and one number of repeats for all or "
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
    times = sorted(zip(amplitudes, counts, strict=True), reverse=True)
    excitations = tuple(
        PlannedExcitation(
            joint=name,
            signal=replace(signal, amplitude=amplitude),
            repeat=repeat,
            clamped=robot.joint(name).clamped,
            sign=robot.joint(name).original[1],
        )
        for name in names
        for amplitude, count in dict(times).items()
        for repeat in range(count)
    )
    plan = SweepPlan(
        robot=robot,
        excitations=excitations,
        rate_hz=robot.policy_rate_hz,
        settle_s=settle_s,
        stiffness=kp,
        damping=kd,
        uncertainty=uncertainty or Uncertainty(),
    )
    cache: dict[tuple[object, ...], list[Forecast]] = {}
    loudest = [e for e in excitations if e.repeat == 0 and e.signal.amplitude == max(amplitudes)]
    return replace(plan, forecasts=tuple(f for e in loudest for f in plan._worst(e, cache)))
