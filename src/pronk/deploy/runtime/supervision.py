"""Supervision of the sensors: whether the states of a robot can all be true.

`SensorHistory` takes states one after another and keeps the quantities that the rules compare. Each
source is judged by itself, because the noise of one hides that another has stopped. The rules are
functions at the end of this module, in the order in which they are applied; each says what it
compares, its limit (`SensorLimits`) and its false alarms.

False alarms were counted over 10.02 h of walking, running and 8,665 jumps of the virtual Mini
Cheetah with ten parameter sets, a third of it with 30 % of the states lost (seed 2): none of any
rule. "Largest" is the largest value of the quantity in that time. `python -m benchmarks
supervision` repeats the measurement.

Times between states are those of their arrival. The robot's own clock times nothing here; it is
compared with arrival (`clocks.ClockComparison`). Where the number of states and their time of
arrival differ, as in a burst after a pause, an integral is as uncertain as the product of that
difference and the speed. Between two states of which some in between were lost it is as uncertain
as half the change of the speed times the time, and what the largest acceleration adds to it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from pronk.arrays import Array, Mask
from pronk.deploy.runtime.clocks import ClockComparison
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.reasons import Decision, Reason
from pronk.robots.machine import State

WINDOW_S = 0.06
"""Time over which attitude and position are compared with their rates [s]."""
DRIFT_S = 0.5
"""Time over which a slow drift of a position against its velocity is summed [s]."""
ON_TIME_SHARE = 0.25
"""Largest deviation of the time between two states that arrived on time, in periods."""
PERIOD_AVERAGE_S = 5.0
"""Time constant of the mean time between states [s]. Times of arrival over DDS to a busy computer
are off by up to a quarter of a period for half a second on end, all to one side: joints at 17 to 20
rad/s seemed to drift by 0.038 rad, and by 0.007 with such a mean."""
SLOW_STATES = 5
"""States from one comparison of the slow drift to the next."""
SPEED_STEP = 0.016
"""Largest constant velocity of a joint at rest: the Mini Cheetah's drives send 12 bits over 130
rad/s, of which none is zero [rad/s]."""
AVERAGE_S = 1.0
"""Time constant of the mean specific force [s]."""
LONGEST_GAP_S = 0.05
"""Longest time between two states; after a longer one the comparison begins anew [s]."""
LONGEST_STEP = 5.0
"""Periods that count, for each state by its number, towards the time for which a source repeats: a
pause in which nothing arrived does not show that a source has stopped."""
VOLTAGE_S = 0.08
"""Time within which the largest bus voltage counts [s]: twice the longest that a take-off of the
virtual robot pulls it below 0.6 of the nominal, 38 ms."""
LARGEST_ACCELERATION = 2500.0
"""Acceleration of a joint that may have gone unseen where states were lost [rad/s^2]: landings of
the virtual Mini Cheetah reach 2,570 over 24 ms, 2,480 over 16 ms."""
LARGEST_TRUNK_ACCELERATION = 250.0
"""The same of the trunk [rad/s^2]: 210 over 48 ms."""
LONGEST_SAME = 5.0
"""Periods that count, between two states, towards the time for which a joint is constant: two
speeds are the same step of a coarse encoder by chance, and what was lost is not known."""
_GRAVITY = 9.81
_IMU_SOURCES = ("orientation", "gyro", "accelerometer")
_ALL_CONSTANT_SHARE = 0.5
"""Share of `JointLimits.felt` that is enough where all joints are constant."""

Vector = tuple[float, float, float]


class SensorHistory:
    """What the states so far say about each other."""

    def __init__(self, joints: int, state_rate_hz: float = 500.0) -> None:
        """Begin without a state; `joints` of the robot, and its states per second."""
        self._joints = joints
        self._period = 1.0 / state_rate_hz
        self._window = max(2, round(WINDOW_S * state_rate_hz))
        self.live = np.zeros(joints, dtype=np.bool_)
        """Whether position or velocity of a joint has ever changed."""
        self.clock = ClockComparison()
        """The robot's own clock against the times of arrival."""
        self.restarts = 0
        """Restarts of the comparison since states were last compared for `WINDOW_S` without one."""
        self._undisturbed_s = 0.0
        self._mean_period = self._period
        """Recent mean of the time from one state to the next, lost ones counted [s]."""
        self._drift_window = max(2, round(DRIFT_S * state_rate_hz / SLOW_STATES))
        self._voltages: deque[float] = deque(maxlen=max(1, round(VOLTAGE_S * state_rate_hz)))
        self._newest: State | None = None
        self._command_torque = np.zeros(joints)
        self._reset(np.zeros(joints))

    def _reset(self, position: Array) -> None:
        """Set all quantities to those of a first state at joint positions [rad]."""
        n = self._joints
        window = self._window
        # Of the trunk.
        self.repeated = dict.fromkeys(_IMU_SOURCES, 0.0)
        """Time for which each source of the inertial unit has not changed in one bit [s]."""
        self.attitude = 0.0
        """Attitude less integral of the gyro, beyond the uncertainty of the integral [rad]."""
        self.paths = (0.0, 0.0)
        """Length of the path of the attitude, and of the integral of the gyro less its uncertainty
        [rad]."""
        self.force: Vector = (0.0, 0.0, _GRAVITY)
        """Mean specific force in the world's frame [m/s^2]."""
        # Of each joint.
        self.encoder = np.zeros(n)
        """Position less integral of velocity, beyond its uncertainty [rad], (n,)."""
        self.slow_drift = np.zeros(n)
        """The same over `DRIFT_S`, of states that arrived on time alone [rad], (n,)."""
        self.constant_s = np.zeros(2 * n)
        """Time for which each position, then each velocity has not changed in one bit [s], (2n,):
        entry i is the position of joint i, entry n + i its velocity."""
        self.moved = np.zeros(2 * n)
        """Motion that contradicts the constant, beyond its uncertainty [rad], (2n,): entry i is the
        range of the integral of the velocity of joint i while its position is constant, entry n + i
        the range of its position while its velocity is constant."""
        self.load = np.zeros(n)
        """Change of the commanded torque while neither position nor velocity of a joint has changed
        in one bit [N m], (n,)."""
        self.others = np.zeros(n)
        """Meanwhile: sum of the displacements of the other joints [rad], (n,)."""
        # Lateness of the states against their number, and its spread over the window [s].
        self._late = 0.0
        self._late_spread = 0.0
        self._late_window: deque[float] = deque([0.0], maxlen=window + 1)
        # Speed of the trunk, paths of attitude and gyro, and attitude less gyro over the window.
        self._trunk_speeds: deque[float] = deque(maxlen=window)
        self._trunk_paths: deque[tuple[float, float]] = deque([(0.0, 0.0)], maxlen=window + 1)
        self._trunk_drifts: deque[Vector] = deque([(0.0, 0.0, 0.0)], maxlen=window)
        # Position less integral of velocity, and speed, of the joints over the window, in a circle.
        self._joint_drifts = np.zeros((window, n))
        self._joint_speeds = np.zeros((window, n))
        self._row = 0
        # The same over the longer window, and the largest speeds within it and the one before.
        self._slow_drift = np.zeros(n)
        self._slow_drifts = np.zeros((self._drift_window, n))
        self._slow_speeds = np.zeros((2, n))
        self._slow_row = 0
        self._slow_count = 0
        # Integral of the velocity, and the range of it and of the position while constant.
        self._travel = np.zeros(n)
        self._lowest = np.concatenate((self._travel, position))
        self._highest = self._lowest
        # Range of the commanded torque, and positions of all joints, while a joint is constant.
        self._least_torque = self._command_torque
        self._largest_torque = self._command_torque
        self._origins = np.tile(position, (n, 1))

    @property
    def lean(self) -> float:
        """Angle between the mean specific force and the attitude's vertical [rad]."""
        x, y, z = self.force
        return math.atan2(math.hypot(x, y), z)

    @property
    def newest(self) -> State | None:
        """The newest state since the last damping; None without one."""
        return self._newest

    @property
    def voltage(self) -> float:
        """Largest bus voltage of the last `VOLTAGE_S` [V]; NaN before, and where there is none."""
        voltages = self._voltages
        return max(voltages) if len(voltages) == voltages.maxlen else math.nan

    def begin(self) -> None:
        """Begin anew with the next state."""
        self._newest = None
        self.restarts = 0
        self._undisturbed_s = 0.0
        self._voltages.clear()
        self.clock.begin()

    def command(self, torque: Array) -> None:
        """Note the part of the commanded torque that depends on the target, `kp target` [N m]."""
        self._command_torque = torque

    def observe(self, state: State) -> None:
        """Take the next state; one that is not newer than the last has no effect."""
        before = self._newest
        if before is None:
            self._newest = state
            self._reset(state.position)
            return
        if state.sequence <= before.sequence and state.time <= before.time:
            return
        self._newest = state
        seconds = state.time - before.time
        if not 0.0 <= seconds <= LONGEST_GAP_S:
            self.restarts += 1
            self._undisturbed_s = 0.0
            self._reset(state.position)
            self.clock.begin()
            return
        self._undisturbed_s += seconds
        if self._undisturbed_s > WINDOW_S:
            self.restarts = 0
        self.clock.observe(state.time, state.robot_time)
        self._voltages.append(state.bus_voltage)
        states = state.sequence - before.sequence
        self._late += seconds - self._period * states
        self._late_window.append(self._late)
        self._late_spread = max(self._late_window) - min(self._late_window)
        if states > 0:
            # A count that jumps by far more than was lost would spoil the mean for seconds.
            excess_s = max(seconds - states * self._mean_period, -LONGEST_GAP_S)
            self._mean_period += self._period / PERIOD_AVERAGE_S * excess_s
        self._observe_trunk(before, state, seconds)
        self._observe_joints(before, state, seconds)

    def _observe_trunk(self, before: State, state: State, seconds: float) -> None:
        """Update the quantities of the trunk between two states."""
        states = max(1, state.sequence - before.sequence)
        counted_s = min(seconds, LONGEST_STEP * self._period * states)
        for name, constant_s in self.repeated.items():
            same = getattr(state, name).tobytes() == getattr(before, name).tobytes()
            self.repeated[name] = constant_s + counted_s if same else 0.0
        # Plain numbers: arrays of three cost more than their arithmetic.
        attitude = state.orientation.tolist()
        rate_x, rate_y, rate_z = (0.5 * (before.gyro + state.gyro)).tolist()
        turn_x, turn_y, turn_z = _small_rotation(before.orientation.tolist(), attitude)
        drift_x, drift_y, drift_z = self._trunk_drifts[-1]
        step_x = turn_x - rate_x * seconds
        step_y = turn_y - rate_y * seconds
        step_z = turn_z - rate_z * seconds
        share = 1.0
        if seconds > 1.5 * self._period:
            change = math.dist(before.gyro.tolist(), state.gyro.tolist())
            slack = 0.5 * seconds * change + 0.25 * LARGEST_TRUNK_ACCELERATION * seconds**2
            share -= min(slack / max(math.hypot(step_x, step_y, step_z), 1e-12), 1.0)
        drift = (
            drift_x + share * step_x,
            drift_y + share * step_y,
            drift_z + share * step_z,
        )
        speed = math.hypot(rate_x, rate_y, rate_z)
        self._trunk_speeds.append(speed)
        uncertainty = max(self._trunk_speeds) * self._late_spread
        self.attitude = math.dist(drift, self._trunk_drifts[0]) - uncertainty
        self._trunk_drifts.append(drift)

        attitude_path, gyro_path = self._trunk_paths[-1]
        self._trunk_paths.append(
            (
                attitude_path + math.hypot(turn_x, turn_y, turn_z),
                gyro_path + speed * seconds,
            )
        )
        newest_path, newest_gyro_path = self._trunk_paths[-1]
        oldest_path, oldest_gyro_path = self._trunk_paths[0]
        self.paths = (
            newest_path - oldest_path,
            newest_gyro_path - oldest_gyro_path - uncertainty,
        )

        weight = min(seconds / AVERAGE_S, 1.0)
        force_x, force_y, force_z = _to_world(attitude, state.accelerometer.tolist())
        # The filter refuses such a state; a mean that took one in would never be a number again.
        if math.isfinite(force_x + force_y + force_z):
            mean_x, mean_y, mean_z = self.force
            self.force = (
                mean_x + weight * (force_x - mean_x),
                mean_y + weight * (force_y - mean_y),
                mean_z + weight * (force_z - mean_z),
            )

    def _observe_joints(self, before: State, state: State, seconds: float) -> None:
        """Update the quantities of the joints between two states.

        `path` (n,) is the integral of the velocity from one state to the next, by the trapezium
        rule; `_travel` (n,) its sum. `uncertainty` (n,), not negative, is that of an integral over
        the window: the fastest speed within it times the spread of the states' lateness. Then

            encoder = |sum over the window of (change of position - path)| - uncertainty

        where each term is reduced in size if states in between were lost, by at most half the
        change of speed times the time and `LARGEST_ACCELERATION time^2 / 4`: so far a joint moves
        beyond the trapezium that speeds up and slows down again unseen. `slow_drift` is the same
        over a longer window, of the steps between states that arrived on time, each as long as the
        mean period; its uncertainty is that of one such time. In arrays of 2n entries, entry i
        belongs to the position of joint i and entry n + i to its velocity. `compared` is
        (`_travel`, position): what should not move while the position, or the velocity, is
        constant. `_lowest` and `_highest` are its
        range since that quantity changed last. Then

            moved = _highest - _lowest - uncertainties - offset

        where `uncertainties` is `uncertainty` twice, and `offset` is `SPEED_STEP` times the time
        for which both are constant in the first n entries (a joint at rest may show so much
        velocity), 0 in the others. `moved` is negative where the motion is within the uncertainty.
        """
        n = self._joints
        position = state.position
        velocity = state.velocity
        path = (0.5 * seconds) * (before.velocity + velocity)
        self._travel = self._travel + path

        newest_drift = self._joint_drifts[self._row]
        self._row = (self._row + 1) % self._window
        oldest_drift = self._joint_drifts[self._row].copy()
        step = position - before.position - path
        if seconds > 1.5 * self._period:
            slack = (0.5 * seconds) * np.abs(velocity - before.velocity)
            slack += 0.25 * LARGEST_ACCELERATION * seconds**2
            step = step - np.clip(step, -slack, slack)
        drift = newest_drift + step
        self._joint_drifts[self._row] = drift
        self._joint_speeds[self._row] = np.abs(velocity)
        uncertainty = self._joint_speeds.max(axis=0) * self._late_spread
        self.encoder = np.abs(drift - oldest_drift) - uncertainty

        late = abs(seconds - self._period)
        if state.sequence - before.sequence == 1 and late < ON_TIME_SHARE * self._period:
            slow_path = (0.5 * self._mean_period) * (before.velocity + velocity)
            self._slow_drift = self._slow_drift + position - before.position - slow_path
        self._slow_count += 1
        if self._slow_count % SLOW_STATES == 0:
            self._compare_slow_drift(self._joint_speeds.max(axis=0))

        # A position is compared with the integral of the velocity, a velocity with the position.
        compared = np.concatenate((self._travel, position))
        changed = np.concatenate((position != before.position, velocity != before.velocity))
        counted_s = min(seconds, LONGEST_SAME * self._period)
        self.constant_s = np.where(changed, 0.0, self.constant_s + counted_s)
        self._lowest = np.where(changed, compared, np.minimum(self._lowest, compared))
        self._highest = np.where(changed, compared, np.maximum(self._highest, compared))
        both_constant_s = np.minimum(self.constant_s[:n], self.constant_s[n:])
        offset = np.concatenate((SPEED_STEP * both_constant_s, np.zeros(n)))
        uncertainties = np.concatenate((uncertainty, uncertainty))
        self.moved = self._highest - self._lowest - uncertainties - offset

        changing = changed[:n] | changed[n:]
        torque = self._command_torque
        self.live |= changing
        self._least_torque = np.where(changing, torque, np.minimum(self._least_torque, torque))
        self._largest_torque = np.where(changing, torque, np.maximum(self._largest_torque, torque))
        self.load = self._largest_torque - self._least_torque
        self._origins[changing] = position
        self.others = np.abs(position - self._origins).sum(axis=1)

    def _compare_slow_drift(self, speed: Array) -> None:
        """Update `slow_drift`; `speed` is the largest of the last 60 ms [rad/s], (n,)."""
        self._slow_row = (self._slow_row + 1) % len(self._slow_drifts)
        oldest = self._slow_drifts[self._slow_row].copy()
        self._slow_drifts[self._slow_row] = self._slow_drift
        # Largest speed of the present and of the last window.
        self._slow_speeds[0] = np.maximum(self._slow_speeds[0], speed)
        if self._slow_row == 0:
            self._slow_speeds[1] = self._slow_speeds[0]
            self._slow_speeds[0] = speed
        uncertainty = (ON_TIME_SHARE * self._period) * self._slow_speeds.max(axis=0)
        self.slow_drift = np.abs(self._slow_drift - oldest) - uncertainty


