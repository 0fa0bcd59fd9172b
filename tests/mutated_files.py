"""Mutated inputs of every reader: no traceback, no hang, little memory, nothing written outside.

Every file is read in a process whose address space may grow by 500 MB beyond what the interpreter,
the modules and one read of every sound file take, and which is killed after 5 s of processor or
30 s. Writing outside of its folder, starting a program and connecting are faults (of Python code;
native code is not watched).
"""

from __future__ import annotations

import collections
import contextlib
import importlib
import importlib.util
import io
import json
import multiprocessing
import multiprocessing.connection
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from mcap.writer import Writer

import pronk.identify.match.gains as gains_file
from pronk.cli import console
from pronk.cli.export import TargetName
from pronk.cli.main import run
from pronk.deploy.runtime.deploy_log import read_deploy_log
from pronk.deploy.runtime.log import DeployLogWriter
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.records import STEP, TICK
from pronk.errors import PronkError
from pronk.files import write_text
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap import records
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.export.targets import export
from pronk.identify.match.predict import load_prediction
from pronk.identify.match.result import load_match
from pronk.identify.response import response as response_file
from pronk.jump.trial import results
from pronk.jump.trial.conditions import TOLERANCE_FILE, read_conditions
from pronk.jump.trial.crossing import CROSSING
from pronk.jump.trial.training_sim.results import SCHEMA as EVALUATION
from pronk.jump.trial.training_sim.results import load_speed_errors
from pronk.jump.trial.walk import WALK
from pronk.jump.virtual import capture
from pronk.jump.virtual.sim_params import SHIPPED, load_sim_params
from pronk.policy.contract import from_json, to_json
from pronk.policy.runtime import load_policy
from pronk.processes import die_with_parent
from pronk.report import deploy_run
from pronk.robots import load_robot
from pronk.robots.bare import yaml_of_model
from pronk.robots.load import read_model, read_robot
from pronk.tables import Cell, Column, Table

_TORCH = importlib.util.find_spec("torch") is not None
ROOT = Path(__file__).parents[1]
MEMORY, CPU_S, WALL_S = 500_000_000, 5, 30
"""Limits of one file: address space [bytes], time of processor and on the wall [s]."""
_WORD = re.compile(rb"[-+\w.]+")
_TOKENS = (
    *(b"-1", b"0", b"1e999", b"1e308", b"nan", b"null", b"true", b"[[[[", b"{}", b"[]", b"'", b'"'),
    *(b"\x00", b"\xff", b"*a", b"../" * 5 + b"evil", b"/tmp/evil", b"\x1b[31m", b"9" * 400),
    *(b"9223372036854775808", b"999999999", b"&#10;", b"\n", b": ", b"[" * 3000),
)
_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_URDF = """<robot name="r"><link name="base"/><link name="leg"><inertial><origin xyz="0 0 -0.1"/>
<mass value="1.0"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
</link><joint name="knee" type="revolute"><parent link="base"/><child link="leg"/>
<axis xyz="0 1 0"/><limit lower="-1.0" upper="1.5" effort="10" velocity="20"/></joint></robot>
"""


@dataclass(frozen=True)
class _Kind:
    files: tuple[str, ...]
    """Files that are mutated, one at a time."""
    read: Callable[[Path], Any]
    """Reads the first of them, given by its path, and uses what it holds."""
    checked: bool = False
    """Whether the format has checksums, so that other numbers must not pass silently."""
    share: float = 1.0


