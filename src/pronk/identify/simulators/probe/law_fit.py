"""One law of a joint with friction: its simulation, and its least-squares fit to the runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array
from pronk.identify.simulators.engine import delayed
from pronk.identify.simulators.probe.result import ActingLaw

AMPLITUDE = 0.2
"""Amplitude of the commands [rad]; smaller where the drive's effort limit needs it."""
PARAMETERS = ("damping", "inertia", "viscous", "friction", "delay", "applied", "gravity")
"""Fitted parameters. As gains, inertia, friction and gravity of any common factor move alike, they
belong to a stiffness that acts as it is set: the factor on damping, inertia [kg m^2], passive
damping [N m s/rad], dry friction [N m], delay [steps], and the shares of a change of the armature
and of gravity that act."""
_IMPEDANCE = 0.9
"""Impedance of MuJoCo's dry friction, the first value of solimp (MuJoCo, Computation, Solver
parameters)."""
_FRICTION_RATE = 2.0 / (0.95 * 0.02)
"""Rate of MuJoCo's dry friction [1/s], of the second value of solimp, 0.95, and solref's 0.02 s."""
_DIVERGED = 1e9
"""Position, or its change with a parameter, from which on a simulation has diverged."""
_GRAVITY_SHOWS = 0.002
"""Torque of gravity over stiffness from which on gravity can be fitted [rad]."""


class StepCount:
    """Integration steps that were simulated to fit laws, and how many may be."""

    def __init__(self, limit: int) -> None:
        self.simulated = 0
        self.limit = limit

    def add(self, steps: int) -> None:
        """Count steps that were simulated."""
        self.simulated += steps

    @property
    def remaining(self) -> int:
        """Steps that may still be simulated."""
        return max(self.limit - self.simulated, 0)


@dataclass(frozen=True, kw_only=True)
class ProbeRuns:
    """R runs of T steps to which laws are fitted."""

    command: Array
    """Command that acts in each step without delay [rad], shape (T, R)."""
    position: Array
    """Position at the start of each step [rad], shape (T, R)."""
    stiffness: Array
    """Stiffness that is set [N m/rad], shape (R,)."""
    damping: Array
    """Damping that is set [N m s/rad], shape (R,)."""
    armature_change: Array
    """Change of the armature [kg m^2], shape (R,)."""
    timestep: float
    """Physics step [s]."""
    inertia: float
    """Inertia of the links about the joint [kg m^2]."""
    gravity: tuple[float, float]
    """Torque of gravity, `gravity[0] cos q + gravity[1] sin q` [N m]."""
    set_values: Array
    """`PARAMETERS` if all acts as it is set and nothing is late, shape (7,)."""
    steps: StepCount
    """Integration steps of the fits, those to all runs of the probe."""
    last_step: int
    """Count of `steps` after which no further law is tried, and fits end."""

    @property
    def exhausted(self) -> bool:
        """True after the last step."""
        return self.steps.simulated > self.last_step

    @property
    def torque(self) -> float:
        """Torque of the largest stiffness at the amplitude of the commands [N m]."""
        return float(self.stiffness.max()) * AMPLITUDE

    @property
    def motion(self) -> float:
        """Standard deviation of the motion [rad]; 0 where it is no number."""
        motion = float(np.std(self.position - self.position[0]))
        return motion if math.isfinite(motion) else 0.0

    @property
    def gravity_shows(self) -> bool:
        """True if gravity moves the joint by enough to be fitted."""
        return math.hypot(*self.gravity) > _GRAVITY_SHOWS * float(self.stiffness.max())


@dataclass(frozen=True, kw_only=True)
class LawFit:
    """A law fitted to some runs."""

    law: ActingLaw
    theta: Array
    """Values of `PARAMETERS`, shape (7,)."""
    residual: float
    """RMS of what is not explained, as a share of the motion."""

    def value(self, name: str) -> float:
        """Return the parameter of a name of `PARAMETERS`."""
        return float(self.theta[PARAMETERS.index(name)])


