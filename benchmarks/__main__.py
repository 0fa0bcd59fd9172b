"""Command line of the benchmarks: `python -m benchmarks NAME`."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import tyro

from pronk.cli import console
from pronk.cli.main import run_commands
from pronk.errors import PronkError


def match(
    trials: int = 5,
    seed: int = 0,
    json_file: console.JsonFile = None,
) -> None:
    """Match logs of known truth with pronk, mujoco.sysid and CMA-ES; bias, coverage, time.

    Args:
        trials: Logs of each scenario.
        seed: Of the noise.
        json_file: Also write the figures to this file.
    """
    import orjson

    from benchmarks.match import run, table

    def one_bar(_: str, share: float) -> None:
        report("bench", share)

    with console.progress() as report:
        result = run(trials, seed, one_bar)
    console.show(table(result))
    console.write_json(json_file, orjson.loads(result.to_json()))
    console.following(
        "python -m benchmarks match --trials 20   # steadier coverage, about 20 s a log"
    )


def grid(
    points: int = 50,
    json_file: console.JsonFile = None,
) -> None:
    """The paper's grid on twelve joints of known truth, beside a bare mujoco.rollout loop.

    Args:
        points: Points of each axis; the paper has 50.
        json_file: Also write the figures to this file.
    """
    from dataclasses import asdict

    from benchmarks.search import run, table

    with console.progress() as report:
        result = run(report, points=points)
    console.show(table(result))
    derived = {"steps_per_second": result.steps_per_second, "ratio": result.ratio}
    console.write_json(json_file, asdict(result) | derived)
    console.following("python -m benchmarks engine   # what the simulator's step does to a joint")


def engine(
    json_file: console.JsonFile = None,
) -> None:
    """The same drive at a 0.25 ms step and in the 5 ms training simulator, before and after.

    Args:
        json_file: Also write the figures to this file.
    """
    from benchmarks.engine import run, table

    with console.progress() as report:
        gaps = run(report)
    console.show(table(gaps))
    console.write_json(
        json_file,
        {
            gap.joint: {
                "gains": gap.gains,
                "equal_gains_rms_db": gap.equal_gains_rms_db,
                "equal_gains_max_db": gap.equal_gains_max_db,
                "matched_gains": gap.matched_gains,
                "matched_rms_db": gap.matched_rms_db,
            }
            for gap in gaps
        },
    )
    console.following("python -m benchmarks coverage   # coverage of the intervals")


def coverage(
    trials: int = 200,
    seed: int = 0,
    json_file: console.JsonFile = None,
) -> None:
    """How often the 95 % intervals hold the truth under coloured noise.

    Args:
        trials: Logs of each joint.
        seed: Of the noise.
        json_file: Also write the figures to this file.
    """
    from dataclasses import asdict

    from benchmarks.coverage import run, table

    with console.progress() as report:
        rows = run(trials, seed, report)
    console.show(table(rows))
    console.write_json(json_file, {one.joint: asdict(one) for one in rows})
    console.following("python -m benchmarks match   # the same logs in mujoco.sysid and CMA-ES")


def tick(
    policy: tyro.conf.Positional[Path],
    seconds: float = 40.0,
    json_file: console.JsonFile = None,
) -> None:
    """Lateness and the policy's answer at 50 Hz: idle, beside CPU hogs, with real time, without.

    Args:
        policy: policy.onnx, which decides at each tick.
        seconds: Of each of the four cases.
        json_file: Also write the figures to this file.
    """
    from benchmarks.tick import bars, figures, run, table

    with console.progress() as report:
        rows = run(policy, seconds, report)
    console.show(table(rows))
    console.show(bars(rows))
    for line in dict.fromkeys(line for row in rows for line in row.granted):
        console.say(line)
    console.write_json(json_file, figures(rows))
    console.following(
        f"pronk deploy {policy} --script 1,0,0   # the whole loop, on the virtual robot"
    )


def train(
    envs: str = "4096,16384",
    steps: int = 50,
    iterations: int = 1,
    repeats: int = 4,
    device: str = "auto",
    gpu_ids: str | None = None,
    json_file: console.JsonFile = None,
) -> None:
    """Steps per second of the jump task and of mjlab's own Go1 task, stage by stage.

    Args:
        envs: Numbers of environments.
        steps: Steps in a block of stepping.
        iterations: Iterations in a block of training.
        repeats: Blocks of each task, taken in turn.
        device: auto, cuda or cpu (to try it out).
        gpu_ids: GPUs, such as 0,1: training on one and on all of them as well.
        json_file: Also write the figures to this file.
    """
    from benchmarks.train import run, stage_table, table

    begin = time.perf_counter()

    def line(text: str) -> None:
        seconds = time.perf_counter() - begin
        console.err().print(f"{seconds:6.1f} s  {text}", markup=False)

    result = run(
        line,
        envs=_numbers(envs),
        steps=steps,
        iterations=iterations,
        repeats=repeats,
        device=device,
        gpu_ids=gpu_ids,
    )
    console.show(table(result))
    console.show(stage_table(result))
    console.write_json(json_file, result.figures())
    console.following("pronk train all   # trains with the environment that was measured")


def _numbers(text: str) -> list[int]:
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdigit() for word in words):
        raise PronkError(f"--envs {text!r}: expected whole numbers, such as 4096,16384.")
    return [int(word) for word in words]


def trial(
    policy: tyro.conf.Positional[Path],
    repeats: int = 7,
    sim_params: Path | None = None,
    seed: int = 0,
    json_file: console.JsonFile = None,
) -> None:
    """Simulated seconds per second of the whole trial loop and of bare mj_step, over one run.

    Args:
        policy: policy.onnx.
        repeats: Runs of each loop, taken in turn.
        sim_params: Body of the virtual robot; the one that ships with pronk if left
            out.
        seed: Of the jump's start and noise.
        json_file: Also write the figures to this file.
    """
    from benchmarks.trial import run, table
    from pronk.virtual.sim_params import load_sim_params

    with console.progress() as report:
        result = run(
            policy,
            sim_params=load_sim_params(sim_params),
            repeats=repeats,
            seed=seed,
            progress=report,
        )
    console.show(table(result))
    console.write_json(json_file, result.figures())
    console.following(f"pronk trial {policy} --out out/trial   # 20 jumps with each command")


COMMANDS = {
    "match": ("benchmarks.__main__:match", "pronk, mujoco.sysid and CMA-ES on the same logs."),
    "grid": ("benchmarks.__main__:grid", "The paper's grid beside a bare mujoco.rollout loop."),
    "engine": ("benchmarks.__main__:engine", "The same drive at 0.25 ms and at 5 ms."),
    "coverage": ("benchmarks.__main__:coverage", "How often the 95 % intervals hold."),
    "latency": ("benchmarks.__main__:tick", "Lateness of the control loop, and policy latency."),
    "train": ("benchmarks.__main__:train", "Steps per second beside mjlab's Go1 task."),
    "trial": ("benchmarks.__main__:trial", "The trial loop beside a bare MuJoCo loop."),
}

if __name__ == "__main__":
    sys.exit(run_commands(COMMANDS, sys.argv[1:], "python -m benchmarks"))
