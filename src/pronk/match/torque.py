"""Fit of drives from joint torque beside position, without a position loop.

The equation of motion is linear in everything sought:

    torque = scale * (rigid(q, v, a) + armature a + viscous v + dry sign(v) + stribeck s(v))

with s(v) = sign(v) exp(-(v / V)^2). The links are held as the model has them, or fitted too: mass,
first moment and inertia of each body, with its centre of mass on the model's line from the joint
(off that line it passes for an offset of the encoders). Torque does not distinguish a factor of the
torque sensor from a factor of all masses, so the scale is fitted only with the links known. The
armature of a joint is apart from its link where another joint's coupling shows the link's inertia
alone; joints with the same actuator may share one armature. What the regression leaves open is
found by the null space of the regressor and is not reported as a number. Viscous and
Stribeck friction that the recordings do not identify are held at zero, and the rest is fitted
again.

Velocity and acceleration are derivatives of the measured position, all low-passed alike and
without phase shift. The zero of the torque sensor is taken as right: recordings that begin at rest
show it, and in the fit it passes for gravity.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.match.uncertainty import block_moves, jackknife
from pronk.robots.robot import RobotSpec

Array = NDArray[np.float64]

MOTION_HZ = 40.0
"""Cutoff of position before it is differentiated [Hz]."""
FIT_HZ = 3.0
"""Cutoff of both sides of the equation [Hz]. On the AK80-6 recordings the residual of the fitted
logs is .04 to .07 N m at the shoulder below 3 Hz and .16 to .18 below 10 Hz, and the noise of the
acceleration there biases every inertia low, by 14 % at 10 Hz."""
RATE_HZ = 250.0
"""Rate at which the equation of motion is evaluated [Hz]."""
BLOCK_S = 2.5
"""Block of the intervals [s], the shortest of `arm.BLOCKS_S`."""
SIGN_RAD_S = 0.05
"""Speed over which sign(v) changes, as tanh(v / speed) [rad/s]."""
STRIBECK_RAD_S = 0.5
"""Speed V of the Stribeck term [rad/s]."""
_RANK = 1e-4
"""Singular values of the scaled regressor below this share of the largest are null: below it,
the noise of an acceleration differentiated at `MOTION_HZ` exceeds the signal."""
_PASSES = 3
"""Passes of the weights by joint."""
_NULL = 1e-2
"""Share of a parameter in the null space from which on it is not identified."""
_SD_MAX = 0.3
"""Relative standard deviation of an identified parameter, as `Parameter.sd_max`."""
_PLACES = (0.0, 1.0, -1.0)
"""Point masses that span the inertia of a body: places on the line from its joint through its
centre of mass, in units of that distance."""
_HELD_FIRST = ("stribeck", "viscous")
"""Terms held at zero where they are not identified, in this order."""
DRIVE_TERMS = ("armature", "viscous", "dry", "stribeck")
UNITS = {
    "armature": "kg m^2",
    "viscous": "N m s/rad",
    "dry": "N m",
    "stribeck": "N m",
    "scale": "1",
}


@dataclass(frozen=True, kw_only=True)
class TorqueParameter:
    """One parameter of a joint's drive."""

    value: float
    """NaN if the recordings leave it open."""
    ci95: tuple[float, float]
    """95 % interval by blocks of the recordings."""
    identified: bool
    reason: str = ""
    """Why it is not identified."""