def _write(folder: Path) -> None:
    """Write a sound file of each kind."""
    sys.path.append(str(ROOT / "tests"))
    cases, logs = map(importlib.import_module, ("report_cases", "log_files"))
    cases.write_tree(folder / "tree")
    result = cases.match(legs=1)
    result = replace(result, joints={"FR_knee": result.joints["FR_knee"]})
    cases.write_match(folder / "page", result, prediction=True)
    cases.write_trial(folder / "page" / "trial", ("matched",), cases.CASES[:1])
    shutil.copytree(folder / "tree" / "trial" / "videos", folder / "page" / "trial" / "videos")
    responses = cases.joint_result("knee").responses.measured
    response_file.save_responses(folder / "tree" / "a.response.npz", responses)
    log = logs.example(600, ("FR_hip_pitch", "FR_knee"))
    for name in ("npz", "csv", "mcap"):
        getattr(logs, f"write_{name}")(folder / f"a.{name}", log)
    t = np.arange(1200) / 100.0
    chirp = 0.2 * np.sin(2.0 * np.pi * 0.5 * t**2)
    rows = np.column_stack([t, chirp, 0.9 * chirp])
    header = "time,command.FR_knee,position.FR_knee"
    np.savetxt(folder / "chirp.csv", rows, "%.6f", delimiter=",", header=header, comments="")
    sage = folder / "sage"
    sage.mkdir()
    (sage / "joint_list.txt").write_text("hip\nknee\n")
    states = (f'S,{2000 * k},"[0.{k:02d}, 1]","[0, 0]","[0, 0]"\n' for k in range(60))
    controls = (f'C,{20000 * k},"[{k}.0, 0.5]"\n' for k in range(6))
    first = "type,timestamp,positions"
    (sage / "state_motor.csv").write_text(f"{first},velocities,torques\n{''.join(states)}")
    (sage / "control.csv").write_text(f"{first}\n{''.join(controls)}")
    events = "type,timestamp,event\nE,2000,MOTION_START\nE,100000,DISABLE\n"
    (sage / "event.csv").write_text(events)
    if _TORCH:
        torch = importlib.import_module("torch")
        values = {"time": t[:400], "dof_pos": rows[:400, 1:], "des_dof_pos": rows[:400, 1:]}
        torch.save({k: torch.from_numpy(v.copy()) for k, v in values.items()}, folder / "a.pt")
    ros = importlib.import_module("mcap_ros2.writer").Writer
    with (folder / "bag.mcap").open("wb") as stream, ros(stream) as writer:
        state = writer.register_msgdef("sensor_msgs/msg/JointState", _STATE)
        for k, topic in ((k, topic) for k in range(200) for topic in ("/joint_states", "/command")):
            stamp = {"stamp": {"sec": 1 + k // 100, "nanosec": k % 100 * 10**7}, "frame_id": ""}
            message = {"header": stamp, "name": ["knee"], "position": [float(chirp[k])]}
            message |= {"velocity": [], "effort": []}
            writer.write_message(topic, state, message, 10**9 + k * 10**7, 0)
    robot = cases.ROBOT
    policy = {"file": "policy.onnx", "delay_range_s": [0.0, 0.01]}
    about = {"robot": robot.name, "joints": robot.joint_names, "link": "sim", "policy": policy}
    made = DeployLogWriter(folder / "deploy.mcap", about | {"limits": {"tilt": 0.8}})
    for k in range(200):
        tick, step = np.zeros((), TICK), np.zeros((), STEP)
        tick["tick"] = tick["sequence"] = k
        for name in ("deadline", "begun", "done", "time"):
            tick[name] = k / 500.0
        tick["mode"], tick["latency"], step["begun"], step["live"] = Mode.POLICY, 0.003, k / 500, 1
        made.write(np.frombuffer(tick.tobytes(), TICK)[0])
        if k % 10 == 0:
            made.write(np.frombuffer(step.tobytes(), STEP)[0])
    made.end(complete=True, figures={})
    shutil.copytree(Path(load_robot.__code__.co_filename).parent / robot.name, folder / "robot")
    shutil.copy(folder / "robot" / f"{robot.name}.xml", folder / "model.xml")
    (folder / "model.urdf").write_text(_URDF)
    shutil.copy(SHIPPED, folder / "sim_params.yaml")
    shutil.copy(TOLERANCE_FILE, folder / "conditions.yaml")
    shutil.copy(ROOT / "policies" / "matched" / "policy.onnx", folder / "policy.onnx")
    (folder / "contract.json").write_text(to_json(load_policy(folder / "policy.onnx").contract))
    walks = {"walks": [{"name": "a", "figures": {"speed_error": {"mean": 0.1}}}]}
    results.save_json(folder / "evaluation.json", EVALUATION, walks)
    capture.save_capture(folder / "capture.npz", cases.jump_capture(400, 1.0))


def _kinds() -> dict[str, _Kind]:
    """How each kind is read; the files lie in the folder that `_write` filled."""

    def log(**options: Any) -> Callable[[Path], Any]:
        return lambda path: read_log(path, options=ReadOptions(**options))

    def gains(path: Path) -> None:
        found = gains_file.load_gains(path)
        for target in get_args(TargetName):
            with contextlib.suppress(PronkError):
                write_text(path.parent / "out" / "a.py", export(found, target))

    def match(path: Path) -> Any:
        return load_match(path)

    def model(path: Path) -> None:
        read_model.cache_clear()
        yaml_of_model(path)
        load_robot(path)

    def deploy(path: Path) -> None:
        found = read_deploy_log(path)
        deploy_run.stretches(found)
        deploy_run.jump_inputs(found)
        deploy_run.interventions(found)
        deploy_run.margins(found)
        deploy_run.timed_parts(found)
        deploy_run.measured_delay(found, None)

    def trial(kind: results.RunKind) -> _Kind:
        path = f"tree/trial/{kind.summary}"
        return _Kind((path,), lambda path: results.load_results(path.parent, kind))

    def command(*words: str) -> Callable[[Path], None]:
        return lambda path: _command([word.format(path, path.parent) for word in words])

    sage = tuple(f"sage/{name}" for name in ("state_motor.csv", "control.csv", "joint_list.txt"))
    pages = ("gains.yaml", "match.npz", "fresh.prediction.npz")
    trials = ("summary.json", "videos/matched_forward_2.png")
    response = ("response", "{0}", "--unit", "rad", "--no-plots", "--out", "{1}/out")
    kinds = {
        "npz": _Kind(("a.npz",), log(unit="rad"), True),
        "csv": _Kind(("a.csv",), log(unit="rad")),
        "mcap": _Kind(("a.mcap",), log(), True),
        "bag": _Kind(("bag.mcap",), log(command_topic="/command"), True),
        "sage": _Kind((*sage, "sage/event.csv"), lambda path: read_log(path.parent)),
        "pace": _Kind(("a.pt",), log(joint_order="hip,knee"), True),
        "pronk response": _Kind(("chirp.csv",), command(*response)),
        "deploy log": _Kind(("deploy.mcap",), deploy),
        "gains": _Kind(("tree/gains.yaml",), gains),
        "match": _Kind(("tree/match.npz",), match, True),
        "prediction": _Kind(("page/fresh.prediction.npz",), load_prediction, True),
        "response": _Kind(("tree/a.response.npz",), response_file.load_responses, True),
        "capture": _Kind(("capture.npz",), capture.load_capture, True),
        "trial": trial(results.JUMPS),
        "walk": trial(WALK),
        "crossing": trial(CROSSING),
        "conditions": _Kind(("conditions.yaml",), read_conditions),
        "evaluation": _Kind(("evaluation.json",), load_speed_errors),
        "policy": _Kind(("policy.onnx",), load_policy),
        "contract": _Kind(("contract.json",), lambda p: from_json(p.read_text("l1"), source=p)),
        "robot.yaml": _Kind(("robot/robot.yaml",), read_robot),
        "MJCF": _Kind(("model.xml",), model),
        "URDF": _Kind(("model.urdf",), model),
        "pronk robot check": _Kind(("robot/robot.yaml",), command("robot", "check", "{0}")),
        "sim_params": _Kind(("sim_params.yaml",), load_sim_params),
        "pronk report": _Kind(
            tuple(f"page/{n}" for n in (*pages, *(f"trial/{t}" for t in trials))),
            lambda path: _command(["report", str(path.parent)]),
            share=0.2,
        ),
    }
    return {name: kind for name, kind in kinds.items() if name != "pace" or _TORCH}


def _command(words: list[str]) -> None:
    """Run a command of pronk; PronkError where it refuses its input."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = run(words)
    text = printed.getvalue()
    if not text.replace("\n", "").replace("\r", "").isprintable():
        raise ValueError(f"printed {text[-200:]!r}")
    if status == 2:
        raise PronkError(text.strip().rpartition("\n")[2])
    if status:
        raise ValueError(text[-300:])


def _mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Change bytes and words, put in tokens, cut, repeat or move pieces; more at both ends."""
    out = bytearray(data)
    for _ in range(rng.geometric(0.6)):
        end = min(len(out), 4096)
        at, size = int(rng.integers(len(out) + 1)), int(2 ** rng.uniform(0, 9))
        at = (at, at, at % (end + 1), len(out) - at % (end + 1))[rng.integers(4)]
        token = _TOKENS[rng.integers(len(_TOKENS))]
        match rng.integers(7):
            case 0:
                out[at : at + 1] = rng.bytes(1)
            case 1:
                out[at:at] = token
            case 2:
                del out[at : at + size]
            case 3:
                out[at:at] = out[at : at + size] * int(rng.integers(1, 20))
            case 4:
                out[at:] = out[at + size :] + out[at : at + size]
            case _:
                if word := _WORD.search(out, max(at - 8, 0)):
                    out[slice(*word.span())] = token
    return bytes(out)


def _mutated_inside(data: bytes, rng: np.random.Generator) -> bytes | None:
    """Change what a zip archive or MCAP file holds, with right checksums; None for others."""
    made = io.BytesIO()
    if data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(made, "w", 8) as new:
            changed = rng.choice(old.namelist())
            for name in old.namelist():
                part = old.read(name)
                new.writestr(name, _mutated(part, rng) if name == changed else part)
        return made.getvalue()
    if not data.startswith(b"\x89MCAP"):
        return None
    found = [one for batch in records(io.BytesIO(data), len(data)) for one in batch]
    few = [*range(3), *rng.integers(len(found), size=3), len(found) - 1]
    changed = rng.choice(few, size=rng.integers(1, 3))
    writer, channels = Writer(made), dict[str, int]()
    writer.start()
    for i, one in enumerate(found):
        if one.topic not in channels:
            schema = 0
            if one.schema is not None:
                about = one.schema.data
                about = _mutated(about, rng) if rng.random() < 0.03 else about
                schema = writer.register_schema(one.schema.name, one.schema.encoding, about)
            channels[one.topic] = writer.register_channel(one.topic, one.encoding, schema)
        data = _mutated(one.data, rng) if i in changed else one.data
        writer.add_message(channels[one.topic], one.log_time, data, one.log_time)
    writer.finish()  # type: ignore[no-untyped-call]
    return made.getvalue()


def _numbers(found: Any) -> Iterator[Any]:
    """Numbers and arrays of a dataclass of lists and further dataclasses."""
    if is_dataclass(found):
        found = [getattr(found, field.name) for field in fields(found)]
    if isinstance(found, dict):
        found = list(found.values())
    if isinstance(found, list | tuple):
        for one in found:
            yield from _numbers(one)
    elif isinstance(found, np.ndarray | float):
        yield found


def _same(found: Any, right: Any) -> bool:
    pairs = zip(_numbers(found), _numbers(right), strict=True)
    try:
        return all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)
    except ValueError:
        return False


class _OutsideError(BaseException):
    """Something was about to be done outside; no `except Exception` of a reader catches it."""


def _watch(folder: Path) -> None:
    """Refuse to write outside of a folder, to start programs and to connect, from now on."""
    allowed = (f"{folder}{os.sep}", os.devnull, f"/proc/{os.getpid()}/")
    writes = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    changes = ("mkdir", "rename", "remove", "rmdir", "link", "symlink", "truncate", "chmod")
    starts = ("subprocess.", "os.exec", "os.fork", "os.posix_spawn", "os.system", "socket.connect")

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if event.startswith(starts):
            raise _OutsideError(event, *map(str, given))
        paths: tuple[Any, ...] = ()
        if event == "open" and given[2] & writes:
            paths = given[:1]
        elif event.startswith("os.") and event[3:] in changes:
            paths = given[:2]
        for path in paths:
            if isinstance(path, str | bytes | os.PathLike):
                place = os.path.realpath(os.fsdecode(path))
                if not place.startswith(allowed):
                    raise _OutsideError(event, place)

    sys.addaudithook(hook)


def _memory(name: str) -> int:
    """A line of this process's memory [bytes]: VmSize, VmRSS, VmHWM (the highest VmRSS)."""
    text = Path("/proc/self/status").read_text()
    return int(text.partition(f"{name}:")[2].split()[0]) << 10


def _one(kind: _Kind, path: Path, right: Any) -> tuple[str, str]:
    """Read one file; whether it was `read`, `refused`, or a `fault`, and why."""
    try:
        found = kind.read(path)
    except PronkError as error:
        return "refused" if str(error).isprintable() else "fault", str(error)
    except (Exception, _OutsideError) as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return "fault", f"{place.filename}:{place.lineno}: {type(error).__name__} {error}"
    if right is None:
        return "read", ""
    said = isinstance(found, JointLog) and (not found.origin.complete or found.notes != right.notes)
    if said or _same(found, right):
        return "read", ""
    return "fault", "other numbers without a word"


def _chosen(kinds: dict[str, _Kind], seed: int, i: int) -> tuple[str, np.random.Generator]:
    """Kind of file `i`, and what its mutations are drawn with."""
    rng = np.random.default_rng([seed, i])
    shares = np.array([kind.share for kind in kinds.values()])
    return str(rng.choice(list(kinds), p=shares / shares.sum())), rng


def _read(sound: Path, folder: Path, rows: Path, numbers: range, seed: int, at: Any) -> None:
    """Body of a process that reads mutated files; `at` is the number of the present one."""
    die_with_parent()
    shutil.copytree(sound, folder)
    tempfile.tempdir = str(folder)
    sys.dont_write_bytecode = True
    warnings.simplefilter("ignore")
    kinds = _kinds()
    right = {name: kind.read(folder / kind.files[0]) for name, kind in kinds.items()}
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + MEMORY, resource.RLIM_INFINITY))
    with rows.open("a") as file:
        _watch(folder)
        for i in numbers:
            at.value = i
            name, rng = _chosen(kinds, seed, i)
            kind = kinds[name]
            path = folder / rng.choice(kind.files)
            data = path.read_bytes()
            inside = _mutated_inside(data, rng) if rng.random() < 0.5 else None
            path.write_bytes(inside or _mutated(data, rng))
            Path("/proc/self/clear_refs").write_text("5")
            memory, begun = _memory("VmRSS"), time.process_time()
            signal.setitimer(signal.ITIMER_PROF, CPU_S)
            signal.setitimer(signal.ITIMER_REAL, WALL_S)
            known = right[name] if kind.checked and inside is None else None
            outcome, why = _one(kind, folder / kind.files[0], known)
            for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
                signal.setitimer(timer, 0.0)
            row = {"i": i, "kind": name, "outcome": outcome, "s": time.process_time() - begun}
            row["mb"] = (_memory("VmHWM") - memory) / 1e6
            file.write(json.dumps(row | {"why": why[:300]} if outcome == "fault" else row) + "\n")
            file.flush()
            path.write_bytes(data)


