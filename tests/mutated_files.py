"""Mutated inputs of every reader: no traceback, no hang, little memory, nothing written outside.

Every file is read in a process whose address space may grow by 500 MB beyond what the interpreter,
the modules and one read of every sound file take, and which is killed after 5 s of processor or
30 s. Writing outside of its folder, starting a program and connecting are faults (of Python code;
native code is not watched).
"""

from __future__ import annotations

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
from pronk.arrays import Array
from pronk.cli import console
from pronk.cli.export import TargetName
from pronk.cli.main import run
from pronk.deploy.runtime.deploy_log import read_deploy_log
from pronk.deploy.runtime.log import DeployLogWriter
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.records import STEP, TICK
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.files import write_text
from pronk.identify.logs.description import write_description
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap import Record, records
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
from pronk.robots.load import read_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Cell, Column, Table

_TORCH = importlib.util.find_spec("torch") is not None
ROOT = Path(__file__).parents[1]
MEMORY = 500_000_000
"""Address space that reading one file may take [bytes]."""
CPU_S = 5
"""Time of the processor that reading one file may take [s]."""
WALL_S = 30
"""Time on the wall that reading one file may take [s]."""
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
class _Format:
    """A kind of file, and how it is read."""

    files: tuple[str, ...]
    """Files that are mutated, one at a time."""
    read: Callable[[Path], Any]
    """Reads the first of them, given by its path, and uses what it holds."""
    checked: bool = False
    """Whether the format has checksums, so that other numbers must not pass silently."""
    share: float = 1.0
    """How often the kind is drawn, relative to the others."""


def _write(folder: Path) -> None:
    """Write a sound file of each kind."""
    sys.path.append(str(ROOT / "tests"))
    cases = importlib.import_module("report_cases")
    logs = importlib.import_module("log_files")
    cases.write_tree(folder / "tree")
    result = cases.match(legs=1)
    result = replace(result, joints={"FR_knee": result.joints["FR_knee"]})
    cases.write_match(folder / "page", result, prediction=True)
    cases.write_trial(folder / "page" / "trial", ("matched",), cases.CASES[:1])
    shutil.copytree(folder / "tree" / "trial" / "videos", folder / "page" / "trial" / "videos")
    responses = cases.joint_result("knee").responses.measured
    response_file.save_responses(folder / "tree" / "a.response.npz", responses)
    log = logs.example(600, ("FR_hip_pitch", "FR_knee"))
    logs.write_npz(folder / "a.npz", log)
    logs.write_csv(folder / "a.csv", log)
    logs.write_mcap(folder / "a.mcap", log)
    t = np.arange(1200) / 100.0
    chirp = 0.2 * np.sin(2.0 * np.pi * 0.5 * t**2)
    rows = np.column_stack([t, chirp, 0.9 * chirp])
    header = "time,command.FR_knee,position.FR_knee"
    np.savetxt(folder / "chirp.csv", rows, "%.6f", delimiter=",", header=header, comments="")
    _write_sage(folder / "sage")
    if _TORCH:
        torch = importlib.import_module("torch")
        positions = torch.from_numpy(rows[:400, 1:].copy())
        recording = {"time": torch.from_numpy(t[:400].copy())}
        recording["dof_pos"] = positions
        recording["des_dof_pos"] = positions.clone()
        torch.save(recording, folder / "a.pt")
    _write_bag(folder / "bag.mcap", chirp)
    _write_other_bags(folder, chirp)
    described = {"time": "time", "command.FR_knee": "u", "position.FR_knee": "q"}
    np.savetxt(folder / "own.csv", rows, "%.6f", delimiter=",", header="time,u,q", comments="# ")
    write_description(folder / "own.csv", ReadOptions(unit="rad", columns=described))
    robot = cases.ROBOT
    _write_deploy_log(folder / "deploy.mcap", robot)
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


