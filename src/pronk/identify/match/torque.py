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
Stribeck friction have priors about zero (`_PRIOR`), which count in every interval.

Velocity and acceleration are derivatives of the measured position, all low-passed alike and
without phase shift. The torque is a measured one, as from the current. With the commanded torques
of the AK80-6 recordings the elbow's armature would be 0.0058 (0.0054 to 0.0061) instead of 0.0026
kg m^2 (0.0023 to 0.0030): the measured ones are 0.8 of them. The zero of the torque sensor is taken
as right: recordings that begin at rest show it, and in the fit it passes for gravity.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from pronk.arrays import Array, Mask
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import TorqueParameter
from pronk.identify.match.measured import grouped
from pronk.identify.match.result import DriveFit
from pronk.identify.match.uncertainty import block_moves, jackknife, time_blocks
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec

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
_METHOD = 0.025
"""Relative error of the method itself, part of every interval: on ten simulated rigs of two joints
without any error of the model it was up to 2.3 %, from the filters, and the blocks alone covered
55 of 80 parameters."""
_LINKS_HOLD = 1.05
"""Residual with the model's links over that with fitted links up to which the model's hold. On
simulated logs: 1.002 or less with the right links, 1.14 and more with a link 2 % too heavy, which
makes the armature of the joint before it 12 % too large."""
_MOVES_RAD_S = 2.0 * SIGN_RAD_S
"""Root mean square speed below `FIT_HZ` from which on a joint moves. In sweeps of one joint the
excited one moves at 0.5 rad/s, its neighbours at 0.01."""
_MOST_S = 120.0
"""Recordings of one chain that are used [s]: 48 blocks."""
_SCALE = (0.5, 2.0)
"""Torque scale of a sensor on the joint's side of the gear."""
_AGREE = 0.3
"""Relative difference of one parameter by torque and by position that is no contradiction."""
_BOTH = {"armature": "armature", "dry": "frictionloss"}
"""Names by position of what is fitted by torque as well."""
_PRIOR = {"viscous": 1.0, "stribeck": 0.3}
"""Standard deviations about zero, of the root mean square torque of the joint's friction: all of it
may be viscous, and geared drives break away at 1.15 to 1.45 of their Coulomb friction (those of
the virtual robot; AK80-6 held out: the same cells are lower for 0.1 to 3)."""
_STILL = TorqueParameter(value=np.nan, ci95=(np.nan, np.nan), reason="it does not move")
DRIVE_TERMS = ("armature", "viscous", "dry", "stribeck")
UNITS = dict(zip(DRIVE_TERMS, ("kg m^2", "N m s/rad", "N m", "N m"), strict=True)) | {"scale": "1"}


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
    """A recording on an even grid, low-passed at `MOTION_HZ`: rad, s and N m.

    Time has the shape (n,), the others (n, joints).
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    torque: Array

    def moves(self) -> Mask:
        """Which joints move enough for their friction to be known, shape (joints,)."""
        rate_hz = 1.0 / float(self.time[1] - self.time[0])
        slow = low_passed(self.velocity, rate_hz, FIT_HZ)
        return np.asarray(np.sqrt(np.mean(slow**2, axis=0)) > _MOVES_RAD_S)


def low_passed(values: Array, rate_hz: float, cutoff_hz: float) -> Array:
    """Filter along the first axis without phase shift."""
    sos = signal.butter(3, cutoff_hz, fs=rate_hz, output="sos")
    return np.asarray(signal.sosfiltfilt(sos, values, axis=0))


def motion(log: JointLog, joints: Sequence[str]) -> Motion:
    """Motion of some joints; LogError if the log has no torque, or samples too slowly."""
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
    """Columns of the equation of motion of a chain of joints with a fixed base."""

    def __init__(
        self,
        robot: RobotSpec,
        joint: str,
        *,
        links_known: bool,
        shared: Sequence[Sequence[str]] = (),
    ) -> None:
        """Choose what is fitted; arguments as of `fit_torque`."""
        self.model = bench_spec(robot, joint).compile()
        self.joints = tuple(self.model.joint(i).name for i in range(self.model.njnt))
        self.links_known = links_known
        self._bodies = [
            body for body in range(1, self.model.nbody) if self.model.body_weldid[body] != 0
        ]
        scales = self.joints if links_known else ()
        self.columns = {(name, "scale"): column for column, name in enumerate(scales)}
        """Column of each joint and parameter, after those of links; a shared armature has one."""
        self.count = len(scales) or len(self._bodies) * len(_PLACES)
        groups = {name: group for group in shared for name in group}
        for term, name in product(DRIVE_TERMS, self.joints):
            alike = groups.get(name, ()) if term == "armature" else ()
            known = [self.columns[one, term] for one in alike if (one, term) in self.columns]
            self.columns[name, term] = known[0] if known else self.count
            self.count += not known

    def regressor(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torque of each joint for a unit of each parameter, shape (n, joints, p).

        With the links known the columns of `armature` and friction carry the scale as well.
        """
        out = np.zeros((*position.shape, self.count))
        own = copy.copy(self.model)
        if self.links_known:
            joints = np.arange(len(self.joints))
            out[:, joints, joints] = self._rne(own, position, velocity, acceleration)
        else:
            places = own.body_ipos.copy()
            for column, (body, place) in enumerate(product(self._bodies, _PLACES)):
                own.body_mass[:], own.body_inertia[:] = 0.0, 0.0
                own.body_mass[body], own.body_ipos[body] = 1.0, place * places[body]
                out[:, :, column] = self._rne(own, position, velocity, acceleration)
        sign = np.tanh(velocity / SIGN_RAD_S)
        falling = sign * np.exp(-((velocity / STRIBECK_RAD_S) ** 2))
        for term, values in zip(DRIVE_TERMS, (acceleration, velocity, sign, falling), strict=True):
            for j, name in enumerate(self.joints):
                out[:, j, self.columns[name, term]] = values[:, j]
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
    joint: str,
    *,
    links_known: bool,
    shared: Sequence[Sequence[str]] = (),
    most_s: float = np.inf,
) -> TorqueFit:
    """Fit armature and friction of the chain of a joint, and the torque scale or the links.

    Every log has the torque of all joints of the chain, the base fixed; its first `most_s` are
    used. With `links_known` the links are as in the model and the torque scale is fitted. Each
    group of `shared` joints has the same actuator and one armature. Each joint counts by the
    inverse of its own residual (`_PASSES` passes). LogError without torque, for a log that is too
    slow, or with fewer than three blocks of `BLOCK_S`.
    """
    model = TorqueModel(robot, joint, links_known=links_known, shared=shared)
    columns, torques, times, kept = [], [], [], []
    for log in logs:
        moved = motion(log, model.joints)
        every = max(1, round(log.rate_hz / RATE_HZ))
        step, used = log.rate_hz / every, slice(0, int(min(most_s, 1e6) * log.rate_hz), every)
        full = model.regressor(moved.position[used], moved.velocity[used], moved.acceleration[used])
        full, torque = low_passed(full, step, FIT_HZ), low_passed(moved.torque[used], step, FIT_HZ)
        # Both sides end at FIT_HZ, and the ends hold the transients of the filters.
        keep = slice(round(0.1 * step), -round(0.1 * step), max(1, int(step / (4.0 * FIT_HZ))))
        # What friction holds a joint at that stands still is not known.
        moves = moved.moves()
        columns.append(np.where(moves[:, None], full[keep], 0.0))
        torques.append(np.where(moves, torque[keep], 0.0))
        times.append(moved.time[used] - moved.time[0])
        kept.append(keep)
    numbers = time_blocks(times, BLOCK_S)
    if (count := int(numbers[-1][-1]) + 1) < 3:
        raise LogError(f"the recordings make {count} blocks of {BLOCK_S:g} s; intervals need 3.")
    design, goal = np.concatenate(columns), np.concatenate(torques)
    used_numbers = [own[keep] for own, keep in zip(numbers, kept, strict=True)]
    blocks = np.repeat(np.concatenate(used_numbers), goal.shape[1])
    return _solve(model, design, goal, blocks)


