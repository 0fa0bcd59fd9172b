"""`python -m benchmarks sensor-faults`: from a sensor's fault to damping on the wire.

The processes of `pronk deploy` walk the virtual robot over LCM and DDS in real time. A fault of
`SENSOR_FAULTS` begins at a moment of the robot's choice; the time to the first command that damps
is on the virtual robot's own clock. Then the fault ends, is reset, and the robot stands up again.
A run in which something else damped, as on a busy computer, is repeated.

With `--minutes` the robot walks without a fault instead: what damps it, the memory and the handles
of each process, and the lateness of the servo. Its link may then also be `sim`.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, finish
from pronk.cli import console
from pronk.cli.simulate import _PRIORITY, _SERVERS
from pronk.errors import HardwareError
from pronk.links.address import Address
from pronk.links.realtime import Wanted, enter
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
    # A robot does not depend on how busy this computer is.
    enter(Wanted(priority=_PRIORITY, lock=False))
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
def served(link: str) -> Iterator[tuple[Address, Connection | None]]:
    """A virtual robot on the ground in a process of its own: its address, and its other end.

    Of the link `sim`, whose robot is in the servo's process, the address alone.
    """
    if link == "sim":
        yield Address.parse("sim://ground"), None
        return
    if link == "lcm":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", 0))
            options = {"port": int(probe.getsockname()[1])}
    else:
        options = {"domain": 100 + os.getpid() % 50}
    context = get_context("spawn")
    end, other = context.Pipe()
    process = context.Process(
        target=_serve, args=(link, options, other), name="virtual robot", daemon=True
    )
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
            assert robot is not None
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


ROAM = (0.6, 0.2, 0.5)
"""Largest commands of a walk without a fault: forward, left [m/s], yaw rate [rad/s]."""
_ROW_S = 30.0
_FALLS = ("TILT", "SPEED", "OVERRUN", "OVERLOAD")
"""Faults that a robot's own motion may cause."""


def endure(
    policy: Path, link: str, minutes: float, seed: int, progress: Progress, out: Path | None
) -> dict[str, Any]:
    """Walk without a fault under commands that change every two seconds.

    Returns the time walked [s]; time and text of each fault; memory [MB] and open handles by
    process, every 30 s since the robot first walked; and figures of each deployment. A robot that
    has fallen is replaced. `out` is written as the rows come.
    """
    rng = np.random.default_rng([29, seed])
    walked, faults, rows = 0.0, list[tuple[float, str, str]](), list[dict[str, Any]]()
    runs = list[dict[str, Any]]()
    while walked < 60.0 * minutes and len(runs) < TRIES + len(faults):
        with served(link) as (address, _):
            plan = Plan(
                link=Link(robot=ROBOT, address=address),
                policy=policy,
                timing=TIMING,
                ignore_latency=True,
            )
            with suppress(HardwareError), Deployment(plan) as deployment:
                while walked < 60.0 * minutes and _walk(deployment):
                    begun, due = time.monotonic(), 0.0
                    while deployment.mode is Mode.POLICY and walked < 60.0 * minutes:
                        velocity = tuple((rng.uniform(-1.0, 1.0, 3) * ROAM).tolist())
                        _until(deployment, 2.0, (Mode.FAULT, Mode.ENDED), command=velocity)
                        passed = time.monotonic() - begun
                        walked, begun = walked + passed, begun + passed
                        for event in deployment.events_seen():
                            if event.kind == "fault":
                                faults.append((walked, event.reason, event.text))
                        if begun >= due:
                            due = begun + _ROW_S
                            rows.append({"walked_s": walked, "processes": _processes()})
                        if out is not None and rows:
                            kept = {"link": link, "faults": faults, "rows": rows, "runs": runs}
                            out.write_text(json.dumps(kept | {"walked_s": walked}))
                        progress(link, walked / (60.0 * minutes))
            runs.append(deployment.summary.figures())
    return {"link": link, "walked_s": walked, "faults": faults, "rows": rows, "runs": runs}


def _processes() -> dict[str, tuple[float, int]]:
    """Memory [MB] and open handles of each process of a run, and of this one."""
    found = {}
    known = {"operator": os.getpid(), **{each.name: each.pid for each in active_children()}}
    for name, pid in known.items():
        with suppress(OSError):
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            handles = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
            found[name] = (pages * os.sysconf("SC_PAGE_SIZE") / 1e6, handles)
    return found


def _endured(walks: list[dict[str, Any]]) -> console.Outcome:
    """Print what a walk without faults took and met."""
    cells = []
    for walk in walks:
        for seconds, reason, text in walk["faults"]:
            console.say(f"{walk['link']}, {seconds:.0f} s, {reason}: {text}")
        falls = sum(reason in _FALLS for _, reason, _ in walk["faults"])
        late = [run["servo"]["lateness"] for run in walk["runs"] if run["servo"]]
        common = f"{walk['walked_s'] / 60.0:.1f}", str(len(walk["faults"]) - falls), str(falls)
        times = [f"{max(each[key] for each in late):.2f}" for key in ("p50_ms", "p99_ms", "max_ms")]
        cells.append((walk["link"], *common, *times, "", ""))
        for name in walk["rows"][-1]["processes"]:
            kept = [row["processes"][name] for row in walk["rows"] if name in row["processes"]]
            (first, opened), (last, open_) = kept[min(2, len(kept) - 1)], kept[-1]
            sizes = f"{first:.1f} to {last:.1f}", f"{opened} to {open_}"
            cells.append((f"  {name}", *[""] * 6, *sizes))
    columns = ["link", "minutes", "false alarms", "falls", "late: median [ms]", "99 %", "largest"]
    columns += ["memory from the second minute on [MB]", "handles"]
    return finish({"walks": walks}, console.table("Walking without a fault", columns, cells))


def sensor_faults(
    policy: tyro.conf.Positional[Path],
    runs: int = 10,
    links: str = "lcm,dds",
    minutes: float = 0.0,
    seed: int = 0,
    out: Path | None = None,
) -> console.Outcome:
    """Time from each sensor fault to damping on the wire, over LCM and DDS in real time.

    Args:
        policy: policy.onnx that walks.
        runs: With each fault and link.
        links: lcm, dds, separated by commas; sim too with `--minutes`.
        minutes: Of walking without a fault over each link, in place of the faults.
        seed: Of the commands of that walk.
        out: File in JSON for that walk, written as it goes.
    """
    if minutes > 0.0:
        with console.progress() as report:
            walks = [endure(policy, link, minutes, seed, report, out) for link in links.split(",")]
        return _endured(walks)
    cells, figures = [], {}
    with console.progress() as report:
        for link in links.split(","):
            figures[link] = rows = measure(policy, link, FAULTS, runs, report)
            for fault, row in rows.items():
                times = 1e3 * np.array(row["times_s"])
                reasons = ", ".join(row["reasons"])
                numbers = f"{np.median(times):.0f}", f"{times.max():.0f}", str(len(times))
                cells.append((fault, link, *numbers, reasons))
    columns = ["fault", "link", "median [ms]", "worst [ms]", "n", "reasons"]
    return finish(figures, console.table("From a fault to damping", columns, cells))
