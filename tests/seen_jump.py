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
"""Time between two samples [s]."""
G = 9.81
"""Acceleration of free fall [m/s^2]."""
STANDING = 0.30
"""Height of the standing trunk [m]."""
CROUCH = 0.08
"""Depth of the crouch after the jump input [m]."""
SINK = 0.10
"""How far the trunk sinks after touchdown [m]."""
DELAY = 0.2
"""Time from the jump input to lift-off [s]."""
Z_OFF = 0.35
"""Height of the trunk at lift-off and touchdown [m]."""
FEET = np.array([[0.21, -0.11], [0.21, 0.11], [-0.21, -0.11], [-0.21, 0.11]])
"""Places of the feet below the trunk, forward and left [m]."""
TUCKED = 0.12
"""How far feet are pulled up below the trunk in flight, at most [m]."""
SCRIPT = Script(command=(1.0, 0.0, 0.0), stand_s=1.0, run_s=2.0, stop_s=3.0)


def motion(time: np.ndarray, **arrays: Any) -> Capture:
    """A capture of a robot that stands at the origin, but for some arrays."""
    count = len(time)
    standing: dict[str, Any] = {
        "position": np.tile([0.0, 0.0, STANDING], (count, 1)),
        "orientation": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "velocity": np.zeros((count, 3)),
        "angular_velocity": np.zeros((count, 3)),
        "foot_position": np.zeros((count, 4, 3)),
        "contact": np.ones((count, 4), dtype=bool),
        "other_contact": np.zeros(count, dtype=bool),
        "other_parts": np.full(count, ""),
        "joint_position": np.zeros((count, 12)),
        "joint_velocity": np.zeros((count, 12)),
        "torque": np.zeros((count, 12)),
        "electrical_power": np.full(count, 100.0),
        "bus_voltage": np.full(count, 24.0),
    }
    return Capture(time=time, **(standing | arrays))


def seen_jump(*, up: float = 2.0, speed: float = 1.0, yaw: float = 0.0) -> Capture:
    """The jump of the module, with a lift-off velocity `up` [m/s] and a heading `yaw` [rad].

    The flight must last whole milliseconds; `speed` is along the heading until touchdown [m/s].
    """
    time = np.arange(8001) * DT
    lift_off = SCRIPT.on + DELAY
    touchdown = lift_off + round(2.0 * up / G, 3)
    in_flight = time - lift_off
    is_flying = (time >= lift_off - 1e-9) & (time < touchdown - 1e-9)
    height = np.interp(
        time,
        [
            0.0,
            SCRIPT.on,
            SCRIPT.on + 0.1,
            lift_off,
            touchdown,
            touchdown + 0.1,
            touchdown + 0.5,
            8.0,
        ],
        [STANDING, STANDING, STANDING - CROUCH, Z_OFF, Z_OFF, Z_OFF - SINK, STANDING, STANDING],
    )
    height[is_flying] = (Z_OFF + up * in_flight - 0.5 * G * in_flight**2)[is_flying]
    travelled = speed * (np.clip(time, SCRIPT.start, touchdown) - SCRIPT.start)
    forward_axis = np.array([np.cos(yaw), np.sin(yaw)])
    side_axis = np.array([-np.sin(yaw), np.cos(yaw)])
    vertical = np.where(is_flying, up - G * in_flight, 0.0)
    is_running = (time >= SCRIPT.start) & (time < touchdown)
    horizontal = np.where(is_running, speed, 0.0)[:, None] * forward_axis
    # Feet stand under the hips as the trunk passes: their place is that of the trunk at all times.
    foot_place = FEET[:, :1] * forward_axis + FEET[:, 1:] * side_axis
    foot_place = travelled[:, None, None] * forward_axis + foot_place
    share_flown = np.clip(in_flight / (touchdown - lift_off), 0.0, 1.0)
    tuck = np.where(is_flying, TUCKED * np.sin(np.pi * share_flown), 0.0)
    foot_height = BODY.foot_radius + np.maximum(0.0, height - Z_OFF) * is_flying + tuck
    foot_heights = np.repeat(foot_height[:, None], 4, axis=1)
    return motion(
        time,
        position=np.column_stack([travelled[:, None] * forward_axis, height]),
        orientation=np.tile([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], (len(time), 1)),
        velocity=np.column_stack([horizontal, vertical]),
        foot_position=np.concatenate([foot_place, foot_heights[:, :, None]], axis=2),
        contact=np.repeat(~is_flying[:, None], 4, axis=1),
    )


def changed(capture: Capture, name: str, samples: Any, value: Any) -> Capture:
    """The same with some samples of one array set to a value."""
    array = getattr(capture, name).copy()
    array[samples] = value
    return replace(capture, **{name: array})
