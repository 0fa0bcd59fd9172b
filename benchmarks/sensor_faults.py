"""`python -m benchmarks sensor-faults`: from a sensor's fault to damping on the wire.

The processes of `pronk deploy` walk the virtual robot over LCM and DDS in real time. A fault of
`SENSOR_FAULTS` begins at a moment of the robot's choice; the time to the first command that damps
is on the virtual robot's own clock. Then the fault ends, is reset, and the robot stands up again.
A run in which something else damped, as on a busy computer, is repeated.
"""

from __future__ import annotations

import os
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, finish
from pronk.cli import console
from pronk.cli.simulate import _SERVERS
from pronk.errors import HardwareError
from pronk.links.address import Address
from pronk.processes import die_with_parent
from pronk.robots import load_robot
from pronk.runtime.ipc import Mode, OperatorRequest
from pronk.runtime.plan import Link, Plan
from pronk.runtime.run import Deployment
from pronk.runtime.safety import Reason
from pronk.runtime.state_machine import Timing
from pronk.runtime.teleop import OperatorCommand
from pronk.virtual.faults import SENSOR_FAULTS
from pronk.virtual.robot import VirtualRobot, hold_of
from pronk.virtual.server import RobotServer
from pronk.virtual.sim_params import load_sim_params

ROBOT = "mini_cheetah"
FAULTS = tuple(name for name in SENSOR_FAULTS if name != "legs-swapped")
FOUND = (Reason.REPEATED.name, Reason.ATTITUDE.name, Reason.ENCODER.name)
WALK = (0.6, 0.0, 0.0)
"""Forward, left [m/s], yaw rate [rad/s]."""
WALK_S = 1.0
"""Before a fault begins [s]."""
TRIES = 4
"""For each run."""
TIMING = Timing(damp_s=0.3, fold_s=0.5, check_s=0.0, rise_s=0.8)
RISE_S = TIMING.fold_s + TIMING.rise_s + 0.2
"""In which the robot stands up [s]."""


def _serve(link: str, options: dict[str, int], end: Connection) -> None:
    """Body of the robot's process; receives faults, and sends the time to damping."""
    die_with_parent()
    robot = load_robot(ROBOT)
    machine = VirtualRobot(robot, load_sim_params(None, robot), base="ground", capture_rate_hz=None)
    machine.connect()
    server = RobotServer(
        machine, resolve_name(_SERVERS[link])(robot, mode="", **options), hold=hold_of(robot)
    )
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


@contextmanager
def served(link: str) -> Iterator[tuple[Address, Connection]]:
    """A virtual robot on the ground in a process of its own: its address, and its other end."""
    if link == "lcm":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", 0))
            options = {"port": int(probe.getsockname()[1])}
    else:
        options = {"domain": 100 + os.getpid() % 50}
    context = get_context("spawn")
    end, other = context.Pipe()
    process = context.Process(target=_serve, args=(link, options, other), daemon=True)
    process.start()
    try:
        end.recv()
        yield Address(kind=link, options=options), end
    finally:
        process.kill()
        process.join()


def _until(deployment: Deployment, seconds: float, modes: tuple[Mode, ...], **more: Any) -> bool:
    """Hold the dead-man button until one of some modes comes; whether it came."""
    until = time.monotonic() + seconds
    request = more.pop("request", OperatorRequest.NONE)
    while time.monotonic() < until:
        deployment.write(OperatorCommand(held=True, request=request, **more))
        request = OperatorRequest.NONE
        if deployment.mode in modes:
            return True
        time.sleep(0.01)
    return False


def _walk(deployment: Deployment) -> bool:
    """From wherever it is to walking; whether it walks."""
    if deployment.mode is Mode.FAULT:
        _until(deployment, 1.1, ())
        _until(deployment, 5.0, (Mode.DAMP,), request=OperatorRequest.RESET)
    for mode, request in (
        (Mode.STAND, OperatorRequest.STAND),
        (Mode.POLICY, OperatorRequest.WALK),
    ):
        if not _until(deployment, 5.0, (mode, Mode.FAULT), request=request):
            return False
        if mode is Mode.STAND:
            _until(deployment, RISE_S, (Mode.FAULT,))
    _until(deployment, WALK_S, (Mode.FAULT, Mode.ENDED), command=WALK)
    return deployment.mode is Mode.POLICY


def strike(plan: Plan, robot: Connection, faults: list[str]) -> list[tuple[str, float, str]]:
    """Name, time to damping on the robot's clock [s] and reason of faults, one after the other.

    Ends early where the robot does not walk, or something else damps.
    """
    rows: list[tuple[str, float, str]] = []
    with Deployment(plan) as deployment:
        for fault in faults:
            if not _walk(deployment):
                break
            deployment.events_seen()
            robot.send(fault)
            _until(deployment, 2.0, (Mode.FAULT, Mode.ENDED), command=WALK)
            _until(deployment, 0.1, ())
            robot.send("damped")
            damped = robot.recv()
            robot.send(None)
            reasons = [each.reason for each in deployment.events_seen() if each.kind == "fault"]
            if reasons and reasons[0] in FOUND and damped is not None:
                rows.append((fault, float(damped), reasons[0]))
            else:
                break
    return rows


def measure(
    policy: Path,
    link: str,
    faults: tuple[str, ...],
    runs: int,
    progress: Progress,
    **more: Any,
) -> dict[str, dict[str, Any]]:
    """Times to damping [s] and reasons of each fault over a link; `more` is of the `Plan`.

    Raises:
        HardwareError: A fault was not found in `TRIES` deployments in a row.
    """
    left = [fault for _ in range(runs) for fault in faults]
    whole, failed = len(left), 0
    found: dict[str, dict[str, Any]] = {
        fault: {"times_s": [], "reasons": Counter()} for fault in faults
    }
    while left:
        rows: list[tuple[str, float, str]] = []
        # A robot of its own each time: one that has fallen may not stand up again.
        with served(link) as (address, robot), suppress(HardwareError):
            plan = Plan(
                link=Link(robot=ROBOT, address=address),
                policy=policy,
                timing=TIMING,
                ignore_latency=True,
                **more,
            )
            rows = strike(plan, robot, left)
        for fault, seconds, reason in rows:
            left.remove(fault)
            found[fault]["times_s"].append(seconds)
            found[fault]["reasons"][reason] += 1
        failed = 0 if rows else failed + 1
        if failed == TRIES:
            raise HardwareError(
                f"{left[0]} was not found over {link} in {TRIES} runs; see that this computer is "
                "idle."
            )
        progress(link, 1.0 - len(left) / whole)
    return found


def sensor_faults(
    policy: tyro.conf.Positional[Path], runs: int = 10, links: tuple[str, ...] = ("lcm", "dds")
) -> console.Outcome:
    """Time from each sensor fault to damping on the wire, over LCM and DDS in real time.

    Args:
        policy: policy.onnx that walks.
        runs: With each fault and link.
        links: lcm, dds.
    """
    cells, figures = [], {}
    with console.progress() as report:
        for link in links:
            figures[link] = rows = measure(policy, link, FAULTS, runs, report)
            for fault, row in rows.items():
                times = 1e3 * np.array(row["times_s"])
                reasons = ", ".join(row["reasons"])
                numbers = f"{np.median(times):.0f}", f"{times.max():.0f}", str(len(times))
                cells.append((fault, link, *numbers, reasons))
    columns = ["fault", "link", "median [ms]", "worst [ms]", "n", "reasons"]
    return finish(figures, console.table("From a fault to damping", columns, cells))
