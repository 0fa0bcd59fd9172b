"""Command line of the benchmarks: `python -m benchmarks NAME`."""

from __future__ import annotations

import sys

from pronk.cli.main import run
from pronk.opengl import keep_opengl_out

SUMMARIES = {
    "match": "pronk and its peers on virtual robots drawn at random.",
    "ak80": "The torque fit on real AK80-6 recordings beside published parameters.",
    "go2": "Two policies that ran on real Go2s, on several drives and on the virtual Go2.",
    "go2-feet": "Falls of a policy that ran on real Go2s, on feet of several stiffnesses.",
    "go2-drives": "All joints of virtual Go2s, swept, matched, and judged by other recordings.",
    "known": "pronk, mujoco.sysid and CMA-ES on logs with known gains.",
    "grid": "The paper's grid beside a bare mujoco.rollout loop.",
    "engine": "The same drive at 0.25 ms and at 5 ms.",
    "coverage": "How often the 95 % intervals hold.",
    "wrong-inputs": "How often wrong inputs are named, and right ones flagged.",
    "foreign": "Robots of public packages to an export; honest and faulty logs of their joints.",
    "plan": "The forecast of a sweep beside plain MuJoCo.",
    "latency": "Lateness of the control loop, and policy latency.",
    "supervision": "False alarms and detection times of the sensors' supervision.",
    "sensor-faults": "From a sensor's fault to damping, over LCM and DDS in real time.",
    "probe": "Laws, parameters and faults of simulators drawn at random, named blind.",
    "frameworks": "Gains matched for frameworks, in the engines themselves, beside the logs.",
    "profiles": "The same logs matched for every profile: errors and time.",
    "reach": "How far a policy's jumps get by changes of its joint targets alone.",
    "transfer": "A policy in training simulators of other drive laws.",
    "fuzz": "Mutated files of every reader: tracebacks, hangs, other numbers.",
    "kills": "Processes of commands killed and stopped: files, orphans, damping.",
    "train": "Steps per second beside mjlab's Go1 task.",
    "trial": "The trial loop beside a bare MuJoCo loop.",
    "study": "A study on pages of the documentation, from its results.",
}
MODULES = {"foreign": "foreign.command"}
"""Modules whose names are not those of their benchmarks."""

if __name__ == "__main__":
    keep_opengl_out()
    commands = {}
    for name, summary in SUMMARIES.items():
        function = name.replace("-", "_")
        module = MODULES.get(name, function)
        commands[name] = (f"benchmarks.{module}:{function}", summary)
    sys.exit(run(sys.argv[1:], commands, "python -m benchmarks"))
