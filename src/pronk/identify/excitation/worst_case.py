"""Worst case of an excitation, simulated before anything moves.

The bench model with the gains of the real drives is simulated once for every corner of the robot's
uncertainty. A plan that exceeds a limit in any corner is refused.

A drive is simulated as MuJoCo's position actuator with the integrator implicitfast, whose damping
is implicit: no damping is too large for the step, however small the inertia. (Explicit damping is
unstable from `2 h kd / J = 4` on, which a stiff arm's wrist exceeds a hundredfold at 1 ms.) The
torque is that of the drive law, not cut at the limits of the drive: what exceeds them is refused,
and what stays inside them is not cut. The step is halved until peaks have converged.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import mujoco.rollout
import numpy as np

from pronk.arrays import Array
from pronk.errors import PlanError
from pronk.robots.model import bench_spec
from pronk.robots.motor import electrical_power, torque_limits
from pronk.robots.robot import Drive, RobotSpec

LARGEST_TIMESTEP_S = 0.001
"""Physics step with which the search for one begins [s]."""
SMALLEST_TIMESTEP_S = 3e-5
"""Smallest physics step of a forecast; 20 s of a leg at half of it take some ten seconds [s]."""
CONVERGED = 0.02
"""Change of the peaks with half the step at which a step suffices, as a share of the peaks. The
error of the scheme is of first order in the step, so the peaks are within twice this share."""
FASTEST = 1e5
"""Speed that no joint has; a simulation that reaches it has diverged [rad/s]."""
NEIGHBOUR = 0.05
"""Share of its limit within which a peak of a joint that is only held may change with the step.
What an abrupt torque of the excited joint does to a stiff neighbour lasts microseconds, less than
the lag of any drive."""

SPEED_SHARE = 0.95
"""Share of its no-load speed that a joint may reach. A sweep ends where a measured speed exceeds
that speed, and a measured speed has noise, quanta, and the motion of a motor on its gear, about
4 % together of the virtual robots of arms whose speed limits are low."""
REST_RAD = 1e-3
"""Angle by which a joint that is only held may move on from a place at its stop to which it sags
without excitation: a stop of MuJoCo gives way by about that much [rad]."""

SETTLE_S = 0.5
"""Rest before the excitation, in which the leg sags into its pose [s]."""


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """Largest differences of the robot from its model, as shares of the model's values."""

    inertia: float = 0.2
    """Share of masses, link inertias and armature. The paper's own gains amount to 3 to 29 %
    (reading A10); Cheetah-Software's rotor is 13 % lighter than the paper's (reading A11)."""
    stiffness: float = 0.1
    """Share of the torque constant, and with it of both gains. It is assumed, as no data sheet
    gives it."""
    friction: float = 1.0
    """Share of the dry friction: 1 for none to twice the model's."""

    def corners(self) -> list[tuple[float, float, float]]:
        """Return factors of inertia, stiffness and friction: 1 each, then the eight corners."""
        inertia = (1.0 - self.inertia, 1.0 + self.inertia)
        stiffness = (1.0 - self.stiffness, 1.0 + self.stiffness)
        friction = (1.0 - self.friction, 1.0 + self.friction)
        return [(1.0, 1.0, 1.0), *product(inertia, stiffness, friction)]


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """Extremes of one joint over an excitation and over every corner of the uncertainty."""

    joint: str
    """Name of the joint."""
    excited: str
    """Name of the excited joint: this joint, or a neighbour of it."""
    amplitude: float
    """Peak of the command [rad]; 0 for a joint that is only held."""
    lowest: float
    """Lowest position [rad]."""
    highest: float
    """Highest position [rad]."""
    range: tuple[float, float]
    """Lower and upper mechanical limit [rad]; of a joint that is only held, a little beyond where
    it goes without excitation, if that is further."""
    speed: float
    """Greatest speed [rad/s]."""
    no_load_speed: float
    """Speed at which back-EMF takes all of the bus voltage [rad/s]."""
    torque: float
    """Greatest torque that the controller commands [N m]."""
    effort_limit: float
    """Greatest torque of the drive at standstill [N m]."""
    torque_share: float
    """Greatest torque, as a share of the torque available at the speed of the moment."""
    mechanical_power: float
    """Greatest mechanical power [W]."""
    electrical_power: float
    """Greatest power from the bus [W]."""
    bus_current: float
    """Greatest current from the bus [A]."""
    nominal: Forecast | None = None
    """The same of the model as it is, without uncertainty; None in the forecast of one corner."""

    def breaches(self) -> Iterator[str]:
        """Yield what the joint could do and the limit that it would exceed, in words."""
        low, high = self.range
        if self.lowest < low:
            yield f"reach {self.lowest:.3f} rad, below its range at {low:.3f} rad"
        if self.highest > high:
            yield f"reach {self.highest:.3f} rad, above its range at {high:.3f} rad"
        if self.speed > SPEED_SHARE * self.no_load_speed:
            yield (
                f"turn at {self.speed:.3g} rad/s, above {100 * SPEED_SHARE:.0f} % of its no-load "
                f"speed of {self.no_load_speed:.3g} rad/s"
            )
        if self.torque_share > 1.0:
            yield (
                f"need {self.torque_share:.2f} times the torque that its drive gives at the speed "
                f"of the moment (up to {self.torque:.1f} N m, the limit at standstill "
                f"is {self.effort_limit:.1f} N m)"
            )

    def leaves_range(self) -> bool:
        """Tell whether the joint could leave its range."""
        return self.lowest < self.range[0] or self.highest > self.range[1]

    def mirrored(self, robot: RobotSpec, joint: str) -> Forecast:
        """Return the forecast of a joint that mirrors this one."""
        mirrored = robot.joint(joint)
        simulated = robot.joint(self.joint)
        sign = mirrored.original[1] * simulated.original[1]
        ends = (sign * self.lowest, sign * self.highest)
        below = simulated.range[0] - self.range[0]
        above = self.range[1] - simulated.range[1]
        if sign < 0.0:
            below, above = above, below
        nominal = self.nominal
        if nominal is not None:
            nominal = nominal.mirrored(robot, joint)
        return replace(
            self,
            joint=joint,
            lowest=min(ends),
            highest=max(ends),
            range=(mirrored.range[0] - below, mirrored.range[1] + above),
            nominal=nominal,
        )

    def of_excitation(self, joint: str) -> Forecast:
        """Return the forecast as that of the excitation of another joint."""
        nominal = self.nominal
        if nominal is not None:
            nominal = nominal.of_excitation(joint)
        return replace(self, excited=joint, nominal=nominal)


