"""What every link to a robot does alike, whatever the wire.

Before anything is written, states are fresh and nobody else commands; a joint is fixed by the
virtual robot itself or by a person; and at the end the robot is damped until it is at rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from pronk.errors import HardwareError
from pronk.links.machine import State
from pronk.links.preflight import WINDOW_S, Freshness, check_rate
from pronk.robots.robot import Robot

Hand = Callable[[tuple[str, ...]], None]
"""A person at the bench: told which joints to fix, returns when they are."""

ANSWER_S = 2.0
"""How long a robot is given to be heard at first, or to answer a request [s]."""
_LOOK_S = 0.002
"""Between two looks at something that is waited for."""
_DAMP_AT_LEAST_S, _DAMP_AT_MOST_S = 1.0, 3.0
_AT_REST = 0.5
"""Joint speed below which a robot that is being left counts as at rest [rad/s]."""


def waited_for(done: Callable[[], bool], seconds: float = ANSWER_S) -> bool:
    """Wait until something is so, at most `seconds`; whether it is."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end:
            return False
        time.sleep(_LOOK_S)
    return True


def fresh_states(
    robot: str,
    wait: Callable[[float], list[State]],
    rate_hz: float,
    fresh: Freshness | None,
    *,
    until: float,
) -> list[State]:
    """Watch the states of one window after another until they come often enough, without gaps.

    Args:
        robot: Its name.
        wait: `Machine.wait` of its link.
        rate_hz: Expected.
        fresh: What is asked; as `Freshness` has it if None.
        until: Windows that end no later are forgiven, on the local monotonic clock [s].

    Returns:
        The states of the first window that is good.

    Raises:
        HardwareError: None was by then.
    """
    while True:
        wait(0.0)  # those of before
        states = wait(time.monotonic() + WINDOW_S)
        try:
            check_rate(robot, states, rate_hz, fresh)
        except HardwareError:
            # A busy computer may lose its breath; a robot that is too slow never has it.
            if time.monotonic() > until:
                raise
        else:
            return states


def check_alone(foreign: int, topic: str, watched_s: float) -> None:
    """Nobody else commands the joints while pronk only listens.

    Args:
        foreign: Commands of others that were met.
        topic: Where.
        watched_s: In this time [s].

    Raises:
        HardwareError: Somebody does.
    """
    if foreign:
        raise HardwareError(
            f"someone else commands the joints: {foreign} commands on {topic} within "
            f"{watched_s:g} s; stop that program, or release the robot's own controller."
        )


def check_still_alone(foreign: int, topic: str) -> None:
    """Nobody else has begun to command the joints beside pronk.

    Args:
        foreign: Commands of others that were met.
        topic: Where.

    Raises:
        HardwareError: Somebody has.
    """
    if foreign:
        raise HardwareError(
            f"another program commands the joints on {topic} ({foreign} commands met); stop it, "
            "and connect again."
        )


def clamp(
    robot: Robot,
    joints: tuple[str, ...],
    *,
    hold: Callable[[tuple[str, ...]], bool] | None,
    hand: Hand | None,
) -> None:
    """Have joints fixed: by the virtual robot itself, or by a person's hand.

    Args:
        robot: Whose joints.
        joints: Their names; () frees all.
        hold: Asks the virtual robot; whether it confirmed. None for a real one.
        hand: Who fixes joints of a real one; None if nobody.

    Raises:
        RobotError: A joint is unknown.
        HardwareError: Nobody is there to fix them, or no answer came.
    """
    for name in joints:
        robot.joint(name)
    if hold is not None:
        if not hold(joints):
            raise HardwareError(
                f"the virtual robot did not confirm its clamps within {ANSWER_S:g} s; check that "
                "`pronk simulate` still runs."
            )
    elif hand is not None:
        hand(joints)
    elif joints:
        raise HardwareError(
            f"{', '.join(joints)} must be fixed mechanically and nobody is at the bench; ask "
            "joints that need no clamp, or have someone there who confirms it."
        )


def await_rest(latest: Callable[[], State | None]) -> None:
    """Wait until a robot that is being damped is at rest: 1 s at least, 3 s at most.

    Args:
        latest: Its newest state; None counts as at rest.
    """
    begun = time.monotonic()
    while (spent := time.monotonic() - begun) < _DAMP_AT_MOST_S:
        state = latest()
        speed = np.abs(state.velocity).max() if state is not None else 0.0
        if spent >= _DAMP_AT_LEAST_S and speed < _AT_REST:
            break
        time.sleep(_LOOK_S)