def fit_drives(
    logs: Sequence[JointLog], robot: RobotSpec
) -> tuple[dict[str, dict[str, TorqueParameter]], dict[str, str]]:
    """Fit the drives of every chain whose joints all have torque in some of the logs.

    The links are the model's if these explain the torque as well as fitted ones, and their torque
    is not hidden by friction. Else they are fitted, joints with equal drives share one armature,
    and the torque scale is left open. Also returns what is to be known of the joints.
    """
    found: dict[str, dict[str, TorqueParameter]] = {}
    flags: dict[str, str] = {}
    roots: dict[tuple[str, ...], str] = {}
    for name in robot.joint_names:
        inside = [joint for joint in robot.joints if name in joint.chain]
        longest = max(inside, key=lambda joint: len(joint.chain))
        roots.setdefault(longest.chain, longest.name)
    for chain, root in roots.items():
        mine = [log for log in logs if log.torque is not None and set(chain) <= set(log.joints)]
        if not mine:
            continue
        reasons = [_unusable(log, chain) for log in mine]
        mine = [log for log, reason in zip(mine, reasons, strict=True) if not reason]
        length = sum(float(np.ptp(log.time)) for log in mine)
        if length < 3.0 * BLOCK_S:
            reason = f"{length:.3g} s, less than {3.0 * BLOCK_S:g}" if mine else reasons[0]
            flags |= dict.fromkeys(chain, f"torque not used: {reason}")
            continue
        alike = grouped(chain, lambda a, b: robot.joint(a).drive == robot.joint(b).drive)
        fit = partial(fit_torque, mine, robot, root, most_s=_MOST_S / len(mine))
        known = fit(links_known=True)
        fitted = fit(links_known=False, shared=alike)
        wrong = bool((known.rms > _LINKS_HOLD * fitted.rms).any())
        for j, (name, own) in enumerate(known.joints.items()):
            scale = own["scale"]
            if scale is _STILL:
                continue
            if wrong:
                reason = (
                    f"the model's links leave {1e3 * known.rms[j]:.0f} mN m of the torque "
                    f"unexplained, fitted ones {1e3 * fitted.rms[j]:.0f} mN m"
                )
                scale = replace(fitted.joints[name]["scale"], reason=reason)
            elif scale.identified and not _SCALE[0] < scale.value < _SCALE[1]:
                flags[name] = f"its torque column is {scale.value:.3g} of the joint's torque"
            drive = own if scale.identified else fitted.joints[name]
            found[name] = {**drive, "scale": scale}
    return found, flags


