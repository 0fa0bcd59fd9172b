"""A jump as cameras would record it; all of its figures are known in closed form.

Time runs in steps of 1 ms for 8 s. The trunk stands at `STANDING`, runs along x at `speed` from
`start` on, drops by `CROUCH` within 0.1 s of the jump input, rises evenly to `z_off` and lifts off
at `on + DELAY` with `up` m/s, flies on a parabola, touches down where the parabola comes back to
`z_off`, sinks by `SINK` and is back at `STANDING` half a second later.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pronk.jump.virtual.capture import Capture
from pronk.policy.script import Script
from pronk.robots.legged import legged

BODY = legged("mini_cheetah")

DT = 1e-3
G = 9.81
STANDING = 0.30
CROUCH = 0.08
SINK = 0.10
DELAY = 0.2
Z_OFF = 0.35
FEET = np.array([[0.21, -0.11], [0.21, 0.11], [-0.21, -0.11], [-0.21, 0.11]])
TUCKED = 0.12
"""How far feet are pulled up below the trunk in flight, at most [m]."""
SCRIPT = Script(command=(1.0, 0.0, 0.0), stand_s=1.0, run_s=2.0, stop_s=3.0)


def motion(time: np.ndarray, **arrays: Any) -> Capture:
    """A capture of a robot that stands at the origin, but for the given arrays."""
    count = len(time)
    kept: dict[str, Any] = {
        "position": np.tile([0.0, 0.0, STANDING], (count, 1)),
        "orientation": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "velocity": np.zeros((count, 3)),
        "angular_velocity": np.zeros((count, 3)),
        "foot_position": np.zeros((count, 4, 3)),
        "contact": np.ones((count, 4), dtype=bool),
        "other_contact": np.zeros(count, dtype=bool),
        **dict.fromkeys(("joint_position", "joint_velocity", "torque"), np.zeros((count, 12))),
        "electrical_power": np.full(count, 100.0),
        "bus_voltage": np.full(count, 24.0),
    }
    return Capture(time=time, **(kept | arrays))


def seen_jump(*, up: float = 2.0, speed: float = 1.0, yaw: float = 0.0) -> Capture:
    """The jump of the module, with a lift-off velocity `up` [m/s] and a heading `yaw` [rad].

    The flight must last whole milliseconds; `speed` is along the heading until touchdown [m/s].
    """
    time = np.arange(8001) * DT
    off = SCRIPT.on + DELAY
    down = off + round(2.0 * up / G, 3)
    flight = time - off
    z = np.interp(
        time,
        [0.0, SCRIPT.on, SCRIPT.on + 0.1, off, down, down + 0.1, down + 0.5, 8.0],
        [STANDING, STANDING, STANDING - CROUCH, Z_OFF, Z_OFF, Z_OFF - SINK, STANDING, STANDING],
    )
    flying = (time >= off - 1e-9) & (time < down - 1e-9)
    z[flying] = (Z_OFF + up * flight - 0.5 * G * flight**2)[flying]
    x = speed * (np.clip(time, SCRIPT.start, down) - SCRIPT.start)
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-ahead[1], ahead[0]])
    vz = np.where(flying, up - G * flight, 0.0)
    moving = (time >= SCRIPT.start) & (time < down)
    # Feet stand under the hips as the trunk passes: their place is that of the trunk at all times.
    plane = x[:, None, None] * ahead + FEET[:, :1] * ahead + FEET[:, 1:] * left
    lift = np.where(flying, np.sin(np.pi * np.clip(flight / (down - off), 0.0, 1.0)), 0.0)
    low = np.maximum(0.0, z - Z_OFF) * flying + TUCKED * lift
    foot_z = np.repeat((BODY.foot_radius + low)[:, None], 4, axis=1)
    return motion(
        time,
        position=np.column_stack([x[:, None] * ahead, z]),
        orientation=np.tile([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], (len(time), 1)),
        velocity=np.column_stack([np.where(moving, speed, 0.0)[:, None] * ahead, vz]),
        foot_position=np.concatenate([plane, foot_z[:, :, None]], axis=2),
        contact=np.repeat(~flying[:, None], 4, axis=1),
    )


def changed(capture: Capture, name: str, where: Any, value: Any) -> Capture:
    """The same with some samples of one array set to a value."""
    array = getattr(capture, name).copy()
    array[where] = value
    return replace(capture, **{name: array})
