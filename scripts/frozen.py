"""Print the numbers that a change of structure must not move, and compare two checkouts.

    python scripts/frozen.py measure CHECKOUT --out new.json [--data ../shared/data] [--jobs 2]
    python scripts/frozen.py compare old.json new.json

`measure` runs the commands and benchmarks of a checkout in processes of their own, with its
sources, and writes one JSON file. It takes about ten minutes on two idle cores; `--only NAME`
measures a part. `compare` prints each number beside its bar and exits with 1 if one is missed.

| part | what is measured |
| --- | --- |
| grid | the paper's Table I by `--method paper`: distance from the known gains in grid cells |
| match | default match of a sweep of the virtual Mini Cheetah, all joints: gains and errors |
| robots | 20 random virtual robots, seed 27: held-out error and coverage of total intervals |
| so101 | five recordings of a real SO-101: error on the two that were not fitted |
| ak80 | real AK80-6 recordings: comparisons won against published parameters |
| trial | `pronk trial policies/matched/policy.onnx --seed 0`: every jump |
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
CELL = {"stiffness": (27.0 - 13.0) / 49.0, "damping": (0.7 - 0.1) / 49.0}
"""Distance of two nodes of the paper's grid [N m/rad], [N m s/rad]."""
PARAMETERS = ("stiffness", "damping", "frictionloss", "delay")
JUMP_FIGURES = ("height_m", "distance_m")
"""Columns of `trials.csv`."""
PRONK = "pronk"
NOMINAL = "nominal with delay"
COMMAND_LINE = "import sys; from pronk.cli.main import main; sys.exit(main())"


def run(checkout: Path, *words: str) -> str:
    """Run Python with the sources of a checkout; return what it prints."""
    environment = dict(os.environ)
    paths = [str(checkout / "src"), str(checkout), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    environment.setdefault("OMP_NUM_THREADS", "1")
    command = [sys.executable, *words]
    process = subprocess.run(
        command, cwd=checkout, env=environment, check=False, stdout=subprocess.PIPE, text=True
    )
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}:\n{process.stdout}")
    return process.stdout


def benchmark(checkout: Path, name: str, folder: Path, *options: str) -> Any:
    """Run a benchmark of a checkout and return its figures."""
    out = folder / f"{name}-{len(list(folder.iterdir()))}.json"
    run(checkout, "-m", "benchmarks", name, *options, "--json", str(out))
    return json.loads(out.read_text(encoding="utf-8"))


def pronk(checkout: Path, *words: str) -> None:
    """Run `pronk` of a checkout."""
    run(checkout, "-c", COMMAND_LINE, *words)


def measure_grid(checkout: Path, folder: Path) -> dict[str, Any]:
    """Distance of the refined gains from the known ones [grid cells], and the speed."""
    figures = benchmark(checkout, "grid", folder)
    cells = {}
    for row in figures["joints"]:
        distances = []
        for name, refined, known in zip(CELL, row["refined"], row["known"], strict=True):
            distances.append(abs(refined - known) / CELL[name])
        cells[row["joint"]] = max(distances)
    return {"cells": cells, "grid_s": figures["grid_s"], "ratio": figures["ratio"]}


def measure_match(checkout: Path, folder: Path) -> dict[str, Any]:
    """Gains, intervals and errors of the default match of twelve joints, and its time."""
    logs = folder / "logs"
    gains = folder / "match" / "gains.yaml"
    pronk(checkout, "sweep", "mini_cheetah", "--out", str(logs), "--seed", "0")
    begin = time.perf_counter()
    pronk(checkout, "match", str(logs), "--robot", "mini_cheetah", "--out", str(gains))
    seconds = time.perf_counter() - begin
    joints = {}
    for name, joint in yaml.safe_load(gains.read_text(encoding="utf-8"))["joints"].items():
        joints[name] = joint_numbers(joint)
    return {"joints": joints, "seconds": seconds}


def joint_numbers(joint: dict[str, Any]) -> dict[str, Any]:
    """Numbers of one joint in `gains.yaml`, of the first schema or of a later one."""
    quality = joint.get("quality", joint)
    numbers = {"error_db": quality["error_db"]}
    for name in ("stiffness", "damping"):
        entry = joint[name]
        if isinstance(entry, dict):  # From schema 2 on.
            numbers[name] = entry["value"]
            numbers[f"{name}_total95"] = entry["total95"]
        else:
            numbers[name] = entry
            numbers[f"{name}_total95"] = joint[f"{name}_total95"]
    return numbers