def _small_rotation(first: list[float], second: list[float]) -> Vector:
    """Return the rotation from one attitude to another in the trunk's frame; small angles [rad].

    Twice the vector part of `conjugate(first) * second`, quaternions w, x, y, z.
    """
    w1, x1, y1, z1 = first
    w2, x2, y2, z2 = second
    twice = 2.0 if w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2 >= 0.0 else -2.0
    return (
        twice * (w1 * x2 - x1 * w2 - y1 * z2 + z1 * y2),
        twice * (w1 * y2 - y1 * w2 - z1 * x2 + x1 * z2),
        twice * (w1 * z2 - z1 * w2 - x1 * y2 + y1 * x2),
    )


def _to_world(attitude: list[float], vector: list[float]) -> Vector:
    """Return a vector of the trunk's frame in the world's, `R v`."""
    w, x, y, z = attitude
    a, b, c = vector
    i = 2.0 * (y * c - z * b)
    j = 2.0 * (z * a - x * c)
    k = 2.0 * (x * b - y * a)
    return (
        a + w * i + y * k - z * j,
        b + w * j + z * i - x * k,
        c + w * k + x * j - y * i,
    )


# --- The rules ------------------------------------------------------------------------------------
#
# Each rule returns what contradicts what, in words with numbers, or "" if nothing does.