def fuzz(
    count: int = 2000, seed: int = 0, jobs: int = 1, first: int = 0, out: Path | None = None
) -> console.Outcome:
    """Read mutated files of every kind.

    Args:
        count: Files, all kinds together.
        seed: Of the mutations; file `i` is the same for any count and jobs.
        jobs: Processes at once.
        first: Number of the first file.
        out: JSON lines, one a file, written as it goes.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        (folder / "sound").mkdir()
        _write(folder / "sound")
        rows = (out or folder / "rows.jsonl").resolve()
        rows.write_text("")
        context, last = multiprocessing.get_context("spawn"), first + count
        running: dict[int, tuple[Any, int, Any]] = {}

        def start(begin: int, place: int) -> None:
            at = context.Value("q", begin - jobs)
            numbers = range(begin, last, jobs)
            given = (folder / "sound", folder / str(place), rows, numbers, seed, at)
            process = context.Process(target=_read, args=given)
            process.start()
            running[process.sentinel] = (process, place, at)

        for job in range(min(jobs, count)):
            start(first + job, job)
        while running:
            for sentinel in multiprocessing.connection.wait(list(running)):
                process, place, at = running.pop(int(sentinel))  # type: ignore[arg-type]
                process.join()
                if process.exitcode:
                    if at.value < first or process.exitcode > 0:
                        raise PronkError("a process of this benchmark failed; see above.")
                    why = f"ended the process with {process.exitcode}"
                    with rows.open("a") as file:
                        kind, _ = _chosen(_kinds(), seed, at.value)
                        row = {"i": at.value, "kind": kind, "outcome": "fault", "s": 0.0, "mb": 0.0}
                        file.write(json.dumps(row | {"why": why}) + "\n")
                    if at.value + jobs < last:
                        start(at.value + jobs, place + jobs)
        found = [json.loads(line) for line in rows.read_text().splitlines()]
    return _outcome(found, seed)


def _outcome(found: list[dict[str, Any]], seed: int) -> console.Outcome:
    by_kind = collections.defaultdict[str, list[dict[str, Any]]](list)
    for row in found:
        by_kind[row["kind"]].append(row)
    counts = []
    cells: list[tuple[Cell, ...]] = []
    for kind, rows in sorted(by_kind.items()):
        outcomes = [row["outcome"] for row in rows]
        count_row = {
            "kind": kind,
            "n": len(rows),
            "read": outcomes.count("read"),
            "refused": outcomes.count("refused"),
            "faults": outcomes.count("fault"),
            "longest_s": max(row["s"] for row in rows),
            "most_mb": max(row["mb"] for row in rows),
        }
        counts.append(count_row)
        cells.append(tuple(count_row.values()))
    columns = (
        Column(heading="kind"),
        Column(heading="n"),
        Column(heading="read"),
        Column(heading="refused"),
        Column(heading="faults"),
        Column(heading="longest", unit="s", digits=2),
        Column(heading="most memory", unit="MB", digits=0),
    )
    title = f"{len(found)} mutated files, seed {seed}"
    console.show(Table(title=title, columns=columns, rows=tuple(cells)))
    faults = [row for row in found if row["outcome"] == "fault"]
    for row in faults[:60]:
        console.say(f"{row['i']} {row['kind']}: {row['why']}")
    figures = {"count": len(found), "faults": len(faults), "kinds": counts}
    return console.Outcome(figures=figures, status=1 if faults else 0)
