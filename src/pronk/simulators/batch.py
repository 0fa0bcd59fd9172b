"""Ask the simulator for responses: many joints and gain pairs in few rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.match.measured_joint import Target
from pronk.robots.robot import Robot
from pronk.simulators.device import bench_on
from pronk.simulators.mujoco import Bench, Count

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Job:
    """One simulation: a target's question with one pair of gains."""

    target: Target
    stiffness: float
    damping: float


class Simulator:
    """The benches of a robot, compiled when first asked for and kept."""

    def __init__(
        self,
        robot: Robot,
        *,
        armature: float | None = None,
        frictionloss: float | None = None,
        threads: int = 2,
        device: str = "cpu",
    ) -> None:
        """Take note of the robot.

        Args:
            robot: The robot.
            armature: Rotor inertia of the asked joint [kg m^2]; the drive's if not given.
            frictionloss: Dry friction of the asked joint [N m]; the drive's if not given.
            threads: Threads of the simulator.
            device: Where large runs are simulated; see `pronk.simulators.device.DEVICES`.

        Raises:
            PronkError: The device is unknown or cannot be used here.
        """
        self.robot = robot
        self._new_bench = bench_on(device)
        self._armature = armature
        self._frictionloss = frictionloss
        self._threads = threads
        self._benches: dict[str, Bench] = {}

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the threads of every bench."""
        for bench in self._benches.values():
            bench.close()
        self._benches.clear()

    def bench(self, joint: str) -> Bench:
        """The bench that is simulated for a joint: that of its mirrored original."""
        original = self.robot.joint(joint).original[0]
        if original not in self._benches:
            self._benches[original] = self._new_bench(
                self.robot,
                original,
                armature=self._armature,
                frictionloss=self._frictionloss,
                threads=self._threads,
            )
        return self._benches[original]

    @property
    def count(self) -> Count:
        """Steps and seconds of all benches together."""
        counts = [bench.count for bench in self._benches.values()]
        return Count(
            steps=sum(count.steps for count in counts),
            seconds=sum(count.seconds for count in counts),
        )

    def responses(self, jobs: Sequence[Job], *, whole: bool = False) -> list[ComplexArray]:
        """Simulated responses, one a job.

        Args:
            jobs: What to simulate.
            whole: All frequencies of the target instead of those inside its band.

        Returns:
            Each of shape (inside,), or (f,) if `whole`. NaN where a simulation diverged.
        """
        out: list[ComplexArray] = [np.empty(0, dtype=np.complex128)] * len(jobs)
        by_original: dict[str, list[int]] = {}
        for i, job in enumerate(jobs):
            original = self.robot.joint(job.target.joint).original[0]
            by_original.setdefault(original, []).append(i)
        for indices in by_original.values():
            self._ask([jobs[i] for i in indices], indices, out, whole)
        return out

    def _ask(
        self, jobs: Sequence[Job], indices: Sequence[int], out: list[ComplexArray], whole: bool
    ) -> None:
        """Simulate jobs that share an original joint, in one rollout."""
        bench = self.bench(jobs[0].target.joint)
        lengths = [len(job.target.matrix) if whole else job.target.steps for job in jobs]
        longest = max(lengths)
        commands, poses = [], []
        for job in jobs:
            command = job.target.question.mirrored(self.robot)[2][:longest]
            # Shorter questions rest at the pose until the longest has ended.
            commands.append(np.pad(command, (0, longest - len(command))))
            poses.append(bench.pose(job.target.question))
        stiffness = np.array([job.stiffness for job in jobs])
        damping = np.array([job.damping for job in jobs])
        for part, position in bench.run(commands, poses, stiffness, damping):
            for row, i in enumerate(range(part.start, part.stop)):
                goal = jobs[i].target
                read = goal.whole_answer if whole else goal.answer
                out[indices[i]] = read(position[row])