@dataclass(frozen=True, kw_only=True)
class _Bench:
    """The bench model of a joint, commanded from tick to tick."""

    robot: RobotSpec
    """The robot."""
    joint: str
    """Name of the excited joint."""
    offsets: Array
    """Command offsets about the default pose at each tick [rad], shape (ticks,)."""
    rate_hz: float
    """Rate of the ticks [Hz]."""
    stiffness: Mapping[str, float]
    """Stiffness on the real drives by joint [N m/rad]."""
    damping: Mapping[str, float]
    """Damping on the real drives by joint [N m s/rad]."""

    def steps_a_tick(self, timestep_s: float) -> int:
        """Return how many physics steps of at most `timestep_s` a tick has."""
        return max(1, math.ceil(1.0 / (self.rate_hz * timestep_s) - 1e-9))

    def simulate(
        self, corners: Sequence[tuple[float, float, float]], timestep_s: float
    ) -> list[list[Forecast]] | None:
        """Simulate the excitation in some corners of the uncertainty.

        Args:
            corners: Factors of inertia, stiffness and friction.
            timestep_s: Largest physics step [s]; whole steps make a tick.

        Returns:
            For each corner a forecast for each joint of the chain; None if a simulation diverged.
        """
        steps_a_tick = self.steps_a_tick(timestep_s)
        spec = bench_spec(self.robot, self.joint)
        spec.option.timestep = 1.0 / (self.rate_hz * steps_a_tick)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model = spec.compile()
        names = [model.actuator(index).name for index in range(model.nu)]
        pose = np.array([self.robot.joint(name).default_position for name in names])
        ticks = np.tile(pose, (round(SETTLE_S * self.rate_hz) + len(self.offsets), 1))
        ticks[-len(self.offsets) :, names.index(self.joint)] += self.offsets
        command = np.repeat(ticks, steps_a_tick, axis=0)
        # A robot has sagged into its pose when a sweep begins; the model falls into it.
        settled = len(command) - steps_a_tick * len(self.offsets)
        forecasts = []
        threads = os.cpu_count() or 1
        # No more corners at once than run at once, so that small steps do not need much memory.
        for begin in range(0, len(corners), threads):
            some_corners = corners[begin : begin + threads]
            models = []
            for inertia, strength, friction in some_corners:
                altered = copy(model)
                altered.body_mass[:] *= inertia
                altered.body_inertia[:] *= inertia
                altered.dof_armature[:] *= inertia
                altered.dof_frictionloss[:] *= friction
                mujoco.mj_setConst(altered, mujoco.MjData(altered))
                for name in names:
                    stiffness = strength * self.stiffness[name]
                    _set_position_drive(altered, name, stiffness, strength * self.damping[name])
                models.append(altered)
            motion = _roll(models, names, command)
            if motion is None:
                return None
            position, velocity = motion
            for k, (_, strength, _) in enumerate(some_corners):
                chain = []
                for column, name in enumerate(names):
                    q = position[k, settled:, column]
                    v = velocity[k, settled:, column]
                    lag = command[settled:, column] - q
                    torque = strength * (self.stiffness[name] * lag - self.damping[name] * v)
                    chain.append(self._extremes(name, q, v, torque))
                forecasts.append(chain)
        return forecasts

    def _extremes(self, name: str, position: Array, speed: Array, torque: Array) -> Forecast:
        """Return the extremes of one joint in one corner, from its motion at each step."""
        drive = self.robot.joint(name).drive
        low, high = torque_limits(
            speed, drive.stall_torque, drive.no_load_speed, drive.effort_limit
        )
        # A drive that can give nothing at this speed exceeds its limit with any command.
        available = np.maximum(np.where(torque >= 0.0, high, -low), 1e-6 * drive.effort_limit)
        produced = np.clip(torque, low, high)
        power = _power(drive, produced, speed)
        return Forecast(
            joint=name,
            excited=self.joint,
            amplitude=float(np.abs(self.offsets).max()) if name == self.joint else 0.0,
            lowest=float(position.min()),
            highest=float(position.max()),
            range=self.robot.joint(name).range,
            speed=float(np.abs(speed).max()),
            no_load_speed=drive.no_load_speed,
            torque=float(np.abs(torque).max()),
            effort_limit=drive.effort_limit,
            torque_share=float((np.abs(torque) / available).max()),
            mechanical_power=float((produced * speed).max()),
            electrical_power=float(power.max()),
            bus_current=float((power / drive.bus_voltage).max()),
        )

    def converged(self) -> tuple[float, list[Forecast]]:
        """Find the physics step with half of which the peaks of the model stay the same.

        Returns:
            The step [s], and the forecasts of the model as it is, at half the step.

        Raises:
            PlanError: The simulation diverges, or its peaks depend on the step, even at the
                smallest step.
        """
        timestep_s = 1.0 / (self.rate_hz * self.steps_a_tick(LARGEST_TIMESTEP_S))
        as_it_is = [(1.0, 1.0, 1.0)]
        coarse = self.simulate(as_it_is, timestep_s)
        while timestep_s >= SMALLEST_TIMESTEP_S:
            fine = self.simulate(as_it_is, 0.5 * timestep_s)
            if coarse is not None and fine is not None:
                changes = [
                    self._change(before, after)
                    for before, after in zip(coarse[0], fine[0], strict=True)
                ]
                if max(changes) <= CONVERGED:
                    return timestep_s, fine[0]
            coarse = fine
            timestep_s *= 0.5
        fault = "diverges" if coarse is None else "gives other peaks at each step"
        raise PlanError(
            f"{self.joint}: its excitation cannot be forecast. With the gains of its chain "
            f"({self._gains()}) the simulation {fault}, down to a step of "
            f"{1e6 * timestep_s:.0f} us; lower the stiffness, raise the damping, or check the "
            "inertia of the links and the armature."
        )

    def _change(self, coarse: Forecast, fine: Forecast) -> float:
        """Return the largest change of a joint's peaks with the step, as a share of the peaks."""
        pose = self.robot.joint(fine.joint).default_position
        reach = max(fine.highest - pose, pose - fine.lowest)
        coarse_reach = max(coarse.highest - pose, pose - coarse.lowest)
        low, high = fine.range
        change = 0.0
        for before, after, limit in (
            (coarse_reach, reach, high - low),
            (coarse.speed, fine.speed, fine.no_load_speed),
            (coarse.torque, fine.torque, fine.effort_limit),
        ):
            # What is too small to matter: far below the limit of a joint that is only held.
            negligible = 1e-9
            if fine.joint != self.joint:
                negligible = NEIGHBOUR / CONVERGED * limit
            change = max(change, abs(after - before) / max(after, negligible))
        return change

    def _gains(self) -> str:
        """Return the gains of the chain in words."""
        words = []
        for name in self.robot.joint(self.joint).chain or (self.joint,):
            words.append(f"{name} {self.stiffness[name]:g} / {self.damping[name]:g}")
        return ", ".join(words)


