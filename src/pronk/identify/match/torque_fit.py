"""The fit of drives to a torque channel beside positions, without a position loop.

It gives the same `DriveFit` as `pronk.identify.match.drive_fit`, by another equation. The equation
of motion is linear in everything sought,

    torque = scale * (rigid(q, v, a) + armature a + viscous v + dry sign(v) + stribeck s(v))

with s(v) = sign(v) exp(-(v / V)^2), so its least squares need no simulation and no search, and the
null space of its regressor says exactly what the recordings leave open. As further residuals of the
fit in time it would lose both; that is why it is a function of its own.

The links are held as the model has them, or fitted too: mass, first moment and inertia of each
body, with its centre of mass on the model's line from the joint (off that line it passes for an
offset of the encoders). Torque does not distinguish a factor of the torque sensor from a factor of
all masses, so the scale is fitted only with the links known. The armature of a joint is apart from
its link where another joint's coupling shows the link's inertia alone; joints with the same
actuator may share one armature. Viscous and Stribeck friction have priors about zero
(`PRIOR_SHARE`), which count in every interval.

Velocity and acceleration are derivatives of the measured position, all low-passed alike and
without phase shift. The torque is a measured one, as from the current. With the commanded torques
of the AK80-6 recordings the elbow's armature would be 0.0058 (0.0054 to 0.0061) instead of 0.0026
kg m^2 (0.0023 to 0.0030): the measured ones are 0.8 of them. The zero of the torque sensor is taken
as right: recordings that begin at rest show it, and in the fit it passes for gravity.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import special

from pronk.arrays import Array, Mask
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import TorqueParameter
from pronk.identify.match.result import DriveFit
from pronk.identify.match.uncertainty import block_moves, jackknife, time_blocks
from pronk.robots.model import bench_spec
from pronk.robots.robot import Joint, RobotSpec

MOTION_HZ = 40.0
"""Cutoff of the position before it is differentiated [Hz]."""
FIT_HZ = 3.0
"""Cutoff of both sides of the equation [Hz]. On the AK80-6 recordings the residual of the fitted
logs is 0.04 to 0.07 N m at the shoulder below 3 Hz and 0.16 to 0.18 below 10 Hz, and the noise of
the acceleration there biases every inertia low, by 14 % at 10 Hz."""
RATE_HZ = 250.0
"""Rate at which the equation of motion is evaluated [Hz]."""
BLOCK_S = 2.5
"""Length of a block of the jackknife [s], the shortest of joints that moved together."""
FEWEST_BLOCKS_OF_TORQUE = 3
"""Fewest blocks that give an interval."""
SIGN_RAD_S = 0.05
"""Speed over which sign(v) changes, as tanh(v / speed) [rad/s]."""
STRIBECK_RAD_S = 0.5
"""Speed V of the Stribeck term [rad/s]."""
RANK_RATIO = 1e-4
"""Singular values of the scaled regressor below this share of the largest are null: below it, the
noise of an acceleration differentiated at `MOTION_HZ` exceeds the signal."""
WEIGHT_PASSES = 3
"""Passes of the weights by joint."""
NULL_SHARE = 1e-2
"""Share of a parameter in the null space from which on it is not identified."""
TORQUE_SD_MAX = 0.3
"""Relative standard deviation of an identified parameter, as `Parameter.sd_max`."""
PLACES = (0.0, 1.0, -1.0)
"""Point masses that span the inertia of a body: places on the line from its joint through its
centre of mass, in units of that distance."""
METHOD_ERROR = 0.025
"""Relative error of the method itself, part of every interval: on ten simulated rigs of two joints
without any error of the model it was up to 2.3 %, from the filters, and the blocks alone covered 55
of 80 parameters."""
LINKS_HOLD = 1.05
"""Residual with the model's links over that with fitted links up to which the model's hold. On
simulated logs it is 1.002 or less with the right links, and 1.14 or more with a link 2 % too heavy,
which makes the armature of the joint before it 12 % too large."""
UNEXPLAINED_MAX = 0.5
"""Residual over the torque, from which on the equation of motion does not hold: a quarter of the
torque's power. On simulated rigs it is 0.02, on the AK80-6 recordings 0.1 to 0.2."""
EXPLAINED_BY_OTHERS = 0.25
"""Residual over the torque below which another meaning of the angles is named."""
MOVES_RAD_S = 2.0 * SIGN_RAD_S
"""Root mean square speed below `FIT_HZ` from which on a joint moves [rad/s]. In sweeps of one joint
the excited one moves at 0.5 rad/s, its neighbours at 0.01."""
MOST_S = 120.0
"""Length of the recordings of one chain that is used [s]: 48 blocks."""
SCALE_LOW = 0.5
"""Smallest torque scale of a sensor on the joint's side of the gear."""
SCALE_HIGH = 2.0
"""Largest torque scale of a sensor on the joint's side of the gear."""
AGREE = 0.3
"""Relative difference of one parameter by torque and by position that is no contradiction."""
PRIOR_SHARE = {"viscous": 1.0, "stribeck": 0.3}
"""Standard deviations about zero, as shares of the root mean square torque of the joint's friction:
all of it may be viscous, and geared drives break away at 1.15 to 1.45 of their Coulomb friction
(those of the virtual robot; on the AK80-6 recordings that judge the fit, the same comparisons are
won with 0.1 to 3)."""
DRIVE_TERMS = ("armature", "viscous", "dry", "stribeck")
"""Terms of the equation of motion that are a joint's drive."""
UNITS = {
    "armature": "kg m^2",
    "viscous": "N m s/rad",
    "dry": "N m",
    "stribeck": "N m",
    "scale": "1",
}
"""Units of the parameters that a torque channel gives."""
POSITION_NAMES = {"armature": "armature", "dry": "frictionloss"}
"""Terms that a fit in time gives as well, and their names there."""
STILL = TorqueParameter(value=np.nan, ci95=(np.nan, np.nan), reason="it does not move")
"""Any parameter of a joint that does not move."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A recording on an even grid, low-passed at `MOTION_HZ`; arrays of shape (n, joints)."""

    time: Array
    """Instants [s], shape (n,)."""
    position: Array
    """Position [rad]."""
    velocity: Array
    """Velocity [rad/s]."""
    acceleration: Array
    """Acceleration [rad/s^2]."""
    torque: Array
    """Measured torque [N m]."""

    def moves(self) -> Mask:
        """Which joints move enough for their friction to be known, shape (joints,)."""
        rate_hz = 1.0 / float(self.time[1] - self.time[0])
        slow = low_passed(self.velocity, rate_hz, FIT_HZ)
        return np.asarray(np.sqrt(np.mean(slow**2, axis=0)) > MOVES_RAD_S)


