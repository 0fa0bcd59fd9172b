"""Name how a simulator drives a joint, from the response of the joint alone.

Two experiments on one joint, all others held at their default positions:

- Steps of the command at successive instants. The step in which each begins to act gives the number
  of steps that the simulator holds a command for, and the whole steps of delay.
- Chirps at three pairs of gains, and one with another armature where it can be set. One pair is not
  enough: explicit drives of inertia `J + h kd` respond as drives of inertia `J` with implicit
  damping do. How the response changes with the gains separates the laws of
  `pronk.robots.drive_law`, and an implicit drive that acts beside the explicit torque.

A joint with friction is fitted to each law; the one that leaves least is the answer. Gravity and
the inertia of the links are the robot's, which is what makes the gains absolute.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.engine import delayed
from pronk.identify.simulators.links import links_of
from pronk.identify.simulators.simulator import Simulator, rollout_joint
from pronk.robots.drive_law import DriveLaw
from pronk.robots.robot import RobotSpec

AMPLITUDE = 0.2
"""Of the commands [rad]; less where the drive's effort limit needs it."""
_REST = 8  # steps before the command moves
_HOLDS = 40  # longest hold that is looked for [steps]
_ITERATIONS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 32)
_SCALES = (1.0, 2.0, 180.0 / math.pi, math.pi / 180.0)
"""Factors on gains that have a usual cause."""
_HALVINGS = 7  # of the gains, until the simulator is stable
_ROUNDS = 25
_IMPEDANCE, _RATE = 0.9, 2.0 / (0.95 * 0.02)
"""Of MuJoCo's dry friction: solimp 0.9 to 0.95, and the rate [1/s] of solref's 0.02 s (MuJoCo,
Computation, Solver parameters)."""
_FAR = 30.0
"""A law that leaves so many times what another leaves is not followed further: iterations change
what is left by less."""
_CLEAR = 0.7  # of what the next law leaves, the best one leaves less
_LEFT = 0.01  # share of the motion that a right answer leaves at most
_GRAVITY = 0.002  # torque of gravity over stiffness [rad] from which on it shows
_NAMES = ("damping", "inertia", "viscous", "friction", "delay", "applied", "gravity")
"""Fitted, as gains, inertia, friction and gravity of any common factor move alike, to a stiffness
that acts as it is set: the factor on damping, inertia, passive damping, dry friction, delay in
steps, and the shares of a change of the armature and of gravity that act."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What a joint responds like."""

    joint: str
    law: DriveLaw
    beside_explicit: bool
    """True if a drive of this law acts beside an explicit torque of the same gains."""
    stiffness_factor: float
    """Stiffness that acts over the one that is set."""
    damping_factor: float
    armature: float  # [kg m^2]
    armature_set: float
    armature_applied: float | None
    """Share of a change of the armature that acts; None where it cannot be set."""
    viscous_damping: float  # [N m s/rad]
    frictionloss: float
    """Dry friction [N m]."""
    frictionloss_set: float
    soft_friction: bool
    """True if it is MuJoCo's soft constraint, in which a joint that is held creeps."""
    gravity: float
    """Share of gravity that acts."""
    delay_s: float
    hold: int
    """Steps that a command is held for."""
    stable_share: float
    """Share of the gains at which the simulator is stable: 1, or less."""
    residual: float
    """RMS of the motion that the answer does not explain, as a share of the motion."""
    faults: Mapping[str, str] = field(default_factory=dict)
    """What acts otherwise than it is set: a word, and a sentence (see `_wrong`)."""


