"""Name how a simulator drives a joint, from the response of the joint alone.

Three experiments on one joint, all others held at their default positions:

- Steps of the command at successive instants. The step in which each begins to act gives the number
  of steps that the simulator holds a command for, and the whole steps of delay.
- Steps of many heights, up to the effort limit. How far the joint comes in the first step in which
  it moves is in proportion to the height, until the torque (or the command) is clipped.
- Chirps at three pairs of gains, and one with another armature where it can be set. One pair is not
  enough: explicit drives of inertia `J + h kd` respond as drives of inertia `J` with implicit
  damping do. How the response changes with the gains separates the laws of
  `pronk.robots.drive_law`, an implicit drive that acts beside the explicit torque, and a torque
  of a position that is some steps old.

A joint with friction is fitted to each law; the law with the smallest residual is the answer, with
those that explain the motion as well. The fits are limited by the steps that they simulate, which
the answer of every machine has in common, and not by time.
Gravity and the inertia of the links are the robot's, which is what makes the gains absolute.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engine import delayed
from pronk.identify.simulators.links import links_of
from pronk.identify.simulators.simulator import Simulator, Values, rollout_joint
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

AMPLITUDE = 0.2
"""Amplitude of the commands [rad]; smaller where the drive's effort limit needs it."""
_REST = 8
"""Steps before the command moves."""
_LONGEST_HOLD = 40
"""Longest hold that is looked for [steps]."""
_HALVINGS = 7
"""Most halvings of the gains until the simulator is stable."""
_USUAL_SCALES = (1.0, 2.0, 180.0 / math.pi, math.pi / 180.0)
"""Factors on both gains that have a usual cause."""
_ITERATIONS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 32)
"""Iterations of law implicit that are tried."""
_IMPEDANCE = 0.9
"""Impedance of MuJoCo's dry friction, the first value of solimp (MuJoCo, Computation, Solver
parameters)."""
_FRICTION_RATE = 2.0 / (0.95 * 0.02)
"""Rate of MuJoCo's dry friction [1/s], of the second value of solimp, 0.95, and solref's 0.02 s."""
_FAR = 30.0
"""A law whose residual is so many times another's is not followed further: iterations change the
residual by less."""
_SCREENING_EVALUATIONS = 20
"""Simulations of the runs with which a law is tried."""
_FINAL_EVALUATIONS = 60
"""Simulations of the runs with which one of the best laws is fitted."""
_CLEAR = 0.7
"""The best law is clear if its residual is less than this share of the next one's."""
_LARGE_RESIDUAL = 0.01
"""Share of the motion that a right answer leaves unexplained at most."""
_DIVERGED = 1e9
"""Position, or its change with a parameter, from which on a simulation has diverged."""
_NO_DAMPING = 1e-3
"""Damping that acts over the one that is set below which there is none."""
_DELAY_SHOWS = 0.05
"""Share of a step from which on a delay is named."""
_GRAVITY_SHOWS = 0.002
"""Torque of gravity over stiffness from which on gravity can be fitted [rad]."""
_SAME_RESIDUAL = 1e-7
"""Residual below which laws are told apart by nothing but rounding."""
_EXACT_RESIDUAL = 1e-6
"""Residual of a law that is certainly right: no other is tried."""
_STALE_STEPS = (1, 2, 3, 4)
"""Ages of the position in the torque that are tried [steps]."""
MOST_STEPS = 1_500_000
"""Integration steps after which no further law is tried. None of 50 random simulators needs more
than 520,000, which take 11 s of a core (`python -m benchmarks probe`)."""
_SHARE_OF_STEPS = 0.4
"""Share of the steps that are left in which laws are tried with one share of the gains."""
_HIGHEST_STEP = 3.0
"""Highest step of the command with which a limit of the torque is looked for [rad]."""
_CLIPPED_SLOPE = 0.3
"""Share of its greatest growth with the height of a step below which the motion is clipped."""
_CLEAR_OF_CLIP = 0.35
"""Amplitude of the chirps over the height of a step that is clipped."""
_DAMPED_SHARE = 0.3
"""What the drive itself takes from the motion of the second step, about, over that of the first."""
_SHORT_FIRST_STEP = 5.0
"""Motion after two steps over that after one from which on a command acts for less than a third of
the first one; it is 3 where it acts for all of it."""
_PARAMETERS = ("damping", "inertia", "viscous", "friction", "delay", "applied", "gravity")
"""Fitted parameters. As gains, inertia, friction and gravity of any common factor move alike, they
belong to a stiffness that acts as it is set: the factor on damping, inertia [kg m^2], passive
damping [N m s/rad], dry friction [N m], delay [steps], and the shares of a change of the armature
and of gravity that act."""