SensorRule = Callable[[SensorHistory, Limits], str]


def robot_clock_off(history: SensorHistory, limits: Limits) -> str:
    """Find a robot's clock that disagrees with the times of arrival.

    Rule: `|change of the robot's time - change of the time of arrival|` over a second is more than
    `clock_s`, 0.2 s, where each half second is timed by its least delayed state; or the robot's
    times of half a second scatter by more than 0.5 s about those of arrival. A pause of this
    computer, or a burst after it, delays some states of a block but not all. Only where the wire
    carries the robot's time.
    """
    if history.clock.disagreement > limits.sensors.clock_s:
        return f"by {history.clock.disagreement:.1f} s in a second"
    return ""


def interrupted_states(history: SensorHistory, limits: Limits) -> str:
    """Find states that are never compared for long enough to find anything.

    Rule: more than `restarts`, 4, times in a row the comparison began anew, because of a pause of
    more than 50 ms or a time of arrival that went back, without 60 ms of states in between.
    """
    if history.restarts > limits.sensors.restarts:
        return f"{history.restarts} times in a row"
    return ""


def low_voltage(history: SensorHistory, limits: Limits) -> str:
    """Find a bus voltage below what the drives need.

    Rule: the largest bus voltage of 80 ms is below `OperatingLimits.bus_voltage`, by default 0.55
    of the nominal. NaN is no measurement; 0 is one.
    """
    if history.voltage < limits.operating.bus_voltage:
        return f"{history.voltage:.1f} of {limits.operating.bus_voltage:.1f} V"
    return ""