def joint_fits(
    robot: RobotSpec,
    fits: Mapping[str, DriveFit],
    drives: Mapping[str, Mapping[str, TorqueParameter]],
    flags: Mapping[str, str],
) -> dict[str, DriveFit]:
    """Fits by position with the drives by torque; the arguments are those of `fit_drives`.

    Joints that were not fitted by position have the gains of the robot's file, and the armature and
    dry friction that torque identifies.
    """
    out = {}
    for known in robot.joints:
        joint, own = known.name, drives.get(known.name, {})
        found = [flags[joint]] if joint in flags else []
        identified = {
            term: own[term].value for term in _BOTH if term in own and own[term].identified
        }
        fit = fits.get(joint)
        if fit:
            for term, value in identified.items():
                name = _BOTH[term]
                other, (low, high) = fit.values[name], own[term].ci95
                apart = not low <= other <= high and abs(value - other) > _AGREE * other
                if name in fit.ci95 and apart:
                    unit = UNITS[term]
                    found.append(f"{name} {other:.3g} {unit} by position, {value:.3g} by torque")
        elif any(one.identified for one in own.values()):
            fit = DriveFit(
                joint=joint,
                values={
                    "stiffness": known.stiffness,
                    "damping": known.damping,
                    "armature": identified.get("armature", known.drive.armature),
                    "frictionloss": identified.get("dry", np.nan),
                    "stribeck": 0.0,
                    "delay": 0.0,
                },
                covariance=np.zeros((2, 2)),
            )
            held = ["stiffness", "damping", *["armature"] * ("armature" not in identified)]
            found.append(f"{', '.join(held)}: not fitted but those of the robot's file")
        if fit:
            out[joint] = replace(fit, torque=own, flags=(*fit.flags, *found))
    return out


def _unusable(log: JointLog, chain: Sequence[str]) -> str:
    """Why the torques of a log cannot be used."""
    assert log.torque is not None
    if log.origin.metadata.get("torque") == "computed":
        return "it is computed from the command, not measured"
    if log.rate_hz < 4.0 * MOTION_HZ:
        return f"{log.rate_hz:.0f} Hz, fewer than {4.0 * MOTION_HZ:.0f}"
    if log.torque[:, [log.column(name) for name in chain]].min() >= 0.0:
        return "no torque is negative, so they are magnitudes"
    if any(log.unit(name) != "rad" for name in chain):
        return "a joint of the chain is not in radians"
    return "" if motion(log, chain).moves().any() else "no joint moves enough"