@dataclass(frozen=True, kw_only=True)
class TorqueFit:
    """Drives, and links where they were fitted."""

    joints: dict[str, dict[str, TorqueParameter]]
    """By joint: the names of `UNITS`."""
    coefficients: Array
    """Of the columns of `regressor`, shape (p,)."""
    rank: int
    """Independent combinations of parameters that the recordings show."""
    rms: Array
    """Residual of each joint's torque below `FIT_HZ` [N m], shape (joints,)."""
    blocks: int
    model: TorqueModel

    def torque(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torque that the sensor would show by inverse dynamics [N m], shape (n, joints)."""
        columns = self.model.regressor(position, velocity, acceleration)
        return np.asarray(columns @ self.coefficients)


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A recording on an even grid, low-passed at `MOTION_HZ`."""

    time: Array
    """[s], shape (n,)."""
    position: Array
    """[rad], shape (n, joints)."""
    velocity: Array
    """[rad/s], shape (n, joints)."""
    acceleration: Array
    """[rad/s^2], shape (n, joints)."""
    torque: Array
    """[N m], shape (n, joints)."""


def low_passed(values: Array, rate_hz: float, cutoff_hz: float) -> Array:
    """Filter along the first axis without phase shift."""
    sos = signal.butter(3, cutoff_hz, fs=rate_hz, output="sos")
    return np.asarray(signal.sosfiltfilt(sos, values, axis=0))


def motion(log: JointLog, joints: Sequence[str]) -> Motion:
    """Position, its derivatives and torque of some joints.

    Raises:
        LogError: The log has no torque, or samples too slowly.
    """
    where = log.source or "log"
    if log.torque is None:
        raise LogError(f"{where}: no torque channel; the torque fit needs one.")
    if log.rate_hz < 4.0 * MOTION_HZ:
        raise LogError(
            f"{where}: {log.rate_hz:.0f} Hz; accelerations need {4.0 * MOTION_HZ:.0f} Hz or more."
        )
    columns = [log.column(name) for name in joints]
    time = np.arange(log.time[0], log.time[-1], 1.0 / log.rate_hz)

    def even(values: Array) -> Array:
        return np.stack([np.interp(time, log.time, values[:, c]) for c in columns], axis=1)

    position = low_passed(even(log.position), log.rate_hz, MOTION_HZ)
    velocity = np.gradient(position, time, axis=0)
    return Motion(
        time=time,
        position=position,
        velocity=velocity,
        acceleration=np.gradient(velocity, time, axis=0),
        torque=low_passed(even(log.torque), log.rate_hz, MOTION_HZ),
    )


class TorqueModel:
    """Columns of the equation of motion of a robot with a fixed base."""

    def __init__(
        self, robot: RobotSpec, *, links_known: bool, shared: Sequence[Sequence[str]] = ()
    ) -> None:
        """Choose what is fitted.

        Args:
            robot: Geometry, and the links' inertia if known.
            links_known: Hold the links as the model has them, and fit the torque scale.
            shared: Groups of joints with the same actuator: one armature for each group.
        """
        self.model = robot.build_spec().compile()
        self.joints = tuple(self.model.joint(i).name for i in range(self.model.njnt))
        if self.model.nv != self.model.njnt:
            raise LogError("the torque fit is for robots with a fixed base and hinges.")
        self.links_known = links_known
        groups = {name: tuple(group) for group in shared for name in group}
        self.armature_of = {name: groups.get(name, (name,)) for name in self.joints}
        self.names: list[tuple[str, str]] = []
        """Joint (or body) and parameter of each column."""
        if links_known:
            self.names += [(name, "scale") for name in self.joints]
        else:
            for body in range(1, self.model.nbody):
                if self.model.body_weldid[body] != 0:
                    self.names += [
                        (self.model.body(body).name, f"mass_{k}") for k in range(len(_PLACES))
                    ]
        self._rigid = len(self.names)
        for term in DRIVE_TERMS:
            for name in self.joints:
                owner = self.armature_of[name][0] if term == "armature" else name
                if (owner, term) not in self.names:
                    self.names.append((owner, term))

    def regressor(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torque of each joint for a unit of each parameter, shape (n, joints, p).

        With the links known the columns of `armature` and friction carry the scale as well.
        """
        out = np.zeros((*position.shape, len(self.names)))
        own = copy.copy(self.model)
        if self.links_known:
            rigid = self._rne(own, position, velocity, acceleration)
            for j in range(len(self.joints)):
                out[:, j, j] = rigid[:, j]
        else:
            column, places = 0, own.body_ipos.copy()
            for body in range(1, own.nbody):
                if own.body_weldid[body] == 0:
                    continue
                for place in _PLACES:
                    own.body_mass[:], own.body_inertia[:] = 0.0, 0.0
                    own.body_mass[body], own.body_ipos[body] = 1.0, place * places[body]
                    out[:, :, column] = self._rne(own, position, velocity, acceleration)
                    column += 1
        sign = np.tanh(velocity / SIGN_RAD_S)
        terms = {
            "armature": acceleration,
            "viscous": velocity,
            "dry": sign,
            "stribeck": sign * np.exp(-((velocity / STRIBECK_RAD_S) ** 2)),
        }
        for term, values in terms.items():
            for j, name in enumerate(self.joints):
                owner = self.armature_of[name][0] if term == "armature" else name
                out[:, j, self.names.index((owner, term))] = values[:, j]
        return out

    def _rne(
        self, model: mujoco.MjModel, position: Array, velocity: Array, acceleration: Array
    ) -> Array:
        """Inverse dynamics of the links alone [N m], shape (n, joints)."""
        data, out = mujoco.MjData(model), np.empty(position.shape)
        result = np.empty(model.nv)
        for k in range(len(position)):
            data.qpos[:], data.qvel[:], data.qacc[:] = position[k], velocity[k], acceleration[k]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 1, result)
            out[k] = result
        return out


def fit_torque(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    *,
    links_known: bool,
    shared: Sequence[Sequence[str]] = (),
) -> TorqueFit:
    """Fit armature and friction, and the torque scale or the links.

    Each joint counts by the inverse of its own residual (`_PASSES` passes). Blocks are
    `BLOCK_S` of a recording.

    Args:
        logs: Recordings with torque, every joint in each.
        robot: A robot with a fixed base.
        links_known: Hold the links as the model has them, and fit the torque scale.
        shared: Groups of joints with the same actuator.

    Raises:
        LogError: A log has no torque or is too slow, or there are fewer than three blocks.
    """
    model = TorqueModel(robot, links_known=links_known, shared=shared)
    columns, torques, numbers, first = [], [], [], 0
    for log in logs:
        moved = motion(log, model.joints)
        rate = log.rate_hz
        every = max(1, round(rate / RATE_HZ))
        thin = [v[::every] for v in (moved.position, moved.velocity, moved.acceleration)]
        step = rate / every
        full = low_passed(model.regressor(*thin), step, FIT_HZ)
        torque = low_passed(moved.torque[::every], step, FIT_HZ)
        # Both sides end at FIT_HZ, and the ends hold the transients of the filters.
        keep = slice(round(0.1 * step), -round(0.1 * step), max(1, int(step / (4.0 * FIT_HZ))))
        time = moved.time[::every][keep] - moved.time[0]
        count = max(round((moved.time[-1] - moved.time[0]) / BLOCK_S), 1)
        share = np.minimum((time / (moved.time[-1] - moved.time[0]) * count).astype(int), count - 1)
        columns.append(full[keep])
        torques.append(torque[keep])
        numbers.append(first + share)
        first += count
    if first < 3:
        raise LogError(f"the recordings make {first} blocks of {BLOCK_S:g} s; intervals need 3.")
    design, goal = np.concatenate(columns), np.concatenate(torques)
    blocks = np.repeat(np.concatenate(numbers), goal.shape[1])
    held: dict[tuple[str, str], TorqueParameter] = {}
    while True:
        found = _solve(model, design, goal, blocks, held)
        unknown = [
            (joint, term)
            for term in _HELD_FIRST
            for joint in model.joints
            if (joint, term) not in held and not found.joints[joint][term].identified
        ]
        if not unknown:
            return found
        for joint, term in unknown:
            if term == unknown[0][1]:
                held[joint, term] = found.joints[joint][term]


def _solve(
    model: TorqueModel,
    design: Array,
    goal: Array,
    blocks: NDArray[np.int64],
    held: Mapping[tuple[str, str], TorqueParameter],
) -> TorqueFit:
    """Least squares with some parameters at zero; `held` has them as they were last fitted."""
    design = design * np.array([name not in held for name in model.names])
    weight = np.ones(goal.shape[1])
    for _ in range(_PASSES):
        rows = (design * weight[:, None]).reshape(-1, design.shape[2])
        sought = (goal * weight).ravel()
        size = np.linalg.norm(rows, axis=0)
        size[size == 0.0] = 1.0
        left, singular, right = np.linalg.svd(rows / size, full_matrices=False)
        rank = int((singular > _RANK * singular[0]).sum())
        reduced = left[:, :rank] * singular[:rank]
        best = (left[:, :rank].T @ sought) / singular[:rank]
        x = right[:rank].T @ best / size
        rms = np.sqrt(np.mean((design @ x - goal) ** 2, axis=0))
        weight = 1.0 / np.maximum(rms, 1e-9)
    moves = block_moves(reduced, reduced @ best - sought, blocks)
    spread = right[:rank].T @ jackknife(moves) @ right[:rank] / np.outer(size, size)
    # Share of each (scaled) parameter that moves along combinations without effect.
    open_share = np.sqrt(np.maximum(1.0 - np.sum(right[:rank] ** 2, axis=0), 0.0))
    joints = {
        name: _parameters(model, name, x, spread, open_share, len(moves)) for name in model.joints
    }
    for (joint, term), last in held.items():
        reason = f"held at 0: {last.reason}"
        joints[joint][term] = replace(last, value=0.0, reason=reason)
    return TorqueFit(
        joints=joints, coefficients=x, rank=rank, rms=rms, blocks=len(moves), model=model
    )


def _parameters(
    model: TorqueModel, joint: str, x: Array, covariance: Array, open_share: Array, blocks: int
) -> dict[str, TorqueParameter]:
    """Every parameter of one joint, the scale divided out where it was fitted."""
    quantile = float(stats.t.ppf(0.975, blocks - 1))
    out = {}
    scale_at = model.names.index((joint, "scale")) if model.links_known else None
    for term in ("scale", *DRIVE_TERMS):
        if term == "scale" and scale_at is None:
            reason = "needs links of known mass: it is one with the unit of all masses"
            out[term] = TorqueParameter(
                value=np.nan, ci95=(-np.inf, np.inf), identified=False, reason=reason
            )
            continue
        owner = model.armature_of[joint][0] if term == "armature" else joint
        at = model.names.index((owner, term))
        value, gradient = x[at], np.zeros(len(x))
        gradient[at] = 1.0
        if scale_at is not None and term != "scale":
            value = x[at] / x[scale_at]
            gradient[at] = 1.0 / x[scale_at]
            gradient[scale_at] -= value / x[scale_at]
        sd = max(float(gradient @ covariance @ gradient), 0.0) ** 0.5
        reason = ""
        if open_share[at] > _NULL:
            reason = "the motion does not tell it from the links' inertia"
            value, sd = np.nan, np.inf
        elif not sd <= _SD_MAX * abs(value):
            reason = f"standard deviation {sd:.2g} {UNITS[term]}"
        elif value < 0.0 and term in ("armature", "viscous", "dry"):
            reason = "negative: the model does not hold"
        half = quantile * sd
        interval = (value - half, value + half) if np.isfinite(half) else (-np.inf, np.inf)
        out[term] = TorqueParameter(
            value=float(value),
            ci95=(float(interval[0]), float(interval[1])),
            identified=not reason,
            reason=reason,
        )
    return out
