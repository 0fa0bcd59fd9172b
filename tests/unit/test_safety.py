"""The safety filter: no output exceeds a limit; damping is always allowed."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pronk.robots
from pronk.deploy.runtime.limits import AgeLimits, Limits
from pronk.deploy.runtime.reasons import REASONS, Decision, FilterAction, Reason
from pronk.deploy.runtime.rules import SafetyInput, apply_rules, limit_targets, tilt
from pronk.deploy.runtime.safety import LEAST_DAMPING_S, SafetyFilter
from pronk.errors import RobotError
from pronk.robots import load_robot
from pronk.robots.limits import OperatingLimits
from pronk.robots.machine import Command, State
from pronk.robots.robot import RobotSpec
from virtual_robot import KD, KP, POSE, ROBOT, rolled, still

LIMITS = Limits.of(ROBOT)
N = len(ROBOT.joints)
state = partial(still, sequence=100)


def operating(**changes: float) -> Limits:
    """The robot's limits with other operating limits."""
    return replace(LIMITS, operating=replace(LIMITS.operating, **changes))


def command(**changes: Any) -> Command:
    """A command to the default pose, with changes."""
    fields: dict[str, Any] = {
        "position": POSE,
        "stiffness": KP,
        "damping": KD,
        "state_sequence": 100,
        "valid_for": 0.05,
    }
    fields.update(changes)
    return Command(**fields)


def judged(
    measured: State,
    desired: Command,
    t: float = 0.0,
    *,
    limits: Limits = LIMITS,
    sent_target: np.ndarray | None = None,
    dead_man: bool = True,
    earlier: tuple[State, ...] = (),
) -> tuple[Command | None, Decision, SafetyFilter]:
    """What a filter makes of a state and a command, and the filter."""
    safety = SafetyFilter(limits=limits)
    safety.sent_target = sent_target
    sent, decision = safety.judge([*earlier, measured], desired, t, dead_man=dead_man)
    return sent, decision, safety


def reason_of(
    measured: State,
    desired: Command,
    *,
    sent_target: np.ndarray | None = None,
    dead_man: bool = True,
    earlier: tuple[State, ...] = (),
) -> Reason:
    """Why a filter acts on a state and a command."""
    _, decision, _ = judged(
        measured, desired, sent_target=sent_target, dead_man=dead_man, earlier=earlier
    )
    return decision.reason


def at(values: Any, value: float, index: int = -1) -> np.ndarray:
    """An array with another value at an index."""
    array = np.array(values, dtype=float)
    array[index] = value
    return array


def test_a_command_within_all_limits_passes_unchanged() -> None:
    target = POSE + 0.1
    sent, decision, safety = judged(state(), command(position=target), 0.001)
    assert sent is not None
    assert safety.sent_target is not None
    assert decision.reason is Reason.NONE
    for values in (sent.position, safety.sent_target):
        np.testing.assert_array_equal(values, target)
    assert sent.stiffness is KP
    assert sent.damping is KD


@pytest.mark.parametrize("target", [1e3, -1e3, 1e5, 1e6 - 1.0])
def test_a_target_far_beyond_its_range_is_a_fault_at_once(target: float) -> None:
    absurd = command(position=at(POSE, target, 4))
    sent, decision, safety = judged(state(), absurd, 0.001)
    assert sent is None
    assert decision.reason is Reason.FAR_TARGET
    assert ROBOT.joint_names[4] in decision.detail
    assert safety.level is FilterAction.LATCH
    beyond = float(LIMITS.joints.high[4]) + LIMITS.operating.far_target
    near = command(position=at(POSE, beyond - 0.01, 4))
    far = command(position=at(POSE, beyond + 0.01, 4))
    assert reason_of(state(), near) is not Reason.FAR_TARGET
    assert reason_of(state(), far) is Reason.FAR_TARGET
    # A joint without stiffness has no target.
    loose = command(position=at(POSE, 1e3, 4), stiffness=at(KP, 0.0, 4))
    assert reason_of(state(), loose) is not Reason.FAR_TARGET