def repeated_source(history: SensorHistory, limits: Limits) -> str:
    """Find a source of the inertial unit that repeats its numbers to the last bit.

    Rule: attitude, gyro or accelerometer has not changed in one bit for more than `repeat_s`, 40
    ms. All three are noisy. False alarms: none in 10.02 h.
    """
    for name, seconds in history.repeated.items():
        if seconds > limits.sensors.repeat_s:
            return f"{name}, for {1e3 * seconds:.0f} ms"
    return ""


def attitude_off_gyro(history: SensorHistory, limits: Limits) -> str:
    """Find an attitude that differs from the integral of the gyro.

    Rule: `|sum(rotation of the attitude - rate dt)|` over 60 ms, less the uncertainty of the
    integral, is more than `attitude`, 0.06 rad. Largest: 0.037 rad. False alarms: none in 10.02 h.
    """
    if history.attitude > limits.sensors.attitude:
        return f"the gyro's integral is {history.attitude:.2f} rad off"
    return ""


def attitude_stuck(history: SensorHistory, limits: Limits) -> str:
    """Find an attitude that is stuck, even if it is not constant.

    Rule: the path `sum(|rate| dt)` of the gyro over 60 ms is more than `turned`, 0.03 rad, and the
    path of the attitude is less than `stuck_share`, a quarter, of it. Least share: 0.86. False
    alarms: none in 10.02 h.
    """
    path, turned = history.paths
    if turned > limits.sensors.turned and path < limits.sensors.stuck_share * turned:
        return f"it is stuck while the gyro's integral is {turned:.2f} rad"
    return ""


