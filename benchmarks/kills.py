"""Processes of commands killed and stopped at random moments: files, orphans, damping.

Each run starts a command, kills or stops one of its processes at a moment of its time, and looks
when it has ended: every file that is there is whole (a log is readable up to its end), no process
is left, and where a robot was commanded over LCM, the last command damps.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pronk.cli import console
from pronk.deploy.links.address import Address
from pronk.deploy.links.lcm.codec import decode_lcm_command
from pronk.deploy.links.lcm.layouts import CHEETAH
from pronk.deploy.links.lcm.link import url_of
from pronk.deploy.runtime.deploy_log import is_deploy_log, read_deploy_log
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.run import Deployment
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.files import read_yaml
from pronk.identify.logs.readers import read_log
from pronk.identify.match.result import load_match
from pronk.jump.trial import results
from pronk.jump.virtual import capture
from pronk.tables import Cell, Column, Table
from tests.deploy_strikes import TIMING, WALKING_ROBOT, begin_to_walk, drive_until, motion_of

Program = Literal["sweep", "sweep-lcm", "match", "trial", "deploy"]
PROGRAMS: tuple[Program, ...] = ("sweep", "sweep-lcm", "match", "trial", "deploy")
ACTIONS = ("KILL", "TERM", "STOP CONT", "STOP KILL")
MOVING = ("operator", "servo", "policy", "root")
"""Processes without which the joints must be damped."""
STOPPED_S = 0.5
"""Time for which a process is stopped [s]."""
ENDS_S = 10.0
"""Longest time until the other processes have ended [s]."""
DAMPED_S = 0.5
"""Longest time until damping [s]."""
COLUMNS = {
    "program": Column(heading="program"),
    "process": Column(heading="process"),
    "n": Column(heading="n"),
    "faults": Column(heading="faults"),
    "aside": Column(heading="aside"),
    "traceback": Column(heading="traceback"),
    "damped_s": Column(heading="damped after at most", unit="s"),
    "ends_s": Column(heading="all ended after at most", unit="s", digits=2),
}
"""Columns of the table by the names of the counts."""
_JOINTS = ("FR_hip_pitch", "FR_knee", "FL_hip_pitch", "FL_knee")
_EMPTY = 2**16
"""A log of at most so many bytes may hold no sample yet."""
_POLICY = Path(__file__).parents[1] / "policies" / "matched" / "policy.onnx"


def operate(port: int, log: str) -> None:
    """Walk a virtual robot over LCM until SIGTERM; prints its processes when it walks."""
    link = Link(robot=WALKING_ROBOT, address=Address(scheme="lcm", options={"port": port}))
    plan = RunPlan(link=link, policy=_POLICY, timing=TIMING, ignore_latency=True, log=Path(log))
    with Deployment(plan) as deployment:
        if not begin_to_walk(deployment):
            sys.exit("it does not walk")
        pids = {"operator": os.getpid()}
        for name, process in (
            ("servo", deployment.servo),
            ("policy", deployment.policy),
            ("logger", deployment.logger),
            ("standby", deployment.standby),
        ):
            assert process is not None
            assert process.pid is not None
            pids[name] = process.pid
        print(json.dumps(pids), flush=True)
        drive_until(deployment, 30.0, (), command=motion_of(deployment))


def _words(program: Program, folder: Path, port: int) -> list[str]:
    """The command line of a program."""
    if program == "deploy":
        # Not as a module: the processes that it starts would import all of this one.
        log = str(folder / "run.mcap")
        return ["-c", f"from benchmarks.kills import operate; operate({port}, {log!r})"]
    logs = str(folder.parent / "logs")
    joints = [word for joint in _JOINTS for word in ("--joints", joint)]
    short = ["--signal", "log-chirp", "--amplitude", "0.25", "--repeats", "1"]
    out = ["--out", str(folder / ("gains.yaml" if program == "match" else "out"))]
    name = WALKING_ROBOT
    wire = ["--link", "lcm", "--port", str(port), "--yes"]
    jumps = ["--jumps", "2", "--commands", "1.5,0", "--commands", "2.25,0", "--processes", "2"]
    commands = {
        "sweep": ["sweep", name, *joints, *short],
        "sweep-lcm": ["sweep", name, *wire, *joints[:2], *short],
        "match": ["match", logs, "--robot", name, "--method", "paper"],
        "trial": ["trial", str(_POLICY), *jumps, "--no-video"],
    }
    return ["-m", "pronk.cli.main", *commands[program], *out]


def _start(words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )


@dataclass(frozen=True)
class _Process:
    pid: int
    born: str
    """Tells it from a later one of the same number."""
    kind: str

    @property
    def alive(self) -> bool:
        return bool(self.born) and _stat(self.pid)[2] == self.born


def _stat(pid: int) -> tuple[int, str, str]:
    """Parent, state and time of birth; zero and empty if there is no such process."""
    with suppress(OSError, ValueError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        if fields[0] != "Z":
            return int(fields[1]), fields[0], fields[19]
    return 0, "", ""


def _below(root: int, processes: dict[int, _Process]) -> None:
    """Add a process and all below it to `processes`."""
    parents = {int(p.name): _stat(int(p.name)) for p in Path("/proc").iterdir() if p.name.isdigit()}
    for pid, (parent, _, born) in sorted(parents.items()):
        if born and pid not in processes and (pid == root or parent in processes):
            words = Path(f"/proc/{pid}/cmdline")
            with suppress(OSError):
                tracker = "resource_tracker" in words.read_text()
                kind = "root" if pid == root else "tracker" if tracker else "child"
                processes[pid] = _Process(pid, born, kind)


@contextmanager
def _heard(port: int) -> Iterator[list[tuple[float, bool]]]:
    """Commands on the wire: when they came [s], and whether they damp."""
    import lcm

    commands: list[tuple[float, bool]] = []
    going = threading.Event()
    going.set()
    wire = lcm.LCM(url_of(port=port))

    def hear(_: str, data: bytes) -> None:
        damps = not decode_lcm_command(CHEETAH, data).stiffness.any()
        commands.append((time.monotonic(), damps))

    def listen() -> None:
        while going.is_set():
            wire.handle_timeout(50)

    subscription = wire.subscribe(CHEETAH.command.channel, hear)
    subscription.set_queue_capacity(1000)
    thread = threading.Thread(target=listen)
    thread.start()
    try:
        yield commands
    finally:
        going.clear()
        thread.join()


def _torn(folder: Path) -> list[str]:
    """Files that cannot be read; a log of no sample yet may be short."""
    errors = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.name[0] != "."):
        try:
            if path.suffix == ".mcap":
                if path.stat().st_size > _EMPTY:
                    (read_deploy_log if is_deploy_log(path) else read_log)(path)
            elif path.name == "match.npz":
                load_match(path)
            elif path.suffix == ".npz":
                capture.load_capture(path)
            elif path.suffix == ".yaml":
                read_yaml(path)
            elif path.name == results.SUMMARY:
                results.load_results(path.parent)
            elif path.suffix in (".html", ".svg"):
                end = path.read_text().rstrip().rpartition("<")[2]
                if end != f"/{path.suffix[1:]}>":
                    raise PronkError(f"{path} is cut")
        except PronkError as error:
            errors.append(str(error)[:300])
    return errors


def _wait(process: subprocess.Popen[str], processes: dict[int, _Process], seconds: float) -> bool:
    """Wait until a process has ended, and note what it starts; whether it has."""
    until = time.monotonic() + seconds
    while process.poll() is None and time.monotonic() < until:
        _below(process.pid, processes)
        time.sleep(0.02)
    return process.poll() is not None


def _act(process: _Process, action: str) -> None:
    for name in action.split():
        if name != "STOP" and "STOP" in action:
            time.sleep(STOPPED_S)
        if process.alive:
            with suppress(ProcessLookupError):
                os.kill(process.pid, getattr(signal, f"SIG{name}"))


def _one(program: Program, i: int, seed: int, folder: Path, length_s: float) -> dict[str, Any]:
    """One run; a row of figures and faults. A `length_s` of zero: nothing is killed."""
    rng = np.random.default_rng([seed, i])
    faults: list[str] = []
    row: dict[str, Any] = {"program": program, "seed": seed, "i": i}
    row["action"] = ACTIONS[i // 5 % 4]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = int(probe.getsockname()[1])
    wired = program in ("sweep-lcm", "deploy")
    base = "ground" if program == "deploy" else "bench"
    robot = _start(["-m", "pronk.cli.main", "simulate", "--port", str(port), "--base", base])
    if not wired:
        robot.kill()
    elif not any(line.startswith("ready") for line in robot.stdout or ()):
        raise PronkError("the virtual robot did not start.")
    folder.mkdir()
    processes: dict[int, _Process] = {}
    with _heard(port) if wired else tempfile.TemporaryFile() as heard:
        process = _start(_words(program, folder, port))
        lines: list[str] = []
        ready = threading.Event()
        text = process.stdout
        assert text is not None

        def read() -> None:
            for line in text:
                lines.append(line)
                if line.startswith('{"operator"'):
                    ready.set()

        reader = threading.Thread(target=read)
        reader.start()
        begun = time.monotonic()
        if program == "deploy":
            ready.wait(120.0)
            _below(process.pid, processes)
            if not ready.is_set():
                process.terminate()
        if length_s == 0.0:
            _wait(process, processes, 600.0)
        else:
            _wait(process, processes, float(rng.uniform(0.05, 1.0)) * length_s)
            _below(process.pid, processes)
            alive = [child for child in processes.values() if child.alive]
            if program == "deploy" and ready.is_set():
                names = json.loads(next(line for line in lines if line.startswith("{")))
                name = list(names)[i % 5]
                target = _Process(names[name], _stat(names[name])[2], name)
            elif alive and program != "deploy":
                target = alive[int(rng.integers(len(alive)))]
            else:
                target = _Process(process.pid, "", "none: not walking, or ended before")
            at = time.monotonic()
            row |= {"target": target.kind, "at_s": at - begun}
            _act(target, row["action"])
            acted = time.monotonic()
            if not _wait(process, processes, 4.0 if wired else 30.0 + 4.0 * length_s):
                if wired:
                    process.terminate()
                if not _wait(process, processes, ENDS_S):
                    faults.append("does not end")
        ended = time.monotonic()
        while process.poll() is not None:
            orphans = [orphan.kind for orphan in processes.values() if orphan.alive]
            if not orphans:
                break
            if time.monotonic() - ended > ENDS_S:
                faults.append(f"left: {', '.join(orphans)}")
                break
            time.sleep(0.05)
        row["ends_s"] = time.monotonic() - ended
        for orphan in processes.values():
            _act(orphan, "KILL")
        process.wait()
        reader.join()
        time.sleep(0.2 if wired else 0.0)
    row |= {"length_s": time.monotonic() - begun, "status": process.returncode}
    if wired:
        robot.kill()
        wire: Any = heard
        if length_s and wire:
            damped = [when - at for when, damps in wire if damps and when > at]
            row["damped_s"] = damped[0] if damped else None
            gone = row["target"] in MOVING and row["action"].endswith("KILL")
            before = [damps for when, damps in wire if when <= at]
            late = not damped or damped[0] > acted - at + DAMPED_S
            if gone and before and not before[-1] and late:
                faults.append(f"damped after {row['damped_s']} s")
            if not wire[-1][1]:
                faults.append("the last command does not damp")
    robot.wait()
    faults += _torn(folder)
    traceback = next((k for k, line in enumerate(lines) if line.startswith("Traceback")), None)
    if traceback is not None:
        row["printed"] = "".join(lines[traceback:])[-600:]
    row["aside"] = sum(path.name.startswith(".") for path in folder.rglob("*"))
    return row | {"faults": faults}


def kills(
    programs: tuple[Program, ...] = (),
    count: int = 50,
    seed: int = 0,
    jobs: int = 1,
    out: Path | None = None,
) -> console.Outcome:
    """Kill and stop processes of commands at random moments.

    Args:
        programs: Which; all if left out.
        count: Runs of each; of deploy, of each of its five processes.
        seed: Of moments and processes.
        jobs: Runs at once.
        out: JSON lines, one a run, written as it goes; runs that are there are not repeated.
    """
    programs = programs or PROGRAMS
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(jobs) as threads:
        folder = Path(name)
        sound = folder / "sound"
        lengths = {"sweep-lcm": 15.0, "deploy": 2.0}
        if {"sweep", "match"} & set(programs):
            lengths["sweep"] = _one("sweep", 0, seed, sound, 0.0)["length_s"]
            (sound / "out").rename(folder / "logs")
        for program in programs:
            if program not in lengths:
                alone = _one(program, 0, seed, folder / program, 0.0)
                if alone["status"] or alone["faults"]:
                    raise PronkError(f"{program} by itself: {alone}")
                lengths[program] = alone["length_s"]
        there = out.read_text().splitlines() if out is not None and out.exists() else []
        rows = [row for row in map(json.loads, there) if row["seed"] == seed]
        done = {(row["program"], row["i"]) for row in rows}
        runs = [(p, i) for p in programs for i in range(count * (5 if p == "deploy" else 1))]
        todo = [run for run in runs if run not in done]

        def one(job: tuple[Program, int]) -> dict[str, Any]:
            program, i = job
            row = _one(program, i, seed, folder / f"{program}{i}", lengths[program])
            if out is not None:
                with out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
            return row

        rows += threads.map(one, todo)
    by = defaultdict[tuple[str, str], list[dict[str, Any]]](list)
    for row in rows:
        by[row["program"], row["target"]].append(row)
    counts = []
    cells: list[tuple[Cell, ...]] = []
    for (program_name, target), of_target in sorted(by.items()):
        count_row = {
            "program": program_name,
            "process": target,
            "n": len(of_target),
            "faults": len([row for row in of_target if row["faults"]]),
            "damped_s": max(row.get("damped_s") or 0.0 for row in of_target),
            "ends_s": max(row["ends_s"] for row in of_target),
            "aside": sum(row["aside"] for row in of_target),
            "traceback": len([row for row in of_target if "printed" in row]),
        }
        counts.append(count_row)
        cells.append(tuple(count_row[column] for column in COLUMNS))
    title = f"{len(rows)} kills, seed {seed}"
    console.show(Table(title=title, columns=tuple(COLUMNS.values()), rows=tuple(cells)))
    for row in rows:
        if row["faults"]:
            console.say(json.dumps(row))
    failed = sum(bool(row["faults"]) for row in rows)
    return console.Outcome(
        figures={"rows": counts, "faults": failed},
        status=ExitStatus.DEFECT if failed else ExitStatus.DONE,
    )
