"""What every link does alike, without a wire: fresh states, others who command, clamps, rest."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from pronk.errors import HardwareError, RobotError
from pronk.links import link_checks as link_rules
from pronk.links.link_checks import (
    await_rest,
    check_alone,
    check_still_alone,
    clamp,
    fresh_states,
    waited_for,
)
from pronk.links.machine import State
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")


class Clock:
    """A clock that only sleeping moves on."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(link_rules, "time", made)
    return made


def state(when: float = 0.0, speed: float = 0.0) -> State:
    return State(
        time=when,
        sequence=0,
        position=np.zeros(12),
        velocity=np.full(12, -speed),
        torque=np.zeros(12),
        gyro=np.zeros(3),
        accelerometer=np.array([0.0, 0.0, 9.81]),
        bus_voltage=24.0,
    )


def watched(*windows: int) -> tuple[Callable[[float], list[State]], list[float]]:
    """A link's `wait` that gives so many states a window, and when it was asked to wait until."""
    left, asked = list(windows), list[float]()

    def wait(until: float) -> list[State]:
        asked.append(until)
        return [state(0.002 * k) for k in range(left.pop(0))] if until else [state()]

    return wait, asked


def test_something_is_waited_for_and_given_up(clock: Clock) -> None:
    assert waited_for(lambda: clock.now > 1.5)
    assert clock.now == pytest.approx(1.5, abs=0.01)
    assert not waited_for(lambda: False, 0.5)
    assert clock.now == pytest.approx(2.0, abs=0.01)


def test_a_computer_that_was_busy_is_forgiven() -> None:
    wait, asked = watched(20, 0, 100)
    found = fresh_states("it", wait, 500.0, None, until=math.inf)
    assert len(found) == 100
    # Before each window, what had come until then is thrown away.
    assert [until == 0.0 for until in asked] == [True, False] * 3


def test_a_robot_that_is_too_slow_is_not() -> None:
    wait, asked = watched(20, 100)
    with pytest.raises(HardwareError, match="it sent 20 fresh states in 200 ms"):
        fresh_states("it", wait, 500.0, None, until=0.0)
    assert len(asked) == 2


def test_others_who_command_are_named() -> None:
    check_alone(0, "rt/lowcmd", 1.0)
    check_still_alone(0, "rt/lowcmd")
    with pytest.raises(HardwareError) as before:
        check_alone(3, "rt/lowcmd", 0.3)
    assert str(before.value) == (
        "someone else commands the joints: 3 commands on rt/lowcmd within 0.3 s; stop that "
        "program, or release the robot's own controller."
    )
    with pytest.raises(HardwareError) as since:
        check_still_alone(3, "rt/lowcmd")
    assert str(since.value) == (
        "another program commands the joints on rt/lowcmd (3 commands met); stop it, and connect "
        "again."
    )


def test_who_fixes_a_joint() -> None:
    asked: list[tuple[str, ...]] = []

    def confirm(joints: tuple[str, ...]) -> bool:
        asked.append(joints)
        return "FR_knee" in joints

    # The virtual robot does it itself, whoever stands by.
    clamp(ROBOT, ("FR_knee",), hold=confirm, hand=lambda _: pytest.fail("a person was asked"))
    with pytest.raises(
        HardwareError, match=r"did not confirm its clamps within 2 s; .* still runs"
    ):
        clamp(ROBOT, (), hold=confirm, hand=None)
    clamp(ROBOT, ("FL_knee",), hold=None, hand=asked.append)
    assert asked == [("FR_knee",), (), ("FL_knee",)]
    # Nobody: only what needs no clamp.
    clamp(ROBOT, (), hold=None, hand=None)
    with pytest.raises(HardwareError, match="FL_knee, FR_knee must be fixed mechanically"):
        clamp(ROBOT, ("FL_knee", "FR_knee"), hold=None, hand=None)
    for hold, hand in ((confirm, None), (None, asked.append)):
        with pytest.raises(RobotError, match="no joint 'tail'"):
            clamp(ROBOT, ("FR_knee", "tail"), hold=hold, hand=hand)
    assert len(asked) == 3


@pytest.mark.parametrize(
    ("newest", "takes"),
    [
        (lambda now: None, 1.0),
        (lambda now: state(speed=0.4), 1.0),
        (lambda now: state(speed=5.0 if now < 1.7 else 0.0), 1.7),
        (lambda now: state(speed=0.6), 3.0),
        (lambda now: state(speed=math.nan), 3.0),
    ],
    ids=["no state", "slow enough", "in between", "never", "not a number"],
)
def test_a_robot_is_left_at_rest(
    newest: Callable[[float], State | None], takes: float, clock: Clock
) -> None:
    await_rest(lambda: newest(clock.now))
    assert clock.now == pytest.approx(takes, abs=0.01)