@pytest.mark.parametrize(
    ("age_s", "reason"),
    [
        (0.019, Reason.NONE),
        (0.021, Reason.OLD_STATE),
        (0.049, Reason.OLD_STATE),
        (0.051, Reason.NO_STATE),
        (0.099, Reason.NO_STATE),
        (0.101, Reason.STATE_LOST),
    ],
)
def test_an_old_state_holds_then_damps_then_latches(age_s: float, reason: Reason) -> None:
    sent_target = POSE + 0.2
    desired = command(position=POSE + 0.4, made=age_s)
    sent, decision, _ = judged(state(), desired, age_s, sent_target=sent_target)
    assert decision.reason is reason
    if reason is Reason.OLD_STATE:
        assert sent is not None
        np.testing.assert_array_equal(sent.position, sent_target)


def test_each_reason_has_its_level() -> None:
    reasons_of_level = {
        FilterAction.PASS: {Reason.NONE},
        FilterAction.HOLD: {Reason.OLD_STATE},
        FilterAction.LIMIT: {Reason.POSITION, Reason.CHANGE, Reason.TORQUE, Reason.POWER},
        FilterAction.DAMP: {Reason.NO_STATE, Reason.DEAD_MAN, Reason.ENDED, Reason.HELD},
    }
    for level, reasons in reasons_of_level.items():
        assert {reason for reason in Reason if reason.level is level} == reasons


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_latches(number: float) -> None:
    for name in ("position", "velocity", "gyro", "accelerometer", "orientation"):
        s = state(**{name: at(getattr(state(), name), number)})
        assert reason_of(s, command()) == Reason.STATE_NOT_FINITE
    for name in ("position", "stiffness", "damping"):
        c = command(**{name: at(getattr(command(), name), number)})
        assert reason_of(state(), c) == Reason.COMMAND_NOT_FINITE


@pytest.mark.parametrize("shape", [np.zeros(N + 1), np.zeros((2, N)), None, "legs"])
def test_a_command_of_another_shape_latches(shape: Any) -> None:
    assert reason_of(state(), command(position=shape)) == Reason.COMMAND_NOT_FINITE


@pytest.mark.parametrize(
    ("s", "c", "reason"),
    [
        (state(), command(made=-0.06), Reason.EXPIRED),
        (state(), command(made=-0.06, valid_for=math.inf), Reason.EXPIRED),
        (state(), command(made=-0.03, valid_for=0.02), Reason.EXPIRED),
        (state(), command(made=0.02), Reason.CLOCK),
        (state(time=0.02), command(), Reason.CLOCK),
        (state(sequence=131), command(), Reason.LAG),
        (state(), command(stiffness=KP - 20.0), Reason.GAINS),
        (state(), command(stiffness=KP + 100.0), Reason.GAINS),
        (state(), command(damping=KD + 5.0), Reason.GAINS),
        (state(position=at(POSE, 2.76)), command(), Reason.OVERRUN),
        (state(orientation=rolled(0.81)), command(), Reason.TILT),
        (state(orientation=rolled(-3.0)), command(), Reason.TILT),
        (state(orientation=np.zeros(4)), command(), Reason.STATE_NOT_FINITE),
        (state(velocity=at(np.zeros(N), -40.0)), command(), Reason.SPEED),
        (state(temperature=at(np.full(N, 40.0), 81.0)), command(), Reason.TEMPERATURE),
    ],
)
def test_faults_latch_with_their_reason(s: State, c: Command, reason: Reason) -> None:
    sent, decision, safety = judged(s, c)
    assert sent is None
    assert (decision.level, decision.reason) == (FilterAction.LATCH, reason)
    assert safety.faulted
    assert safety.sent_target is None
    assert reason.text in decision.text
    assert "\n" not in decision.text
    # In an earlier state of the tick it counts too.
    if s.sequence == 100 and s.time == 0.0:
        assert reason_of(state(), c, earlier=(s,)) is reason


def test_a_state_that_is_not_finite_is_named_wherever_it_came_in_the_tick() -> None:
    broken = state(position=at(POSE, math.nan))
    for measured, earlier in ((broken, (state(),)), (state(), (broken,))):
        assert reason_of(measured, command(), earlier=earlier) is Reason.STATE_NOT_FINITE