@dataclass(frozen=True, kw_only=True)
class _Runs:
    """What is fitted: R runs of T steps."""

    command: Array
    """Of each step as it acts without delay [rad], shape (T, R)."""
    position: Array
    """[rad], shape (T, R)."""
    stiffness: Array
    damping: Array
    armature_change: Array
    """Shape (R,)."""
    timestep: float
    inertia: float
    """Of the links about the joint [kg m^2]."""
    gravity: tuple[float, float]
    """Torque of gravity `gravity[0] cos q + gravity[1] sin q` [N m]."""

    @property
    def torque(self) -> float:
        """Of the largest stiffness at the amplitude [N m]."""
        return float(self.stiffness.max()) * AMPLITUDE

    @property
    def gravity_shows(self) -> bool:
        """True if gravity moves the joint by enough to be fitted."""
        return math.hypot(*self.gravity) > _GRAVITY * float(self.stiffness.max())


@dataclass(frozen=True)
class _Law:
    drive: DriveLaw
    beside: bool = False
    soft: bool = False


@dataclass(frozen=True)
class _Fit:
    left: float
    """RMS, as a share of the motion."""
    theta: Array
    """Of `_NAMES`."""
    law: _Law


def probe_joint(simulator: Simulator, robot: RobotSpec, joint: str | None = None) -> Probe:
    """Name the drive law and the parameters that act at one joint, whose gains are the robot's.

    It is the first joint that moves no other if None. A PronkError says that there is no such
    joint, that it does not move, or that the simulator diverges even with small gains.
    """
    if joint is None:
        joint = min(robot.joints, key=lambda one: len(one.chain)).name
    drive = robot.joint(joint).drive
    if joint not in simulator.joints:
        raise PronkError(
            f"the simulator has no joint {joint!r}; its joints are {', '.join(simulator.joints)}."
        )
    bench = _Bench(simulator, robot, joint)
    stable = bench.stable_share()
    settable = "armature" in simulator.parameters
    answers: list[tuple[float, _Fit, float, int, _Runs]] = []
    shares = [stable]
    while shares:
        share = shares.pop(0)
        try:
            whole, hold, phase = bench.latency(share)
        except PronkError:
            if answers:
                break  # Friction holds the joint against smaller gains.
            raise
        runs = bench.chirps(share, hold, phase)
        best, rival = _best(runs, whole, settable)
        theta = best.theta
        scale = _scale(runs, float(theta[5]) if settable else None, float(theta[6]))
        unclear = best.left / rival
        if best.left > _LEFT:
            unclear += best.left
            if not answers:
                # Gravity moves a joint far whose gains act per degree; of a limit of the torque
                # smaller gains stay clear.
                more = _SCALES[2] * share
                shares = [more] * bench.stable(more) + [share / 8.0, share / 64.0]
        elif share * scale < 0.2:
            # Laws differ by step times gains over inertia: with so soft a joint, by nothing.
            unclear, shares = 1.0, [share / scale]
        elif unclear > _CLEAR and share <= stable and bench.stable(4.0 * share):
            # Rounding hides by how many iterations laws differ; of larger gains less.
            shares = [4.0 * share]
        else:
            shares = []
        answers.append((unclear, best, scale, hold, runs))
    _, best, scale, hold, runs = min(answers, key=lambda one: one[0])
    left, law = best.left, best.law
    damping, inertia, viscous, friction, delay, applied, gravity = best.theta.tolist()
    found = Probe(
        joint=joint,
        law=law.drive,
        beside_explicit=law.beside,
        stiffness_factor=scale,
        damping_factor=scale * damping,
        armature=scale * inertia - runs.inertia,
        armature_set=drive.armature,
        armature_applied=scale * applied if settable else None,
        viscous_damping=scale * viscous,
        frictionloss=scale * friction,
        frictionloss_set=drive.frictionloss,
        soft_friction=law.soft,
        gravity=scale * gravity,
        delay_s=delay * runs.timestep,
        hold=hold,
        stable_share=stable,
        residual=left,
    )
    return replace(found, faults=_wrong(found, simulator, runs))


