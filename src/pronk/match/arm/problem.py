"""The least-squares problem of an arm that moved all its joints at once.

Residuals are simulated less recorded positions over the samples that can be believed
(`pronk.match.arm.sample_mask`). One joint's parameters move its own position far more than its
neighbours', so the Jacobian is taken block-diagonal: one simulation per kind of parameter, in
which the parameter of every joint is moved at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pronk.match.arm.sample_mask import trusted_samples
from pronk.match.parameters import KINDS, PARAMETERS
from pronk.simulators.chain import ChainSimulation, Drives, JointDrive, asked_joints

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class DriveProblem:
    """Residuals and Jacobian of the drives of one arm, in scaled parameters."""

    def __init__(
        self,
        rig: ChainSimulation,
        asked: Mapping[str, tuple[str, ...]],
        start: Drives,
        told: Callable[[int], None] | None = None,
    ) -> None:
        """Take in the recordings.

        Args:
            rig: The arm and its recordings.
            asked: Names of the parameters to fit, by joint.
            start: Drives to begin with; the robot's published ones if not given.
            told: Told the number of simulations so far.
        """
        self.rig = rig
        self.asked = asked
        self.start = {
            joint: start.get(joint) or JointDrive.published(rig.robot, joint)
            for joint in rig.joints
        }
        self._given = frozenset(start)
        self.slots = [(joint, name) for joint in rig.joints for name in asked[joint]]
        """Joint and name of every scaled parameter."""
        self.measured = rig.measured()
        self.believed, self.limit_hz = believed(rig)
        self.evaluations = 0
        self._kinds = [name for name in PARAMETERS if any(name in n for n in asked.values())]
        self._told = told
        self._last: tuple[Array, list[Array]] | None = None

    @property
    def low(self) -> Array:
        """Lower bounds of the scaled parameters."""
        return np.array([KINDS[name].scaled(KINDS[name].low) for _, name in self.slots])

    @property
    def high(self) -> Array:
        """Upper bounds of the scaled parameters."""
        return np.array([KINDS[name].scaled(KINDS[name].high) for _, name in self.slots])

    @property
    def begin(self) -> Array:
        """Scaled parameters at which the search begins, strictly inside the bounds."""
        values = []
        for joint, name in self.slots:
            value = getattr(self.start[joint], name)
            # A published value may be a bad place to begin; one that was given is not.
            value = value if joint in self._given else max(value, KINDS[name].start)
            values.append(KINDS[name].scaled(max(value, KINDS[name].low)))
        inside = 1e-3 * (self.high - self.low)
        return np.asarray(np.clip(values, self.low + inside, self.high - inside))

    @property
    def rows(self) -> int:
        """Samples of all recordings together."""
        return sum(len(part) for part in self.measured)

    def drives(self, x: Array) -> dict[str, JointDrive]:
        """Drives that some scaled parameters stand for."""
        out = dict(self.start)
        for (joint, name), value in zip(self.slots, x, strict=True):
            out[joint] = replace(out[joint], **{name: KINDS[name].unscaled(float(value))})
        return out

    def residual(self, x: Array) -> Array:
        """Simulated less measured [rad], 0 where not believed, one joint after another."""
        return stacked(self.errors(x))

    def errors(self, x: Array) -> list[Array]:
        """The same, one array per recording, each of shape (n, joints)."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = (x.copy(), self.differences([self.drives(x)])[0])
        return self._last[1]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, block-diagonal, shape (joints * rows, parameters)."""
        low, high = self.low, self.high
        taken = np.array([KINDS[name].step for _, name in self.slots])
        taken = np.where(x + taken <= high, taken, -taken)
        moved = np.clip(x + taken, low, high)
        taken = moved - x
        sets = []
        for kind in self._kinds:
            mine = np.array([name == kind for _, name in self.slots])
            sets.append(self.drives(np.where(mine, moved, x)))
        before = stacked(self.errors(x))
        after = [stacked(parts) for parts in self.differences(sets)]
        out = np.zeros((len(before), len(x)))
        for i, (joint, name) in enumerate(self.slots):
            block = self.block(joint)
            change = after[self._kinds.index(name)][block] - before[block]
            out[block, i] = change / taken[i]
        return out

    def block(self, joint: str) -> slice:
        """Rows of the residual that are a joint's."""
        first = self.rig.joints.index(joint) * self.rows
        return slice(first, first + self.rows)

    def differences(self, sets: Sequence[Drives]) -> list[list[Array]]:
        """Simulated less measured of several sets of drives, one list of recordings a set."""
        out = []
        for answers in self.rig.run(sets):
            row = []
            for answer, measured, mask in zip(answers, self.measured, self.believed, strict=True):
                # What diverged is as wrong as a joint can be, not undefined.
                wrong = np.clip(np.nan_to_num(answer - measured, nan=np.pi), -np.pi, np.pi)
                row.append(np.where(mask, wrong, 0.0))
            out.append(row)
        self.evaluations += len(sets)
        if self._told is not None:
            self._told(self.evaluations)
        return out


def stacked(parts: Sequence[Array]) -> Array:
    """Recordings of shape (n, joints) as one vector, one joint after another."""
    return np.asarray(np.concatenate(parts).T.ravel())


def believed(rig: ChainSimulation) -> tuple[list[Mask], dict[str, float]]:
    """Samples to believe, shape (n, joints) a recording, and each joint's trusted frequency [Hz].

    The frequency is infinite where no recording ran out of coherence.
    """
    masks, limit = [], dict.fromkeys(rig.joints, float("inf"))
    for log in rig.logs:
        asked, _ = asked_joints(log, rig.robot)
        mask = np.zeros((len(log.time), len(rig.joints)), dtype=bool)
        for i, joint in enumerate(rig.joints):
            if joint in asked:
                mask[:, i], highest = trusted_samples(log, joint)
                if not mask[:, i].all():
                    limit[joint] = min(limit[joint], highest)
        masks.append(mask)
    return masks, limit
