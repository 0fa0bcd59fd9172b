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
from dataclasses import dataclass
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
from pronk.tables import Column, Table

LIMIT = 0.6
"""Least speed over that of the bare loop [1]."""
ROBOT = "mini_cheetah"
CASE = PAPER_COMMANDS[1]


@dataclass(frozen=True)
class Block:
    """Physics steps between which nothing was set."""

    steps: int
    targets: Array
    """Targets of the drives."""
    motors: Array
    """Parameters of the motors."""


class Recording:
    """Every physics step of one run, and what was set before each block of them."""

    def __init__(self, job: TrialJob) -> None:
        """Run one job and record it."""
        self.blocks: list[Block] = []
        self._step = mujoco.mj_step
        self._data: Any = None
        with patch.object(mujoco, "mj_step", self._record):
            run_job(job)
        self.steps = sum(block.steps for block in self.blocks)
        self.timestep_s = float(self._model.opt.timestep)

    def _record(self, model: Any, data: Any, nstep: int = 1) -> None:
        """Record some steps, and do them."""
        if self._data is None:
            self._model = copy.deepcopy(model)
            self._begin = copy.deepcopy(data)
            self._data = data
        elif data is not self._data:
            raise PronkError("the trial stepped two simulations; the benchmark records one.")
        targets = data.ctrl.copy()
        motors = model.actuator_gainprm.copy()
        steps = nstep
        if self.blocks:
            block = self.blocks[-1]
            is_same = np.array_equal(block.targets, targets)
            if is_same and np.array_equal(block.motors, motors):
                self.blocks.pop()
                steps += block.steps
        self.blocks.append(Block(steps, targets, motors))
        self._step(model, data, nstep)

    def replay(self) -> float:
        """Repeat the run with `mujoco.mj_step` alone; return the processor time [s].

        Raises:
            PronkError: It ended in another state than the recorded run.
        """
        model = self._model
        data = copy.deepcopy(self._begin)
        step = self._step
        begun = time.process_time()
        for block in self.blocks:
            data.ctrl[:] = block.targets
            model.actuator_gainprm[:] = block.motors
            step(model, data, block.steps)
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

    Args:
        policy: File of the policy.
        progress: Called with a stage and the share of it that is done.
        sim_params: Parameters of the virtual robot; those that ship with pronk if None.
        repeats: Number of runs of each loop.
        seed: Seed of the jump's start and noise.

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
    setup = TrialSetup(robot=robot, sim_params=params, out=Path())
    (job,) = plan_jobs([subject], plan, setup)
    recording = Recording(job)  # the warm-up as well

    def run_trial_loop() -> float:
        begun = time.process_time()
        run_job(job)
        return time.process_time() - begun

    progress("trial", 0.0)
    trial_s, bare_s = in_turn([run_trial_loop, recording.replay], repeats)
    ratio, lowest, highest = paired_ratio(bare_s, trial_s)
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
        "ratio": ratio,
        "ratio_range": [lowest, highest],
        "limit": LIMIT,
        "passed": ratio >= LIMIT,
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
        seed: Seed of the jump's start and noise.
    """
    with console.progress() as report:
        params = load_sim_params(sim_params)
        figures = run(policy, report, sim_params=params, repeats=repeats, seed=seed)
    lowest, highest = figures["ratio_range"]
    limit = f"{LIMIT:.2f} {'reached' if figures['passed'] else 'MISSED'}"
    table = Table(
        title="Simulated seconds per second and core, virtual robot",
        columns=(
            Column(heading="loop"),
            Column(heading="simulated s per s", digits=2),
            Column(heading="ratio"),
            Column(heading="least ratio"),
        ),
        rows=(
            (
                "trial: build, settle, policy, sensors, capture, measure",
                figures["speed"],
                spread((figures["ratio"], lowest, highest)),
                limit,
            ),
            ("bare mujoco.mj_step", figures["bare_speed"], "1", ""),
        ),
        notes=(
            f"One jump with the command {CASE.name}: {figures['simulated_s']:.1f} s in "
            f"{figures['steps']:,} physics steps of {1e3 * figures['timestep_s']:g} ms, the same "
            f"in both loops; medians of {repeats} runs of each, taken in turn, processor time of "
            f"one thread. Policy {figures['policy']} ({figures['sha256'][:12]}), MuJoCo "
            f"{figures['machine']['mujoco']}, ONNX Runtime {figures['machine']['onnxruntime']}.",
        ),
    )
    return finish(figures, table)