def force_off_vertical(history: SensorHistory, limits: Limits) -> str:
    """Find an attitude that contradicts the accelerometer.

    Rule: the specific force in the world's frame, averaged over a second, leans by more than
    `upright`, 0.5 rad. Legs accelerate the trunk, but never for as long. Largest: 0.26 rad. False
    alarms: none in 10.02 h.
    """
    if history.lean > limits.sensors.upright:
        return f"the mean specific force is {history.lean:.2f} rad off the vertical"
    return ""


def position_off_velocity(history: SensorHistory, limits: Limits) -> str:
    """Find a joint whose position differs from the integral of its velocity.

    Rule: `|sum(change of position - velocity dt)|` over 60 ms, less the uncertainty of the
    integral, is more than `encoder`, 0.18 rad. A step is found in the state in which it occurs.
    Largest: 0.01 rad. Before `LARGEST_ACCELERATION` counted it was 0.120 rad in 10.02 h, with one
    false alarm in 3.0 other hours: 24 ms of states were lost in a landing.
    """
    if (history.encoder > limits.sensors.encoder).any():
        i = int(np.argmax(history.encoder))
        return f"{limits.joints.names[i]}, by {history.encoder[i]:.2f} rad"
    return ""


def position_drifts(history: SensorHistory, limits: Limits) -> str:
    """Find a joint whose position drifts slowly against its velocity.

    Rule: `|sum(change of position - velocity dt)|` over half a second, of the states that arrived
    on time, with the mean period as dt and less the uncertainty of a time of arrival, is more than
    `drift`, 0.035 rad. A drift of both together does not show. Largest: 0.0141 rad in 3.0 h, before
    the mean period was taken.
    """
    if (history.slow_drift > limits.sensors.drift).any():
        i = int(np.argmax(history.slow_drift))
        return f"{limits.joints.names[i]}, drifts by {history.slow_drift[i]:.2f} rad"
    return ""


