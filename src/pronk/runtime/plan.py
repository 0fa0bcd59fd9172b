"""What a deployment is made of: everything that its processes are told when they start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pronk.errors import HardwareError
from pronk.links.realtime import Wanted
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.limits import Limits
from pronk.runtime.link import Opener
from pronk.runtime.records import EVENT, NEWS, ORDERS, STEP, STICK, TICK
from pronk.runtime.shared import Mailbox, Ring
from pronk.runtime.trajectories import Timing

SERVO_PRIORITY, POLICY_PRIORITY = 60, 50
"""Of SCHED_FIFO: the servo before the policy, both below the kernel's own threads' 99."""

_TICKS, _STEPS, _EVENTS = 2048, 256, 256
"""Room of the queues to the logger: four seconds."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A deployment."""

    link: Opener
    policy: Path
    log: Path | None = None
    """MCAP file; None for no log."""
    capture: Path | None = None
    """What the cameras around the virtual robot saw, written at the end; None for nothing."""
    limits: Mapping[str, float] = field(default_factory=dict)
    """Other values for the scalar fields of `Limits`."""
    timing: Timing = field(default_factory=Timing)
    servo_rate_hz: float = 500.0
    order_valid_s: float = 0.05
    """How long an order of the policy is repeated: two steps and a half [s]."""
    stick_valid_s: float = 0.3
    """How long the operator's program may be silent [s]."""
    any_delay: bool = False
    """Let the policy take over whatever the latency."""
    real_time: bool = True
    """Ask for real-time scheduling, a core and locked memory."""

    def __post_init__(self) -> None:
        """Refuse what cannot run.

        Raises:
            HardwareError: Names the field.
        """
        for name in ("servo_rate_hz", "order_valid_s", "stick_valid_s"):
            if not getattr(self, name) > 0.0:
                raise HardwareError(f"Plan.{name} is {getattr(self, name)}; it must be positive.")

    @property
    def robot(self) -> Robot:
        """What the link's machine is."""
        return load_robot(self.link.robot)

    def safety(self) -> Limits:
        """The limits of the safety filter."""
        return Limits.of(self.robot, **self.limits)

    def wanted(self, priority: int, core: int) -> Wanted:
        """What a process asks of the operating system."""
        return Wanted(priority=priority, core=core) if self.real_time else Wanted(lock=False)


@dataclass(frozen=True)
class Names:
    """Of the shared memory."""

    news: str
    orders: str
    stick: str
    ticks: str
    steps: str
    events: str
    troubles: str
    notices: str


class Shared:
    """The shared memory of a deployment, made by its first process and attached by the others."""

    def __init__(self, names: Names | None = None) -> None:
        """Make it, or attach to what has these names."""

        def called(which: str) -> str | None:
            return None if names is None else str(getattr(names, which))

        self.news = Mailbox(NEWS, called("news"))
        """Servo to all."""
        self.orders = Mailbox(ORDERS, called("orders"))
        """Policy to servo."""
        self.stick = Mailbox(STICK, called("stick"))
        """Operator to servo and policy."""
        self.ticks = Ring(TICK, _TICKS, called("ticks"))
        """Servo to logger."""
        self.steps = Ring(STEP, _STEPS, called("steps"))
        """Policy to logger."""
        self.events = Ring(EVENT, _EVENTS, called("events"))
        """Servo to logger."""
        self.troubles = Ring(EVENT, _EVENTS, called("troubles"))
        """Policy to logger."""
        self.notices = Ring(EVENT, _EVENTS, called("notices"))
        """Servo to operator."""

    @property
    def names(self) -> Names:
        """For the processes that attach."""
        return Names(**{name: block.name for name, block in self._blocks().items()})

    def dropped(self) -> dict[str, int]:
        """Records that found no room on their way to the logger."""
        queues = {"ticks": self.ticks, "steps": self.steps, "events": self.events}
        return {name: ring.dropped for name, ring in queues.items()}

    def close(self) -> None:
        """Let go of everything."""
        for block in self._blocks().values():
            block.close()

    def _blocks(self) -> dict[str, Any]:
        return dict(vars(self))