def test_the_most_severe_fault_of_a_tick_decides() -> None:
    fallen = state(orientation=rolled(1.2))
    for measured, earlier in ((fallen, (state(),)), (state(), (fallen,))):
        sent, decision, safety = judged(measured, command(), dead_man=False, earlier=earlier)
        assert sent is None
        assert decision.reason is safety.reason is Reason.TILT


def test_just_within_the_limits_is_no_fault() -> None:
    s = state(
        position=at(POSE, 2.69),
        orientation=rolled(0.79),
        velocity=at(np.zeros(N), -5.0),
        temperature=at(np.full(N, np.nan), 79.0),
        sequence=130,
    )
    target = np.minimum(s.position, 2.5)
    assert reason_of(s, command(position=target), sent_target=target).level <= FilterAction.LIMIT
    assert reason_of(state(), command(), dead_man=False) is Reason.DEAD_MAN


@pytest.mark.parametrize("reason", [Reason.NO_STATE, Reason.TILT])
def test_a_fault_lasts_a_second_and_a_latched_one_until_it_is_reset(reason: Reason) -> None:
    safety = SafetyFilter(limits=LIMITS)
    safety.fault(reason, 10.0)
    sent, decision = safety.judge([state(time=10.0)], command(made=10.0), 10.0)
    assert (sent, decision) == (None, Decision(reason))
    safety.release(10.0 + LEAST_DAMPING_S - 1e-6, acknowledged=True)
    assert safety.faulted
    safety.release(1e6)
    assert safety.faulted is (reason is Reason.TILT)
    safety.release(1e6, acknowledged=True)
    assert not safety.faulted


def test_a_fault_can_only_become_worse() -> None:
    safety = SafetyFilter(limits=LIMITS)
    for t, reason in ((0.06, Reason.NO_STATE), (0.11, Reason.STATE_LOST)):
        _, decision = safety.judge([state()], command(made=t), t)
        assert decision.reason is safety.reason is reason
    safety.fault(Reason.DEAD_MAN, 0.2)
    assert (safety.reason, safety.since) == (Reason.STATE_LOST, 0.06)


def moved(
    measured: State,
    target: np.ndarray,
    sent_target: np.ndarray | None = None,
    limits: Limits = LIMITS,
) -> tuple[np.ndarray, Reason]:
    """The target that is sent, and why it was moved."""
    desired = command(position=target)
    sent, decision, _ = judged(measured, desired, limits=limits, sent_target=sent_target)
    assert sent is not None
    assert decision.level is FilterAction.LIMIT
    return sent.position, decision.reason


def test_targets_are_moved_into_each_limit() -> None:
    # By hand: 17 N m at 17 N m/rad is 1 rad, and 0.4 N m s/rad at 2.5 rad/s adds 1 N m.
    s = state(velocity=at(np.zeros(N), 2.5, 0))
    target, reason = moved(s, at(POSE, 1.4, 0), at(POSE, 0.9, 0))
    assert reason is Reason.TORQUE
    assert target[0] == pytest.approx(1.0 + 1.0 / 17.0)
    np.testing.assert_array_equal(target[1:], POSE[1:])

    target, reason = moved(state(), POSE - 0.9, POSE + 0.5)
    assert reason is Reason.CHANGE
    np.testing.assert_allclose(target, POSE + 0.5 - LIMITS.operating.change)

    # In 20 ms at 10 rad/s the knee would pass its margin, 2.55 rad.
    q = at(POSE, 2.4, 2)
    s = state(position=q, velocity=at(np.zeros(N), 10.0, 2))
    target, reason = moved(s, at(q, 2.5, 2))
    assert (target[2], reason) == (2.4, Reason.POSITION)

    # At rest all power is winding loss: the torques are equal still, and give the limit exactly.
    target, reason = moved(state(), POSE + 0.8, limits=operating(power_w=1000.0))
    torque = KP * (target - POSE)
    assert reason is Reason.POWER
    np.testing.assert_allclose(torque, torque[0])
    assert float(torque**2 @ LIMITS.joints.loss) == pytest.approx(1000.0)
    # V / (gear kt stall torque), by hand for the hips: 24 / (6 0.05 62.43).
    stall = 1.5 * 6 * 0.05 * 24 / 0.173
    assert LIMITS.joints.loss[0] == pytest.approx(24 / (6 * 0.05 * stall))