def constant_while_others_moved(history: SensorHistory, limits: Limits) -> str:
    """Find a joint that is constant to the last bit while the other joints move.

    Rule: position and velocity have been constant for more than `repeat_s`, 40 ms, and the
    displacements of the other joints since then are more than `others_moved`, 0.05 rad, in sum.
    Only of a robot that is free to move. Largest: 0.003 rad. False alarms: none in 10.02 h.
    """
    if not limits.trunk_is_free:
        return ""
    position_constant, velocity_constant = _constant(history, limits)
    stopped = position_constant & velocity_constant & (history.others > limits.sensors.others_moved)
    if stopped.any():
        i = int(np.argmax(stopped))
        name = limits.joints.names[i]
        return f"{name}, constant while others moved by {history.others[i]:.2f} rad"
    return ""


def constant_while_moved(history: SensorHistory, limits: Limits) -> str:
    """Find a position that is constant while the velocity says that it moved, or the reverse.

    Rule: a position has been constant for more than `repeat_s`, 40 ms, and the range of the
    integral of the velocity since then is more than `moved`, 0.005 rad; or the velocity has, and
    the range of the position is. Largest: 0.0032 rad. False alarms: none in 10.02 h.
    """
    n = len(limits.joints.names)
    constant = np.stack(_constant(history, limits))
    excess = np.where(constant, history.moved.reshape(2, n) / limits.sensors.moved, 0.0)
    if (excess > 1.0).any():
        row, i = divmod(int(np.argmax(excess)), n)
        quantity = ("position", "velocity")[row]
        return f"{limits.joints.names[i]}, whose {quantity} is constant"
    return ""


