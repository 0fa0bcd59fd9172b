"""`pronk bench trial`: the whole trial loop beside a bare MuJoCo loop, over the very same run.

The trial loop is all that `pronk trial` does for a jump: it builds the virtual robot, sets it down,
lets the policy run it, turns what was seen into a capture and measures the jump. Once, every
physics step of it is taped: how many at a time, and what was set before (targets of the drives,
voltage of the battery). The bare loop is `mujoco.mj_step` over that tape, with the same model from
the same state, and nothing else; it must end in the same state to the last bit.

Both take turns in one process, and who goes first changes with every turn. Times are of the
processor, one thread: other work on the machine does not count.
"""

from __future__ import annotations

import copy
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from pronk.errors import PronkError
from pronk.evaluation.protocol import PAPER_COMMANDS, Case
from pronk.evaluation.trial import Job, Plan, load_subjects, plan_jobs, run_job, versions
from pronk.robots import load_robot
from pronk.virtual.sim_params import SimParams, load_sim_params

Array = NDArray[np.float64]

SCHEMA = "pronk/bench-trial/1"
BAR = 0.6
"""Speed over that of the bare loop that pronk sets itself."""
REPEATS = 7
ROBOT = "mini_cheetah"
CASE = PAPER_COMMANDS[1]


@dataclass(frozen=True, kw_only=True)
class TrialBench:
    """What one run gave. Each tuple has one value a repeat."""

    policy: str
    sha256: str
    case: Case
    simulated_s: float
    """Of one run, settling included [s]."""
    steps: int
    timestep_s: float
    trial_s: tuple[float, ...]
    """Processor time of the whole trial loop [s]."""
    bare_s: tuple[float, ...]
    """Processor time of the bare loop [s]."""
    machine: dict[str, str] = field(default_factory=dict)

    @property
    def speed(self) -> float:
        """Simulated seconds per second and core of the trial loop, median."""
        return self.simulated_s / float(np.median(self.trial_s))

    @property
    def bare_speed(self) -> float:
        """The same of the bare loop."""
        return self.simulated_s / float(np.median(self.bare_s))

    @property
    def ratios(self) -> tuple[float, ...]:
        """Speed over that of the bare loop, of neighbouring runs."""
        return tuple(bare / trial for bare, trial in zip(self.bare_s, self.trial_s, strict=True))

    @property
    def ratio(self) -> float:
        """Their median."""
        return float(np.median(self.ratios))

    @property
    def passed(self) -> bool:
        """Whether the bar is reached."""
        return self.ratio >= BAR

    def figures(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {
            "schema": SCHEMA,
            **asdict(self),
            "speed": self.speed,
            "bare_speed": self.bare_speed,
            "ratios": self.ratios,
            "ratio": self.ratio,
            "bar": BAR,
            "passed": self.passed,
        }


class Tape:
    """Every physics step of one run, and what was set before each block of them."""

    def __init__(self) -> None:
        self.blocks: list[tuple[int, Array, Array]] = []
        """Steps, targets of the drives, parameters of the motors."""
        self._step = mujoco.mj_step
        self._model: Any = None
        self._begin: Any = None
        self._data: Any = None

    def step(self, model: Any, data: Any, nstep: int = 1) -> None:
        """`mujoco.mj_step`, taped."""
        if self._data is None:
            self._model, self._begin = copy.deepcopy(model), copy.deepcopy(data)
        elif data is not self._data:
            raise PronkError("the trial stepped two simulations; the bench tapes one.")
        self._data = data
        control, motors = data.ctrl.copy(), model.actuator_gainprm.copy()
        last = self.blocks[-1] if self.blocks else None
        if last and np.array_equal(last[1], control) and np.array_equal(last[2], motors):
            self.blocks[-1] = (last[0] + nstep, control, motors)
        else:
            self.blocks.append((nstep, control, motors))
        self._step(model, data, nstep)

    @property
    def steps(self) -> int:
        """Physics steps in all."""
        return sum(steps for steps, _, _ in self.blocks)

    @property
    def timestep_s(self) -> float:
        """Physics step [s]."""
        return float(self._model.opt.timestep)

    def replay(self) -> float:
        """Run the tape with `mujoco.mj_step` alone; returns the processor time [s].

        Raises:
            PronkError: It ended elsewhere than the run that was taped.
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
            raise PronkError("the bare loop ended in another state than the trial it replays.")
        return seconds


def tape(job: Job) -> Tape:
    """Run one job, taped."""
    taped = Tape()
    with patch.object(mujoco, "mj_step", taped.step):
        run_job(job)
    return taped


def run(
    policy: Path,
    *,
    sim_params: SimParams | None = None,
    case: Case = CASE,
    repeats: int = REPEATS,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> TrialBench:
    """Time the trial loop of one jump beside the bare loop.

    Args:
        policy: `policy.onnx`.
        sim_params: Body of the virtual robot; the shipped one if None.
        case: The command.
        repeats: Runs of each loop.
        seed: Of the jump's start and noise.
        progress: Told the share done.

    Raises:
        PronkError: The policy does not fit, or there is nothing to repeat.
    """
    if repeats < 1:
        raise PronkError(f"{repeats} repeats; expected 1 or more.")
    robot = load_robot(ROBOT)
    (subject,) = load_subjects([policy], robot)
    plan = Plan(cases=(case,), jumps=1, seed=seed)
    [(_, job)] = plan_jobs(
        [subject], plan, robot=robot, sim_params=sim_params or load_sim_params(), out=Path()
    )
    job = replace(job, keep=None)
    taped = tape(job)  # warms everything up as well
    times: dict[str, list[float]] = {"trial": [], "bare": []}
    for turn in range(repeats):
        for what in ("trial", "bare") if turn % 2 == 0 else ("bare", "trial"):
            times[what].append(taped.replay() if what == "bare" else _whole(job))
        if progress is not None:
            progress("trial", (turn + 1) / repeats)
    return TrialBench(
        policy=subject.name,
        sha256=subject.sha256,
        case=case,
        simulated_s=taped.steps * taped.timestep_s,
        steps=taped.steps,
        timestep_s=taped.timestep_s,
        trial_s=tuple(times["trial"]),
        bare_s=tuple(times["bare"]),
        machine={
            "cores": str(os.cpu_count()),
            "processor": platform.processor() or platform.machine(),
            **versions(),
        },
    )


def _whole(job: Job) -> float:
    """Processor time of the whole trial loop [s]."""
    begun = time.process_time()
    run_job(job)
    return time.process_time() - begun


def table(result: TrialBench) -> Table:
    """Both loops and their ratio, for a terminal."""
    low, high = min(result.ratios), max(result.ratios)
    made = Table(
        title=Text("Simulated seconds per second and core, virtual robot"),
        caption=Text(
            f"One jump with the command {result.case.name}: {result.simulated_s:.1f} s in "
            f"{result.steps:,} physics steps of {1e3 * result.timestep_s:g} ms, the very same in "
            f"both loops; medians of {len(result.trial_s)} runs of each, taken in turn, processor "
            f"time of one thread. Policy {result.policy} ({result.sha256[:12]}), MuJoCo "
            f"{result.machine['mujoco']}, ONNX Runtime {result.machine['onnxruntime']}."
        ),
        title_justify="left",
        caption_justify="left",
    )
    made.add_column("loop")
    for name in ("simulated s per s", "ratio", "bar"):
        made.add_column(name, justify="right")
    verdict = "reached" if result.passed else "MISSED"
    made.add_row(
        "trial: build, settle, policy, sensors, capture, measure",
        f"{result.speed:.2f}",
        f"{result.ratio:.2f} ({low:.2f} to {high:.2f})",
        f"{BAR:.2f} {verdict}",
    )
    made.add_row("bare mujoco.mj_step", f"{result.bare_speed:.2f}", "1", "")
    return made