def test_power_that_was_too_large_may_end_at_once() -> None:
    """However far the targets of the tick before are from those with less power."""
    limits = operating(power_w=1000.0, change=0.1)
    before = POSE + 0.8
    target, reason = moved(state(), before, before, limits=limits)
    torque = KP * (target - POSE)
    assert reason is Reason.POWER
    assert float(torque**2 @ LIMITS.joints.loss) == pytest.approx(1000.0)
    assert (before - target > 2 * limits.operating.change).all()
    # Not in the other direction: from no torque on it grows by the change alone.
    target, reason = moved(state(), before, POSE, limits=limits)
    assert reason is Reason.CHANGE
    np.testing.assert_allclose(target, POSE + 0.1)


def test_a_joint_that_brakes_whatever_its_target_leaves_less_power_to_the_others() -> None:
    """Faster than without load, its torque cannot be scaled with the others."""
    joint = 0
    limits = operating(power_w=1000.0)
    velocity = at(np.zeros(N), 1.05 * LIMITS.joints.no_load[joint], joint)
    target, reason = moved(state(velocity=velocity), POSE + 0.8, POSE + 0.8, limits=limits)
    assert reason is Reason.POWER
    torque = KP * (target - POSE) - KD * velocity
    # What back-EMF leaves at 1.05 of the no-load speed: braking with 0.05 of the stall torque.
    torque[joint] = min(torque[joint], -0.05 * LIMITS.joints.stall[joint])
    assert float(torque**2 @ LIMITS.joints.loss) == pytest.approx(1000.0)
    others = np.delete(torque, joint)
    np.testing.assert_allclose(others, others[0])


def test_with_a_reach_a_joint_clear_of_its_limits_gets_a_torque() -> None:
    limits = operating(target_reach=0.5, far_target=1.0)
    knee = 2
    highest = LIMITS.joints.high[knee] - LIMITS.operating.margin
    # Clear of its limits: half a radian beyond them, no more.
    s = state(position=at(POSE, 2.1, knee))
    before = at(POSE, 2.7, knee)
    desired = command(position=at(POSE, highest + 0.4, knee))
    _, decision, _ = judged(s, desired, limits=limits, sent_target=before)
    assert decision.reason is Reason.NONE
    target, reason = moved(s, at(POSE, highest + 0.7, knee), before, limits=limits)
    assert target[knee] == pytest.approx(highest + 0.5)
    assert reason is Reason.POSITION
    # On its way to a limit it is not driven further, whatever target was sent before.
    s = state(position=at(POSE, 2.4, knee), velocity=at(np.zeros(N), 10.0, knee))
    before = at(POSE, highest + 0.5, knee)
    small_change = operating(target_reach=0.5, far_target=1.0, change=0.1)
    target, reason = moved(s, at(POSE, highest + 0.4, knee), before, limits=small_change)
    assert (target[knee], reason) == (2.4, Reason.POSITION)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("power_w", 0.0),
        ("target_reach", -0.1),
        ("target_reach", 1.0),
        ("change", math.inf),
        ("margin", 3.0),
        ("tilt", -1.0),
    ],
)
def test_limits_that_limit_nothing_are_refused(name: str, value: float) -> None:
    with pytest.raises(RobotError, match=name):
        operating(**{name: value})
    assert not operating(tilt=math.inf).trunk_is_free
    with pytest.raises(RobotError, match="must not fall"):
        AgeLimits(hold_s=9.0)
    with pytest.raises(RobotError, match="lag"):
        AgeLimits(lag=0.0)