def forecast(
    robot: RobotSpec,
    joint: str,
    offsets: Array,
    *,
    rate_hz: float,
    stiffness: Mapping[str, float],
    damping: Mapping[str, float],
    uncertainty: Uncertainty | None = None,
    timestep_s: float | None = None,
) -> tuple[list[Forecast], float]:
    """Simulate the bench model in every corner of the uncertainty.

    Args:
        robot: The robot.
        joint: Name of the excited joint.
        offsets: Command offsets about the default pose at each tick [rad], shape (ticks,).
        rate_hz: Rate of the ticks [Hz].
        stiffness: Stiffness on the real drives by joint [N m/rad].
        damping: Damping on the real drives by joint [N m s/rad].
        uncertainty: Differences of the robot from its model; the defaults of `Uncertainty` if None.
        timestep_s: Physics step [s]; one at which the peaks have converged if None.

    Returns:
        A forecast for each joint of the chain, and the physics step [s].

    Raises:
        PlanError: The simulation diverges, or depends on its step however small that is.
    """
    bench = _Bench(
        robot=robot,
        joint=joint,
        offsets=offsets,
        rate_hz=rate_hz,
        stiffness=stiffness,
        damping=damping,
    )
    corners = (uncertainty or Uncertainty()).corners()
    if timestep_s is None:
        timestep_s, nominal = bench.converged()
        corner_forecasts = bench.simulate(corners[1:], timestep_s)
    else:
        corner_forecasts = bench.simulate(corners, timestep_s)
        nominal = [] if corner_forecasts is None else corner_forecasts.pop(0)
    if corner_forecasts is None:
        raise PlanError(
            f"{joint}: the simulation of its excitation diverges at a step of "
            f"{1e6 * timestep_s:.0f} us where inertia and gains differ from the model by what is "
            "uncertain; lower the stiffness or raise the damping."
        )
    worst = list(nominal)
    for chain in corner_forecasts:
        for column, corner in enumerate(chain):
            worst[column] = _widened(worst[column], corner)
    if any(corner.joint != joint and corner.leaves_range() for corner in worst):
        # What a joint does in its pose is no effect of the excitation.
        still = replace(bench, offsets=np.zeros_like(offsets)).simulate(corners, timestep_s)
        for column, held in enumerate(worst):
            if still is not None and held.joint != joint:
                worst[column] = _at_rest(held, [chain[column] for chain in still])
    forecasts = []
    for widest, as_it_is in zip(worst, nominal, strict=True):
        forecasts.append(replace(widest, nominal=as_it_is))
    return forecasts, timestep_s


