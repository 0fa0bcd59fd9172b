"""`python -m benchmarks sensor-faults`: from a fault to damping on the wire.

The processes of `pronk deploy` move a virtual robot over LCM and DDS in real time: the Mini Cheetah
walks; the Go2, for which no policy was trained, squats, sways and pitches on its feet
(`write_swaying`). A fault of `SENSOR_FAULTS` or `PROCESSES` begins; the time to the first command
that damps is on the virtual robot's own clock. Then the fault ends, is reset, and the robot stands
up again. A run that ends for want of processor time (`BUSY`) is repeated. `--docs` writes the table
of faults in docs.

With `--minutes` the robot walks without a fault instead: what damps it, the memory and the handles
of each process, and the lateness of the servo. Its link may then also be `sim`.
"""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, Row, finish, rows_in, rows_of
from pronk.cli import console
from pronk.cli.simulate import _PRIORITY, _SERVERS
from pronk.deploy.bench.faults import SENSOR_FAULTS, SWAPPED
from pronk.deploy.bench.server import RobotServer
from pronk.deploy.links.address import Address
from pronk.deploy.links.realtime import Wanted, enter
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
from tests.linear_policy import stiff_go2, write_swaying

ROBOT = "mini_cheetah"
PROCESSES = {
    "policy-stopped": ("policy", signal.SIGSTOP),
    "policy-killed": ("policy", signal.SIGKILL),
    "servo-stopped": ("servo", signal.SIGSTOP),
    "servo-killed": ("servo", signal.SIGKILL),
}
"""Process of a `Deployment`, and what it gets."""
FAULTS = (*SENSOR_FAULTS, *PROCESSES)
BUSY = ("NO_STATE", "STATE_LOST", "HELD", "EXPIRED", "LAG", "CLOCK", "ENDED", "LINK", "STANDBY")
"""Reasons of a computer that is too busy."""
FOUND_S = 3.0
"""For which a fault is waited for [s]."""
REFUSED = "refused"
"""Reason of a robot that the pre-flight refuses: nothing is sent to it."""
BAR_S = 0.1
"""From a fault to damping [s]."""
WALK = (0.6, 0.0, 0.0)
"""Forward, left [m/s], yaw rate [rad/s]."""
SWAY_HZ = (1.5, 1.1, 1.9)
"""Of the three commands of a robot that sways."""
SWAY = 0.5
"""Their amplitude: joints move by 0.2 to 0.7 rad, the trunk tilts by up to 0.2."""
WALK_S = 1.0
"""Before a fault begins [s]."""
TRIES = 4
"""For each run."""
TIMING = RunTiming(damp_s=0.3, fold_s=0.5, check_s=0.0, rise_s=0.8)
RISE_S = TIMING.fold_s + TIMING.rise_s + 0.2
"""In which the robot stands up [s]."""


def _serve(name: str, link: str, options: dict[str, int], end: Connection) -> None:
    """Body of the robot's process; receives faults, and sends the time to damping."""
    die_with_parent()
    # A robot does not depend on how busy this computer is.
    enter(Wanted(priority=_PRIORITY, lock=False))
    robot = load_robot(name)
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
def served(robot: str, link: str) -> Iterator[tuple[Address, Connection | None]]:
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
        target=_serve, args=(robot, link, options, other), name="virtual robot", daemon=True
    )
    process.start()
    other.close()
    try:
        end.recv()
        yield Address(kind=link, options=options), end
    finally:
        process.kill()
        process.join()


def _until(
    deployment: Deployment,
    seconds: float,
    modes: tuple[Mode, ...],
    request: OperatorRequest = OperatorRequest.NONE,
    command: Callable[[float], Velocity] = lambda t: STILL,
) -> bool:
    """Hold the dead-man button until one of some modes comes; whether it came."""
    until = time.monotonic() + seconds
    while (now := time.monotonic()) < until:
        deployment.write(OperatorCommand(dead_man=True, request=request, command=command(now)))
        request = OperatorRequest.NONE
        if deployment.mode in modes:
            return True
        time.sleep(0.01)
    return False


def _sway(t: float) -> Velocity:
    x, y, z = (SWAY * math.sin(2.0 * math.pi * hz * t) for hz in SWAY_HZ)
    return x, y, z


def _motion(deployment: Deployment) -> Callable[[float], Velocity]:
    """Commands of a robot at a time [s]."""
    return (lambda t: WALK) if deployment.plan.link.robot == ROBOT else _sway


def _walk(deployment: Deployment) -> bool:
    """From wherever it is to walking; whether it walks."""
    if deployment.mode is Mode.FAULT:
        _until(deployment, 1.1, ())
        _until(deployment, 5.0, (Mode.DAMP,), OperatorRequest.RESET)
    for mode, request in (
        (Mode.STAND, OperatorRequest.STAND),
        (Mode.POLICY, OperatorRequest.WALK),
    ):
        if not _until(deployment, 5.0, (mode, Mode.FAULT), request):
            return False
        if mode is Mode.STAND:
            _until(deployment, RISE_S, (Mode.FAULT,))
    _until(deployment, WALK_S, (Mode.FAULT, Mode.ENDED), command=_motion(deployment))
    return deployment.mode is Mode.POLICY


