"""Deployments that are struck by a fault: from its begin to damping on the wire.

The processes of `pronk deploy` move a virtual robot over LCM or DDS in real time: the Mini Cheetah
walks; the Go2, for which no policy was trained, squats, sways and pitches on its feet
(`write_swaying`). A fault of `SENSOR_FAULTS` or `PROCESSES` begins; the time to the first command
that damps is on the virtual robot's own clock. Then the fault ends, is reset, and the robot stands
up again. A run that ends for want of processor time (`BUSY`) is repeated.
"""

from __future__ import annotations

import math
import os
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pronk.deploy.bench.faults import SENSOR_FAULTS, SWAPPED
from pronk.deploy.bench.server import RobotServer, ServerTransport
from pronk.deploy.links.address import Address
from pronk.deploy.links.realtime import RealTimeSettings, enter
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.poses import RunTiming
from pronk.deploy.runtime.records import Event
from pronk.deploy.runtime.run import Deployment
from pronk.deploy.runtime.teleop import OperatorCommand
from pronk.errors import HardwareError
from pronk.jump.virtual.robot import VirtualRobot, hold_of
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.script import STILL, Velocity
from pronk.processes import die_with_parent
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from tests.dds_domain import own_domain
from tests.deploy_runs import LATE
from tests.linear_policy import stiff_go2, write_swaying

WALKING_ROBOT = "mini_cheetah"
"""The robot that walks; any other sways."""
PROCESSES = {
    "policy-stopped": ("policy", signal.SIGSTOP),
    "policy-killed": ("policy", signal.SIGKILL),
    "servo-stopped": ("servo", signal.SIGSTOP),
    "servo-killed": ("servo", signal.SIGKILL),
}
"""Process of a `Deployment`, and the signal that it gets."""
BUSY = (
    *(reason.name for reason in LATE),
    "CLOCK",
    "LINK",
    "STANDBY",
    # The robot's program stood still for some tenths of a second, or again and again for a moment.
    "ROBOT_CLOCK",
    "INTERRUPTED",
)
"""Reasons of a computer that is too busy, but for faults of a clock."""
FOUND_S = 3.0
"""Time for which a fault is waited for [s]."""
REFUSED = "refused"
"""Reason of a robot that the pre-flight refuses: nothing is sent to it."""
WALK = (0.6, 0.0, 0.0)
"""Command of a walking robot: forward, left [m/s], yaw rate [rad/s]."""
SWAY_HZ = (1.5, 1.1, 1.9)
"""Frequencies of the three commands of a robot that sways [Hz]."""
SWAY = 0.5
"""Their amplitude: joints move by 0.2 to 0.7 rad, the trunk tilts by up to 0.2."""
WALK_S = 1.0
"""Time of walking before a fault begins [s]."""
TRIES = 4
"""Deployments that are tried for a fault."""
TIMING = RunTiming(damp_s=0.3, fold_s=0.5, check_s=0.0, rise_s=0.8)
RISE_S = TIMING.fold_s + TIMING.rise_s + 0.2
"""Time in which the robot stands up [s]."""
_ROBOT_PRIORITY = 30
"""Real-time priority of the virtual robot, below that of the commanding processes."""


def _wire(robot: RobotSpec, link: str, options: dict[str, Any]) -> ServerTransport:
    """The wire behind which a virtual robot is."""
    if link.startswith("lcm"):
        from pronk.deploy.bench.lcm_server import LcmServerTransport

        layout = "wtw" if link == "lcm-wtw" else "cheetah"
        return LcmServerTransport(robot, mode="", port=options["port"], layout=layout)
    from pronk.deploy.bench.dds_server import DdsServerTransport

    return DdsServerTransport(robot, mode="", domain=options["domain"])


def _serve(name: str, link: str, options: dict[str, Any], end: Connection) -> None:
    """Body of the robot's process; receives faults, and sends the time to damping."""
    die_with_parent()
    # A robot does not depend on how busy this computer is.
    enter(RealTimeSettings(priority=_ROBOT_PRIORITY, lock=False))
    robot = load_robot(name)
    machine = VirtualRobot(robot, load_sim_params(None, robot), base="ground", capture_rate_hz=None)
    machine.connect()
    server = RobotServer(machine, _wire(robot, link, options), hold=hold_of(robot))
    end.send(None)

    def stop() -> bool:
        if end.poll():
            word = end.recv()
            if word == "stop":
                return True
            if word == "damped":
                end.send(server.damped_s)
            else:
                server.spoil(word)
        return False

    server.run(stop)