def _widened(worst: Forecast, corner: Forecast) -> Forecast:
    """Return a forecast with the extremes of another one of the same joint."""
    return replace(
        worst,
        lowest=min(worst.lowest, corner.lowest),
        highest=max(worst.highest, corner.highest),
        speed=max(worst.speed, corner.speed),
        torque=max(worst.torque, corner.torque),
        torque_share=max(worst.torque_share, corner.torque_share),
        mechanical_power=max(worst.mechanical_power, corner.mechanical_power),
        electrical_power=max(worst.electrical_power, corner.electrical_power),
        bus_current=max(worst.bus_current, corner.bus_current),
    )


def _at_rest(worst: Forecast, still: Sequence[Forecast]) -> Forecast:
    """Return a held joint's forecast whose range holds what it does without excitation.

    Args:
        worst: The forecast.
        still: Forecasts of that joint in every corner, of commands that stay at the pose.
    """
    low, high = worst.range
    for corner in still:
        if corner.lowest < low + REST_RAD:
            low = min(low, corner.lowest - REST_RAD)
        if corner.highest > high - REST_RAD:
            high = max(high, corner.highest + REST_RAD)
    return replace(worst, range=(low, high))


def _power(drive: Drive, torque: Array, speed: Array) -> Array:
    """Return the power that a drive takes from the bus [W]."""
    return electrical_power(
        torque,
        speed,
        gear_ratio=drive.gear_ratio,
        torque_constant=drive.torque_constant,
        stall_torque=drive.stall_torque,
        bus_voltage=drive.bus_voltage,
    )