def strike(plan: RunPlan, robot: Connection, faults: list[str]) -> list[tuple[str, float, str]]:
    """Name, time to damping on the robot's clock [s] and reason of faults, one after the other.

    A fault that is not found within `FOUND_S` has the time NaN. Of swapped legs the time is that
    from the request to stand. Ends early where the robot does not walk, the computer is too busy, a
    process is gone, or the pre-flight refuses the robot (`REFUSED`).
    """
    rows: list[tuple[str, float, str]] = []
    if faults[0] in SWAPPED:
        plan = replace(plan, timing=replace(TIMING, check_s=RunTiming().check_s))
    with Deployment(plan) as deployment:
        for fault in faults:
            events = list[Event]()
            if fault in SWAPPED and rows:
                break  # it needs a robot that has not stood up
            if fault in SWAPPED:
                robot.send(fault)
                begun, request = time.monotonic(), OperatorRequest.STAND
                while (passed := time.monotonic() - begun) < 5.0:
                    over = _until(deployment, 0.02, (Mode.FAULT, Mode.ENDED), request)
                    request = OperatorRequest.NONE
                    events += deployment.events_seen()
                    if any(each.kind == "refused" for each in events):
                        rows.append((fault, passed, REFUSED))
                        return rows
                    if over:
                        break
            elif not _walk(deployment):
                break
            else:
                deployment.events_seen()
                robot.send(fault if fault in SENSOR_FAULTS else "")
            struck = None
            if fault in PROCESSES:
                name, number = PROCESSES[fault]
                struck = getattr(deployment, name).pid
                os.kill(struck, number)
            damped: float | None = None
            due = time.monotonic() + (0.0 if fault in SWAPPED else FOUND_S)
            while damped is None:
                _until(deployment, 0.1, (), command=_motion(deployment))
                robot.send("damped")
                damped = robot.recv()
                if time.monotonic() >= due:
                    break
            _until(deployment, 0.1, ())
            if struck is not None and fault == "policy-stopped":
                os.kill(struck, signal.SIGCONT)
            robot.send(None)
            events += deployment.events_seen()
            reasons = [each.reason for each in events if each.kind == "fault"]
            if fault.startswith("servo") and deployment.shared.standby.written:
                reasons = ["STANDBY"]
            if damped is None or not reasons:
                rows.append((fault, math.nan, "not found"))
                break
            if reasons[0] in BUSY and not fault.startswith(("policy", "servo")):
                break
            rows.append((fault, passed if fault in SWAPPED else damped, reasons[0]))
            if fault in SWAPPED or (struck is not None and fault != "policy-stopped"):
                break
    return rows


def measure(
    robot: str,
    policy: Path,
    link: str,
    faults: tuple[str, ...],
    run: int,
    **more: Any,
) -> list[Row]:
    """Time to damping [s] and reason of each fault over a link, once; `more` is of the `Plan`.

    A fault that could not begin in `TRIES` deployments, because the robot did not walk or the
    computer was too busy, has the reason `not measured`.
    """
    left, rows, failed = list(faults), list[Row](), 0
    while left:
        found: list[tuple[str, float, str]] = []
        # A robot of its own each time: one that has fallen may not stand up again.
        with tempfile.TemporaryDirectory() as folder, suppress(HardwareError), ExitStack() as stack:
            known, network = robot, policy
            if robot != ROBOT:
                known = str(stiff_go2(Path(folder) / robot))
                network = write_swaying(Path(folder) / "policy.onnx", load_robot(known))
            address, end = stack.enter_context(served(known, link))
            assert end is not None
            plan = RunPlan(
                link=Link(robot=known, address=address),
                policy=network,
                timing=TIMING,
                ignore_latency=True,
                **more,
            )
            found = strike(plan, end, left)
        failed = 0 if found else failed + 1
        if failed == TRIES:
            found = [(left[0], math.nan, "not measured")]
        for fault, seconds, reason in found:
            left.remove(fault)
            common = {"robot": robot, "link": link, "fault": fault, "run": run}
            rows.append({**common, "time_s": seconds, "reason": reason})
    return rows


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
        with served(ROBOT, link) as (address, _):
            plan = RunPlan(
                link=Link(robot=ROBOT, address=address),
                policy=policy,
                timing=TIMING,
                ignore_latency=True,
            )
            with suppress(HardwareError), Deployment(plan) as deployment:
                while walked < 60.0 * minutes and _walk(deployment):
                    begun, due = time.monotonic(), 0.0
                    while deployment.mode is Mode.POLICY and walked < 60.0 * minutes:
                        x, y, z = (rng.uniform(-1.0, 1.0, 3) * ROAM).tolist()
                        now: Velocity = (x, y, z)
                        _until(
                            deployment,
                            2.0,
                            (Mode.FAULT, Mode.ENDED),
                            command=lambda t, now=now: now,  # type: ignore[misc]
                        )
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


