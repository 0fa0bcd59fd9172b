"""The virtual robot in real time, a person at the stick.

Where nothing waits for the wall's clock, it runs 3.1 times faster than real time without a page,
2.4 with one, and 3.0 with one and a client that takes its 27 messages a second (12 s at 1 m/s each,
two cores shared with other work). Paced it keeps real time: 0.99, setting down included.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pronk.evaluation.live.gamepad import Gamepad
from pronk.evaluation.live.joystick import Stick
from pronk.evaluation.live.readout import Gauge, Hop
from pronk.links.machine import State
from pronk.policy.runtime import Policy
from pronk.robots.robot import Robot
from pronk.runtime.rollout import ticks
from pronk.virtual.capture import Capture
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.sim_params import SimParams

_SEE_S = 0.004
"""From look to look at the robot; a lift-off speed is off by less than 4 cm/s for it."""
_LATE_S = 0.25
"""Delay that is not made up for: the robot then runs late instead of faster than real time."""
_WINDOW_S = 2.0
"""Over which the real-time factor is taken."""


class Page(Protocol):
    """What shows the robot to a person."""

    def show(self, sample: Capture) -> None:
        """Draw the robot as it is now; called once a policy step."""

    def tell(self, gauge: Gauge, factor: float) -> None:
        """Write figures, and simulated seconds per second; called once a policy step."""


class Watched(VirtualRobot):
    """A virtual robot that somebody looks at while it runs."""

    seen: Callable[[Capture], None] | None = None

    def wait(self, until: float) -> list[State]:
        """As the robot's own; looks at it every 4 ms on the way."""
        states: list[State] = []
        while (now := self.now()) < until:
            states += super().wait(min(until, now + _SEE_S))
            if self.seen is not None:
                self.seen(self.snapshot())
        return states


@dataclass(frozen=True, kw_only=True)
class Played:
    """What there was to see."""

    simulated_s: float
    wall_s: float
    resets: int
    hops: tuple[Hop, ...]

    @property
    def factor(self) -> float:
        """Simulated seconds per second."""
        return self.simulated_s / self.wall_s if self.wall_s > 0.0 else 0.0


def play(
    robot: Robot,
    policy: Policy,
    sim_params: SimParams,
    stick: Stick,
    page: Page,
    *,
    gamepad: Gamepad | None = None,
    seed: int = 0,
    until: Callable[[float], bool] = lambda simulated: False,
) -> Played:
    """Run the robot in real time until Ctrl-C.

    A fallen robot goes on being simulated until somebody resets it.

    Args:
        robot: Structure.
        policy: Whose contract fits the robot.
        sim_params: Body of the virtual robot.
        stick: Operator command.
        page: Where it is shown.
        gamepad: Read once a policy step.
        seed: Of all noise.
        until: Called with the simulated time [s]; true ends the game.

    Raises:
        ArtefactError: The contract does not fit.
        HardwareError: The robot cannot stand.
        RobotError: The parameters are not of this robot.
    """
    gauge, pace = Gauge(), Pace()
    machine = Watched(robot, sim_params, base="ground", seed=seed, capture_rate_hz=None)
    began, simulated, resets, over = time.perf_counter(), 0.0, 0, False
    try:
        while not over:
            machine.seen = None
            machine.connect()
            machine.seen = gauge.see
            gauge.forget()
            pace.start()
            before = simulated
            for tick in ticks(machine, policy, robot, stick.commanded):
                simulated = before + tick.since
                if gamepad is not None:
                    stick.feel(gamepad.read())
                page.show(machine.snapshot())
                page.tell(gauge, pace.factor)
                over = until(simulated)
                again = stick.take_reset()
                if over or again:
                    resets += again
                    break
                pace.keep(tick.since)
    except KeyboardInterrupt:
        pass  # how a person ends the game
    finally:
        machine.close()
    return Played(
        simulated_s=simulated,
        wall_s=time.perf_counter() - began,
        resets=resets,
        hops=tuple(gauge.hops),
    )


class Pace:
    """Keeps simulated time with the wall's clock."""

    def __init__(self) -> None:
        self.factor = 1.0
        """Simulated seconds per second, of late."""
        self.start()

    def start(self) -> None:
        """The simulated clock is at zero now."""
        self._zero = time.perf_counter()
        self._mark = (self._zero, 0.0)

    def keep(self, simulated: float) -> None:
        """Sleep until it is time for a moment of the simulation [s]."""
        ahead = self._zero + simulated - time.perf_counter()
        if ahead > 0.0:
            time.sleep(ahead)
        elif ahead < -_LATE_S:
            self._zero -= ahead
        now = time.perf_counter()
        wall, then = self._mark
        if now - wall >= _WINDOW_S:
            self.factor = (simulated - then) / (now - wall)
            self._mark = (now, simulated)