def low_passed(values: Array, rate_hz: float, cutoff_hz: float) -> Array:
    """Filter values along their first axis without phase shift."""
    from scipy import signal  # slow to import

    sections = signal.butter(3, cutoff_hz, fs=rate_hz, output="sos")
    return np.asarray(signal.sosfiltfilt(sections, values, axis=0))


def motion(log: JointLog, joints: Sequence[str]) -> Motion:
    """Read the motion of some joints from a log.

    Raises:
        LogError: The log has no torque, or too few samples a second.
    """
    source = log.source or "log"
    if log.torque is None:
        raise LogError(f"{source}: no torque channel; the torque fit needs one.")
    if log.rate_hz < 4.0 * MOTION_HZ:
        raise LogError(
            f"{source}: {log.rate_hz:.0f} Hz; accelerations need {4.0 * MOTION_HZ:.0f} Hz or more."
        )
    time = np.arange(log.time[0], log.time[-1], 1.0 / log.rate_hz)
    position = np.empty((len(time), len(joints)))
    torque = np.empty((len(time), len(joints)))
    for index, joint in enumerate(joints):
        column = log.column(joint)
        position[:, index] = np.interp(time, log.time, log.position[:, column])
        torque[:, index] = np.interp(time, log.time, log.torque[:, column])
    position = low_passed(position, log.rate_hz, MOTION_HZ)
    velocity = np.asarray(np.gradient(position, time, axis=0))
    return Motion(
        time=time,
        position=position,
        velocity=velocity,
        acceleration=np.asarray(np.gradient(velocity, time, axis=0)),
        torque=low_passed(torque, log.rate_hz, MOTION_HZ),
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
        """Choose what is fitted; the arguments are those of `fit_torque`."""
        self.model = bench_spec(robot, joint).compile()
        self.joints = tuple(self.model.joint(i).name for i in range(self.model.njnt))
        self.links_known = links_known
        self._bodies = []
        for body in range(1, self.model.nbody):
            if self.model.body_weldid[body] != 0:
                self._bodies.append(body)
        self.columns: dict[tuple[str, str], int] = {}
        """Column of each joint and parameter, after those of links; a shared armature has one."""
        self.count = 0
        """Number of columns."""
        if links_known:
            for name in self.joints:
                self.columns[name, "scale"] = self.count
                self.count += 1
        else:
            self.count = len(self._bodies) * len(PLACES)
        first_of_group = {}
        for group in shared:
            members = [joint for joint in self.joints if joint in group]
            for name in members:
                first_of_group[name] = members[0]
        for term in DRIVE_TERMS:
            for name in self.joints:
                first = first_of_group.get(name, name)
                if term == "armature" and first != name:
                    self.columns[name, term] = self.columns[first, term]
                    continue
                self.columns[name, term] = self.count
                self.count += 1

    def regressor(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torque of each joint for a unit of each parameter, shape (n, joints, p).

        With the links known the columns of `armature` and friction carry the scale as well.
        """
        columns = np.zeros((*position.shape, self.count))
        model = copy.copy(self.model)
        if self.links_known:
            joints = np.arange(len(self.joints))
            columns[:, joints, joints] = _inverse_dynamics(model, position, velocity, acceleration)
        else:
            centers = model.body_ipos.copy()
            column = 0
            for body in self._bodies:
                for place in PLACES:
                    model.body_mass[:] = 0.0
                    model.body_inertia[:] = 0.0
                    model.body_mass[body] = 1.0
                    model.body_ipos[body] = place * centers[body]
                    columns[:, :, column] = _inverse_dynamics(
                        model, position, velocity, acceleration
                    )
                    column += 1
        sign = np.tanh(velocity / SIGN_RAD_S)
        terms = {
            "armature": acceleration,
            "viscous": velocity,
            "dry": sign,
            "stribeck": sign * np.exp(-((velocity / STRIBECK_RAD_S) ** 2)),
        }
        for term, values in terms.items():
            for index, name in enumerate(self.joints):
                columns[:, index, self.columns[name, term]] = values[:, index]
        return columns


def _inverse_dynamics(
    model: mujoco.MjModel, position: Array, velocity: Array, acceleration: Array
) -> Array:
    """Torque that the links alone need [N m], arrays of shape (n, joints)."""
    data = mujoco.MjData(model)
    torque = np.empty(position.shape)
    result = np.empty(model.nv)
    for k in range(len(position)):
        data.qpos[:] = position[k]
        data.qvel[:] = velocity[k]
        data.qacc[:] = acceleration[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 1, result)
        torque[k] = result
    return torque


@dataclass(frozen=True, kw_only=True)
class TorqueFit:
    """Drives of a chain by torque, and its links where they were fitted."""

    joints: dict[str, dict[str, TorqueParameter]]
    """Parameters of each joint, by the names of `UNITS`."""
    coefficients: Array
    """Coefficients of the columns of the regressor, shape (p,)."""
    rank: int
    """Number of independent combinations of parameters that the recordings show."""
    rms: Array
    """Residual of each joint's torque below `FIT_HZ` [N m], shape (joints,)."""
    unexplained: Array
    """That residual over the torque's own root mean square about its mean, shape (joints,)."""
    blocks: int
    """Number of blocks that the intervals rest on."""
    model: TorqueModel
    """Equation of motion that was fitted."""

    def torque(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torque that the sensor would show by inverse dynamics [N m], shape (n, joints)."""
        columns = self.model.regressor(position, velocity, acceleration)
        return np.asarray(columns @ self.coefficients)


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

    Args:
        logs: Logs that have the torque of all joints of the chain, the base fixed.
        robot: The robot.
        joint: The joint whose chain it is.
        links_known: True if the links are as in the model, and the torque scale is fitted.
        shared: Groups of joints with the same actuator, whose armature is one.
        most_s: Length of each log that is used, from its beginning [s].

    Returns:
        The drives; each joint counts by the inverse of its own residual.

    Raises:
        LogError: A log has no torque or too few samples a second, or they make fewer than three
            blocks of `BLOCK_S`.
    """
    model = TorqueModel(robot, joint, links_known=links_known, shared=shared)
    designs = []
    torques = []
    times = []
    kept_rows = []
    for log in logs:
        moved = motion(log, model.joints)
        stride = max(1, round(log.rate_hz / RATE_HZ))
        rate_hz = log.rate_hz / stride
        used = slice(0, int(min(most_s, 1e6) * log.rate_hz), stride)
        columns = model.regressor(
            moved.position[used], moved.velocity[used], moved.acceleration[used]
        )
        columns = low_passed(columns, rate_hz, FIT_HZ)
        torque = low_passed(moved.torque[used], rate_hz, FIT_HZ)
        # Both sides end at FIT_HZ, and the ends hold the transients of the filters.
        edge = round(0.1 * rate_hz)
        rows = slice(edge, -edge, max(1, int(rate_hz / (4.0 * FIT_HZ))))
        # What friction holds a joint at that stands still is not known.
        moves = moved.moves()
        designs.append(np.where(moves[:, None], columns[rows], 0.0))
        torques.append(np.where(moves, torque[rows], 0.0))
        times.append(moved.time[used] - moved.time[0])
        kept_rows.append(rows)
    block_numbers = time_blocks(times, BLOCK_S)
    count = int(block_numbers[-1][-1]) + 1
    if count < FEWEST_BLOCKS_OF_TORQUE:
        raise LogError(
            f"the recordings make {count} blocks of {BLOCK_S:g} s; intervals need "
            f"{FEWEST_BLOCKS_OF_TORQUE}."
        )
    kept_blocks = []
    for numbers, rows in zip(block_numbers, kept_rows, strict=True):
        kept_blocks.append(numbers[rows])
    blocks = np.repeat(np.concatenate(kept_blocks), len(model.joints))
    return _solve(model, np.concatenate(designs), np.concatenate(torques), blocks)


def _solve(
    model: TorqueModel, design: Array, torque: Array, blocks: NDArray[np.int64]
) -> TorqueFit:
    """Solve the equation of motion by least squares, each joint weighted by its residual.

    `design` has the shape (n, joints, p), `torque` (n, joints), `blocks` (n * joints,).
    """
    samples, joint_count = torque.shape
    counts = design.any(axis=2).sum(axis=0)
    weight = np.ones(joint_count)
    prior = np.zeros((0, model.count))
    next_prior = prior
    for _ in range(WEIGHT_PASSES):
        prior = next_prior
        weighted = (design * weight[:, None]).reshape(-1, model.count)
        rows = np.vstack([weighted, prior])
        target = np.concatenate([(torque * weight).ravel(), np.zeros(len(prior))])
        size = np.linalg.norm(rows, axis=0)
        size[size == 0.0] = 1.0
        left_vectors, singular, right = np.linalg.svd(rows / size, full_matrices=False)
        rank = int((singular > RANK_RATIO * singular[0]).sum())
        left_vectors = left_vectors[:, :rank]
        singular = singular[:rank]
        right = right[:rank]
        seen = (left_vectors.T @ target) / singular
        x = right.T @ seen / size
        squares = np.sum((design @ x - torque) ** 2, axis=0)
        rms = np.sqrt(squares / np.maximum(counts, 1))
        weight = 1.0 / np.maximum(rms, 1e-9)
        next_prior = _prior(model, design, x)
    # Combinations that the recordings show, and what each row says of them.
    reduced = left_vectors * singular
    prior_count = len(prior)
    all_blocks = np.append(blocks, np.full(prior_count, -1))
    moves = block_moves(reduced, reduced @ seen - target, all_blocks)
    if prior_count:
        moves = moves[1:]
    # An optimum moves by this when the truth is one deviation of its prior from zero.
    drawn = reduced[samples * joint_count :] / singular**2
    covariance = right.T @ (jackknife(moves) + drawn.T @ drawn) @ right / np.outer(size, size)
    # Share of each (scaled) parameter that moves along combinations without effect.
    hidden = np.sqrt(np.maximum(1.0 - np.sum(right**2, axis=0), 0.0))
    quantile = float(special.stdtrit(len(moves) - 1, 0.975))
    solution = _Solution(model=model, x=x, covariance=covariance, hidden=hidden, quantile=quantile)
    joints: dict[str, dict[str, TorqueParameter]] = {}
    for index, joint in enumerate(model.joints):
        if not counts[index]:
            joints[joint] = dict.fromkeys(UNITS, STILL)
            continue
        # Torque of the links that no other term has; known ones fill one column, the first ones.
        links = design[:, index, index]
        other_terms = np.delete(design[:, index], index, axis=1)
        links = links - other_terms @ np.linalg.lstsq(other_terms, links, rcond=None)[0]
        links_torque = float(np.sqrt(np.sum(links**2) / counts[index]))
        joints[joint] = {}
        for term in ("scale", *DRIVE_TERMS):
            joints[joint][term] = solution.parameter(joint, term, links_torque)
    moved = np.where(design.any(axis=2), torque, np.nan)
    deviation = np.full(joint_count, np.inf)
    for column in np.flatnonzero(counts):
        deviation[column] = np.nanstd(moved[:, column])
    return TorqueFit(
        joints=joints,
        coefficients=x,
        rank=rank,
        rms=rms,
        unexplained=rms / np.maximum(deviation, 1e-12),
        blocks=len(moves),
        model=model,
    )


def _prior(model: TorqueModel, design: Array, x: Array) -> Array:
    """Rows of the priors about zero of viscous and Stribeck friction, shape (priors, p)."""
    rows = []
    for index, joint in enumerate(model.joints):
        terms = [model.columns[joint, term] for term in ("viscous", "dry", "stribeck")]
        friction = np.linalg.norm(design[:, index, terms] @ x[terms])
        for term, share in PRIOR_SHARE.items():
            # Stribeck friction is compared with dry friction, of which it is a part.
            compared = model.columns[joint, "dry" if term == "stribeck" else term]
            unit = np.linalg.norm(design[:, index, compared])
            if unit > 0.0 and friction > 0.0:
                row = np.zeros(model.count)
                row[model.columns[joint, term]] = unit / (share * friction)
                rows.append(row)
    return np.array(rows).reshape(-1, model.count)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Solution:
    """Coefficients of the equation of motion with their uncertainty."""

    model: TorqueModel
    x: Array
    """Coefficients, shape (p,)."""
    covariance: Array
    """Covariance of the coefficients, shape (p, p)."""
    hidden: Array
    """Share of each coefficient that has no effect, shape (p,)."""
    quantile: float
    """Half-width of a 95 % interval in deviations."""

    def parameter(self, joint: str, term: str, links_torque: float) -> TorqueParameter:
        """Read one parameter of a joint, the scale divided out where it was fitted.

        `links_torque` is the torque of the links [N m] that no other term of the joint has.
        """
        columns = self.model.columns
        if (joint, term) not in columns:
            reason = "needs links of known mass: it is one with the unit of all masses"
            return TorqueParameter(value=np.nan, ci95=(np.nan, np.nan), reason=reason)
        column = columns[joint, term]
        value = float(self.x[column])
        gradient = np.zeros(len(self.x))
        gradient[column] = 1.0
        scale_column = columns.get((joint, "scale"))
        if scale_column is not None and term != "scale":
            scale = self.x[scale_column]
            value = value / scale
            gradient[column] = 1.0 / scale
            gradient[scale_column] -= value / scale
        deviation = max(float(gradient @ self.covariance @ gradient), 0.0) ** 0.5
        dry = float(self.x[columns[joint, "dry"]])
        reason = ""
        if self.hidden[column] > NULL_SHARE:
            reason = (
                "the motion does not separate it from the links' inertia (joints whose drives are "
                "equal in robot.yaml share one armature)"
            )
            value = np.nan
            deviation = np.nan
        elif not deviation <= TORQUE_SD_MAX * abs(value):
            reason = f"standard deviation {deviation:.2g} {UNITS[term]}"
        elif value < 0.0 and term != "stribeck":
            reason = "negative: the model does not hold"
        elif term == "scale" and value * links_torque < dry:
            reason = (
                f"dry friction, {dry:.2g} N m, hides {value * links_torque:.2g} N m of the links"
            )
        half = float(np.hypot(self.quantile * deviation, METHOD_ERROR * value))
        return TorqueParameter(value=value, ci95=(value - half, value + half), reason=reason)


def fit_torque_drives(logs: Sequence[JointLog], robot: RobotSpec) -> dict[str, DriveFit]:
    """Fit the drives of every chain whose joints all have torque in some of the logs.

    The links are the model's if these explain the torque as well as fitted ones, and their torque
    is not hidden by friction. Else they are fitted, joints with equal drives share one armature,
    and the torque scale is left open.

    Args:
        logs: Logs of one robot; those without torque are passed over.
        robot: The robot.

    Returns:
        The drive of each joint that has torque, with the gains of the robot's file, which torque
        says nothing of. Where the torque could not be used, `torque` is empty and a flag has the
        reason.
    """
    fits: dict[str, DriveFit] = {}
    for chain, root in _chains(robot).items():
        chain_logs = []
        reasons = []
        for log in logs:
            if log.torque is None or not set(chain) <= set(log.joints):
                continue
            reason = _unusable(log, chain)
            if reason:
                reasons.append(reason)
            else:
                chain_logs.append(log)
        if not chain_logs and not reasons:
            continue
        length_s = sum(float(np.ptp(log.time)) for log in chain_logs)
        if length_s < FEWEST_BLOCKS_OF_TORQUE * BLOCK_S:
            reason = f"{length_s:.3g} s, less than {FEWEST_BLOCKS_OF_TORQUE * BLOCK_S:g}"
            if not chain_logs:
                reason = reasons[0]
            for name in chain:
                fits[name] = _torque_drive(robot.joint(name), {}, (f"torque not used: {reason}",))
            continue
        fits |= _fit_chain_torque(chain_logs, robot, root, chain)
    return fits


def _chains(robot: RobotSpec) -> dict[tuple[str, ...], str]:
    """The longest chain of every joint, with the joint whose chain it is."""
    roots: dict[tuple[str, ...], str] = {}
    for name in robot.joint_names:
        holders = [joint for joint in robot.joints if name in joint.chain]
        longest = max(holders, key=lambda joint: len(joint.chain))
        roots.setdefault(longest.chain, longest.name)
    return roots


def _unusable(log: JointLog, chain: Sequence[str]) -> str:
    """Say why the torques of a log cannot be used; empty if they can."""
    assert log.torque is not None
    if log.origin.metadata.get("torque") == "computed":
        return "it is computed from the command, not measured"
    if log.rate_hz < 4.0 * MOTION_HZ:
        return f"{log.rate_hz:.0f} Hz, fewer than {4.0 * MOTION_HZ:.0f}"
    columns = [log.column(name) for name in chain]
    if log.torque[:, columns].min() >= 0.0:
        return "no torque is negative, so they are magnitudes"
    if any(log.unit(name) != "rad" for name in chain):
        return "a joint of the chain is not in radians"
    if not motion(log, chain).moves().any():
        return "no joint moves enough"
    return ""


def _fit_chain_torque(
    logs: Sequence[JointLog], robot: RobotSpec, root: str, chain: Sequence[str]
) -> dict[str, DriveFit]:
    """Fit the drives of one chain with the model's links, or with fitted ones."""
    equal_drives: list[list[str]] = []
    for name in chain:
        for group in equal_drives:
            if robot.joint(group[0]).drive == robot.joint(name).drive:
                group.append(name)
                break
        else:
            equal_drives.append([name])
    most_s = MOST_S / len(logs)
    with_known_links = fit_torque(logs, robot, root, links_known=True, most_s=most_s)
    with_fitted_links = fit_torque(
        logs, robot, root, links_known=False, shared=equal_drives, most_s=most_s
    )
    least = np.minimum(with_known_links.unexplained, with_fitted_links.unexplained)
    if least.max() > UNEXPLAINED_MAX:
        reason = (
            f"the equation of motion leaves {100.0 * least.max():.0f} % of the torque of "
            f"{chain[int(np.argmax(least))]} unexplained{_other_angles(logs, robot, root, chain)}"
        )
        unexplained = {}
        for name in chain:
            torque = {}
            for term, parameter in with_known_links.joints[name].items():
                torque[term] = replace(parameter, value=np.nan, reason=reason)
            unexplained[name] = _torque_drive(robot.joint(name), torque, ())
        return unexplained
    links_hold = bool((with_known_links.rms <= LINKS_HOLD * with_fitted_links.rms).all())
    fits = {}
    for index, (name, drive) in enumerate(with_known_links.joints.items()):
        scale = drive["scale"]
        flags: tuple[str, ...] = ()
        if scale is STILL:
            continue
        if not links_hold:
            reason = (
                f"the model's links leave {1e3 * with_known_links.rms[index]:.0f} mN m of the "
                f"torque unexplained, fitted ones {1e3 * with_fitted_links.rms[index]:.0f} mN m"
            )
            scale = replace(with_fitted_links.joints[name]["scale"], reason=reason)
        elif scale.identified and not SCALE_LOW < scale.value < SCALE_HIGH:
            flags = (f"its torque column is {scale.value:.3g} of the joint's torque",)
        if not scale.identified:
            drive = with_fitted_links.joints[name]
        fits[name] = _torque_drive(robot.joint(name), {**drive, "scale": scale}, flags)
    return fits


def _other_angles(
    logs: Sequence[JointLog], robot: RobotSpec, root: str, chain: Sequence[str]
) -> str:
    """Say whether the torque is explained by angles that count from the base; empty if not.

    The links of some arms are driven by belts from the base: the encoder of the second joint then
    shows the angle of its link, and its motor pushes against the base.
    """
    for torque_too in (False, True):
        relative = []
        for log in logs:
            assert log.torque is not None
            position = log.position.copy()
            torque = log.torque.copy()
            for before, name in itertools.pairwise(chain):
                position[:, log.column(name)] -= log.position[:, log.column(before)]
            if torque_too:
                for before, name in reversed(list(itertools.pairwise(chain))):
                    torque[:, log.column(before)] += torque[:, log.column(name)]
            relative.append(replace(log, position=position, torque=torque))
        most_s = MOST_S / len(logs)
        fit = fit_torque(relative, robot, root, links_known=True, most_s=most_s)
        if fit.unexplained.max() < EXPLAINED_BY_OTHERS:
            torque_words = ""
            if torque_too:
                torque_words = ", and add the torques of later joints to those before"
            return (
                f"; it leaves {100.0 * fit.unexplained.max():.0f} % if the angles of the file "
                "count from the base and not from the link before: take the differences of the "
                f"columns{torque_words}"
            )
    return ""


def _torque_drive(
    joint: Joint, torque: Mapping[str, TorqueParameter], flags: tuple[str, ...]
) -> DriveFit:
    """Make the drive of a joint of what torque identifies, and of the robot's file."""
    values = {
        "stiffness": joint.stiffness,
        "damping": joint.damping,
        "armature": joint.drive.armature,
        "frictionloss": float("nan"),
        "stribeck": 0.0,
        "delay": 0.0,
    }
    ci95 = {}
    for term, name in POSITION_NAMES.items():
        if term in torque and torque[term].identified:
            values[name] = torque[term].value
            ci95[name] = torque[term].ci95
    return DriveFit(
        joint=joint.name,
        values=values,
        ci95=ci95,
        total95=dict(ci95),
        covariance=np.zeros((2, 2)),
        torque=torque,
        flags=flags,
    )


def with_torque(
    fits: Mapping[str, DriveFit], torque_fits: Mapping[str, DriveFit], robot: RobotSpec
) -> dict[str, DriveFit]:
    """Join drives that were fitted in time with those by torque.

    Args:
        fits: Drives by `fit_drives`.
        torque_fits: Drives by `fit_torque_drives`.
        robot: The robot, whose order of joints the result has.

    Returns:
        The drives in time, with the parameters by torque beside them and a flag where the two
        contradict each other, and the drives of joints that torque alone says something of.
    """
    joined = {}
    for joint in robot.joint_names:
        fit = fits.get(joint)
        by_torque = torque_fits.get(joint)
        if fit is not None and by_torque is not None:
            flags = (*fit.flags, *by_torque.flags, *_contradictions(fit, by_torque))
            joined[joint] = replace(fit, torque=by_torque.torque, flags=flags)
        elif fit is not None:
            joined[joint] = fit
        elif by_torque is not None and _identifies(by_torque):
            names = ["stiffness", "damping"]
            if "armature" not in by_torque.ci95:
                names.append("armature")
            flag = f"{', '.join(names)}: not fitted but those of the robot's file"
            joined[joint] = replace(by_torque, flags=(*by_torque.flags, flag))
    return joined


def left_out_by_torque(
    torque_fits: Mapping[str, DriveFit], joints: Collection[str]
) -> dict[str, str]:
    """Say of joints with torque why they are in no result.

    Args:
        torque_fits: Drives by `fit_torque_drives`.
        joints: Names of the joints that have a result.

    Returns:
        A sentence for each joint that is left out.
    """
    reasons = {}
    for name, fit in torque_fits.items():
        if name in joints:
            continue
        causes: dict[str, list[str]] = {}
        for term, parameter in fit.torque.items():
            if parameter.reason:
                causes.setdefault(parameter.reason, []).append(term)
        words = [f"{', '.join(terms)}: {cause}" for cause, terms in causes.items()]
        if len(causes) == 1:
            words = list(causes)
        words.extend(fit.flags)
        reason = f"torque identifies none of its parameters ({'; '.join(words) or 'no motion'})"
        if any(cause.startswith("negative") for cause in causes):
            reason += (
                "; check that its angle counts from the link before it, which that of a link "
                "driven by a belt from the base does not, and the sign of its torque"
            )
        reasons[name] = reason
    return reasons


def _identifies(fit: DriveFit) -> bool:
    """True if torque identifies a parameter of a joint."""
    return any(parameter.identified for parameter in fit.torque.values())


def _contradictions(fit: DriveFit, by_torque: DriveFit) -> list[str]:
    """Parameters that a fit in time and torque both give, and that do not agree."""
    flags = []
    for term, name in POSITION_NAMES.items():
        if name not in fit.ci95 or name not in by_torque.ci95:
            continue
        by_position = fit.values[name]
        value = by_torque.values[name]
        low, high = by_torque.ci95[name]
        agrees = low <= by_position <= high or abs(value - by_position) <= AGREE * by_position
        if not agrees:
            flags.append(
                f"{name} {by_position:.3g} {UNITS[term]} by position, {value:.3g} by torque"
            )
    return flags
