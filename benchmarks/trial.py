"""`python -m benchmarks trial`: the whole trial loop beside a bare MuJoCo loop, over one run.

The trial loop is all that `pronk trial` does for a jump: build the virtual robot, set it down, run
the policy, record and measure the jump. It is run once while every physics step is recorded: how
many at a time, and the controls and motor parameters set before. The bare loop is `mujoco.mj_step`
over that recording, with the same model from the same state; it must end in the same state to the
last bit. Times are of the processor, one thread.
"""

from __future__ import annotations

import copy
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
import tyro

from benchmarks.runner import Progress, finish, in_turn, machine, paired_ratio, spread
from pronk.arrays import Array
from pronk.cli import console
from pronk.errors import PronkError
from pronk.jump.trial.protocol import PAPER_COMMANDS
from pronk.jump.trial.trial import (
    TrialJob,
    TrialPlan,
    TrialSetup,
    load_subjects,
    plan_jobs,
    run_job,
)
from pronk.jump.virtual.sim_params import SimParams, load_sim_params
from pronk.robots import load_robot

LIMIT = 0.6
"""Least speed over that of the bare loop."""
ROBOT = "mini_cheetah"
CASE = PAPER_COMMANDS[1]


class Recording:
    """Every physics step of one run, and what was set before each block of them."""

    def __init__(self, job: TrialJob) -> None:
        """Run one job and record it."""
        self.blocks: list[tuple[int, Array, Array]] = []
        """Steps, targets of the drives, parameters of the motors."""
        self._step = mujoco.mj_step
        self._data: Any = None
        with patch.object(mujoco, "mj_step", self._record):
            run_job(job)
        self.steps = sum(steps for steps, _, _ in self.blocks)
        self.timestep_s = float(self._model.opt.timestep)

    def _record(self, model: Any, data: Any, nstep: int = 1) -> None:
        if self._data is None:
            self._model, self._begin = copy.deepcopy(model), copy.deepcopy(data)
        elif data is not self._data:
            raise PronkError("the trial stepped two simulations; the benchmark records one.")
        self._data = data
        control, motors = data.ctrl.copy(), model.actuator_gainprm.copy()
        last = self.blocks[-1] if self.blocks else None
        if last and np.array_equal(last[1], control) and np.array_equal(last[2], motors):
            self.blocks[-1] = (last[0] + nstep, control, motors)
        else:
            self.blocks.append((nstep, control, motors))
        self._step(model, data, nstep)

    def replay(self) -> float:
        """Repeat the run with `mujoco.mj_step` alone; returns the processor time [s].

        Raises:
            PronkError: It ended in another state than the recorded run.
        """
        model, data, step = self._model, copy.deepcopy(self._begin), self._step
        control, motors = data.ctrl, model.actuator_gainprm
        begun = time.process_time()
        for steps, targets, parameters in self.blocks:
            control[:] = targets
            motors[:] = parameters
            step(model, data, steps)
        seconds = time.process_time() - begun
        if not np.array_equal(data.qpos, self._data.qpos):
            raise PronkError("the bare loop ended in another state than the recorded trial.")
        return seconds


def run(
    policy: Path,
    progress: Progress,
    *,
    sim_params: SimParams | None = None,
    repeats: int = 7,
    seed: int = 0,
) -> dict[str, Any]:
    """Time the trial loop of one jump beside the bare loop.

    Returns:
        Processor times of both loops [s], simulated seconds per second (medians), and the paired
        ratio with its range.

    Raises:
        PronkError: The policy does not fit the robot, or there is nothing to repeat.
    """
    if repeats < 1:
        raise PronkError(f"{repeats} repeats; expected 1 or more.")
    robot = load_robot(ROBOT)
    (subject,) = load_subjects([policy], robot)
    plan = TrialPlan(cases=(CASE,), jumps=1, seed=seed)
    params = sim_params or load_sim_params()
    [job] = plan_jobs([subject], plan, TrialSetup(robot=robot, sim_params=params, out=Path()))
    recording = Recording(job)  # the warm-up as well

    def trial_block() -> float:
        begun = time.process_time()
        run_job(job)
        return time.process_time() - begun

    progress("trial", 0.0)
    trial_s, bare_s = in_turn([trial_block, recording.replay], repeats)
    middle, *extremes = paired_ratio(bare_s, trial_s)
    simulated_s = recording.steps * recording.timestep_s
    return {
        "policy": subject.name,
        "sha256": subject.sha256,
        "steps": recording.steps,
        "timestep_s": recording.timestep_s,
        "machine": machine("mujoco", "onnxruntime"),
        "trial_s": trial_s,
        "bare_s": bare_s,
        "simulated_s": simulated_s,
        "speed": simulated_s / float(np.median(trial_s)),
        "bare_speed": simulated_s / float(np.median(bare_s)),
        "ratio": middle,
        "ratio_range": extremes,
        "limit": LIMIT,
        "passed": middle >= LIMIT,
    }


def trial(
    policy: tyro.conf.Positional[Path],
    repeats: int = 7,
    sim_params: Path | None = None,
    seed: int = 0,
) -> console.Outcome:
    """Simulated seconds per second of the whole trial loop and of bare mj_step, over one run.

    Args:
        policy: policy.onnx.
        repeats: Runs of each loop, taken in turn.
        sim_params: Parameters of the virtual robot; those that ship with pronk if left out.
        seed: Of the jump's start and noise.
    """
    with console.progress() as report:
        chosen = load_sim_params(sim_params)
        found = run(policy, report, sim_params=chosen, repeats=repeats, seed=seed)
    caption = (
        f"One jump with the command {CASE.name}: {found['simulated_s']:.1f} s in "
        f"{found['steps']:,} physics steps of {1e3 * found['timestep_s']:g} ms, the same in both "
        f"loops; medians of {repeats} runs of each, taken in turn, processor time of one thread. "
        f"Policy {found['policy']} ({found['sha256'][:12]}), MuJoCo {found['machine']['mujoco']}, "
        f"ONNX Runtime {found['machine']['onnxruntime']}."
    )
    ratio = spread((found["ratio"], *found["ratio_range"]))
    limit = f"{LIMIT:.2f} {'reached' if found['passed'] else 'MISSED'}"
    whole = "trial: build, settle, policy, sensors, capture, measure"
    rows = [
        (whole, f"{found['speed']:.2f}", ratio, limit),
        ("bare mujoco.mj_step", f"{found['bare_speed']:.2f}", "1", ""),
    ]
    columns = ("loop", "simulated s per s", "ratio", "least ratio")
    title = "Simulated seconds per second and core, virtual robot"
    return finish(found, console.table(title, columns, rows, caption))
