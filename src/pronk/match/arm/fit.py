"""Fit the drives of an arm that moved all its joints at once.

The same question goes to the simulator: the whole arm, gravity included, every joint commanded as
recorded. It is answered in time, not frequency, because what dominates the servos of small arms,
dry friction under load, has no frequency response.

Uncertainty is a delete-one-block jackknife over blocks of the recordings, one Gauss-Newton step
from the optimum: blocks are the unit, not samples, so coloured residuals count as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares

from pronk.errors import IdentifiabilityError, LogError
from pronk.logs.joint_log import SweepLog
from pronk.match.arm.problem import DriveProblem, stacked
from pronk.match.identifiability import EXPERIMENTS
from pronk.match.parameters import DRIVE_MODE, KINDS, PARAMETERS, asked_of
from pronk.robots.robot import Robot
from pronk.simulators.chain import ChainSimulation, Drives, JointDrive

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

BLOCK_S = 20.0
"""Length of a block of the jackknife [s]: many times the joints' memory of half a second."""
MIN_BLOCKS = 3
_ROUNDS = 15
_SETTLED = 1e-3
"""Relative change of cost or parameters that ends the search: far below the intervals."""
_AT_BOUND = 1e-3


@dataclass(frozen=True, kw_only=True)
class DriveJoint:
    """What was fitted for one joint."""

    drive: JointDrive
    fitted: tuple[str, ...]
    """Names of the parameters that were fitted; the others were held."""
    covariance: Array
    """Of the fitted parameters in their own units, shape (p, p)."""
    sd: Mapping[str, float]
    """Standard deviation of each fitted parameter: relative, of delay and offset in [s], [rad]."""
    ci95: Mapping[str, tuple[float, float]]
    """95 % interval of each fitted parameter, Student's t over blocks."""
    rmse: float
    """Simulated less recorded position over the believed samples [rad]."""
    published_rmse: float
    """The same with the robot's published figures."""
    trusted_hz: float
    """Frequency up to which the recordings were believed [Hz]; infinite if to their end."""
    trusted_share: float
    """Share of the samples that were believed."""
    flags: tuple[str, ...] = ()

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Fitted parameters that the recordings do not identify."""
        return tuple(name for name in self.fitted if not self.sd[name] <= KINDS[name].sd_max)


@dataclass(frozen=True, kw_only=True)
class DriveFit:
    """A fitted arm."""

    robot: str
    joints: Mapping[str, DriveJoint]
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Joints that moved and were not fitted, and why."""
    evaluations: int = 0
    """Simulations of all recordings that it took."""

    @property
    def drives(self) -> dict[str, JointDrive]:
        """Fitted drives by joint name."""
        return {name: joint.drive for name, joint in self.joints.items()}


def fit_drive(
    logs: Sequence[SweepLog],
    robot: Robot,
    *,
    parameters: Sequence[str] | Mapping[str, Sequence[str]] = DRIVE_MODE,
    start: Drives | None = None,
    strict: bool = True,
    threads: int = 2,
    progress: Progress | None = None,
) -> DriveFit:
    """Fit drive parameters of every joint that moves in some recordings.

    Args:
        logs: Recordings of one arm; several joints may move at once.
        robot: The robot.
        parameters: Names out of `PARAMETERS`, for all joints or by joint name.
        start: Drives to begin with, the robot's published ones if not given. What is not fitted
            keeps these values.
        strict: Refuse parameters that the recordings cannot tell apart. Otherwise they are
            reported with their deviation, and `DriveJoint.unidentified` names them.
        threads: Threads of the simulator.
        progress: Told the stage in words and the share of it that is done, 0 to 1.

    Raises:
        PronkError: A parameter is unknown or none is asked.
        LogError: Nothing moves in radians, or the recordings are too short for intervals.
        IdentifiabilityError: `strict`, and a parameter is not identified; the message names it
            and what to record.
    """
    if not logs:
        raise LogError("no recordings; fit_drive needs at least one.")
    with ChainSimulation(robot, logs, threads=threads) as rig:
        asked = asked_of(parameters, rig.joints)
        kinds = len({name for names in asked.values() for name in names})
        most = _ROUNDS * (1 + kinds)

        def told(evaluations: int) -> None:
            if progress is not None:
                progress("fit", min(evaluations / most, 0.99))

        problem = DriveProblem(rig, asked, start or {}, told)
        blocks = _blocks(logs)
        if (count := len(np.unique(blocks))) < MIN_BLOCKS:
            raise LogError(
                f"the recordings make {count} blocks of {BLOCK_S:g} s; intervals need at least "
                f"{MIN_BLOCKS}."
            )
        found = least_squares(
            problem.residual,
            problem.begin,
            jac=problem.jacobian,
            bounds=(problem.low, problem.high),
            x_scale="jac",
            xtol=_SETTLED,
            ftol=_SETTLED,
            max_nfev=_ROUNDS,
        )
        x = np.asarray(found.x)
        fit = DriveFit(
            robot=robot.name,
            joints=_joints(problem, x, blocks),
            excluded=rig.excluded,
            evaluations=problem.evaluations,
        )
    if progress is not None:
        progress("fit", 1.0)
    if strict:
        _refuse(fit)
    return fit