def robot_with(folder: Path, old: str, new: str) -> RobotSpec:
    """The Mini Cheetah with a change in its file."""
    shipped = Path(pronk.robots.__file__).parent / "mini_cheetah"
    for name in ("mini_cheetah.xml", "robot.yaml"):
        (folder / name).write_text((shipped / name).read_text())
    text = (folder / "robot.yaml").read_text()
    assert old in text
    (folder / "robot.yaml").write_text(text.replace(old, new))
    return load_robot(folder)


def test_limits_of_a_robot_are_in_its_file(tmp_path: Path) -> None:
    limits = Limits.of(robot_with(tmp_path, "  tilt: 0.8 ", "  tilt: 0.5 "))
    assert limits.operating == replace(LIMITS.operating, tilt=0.5)
    assert reason_with(limits, rolled(0.6)) is Reason.TILT
    assert reason_with(LIMITS, rolled(0.6)) is Reason.NONE
    # A file without the section has the usual limits.
    assert load_robot("so101").limits == OperatingLimits()


def reason_with(limits: Limits, orientation: np.ndarray) -> Reason:
    """Why a filter acts on a robot with an attitude."""
    _, decision, _ = judged(state(orientation=orientation), command(), limits=limits)
    return decision.reason


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("  tilt: 0.8 ", "  tillt: 0.8 ", "tillt"),
        ("  power_w: 5000.0 ", "  power_w: -1.0 ", "power_w"),
    ],
)
def test_wrong_limits_in_a_robot_file_are_refused(
    old: str, new: str, word: str, tmp_path: Path
) -> None:
    with pytest.raises(RobotError, match=word):
        robot_with(tmp_path, old, new)


def test_tilt_is_the_angle_of_the_z_axis() -> None:
    assert tilt(rolled(0.3)) == pytest.approx(0.3)
    assert tilt(np.array([math.cos(1.0), 0.0, 0.0, math.sin(1.0)])) == pytest.approx(0.0)


def wild(rng: np.random.Generator, count: int) -> SafetyInput:
    """States and commands from harmless to impossible, every limit met on both sides."""

    def spread(shape: tuple[int, ...], centre: Any, scale: Any) -> np.ndarray:
        # Each row has its own size: from far within all limits to far beyond.
        size = 10.0 ** rng.uniform(-2.0, 0.7, (count, 1))
        return np.asarray(centre + scale * size * rng.standard_normal(shape))

    of_joints = (count, N)
    orientation = np.array([1.0, 0.0, 0.0, 0.0]) + rng.uniform(0, 0.6, (count, 1)) * (
        rng.standard_normal((count, 4))
    )
    orientation /= np.linalg.norm(orientation, axis=-1, keepdims=True)
    position = spread(of_joints, POSE, 0.5)
    temperature = rng.uniform(20.0, 82.0, of_joints)
    temperature[rng.random(of_joints) < 0.5] = np.nan
    drawn = SafetyInput(
        position=position,
        velocity=spread(of_joints, 0.0, 5.0),
        orientation=orientation,
        torque=np.full((count, 12), np.nan),
        imu=spread((count, 6), (0.0, 0.0, 0.0, 0.0, 0.0, 9.81), 1.0),
        temperature=np.where(
            rng.random(of_joints) < 0.5, np.nan, rng.uniform(20.0, 82.0, of_joints)
        ),
        state_age=rng.exponential(0.01, count),
        target=position + spread(of_joints, 0.0, 1.0),
        stiffness=np.abs(spread(of_joints, KP, 5.0)) * (rng.random((count, 1)) > 0.05),
        damping=np.abs(spread(of_joints, KD, 0.2)),
        command_age=rng.exponential(0.01, count),
        valid_for=rng.choice([0.01, 0.05, math.inf], count),
        lag=rng.integers(0, 35, count).astype(float),
        previous=position + spread(of_joints, 0.0, 0.3),
        dead_man=rng.random(count) < 0.95,
    )
    for values in (drawn.position, drawn.velocity, drawn.imu, drawn.target, drawn.previous):
        struck = rng.random(values.shape) < 0.001
        values[struck] = rng.choice([math.nan, math.inf, -math.inf, 1e300], struck.sum())
    return drawn