def free_port() -> int:
    """A UDP port that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


@contextmanager
def served(robot: str, link: str) -> Iterator[tuple[Address, Connection | None]]:
    """A virtual robot on the ground in a process of its own: its address, and its other end.

    `lcm-wtw` is LCM in the layout `wtw`, which carries the robot's own time.

    Of the link `sim`, whose robot is in the servo's process, the address alone.
    """
    if link == "sim":
        yield Address.parse("sim://ground"), None
        return
    options: dict[str, Any] = {"domain": own_domain()}
    if link.startswith("lcm"):
        options = {"port": free_port()}
    context = get_context("spawn")
    end, other_end = context.Pipe()
    process = context.Process(
        target=_serve, args=(robot, link, options, other_end), name="virtual robot", daemon=True
    )
    process.start()
    other_end.close()
    try:
        end.recv()
        if link == "lcm-wtw":
            options["layout"] = "wtw"
        yield Address(scheme=link.partition("-")[0], options=options), end
    finally:
        process.kill()
        process.join()


def stand_still(t: float) -> Velocity:
    """No command."""
    return STILL


def walk_on(t: float) -> Velocity:
    """The command of a robot that walks."""
    return WALK


def sway(t: float) -> Velocity:
    """The commands of a robot that sways, at a time [s]."""
    height, roll, pitch = (SWAY * math.sin(2.0 * math.pi * hz * t) for hz in SWAY_HZ)
    return height, roll, pitch


def motion_of(deployment: Deployment) -> Callable[[float], Velocity]:
    """The commands of a deployment's robot at a time [s]."""
    return walk_on if deployment.plan.link.robot == WALKING_ROBOT else sway


def drive_until(
    deployment: Deployment,
    seconds: float,
    modes: tuple[Mode, ...],
    request: OperatorRequest = OperatorRequest.NONE,
    command: Callable[[float], Velocity] = stand_still,
) -> bool:
    """Hold the dead-man button until one of some modes comes; whether it came."""
    now = time.monotonic()
    until = now + seconds
    while now < until:
        deployment.write(OperatorCommand(dead_man=True, request=request, command=command(now)))
        request = OperatorRequest.NONE
        if deployment.mode in modes:
            return True
        time.sleep(0.01)
        now = time.monotonic()
    return False


def begin_to_walk(deployment: Deployment) -> bool:
    """From wherever it is to walking; whether it walks."""
    if deployment.mode is Mode.FAULT:
        drive_until(deployment, 1.1, ())
        drive_until(deployment, 5.0, (Mode.DAMP,), OperatorRequest.RESET)
    if not drive_until(deployment, 5.0, (Mode.STAND, Mode.FAULT), OperatorRequest.STAND):
        return False
    drive_until(deployment, RISE_S, (Mode.FAULT,))
    if not drive_until(deployment, 5.0, (Mode.POLICY, Mode.FAULT), OperatorRequest.WALK):
        return False
    drive_until(deployment, WALK_S, (Mode.FAULT, Mode.ENDED), command=motion_of(deployment))
    return deployment.mode is Mode.POLICY


@dataclass(frozen=True)
class Strike:
    """What came of a fault."""

    fault: str
    """Name of the fault."""
    time_s: float
    """Time to damping [s]; NaN if the fault was not found."""
    reason: str
    """Reason of the filter, `REFUSED`, `not found` or `not measured`."""


def strike(plan: RunPlan, robot: Connection, faults: list[str]) -> list[Strike]:
    """Strike a moving robot with faults, one after the other.

    A fault that is not found within `FOUND_S` has the time NaN. Of swapped legs the time is that
    from the request to stand. Ends early where the robot does not walk, the computer is too busy, a
    process is gone, or the pre-flight refuses the robot (`REFUSED`).
    """
    if faults[0] in SWAPPED:
        plan = replace(plan, timing=replace(TIMING, check_s=RunTiming().check_s))
        with Deployment(plan) as deployment:
            result = _strike_standing(deployment, robot, faults[0])
        return [] if result is None else [result]
    strikes: list[Strike] = []
    with Deployment(plan) as deployment:
        for fault in faults:
            # Swapped encoders need a robot that has not stood up.
            if fault in SWAPPED or not begin_to_walk(deployment):
                break
            result = _strike_walking(deployment, robot, fault)
            if result is None:
                break
            strikes.append(result)
            ends_a_process = fault in PROCESSES and fault != "policy-stopped"
            if result.reason == "not found" or ends_a_process:
                break
    return strikes


