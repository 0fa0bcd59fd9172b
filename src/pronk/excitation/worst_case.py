"""What a question will do to the robot, computed before anything moves.

The question is put to the bench model with the gains of the real drives, once for every corner of
what is not known of the robot. A plan that exceeds a limit in any corner is refused.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from pronk.actuator.model import bus_current, electrical_power, pd_torque, torque_limits
from pronk.errors import PlanError
from pronk.robots.model import bench_spec, set_drive_gains
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

TIMESTEP_S = 0.001
"""Physics step. The drives run at 40 kHz (paper S4); a test holds that peaks at this step are
within 2 % of those at 0.25 ms, far inside the corners below."""

SETTLE_S = 0.5
"""Rest before the question, in which the leg sags into its pose [s]."""


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """How far the robot may be from its model, in shares of the model's values."""

    inertia: float = 0.2
    """Masses, link inertias and armature. The paper's own gains amount to 3 to 29 % (reading
    A10); Cheetah-Software's rotor is 13 % lighter than the paper's (reading A11)."""
    stiffness: float = 0.1
    """Torque constant and with it both gains. An assumption: no data sheet says."""
    friction: float = 1.0
    """Dry friction: from none to twice the model's."""

    def corners(self) -> list[tuple[float, float, float]]:
        """(inertia, stiffness, friction) factors: the model itself, then the eight corners."""
        sides = [(1.0 - w, 1.0 + w) for w in (self.inertia, self.stiffness, self.friction)]
        return [(1.0, 1.0, 1.0), *(tuple(c) for c in product(*sides))]  # type: ignore[list-item]


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """Extremes of one joint over a question and over every corner of the uncertainty.

    The `nominal_` values are those of the model itself.
    """

    joint: str
    excited: tuple[str, ...] = ()
    """Joints of the question: this one, or neighbours of it."""
    amplitude: float
    """Peak of the command [rad]; 0 for a joint that is only held."""
    lowest: float
    """Least position [rad]."""
    highest: float
    """Greatest position [rad]."""
    range: tuple[float, float]
    """Mechanical limits [rad]."""
    speed: float
    """Greatest speed [rad/s]."""
    no_load_speed: float
    """Speed at which back-EMF takes the whole bus voltage [rad/s]."""
    torque: float
    """Greatest torque that the controller asks for [N m]."""
    effort_limit: float
    """Greatest torque that the drive gives [N m]."""
    torque_share: float
    """Greatest share of the torque available at the speed of the moment [1]."""
    mechanical_power: float
    """Greatest mechanical power [W]."""
    electrical_power: float
    """Greatest power from the bus [W]."""
    bus_current: float
    """Greatest current from the bus [A]."""
    nominal_excursion: float
    """Greatest distance from the pose [rad]."""
    nominal_speed: float
    """[rad/s]"""
    nominal_torque: float
    """[N m]"""

    def breaches(self) -> list[str]:
        """What could be exceeded: what the joint could do, and the limit, in words."""
        low, high = self.range
        found = []
        if self.lowest < low:
            found.append(f"reach {self.lowest:.3f} rad, below its range at {low:.3f} rad")
        if self.highest > high:
            found.append(f"reach {self.highest:.3f} rad, above its range at {high:.3f} rad")
        if self.speed > self.no_load_speed:
            found.append(
                f"turn at {self.speed:.1f} rad/s, above its no-load speed of "
                f"{self.no_load_speed:.1f} rad/s"
            )
        if self.torque_share > 1.0:
            found.append(
                f"need {self.torque_share:.2f} times the torque that its drive gives at the speed "
                f"of the moment (it asks for up to {self.torque:.1f} N m, the limit at standstill "
                f"is {self.effort_limit:.1f} N m)"
            )
        return found

    def mirrored(self, robot: Robot, joint: str, sign: float) -> Forecast:
        """The same for the joint that mirrors this one, `sign` between their coordinates."""
        ends = sorted((sign * self.lowest, sign * self.highest))
        own = robot.joint(joint)
        return replace(self, joint=joint, lowest=ends[0], highest=ends[1], range=own.range)

    def shrink(self, rest: float) -> float:
        """Factor on the amplitude that would bring everything inside, were it all linear.

        Args:
            rest: Position of the joint in its pose [rad].
        """
        low, high = self.range
        if not low < rest < high:
            return 0.0
        shares = [
            (high - rest) / (self.highest - rest) if self.highest > high else 1.0,
            (rest - low) / (rest - self.lowest) if self.lowest < low else 1.0,
            self.no_load_speed / self.speed if self.speed > self.no_load_speed else 1.0,
            1.0 / self.torque_share if self.torque_share > 1.0 else 1.0,
        ]
        return float(np.clip(min(shares), 0.0, 1.0))