@dataclass(frozen=True, kw_only=True)
class ActingLaw:
    """A law by which a joint moves."""

    drive: DriveLaw
    """Law of the engine's drive."""
    beside_explicit: bool = False
    """True if the drive acts beside an explicit torque of the same gains."""
    soft_friction: bool = False
    """True if dry friction is MuJoCo's soft constraint, in which a joint that is held creeps."""
    stale_position: int = 0
    """Age of the position from which the torque is computed [steps]."""
    stale_speed: int = 0
    """Age of the speed from which the torque is computed [steps]."""
    clip: float | None = None
    """Torque [N m] or command about the pose [rad] at which it is clipped below the effort limit;
    None where no limit was met."""

    @property
    def label(self) -> str:
        """Short name."""
        name = self.drive.label
        if self.beside_explicit:
            name = f"E, beside it {name}"
        if self.stale_position:
            name += f" of an old position (steps: {self.stale_position})"
        return name

    def moves_as(self, other: ActingLaw) -> bool:
        """Tell whether two laws are the same but for the kind of dry friction."""
        return replace(self, soft_friction=other.soft_friction) == other


@dataclass(frozen=True, kw_only=True)
class Clip:
    """A limit that was found in the response to steps of many heights."""

    height: float
    """Height of a step from which on the joint goes no further in its first step [rad]."""
    of_torque: bool
    """True if the torque is clipped, False if the command is."""
    acting: float
    """Share of its first step for which the command acts, about: the rest is delay."""


@dataclass(frozen=True, kw_only=True)
class ActingGains:
    """What acts of the gains that are set."""

    stiffness_factor: float
    """Stiffness that acts over the one that is set."""
    damping_factor: float
    """Damping that acts over the one that is set."""
    stable_share: float
    """Share of the gains at which the simulator is stable: 1, or less."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What a joint responds like."""

    joint: str
    """Name of the joint."""
    law: ActingLaw
    """Law by which it moves."""
    gains: ActingGains
    """What acts of the gains that are set."""
    armature: float
    """Armature that acts [kg m^2]."""
    armature_applied: float | None
    """Share of a change of the armature that acts; None where it cannot be set."""
    viscous_damping: float
    """Passive damping that acts [N m s/rad]."""
    frictionloss: float
    """Dry friction that acts [N m]."""
    gravity: float
    """Share of gravity that acts."""
    delay_s: float
    """Delay of the command [s]."""
    hold: int
    """Steps that a command is held for."""
    residual: float
    """RMS of the motion that the answer does not explain, as a share of the motion."""
    complete: bool
    """False if the limit of integration steps ended the fits before all laws were fitted."""
    alike: tuple[ActingLaw, ...] = ()
    """Other laws that explain the motion as well."""
    faults: Mapping[str, str] = field(default_factory=dict)
    """What acts otherwise than it is set: a word for each, and a sentence."""


class _StepCount:
    """Integration steps that were simulated to fit laws, and how many may be."""

    def __init__(self, most: int) -> None:
        self.simulated = 0
        self.most = most

    def add(self, steps: int) -> None:
        """Count steps that were simulated."""
        self.simulated += steps

    @property
    def left(self) -> int:
        """Steps that may still be simulated."""
        return max(self.most - self.simulated, 0)


@dataclass(frozen=True, kw_only=True)
class _Runs:
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
    steps: _StepCount
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
class _Fit:
    """A law fitted to some runs."""

    law: ActingLaw
    theta: Array
    """Values of `_PARAMETERS`, shape (7,)."""
    residual: float
    """RMS of what is not explained, as a share of the motion."""


@dataclass(frozen=True, kw_only=True)
class _Answer:
    """The best law at one share of the gains."""

    doubt: float
    """Residual over that of the next law, and more where the answer is poor; the least counts."""
    fit: _Fit
    alike: tuple[ActingLaw, ...]
    """Other laws that explain the motion as well."""
    scale: float
    """Gains that act over those that are set."""
    hold: int
    runs: _Runs
    complete: bool
    """False if the steps were over before all laws were fitted."""


