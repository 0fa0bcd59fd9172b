"""Supervision of the sensors: whether the states of a robot can all be true.

`Supervision` takes states one after another; what it finds depends on them and the commands alone.

Each source is judged by itself, because the noise of one hides that another has stopped:

- The inertial unit's attitude, gyro and accelerometer never repeat to the last bit for long.
- Attitude against gyro: over 60 ms, the rotation of the attitude less the integral of the rate.
  An attitude that is stuck moves far less in all than the rate says, even if it is not constant.
- Attitude against accelerometer: the specific force in the world's frame, averaged over a second,
  points up. Legs accelerate the trunk, but never for as long.
- Position against velocity of a joint: over 60 ms, the change of the one less the integral of
  the other. A step is found in the state in which it occurs.
- A position that does not change in one bit has no velocity, and the reverse; least of all where
  no joint's does.
- A joint of which neither changes in one bit does not feel a load that changes, nor, on a robot
  that is free to move, the motion of the other joints.

Times between states are the robot's own where it sends them, else of arrival. Where the number of
states and their time of arrival differ, as in a burst after a pause, an integral is as uncertain as
the product of that difference and the speed. Between two states of which some in between were lost
it is as uncertain as half the change of the speed times the time.

`python -m benchmarks supervision` measures what the limits rest on.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from pronk.arrays import Array
from pronk.robots.machine import State

WINDOW_S = 0.06
"""Over which attitude and position are compared with their rates [s]."""
SPEED_STEP = 0.016
"""Largest constant velocity of a joint at rest: the Mini Cheetah's drives send 12 bits over 130
rad/s, of which none is zero [rad/s]."""
AVERAGE_S = 1.0
"""Time constant of the mean specific force [s]."""
_LONGEST_S = 0.05
"""Between two states; after a longer one the comparison begins anew [s]."""
_GRAVITY = 9.81
_IMU = ("orientation", "gyro", "accelerometer")


class Supervision:
    """What the states so far say about each other."""

    def __init__(self, joints: int, state_rate_hz: float = 500.0) -> None:
        """Begin without a state; `joints` of the robot, and its states per second."""
        self._period = 1.0 / state_rate_hz
        self._states = max(2, round(WINDOW_S * state_rate_hz))
        self.repeated = dict.fromkeys(_IMU, 0.0)
        """Time for which each source of the inertial unit has not changed in one bit [s]."""
        self.attitude = 0.0
        """Attitude less integral of the gyro, beyond the uncertainty of the integral [rad]."""
        self.paths = (0.0, 0.0)
        """Length of the path of the attitude, and of the integral of the gyro less its uncertainty
        [rad]."""
        self.force = (0.0, 0.0, _GRAVITY)
        """Mean specific force in the world's frame [m/s^2]."""
        self.encoder = np.zeros(joints)
        """Position less integral of velocity, beyond its uncertainty [rad]."""
        self.constant_s = np.zeros(2 * joints)
        """Time for which each position, then each velocity has not changed in one bit [s]."""
        self.moved = np.zeros(2 * joints)
        """Meanwhile: range of the integral of the velocity, then of the position, beyond their
        uncertainty [rad]."""
        self.load = np.zeros(joints)
        """Change of the commanded torque while neither has changed in one bit [N m]."""
        self.others = np.zeros(joints)
        """Meanwhile: sum of the displacements of the other joints [rad]."""
        self.live = np.zeros(joints, dtype=np.bool_)
        """Whether position or velocity of a joint has ever changed."""
        self._joints = joints
        self._before: State | None = None
        self._late = self._spread = 0.0
        self._loads = np.zeros(joints)

    @property
    def lean(self) -> float:
        """Angle between the mean specific force and the attitude's vertical [rad]."""
        x, y, z = self.force
        return math.atan2(math.hypot(x, y), z)

    def begin(self) -> None:
        """Begin anew with the next state."""
        self._before = None

    def command(self, torque: Array) -> None:
        """Note the part of the commanded torque that depends on the target, `kp target` [N m]."""
        self._loads = torque

    def observe(self, state: State) -> None:
        """Take the next state; one that is not newer than the last has no effect."""
        before = self._before
        if before is not None and state.sequence == before.sequence and state.time <= before.time:
            return
        seconds = math.nan if before is None else _clock(state) - _clock(before)
        self._before = state
        if before is None or not 0.0 < seconds <= _LONGEST_S:
            self._restart(state)
            return
        self._late += seconds - self._period * (state.sequence - before.sequence)
        self._lates.append(self._late)
        self._spread = max(self._lates) - min(self._lates)
        self._observe_trunk(before, state, seconds)
        self._observe_joints(before, state, seconds)

    def _restart(self, state: State) -> None:
        n = self._joints
        self._late = self._spread = 0.0
        self._lates: deque[float] = deque([0.0], maxlen=self._states + 1)
        self._rates: deque[float] = deque(maxlen=self._states)
        self._gone: deque[tuple[float, float]] = deque([(0.0,) * 2], maxlen=self._states + 1)
        self._turns: deque[tuple[float, float, float]] = deque(
            [(0.0, 0.0, 0.0)], maxlen=self._states
        )
        self._drifts, self._speeds = np.zeros((2, self._states, n))
        self._row = 0
        self.repeated = dict.fromkeys(_IMU, 0.0)
        self.attitude, self.paths, self.force = 0.0, (0.0, 0.0), (0.0, 0.0, _GRAVITY)
        self.encoder = np.zeros(n)
        self._travel = np.zeros(n)
        self._lowest = self._highest = np.concatenate((self._travel, state.position))
        self.constant_s, self.moved = np.zeros(2 * n), np.zeros(2 * n)
        self._least = self._most = self._loads
        self.load, self.others = np.zeros((2, n))
        self._origins = np.tile(state.position, (n, 1))

    def _observe_trunk(self, before: State, state: State, seconds: float) -> None:
        for name, since in self.repeated.items():
            same = getattr(state, name).tobytes() == getattr(before, name).tobytes()
            self.repeated[name] = since + seconds if same else 0.0
        # Plain numbers: arrays of three cost more than their arithmetic.
        a, b = before.orientation.tolist(), state.orientation.tolist()
        x, y, z = (0.5 * (before.gyro + state.gyro)).tolist()
        (i, j, k), (dx, dy, dz) = self._turns[-1], _turn(a, b)
        total = (i + dx - x * seconds, j + dy - y * seconds, k + dz - z * seconds)
        rate = math.hypot(x, y, z)
        self._rates.append(rate)
        unsure = max(self._rates) * self._spread
        self.attitude = math.dist(total, self._turns[0]) - unsure
        gone, turned = self._gone[-1]
        self._gone.append((gone + math.hypot(dx, dy, dz), turned + rate * seconds))
        gone, turned = (
            last - first for last, first in zip(self._gone[-1], self._gone[0], strict=True)
        )
        self.paths = gone, turned - unsure
        self._turns.append(total)
        share = min(seconds / AVERAGE_S, 1.0)
        (p, q, r), (fx, fy, fz) = self.force, _to_world(b, state.accelerometer.tolist())
        self.force = (p + share * (fx - p), q + share * (fy - q), r + share * (fz - r))

    def _observe_joints(self, before: State, state: State, seconds: float) -> None:
        n, q, v = self._joints, state.position, state.velocity
        path = (0.5 * seconds) * (before.velocity + v)
        self._travel = self._travel + path
        last = self._drifts[self._row]
        self._row = (self._row + 1) % self._states
        oldest = self._drifts[self._row].copy()
        step = q - before.position - path
        if seconds > 1.5 * self._period:
            slack = (0.5 * seconds) * np.abs(v - before.velocity)
            step = step - np.clip(step, -slack, slack)
        self._drifts[self._row] = drift = last + step
        self._speeds[self._row] = np.abs(v)
        unsure = self._speeds.max(axis=0) * self._spread
        self.encoder = np.abs(drift - oldest) - unsure
        # A position is compared with the integral of the velocity, a velocity with the position.
        other = np.concatenate((self._travel, q))
        changed = np.concatenate((q != before.position, v != before.velocity))
        self.constant_s = np.where(changed, 0.0, self.constant_s + seconds)
        self._lowest = np.where(changed, other, np.minimum(self._lowest, other))
        self._highest = np.where(changed, other, np.maximum(self._highest, other))
        both = np.minimum(self.constant_s[:n], self.constant_s[n:])
        offset = np.concatenate((SPEED_STEP * both, np.zeros(n)))
        self.moved = self._highest - self._lowest - np.concatenate((unsure, unsure)) - offset
        live, loads = changed[:n] | changed[n:], self._loads
        self.live |= live
        self._least = np.where(live, loads, np.minimum(self._least, loads))
        self._most = np.where(live, loads, np.maximum(self._most, loads))
        self.load = self._most - self._least
        self._origins[live] = q
        self.others = np.abs(q - self._origins).sum(axis=1)


def _clock(state: State) -> float:
    """The robot's own time of a state, or that of its arrival [s]."""
    return state.time if state.robot_time is None else state.robot_time


def _turn(a: list[float], b: list[float]) -> tuple[float, float, float]:
    """Rotation from one attitude to another in the trunk's frame; small angles [rad]."""
    (w, x, y, z), (p, q, r, s) = a, b
    twice = 2.0 if w * p + x * q + y * r + z * s >= 0.0 else -2.0
    return (
        twice * (w * q - x * p - y * s + z * r),
        twice * (w * r - y * p - z * q + x * s),
        twice * (w * s - z * p - x * r + y * q),
    )


def _to_world(attitude: list[float], v: list[float]) -> tuple[float, float, float]:
    """A vector of the trunk's frame in the world's, R v."""
    (w, x, y, z), (a, b, c) = attitude, v
    i, j, k = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * i + y * k - z * j,
        b + w * j + z * i - x * k,
        c + w * k + x * j - y * i,
    )