def forecast(
    robot: Robot,
    offsets: Mapping[str, Array],
    *,
    rate_hz: float,
    stiffness: Mapping[str, float],
    damping: Mapping[str, float],
    uncertainty: Uncertainty | None = None,
    timestep_s: float = TIMESTEP_S,
) -> dict[str, Forecast]:
    """Ask the bench model, in every corner of the uncertainty.

    Args:
        robot: The robot.
        offsets: Command offsets about the default pose by joint [rad], shape (ticks,), for the
            joints of one chain.
        rate_hz: Rate of the ticks.
        stiffness: Gains of the real drives by joint [N m/rad].
        damping: Gains of the real drives by joint [N m s/rad].
        uncertainty: How far the robot may be from the model.
        timestep_s: Physics step.

    Returns:
        A forecast for every joint of the chain, those that are only held included.

    Raises:
        PlanError: No chain holds all of the joints, or the simulation diverges.
    """
    lead = next((n for n in offsets if set(offsets) <= set(robot.joint(n).chain or (n,))), None)
    if lead is None:
        raise PlanError(
            f"{', '.join(offsets)} cannot be excited together: one is clamped while another moves."
        )
    joint = robot.joint(lead)
    chain = joint.chain or (joint.name,)
    spec = bench_spec(
        robot,
        joint.name,
        stiffness={n: stiffness[n] for n in chain},
        damping={n: damping[n] for n in chain},
    )
    spec.option.timestep = timestep_s
    model = spec.compile()
    order = [model.actuator(i).name for i in range(model.nu)]
    pose = np.array([robot.joint(n).default_position for n in order])
    command = np.tile(pose, (len(next(iter(offsets.values()))), 1))
    for name, values in offsets.items():
        command[:, order.index(name)] += values
    held = np.vstack([np.tile(pose, (round(SETTLE_S * rate_hz), 1)), command])
    steps = np.repeat(held, round(1.0 / (rate_hz * timestep_s)), axis=0)
    corners = (uncertainty or Uncertainty()).corners()
    gains = [(np.array([stiffness[n] for n in order]), np.array([damping[n] for n in order]))]
    models = [_altered(model, robot, order, gains[0], corner) for corner in corners]
    position, velocity = _roll(models, order, steps)
    if not (np.isfinite(position).all() and np.abs(velocity).max() < 1e4):
        raise PlanError(
            f"{lead}: the simulation of the excitation diverges; its gains "
            f"({stiffness[lead]:g} N m/rad, {damping[lead]:g} N m s/rad) are not stable."
        )
    forecasts = {}
    for i, name in enumerate(order):
        scale = np.array([corner[1] for corner in corners])[:, None]
        torque = pd_torque(
            steps[:, i],
            position[..., i],
            velocity[..., i],
            stiffness=scale * stiffness[name],
            damping=scale * damping[name],
        )
        amplitude = float(np.abs(offsets[name]).max()) if name in offsets else 0.0
        forecasts[name] = _extremes(
            robot, name, amplitude, position[..., i], velocity[..., i], torque
        )
    return forecasts


def _altered(
    model: mujoco.MjModel,
    robot: Robot,
    order: Sequence[str],
    gains: tuple[Array, Array],
    corner: tuple[float, float, float],
) -> mujoco.MjModel:
    """A copy of the model in one corner of the uncertainty."""
    inertia, torque, friction = corner
    altered = copy(model)
    altered.body_mass[:] *= inertia
    altered.body_inertia[:] *= inertia
    altered.dof_armature[:] *= inertia
    altered.dof_frictionloss[:] *= friction
    mujoco.mj_setConst(altered, mujoco.MjData(altered))
    for name, kp, kd in zip(order, *gains, strict=True):
        drive = robot.joint(name).drive
        set_drive_gains(altered, name, drive, float(torque * kp), float(torque * kd))
    return altered


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
    batch = len(models)
    threads = os.cpu_count() or 1
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        states, _ = pool.rollout(
            list(models),
            [mujoco.MjData(model) for _ in range(threads)],
            np.tile(initial, (batch, 1)),
            np.broadcast_to(steps, (batch, *steps.shape)),
        )
    before = np.concatenate([np.tile(initial, (batch, 1, 1)), states[:, :-1]], axis=1)
    # Full physics begins with time, then qpos, then qvel (mjtState); a bench has hinges only.
    columns = np.array([model.joint(n).qposadr[0] for n in order])
    rates = np.array([model.joint(n).dofadr[0] for n in order])
    return before[..., 1 + columns], before[..., 1 + model.nq + rates]


def _extremes(
    robot: Robot, name: str, amplitude: float, position: Array, velocity: Array, torque: Array
) -> Forecast:
    """Extremes over time and corners; the first row is the model itself. Shapes (corners, n)."""
    joint = robot.joint(name)
    drive = joint.drive
    low, high = torque_limits(velocity, drive.stall_torque, drive.no_load_speed, drive.effort_limit)
    # A drive that can give nothing at this speed exceeds its limit with any command.
    room = np.maximum(np.where(torque >= 0.0, high, -low), 1e-6)
    given = np.clip(torque, low, high)
    power = electrical_power(
        given,
        velocity,
        gear_ratio=drive.gear_ratio,
        torque_constant=drive.torque_constant,
        stall_torque=drive.stall_torque,
        bus_voltage=drive.bus_voltage,
    )
    return Forecast(
        joint=name,
        amplitude=amplitude,
        lowest=float(position.min()),
        highest=float(position.max()),
        range=joint.range,
        speed=float(np.abs(velocity).max()),
        no_load_speed=drive.no_load_speed,
        torque=float(np.abs(torque).max()),
        effort_limit=drive.effort_limit,
        torque_share=float((np.abs(torque) / room).max()),
        mechanical_power=float((given * velocity).max()),
        electrical_power=float(power.max()),
        bus_current=float(bus_current(power, drive.bus_voltage).max()),
        nominal_excursion=float(np.abs(position[0] - joint.default_position).max()),
        nominal_speed=float(np.abs(velocity[0]).max()),
        nominal_torque=float(np.abs(torque[0]).max()),
    )
