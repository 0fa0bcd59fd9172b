"""A robot from a package on its way from its model to an export, as a user goes it."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.foreign.plain import Held, Numbers, differences, numbers_of, peaks, spec_of
from benchmarks.foreign.population import Candidate, copy_model
from pronk.errors import PronkError
from pronk.identify.excitation.plan import make_plan
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

STEPS = ("new", "check", "sweep", "match", "export mjlab", "export mjcf")
TOLERANCE = 1e-3
"""Largest relative difference of a number of the robot.yaml, which has four digits."""
LIMIT_S = 900.0
"""Longest time of a command [s]."""
FITTING = re.compile(r"amplitude of ([0-9.e+-]+) rad fits")
"""Where a refusal of a sweep says which amplitude fits."""
NOT_BETTER_STATUS = 3
NO_MATCH_STATUS = 4
PEAK_DIFFERENCE = 0.1
"""Largest difference of a planned peak, as a share of MuJoCo's."""
Row = dict[str, Any]


def pronk(folder: Path, *words: str) -> Row:
    """Run a command of pronk in a folder; return its status, time and what it printed."""
    begin = time.perf_counter()
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": "disable", "COLUMNS": "250"}
    program = "import sys; from pronk.cli.main import main; sys.exit(main())"
    try:
        done = subprocess.run(
            [sys.executable, "-c", program, *words],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
        status, printed, said = done.returncode, done.stdout, done.stderr
    except subprocess.TimeoutExpired:
        status, printed, said = -1, "", f"no end in {LIMIT_S:g} s"
    return {
        "command": " ".join(words),
        "status": status,
        "seconds": time.perf_counter() - begin,
        "printed": printed[-4000:],
        "said": said[-2000:],
    }


def sentence_of(said: str) -> str:
    """Return the sentence with which a command ended, among what it printed beside it."""
    lines = [line for line in said.split("\n") if line.startswith("pronk: ")]
    return lines[-1] if lines else " ".join(said.split())[-300:]


def walk(
    packages: Path, candidate: Candidate, joint: str, scratch: Path, *, repeats: int = 3
) -> Row:
    """Take one robot from its model to its exports; return how far it went, and its numbers.

    Args:
        packages: Folder that the packages are installed in.
        candidate: The robot.
        joint: Hinge that is excited.
        scratch: Folder to work in; it is emptied first.
        repeats: Times each amplitude of the sweep is repeated.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    model = copy_model(packages, candidate.path, scratch)
    folder = model.parent
    row: Row = {
        "robot": candidate.label,
        "path": candidate.path,
        "joint": joint,
        "reached": "",
        "refusal": "",
        "commands": [],
        "wrong_numbers": {},
        "compared": 0,
        "peaks": {},
    }

    def step(name: str, *words: str, accepted: Sequence[int] = (0,)) -> bool:
        done = pronk(folder, *words)
        row["commands"].append(done)
        if done["status"] in accepted:
            row["reached"] = name
            return True
        row["refusal"] = sentence_of(done["said"])
        row["refused_at"] = name
        row["status"] = done["status"]
        return False

    if not step("new", "robot", "new", model.name):
        return row
    robot_file = folder / "robot.yaml"
    compare_numbers(robot_file, model, row)
    if not step("check", "robot", "check", "robot.yaml"):
        return row
    sweep = ["sweep", "robot.yaml", "--out", "logs", "--joints", joint, "--link", "sim"]
    sweep += ["--repeats", str(repeats), "--json", "sweep.json", "--overwrite"]
    if not step("sweep", *sweep):
        fitting = FITTING.search(row["refusal"])
        if fitting is None:
            return row
        row["refusal"] = ""
        amplitude = float(fitting.group(1))
        sweep += ["--amplitude", f"{amplitude:.6g}", "--amplitude", f"{0.5 * amplitude:.6g}"]
        if not step("sweep", *sweep):
            return row
    compare_peaks(robot_file, model, joint, folder / "sweep.json", row)
    match = ["match", "logs", "--robot", "robot.yaml", "--out", "gains.yaml"]
    if not step("match", *match, "--json", "match.json", accepted=(0, NOT_BETTER_STATUS)):
        if row["status"] == NO_MATCH_STATUS:
            figures = json.loads((folder / "match.json").read_text(encoding="utf-8"))
            row["refusal"] = "; ".join(figures["flags"][joint])
        return row
    for target, name in (("mjlab", "actuators.py"), ("mjcf", "matched.xml")):
        export = ["export", "gains.yaml", "--to", target, "--out", name, "--robot", "robot.yaml"]
        if not step(f"export {target}", *export):
            return row
    return row


def compare_numbers(robot_file: Path, model: Path, row: Row) -> None:
    """Compare the numbers of a robot.yaml with those of its model."""
    try:
        truth = numbers_of(model)
        robot = load_robot(str(robot_file))
    except (ValueError, PronkError) as error:
        row["numbers_error"] = str(error)
        return
    for joint in robot.joints:
        # Slide joints, where the robot has them, are no hinges of the model.
        numbers = truth.get(joint.name)
        if numbers is None:
            continue
        found = {
            "effort_limit": joint.drive.effort_limit,
            "stiffness": joint.stiffness,
            "damping": joint.damping,
            "low": joint.range[0],
            "high": joint.range[1],
            "speed": joint.drive.no_load_speed,
        }
        row["compared"] += stated_numbers(numbers)
        wrong = differences(found, numbers, TOLERANCE)
        if wrong:
            row["wrong_numbers"][joint.name] = wrong


def stated_numbers(numbers: Numbers) -> int:
    """Return how many numbers a model states of a hinge."""
    values = (numbers.stiffness, numbers.damping, numbers.low, numbers.high, numbers.speed)
    return len(numbers.effort_limits[:1]) + sum(not math.isnan(value) for value in values)


def compare_peaks(robot_file: Path, model: Path, joint: str, sweep: Path, row: Row) -> None:
    """Compare the peaks of the plan, without uncertainty, with those of plain MuJoCo."""
    robot = load_robot(str(robot_file))
    figures = json.loads(sweep.read_text(encoding="utf-8"))
    planned = figures["plan"][0]
    plan = make_plan(robot, [joint], amplitudes=(planned["amplitude_rad"],), repeats=1)
    offsets = plan.excitations[0].offsets(plan.rate_hz)
    imported = False
    try:
        spec = spec_of(model)
    except ValueError:
        # MuJoCo refuses the file; pronk has mended it.
        spec = robot.build_spec()
        imported = True
    try:
        simulated = peaks(
            spec,
            joint,
            drives_of(robot, joint),
            {other.name: other.default_position for other in robot.joints},
            robot.base_body,
            offsets,
            plan.rate_hz,
        )
    except (ValueError, KeyError) as error:
        row["peaks"] = {"error": str(error)}
        return
    pose = robot.joint(joint).default_position
    planned_reach = max(planned["nominal_highest_rad"] - pose, pose - planned["nominal_lowest_rad"])
    simulated_reach = max(simulated.highest - pose, pose - simulated.lowest)
    row["peaks"] = {
        "imported": imported,
        "amplitude": planned["amplitude_rad"],
        "torque": [planned["nominal_torque_nm"], simulated.torque],
        "speed": [planned["nominal_speed_rad_s"], simulated.speed],
        "reach": [planned_reach, simulated_reach],
    }
    largest = 0.0
    for name in ("torque", "speed", "reach"):
        ours, theirs = row["peaks"][name]
        largest = max(largest, abs(ours - theirs) / theirs if theirs else math.inf)
    row["peaks"]["difference"] = largest


def drives_of(robot: RobotSpec, joint: str) -> dict[str, Held]:
    """Return the drives of the joints that move with a joint, as its robot.yaml has them."""
    chain = {}
    for name in robot.joint(joint).chain or (joint,):
        link = robot.joint(name)
        chain[name] = Held(
            stiffness=link.stiffness,
            damping=link.damping,
            effort_limit=link.drive.effort_limit,
            armature=link.drive.armature,
            frictionloss=link.drive.frictionloss,
            viscous_damping=link.drive.viscous_damping,
        )
    return chain