def page(rows: list[Row], command: str) -> str:
    """The page of the table of faults in docs."""
    groups = sorted({(row["robot"], row["link"]) for row in rows}, reverse=True)
    head = ["fault", *(f"{robot}, {link}" for robot, link in groups), "reasons"]
    table, missed = [head, ["---"] * len(head)], []
    for fault in FAULTS:
        cells, reasons = [], set[str]()
        for robot, link in groups:
            mine = [r for r in rows if (r["robot"], r["link"], r["fault"]) == (robot, link, fault)]
            done = [row for row in mine if row["reason"] != "not measured"]
            times = [1e3 * row["time_s"] for row in done if not math.isnan(row["time_s"])]
            reasons |= {row["reason"] for row in done if not math.isnan(row["time_s"])}
            lost = len(done) - len(times)
            cell = f"{np.median(times):.0f} ({max(times):.0f})" if times else ""
            cell += f", {lost} of {len(done)} not found" if lost else ""
            cell += f", n = {len(done)}" if done else "not measured"
            cells.append(cell.removeprefix(", "))
            late = sum(each > 1e3 * BAR_S for each in times) if fault not in SWAPPED else 0
            if lost or late or not done:
                where = f"`{fault}` ({robot}, {link})"
                missed.append(f"{where}: {late} of {len(done)} later, {lost} not found")
        table.append([f"`{fault}`", *cells, ", ".join(f"`{each}`" for each in sorted(reasons))])
    lines = "\n".join("| " + " | ".join(row) + " |" for row in table)
    bar = f"{1e3 * BAR_S:.0f} ms"
    failures = "".join(f"- {each}\n" for each in missed) or f"All within {bar}.\n"
    return f"""# Faults and damping

Written by `{command}`; do not edit.

From the begin of a fault to the first command that damps, at the virtual robot and on its clock, in
ms: median (worst). All over loopback, in real time. The Mini Cheetah walks with the shipped policy.
For the Go2, of which no policy was trained, a linear one squats, sways and pitches on four feet, at
the stiffness of Unitree's stand example (60 N m/rad).
The joint of the faults of one encoder is a hip roll, which moves and is loaded least. The time of
swapped legs and joints is that from the request to stand; the robot has not risen. `refused` is of
the pre-flight, after which nothing is sent. A stopped or killed servo is followed by the standby
process. What it takes to find a fault is in [hardware.md](hardware.md).

{lines}

## Longer than {bar}, or not found

{failures}
## What cannot be seen

- A constant encoder of a joint whose load does not change while no other joint moves: the robot
  stands still. It is found once the others have moved by 0.05 rad in sum.
- An encoder at zero whose joint rests at zero, until its velocity says that it moved by 0.005 rad.
- A stuck attitude of a trunk that hardly turns, until the gyro says that it turned by 0.03 rad.
- Hip roll and hip pitch of one leg swapped with each other: a knee swings before the robot rises.
- Swapped encoders in a sweep, before their joint is excited.
"""


def sensor_faults(
    policy: tyro.conf.Positional[Path],
    runs: int = 10,
    robots: str = "mini_cheetah,go2",
    links: str = "lcm,dds",
    minutes: float = 0.0,
    seed: int = 0,
    jobs: int = 1,
    out: Path | None = None,
    docs: Path | None = None,
) -> console.Outcome:
    """Time from each fault to damping on the wire, over LCM and DDS in real time.

    Args:
        policy: policy.onnx of the Mini Cheetah that walks.
        runs: With each fault, robot and link.
        robots: mini_cheetah, go2, separated by commas.
        links: lcm, dds, separated by commas; sim too with `--minutes`.
        minutes: Of walking without a fault over each link, in place of the faults.
        seed: Of the commands of that walk.
        jobs: Runs at a time, each of which takes two cores; more than 1 without real-time priority.
        out: File of rows in JSON, written as they come; faults go on from those that are there.
        docs: Page to write.
    """
    if minutes > 0.0:
        with console.progress() as report:
            walks = [endure(policy, link, minutes, seed, report, out) for link in links.split(",")]
        return _endured(walks)
    rows = rows_in(out)
    known = {(row["robot"], row["link"], row["run"], row["fault"]) for row in rows}
    work = []
    for run in range(runs):
        for robot in robots.split(","):
            for link in links.split(","):
                left = tuple(f for f in FAULTS if (robot, link, run, f) not in known)
                part = partial(measure, robot, policy, link, left, run, real_time=jobs == 1)
                work += [part] if left else []
    whole = len(rows) + sum(len(part.args[3]) for part in work)
    with console.progress() as report:
        for row in rows_of(work, jobs, out):
            rows.append(row)
            report("faults", len(rows) / whole)
    command = f"python -m benchmarks sensor-faults POLICY --runs {runs} --docs {docs}"
    text = page(rows, command)
    if docs is not None:
        docs.write_text(text, encoding="utf-8")
    console.say(text)
    return console.Outcome(figures={"rows": rows}, wrote=[] if docs is None else [docs])