def _solve(model: TorqueModel, design: Array, goal: Array, blocks: NDArray[np.int64]) -> TorqueFit:
    """Least squares, each joint weighted by its residual."""
    weight, counts = np.ones(goal.shape[1]), design.any(axis=2).sum(axis=0)
    columns, prior = model.columns, np.zeros((0, model.count))
    for _ in range(_PASSES):
        rows = np.vstack([(design * weight[:, None]).reshape(-1, model.count), prior])
        sought = np.concatenate([(goal * weight).ravel(), np.zeros(len(prior))])
        size = np.linalg.norm(rows, axis=0)
        size[size == 0.0] = 1.0
        left, singular, right = np.linalg.svd(rows / size, full_matrices=False)
        rank = int((singular > _RANK * singular[0]).sum())
        left, singular, right = left[:, :rank], singular[:rank], right[:rank]
        best = (left.T @ sought) / singular
        x = right.T @ best / size
        rms = np.sqrt(np.sum((design @ x - goal) ** 2, axis=0) / np.maximum(counts, 1))
        weight = 1.0 / np.maximum(rms, 1e-9)
        deviation = {}
        for j, name in enumerate(model.joints):
            terms = [columns[name, term] for term in ("viscous", "dry", "stribeck")]
            friction = np.linalg.norm(design[:, j, terms] @ x[terms])
            for term, share in _PRIOR.items():
                alike = columns[name, "dry" if term == "stribeck" else term]
                unit = np.linalg.norm(design[:, j, alike])
                if unit > 0.0 and friction > 0.0:
                    deviation[columns[name, term]] = share * friction / unit
        prior = np.eye(len(x))[list(deviation)] / np.array([*deviation.values()])[:, None]
    reduced, known = left * singular, len(rows) - goal.size
    moves = block_moves(reduced, reduced @ best - sought, np.append(blocks, np.full(known, -1)))
    moves = moves[min(known, 1) :]
    # An optimum moves by this when the truth is one deviation of its prior from zero.
    drawn = reduced[goal.size :] / singular**2
    spread = right.T @ (jackknife(moves) + drawn.T @ drawn) @ right / np.outer(size, size)
    # Share of each (scaled) parameter that moves along combinations without effect.
    hidden = np.sqrt(np.maximum(1.0 - np.sum(right**2, axis=0), 0.0))
    quantile, joints = float(stats.t.ppf(0.975, len(moves) - 1)), {}
    for j, name in enumerate(model.joints):
        if not counts[j]:
            joints[name] = dict.fromkeys(UNITS, _STILL)
            continue
        # Torque of the links that no other term has; known ones fill one column, the first ones.
        others = np.delete(design[:, j], j, axis=1)
        links = design[:, j, j] - others @ np.linalg.lstsq(others, design[:, j, j], rcond=None)[0]
        apart = float(np.sqrt(np.sum(links**2) / counts[j]))
        joints[name] = {
            term: _parameter(model, name, term, x, spread, quantile, hidden, apart)
            for term in ("scale", *DRIVE_TERMS)
        }
    return TorqueFit(
        joints=joints, coefficients=x, rank=rank, rms=rms, blocks=len(moves), model=model
    )


def _parameter(
    model: TorqueModel,
    joint: str,
    term: str,
    x: Array,
    covariance: Array,
    quantile: float,
    hidden: Array,
    apart: float,
) -> TorqueParameter:
    """One parameter of a joint, the scale divided out where it was fitted.

    `hidden` is the share of each that has no effect, `apart` the torque of the links [N m] that no
    other term of the joint has.
    """
    if (joint, term) not in model.columns:
        reason = "needs links of known mass: it is one with the unit of all masses"
        return TorqueParameter(value=np.nan, ci95=(np.nan, np.nan), reason=reason)
    at, scale_at = model.columns[joint, term], model.columns.get((joint, "scale"))
    value, gradient = x[at], np.eye(len(x))[at]
    if scale_at is not None and term != "scale":
        value, gradient = value / x[scale_at], gradient / x[scale_at]
        gradient[scale_at] -= value / x[scale_at]
    sd = max(float(gradient @ covariance @ gradient), 0.0) ** 0.5
    dry, reason = x[model.columns[joint, "dry"]], ""
    if hidden[at] > _NULL:
        reason = (
            "the motion does not separate it from the links' inertia (joints whose drives are "
            "equal in robot.yaml share one armature)"
        )
        value = sd = np.nan
    elif not sd <= _SD_MAX * abs(value):
        reason = f"standard deviation {sd:.2g} {UNITS[term]}"
    elif value < 0.0 and term != "stribeck":
        reason = "negative: the model does not hold"
    elif term == "scale" and value * apart < dry:
        reason = f"dry friction, {dry:.2g} N m, hides {value * apart:.2g} N m of the links"
    half = float(np.hypot(quantile * sd, _METHOD * value))
    ends = float(value - half), float(value + half)
    return TorqueParameter(value=float(value), ci95=ends, reason=reason)