def _set_position_drive(model: mujoco.MjModel, name: str, stiffness: float, damping: float) -> None:
    """Make the actuator of a joint a position actuator without limits."""
    index = model.actuator(name).id
    model.actuator_gaintype[index] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[index] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_dyntype[index] = mujoco.mjtDyn.mjDYN_NONE
    model.actuator_gainprm[index] = 0.0
    model.actuator_gainprm[index, 0] = stiffness
    model.actuator_biasprm[index] = 0.0
    model.actuator_biasprm[index, 1:3] = (-stiffness, -damping)
    model.actuator_ctrllimited[index] = False
    model.actuator_forcelimited[index] = False


def _roll(
    models: Sequence[mujoco.MjModel], order: Sequence[str], steps: Array
) -> tuple[Array, Array] | None:
    """Simulate models from their default pose.

    Args:
        models: Models of one structure.
        order: Names of their joints.
        steps: Commands of all joints at each step [rad], shape (steps, joints).

    Returns:
        Positions [rad] and velocities [rad/s] at the start of each step, each of shape
        (models, steps, joints); None if a simulation diverged.
    """
    model = models[0]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data, initial, full)
    with mujoco.rollout.Rollout(nthread=len(models)) as pool:
        states, _ = pool.rollout(
            list(models),
            [mujoco.MjData(model) for _ in models],
            np.tile(initial, (len(models), 1)),
            np.broadcast_to(steps, (len(models), *steps.shape)),
        )
    # Time stops, or starts again at 0, where MuJoCo meets numbers that are no motion.
    end_s = initial[0] + (len(steps) - 0.5) * model.opt.timestep
    if not (np.isfinite(states).all() and states[:, -1, 0].min() > end_s):
        return None
    before = np.concatenate([np.tile(initial, (len(models), 1, 1)), states[:, :-1]], axis=1)
    # Full physics begins with time, then qpos, then qvel (mjtState); a bench has hinges only.
    columns = np.array([model.joint(name).qposadr[0] for name in order])
    rates = np.array([model.joint(name).dofadr[0] for name in order])
    velocity = before[..., 1 + model.nq + rates]
    if np.abs(velocity).max() > FASTEST:
        return None
    return before[..., 1 + columns], velocity
