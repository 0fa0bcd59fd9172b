"""The plan of one run, given to each of its processes at the start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pronk.errors import HardwareError
from pronk.links.realtime import Wanted
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.link import Opener
from pronk.runtime.safety import Limits
from pronk.runtime.sweep import SweepTask
from pronk.runtime.trajectories import Timing

SERVO_PRIORITY, POLICY_PRIORITY = 60, 50
"""Of SCHED_FIFO: the servo before the policy, both below the kernel's own threads' 99."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One run: a policy or a sweep on a machine."""

    link: Opener
    policy: Path | None = None
    sweep: SweepTask | None = None
    """Instead of a policy."""
    log: Path | None = None
    """MCAP file; None for no log."""
    capture: Path | None = None
    """What the cameras around the virtual robot saw, written at the end; None for nothing."""
    limits: Mapping[str, float] = field(default_factory=dict)
    """Other values for the scalar fields of `Limits`."""
    timing: Timing = field(default_factory=Timing)
    servo_rate_hz: float = 500.0
    action_valid_s: float = 0.05
    """How long an action of the policy is repeated: two steps and a half [s]."""
    operator_timeout_s: float = 0.3
    """How long the operator's program may be silent [s]."""
    ignore_latency: bool = False
    """Let the policy take over whatever the latency."""
    real_time: bool = True
    """Ask for real-time scheduling, a core and locked memory."""

    def __post_init__(self) -> None:
        """Refuse what cannot run.

        Raises:
            HardwareError: Names the field.
        """
        if (self.policy is None) == (self.sweep is None):
            raise HardwareError("a run needs either a policy or a sweep.")
        for name in ("servo_rate_hz", "action_valid_s", "operator_timeout_s"):
            if not getattr(self, name) > 0.0:
                raise HardwareError(f"Plan.{name} is {getattr(self, name)}; it must be positive.")

    @property
    def robot(self) -> Robot:
        """What the link's machine is."""
        return load_robot(self.link.robot) if self.sweep is None else self.sweep.plan.robot

    def safety(self) -> Limits:
        """The limits of the safety filter."""
        if self.sweep is not None:
            return self.sweep.limits("absent", **self.limits)
        return Limits.of(self.robot, **self.limits)

    def wanted(self, priority: int, core: int) -> Wanted:
        """What a process asks of the operating system."""
        return Wanted(priority=priority, core=core) if self.real_time else Wanted(lock=False)