def _strike_standing(deployment: Deployment, robot: Connection, fault: str) -> Strike | None:
    """Have a robot with swapped encoders stand up; None if the computer was too busy."""
    events: list[Event] = []
    robot.send(fault)
    begun = time.monotonic()
    passed = 0.0
    request = OperatorRequest.STAND
    while passed < 5.0:
        over = drive_until(deployment, 0.02, (Mode.FAULT, Mode.ENDED), request)
        request = OperatorRequest.NONE
        events += deployment.events_seen()
        if any(event.kind == "refused" for event in events):
            return Strike(fault, passed, REFUSED)
        if over:
            break
        passed = time.monotonic() - begun
    is_damped = _damped_s(deployment, robot, 0.0) is not None
    drive_until(deployment, 0.1, ())
    robot.send(None)
    events += deployment.events_seen()
    return _result(deployment, fault, events, passed if is_damped else None)


def _strike_walking(deployment: Deployment, robot: Connection, fault: str) -> Strike | None:
    """Strike a robot that walks; None if the computer was too busy."""
    deployment.events_seen()
    robot.send(fault if fault.partition("@")[0] in SENSOR_FAULTS else "")
    stopped: int | None = None
    if fault in PROCESSES:
        process_name, number = PROCESSES[fault]
        process = deployment.policy if process_name == "policy" else deployment.servo
        assert process is not None
        assert process.pid is not None
        os.kill(process.pid, number)
        if number == signal.SIGSTOP:
            stopped = process.pid
    damped_s = _damped_s(deployment, robot, FOUND_S)
    drive_until(deployment, 0.1, ())
    if stopped is not None and fault == "policy-stopped":
        os.kill(stopped, signal.SIGCONT)
    robot.send(None)
    return _result(deployment, fault, deployment.events_seen(), damped_s)


def _damped_s(deployment: Deployment, robot: Connection, seconds: float) -> float | None:
    """Wait for damping on the wire; the time from the fault to it [s], None if it did not come."""
    due = time.monotonic() + seconds
    damped_s: float | None = None
    while damped_s is None:
        drive_until(deployment, 0.1, (), command=motion_of(deployment))
        robot.send("damped")
        damped_s = robot.recv()
        if time.monotonic() >= due:
            break
    return damped_s


def _result(
    deployment: Deployment, fault: str, events: list[Event], seconds: float | None
) -> Strike | None:
    """What came of a fault, by its events; None if the computer was too busy."""
    reasons = [event.reason for event in events if event.kind == "fault"]
    if fault.startswith("servo") and deployment.shared.standby.written:
        reasons = ["STANDBY"]
    if seconds is None or not reasons:
        return Strike(fault, math.nan, "not found")
    # A clock that stands still stops the numbers of the states over DDS, and so the states.
    if reasons[0] in BUSY and "@" not in fault and not fault.startswith(("policy", "servo")):
        return None
    return Strike(fault, seconds, reasons[0])


def measure(
    robot: str, policy: Path, link: str, faults: tuple[str, ...], **plan_fields: Any
) -> list[Strike]:
    """Time to damping and reason of each fault over a link; `plan_fields` are of the `RunPlan`.

    A fault that could not begin in `TRIES` deployments, because the robot did not walk or the
    computer was too busy, has the reason `not measured`.
    """
    waiting = list(faults)
    strikes: list[Strike] = []
    failures = 0
    while waiting:
        results: list[Strike] = []
        # A robot of its own each time: one that has fallen may not stand up again.
        with tempfile.TemporaryDirectory() as folder, suppress(HardwareError), ExitStack() as stack:
            robot_file = robot
            network = policy
            if robot != WALKING_ROBOT:
                robot_file = str(stiff_go2(Path(folder) / robot))
                network = write_swaying(Path(folder) / "policy.onnx", load_robot(robot_file))
            address, end = stack.enter_context(served(robot_file, link))
            assert end is not None
            plan = RunPlan(
                link=Link(robot=robot_file, address=address),
                policy=network,
                timing=TIMING,
                ignore_latency=True,
                **plan_fields,
            )
            results = strike(plan, end, waiting)
        if results:
            failures = 0
        else:
            failures += 1
        if failures == TRIES:
            results = [Strike(waiting[0], math.nan, "not measured")]
        for result in results:
            waiting.remove(result.fault)
            strikes.append(result)
    return strikes