def probe_joint(
    simulator: Simulator,
    robot: RobotSpec,
    joint: str | None = None,
    *,
    most_steps: int = MOST_STEPS,
) -> Probe:
    """Name the drive law and the parameters that act at one joint, whose gains are the robot's.

    Args:
        simulator: The simulator.
        robot: The robot whose joint it is.
        joint: The joint; the first one that moves no other if None.
        most_steps: Integration steps of the fits after which no further law is tried.

    Raises:
        PronkError: There is no such joint, it does not move, or the simulator diverges even with
            small gains.
    """
    if joint is None:
        joint = min(robot.joints, key=lambda robot_joint: len(robot_joint.chain)).name
    robot.joint(joint)
    if joint not in simulator.joints:
        raise PronkError(
            f"the simulator has no joint {joint!r}; its joints are {', '.join(simulator.joints)}."
        )
    bench = _Bench(simulator, robot, joint)
    stable_share = bench.stable_share()
    clip = bench.clip(stable_share)
    if clip is not None:
        bench.lower_amplitude(_CLEAR_OF_CLIP * clip.acting * clip.height)
    steps = _StepCount(most_steps)
    answers: list[_Answer] = []
    shares = [stable_share]
    while shares:
        share = shares.pop(0)
        try:
            delay, hold, phase = bench.latency(share)
        except PronkError:
            if answers:
                # Friction holds the joint against smaller gains.
                break
            raise
        # Other shares of the gains need steps as well.
        last_step = steps.simulated + round(_SHARE_OF_STEPS * steps.left)
        runs = bench.chirps(share, hold, phase, steps, last_step)
        if runs.motion < 1e-3 * bench.amplitude:
            # Friction, or a defect, holds the joint.
            break
        ranking = _best_laws(runs, delay, simulator.info.drive_law, bench.armature_settable)
        best = ranking[0]
        alike = _alike(ranking)
        next_residual = np.inf
        for fit in ranking[1:]:
            if fit.law not in alike:
                next_residual = min(next_residual, fit.residual)
        scale = _scale(runs, best, bench.armature_settable)
        doubt = best.residual / max(next_residual, 1e-15)
        more_shares: list[float] = []
        if best.residual > _LARGE_RESIDUAL:
            doubt += best.residual
            if answers:
                more_shares = shares
            else:
                # Gravity moves a joint far whose gains act per degree; of a limit of the torque
                # smaller gains stay clear.
                larger_share = share * 180.0 / math.pi
                if bench.stable(larger_share):
                    more_shares.append(larger_share)
                more_shares += [share / 8.0, share / 64.0]
        elif share * scale < 0.2:
            # Laws differ by step times gains over inertia: with so soft a joint, by nothing.
            doubt = 1.0
            more_shares = [share / scale]
        elif doubt > _CLEAR and share <= stable_share and bench.stable(4.0 * share):
            # Rounding hides by how many iterations laws differ; of larger gains less.
            more_shares = [4.0 * share]
        shares = more_shares if steps.left else []
        answers.append(
            _Answer(
                doubt=doubt,
                fit=best,
                alike=alike,
                scale=scale,
                hold=hold,
                runs=runs,
                complete=not runs.exhausted,
            )
        )
    if not answers:
        raise PronkError(
            f"{joint} moves by less than {1e-3 * bench.amplitude:.1g} rad when it is commanded by "
            f"chirps of {bench.amplitude:.2g} rad; check friction and limits of the simulator."
        )
    answer = min(answers, key=lambda candidate: candidate.doubt)
    damping, inertia, viscous, friction, delay_steps, applied, gravity = answer.fit.theta.tolist()
    scale = answer.scale
    probe = Probe(
        joint=joint,
        law=answer.fit.law,
        gains=ActingGains(
            stiffness_factor=scale,
            damping_factor=scale * damping,
            stable_share=stable_share,
        ),
        armature=scale * inertia - answer.runs.inertia,
        armature_applied=scale * applied if bench.armature_settable else None,
        viscous_damping=scale * viscous,
        frictionloss=scale * friction,
        gravity=scale * gravity,
        delay_s=delay_steps * answer.runs.timestep,
        hold=answer.hold,
        residual=answer.fit.residual,
        complete=answer.complete,
        alike=answer.alike,
    )
    if answer.fit.law.drive.kind == "implicit" and scale > 1.5:
        # Within the iterations of a step much larger gains meet other limits of an engine too.
        clip = None
    if clip is not None:
        limit = clip.height
        if clip.of_torque:
            # In its first step a command acts for the share of the step that the delay leaves.
            acting = 1.0 - (delay_steps - math.floor(delay_steps + 1e-3))
            if acting < 1.0 / (_SHORT_FIRST_STEP - 2.0):
                acting = 1.0
            limit = min(acting, 1.0) * robot.joint(joint).stiffness * stable_share * clip.height
            if answer.fit.residual < _LARGE_RESIDUAL:
                limit *= scale
            drive = robot.joint(joint).drive
            if limit > 0.97 * min(drive.effort_limit, drive.stall_torque):
                # Of larger gains than are set the effort limit is met earlier; it is no fault.
                clip = None
    if clip is not None:
        probe = replace(probe, law=replace(probe.law, clip=limit))
    return replace(probe, faults=_faults(probe, clip, simulator, robot, answer.runs))


