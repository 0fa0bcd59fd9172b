"""The plan of one run, given to each of its processes at the start, and the machine it opens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from pronk.deploy.links.address import Address
from pronk.deploy.links.link import ClampOperator, Freshness
from pronk.deploy.links.realtime import Wanted
from pronk.deploy.runtime.safety import Limits
from pronk.deploy.runtime.state_machine import Timing
from pronk.deploy.runtime.sweep import STALE_S, SweepTask
from pronk.errors import HardwareError
from pronk.robots import load_robot
from pronk.robots.machine import Machine, TorqueKind
from pronk.robots.robot import RobotSpec

SERVO_PRIORITY, STANDBY_PRIORITY, POLICY_PRIORITY = 60, 55, 50
"""Of SCHED_FIFO: the servo first, all below the kernel's own threads at 99."""


@dataclass(frozen=True, kw_only=True)
class Link:
    """A robot at an address. It is pickled and sent to the servo's process."""

    robot: str
    address: Address = field(default_factory=Address)
    release: bool = False
    """Disable the robot's own controller first."""
    fresh: Freshness | None = None
    """How fresh states must be at first; the usual if None."""

    def __call__(self, clamp_operator: ClampOperator | None = None) -> Machine:
        """Make the machine, not yet connected.

        HardwareError if the link's library is not installed.
        """
        return self.address.machine(
            load_robot(self.robot),
            clamp_operator=clamp_operator,
            release=self.release,
            fresh=self.fresh,
        )

    def __str__(self) -> str:
        return str(self.address)


class MachineRecorder(Protocol):
    """Recorder of what a machine does besides its states; whoever makes the plan hands it in."""

    def prepare(self, machine: Machine) -> None:
        """Have a machine that is not connected yet keep what is recorded."""

    def save(self, machine: Machine) -> None:
        """Write what was recorded, once the run is over; an OSError or PronkError is reported."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One run: a policy or a sweep on a machine."""

    link: Link
    policy: Path | None = None
    sweep: SweepTask | None = None
    """Instead of a policy."""
    log: Path | None = None
    """MCAP file; None for no log."""
    recorder: MachineRecorder | None = None
    """Recorder of the machine's trajectory; None for none."""
    limits: Mapping[str, float] = field(default_factory=dict)
    """Other values for the scalar fields of `Limits`."""
    timing: Timing = field(default_factory=Timing)
    servo_rate_hz: float = 500.0
    action_valid_s: float = 0.05
    """How long an action of the policy is repeated: two and a half steps [s]."""
    operator_timeout_s: float = 0.3
    """How long the operator's program may be silent [s]."""
    standby_s: float = 0.04
    """Silence of the servo after which the standby process damps the joints [s]."""
    ignore_latency: bool = False
    """Start the policy even if the measured latency exceeds its training range."""
    real_time: bool = True
    """Request real-time scheduling, a core and locked memory."""

    def __post_init__(self) -> None:
        if (self.policy is None) == (self.sweep is None):
            raise HardwareError("a run needs either a policy or a sweep.")
        for name in ("servo_rate_hz", "action_valid_s", "operator_timeout_s", "standby_s"):
            if not getattr(self, name) > 0.0:
                raise HardwareError(f"Plan.{name} is {getattr(self, name)}; it must be positive.")

    @property
    def robot(self) -> RobotSpec:
        """The robot of the link."""
        return load_robot(self.link.robot) if self.sweep is None else self.sweep.plan.robot

    def safety(self, torque_kind: TorqueKind = "absent") -> Limits:
        """The limits of the safety filter, for a machine with such torques."""
        if self.sweep is not None:
            return self.sweep.limits(torque_kind, **self.limits)
        return Limits.of(self.robot, **self.limits)

    @property
    def silence_s(self) -> float:
        """Silence of the servo that is a fault; in a sweep that of the states, which is longer."""
        return self.standby_s if self.sweep is None else max(self.standby_s, STALE_S)

    def wanted(self, priority: int, core: int) -> Wanted:
        """What a process requests of the operating system."""
        return Wanted(priority=priority, core=core) if self.real_time else Wanted(lock=False)
