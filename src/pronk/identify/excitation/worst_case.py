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
    """How far the robot may be from its model, in shares of the model's values."""

    inertia: float = 0.2
    """Masses, link inertias and armature. The paper's own gains amount to 3 to 29 % (reading
    A10); Cheetah-Software's rotor is 13 % lighter than the paper's (reading A11)."""
    stiffness: float = 0.1
    """Torque constant and with it both gains. An assumption: no data sheet gives it."""
    friction: float = 1.0
    """Dry friction: from none to twice the model's."""

    def corners(self) -> list[tuple[float, float, float]]:
        """(inertia, stiffness, friction) factors: the model itself, then the eight corners."""
        a, b, c = ((1.0 - w, 1.0 + w) for w in (self.inertia, self.stiffness, self.friction))
        return [(1.0, 1.0, 1.0), *product(a, b, c)]


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """Extremes of one joint over an excitation and over every corner of the uncertainty.

    Positions [rad], speeds [rad/s], torques [N m], powers [W] and the current from the bus [A].
    """

    joint: str
    excited: str
    """The excited joint: this one, or a neighbour of it."""
    amplitude: float
    """Peak of the command; 0 for a joint that is only held."""
    lowest: float
    highest: float
    range: tuple[float, float]
    """Mechanical limits."""
    speed: float
    no_load_speed: float
    """Speed at which back-EMF takes the whole bus voltage."""
    torque: float
    """Greatest torque that the controller commands."""
    effort_limit: float
    torque_share: float
    """Greatest share of the torque available at the speed of the moment [1]."""
    mechanical_power: float
    electrical_power: float
    """Greatest power from the bus."""
    bus_current: float

    def breaches(self) -> Iterator[str]:
        """What could be exceeded: what the joint could do, and the limit, in words."""
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
        """The same for a joint that mirrors this one."""
        own = robot.joint(joint)
        sign = own.original[1] * robot.joint(self.joint).original[1]
        ends = sorted((sign * self.lowest, sign * self.highest))
        return replace(self, joint=joint, lowest=ends[0], highest=ends[1], range=own.range)


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
    """Simulate the bench model in every corner of the uncertainty; a forecast a joint of the chain.

    `offsets` of the command about the default pose [rad] have shape (ticks,); `stiffness` and
    `damping` are those of the real drives by joint. PlanError if the simulation diverges.
    """
    spec = bench_spec(robot, joint, stiffness=stiffness, damping=damping)
    spec.option.timestep = timestep_s
    model = spec.compile()
    order = [model.actuator(i).name for i in range(model.nu)]
    pose = np.array([robot.joint(n).default_position for n in order])
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
            gains = strength * stiffness[name], strength * damping[name]
            set_drive_gains(altered, name, robot.joint(name).drive, *gains)
        models.append(altered)
    position, velocity = _roll(models, order, steps)
    if not (np.isfinite(position).all() and np.abs(velocity).max() < 1e4):
        raise PlanError(
            f"{joint}: the simulation of the excitation diverges; its gains "
            f"({stiffness[joint]:g} N m/rad, {damping[joint]:g} N m s/rad) are not stable."
        )
    scale = np.array(corners)[:, 1:2]
    forecasts = []
    for i, name in enumerate(order):
        q, v = position[..., i], velocity[..., i]
        torque = scale * stiffness[name] * (steps[:, i] - q) - scale * damping[name] * v
        drive = robot.joint(name).drive
        low, high = torque_limits(v, drive.stall_torque, drive.no_load_speed, drive.effort_limit)
        # A drive that can give nothing at this speed exceeds its limit with any command.
        available = np.maximum(np.where(torque >= 0.0, high, -low), 1e-6)
        given = np.clip(torque, low, high)
        power = electrical_power(
            given,
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
                mechanical_power=float((given * v).max()),
                electrical_power=float(power.max()),
                bus_current=float((power / drive.bus_voltage).max()),
            )
        )
    return forecasts


def _roll(
    models: Sequence[mujoco.MjModel], order: Sequence[str], steps: Array
) -> tuple[Array, Array]:
    """Positions and velocities at the start of each step, each (models, steps, joints)."""
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
    columns = np.array([model.joint(n).qposadr[0] for n in order])
    rates = np.array([model.joint(n).dofadr[0] for n in order])
    return before[..., 1 + columns], before[..., 1 + model.nq + rates]