def _joints(problem: DriveProblem, x: Array, blocks: NDArray[np.int64]) -> dict[str, DriveJoint]:
    """Values, intervals and doubts of every joint at the optimum."""
    published = {
        joint: JointDrive.published(problem.rig.robot, joint) for joint in problem.rig.joints
    }
    naive = stacked(problem.differences([published])[0])
    error, jacobian = problem.residual(x), problem.jacobian(x)
    believed = np.concatenate(problem.believed).T
    at_bound = np.minimum(x - problem.low, problem.high - x) < _AT_BOUND * (
        problem.high - problem.low
    )
    drives = problem.drives(x)
    out = {}
    for column, joint in enumerate(problem.rig.joints):
        block, mask = problem.block(joint), believed[column]
        mine = [i for i, (name, _) in enumerate(problem.slots) if name == joint]
        kinds = [KINDS[name] for name in problem.asked[joint]]
        spread, freedom = _jackknife(
            jacobian[block][:, mine][mask], error[block][mask], blocks[mask]
        )
        sd = np.sqrt(np.diag(spread))
        # e^20 is as good as infinite and does not overflow.
        half = np.minimum(sd * float(stats.t.ppf(0.975, freedom)), 20.0)
        slope = np.array([kind.slope(x[i]) for kind, i in zip(kinds, mine, strict=True)])
        out[joint] = DriveJoint(
            drive=drives[joint],
            fitted=problem.asked[joint],
            covariance=spread * np.outer(slope, slope),
            sd=dict(zip(problem.asked[joint], sd.tolist(), strict=True)),
            ci95={
                name: (
                    max(kind.unscaled(x[i] - reach), -np.inf if name == "offset" else 0.0),
                    kind.unscaled(x[i] + reach),
                )
                for name, kind, i, reach in zip(
                    problem.asked[joint], kinds, mine, half, strict=True
                )
            },
            rmse=float(np.sqrt(np.mean(error[block][mask] ** 2))),
            published_rmse=float(np.sqrt(np.mean(naive[block][mask] ** 2))),
            trusted_hz=problem.limit_hz[joint],
            trusted_share=float(mask.sum() / _asked_samples(problem, joint)),
            flags=tuple(
                f"{name} at the bound of the search, {kind.unscaled(x[i]):.3g} {kind.unit}"
                for name, kind, i in zip(problem.asked[joint], kinds, mine, strict=True)
                if at_bound[i] and name != "delay"  # no delay is a fair answer
            ),
        )
    return out


def _asked_samples(problem: DriveProblem, joint: str) -> int:
    """Samples of the recordings in which a joint was asked at all."""
    column = problem.rig.joints.index(joint)
    return sum(len(part) for part in problem.measured if np.isfinite(part[0, column]))


def _blocks(logs: Sequence[SweepLog]) -> NDArray[np.int64]:
    """Number of the block of every sample of all recordings, shape (rows,)."""
    out, first = [], 0
    for log in logs:
        span = log.time[-1] - log.time[0]
        count = max(round(span / BLOCK_S), 1)
        share = ((log.time - log.time[0]) / span * count).astype(np.int64)
        out.append(first + np.minimum(share, count - 1))
        first += count
    return np.concatenate(out)


def _jackknife(jacobian: Array, error: Array, blocks: NDArray[np.int64]) -> tuple[Array, int]:
    """Covariance of scaled parameters by leaving out one block at a time, linearized.

    Leaving out block b moves the optimum by (A - A_b)^-1 J_b^T r_b with A = J^T J, A_b = J_b^T J_b.

    Returns:
        Covariance, shape (p, p), and its degrees of freedom.
    """
    whole = jacobian.T @ jacobian
    # A parameter without effect must come out as very uncertain, not as an error.
    whole = whole + 1e-12 * np.trace(whole) * np.eye(len(whole))
    numbers = np.unique(blocks)
    moves = []
    for number in numbers:
        own = jacobian[blocks == number]
        left = whole - own.T @ own
        moves.append(np.linalg.lstsq(left, own.T @ error[blocks == number], rcond=None)[0])
    about = np.array(moves) - np.mean(moves, axis=0)
    count = len(numbers)
    return np.asarray((count - 1) / count * about.T @ about), count - 1


def _refuse(fit: DriveFit) -> None:
    """Raise if a parameter of any joint is not identified."""
    doubts = {name: joint.unidentified for name, joint in fit.joints.items()}
    if not any(doubts.values()):
        return
    said = "; ".join(f"{joint}: {', '.join(names)}" for joint, names in doubts.items() if names)
    wanted = {name for names in doubts.values() for name in names}
    cures = "; ".join(EXPERIMENTS[name] for name in PARAMETERS if name in wanted)
    raise IdentifiabilityError(
        f"these recordings cannot tell apart what was asked of {said}; ask for less, or record "
        f"more: {cures}."
    )