class _Bench:
    """Excitation of one joint of a simulator."""

    def __init__(self, simulator: Simulator, robot: RobotSpec, joint: str) -> None:
        self.simulator, self.joint, self.robot = simulator, robot.joint(joint), robot
        self.step = simulator.info.timestep_s
        effort = min(self.joint.drive.effort_limit, self.joint.drive.stall_torque)
        self.amplitude = min(AMPLITUDE, 0.3 * effort / self.joint.stiffness)

    def run(self, command: Array, **values: Array) -> Array:
        """Positions of the joint [rad], shape (B, T), with a command about the pose, (B, T)."""
        names = self.simulator.joints
        pose = np.array([self.robot.joint(name).default_position for name in names])
        full = np.tile(pose, (*command.shape, 1))
        full[..., names.index(self.joint.name)] += command
        with np.errstate(all="ignore"):
            return rollout_joint(self.simulator, self.robot, self.joint.name, full, values)

    def gains(self, share: Array) -> dict[str, Array]:
        """Both gains, shares of the robot's, shape (B,)."""
        return {"stiffness": self.joint.stiffness * share, "damping": self.joint.damping * share}

    def chirp(self) -> Array:
        """The command about the pose [rad], shape (T,): another value each step."""
        count = round(min(max(0.8 / self.step, 160.0), 400.0))
        time = self.step * np.arange(count - _REST)
        low, high = 1.0 / time[-1], min(25.0, 0.1 / self.step)
        phase = 2.0 * np.pi * (low + (high - low) * time / (2.0 * time[-1])) * time
        return np.concatenate([np.zeros(_REST), self.amplitude * (np.sin(phase) + 0.3)])

    def stable(self, share: float) -> bool:
        """Whether the joint stays near with a share of the gains; PronkError if it stays still."""
        position = self.run(self.chirp()[None], **self.gains(np.array([share])))[0]
        motion = position - position[0]
        if not (np.isfinite(motion).all() and np.abs(motion).max() < 12.0 * self.amplitude):
            return False
        if np.ptp(motion) < 1e-3 * self.amplitude:
            raise PronkError(
                f"{self.joint.name} does not move when it is commanded by {self.amplitude:.2g} "
                "rad; check the order of the simulator's joints."
            )
        return True

    def stable_share(self) -> float:
        """The largest share of the gains, a power of 1/2, with which the joint stays near."""
        for halvings in range(_HALVINGS + 1):
            if self.stable(0.5**halvings):
                return float(0.5**halvings)
        raise PronkError(
            f"{self.joint.name} diverges even with 1/{2**_HALVINGS} of {self.joint.stiffness:g} "
            f"N m/rad and {self.joint.damping:g} N m s/rad; check the units and the timestep."
        )

    def latency(self, share: float) -> tuple[int, int, int]:
        """Whole steps of delay, steps of a hold, and the instant of a hold's first step."""
        first = np.arange(_REST, _REST + 2 * _HOLDS)
        length = _REST + 4 * _HOLDS
        command = np.zeros((len(first) + 1, length))
        # Of smaller gains a larger step, which friction does not hold.
        height = self.amplitude * min(max(1.0 / share, 1.0), 5.0)
        command[1:] = height * (np.arange(length)[None] >= first[:, None])
        moved = self.run(command, **self.gains(np.full(len(command), share)))
        apart = np.abs(moved[1:] - moved[:1]) > 1e-5 * self.amplitude
        if not apart.any(axis=1).all():
            raise PronkError(
                f"{self.joint.name} does not respond to a step of {height:.2g} rad within "
                f"{2 * _HOLDS} steps."
            )
        # Position is read at the start of a step: it is apart one step after the command acts.
        acts = apart.argmax(axis=1) - 1
        late = acts - first
        instants = np.unique(acts)
        hold = int(np.diff(instants).max()) if len(instants) > 1 else 1
        return int(late.min()), hold, int(first[late.argmin()])

    def chirps(self, share: float, hold: int, phase: int) -> _Runs:
        """Chirps with three pairs of gains, and with another armature."""
        settable = "armature" in self.simulator.parameters
        rows = 4 if settable else 3
        kp = np.array([1.0, 1.0, 0.5, 1.0])[:rows] * self.joint.stiffness * share
        kd = np.array([1.0, 0.5, 0.5, 1.0])[:rows] * self.joint.damping * share
        links = links_of(self.robot, self.joint.name)
        index = links.joints.index(self.joint.name)
        pose = np.array([self.robot.joint(n).default_position for n in links.joints])
        inertia = links.inertia_about(index, pose)
        own = self.joint.drive.armature
        change = np.array([0.0, 0.0, 0.0, own + 0.5 * inertia])[:rows]
        armature = {"armature": own + change} if settable else {}
        command = np.tile(self.chirp(), (rows, 1))
        position = self.run(command, stiffness=kp, damping=kd, **armature)
        at = np.arange(command.shape[1])
        seen = np.maximum((at - phase) // hold * hold + phase, 0)
        held = command[0, np.minimum(seen, at)] + self.joint.default_position
        torque = []
        for angle in (0.0, 0.5 * np.pi):
            pose[index] = angle
            torque.append(float(links.gravity_torque(pose)[index]))
        return _Runs(
            command=np.tile(held[:, None], (1, rows)),
            position=position.T,
            stiffness=kp,
            damping=kd,
            armature_change=change,
            timestep=self.step,
            inertia=inertia,
            gravity=(torque[0], torque[1]),
        )


def _simulated(runs: _Runs, law: _Law, theta: Array) -> Array:
    """Positions with sets of parameters, shape (P, 7): (P, T, R); see `pronk.robots.drive_law`."""
    damp, inertia, viscous, friction, delay, applied, weight = theta.T[:, :, None]
    kd = damp * runs.damping
    kp = np.broadcast_to(runs.stiffness, kd.shape)
    inertia = np.maximum(inertia + applied * runs.armature_change, 1e-3 * runs.inertia)
    command = np.tile(runs.command, (len(theta), 1, 1))
    command = delayed(command, np.broadcast_to(delay, kp.shape)).transpose(1, 0, 2)
    q = np.broadcast_to(runs.position[0], kp.shape).copy()
    v, out = np.zeros(kp.shape), np.empty((len(command), *kp.shape))
    parts, kind = law.drive.iterations, law.drive.kind
    h = runs.timestep / parts
    explicit = law.beside or kind == "explicit"
    # The drive's part of damping, of law `implicit` with what stiffness adds.
    drive = 0.0 * kd if kind == "explicit" else law.drive.damping(kp, kd, h)
    within = inertia + h * (viscous + drive)
    gain, loss = h / within, h * friction / within
    total, spring = drive + viscous, 0.0 * kp if kind == "explicit" else kp
    cosine, sine = (weight * one for one in runs.gravity)
    for k, target in enumerate(command):
        out[k] = q
        torque = kp * (target - q) - kd * v if explicit else 0.0
        for _ in range(parts):
            pull = torque + spring * (target - q) - total * v + cosine * np.cos(q)
            pull += sine * np.sin(q)
            if law.soft:
                hold = _IMPEDANCE * (pull + _RATE * inertia * v)
                v = v + gain * (pull - np.clip(hold, -friction, friction))
            else:
                v = v + gain * pull
                v = v - np.clip(v, -loss, loss)
            q = q + h * v
    return out.transpose(1, 0, 2)


def _fit(runs: _Runs, law: _Law, start: Array, fixed: frozenset[str], rounds: int) -> _Fit:
    """Parameters of least squares (Levenberg and Marquardt)."""
    free = [i for i, name in enumerate(_NAMES) if name not in fixed]
    size = np.array([start[0], start[1], runs.damping.max(), 0.1 * runs.torque, *np.ones(3)])
    low = np.array([0.0, 1e-3 * runs.inertia, -np.inf, 0.0, -1.0, -np.inf, -np.inf])
    high = np.array([np.inf] * 4 + [start[4] + 2.0, np.inf, np.inf])
    theta, trust = start, 1e-3
    with np.errstate(all="ignore"):
        off = _simulated(runs, law, theta[None])[0] - runs.position
        cost = float(np.mean(off * off))
        for _ in range(rounds):
            moved = np.tile(theta, (len(free), 1))
            moved[np.arange(len(free)), free] += 1e-6 * size[free]
            jacobian = (_simulated(runs, law, moved) - runs.position - off).reshape(len(free), -1)
            jacobian *= 1e6
            square, pull = jacobian @ jacobian.T, jacobian @ off.ravel()
            if not (np.isfinite(square).all() and np.isfinite(cost)):
                break
            # One call for all trials costs as much as one for one.
            trusts = trust * np.array([1e-3, 0.1, 1.0, 30.0, 1e3])
            floor = np.diag(square) + 1e-12 * np.trace(square)
            trials = np.tile(theta, (len(trusts), 1))
            for trial, damped in zip(trials, trusts, strict=True):
                found = np.linalg.lstsq(square + damped * np.diag(floor), pull, rcond=None)[0]
                trial[free] -= size[free] * found
            trials = np.clip(trials, low, high)
            after = _simulated(runs, law, trials) - runs.position
            costs = np.nan_to_num(np.mean(after**2, axis=(1, 2)), nan=np.inf)
            k = int(costs.argmin())
            if costs[k] >= cost:
                if trust > 1e6:
                    break
                trust *= 1e3
                continue
            gained = 1.0 - costs[k] / cost
            theta, off, cost, trust = trials[k], after[k], float(costs[k]), max(trusts[k], 1e-12)
            if gained < 1e-4:
                break
    motion = float(np.std(runs.position - runs.position[0]))
    return _Fit(float(np.sqrt(cost)) / motion if np.isfinite(cost) else np.inf, theta, law)


def _best(runs: _Runs, whole: int, settable: bool) -> tuple[_Fit, float]:
    """The law that leaves least, and what the next one leaves."""
    fixed = frozenset[str]() if settable else frozenset({"applied"})
    starts = np.array(
        [
            [1.0, runs.inertia * inertia / scale, 0.0, 0.0, whole, 1.0 / scale, 1.0 / scale]
            for scale in _SCALES
            for inertia in np.geomspace(1.0, 500.0, 18)
        ]
    )
    tried: list[_Fit] = []
    friction: Array | None = None

    def screen(law: _Law, start: Array | None, rounds: int) -> _Fit:
        if start is None:
            with np.errstate(all="ignore"):
                off = _simulated(runs, law, starts) - runs.position
                square = np.nan_to_num(np.mean(off**2, axis=(1, 2)), nan=np.inf)
            start = starts[square.argmin()]
        tried.append(_fit(runs, law, start, fixed, rounds))
        return tried[-1]

    def least() -> _Fit:
        return min(tried, key=lambda one: one.left)

    for soft in (False, True):
        if soft and (friction is None or least().left < 1e-5):
            break
        screen(_Law(DriveLaw(), soft=soft), friction, 10)
        for beside in (False, True):
            screen(_Law(DriveLaw(kind="implicit_damping"), beside, soft), friction, 10)
            near: _Fit | None = None
            worse = 0
            for n in _ITERATIONS:
                law = _Law(DriveLaw(kind="implicit", iterations=n), beside, soft)
                before = near
                near = screen(law, near.theta if near else friction, 5 if near else 10)
                # What is left has one minimum over the iterations.
                worse = worse + 1 if before and near.left > before.left else 0
                if worse == 2 or (n >= 4 and near.left > _FAR * least().left):
                    break
        # Whether friction is soft shows where there is some.
        theta = least().theta
        friction = theta if theta[3] > 0.002 * runs.torque else None
    tried.sort(key=lambda one: one.left)
    final: list[_Fit] = []
    for begin in tried[:3]:
        if final and begin.left > _FAR * final[0].left:
            break
        free = _fit(runs, begin.law, begin.theta, fixed, _ROUNDS)
        plain = np.array([1.0, *free.theta[1:]])
        usual = _fit(runs, begin.law, plain, fixed | {"damping"}, _ROUNDS)
        # A factor on one of the gains must explain more than none.
        final.append(usual if free.left >= usual.left / 3.0 - 1e-6 else free)
        if free.left < 1e-6:
            break
    final.sort(key=lambda one: one.left)
    return final[0], final[1].left if len(final) > 1 else np.inf


def _scale(runs: _Runs, applied: float | None, gravity: float) -> float:
    """The factor on both gains: the one with which the armature and gravity act as they are set.

    A factor with a usual cause is taken unless another one explains both.
    """
    shares = [] if applied is None else [applied]
    if runs.gravity_shows:
        shares.append(gravity)
    others = [1.0 / share for share in shares if share > 0.01]

    def off(scale: float) -> float:
        wrong = sum(min(abs(scale * share - 1.0), 1.0) for share in shares)
        return float(wrong + 1e-3 * abs(math.log(scale)))

    best = min(_SCALES, key=off)
    return min([best, *others], key=lambda one: off(one) + (0.1 if one != best else 0.0))


def _wrong(found: Probe, simulator: Simulator, runs: _Runs) -> dict[str, str]:
    """Settings that act otherwise than they are set; see `Probe.wrong`."""
    out, stated, law = {}, simulator.info.drive_law, found.law
    if found.beside_explicit:
        out["beside"] = (
            f"a drive of law {law.label} acts beside the explicit torque; set the gains of the "
            "engine's own drive to 0"
        )
    elif law != stated:
        out["law"] = f"law {stated.label} is stated, the joint responds by {law.label}"
    factors = {"stiffness": found.stiffness_factor, "damping": found.damping_factor}
    causes = (
        (2.0, "twice", "torques act twice: the effort is submitted two times"),
        (180.0 / math.pi, "degrees", "gains per degree act as if they were per radian"),
        (math.pi / 180.0, "degrees", "gains per radian act as if they were per degree"),
    )
    for scale, word, sentence in causes:
        if all(abs(factor / scale - 1.0) < 0.05 for factor in factors.values()):
            out[word] = f"{sentence}, {scale:.3g} times the gains that are set"
            break
    else:
        for name, factor in factors.items():
            if abs(factor - 1.0) > 0.05:
                out[name] = f"the {name} that acts is {factor:.3g} times the one that is set"
    acts, own = found.armature, found.armature_set
    if found.armature_applied is not None and found.armature_applied < 0.5:
        out["ignored"] = "a change of the armature changes nothing: the engine ignores it"
    elif abs(acts - own) > 0.03 * (runs.inertia + own):
        out["armature"] = f"an armature of {acts:.4g} kg m^2 acts, {own:.4g} is set"
    acts, own = found.frictionloss, found.frictionloss_set
    apart = abs(acts - own) > max(0.1 * own, 0.005 * runs.torque)
    if apart and "frictionloss" in simulator.parameters:
        out["friction"] = f"dry friction of {acts:.3g} N m acts, {own:.3g} is set"
    if abs(found.gravity - 1.0) > 0.1 and runs.gravity_shows:
        out["gravity"] = f"{max(found.gravity, 0.0):.2f} of the gravity acts that the model has"
    if found.hold > 1:
        out["hold"] = f"the simulator holds each command for {found.hold} steps"
    if found.delay_s < -0.5 * runs.timestep:
        out["early"] = "positions are those at the end of each step, one step early"
    if found.stable_share < 1.0:
        share = found.stable_share
        out["unstable"] = f"the joint diverges with its gains; it was probed with {share:g} of them"
    if found.residual > _LEFT:
        out["left"] = (
            f"{100.0 * found.residual:.1f} % of the motion is left: the joint follows none of the "
            "laws, or others move with it"
        )
    return out