def constant_while_loaded(history: SensorHistory, limits: Limits) -> str:
    """Find a joint that is constant to the last bit while its commanded torque changes.

    Rule: position and velocity have been constant for more than `repeat_s`, 40 ms, and the
    commanded torque has changed since then by more than `JointLimits.felt`: 5 % of the effort limit
    and four times the dry friction; half of it where all positions and velocities are constant.
    False alarms: none in 10.02 h.
    """
    position_constant, velocity_constant = _constant(history, limits)
    all_constant = position_constant.all() and velocity_constant.all()
    share = _ALL_CONSTANT_SHARE if all_constant else 1.0
    unmoved = position_constant & velocity_constant
    unmoved &= history.load > limits.joints.felt * share
    if not limits.trunk_is_free:
        # A robot on its stand may be simulated without some of its legs.
        unmoved &= history.live
    if unmoved.any():
        i = int(np.argmax(unmoved))
        return f"{limits.joints.names[i]}, constant while {history.load[i]:.1f} N m were added"
    return ""


def _constant(history: SensorHistory, limits: Limits) -> tuple[Mask, Mask]:
    """Whether each position, and each velocity, has been constant for `repeat_s`; (joints,)."""
    constant = history.constant_s > limits.sensors.repeat_s
    n = len(limits.joints.names)
    return constant[:n], constant[n:]


STREAM_RULES: tuple[tuple[Reason, SensorRule], ...] = (
    (Reason.ROBOT_CLOCK, robot_clock_off),
    (Reason.INTERRUPTED, interrupted_states),
    (Reason.BUS_VOLTAGE, low_voltage),
)
"""Rules of the stream of states and of the supply, of any robot, before all others."""
TRUNK_RULES: tuple[tuple[Reason, SensorRule], ...] = (
    (Reason.REPEATED, repeated_source),
    (Reason.ATTITUDE, attitude_off_gyro),
    (Reason.ATTITUDE, attitude_stuck),
    (Reason.ATTITUDE, force_off_vertical),
)
"""Rules of a trunk that is free, in their order; a fixed one may have no inertial unit."""
JOINT_RULES: tuple[tuple[Reason, SensorRule], ...] = (
    (Reason.ENCODER, position_off_velocity),
    (Reason.ENCODER, position_drifts),
)
"""Rules of the joints, after those of the trunk."""
CONSTANT_RULES: tuple[tuple[Reason, SensorRule], ...] = (
    (Reason.ENCODER, constant_while_others_moved),
    (Reason.ENCODER, constant_while_moved),
    (Reason.ENCODER, constant_while_loaded),
)
"""Rules of joints whose position or velocity is constant, after those of all joints. Encoders of a
robot at rest may repeat for good, so it takes a contradiction to make a fault."""


def find_contradiction(history: SensorHistory, limits: Limits) -> Decision | None:
    """Return the fault of the first rule that is met; None if the states can all be true."""
    rules = STREAM_RULES + JOINT_RULES
    if limits.trunk_is_free:
        rules = STREAM_RULES + TRUNK_RULES + JOINT_RULES
    if (history.constant_s > limits.sensors.repeat_s).any():
        rules = rules + CONSTANT_RULES
    for reason, rule in rules:
        detail = rule(history, limits)
        if detail:
            return Decision(reason, detail)
    return None