def broken(drawn: SafetyInput, target: np.ndarray, limits: Limits) -> dict[str, np.ndarray]:
    """Which rows that were sent break which limit; written anew, not the filter's own code."""
    slack = 1e-6
    reach = limits.operating.target_reach
    q = drawn.position
    v = drawn.velocity
    kp = drawn.stiffness
    kd = drawn.damping
    torque = kp * (target - q) - kd * v
    # The nearest target that the change alone allows, and its torque.
    changed = np.clip(
        target, drawn.previous - limits.operating.change, drawn.previous + limits.operating.change
    )
    changed_torque = kp * (changed - q) - kd * v
    is_weaker = (np.abs(torque) <= np.abs(changed_torque)) & (torque * changed_torque >= -slack)
    top = limits.joints.stall * (1.0 - v / limits.joints.no_load)
    bottom = -limits.joints.stall * (1.0 + v / limits.joints.no_load)
    applied = np.clip(torque, bottom, top)
    power = (np.maximum(applied * v, 0.0) + limits.joints.loss * applied**2).sum(axis=-1)
    w, x, y, z = drawn.orientation.T
    upright = w * w - x * x - y * y + z * z
    ahead = q + limits.operating.horizon_s * v
    near = (ahead > limits.joints.high - limits.operating.margin) | (
        ahead < limits.joints.low + limits.operating.margin
    )
    out = (ahead > limits.joints.high - limits.operating.margin) & (target > q + slack)
    out |= (ahead < limits.joints.low + limits.operating.margin) & (target < q - slack)
    # Where the joint itself is beyond the margin its target may lead it back, no less.
    inside = (q <= limits.joints.high - limits.operating.margin) & (
        q >= limits.joints.low + limits.operating.margin
    )
    bad_gains = (kp < 0) | (kp > limits.operating.stiffness)
    bad_gains |= (kd < 0) | (kd > limits.operating.damping)
    return {
        "finite": ~np.isfinite(target).all(axis=-1),
        "position": (
            (target < limits.joints.low + limits.operating.margin - reach - slack)
            | (target > limits.joints.high - limits.operating.margin + reach + slack)
            | (out & inside)
        ).any(axis=-1),
        # With a reach, a joint that nears a limit may be brought back from a far target at once,
        # and with too much power torques may become smaller at once.
        "change": (
            (np.abs(target - drawn.previous) > limits.operating.change + slack)
            & ~(near & (reach > 0.0))
            & ~is_weaker
        ).any(axis=-1),
        "torque": (np.abs(torque) > limits.joints.torque + slack).any(axis=-1),
        "power": power > limits.operating.power_w * (1.0 + slack),
        "tilt": upright < math.cos(limits.operating.tilt) - slack,
        "speed": (np.abs(v) > limits.joints.speed).any(axis=-1),
        "temperature": (drawn.temperature > limits.operating.temperature).any(axis=-1),
        "age": drawn.state_age > limits.ages.damp_s,
        "expiry": drawn.command_age > np.minimum(drawn.valid_for, limits.ages.expiry_s),
        "lag": drawn.lag > limits.ages.lag,
        "dead man": ~drawn.dead_man,
        "gains": (
            (kp < 0)
            | (kp > limits.operating.stiffness)
            | (kd < 0)
            | (kd > limits.operating.damping)
        ).any(-1),
    }


