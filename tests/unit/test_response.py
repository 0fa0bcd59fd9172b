"""Response of the joints, height of the trunk, and the small motions before the first step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.poses import RunTiming, folded_pose
from pronk.deploy.runtime.posture import leg_kinematics, upward
from pronk.deploy.runtime.reasons import FilterAction, Reason
from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.state_machine import StateMachine
from pronk.robots import load_robot
from pronk.robots.machine import Command, State
from virtual_robot import KD, KP, POSE, ROBOT, connected, still

DT = 0.002
LIMITS = Limits.of(ROBOT)
KNEE = 2


def found(
    position: Callable[[float], np.ndarray],
    target: Callable[[float], np.ndarray],
    seconds: float,
    *,
    on_feet: bool = False,
    limits: Limits = LIMITS,
) -> tuple[Reason, float]:
    """Why a filter damps joints on these paths, whose sensors are honest, and when [s]."""
    rng = np.random.default_rng(3)
    safety = SafetyFilter(limits=limits)
    safety.on_feet = on_feet
    for k in range(round(seconds / DT)):
        t = k * DT
        state = still(
            time=t,
            sequence=k,
            position=position(t) + 1e-4 * rng.standard_normal(12),
            velocity=(position(t + 1e-4) - position(t - 1e-4)) / 2e-4
            + 0.02 * rng.standard_normal(12),
            gyro=1e-3 * rng.standard_normal(3),
            accelerometer=np.array([0.0, 0.0, 9.81]) + 0.02 * rng.standard_normal(3),
            orientation=np.array([1.0, *(1e-5 * rng.standard_normal(3))]),
        )
        command = Command(position=target(t), stiffness=KP, damping=KD, made=t, valid_for=0.05)
        sent, decision = safety.judge([state], command, t)
        if sent is None:
            assert decision.reason.level is FilterAction.LATCH
            return decision.reason, t
    return Reason.NONE, math.nan


def knee(values: np.ndarray, angle: float) -> np.ndarray:
    """Positions with another one of a knee."""
    changed = values.copy()
    changed[KNEE] = angle
    return changed


def standing(_: float) -> np.ndarray:
    return POSE


@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_feet_are_where_mujoco_has_them(name: str) -> None:
    robot = load_robot(name)
    legs = leg_kinematics(robot)
    assert legs is not None
    model = robot.build_spec().compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        position = rng.uniform(-1.5, 1.5, 12)
        quaternion = rng.standard_normal(4)
        quaternion /= np.linalg.norm(quaternion)
        data.qpos[3:7] = quaternion
        for joint, angle in zip(robot.joint_names, position, strict=True):
            data.qpos[model.joint(joint).qposadr[0]] = angle
        mujoco.mj_kinematics(model, data)
        trunk = data.body(robot.base_body)
        depths = []
        for leg in robot.legs:
            foot = data.geom(f"{leg}_foot_collision").xpos
            depths.append(trunk.xpos[2] - foot[2])
        assert legs.height(position, quaternion) - legs.radius == pytest.approx(max(depths))
        np.testing.assert_allclose(upward(quaternion), trunk.xmat.reshape(3, 3)[2], atol=1e-12)


def test_a_robot_without_legs_has_no_height() -> None:
    assert leg_kinematics(load_robot("so101")) is None


def test_a_collapsed_trunk_is_found_only_while_it_should_be_up() -> None:
    down = folded_pose(ROBOT)

    def collapsing(t: float) -> np.ndarray:
        return POSE + min(1.0, max(0.0, (t - 0.2) / 0.3)) * (down - POSE)

    reason, when = found(collapsing, collapsing, 1.0, on_feet=True)
    assert reason is Reason.COLLAPSED
    assert 0.4 < when <= 0.6
    assert found(collapsing, collapsing, 1.0)[0] is Reason.NONE
    assert found(standing, standing, 1.0, on_feet=True)[0] is Reason.NONE


def test_a_joint_that_gives_way_to_its_target_is_found() -> None:
    far = 1.2 * LIMITS.push[KNEE] / KP[KNEE]

    def pushed(t: float) -> np.ndarray:
        # Slower than what makes a joint that stands still a seized one.
        return knee(POSE, POSE[KNEE] - far * min(1.0, t / 0.9))

    reason, when = found(standing, pushed, 1.3)
    assert reason is Reason.TRACKING
    pushed_since = 0.9 / 1.2
    assert abs(when - pushed_since - LIMITS.response.pushed_s) < 0.02

    def following(t: float) -> np.ndarray:
        return knee(POSE, POSE[KNEE] - 0.5 * t)

    def ahead(t: float) -> np.ndarray:
        return following(t) - knee(np.zeros(12), 1.2 * LIMITS.push[KNEE] / KP[KNEE])

    assert found(following, ahead, 0.9)[0] is Reason.NONE


def test_a_seized_joint_is_found_and_one_that_follows_late_is_not() -> None:
    def swinging(t: float) -> np.ndarray:
        return knee(POSE, POSE[KNEE] + 0.7 * math.sin(2.0 * math.pi * 3.0 * t))

    reason, when = found(standing, swinging, 2.0)
    assert reason is Reason.TRACKING
    assert when < 0.6

    def late(t: float) -> np.ndarray:
        return knee(POSE, POSE[KNEE] + 0.3 * math.sin(2.0 * math.pi * 3.0 * (t - 0.04)))

    assert found(late, swinging, 2.0)[0] is Reason.NONE


def test_a_joint_that_stops_at_once_after_a_swing_is_not_seized() -> None:
    """It followed its last targets within the lag, and its target stands still as it does."""

    def stopping(t: float) -> np.ndarray:
        swing = 1.0 * math.sin(2.0 * math.pi * 3.0 * t) if t < 0.5 else 0.0
        return knee(POSE, POSE[KNEE] + swing)

    assert found(stopping, stopping, 1.5)[0] is Reason.NONE


def test_links_on_a_stand_may_be_clamped() -> None:
    hung = replace(LIMITS, operating=replace(LIMITS.operating, tilt=math.inf))

    def swinging(t: float) -> np.ndarray:
        return knee(POSE, POSE[KNEE] + 0.7 * math.sin(2.0 * math.pi * 3.0 * t))

    assert found(standing, swinging, 1.0, limits=hung)[0] is Reason.NONE


def turned(angle: float) -> Callable[[State], State]:
    """An inertial unit that is turned about the vertical."""
    cosine = math.cos(angle)
    sine = math.sin(angle)
    rotation = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    def report(state: State) -> State:
        w, x, y, z = state.orientation
        c = math.cos(0.5 * angle)
        s = math.sin(0.5 * angle)
        # The attitude times a rotation about the trunk's z axis.
        attitude = np.array([c * w - s * z, c * x + s * y, c * y - s * x, c * z + s * w])
        return replace(
            state,
            gyro=rotation @ state.gyro,
            accelerometer=rotation @ state.accelerometer,
            orientation=attitude,
        )

    return report


def mirrored_unit(state: State) -> State:
    """An inertial unit whose y axis points the other way, which agrees with itself."""
    return replace(
        state,
        gyro=state.gyro * [-1.0, 1.0, -1.0],
        accelerometer=state.accelerometer * [1.0, -1.0, 1.0],
        orientation=state.orientation * [1.0, -1.0, 1.0, -1.0],
    )


def mirrored_rolls(state: State) -> State:
    """Hip rolls are reported with the other sign."""
    signs = np.tile([-1.0, 1.0, 1.0], 4)
    return replace(state, position=signs * state.position, velocity=signs * state.velocity)


def started(report: Callable[[State], State]) -> tuple[Reason, Mode]:
    """The reason and the mode after a virtual robot stood up and was requested to walk."""
    robot = connected(base="ground", capture_rate_hz=None)
    safety = SafetyFilter(limits=LIMITS)
    modes = StateMachine(ROBOT, RunTiming())
    modes.enter(Mode.DAMP, 0.0)
    modes.request(OperatorRequest.STAND)
    for tick in range(1, 3500):
        t = tick * DT
        states = [report(state) for state in robot.wait(t)]
        if modes.mode is Mode.STAND:
            modes.request(OperatorRequest.WALK)
        desired = modes.step(t, states[-1].position, safety, None)
        if modes.mode is Mode.POLICY or safety.faulted:
            break
        if desired.command is None:
            safety.damped()
            robot.damp()
            continue
        sent, _ = safety.judge(states, desired.command, t)
        if sent is None:
            break
        robot.send(sent)
    return safety.reason, modes.mode


@pytest.mark.parametrize(
    "report", [turned(0.5 * math.pi), turned(math.pi), mirrored_unit, mirrored_rolls]
)
def test_a_wrong_orientation_is_found_before_the_first_step(
    report: Callable[[State], State],
) -> None:
    reason, mode = started(report)
    assert reason is Reason.ORIENTATION
    assert mode is not Mode.POLICY


def test_a_right_orientation_may_walk() -> None:
    assert started(lambda state: state) == (Reason.NONE, Mode.POLICY)
