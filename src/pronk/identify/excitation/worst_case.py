"""Worst case of an excitation, simulated before anything moves.

The bench model with the gains of the real drives is simulated once for every corner of the robot's
uncertainty. A plan that exceeds a limit in any corner is refused.
"""

from __future__ import annotations

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
from pronk.robots.model import bench_spec, set_drive_gains
from pronk.robots.motor import electrical_power, torque_limits
from pronk.robots.robot import RobotSpec

TIMESTEP_S = 0.001
"""Physics step. The drives run at 40 kHz (paper S4); a test holds that peaks at this step are
within 2 % of those at 0.25 ms, far inside the corners below."""

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
    """Lower and upper mechanical limit [rad]."""
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

    def breaches(self) -> Iterator[str]:
        """Yield what the joint could do and the limit that it would exceed, in words."""
        low, high = self.range
        if self.lowest < low:
            yield f"reach {self.lowest:.3f} rad, below its range at {low:.3f} rad"
        if self.highest > high:
            yield f"reach {self.highest:.3f} rad, above its range at {high:.3f} rad"
        if self.speed > self.no_load_speed:
            yield (
                f"turn at {self.speed:.1f} rad/s, above its no-load speed of "
                f"{self.no_load_speed:.1f} rad/s"
            )
        if self.torque_share > 1.0:
            yield (
                f"need {self.torque_share:.2f} times the torque that its drive gives at the speed "
                f"of the moment (up to {self.torque:.1f} N m, the limit at standstill "
                f"is {self.effort_limit:.1f} N m)"
            )

    def mirrored(self, robot: RobotSpec, joint: str) -> Forecast:
        """Return the forecast of a joint that mirrors this one."""
        mirrored = robot.joint(joint)
        sign = mirrored.original[1] * robot.joint(self.joint).original[1]
        ends = (sign * self.lowest, sign * self.highest)
        return replace(self, joint=joint, lowest=min(ends), highest=max(ends), range=mirrored.range)


def forecast(
    robot: RobotSpec,
    joint: str,
    offsets: Array,
    *,
    rate_hz: float,
    stiffness: Mapping[str, float],
    damping: Mapping[str, float],
    uncertainty: Uncertainty | None = None,
    timestep_s: float = TIMESTEP_S,
) -> list[Forecast]:
    """Simulate the bench model in every corner of the uncertainty.

    Args:
        robot: The robot.
        joint: Name of the excited joint.
        offsets: Command offsets about the default pose at each tick [rad], shape (ticks,).
        rate_hz: Rate of the ticks [Hz].
        stiffness: Stiffness on the real drives by joint [N m/rad].
        damping: Damping on the real drives by joint [N m s/rad].
        uncertainty: Differences of the robot from its model; the defaults of `Uncertainty` if None.
        timestep_s: Physics step [s].

    Returns:
        A forecast for each joint of the chain.

    Raises:
        PlanError: The simulation diverges.
    """
    spec = bench_spec(robot, joint, stiffness=stiffness, damping=damping)
    spec.option.timestep = timestep_s
    model = spec.compile()
    order = [model.actuator(i).name for i in range(model.nu)]
    pose = np.array([robot.joint(name).default_position for name in order])
    command = np.tile(pose, (round(SETTLE_S * rate_hz) + len(offsets), 1))
    command[-len(offsets) :, order.index(joint)] += offsets
    steps = np.repeat(command, round(1.0 / (rate_hz * timestep_s)), axis=0)
    corners = (uncertainty or Uncertainty()).corners()
    models = []
    for inertia, strength, friction in corners:
        altered = copy(model)
        altered.body_mass[:] *= inertia
        altered.body_inertia[:] *= inertia
        altered.dof_armature[:] *= inertia
        altered.dof_frictionloss[:] *= friction
        mujoco.mj_setConst(altered, mujoco.MjData(altered))
        for name in order:
            set_drive_gains(
                altered,
                name,
                robot.joint(name).drive,
                strength * stiffness[name],
                strength * damping[name],
            )
        models.append(altered)
    position, velocity = _roll(models, order, steps)
    if not (np.isfinite(position).all() and np.abs(velocity).max() < 1e4):
        raise PlanError(
            f"{joint}: the simulation of the excitation diverges; its gains "
            f"({stiffness[joint]:g} N m/rad, {damping[joint]:g} N m s/rad) are not stable."
        )
    strengths = np.array(corners)[:, 1:2]
    forecasts = []
    for i, name in enumerate(order):
        drive = robot.joint(name).drive
        q = position[..., i]
        v = velocity[..., i]
        torque = strengths * stiffness[name] * (steps[:, i] - q) - strengths * damping[name] * v
        low, high = torque_limits(v, drive.stall_torque, drive.no_load_speed, drive.effort_limit)
        # A drive that can give nothing at this speed exceeds its limit with any command.
        available = np.maximum(np.where(torque >= 0.0, high, -low), 1e-6)
        produced = np.clip(torque, low, high)
        power = electrical_power(
            produced,
            v,
            gear_ratio=drive.gear_ratio,
            torque_constant=drive.torque_constant,
            stall_torque=drive.stall_torque,
            bus_voltage=drive.bus_voltage,
        )
        forecasts.append(
            Forecast(
                joint=name,
                excited=joint,
                amplitude=float(np.abs(offsets).max()) if name == joint else 0.0,
                lowest=float(q.min()),
                highest=float(q.max()),
                range=robot.joint(name).range,
                speed=float(np.abs(v).max()),
                no_load_speed=drive.no_load_speed,
                torque=float(np.abs(torque).max()),
                effort_limit=drive.effort_limit,
                torque_share=float((np.abs(torque) / available).max()),
                mechanical_power=float((produced * v).max()),
                electrical_power=float(power.max()),
                bus_current=float((power / drive.bus_voltage).max()),
            )
        )
    return forecasts


def _roll(
    models: Sequence[mujoco.MjModel], order: Sequence[str], steps: Array
) -> tuple[Array, Array]:
    """Return positions and velocities at the start of each step, each (models, steps, joints).

    `steps` holds the commands of all joints at each step [rad], shape (steps, joints).
    """
    model = models[0]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data, initial, full)
    threads = os.cpu_count() or 1
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        states, _ = pool.rollout(
            list(models),
            [mujoco.MjData(model) for _ in range(threads)],
            np.tile(initial, (len(models), 1)),
            np.broadcast_to(steps, (len(models), *steps.shape)),
        )
    before = np.concatenate([np.tile(initial, (len(models), 1, 1)), states[:, :-1]], axis=1)
    # Full physics begins with time, then qpos, then qvel (mjtState); a bench has hinges only.
    columns = np.array([model.joint(name).qposadr[0] for name in order])
    rates = np.array([model.joint(name).dofadr[0] for name in order])
    return before[..., 1 + columns], before[..., 1 + model.nq + rates]