class _Bench:
    """The experiments on one joint of a simulator."""

    def __init__(self, simulator: Simulator, robot: RobotSpec, joint: str) -> None:
        self.armature_settable = "armature" in simulator.parameters
        self._simulator = simulator
        self._robot = robot
        self._joint = robot.joint(joint)
        self._step = simulator.info.timestep_s
        drive = self._joint.drive
        effort_limit = min(drive.effort_limit, drive.stall_torque)
        self.amplitude = min(AMPLITUDE, 0.3 * effort_limit / self._joint.stiffness)
        """Amplitude of the commands [rad]."""
        self._highest = min(_HIGHEST_STEP, 2.0 * effort_limit / self._joint.stiffness)

    def lower_amplitude(self, amplitude: float) -> None:
        """Take a smaller amplitude of the commands [rad], if it is smaller."""
        self.amplitude = min(self.amplitude, amplitude)

    def clip(self, share: float) -> Clip | None:
        """Look for a limit of the torque or of the command below the effort limit.

        Args:
            share: Share of the gains.

        Returns:
            The limit; None where there is none up to the effort limit.
        """
        clipped = self._clipped_height(share)
        if clipped is None:
            return None
        height, acting = clipped
        # A torque is clipped at twice the height with half the stiffness, a command at the same.
        other = self._clipped_height(0.5 * share)
        of_torque = other is None or other[0] > 1.4 * height
        return Clip(height=height, of_torque=of_torque, acting=acting)

    def _clipped_height(self, share: float) -> tuple[float, float] | None:
        """Find the height of a step from which on the joint goes no further.

        How far it comes in the first step is in proportion to the command that acts in it.

        Returns:
            The height [rad], and the share of its first step for which the command acts, about;
            None where the joint always goes further.
        """
        heights = self._highest * np.geomspace(1e-3, 1.0, 24)
        length = _REST + 2 * _LONGEST_HOLD
        command = np.zeros((2 * len(heights) + 1, length))
        command[1:, _REST:] = np.concatenate([heights, -heights])[:, None]
        position = self._run(command, self._gains(np.full(len(command), share)))
        motion = position[1:] - position[:1]
        if not np.isfinite(motion).all():
            return None
        moved = np.abs(motion).max(axis=0) > 1e-6 * self._highest
        if not moved[:-1].any():
            return None
        first = int(moved.argmax())
        # Gravity adds to the torque to one side and takes from it to the other.
        both_sides = 0.5 * (motion[: len(heights)] - motion[len(heights) :])
        reach = both_sides[:, first]
        after_one, after_two = both_sides[len(heights) // 2, first : first + 2]
        acting = 1.0
        if after_two > _SHORT_FIRST_STEP * after_one:
            # The delay leaves little of the first step; what the second one adds to the speed.
            reach = both_sides[:, first + 1] - 2.0 * reach
        elif after_one > 0.0:
            # Without damping after_two / after_one is 2 + 1 / acting; damping takes some of it.
            acting = min(1.0, 1.0 / max(after_two / after_one - 2.0 + _DAMPED_SHARE, 1.0))
        slope = np.diff(reach) / np.diff(heights)
        steepest = int(slope.argmax())
        if slope[steepest] <= 0.0 or slope[-1] > _CLIPPED_SLOPE * slope[steepest]:
            return None
        # Where the line of the steepest part reaches the height of the end.
        height = heights[steepest] + (reach[-1] - reach[steepest]) / slope[steepest]
        return float(height), acting

    def stable(self, share: float) -> bool:
        """Tell whether the joint stays near with a share of the gains.

        Raises:
            PronkError: The joint does not move at all.
        """
        position = self._run(self._chirp()[None], self._gains(np.array([share])))[0]
        motion = position - position[0]
        if not np.isfinite(motion).all() or np.abs(motion).max() >= 12.0 * self.amplitude:
            return False
        if np.ptp(motion) < 1e-3 * self.amplitude:
            raise PronkError(
                f"{self._joint.name} does not move when it is commanded by {self.amplitude:.2g} "
                "rad; check the order of the simulator's joints."
            )
        return True

    def stable_share(self) -> float:
        """Find the largest share of the gains, a power of 1/2, with which the joint stays near."""
        for halvings in range(_HALVINGS + 1):
            share = 0.5**halvings
            if self.stable(share):
                return share
        raise PronkError(
            f"{self._joint.name} diverges even with 1/{2**_HALVINGS} of "
            f"{self._joint.stiffness:g} N m/rad and {self._joint.damping:g} N m s/rad; check the "
            "units and the timestep."
        )

    def latency(self, share: float) -> tuple[int, int, int]:
        """Find the delay and the hold of commands with a share of the gains.

        Returns:
            Whole steps of delay, steps of a hold, and the instant of a hold's first step.
        """
        first_steps = np.arange(_REST, _REST + 2 * _LONGEST_HOLD)
        length = _REST + 4 * _LONGEST_HOLD
        command = np.zeros((len(first_steps) + 1, length))
        # Of smaller gains a larger step, which friction does not hold.
        height = self.amplitude * min(max(1.0 / share, 1.0), 5.0)
        command[1:] = height * (np.arange(length)[None] >= first_steps[:, None])
        position = self._run(command, self._gains(np.full(len(command), share)))
        apart = np.abs(position[1:] - position[:1]) > 1e-5 * self.amplitude
        if not apart.any(axis=1).all():
            raise PronkError(
                f"{self._joint.name} does not respond to a step of {height:.2g} rad within "
                f"{2 * _LONGEST_HOLD} steps."
            )
        # Position is read at the start of a step: it is apart one step after the command acts.
        acting_steps = apart.argmax(axis=1) - 1
        lateness = acting_steps - first_steps
        instants = np.unique(acting_steps)
        hold = 1
        if len(instants) > 1:
            hold = int(np.diff(instants).max())
        return int(lateness.min()), hold, int(first_steps[lateness.argmin()])

    def chirps(
        self, share: float, hold: int, phase: int, steps: _StepCount, last_step: int
    ) -> _Runs:
        """Run chirps with three pairs of gains, and with another armature where it can be set.

        Args:
            share: Share of the gains.
            hold: Steps that the simulator holds a command for.
            phase: Instant of a hold's first step.
            steps: `_Runs.steps`.
            last_step: `_Runs.last_step`.
        """
        links = links_of(self._robot, self._joint.name)
        index = links.joints.index(self._joint.name)
        pose = np.array([self._robot.joint(name).default_position for name in links.joints])
        inertia = links.inertia_about(index, pose)
        armature = self._joint.drive.armature
        stiffness = self._joint.stiffness * share * np.array([1.0, 1.0, 0.5])
        damping = self._joint.damping * share * np.array([1.0, 0.5, 0.5])
        armature_change = np.zeros(3)
        values = {}
        if self.armature_settable:
            stiffness = np.append(stiffness, stiffness[0])
            damping = np.append(damping, damping[0])
            armature_change = np.append(armature_change, armature + 0.5 * inertia)
            values["armature"] = armature + armature_change
        values["stiffness"] = stiffness
        values["damping"] = damping
        runs = len(stiffness)
        command = np.tile(self._chirp(), (runs, 1))
        position = self._run(command, values)
        step = np.arange(command.shape[1])
        read_step = np.maximum((step - phase) // hold * hold + phase, 0)
        held_command = command[0, np.minimum(read_step, step)] + self._joint.default_position
        pose[index] = 0.0
        gravity_at_zero = float(links.gravity_torque(pose)[index])
        pose[index] = 0.5 * np.pi
        gravity_at_quarter = float(links.gravity_torque(pose)[index])
        return _Runs(
            command=np.tile(held_command[:, None], (1, runs)),
            position=position.T,
            stiffness=stiffness,
            damping=damping,
            armature_change=armature_change,
            timestep=self._step,
            inertia=inertia,
            gravity=(gravity_at_zero, gravity_at_quarter),
            steps=steps,
            last_step=last_step,
        )

    def _run(self, command: Array, values: Values) -> Array:
        """Return positions of the joint [rad], with commands about the pose, both (B, T)."""
        names = self._simulator.joints
        pose = np.array([self._robot.joint(name).default_position for name in names])
        full_command = np.tile(pose, (*command.shape, 1))
        full_command[..., names.index(self._joint.name)] += command
        with np.errstate(all="ignore"):
            try:
                return rollout_joint(
                    self._simulator, self._robot, self._joint.name, full_command, values
                )
            except (PronkError, KeyboardInterrupt):
                raise
            except Exception as error:
                # What is wrong is in the simulator, which is the user's.
                raise PronkError(
                    f"the simulator's rollout raised {type(error).__name__}: {error}; its command "
                    f"had the shape {full_command.shape} (runs, steps, joints) and the values were "
                    f"{', '.join(values)}."
                ) from error

    def _gains(self, share: Array) -> dict[str, Array]:
        """Return both gains at shares of the robot's, shape (B,)."""
        return {"stiffness": self._joint.stiffness * share, "damping": self._joint.damping * share}

    def _chirp(self) -> Array:
        """Return a command about the pose [rad], shape (T,): another value each step."""
        count = round(min(max(0.8 / self._step, 160.0), 400.0))
        time = self._step * np.arange(count - _REST)
        low_hz = 1.0 / time[-1]
        high_hz = min(25.0, 0.1 / self._step)
        phase = 2.0 * np.pi * (low_hz + (high_hz - low_hz) * time / (2.0 * time[-1])) * time
        return np.concatenate([np.zeros(_REST), self.amplitude * (np.sin(phase) + 0.3)])


def _simulated(runs: _Runs, law: ActingLaw, theta: Array) -> Array:
    """Simulate the runs with P sets of parameters; see `pronk.robots.drive_law`.

    Args:
        runs: The runs.
        law: Law by which the joint moves.
        theta: Values of `_PARAMETERS`, shape (P, 7).

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


def _fit_law(
    runs: _Runs, law: ActingLaw, start: Array, fixed: Sequence[str], evaluations: int
) -> _Fit:
    """Fit the parameters of a law to the runs by least squares.

    Args:
        runs: The runs.
        law: The law.
        start: Values of `_PARAMETERS` to begin with, shape (7,).
        fixed: Names of parameters that are not fitted.
        evaluations: Most simulations of the runs.
    """
    free = [index for index, name in enumerate(_PARAMETERS) if name not in fixed]
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
            latest[key] = _simulated(runs, law, theta).reshape(len(theta), -1)
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
                return _Fit(law=law, theta=start, residual=np.inf)
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
    return _Fit(law=law, theta=theta, residual=rms / runs.motion)


def _best_laws(runs: _Runs, delay: int, stated: DriveLaw, armature_settable: bool) -> list[_Fit]:
    """Fit the laws that may be right, and return the fits, the best one first.

    Args:
        runs: The runs.
        delay: Whole steps of delay.
        stated: Law that the simulator states.
        armature_settable: True if the armature was changed in one run.
    """
    fixed = [] if armature_settable else ["applied"]
    candidates = _screened(runs, delay, fixed)
    candidates.sort(key=lambda fit: fit.residual)
    # The stated law too, which is the answer where others explain the motion no better.
    tried = candidates[:3]
    plain_laws = [stated, DriveLaw(), DriveLaw(kind="implicit_damping")]
    for candidate in candidates[3:]:
        if any(candidate.law.moves_as(ActingLaw(drive=drive)) for drive in plain_laws):
            tried.append(candidate)
    finals: list[_Fit] = []
    for candidate in tried:
        is_stated = candidate.law.moves_as(ActingLaw(drive=stated))
        is_far = finals and candidate.residual > _FAR * max(finals[0].residual, _SAME_RESIDUAL)
        # Where no damping acts, explicit and implicit damping are the same.
        undamped = len(finals) > 0 and finals[0].theta[0] < _NO_DAMPING
        is_plain = any(candidate.law.moves_as(ActingLaw(drive=drive)) for drive in plain_laws)
        if is_far and not is_stated and not (undamped and is_plain):
            continue
        if finals and runs.exhausted:
            break
        fit = _fit_law(runs, candidate.law, candidate.theta, fixed, _FINAL_EVALUATIONS)
        if is_far:
            # Whether the stated law explains the motion with the values of the best one.
            other_fit = _fit_law(runs, fit.law, finals[0].theta, fixed, _FINAL_EVALUATIONS)
            fit = min(fit, other_fit, key=lambda law_fit: law_fit.residual)
        # A factor on one of the gains must explain more than none.
        plain_start = fit.theta.copy()
        plain_start[0] = 1.0
        plain_fit = _fit_law(
            runs, candidate.law, plain_start, [*fixed, "damping"], _FINAL_EVALUATIONS
        )
        if fit.residual >= plain_fit.residual / 3.0 - 1e-6:
            finals.append(plain_fit)
        else:
            finals.append(fit)
        finals.sort(key=lambda final: final.residual)
    for index, fit in enumerate(finals):
        is_stated = fit.law.moves_as(ActingLaw(drive=stated))
        if is_stated and fit.law in _alike(finals):
            finals.insert(0, finals.pop(index))
            break
    return finals


def _alike(ranking: Sequence[_Fit]) -> tuple[ActingLaw, ...]:
    """Return the laws but the first that explain the motion as well as the best one."""
    least_residual = min(fit.residual for fit in ranking)
    laws: list[ActingLaw] = []
    for fit in ranking[1:]:
        as_well = fit.residual < max(least_residual / _CLEAR, _SAME_RESIDUAL)
        if as_well and not fit.law.moves_as(ranking[0].law):
            laws.append(fit.law)
    return tuple(laws)


def _screened(runs: _Runs, delay: int, fixed: Sequence[str]) -> list[_Fit]:
    """Fit the laws to the runs with few simulations, the quick ones first.

    The fits end with a law that leaves nothing, or with the last step.
    """
    explicit = DriveLaw()
    implicit_damping = DriveLaw(kind="implicit_damping")
    fits: list[_Fit] = []
    friction_start: Array | None = None
    for soft in (False, True):
        if soft:
            # Whether friction is soft shows where there is some.
            best = min(fits, key=lambda fit: fit.residual)
            if best.theta[3] <= 0.002 * runs.torque or best.residual < 1e-5:
                break
            friction_start = best.theta
        quick = [ActingLaw(drive=explicit), ActingLaw(drive=implicit_damping)]
        quick.append(ActingLaw(drive=implicit_damping, beside_explicit=True))
        ages = _STALE_STEPS[:1] if soft else _STALE_STEPS
        for age in ages:
            quick.append(ActingLaw(drive=explicit, stale_position=age))
            quick.append(ActingLaw(drive=explicit, stale_position=age, stale_speed=age))
        quick.append(ActingLaw(drive=implicit_damping, stale_position=1))
        for law in quick:
            if fits and runs.exhausted:
                return fits
            fits.append(
                _screened_law(runs, replace(law, soft_friction=soft), friction_start, delay, fixed)
            )
        if min(fit.residual for fit in fits) < _EXACT_RESIDUAL:
            return fits
        for beside in (False, True):
            _screen_iterations(runs, fits, (beside, soft), friction_start, delay, fixed)
            if min(fit.residual for fit in fits) < _EXACT_RESIDUAL:
                return fits
    return fits


def _screen_iterations(
    runs: _Runs,
    fits: list[_Fit],
    variant: tuple[bool, bool],
    start: Array | None,
    delay: int,
    fixed: Sequence[str],
) -> None:
    """Fit law implicit with few, then more iterations, and add the fits to `fits`.

    Args:
        runs: The runs.
        fits: Fits of other laws.
        variant: True if an explicit torque acts beside it, and if friction is soft.
        start: Values of `_PARAMETERS` to begin with; None to search a grid.
        delay: Whole steps of delay.
        fixed: Names of parameters that are not fitted.
    """
    beside, soft = variant
    by_iterations: dict[int, _Fit] = {}

    def fit_iterations(iterations: int, begin: Array | None) -> _Fit:
        law = ActingLaw(
            drive=DriveLaw(kind="implicit", iterations=iterations),
            beside_explicit=beside,
            soft_friction=soft,
        )
        fit = _screened_law(runs, law, begin, delay, fixed)
        fits.append(fit)
        by_iterations[iterations] = fit
        return fit

    previous: _Fit | None = None
    rises = 0
    for iterations in _ITERATIONS:
        if runs.exhausted:
            return
        fit = fit_iterations(iterations, start if previous is None else previous.theta)
        # The residual has one minimum over the iterations.
        if previous is not None and fit.residual > previous.residual:
            rises += 1
        else:
            rises = 0
        least_residual = min(other.residual for other in fits)
        if rises == 2 or (iterations >= 4 and fit.residual > _FAR * least_residual):
            break
        if least_residual < _EXACT_RESIDUAL:
            return
        previous = fit
    # Numbers between those of the list: 5 beside 4 and 6.
    best = min(by_iterations, key=lambda iterations: by_iterations[iterations].residual)
    least_residual = min(other.residual for other in fits)
    if by_iterations[best].residual > least_residual:
        return
    for iterations in range(max(best - 2, 1), best + 3):
        if iterations not in by_iterations and not runs.exhausted:
            fit_iterations(iterations, by_iterations[best].theta)


def _screened_law(
    runs: _Runs, law: ActingLaw, start: Array | None, delay: int, fixed: Sequence[str]
) -> _Fit:
    """Fit a law with few simulations, from the best point of a grid where no start is given."""
    if start is None:
        starts = []
        for scale in _USUAL_SCALES:
            for inertia_factor in np.geomspace(1.0, 500.0, 18):
                inertia = runs.inertia * inertia_factor / scale
                starts.append([1.0, inertia, 0.0, 0.0, delay, 1.0 / scale, 1.0 / scale])
        with np.errstate(all="ignore"):
            difference = _simulated(runs, law, np.array(starts)) - runs.position
            square = np.mean(difference**2, axis=(1, 2))
        best = np.nan_to_num(square, nan=np.inf).argmin()
        start = np.array(starts[best])
    return _fit_law(runs, law, start, fixed, _SCREENING_EVALUATIONS)


def _scale(runs: _Runs, fit: _Fit, armature_settable: bool) -> float:
    """Return the factor on both gains with which armature and gravity act as they are set.

    A factor with a usual cause is taken unless another one explains both.
    """
    applied = float(fit.theta[5])
    gravity = float(fit.theta[6])
    shares = []
    if armature_settable:
        shares.append(applied)
    if runs.gravity_shows:
        shares.append(gravity)

    def misfit(scale: float) -> float:
        total = 1e-3 * abs(math.log(scale))
        for share in shares:
            total += min(abs(scale * share - 1.0), 1.0)
        return total

    best = min(_USUAL_SCALES, key=misfit)
    least_misfit = misfit(best)
    for share in shares:
        if share > 0.01 and misfit(1.0 / share) + 0.1 < least_misfit:
            best = 1.0 / share
            least_misfit = misfit(best) + 0.1
    return best


def _faults(
    probe: Probe, clip: Clip | None, simulator: Simulator, robot: RobotSpec, runs: _Runs
) -> dict[str, str]:
    """Name what acts otherwise than it is set; see `Probe.faults`."""
    faults = {}
    joint = robot.joint(probe.joint)
    drive = joint.drive
    stated_law = simulator.info.drive_law
    law = probe.law.drive
    if clip is not None and clip.of_torque:
        faults["clipped"] = (
            f"torque is clipped at {probe.law.clip:.2g} N m, the effort limit is "
            f"{drive.effort_limit:g} N m; the joint was probed below it"
        )
    elif clip is not None:
        faults["clipped"] = f"the command is clipped at {probe.law.clip:.3g} rad about the pose"
    if not probe.complete:
        faults["incomplete"] = (
            f"the fits ended after {runs.steps.simulated:,} integration steps, before all laws "
            "were fitted: the law may be another, and with it what acts"
        )
    if probe.residual > _LARGE_RESIDUAL:
        unexplained = f"{100.0 * probe.residual:.1f} % of the motion is not explained"
        if probe.complete:
            unexplained += ": the joint follows none of the laws, or others move with it"
        faults["residual"] = unexplained
    if faults.keys() & {"incomplete", "residual"}:
        # What a law says that does not explain the motion, or may not be the best one, is no
        # finding.
        return faults
    labels = [law.label]
    for other in probe.alike:
        labels.append(other.label)
    if probe.law.stale_position:
        taken = probe.law.stale_position * runs.timestep * joint.stiffness
        stale_parts = "position and speed are" if probe.law.stale_speed else "the position is"
        steps = probe.law.stale_position
        age = "one step old" if steps == 1 else f"{steps} steps old"
        faults["stale"] = (
            f"{stale_parts} {age} where the torque is computed, which takes about {taken:.3g} "
            f"N m s/rad from the damping of {joint.damping:g}"
        )
        if law != stated_law:
            faults["law"] = f"law {stated_law.label} is stated, the joint responds by {law.label}"
    elif probe.law.beside_explicit:
        faults["beside"] = (
            f"a drive of law {law.label} acts beside the explicit torque; set the gains of the "
            "engine's own drive to 0"
        )
    elif law != stated_law:
        faults["law"] = (
            f"law {stated_law.label} is stated, the joint responds by {' or '.join(labels)}"
        )

    if _both_near(probe, 2.0):
        faults["twice"] = (
            "torques act twice: the effort is submitted two times, 2 times the gains that are set"
        )
    elif _both_near(probe, 180.0 / math.pi):
        faults["degrees"] = (
            "gains per degree act as if they were per radian, 57.3 times the gains that are set"
        )
    elif _both_near(probe, math.pi / 180.0):
        faults["degrees"] = (
            "gains per radian act as if they were per degree, 0.0175 times the gains that are set"
        )
    else:
        for name, factor in (
            ("stiffness", probe.gains.stiffness_factor),
            ("damping", probe.gains.damping_factor),
        ):
            if abs(factor - 1.0) > 0.05:
                faults[name] = f"the {name} that acts is {factor:.3g} times the one that is set"

    if probe.armature_applied is not None and probe.armature_applied < 0.5:
        faults["ignored"] = (
            "a change of the armature changes nothing: the engine ignores it, and "
            f"{probe.armature:.4g} kg m^2 acts"
        )
    elif abs(probe.armature - drive.armature) > 0.03 * (runs.inertia + drive.armature):
        faults["armature"] = (
            f"an armature of {probe.armature:.4g} kg m^2 acts, {drive.armature:.4g} is set"
        )

    tolerance = max(0.1 * drive.frictionloss, 0.005 * runs.torque)
    friction_differs = abs(probe.frictionloss - drive.frictionloss) > tolerance
    if friction_differs and "frictionloss" in simulator.parameters:
        faults["friction"] = (
            f"dry friction of {probe.frictionloss:.3g} N m acts, {drive.frictionloss:.3g} is set"
        )
    if abs(probe.gravity - 1.0) > 0.1 and runs.gravity_shows:
        share = max(probe.gravity, 0.0)
        faults["gravity"] = f"{share:.2f} of the gravity acts that the model has"
    if probe.hold > 1:
        faults["hold"] = f"the simulator holds each command for {probe.hold} steps"
    if probe.delay_s < -0.5 * runs.timestep:
        faults["early"] = "positions are those at the end of each step, one step early"
    elif probe.delay_s > _DELAY_SHOWS * runs.timestep:
        faults["delay"] = (
            f"commands act {1e3 * probe.delay_s:.3g} ms late ({probe.delay_s / runs.timestep:.3g} "
            "steps), or positions are read so late"
        )
    passive_tolerance = max(0.1 * drive.viscous_damping, 0.03 * joint.damping)
    if abs(probe.viscous_damping - drive.viscous_damping) > passive_tolerance:
        faults["passive"] = (
            f"passive damping of {probe.viscous_damping:.3g} N m s/rad acts, "
            f"{drive.viscous_damping:.3g} is set"
        )
    if probe.gains.stable_share < 1.0:
        faults["unstable"] = (
            "the joint diverges with its gains; it was probed with "
            f"{probe.gains.stable_share:g} of them"
        )
    return faults


def _both_near(probe: Probe, scale: float) -> bool:
    """Tell whether both gains act about `scale` times as they are set."""
    stiffness_near = abs(probe.gains.stiffness_factor / scale - 1.0) < 0.05
    damping_near = abs(probe.gains.damping_factor / scale - 1.0) < 0.05
    return stiffness_near and damping_near