def measure_robots(checkout: Path, folder: Path, jobs: int) -> dict[str, Any]:
    """Held-out error over that of the nominal gains with delay, and coverage, of 60 joints."""
    options = ("--robots", "20", "--seed", "27", "--method", PRONK, "--jobs", str(jobs))
    rows = benchmark(checkout, "match", folder, *options, "--cache", str(folder))["rows"]
    ratios = held_out_ratios(rows)
    covered = dict.fromkeys(PARAMETERS, 0)
    for row in rows:
        if row["method"] != PRONK or "exact" not in row:
            continue
        for name in PARAMETERS:
            lower, upper = row["total"].get(name, (math.nan, math.nan))
            covered[name] += lower <= row["exact"][name] <= upper
    return {
        "joints": len(ratios),
        "median": sorted(ratios.values())[len(ratios) // 2],
        "below": sum(ratio < 1.0 for ratio in ratios.values()),
        "covered": covered,
        "ratios": ratios,
    }


def held_out_ratios(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Geometric mean over the held-out signals of pronk's error over the nominal one, by joint."""
    errors: dict[str, dict[str, dict[str, float]]] = {PRONK: {}, NOMINAL: {}}
    for row in rows:
        if row["method"] in errors and "rmse" in row:
            errors[row["method"]][f"{row['robot']} {row['joint']}"] = row["rmse"]
    ratios = {}
    for joint, matched in errors[PRONK].items():
        logarithms = []
        for signal, error in matched.items():
            nominal = errors[NOMINAL][joint].get(signal)
            if nominal is not None:
                logarithms.append(math.log(error / nominal))
        ratios[joint] = math.exp(sum(logarithms) / len(logarithms))
    return ratios


def measure_so101(checkout: Path, folder: Path, data: Path) -> dict[str, Any]:
    """Error of each joint on each recording that was not fitted [rad]."""
    options = ("--arm", str(data / "so101"), "--method", PRONK)
    rows = benchmark(checkout, "match", folder, *options)["rows"]
    return {"rmse": {row["joint"]: row["rmse"] for row in rows if row["method"] == PRONK}}


def measure_ak80(checkout: Path, folder: Path) -> dict[str, Any]:
    """Comparisons with published parameters that the fit wins, from the caption of the table."""
    del folder
    text = run(checkout, "-m", "benchmarks", "ak80")
    lower, cells = re.findall(r"lower\s+in\s+(\d+)\s+of\s+(\d+)", text)[0]
    return {"lower": int(lower), "cells": int(cells)}


def measure_trial(checkout: Path, folder: Path) -> dict[str, Any]:
    """Outcome, height and distance of every jump, to the digits of `trials.csv`."""
    out = folder / "trial"
    policy = checkout / "policies" / "matched" / "policy.onnx"
    begin = time.perf_counter()
    pronk(checkout, "trial", str(policy), "--seed", "0", "--out", str(out))
    seconds = time.perf_counter() - begin
    with (out / "trials.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    jumps = []
    for row in rows:
        figures = {name: f"{float(row[name]):.3f}" if row[name] else "" for name in JUMP_FIGURES}
        jumps.append([row["command"], row["success"], *figures.values()])
    return {"jumps": jumps, "seconds": seconds}


def measure(checkout: Path, data: Path, jobs: int, only: list[str]) -> dict[str, Any]:
    """Measure all parts, or some, and return the numbers by part."""
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        parts = {
            "grid": lambda: measure_grid(checkout, folder),
            "match": lambda: measure_match(checkout, folder),
            "robots": lambda: measure_robots(checkout, folder, jobs),
            "so101": lambda: measure_so101(checkout, folder, data),
            "ak80": lambda: measure_ak80(checkout, folder),
            "trial": lambda: measure_trial(checkout, folder),
        }
        for name in only or parts:
            begin = time.perf_counter()
            figures[name] = parts[name]()
            print(f"{name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    return figures


Row = tuple[str, str, str, str, bool]
"""What, before, after, bar, whether it is met."""


def compare(old: dict[str, Any], new: dict[str, Any]) -> list[Row]:
    """Compare the parts that both files have with their bars."""
    rows: list[Row] = []
    comparisons = {
        "grid": compare_grid,
        "match": compare_match,
        "robots": compare_robots,
        "so101": compare_so101,
        "ak80": compare_ak80,
        "trial": compare_trial,
    }
    for name, comparison in comparisons.items():
        if name in old and name in new:
            rows += comparison(old[name], new[name])
    return rows


def compare_grid(old: dict[str, Any], new: dict[str, Any]) -> list[Row]:
    """Twelve of twelve pairs within 0.1 cells of the known gains; speed within 5 %."""
    counts = []
    for figures in (old, new):
        counts.append(sum(distance <= 0.1 for distance in figures["cells"].values()))
    slower = old["ratio"] / new["ratio"]
    return [
        ("Table I, pairs within 0.1 cells", str(counts[0]), str(counts[1]), "12", counts[1] == 12),
        (
            "grid's speed over that of a bare rollout",
            f"{old['ratio']:.3f}",
            f"{new['ratio']:.3f}",
            "5 %",
            slower <= 1.05,
        ),
    ]


def compare_match(old: dict[str, Any], new: dict[str, Any]) -> list[Row]:
    """Gains within the old 95 % intervals, and the error in the band no larger by 0.01 dB."""
    inside = 0
    worst_db = -math.inf
    for name, before in old["joints"].items():
        after = new["joints"][name]
        for gain in ("stiffness", "damping"):
            lower, upper = before[f"{gain}_total95"]
            inside += lower <= after[gain] <= upper
        worst_db = max(worst_db, after["error_db"] - before["error_db"])
    count = 2 * len(old["joints"])
    return [
        ("gains within the old intervals", str(count), str(inside), str(count), inside == count),
        ("largest rise of the error [dB]", "0", f"{worst_db:.4f}", "0.01", worst_db <= 0.01),
        (
            "`pronk match` on twelve logs [s]",
            f"{old['seconds']:.1f}",
            f"{new['seconds']:.1f}",
            "14 on two idle cores",
            True,
        ),
    ]


def compare_robots(old: dict[str, Any], new: dict[str, Any]) -> list[Row]:
    """Median ratio 0.47 or less, 60 of 60 below nominal, coverage 55 of 60 or more."""
    rows: list[Row] = [
        (
            "random robots, median held-out ratio",
            f"{old['median']:.3f}",
            f"{new['median']:.3f}",
            "0.47",
            new["median"] <= 0.475,
        ),
        (
            "below nominal with delay",
            str(old["below"]),
            str(new["below"]),
            f"{new['joints']}",
            new["below"] == new["joints"],
        ),
    ]
    for name in PARAMETERS:
        before = old["covered"][name]
        after = new["covered"][name]
        rows.append((f"coverage of {name}", str(before), str(after), "55", after >= 55))
    return rows


def compare_so101(old: dict[str, Any], new: dict[str, Any]) -> list[Row]:
    """The error on what was not fitted no larger by more than 3 %, joint by joint."""
    rows: list[Row] = []
    for joint, errors in old["rmse"].items():
        for recording, before in errors.items():
            after = new["rmse"][joint][recording]
            rows.append(
                (
                    f"SO-101 {joint}, {recording} [mrad]",
                    f"{1e3 * before:.3f}",
                    f"{1e3 * after:.3f}",
                    "3 %",
                    after <= 1.03 * before,
                )
            )
    return rows


def compare_ak80(old: dict[str, Any], new: dict[str, Any]) -> list[Row]:
    """Thirty or more of 32 comparisons won."""
    before = f"{old['lower']} of {old['cells']}"
    after = f"{new['lower']} of {new['cells']}"
    return [("AK80-6, comparisons won", before, after, "30", new["lower"] >= 30)]


def compare_trial(old: dict[str, Any], new: dict[str, Any]) -> list[Row]:
    """The same landings, heights and distances, jump by jump."""
    alike = sum(before == after for before, after in zip(old["jumps"], new["jumps"], strict=False))
    count = len(old["jumps"])
    same = alike == count == len(new["jumps"])
    return [("jumps alike to the printed digits", str(count), str(alike), str(count), same)]


def main() -> int:
    """Measure a checkout, or compare two files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    measuring = commands.add_parser("measure", help="run a checkout and write its numbers")
    measuring.add_argument("checkout", type=Path, nargs="?", default=ROOT)
    measuring.add_argument("--out", type=Path, required=True)
    measuring.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    measuring.add_argument("--jobs", type=int, default=2, help="processes of part `robots`")
    measuring.add_argument("--only", action="append", default=[], help="a part; may be repeated")
    comparing = commands.add_parser("compare", help="compare two files of `measure`")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "measure":
        figures = measure(
            arguments.checkout.resolve(), arguments.data.resolve(), arguments.jobs, arguments.only
        )
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        return 0
    old = json.loads(arguments.old.read_text(encoding="utf-8"))
    new = json.loads(arguments.new.read_text(encoding="utf-8"))
    rows = compare(old, new)
    for what, before, after, bar, met in rows:
        print(f"{what:46} {before:>12} {after:>12}   bar {bar:22} {'met' if met else 'MISSED'}")
    return 0 if all(met for *_, met in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
