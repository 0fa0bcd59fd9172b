"""Motor and gearbox physics as pure functions that broadcast over arrays, in SI units.

Everything is at the joint (output of the gear) unless a name contains motor. Signs: torque is what
the drive puts on the joint, positive along the joint axis; power and current are positive when
drawn from the bus, negative when the drive brakes hard enough to feed it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array


def voltage_limits(
    speed: ArrayLike, stall_torque: ArrayLike, no_load_speed: ArrayLike
) -> tuple[Array, Array]:
    """Return the least and greatest torque that the bus voltage can drive at a speed [N m].

    `stall_torque (+-1 - speed / no_load_speed)`: bus voltage less back-EMF over the winding.
    """
    ratio = np.divide(speed, no_load_speed)
    lowest = np.multiply(stall_torque, -1.0 - ratio)
    highest = np.multiply(stall_torque, 1.0 - ratio)
    return lowest, highest


def torque_limits(
    speed: ArrayLike, stall_torque: float, no_load_speed: float, effort_limit: float
) -> tuple[Array, Array]:
    """Return the least and greatest torque that a drive can give at a speed [N m].

    Both the torque-speed line and the effort limit are in force.

    Beyond the no-load speed the greatest torque is negative: back-EMF brakes.
    """
    low, high = voltage_limits(speed, stall_torque, no_load_speed)
    lowest = np.clip(low, -effort_limit, effort_limit)
    highest = np.clip(high, -effort_limit, effort_limit)
    return lowest, highest


def winding_loss(
    torque: ArrayLike,
    *,
    gear_ratio: float,
    torque_constant: float,
    stall_torque: float,
    bus_voltage: float,
) -> Array:
    """Return the heat in the winding, `factor R i^2` with `i = torque / (factor gear kt)` [W].

    Factor and resistance enter through the stall torque, `factor gear kt V / resistance`, so the
    loss is `torque^2 V / (gear kt stall_torque)` for three-phase and brushed motors alike.
    """
    return np.asarray(
        np.square(torque) * (bus_voltage / (gear_ratio * torque_constant * stall_torque))
    )


def electrical_power(
    torque: ArrayLike,
    speed: ArrayLike,
    *,
    gear_ratio: float,
    torque_constant: float,
    stall_torque: float,
    bus_voltage: float,
) -> Array:
    """Return the power drawn from the bus: mechanical power and winding loss [W].

    Negative when the drive brakes and the joint gives more than the winding turns to heat. Torque
    is that of the motor, before friction; the constants are those of `winding_loss`. Inverter and
    iron losses are left out.
    """
    loss = winding_loss(
        torque,
        gear_ratio=gear_ratio,
        torque_constant=torque_constant,
        stall_torque=stall_torque,
        bus_voltage=bus_voltage,
    )
    return np.asarray(np.multiply(torque, speed) + loss)