def simulate_law(runs: ProbeRuns, law: ActingLaw, theta: Array) -> Array:
    """Simulate the runs with P sets of parameters; see `pronk.robots.drive_law`.

    Args:
        runs: The runs.
        law: Law by which the joint moves.
        theta: Values of `PARAMETERS`, shape (P, 7).

    Returns:
        Positions [rad], shape (P, T, R).
    """
    damping_factor, inertia, viscous, friction, delay, applied, gravity = theta.T[:, :, None]
    kd = damping_factor * runs.damping
    kp = np.broadcast_to(runs.stiffness, kd.shape)
    inertia = np.maximum(inertia + applied * runs.armature_change, 1e-3 * runs.inertia)
    command = np.tile(runs.command, (len(theta), 1, 1))
    command = delayed(command, np.broadcast_to(delay, kp.shape)).transpose(1, 0, 2)
    iterations = law.drive.iterations
    h = runs.timestep / iterations
    explicit = law.beside_explicit or law.drive.kind == "explicit"
    # The part of the drive that acts implicitly, of law `implicit` with what stiffness adds.
    spring = kp
    if law.stale_position:
        spring = np.zeros(kp.shape)
    implicit_damping = law.drive.damping(kp, kd, h)
    if law.drive.kind == "explicit":
        spring = np.zeros(kp.shape)
        implicit_damping = np.zeros(kp.shape)
    total_damping = implicit_damping + viscous
    effective_inertia = inertia + h * total_damping
    # The part that acts as it is at the start of a step: of the position, and of the speed.
    step_spring = np.zeros(kp.shape)
    step_damping = np.zeros(kp.shape)
    if explicit:
        step_spring = kp
        step_damping = kd
    elif law.stale_position:
        step_spring = kp
    is_fresh = not (law.stale_position or law.stale_speed)
    holds_torque = (explicit or law.stale_position > 0) and not (is_fresh and iterations == 1)
    if explicit and not holds_torque:
        # With one iteration a step the start of the step is that of the iteration.
        spring = spring + step_spring
        total_damping = total_damping + step_damping
        step_spring = np.zeros(kp.shape)
    # All of it as changes of the speed in an iteration.
    gain = h / effective_inertia
    target_change = gain * (spring + step_spring) * command
    spring = gain * spring
    kept_speed = 1.0 - gain * total_damping
    step_spring = gain * step_spring
    step_damping = gain * step_damping
    runs.steps.add(iterations * len(command))
    has_gravity = bool(np.any(runs.gravity))
    cosine = gain * gravity * runs.gravity[0]
    sine = gain * gravity * runs.gravity[1]
    friction_change = gain * friction
    # Of MuJoCo's dry friction, what it takes of the speed beside what it takes of the torque.
    taken_speed = _FRICTION_RATE * gain * inertia - 1.0
    positions = np.empty((len(command) + 1, *kp.shape))
    speeds = np.zeros((len(command) + 1, *kp.shape))
    positions[0] = runs.position[0]
    for step in range(len(command)):
        q = positions[step]
        v = speeds[step]
        step_change = target_change[step]
        if holds_torque:
            read_position = positions[max(step - law.stale_position, 0)]
            read_speed = speeds[max(step - law.stale_speed, 0)]
            step_change = step_change - step_spring * read_position - step_damping * read_speed
        for _ in range(iterations):
            free_speed = kept_speed * v
            free_speed += step_change
            free_speed -= spring * q
            if has_gravity:
                free_speed += cosine * np.cos(q)
                free_speed += sine * np.sin(q)
            stop = free_speed
            if law.soft_friction:
                stop = _IMPEDANCE * (free_speed + taken_speed * v)
            v = free_speed - np.minimum(np.maximum(stop, -friction_change), friction_change)
            q = q + h * v
        positions[step + 1] = q
        speeds[step + 1] = v
    return positions[:-1].transpose(1, 0, 2)


class _FitEndError(Exception):
    """A fit ends before it has converged: its steps are over, or its simulation diverges."""


def fit_law(
    runs: ProbeRuns, law: ActingLaw, start: Array, fixed: Sequence[str], evaluations: int
) -> LawFit:
    """Fit the parameters of a law to the runs by least squares.

    Args:
        runs: The runs.
        law: The law.
        start: Values of `PARAMETERS` to begin with, shape (7,).
        fixed: Names of parameters that are not fitted.
        evaluations: Most simulations of the runs.
    """
    free = [index for index, name in enumerate(PARAMETERS) if name not in fixed]
    size = np.array([start[0], start[1], runs.damping.max(), 0.1 * runs.torque, 1.0, 1.0, 1.0])
    low = np.array([0.0, 1e-3 * runs.inertia, -np.inf, 0.0, -1.0, -np.inf, -np.inf])
    high = np.array([np.inf, np.inf, np.inf, np.inf, max(start[4] + 2.0, 1.0), np.inf, np.inf])
    start = np.clip(start, low, high)
    step = 1e-6 * size[free]

    latest: dict[bytes, Array] = {}
    best_values = start[free]
    least_square = np.inf

    def positions_at(values: Array) -> Array:
        # All differences in one simulation, which takes about as long as that of one set.
        nonlocal best_values, least_square
        key = values.tobytes()
        if key not in latest:
            theta = np.tile(start, (len(free) + 1, 1))
            theta[:, free] = values
            theta[np.arange(1, len(free) + 1), free] += step
            latest.clear()
            latest[key] = simulate_law(runs, law, theta).reshape(len(theta), -1)
            square = float(np.sum((latest[key][0] - runs.position.ravel()) ** 2))
            if square < least_square:
                least_square = square
                best_values = values.copy()
            if runs.exhausted:
                raise _FitEndError
        return latest[key]

    def residuals(values: Array) -> Array:
        return np.asarray(positions_at(values)[0] - runs.position.ravel())

    def jacobian(values: Array) -> Array:
        positions = positions_at(values)
        differences = np.asarray((positions[1:] - positions[0]).T / step)
        if not np.abs(differences).max() < _DIVERGED:
            raise _FitEndError
        return differences

    with np.errstate(all="ignore"):
        try:
            if not np.abs(positions_at(start[free])).max() < _DIVERGED:
                return LawFit(law=law, theta=start, residual=np.inf)
            least_squares(
                residuals,
                start[free],
                jacobian,
                bounds=(low[free], high[free]),
                x_scale=size[free],
                ftol=1e-4,
                xtol=1e-12,
                gtol=None,
                max_nfev=evaluations,
            )
        except (_FitEndError, np.linalg.LinAlgError, ValueError):
            # The best values until then; SciPy's decompositions refuse numbers that overflow.
            pass
    theta = start.copy()
    theta[free] = best_values
    rms = math.sqrt(least_square / runs.position.size)
    return LawFit(law=law, theta=theta, residual=rms / runs.motion)