def test_a_million_states_and_commands_break_no_limit() -> None:
    rng = np.random.default_rng(240415096)
    chunk = 5_000
    times_met = np.zeros(len(Reason), dtype=int)
    times_of_level = np.zeros(len(FilterAction), dtype=int)
    limits = operating(power_w=2000.0)
    for _ in range(200):
        drawn = wild(rng, chunk)
        result = apply_rules(drawn, limits)
        times_met += np.bincount(result.reason, minlength=len(Reason))
        times_of_level += np.bincount(result.level, minlength=len(FilterAction))
        sent = result.level < FilterAction.DAMP
        with np.errstate(invalid="ignore", over="ignore"):
            for name, breaks in broken(drawn, result.target, limits).items():
                assert not (breaks & sent).any(), name
        # A command that is passed is the one that was requested, to the last bit.
        passed = result.level == FilterAction.PASS
        np.testing.assert_array_equal(result.target[passed], drawn.target[passed])
        holds = result.level == FilterAction.HOLD
        assert (drawn.state_age[holds] > limits.ages.hold_s).all()
    # Every rule acted, and enough passed for the test to mean something.
    silent = {Reason(number) for number in np.flatnonzero(times_met == 0)}
    rules_over_time = {reason for reason in Reason if reason >= Reason.REPEATED}
    rare = {Reason.CLOCK, Reason.STATE_LOST, Reason.ENDED, Reason.LINK, Reason.OVERLOAD}
    assert silent - rules_over_time <= rare
    assert times_of_level.min() > 1000
    assert times_of_level.sum() == 1_000_000


def test_targets_beyond_a_range_break_no_limit() -> None:
    """With `target_reach` a joint near its stop is still not driven further."""
    rng = np.random.default_rng(44)
    limits = operating(target_reach=0.8)
    inner = limits.joints.high - limits.operating.margin
    beyond = 0
    for _ in range(10):
        drawn = wild(rng, 5_000)
        result = apply_rules(drawn, limits)
        sent = result.level < FilterAction.DAMP
        with np.errstate(invalid="ignore", over="ignore"):
            for name, breaks in broken(drawn, result.target, limits).items():
                assert not (breaks & sent).any(), name
            beyond += int((result.target[sent] > inner).sum())
    assert beyond > 100, "targets beyond the range were sent"
    with pytest.raises(RobotError, match="target_reach"):
        operating(target_reach=limits.operating.far_target)


def test_a_go2_gets_the_torque_of_its_knees() -> None:
    """From the default pose to the stop of the knees its stiffness alone gives 19 N m."""
    robot = load_robot("go2")
    limits = Limits.of(robot)
    pose = np.array([joint.default_position for joint in robot.joints])
    stiffness = np.full(12, 20.0)
    target = pose.copy()
    target[2::3] += 2.2
    sent, _, possible = limit_targets(
        pose, np.zeros(12), target, target, stiffness, np.full(12, 0.5), limits
    )
    assert possible
    assert 20.0 * (sent - pose)[2] > 40.0
    # A knee that would reach its stop within the horizon is not driven there.
    near = pose.copy()
    near[2] = -0.95
    speed = np.zeros(12)
    speed[2] = 5.0
    sent, _, _ = limit_targets(near, speed, target, near, stiffness, np.full(12, 0.5), limits)
    assert sent[2] <= near[2]


def test_the_table_of_reasons_is_in_the_order_of_their_numbers() -> None:
    assert [entry.reason for entry in REASONS] == list(Reason)


numbers = st.floats(allow_nan=True, allow_infinity=True, width=64)


@given(
    values=st.lists(numbers, min_size=3 * N + 7, max_size=3 * N + 7),
    ages=st.tuples(numbers, numbers, numbers),
    sequences=st.tuples(st.integers(-5, 200), st.integers(-5, 200)),
    dead_man=st.booleans(),
)
def test_any_input_gives_a_command_within_the_limits_or_damping(
    values: list[float], ages: tuple[float, ...], sequences: tuple[int, int], dead_man: bool
) -> None:
    parts = np.split(np.array(values), (N, 2 * N, 3 * N, 3 * N + 3))
    position, velocity, target, gyro, orientation = parts
    measured = state(
        time=-ages[0],
        sequence=sequences[0],
        position=position,
        velocity=velocity,
        gyro=gyro,
        orientation=orientation,
    )
    desired = command(
        position=target, made=-ages[1], valid_for=ages[2], state_sequence=sequences[1]
    )
    sent, decision, safety = judged(measured, desired, dead_man=dead_man)
    assert (sent is None) == (decision.level >= FilterAction.DAMP) == safety.faulted
    if sent is not None:
        assert np.isfinite(sent.position).all()
        assert (sent.position >= LIMITS.joints.low).all()
        assert (sent.position <= LIMITS.joints.high).all()
        assert dead_man
