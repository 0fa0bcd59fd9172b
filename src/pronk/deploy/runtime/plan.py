"""The plan of one run, given to each of its processes at the start, and the machine it opens."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from pronk.arrays import Array
from pronk.deploy.links.address import Address
from pronk.deploy.links.link import ClampOperator, Freshness, LinkSettings
from pronk.deploy.links.realtime import RealTimeSettings
from pronk.deploy.runtime.limits import AgeLimits, Limits
from pronk.deploy.runtime.poses import RunTiming
from pronk.deploy.runtime.sweep import STALE_S, SweepTask
from pronk.errors import HardwareError
from pronk.policy.deploy_yaml import read_deploy_yaml
from pronk.robots import load_robot
from pronk.robots.machine import Machine, TorqueKind
from pronk.robots.robot import RobotSpec

# Priorities of SCHED_FIFO: the servo first, all below the kernel's own threads at 99.
SERVO_PRIORITY = 60
STANDBY_PRIORITY = 55
POLICY_PRIORITY = 50


@dataclass(frozen=True, kw_only=True)
class Link:
    """A robot at an address.

    It is pickled with the plan and sent to each process. The servo connects the machine; over a
    network the standby process makes one too, to open a transport of its own.
    """

    robot: str
    """Name or path of the robot."""
    address: Address = field(default_factory=Address)
    """Address of the machine."""
    release: bool = False
    """Whether the robot's own controller is disabled first."""
    fresh: Freshness = field(default_factory=Freshness)
    """How fresh states must be at first."""

    def __call__(self, clamp_operator: ClampOperator | None = None) -> Machine:
        """Make the machine, not yet connected.

        HardwareError if the link's library is not installed.
        """
        settings = LinkSettings(
            clamp_operator=clamp_operator, release=self.release, fresh=self.fresh
        )
        return self.address.machine(load_robot(self.robot), settings)

    def __str__(self) -> str:
        return str(self.address)


@runtime_checkable
class TrajectoryMachine(Machine, Protocol):
    """A machine that can record its own trajectory besides its states, as the virtual robot can."""

    def keep_trajectory(self) -> None:
        """Keep the trajectory from the connection on."""

    def save_trajectory(self, path: Path) -> None:
        """Write the trajectory; an OSError or PronkError if that is not possible."""


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """One run: a policy or a sweep on a machine."""

    link: Link
    """Robot of the run."""
    policy: Path | None = None
    """The policy, policy.onnx; None for a sweep."""
    deploy_yaml: Path | None = None
    """Unitree's deploy.yaml of a policy that was trained elsewhere; None for one of pronk."""
    sweep: SweepTask | None = None
    """The sweep; None for a policy."""
    log: Path | None = None
    """File of a policy's log, MCAP; None for no log."""
    trajectory: Path | None = None
    """File of the machine's trajectory, written at the end; None for none."""
    tilt: float | None = None
    """Largest angle of the trunk from the vertical [rad]; None for that of the robot's file."""
    ages: AgeLimits | None = None
    """How old states and commands may be; None for the usual."""
    timing: RunTiming = field(default_factory=RunTiming)
    """Times of standing up, starting the policy and sitting down."""
    servo_rate_hz: float = 500.0
    """Ticks of the servo per second [Hz]."""
    action_valid_s: float = 0.05
    """Time for which an action of the policy is repeated: two and a half steps [s]."""
    operator_timeout_s: float = 0.3
    """Time for which the heartbeat of the operator's program may be missing [s]. A program that was
    killed or stopped is noticed after it. The heartbeat of one that hangs goes on for
    `run._STALL_S`, 0.7 s, so it is noticed after the sum, by default 1.0 s."""
    standby_s: float = 0.04
    """Silence of the servo after which the standby process damps the joints [s]."""
    ignore_latency: bool = False
    """Whether the policy starts even if the measured latency exceeds its training range."""
    real_time: bool = True
    """Whether real-time scheduling, a core and locked memory are requested."""

    def __post_init__(self) -> None:
        """Refuse a plan without a task, and times that are not positive."""
        if (self.policy is None) == (self.sweep is None):
            raise HardwareError("a run needs either a policy or a sweep.")
        numbers = {
            "servo_rate_hz": self.servo_rate_hz,
            "action_valid_s": self.action_valid_s,
            "operator_timeout_s": self.operator_timeout_s,
            "standby_s": self.standby_s,
        }
        for name, number in numbers.items():
            if not number > 0.0:
                raise HardwareError(f"RunPlan.{name} is {number}; it must be positive.")

    @property
    def robot(self) -> RobotSpec:
        """The robot of the link."""
        if self.sweep is not None:
            return self.sweep.plan.robot
        return load_robot(self.link.robot)

    def limits(self, torque_kind: TorqueKind = "absent") -> Limits:
        """Return the limits of the safety filter, for a machine with such torques."""
        limits = Limits.of(self.robot)
        if self.sweep is not None:
            limits = self.sweep.limits(torque_kind)
        if self.tilt is not None:
            limits = replace(limits, operating=replace(limits.operating, tilt=self.tilt))
        if self.ages is not None:
            limits = replace(limits, ages=self.ages)
        return limits

    def policy_gains(self) -> tuple[Array, Array]:
        """Return the stiffness and damping that the drives have under the policy, (joints,).

        They are those of the drives themselves, whatever gains the policy was trained with, or
        those of `deploy.yaml`, with which such a policy is run by its makers.

        Raises:
            ArtefactError: The file cannot be read.
        """
        if self.deploy_yaml is not None:
            deploy = read_deploy_yaml(self.deploy_yaml)
            return np.array(deploy.stiffness), np.array(deploy.damping)
        joints = self.robot.joints
        stiffness = np.array([joint.stiffness for joint in joints])
        return stiffness, np.array([joint.damping for joint in joints])

    @property
    def silence_s(self) -> float:
        """Silence of the servo that is a fault [s]; in a sweep that of the states, if longer."""
        return self.standby_s if self.sweep is None else max(self.standby_s, STALE_S)

    def real_time_settings(self, priority: int, core: int) -> RealTimeSettings:
        """Return what a process requests of the operating system."""
        if not self.real_time:
            return RealTimeSettings(lock=False)
        return RealTimeSettings(priority=priority, core=core)
