r"""The jump that training shows, done on the virtual robot: what there is to learn.

    python tools/shown_jumps.py walk.onnx
    python tools/shown_jumps.py policies/matched/policy.onnx --jump jump.yaml --jumps 20

A policy walks; from the jump command on the joint targets are those shown, until its estimator
feels ground again, and then the policy lands it and goes on. It is never told to jump. Script,
draws and figures are those of `pronk trial`.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
import yaml
from numpy.typing import ArrayLike, NDArray

from pronk.evaluation.job import Job, set_down
from pronk.evaluation.metrics import JumpFigures, measure
from pronk.evaluation.protocol import PAPER_COMMANDS, Case
from pronk.evaluation.run import Plan, draw, mass_of
from pronk.policy.observation import Measurement
from pronk.policy.runtime import Policy, load_policy
from pronk.robots import load_robot
from pronk.runtime.rollout import run_policy
from pronk.train.mdp.demonstration import Demonstration, demonstration, parse
from pronk.virtual.sim_params import SHIPPED, load_sim_params

PUSH_S = 0.26
"""After the jump command feet leave the ground no sooner [s]."""
FIGURES = {
    "height": "m",
    "distance": "m",
    "gap": "m",
    "lift_off_velocity": "m/s",
    "delay": "s",
    "speed": "m/s",
}


_OVER = 1 << 30
"""A row after all that is shown."""


class AsShown(Policy):
    """Walks by a network, and jumps as it is shown."""

    shown: Demonstration
    _row = _OVER
    _told = False
    _flew = False

    def reset(self) -> None:
        """Begin anew."""
        super().reset()
        self._row, self._told = _OVER, False

    def step(
        self, measurement: Measurement, command: ArrayLike, jump: bool = False
    ) -> NDArray[np.float64]:
        """As `Policy.step`."""
        if jump and not self._told:
            self._row, self._flew = 0, False
        self._told = jump
        measured = self._history.observe(measurement, command)
        self.inference = self._run(measured[None], np.zeros((1, 1), np.float32))
        action = self.inference.action[0]
        grounded = bool((self.inference.contact[0] > 0.5).any())
        if self._flew and grounded:
            self._row = _OVER
        self._flew |= not grounded and self._row * self.shown.step_s > PUSH_S
        if self._row < self.shown.targets.shape[1]:
            since = torch.tensor([self.shown.step_s * self._row])
            asked = torch.tensor(np.asarray(command, dtype=np.float32)[None, :2])
            target = self.shown.at(since, asked)[0].numpy()
            action = ((target - self._default) / self._scale).astype(np.float32)
            self.inference = replace(self.inference, action=action[None])
        self._row += 1
        self._history.acted(action)
        found: NDArray[np.float64] = self._default + self._scale * action
        return found


def jump(case_number: tuple[Case, int], *, path: Path, shown: Demonstration) -> JumpFigures:
    """One jump on the virtual robot."""
    torch.set_num_threads(1)
    walks, robot, plan = load_policy(path), load_robot("mini_cheetah"), Plan()
    policy = AsShown(walks._session, walks.contract, sha256=walks.sha256)
    policy.shown = shown
    script, start, seed = draw(plan, *case_number, robot)
    job = Job(
        policy=path,
        sha256=walks.sha256,
        robot=robot.name,
        sim_params=load_sim_params(SHIPPED),
        ground=None,
        start=start,
        seed=seed,
        script=script,
        rules=plan.rules,
        mass=mass_of(robot),
        keep=None,
    )
    machine = set_down(job)
    flown = run_policy(machine, policy, robot, script.commanded, seconds=script.seconds)
    seen = machine.capture()
    return measure(seen, script, robot, began=flown.began, mass=job.mass, rules=job.rules)


def main() -> None:
    """Jump, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path, help="walk.onnx or policy.onnx.")
    parser.add_argument("--jump", type=Path, help="What is shown; that of the package.")
    parser.add_argument("--jumps", type=int, default=10, help="A command.")
    asked = parser.parse_args()
    shown = demonstration()
    if asked.jump:
        shown = parse(yaml.safe_load(asked.jump.read_text(encoding="utf-8")), str(asked.jump))
    jobs = [(case, number) for case in PAPER_COMMANDS for number in range(asked.jumps)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(partial(jump, path=asked.policy, shown=shown), jobs))
    for case in PAPER_COMMANDS:
        mine = [figures for (other, _), figures in zip(jobs, found, strict=True) if other == case]
        print(f"{case.name} (virtual robot): {sentence(mine)}")


def sentence(jumps: list[JumpFigures]) -> str:
    """Means, standard deviations and counts of some jumps."""

    def of(name: str) -> Any:
        return np.array([getattr(figures, name) for figures in jumps], dtype=float)

    means = (
        f"{name.replace('_', ' ')} {np.nanmean(of(name)):.3f} +- {np.nanstd(of(name)):.3f} {unit}"
        for name, unit in FIGURES.items()
        if np.isfinite(of(name)).any()
    )
    counts = (f"{flag} {int(of(flag).sum())}" for flag in ("success", "touched", "fell"))
    return f"{', '.join(means)}; of {len(jumps)}: {', '.join(counts)}"


if __name__ == "__main__":
    main()