def _write_sage(folder: Path) -> None:
    """Write a folder of SAGE: states at 500 Hz and commands at 50 Hz of two joints."""
    folder.mkdir()
    (folder / "joint_list.txt").write_text("hip\nknee\n")
    states = ["type,timestamp,positions,velocities,torques\n"]
    for k in range(60):
        states.append(f'S,{2000 * k},"[0.{k:02d}, 1]","[0, 0]","[0, 0]"\n')
    controls = ["type,timestamp,positions\n"]
    for k in range(6):
        controls.append(f'C,{20000 * k},"[{k}.0, 0.5]"\n')
    (folder / "state_motor.csv").write_text("".join(states))
    (folder / "control.csv").write_text("".join(controls))
    events = "type,timestamp,event\nE,2000,MOTION_START\nE,100000,DISABLE\n"
    (folder / "event.csv").write_text(events)


def _write_bag(path: Path, positions: Array) -> None:
    """Write a rosbag2 of one joint whose states equal its commands."""
    ros = importlib.import_module("mcap_ros2.writer").Writer
    with path.open("wb") as stream, ros(stream) as writer:
        state = writer.register_msgdef("sensor_msgs/msg/JointState", _STATE)
        for k in range(200):
            stamp = {"stamp": {"sec": 1 + k // 100, "nanosec": k % 100 * 10**7}, "frame_id": ""}
            message = {
                "header": stamp,
                "name": ["knee"],
                "position": [float(positions[k])],
                "velocity": [],
                "effort": [],
            }
            for topic in ("/joint_states", "/command"):
                writer.write_message(topic, state, message, 10**9 + k * 10**7, 0)


def _write_other_bags(folder: Path, positions: Array) -> None:
    """Write the same bag into SQLite and as a bag of ROS 1."""
    ros_bags = importlib.import_module("ros_bags")

    def build(builder: Any) -> list[Any]:
        messages = []
        for k in range(200):
            nano = 10**9 + k * 10**7
            state = builder.joint_state(nano, ["knee"], [float(positions[k])])
            for topic in ("/joint_states", "/command"):
                messages.append((topic, "sensor_msgs/msg/JointState", nano, state))
        return messages

    sqlite = ros_bags.write_bag(folder / "sqlite", build, "sqlite3")
    shutil.copy(next(sqlite.glob("*.db3")), folder / "bag.db3")
    ros1 = ros_bags.write_bag(folder / "ros1", build, "ros1 bz2")
    shutil.copy(ros1, folder / "bag.bag")


def _write_deploy_log(path: Path, robot: RobotSpec) -> None:
    """Write the log of 0.4 s of a deployment: 200 ticks and 20 steps of the policy."""
    header = {
        "robot": robot.name,
        "joints": robot.joint_names,
        "link": "sim",
        "policy": {"file": "policy.onnx", "delay_range_s": [0.0, 0.01]},
        "limits": {"tilt": 0.8},
    }
    writer = DeployLogWriter(path, header)
    for k in range(200):
        tick = np.zeros((), TICK)
        tick["tick"] = k
        tick["sequence"] = k
        for name in ("deadline", "begun", "done", "time"):
            tick[name] = k / 500.0
        tick["mode"] = Mode.POLICY
        tick["latency"] = 0.003
        writer.write(np.frombuffer(tick.tobytes(), TICK)[0])
        if k % 10 == 0:
            step = np.zeros((), STEP)
            step["begun"] = k / 500
            step["live"] = 1
            writer.write(np.frombuffer(step.tobytes(), STEP)[0])
    writer.end(complete=True, figures={})


def _formats() -> dict[str, _Format]:
    """How each kind is read; the files lie in the folder that `_write` filled."""

    def log(**options: Any) -> Callable[[Path], Any]:
        return lambda path: read_log(path, options=ReadOptions(**options))

    def gains(path: Path) -> None:
        matched = gains_file.load_gains(path)
        for target in get_args(TargetName):
            with contextlib.suppress(PronkError):
                write_text(path.parent / "out" / "a.py", export(matched, target))

    def match(path: Path) -> Any:
        return load_match(path)

    def model(path: Path) -> None:
        yaml_of_model(path)
        load_robot(path)

    def deploy(path: Path) -> None:
        deploy_log = read_deploy_log(path)
        deploy_run.stretches(deploy_log)
        deploy_run.jump_inputs(deploy_log)
        deploy_run.interventions(deploy_log)
        deploy_run.margins(deploy_log)
        deploy_run.timed_parts(deploy_log)
        deploy_run.measured_delay(deploy_log, None)

    def trial(run_kind: results.RunKind) -> _Format:
        summary = f"tree/trial/{run_kind.summary}"
        return _Format((summary,), lambda path: results.load_results(path.parent, run_kind))

    def command(*words: str) -> Callable[[Path], None]:
        return lambda path: _command([word.format(path, path.parent) for word in words])

    sage_files = (
        "sage/state_motor.csv",
        "sage/control.csv",
        "sage/joint_list.txt",
        "sage/event.csv",
    )
    page_files = (
        "page/gains.yaml",
        "page/match.npz",
        "page/fresh.prediction.npz",
        "page/trial/summary.json",
        "page/trial/videos/matched_forward_2.png",
    )
    response = ("response", "{0}", "--unit", "rad", "--no-plots", "--out", "{1}/out")
    formats = {
        "npz": _Format(("a.npz",), log(unit="rad"), True),
        "csv": _Format(("a.csv",), log(unit="rad")),
        "mcap": _Format(("a.mcap",), log(), True),
        "bag": _Format(("bag.mcap",), log(command_topic="/command"), True),
        "sqlite bag": _Format(("bag.db3",), log(command_topic="/command")),
        "ros1 bag": _Format(("bag.bag",), log(command_topic="/command")),
        "description": _Format(("own.log.yaml",), lambda path: read_log(path.with_name("own.csv"))),
        "pronk log inspect": _Format(("chirp.csv",), command("log", "inspect", "{0}")),
        "sage": _Format(sage_files, lambda path: read_log(path.parent)),
        "pace": _Format(("a.pt",), log(joint_order="hip,knee"), True),
        "pronk response": _Format(("chirp.csv",), command(*response)),
        "deploy log": _Format(("deploy.mcap",), deploy),
        "gains": _Format(("tree/gains.yaml",), gains),
        "match": _Format(("tree/match.npz",), match, True),
        "prediction": _Format(("page/fresh.prediction.npz",), load_prediction, True),
        "response": _Format(("tree/a.response.npz",), response_file.load_responses, True),
        "capture": _Format(("capture.npz",), capture.load_capture, True),
        "trial": trial(results.JUMPS),
        "walk": trial(WALK),
        "crossing": trial(CROSSING),
        "conditions": _Format(("conditions.yaml",), read_conditions),
        "evaluation": _Format(("evaluation.json",), load_speed_errors),
        "policy": _Format(("policy.onnx",), load_policy),
        "contract": _Format(("contract.json",), lambda p: from_json(p.read_text("l1"), source=p)),
        "robot.yaml": _Format(("robot/robot.yaml",), read_robot),
        "MJCF": _Format(("model.xml",), model),
        "URDF": _Format(("model.urdf",), model),
        "pronk robot check": _Format(("robot/robot.yaml",), command("robot", "check", "{0}")),
        "sim_params": _Format(("sim_params.yaml",), load_sim_params),
        "pronk report": _Format(
            page_files,
            lambda path: _command(["report", str(path.parent)]),
            share=0.2,
        ),
    }
    if not _TORCH:
        del formats["pace"]
    return formats


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
        at = int(rng.integers(len(out) + 1))
        size = int(2 ** rng.uniform(0, 9))
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
                word = _WORD.search(out, max(at - 8, 0))
                if word:
                    out[slice(*word.span())] = token
    return bytes(out)


def _mutated_inside(data: bytes, rng: np.random.Generator) -> bytes | None:
    """Change what a zip archive or MCAP file holds, with right checksums; None for others."""
    changed_file = io.BytesIO()
    if data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(changed_file, "w", 8) as new:
            changed = rng.choice(old.namelist())
            for name in old.namelist():
                part = old.read(name)
                new.writestr(name, _mutated(part, rng) if name == changed else part)
        return changed_file.getvalue()
    if not data.startswith(b"\x89MCAP"):
        return None
    messages: list[Record] = []
    for batch in records(io.BytesIO(data), len(data)):
        messages.extend(batch)
    candidates = [*range(3), *rng.integers(len(messages), size=3), len(messages) - 1]
    changed = rng.choice(candidates, size=rng.integers(1, 3))
    writer = Writer(changed_file)
    channels: dict[str, int] = {}
    writer.start()
    for i, message in enumerate(messages):
        if message.topic not in channels:
            schema = 0
            if message.schema is not None:
                definition = message.schema.data
                if rng.random() < 0.03:
                    definition = _mutated(definition, rng)
                schema = writer.register_schema(
                    message.schema.name, message.schema.encoding, definition
                )
            channels[message.topic] = writer.register_channel(
                message.topic, message.encoding, schema
            )
        content = message.data
        if i in changed:
            content = _mutated(content, rng)
        writer.add_message(channels[message.topic], message.log_time, content, message.log_time)
    writer.finish()  # type: ignore[no-untyped-call]
    return changed_file.getvalue()


def _numbers(content: Any) -> Iterator[Any]:
    """Numbers and arrays of a dataclass of lists and further dataclasses."""
    if is_dataclass(content):
        content = [getattr(content, field.name) for field in fields(content)]
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list | tuple):
        for part in content:
            yield from _numbers(part)
    elif isinstance(content, np.ndarray | float):
        yield content


def _same_numbers(content: Any, right_content: Any) -> bool:
    """Return True if two contents have the same numbers and arrays."""
    try:
        for number, right in zip(_numbers(content), _numbers(right_content), strict=True):
            # Names of parts that touch the ground are arrays of texts.
            is_float = np.asarray(right).dtype.kind == "f"
            if not np.array_equal(number, right, equal_nan=is_float):
                return False
    except ValueError:
        return False
    return True


class _OutsideError(BaseException):
    """Something was about to be done outside; no `except Exception` of a reader catches it."""


def _watch(folder: Path) -> None:
    """Refuse to write outside of a folder, to start programs and to connect, from now on."""
    allowed = (f"{folder}{os.sep}", os.devnull, f"/proc/{os.getpid()}/")
    writes = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    changes = ("mkdir", "rename", "remove", "rmdir", "link", "symlink", "truncate", "chmod")
    starts = ("subprocess.", "os.exec", "os.fork", "os.posix_spawn", "os.system", "socket.connect")

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event.startswith(starts):
            raise _OutsideError(event, *map(str, arguments))
        paths: tuple[Any, ...] = ()
        if event == "open" and arguments[2] & writes:
            paths = arguments[:1]
        elif event.startswith("os.") and event[3:] in changes:
            paths = arguments[:2]
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


def _read_file(file_format: _Format, path: Path, right: Any) -> tuple[str, str]:
    """Read one file; whether it was `read`, `refused`, or a `fault`, and why."""
    try:
        content = file_format.read(path)
    except PronkError as error:
        return "refused" if str(error).isprintable() else "fault", str(error)
    except (Exception, _OutsideError) as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return "fault", f"{place.filename}:{place.lineno}: {type(error).__name__} {error}"
    if right is None:
        return "read", ""
    if _same_numbers(content, right):
        return "read", ""
    if isinstance(content, JointLog):
        is_noted = not content.origin.complete or content.notes != right.notes
        if is_noted:
            return "read", ""
    return "fault", "other numbers without a word"


def _drawn(formats: dict[str, _Format], seed: int, i: int) -> tuple[str, np.random.Generator]:
    """Kind of file `i`, and what its mutations are drawn with."""
    rng = np.random.default_rng([seed, i])
    shares = np.array([file_format.share for file_format in formats.values()])
    return str(rng.choice(list(formats), p=shares / shares.sum())), rng


def _read(sound: Path, folder: Path, rows: Path, numbers: range, seed: int, at: Any) -> None:
    """Body of a process that reads mutated files; `at` is the number of the present one."""
    die_with_parent()
    shutil.copytree(sound, folder)
    tempfile.tempdir = str(folder)
    sys.dont_write_bytecode = True
    warnings.simplefilter("ignore")
    formats = _formats()
    right_contents = {}
    for name, file_format in formats.items():
        right_contents[name] = file_format.read(folder / file_format.files[0])
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + MEMORY, resource.RLIM_INFINITY))
    with rows.open("a") as file:
        _watch(folder)
        for i in numbers:
            at.value = i
            name, rng = _drawn(formats, seed, i)
            file_format = formats[name]
            path = folder / rng.choice(file_format.files)
            data = path.read_bytes()
            mutated_inside = None
            if rng.random() < 0.5:
                mutated_inside = _mutated_inside(data, rng)
            path.write_bytes(mutated_inside or _mutated(data, rng))
            Path("/proc/self/clear_refs").write_text("5")
            memory = _memory("VmRSS")
            begin = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, CPU_S)
            signal.setitimer(signal.ITIMER_REAL, WALL_S)
            right = None
            if file_format.checked and mutated_inside is None:
                right = right_contents[name]
            outcome, reason = _read_file(file_format, folder / file_format.files[0], right)
            for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
                signal.setitimer(timer, 0.0)
            row: dict[str, Any] = {"i": i, "kind": name, "outcome": outcome}
            row["s"] = time.process_time() - begin
            row["mb"] = (_memory("VmHWM") - memory) / 1e6
            if outcome == "fault":
                row["why"] = reason[:300]
            file.write(json.dumps(row) + "\n")
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
        context = multiprocessing.get_context("spawn")
        end = first + count
        running: dict[int, tuple[Any, int, Any]] = {}

        def start(begin: int, place: int) -> None:
            at = context.Value("q", begin - jobs)
            numbers = range(begin, end, jobs)
            arguments = (folder / "sound", folder / str(place), rows, numbers, seed, at)
            process = context.Process(target=_read, args=arguments)
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
                    name_of_format, _ = _drawn(_formats(), seed, at.value)
                    row = {
                        "i": at.value,
                        "kind": name_of_format,
                        "outcome": "fault",
                        "s": 0.0,
                        "mb": 0.0,
                        "why": f"ended the process with {process.exitcode}",
                    }
                    with rows.open("a") as file:
                        file.write(json.dumps(row) + "\n")
                    if at.value + jobs < end:
                        start(at.value + jobs, place + jobs)
        read_files = [json.loads(line) for line in rows.read_text().splitlines()]
    return _outcome(read_files, seed)


def _outcome(read_files: list[dict[str, Any]], seed: int) -> console.Outcome:
    """Show a table of what became of the files, a row for each kind, and the faults."""
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for row in read_files:
        by_kind.setdefault(row["kind"], []).append(row)
    counts = []
    cells: list[tuple[Cell, ...]] = []
    for name in sorted(by_kind):
        rows = by_kind[name]
        outcomes = [row["outcome"] for row in rows]
        count_row = {
            "kind": name,
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
    title = f"{len(read_files)} mutated files, seed {seed}"
    console.show(Table(title=title, columns=columns, rows=tuple(cells)))
    faults = [row for row in read_files if row["outcome"] == "fault"]
    for row in faults[:60]:
        console.say(f"{row['i']} {row['kind']}: {row['why']}")
    figures = {"count": len(read_files), "faults": len(faults), "kinds": counts}
    return console.Outcome(figures=figures, status=ExitStatus.DEFECT if faults else ExitStatus.DONE)
