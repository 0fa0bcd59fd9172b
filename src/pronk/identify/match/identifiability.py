"""Parameters that a set of experiments can separate, before anything is fitted (reading A10).

A linear joint with position command responds with

    H = kp exp(-s delay) / ((J + armature) s^2 + (kd + viscous + dry) s + kp + m g l).

Dry friction enters by its describing function, 4 frictionloss / (pi omega amplitude |H|), which is
how it depends on amplitude. From |H| in one pose only stiffness / inertia and damping / inertia can
be seen, and no amount of data changes that; a second pose or other gains on the drive do. The
Fisher information of the logarithm of the response shows it for any set of parameters and
experiments, and which single further experiment would help.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from pronk.arrays import Array, ComplexArray
from pronk.errors import IdentifiabilityError, PronkError
from pronk.identify.match.parameters import FREE, GAINS, checked_names
from pronk.identify.simulators.chain import published
from pronk.robots.model import bench_spec
from pronk.robots.robot import RobotSpec

SD_MAX = 0.3
"""Relative standard deviation beyond which a parameter counts as unknown: at 95 % it would reach
from a half to twice its value."""
CONDITION_MAX = 1e5
"""Condition of the Jacobian beyond which the numbers behind a small deviation are rounding."""
_SHARE = 0.02
"""Component of a blind direction from which on a parameter takes part in it; below is rounding."""
_STEP = 1e-4
_ROUNDS = 40


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One sweep of one joint."""

    inertia: float
    """Known inertia of the links about the joint [kg m^2]."""
    gravity: float = 0.0
    """m g l: how much gravity pulls the joint back [N m/rad]; negative where it pulls it over."""
    amplitude: float = 0.25
    """Peak of the command [rad] (paper F3)."""
    viscous: float = 0.0
    """Viscous friction of the joint [N m s/rad]."""
    gain_scale: float = 1.0
    """Stiffness on the drive over its nominal value, known."""
    damping_scale: float = 1.0
    """Damping on the drive over its nominal value, known."""
    phase: bool = False
    """Whether the phase is used; the paper disregards it (F9)."""
    frequency_hz: Array = field(default_factory=lambda: np.geomspace(0.1, 20.0, 60))
    """Where the response is known [Hz], shape (f,)."""
    noise: float = 0.03
    """Standard deviation of the logarithm of the response at each frequency."""


@dataclass(frozen=True, kw_only=True)
class Identifiability:
    """What some experiments determine of some parameters."""

    condition: float
    """Of the Jacobian of the log response by log parameters."""
    sd: Mapping[str, float]
    """Relative standard deviation of each parameter; infinite if it cannot be known."""

    @property
    def confused(self) -> tuple[str, ...]:
        """Parameters that cannot be distinguished; empty if all can."""
        return tuple(name for name, sd in self.sd.items() if not sd <= SD_MAX)


def identifiability(
    parameters: Sequence[str], experiments: Sequence[Experiment], nominal: Mapping[str, float]
) -> Identifiability:
    """Analyse what some experiments can determine of parameters out of `FREE`.

    The response is linearized about `nominal`: stiffness and damping are needed, the rest is 0 if
    not given. A fitted parameter must be positive.

    Raises:
        PronkError: There is no experiment or parameter, or one is unknown or not positive.
    """
    checked_names(parameters, FREE)
    if not experiments:
        raise PronkError("0 experiments; expected one or more, as from `bench_experiment`.")
    values = {**dict.fromkeys(FREE, 0.0), **nominal}
    for name in {*parameters, *GAINS}:
        if not values[name] > 0.0:
            raise PronkError(
                f"nominal {name} is {values[name]:g}; what is fitted (and stiffness and damping) "
                "must be positive to be linearized about."
            )
    columns = []
    for name in parameters:
        up, down = (
            _observed(experiments, {**values, name: values[name] * np.exp(step)})
            for step in (_STEP, -_STEP)
        )
        columns.append((up - down) / (2.0 * _STEP))
    _, singular, directions = np.linalg.svd(np.array(columns).T, full_matrices=False)
    blind = (singular <= singular[0] / CONDITION_MAX) | (singular <= 0.0)
    with np.errstate(divide="ignore"):
        length = np.where(blind, np.inf, 1.0 / singular)
    spread = np.zeros(len(parameters))
    for direction, far, unseen in zip(np.abs(directions), length, blind, strict=True):
        part = direction > (_SHARE if unseen else 0.0)
        spread[part] = np.hypot(spread[part], direction[part] * far)
    return Identifiability(
        condition=float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf"),
        sd=dict(zip(parameters, spread.tolist(), strict=True)),
    )


def require_identifiable(
    parameters: Sequence[str], experiments: Sequence[Experiment], nominal: Mapping[str, float]
) -> Identifiability:
    """The same; IdentifiabilityError names what cannot be distinguished and what would help."""
    result = identifiability(parameters, experiments, nominal)
    if not (confused := result.confused):
        return result
    remedies = "; ".join(
        words
        for words, then in _candidates(experiments).items()
        if not identifiability(parameters, then, nominal).confused
    )
    known = "no single further experiment would: fit fewer parameters"
    raise IdentifiabilityError(
        f"these data {'do not identify' if len(confused) == 1 else 'cannot separate'} "
        f"{', '.join(confused)} (condition {result.condition:.1e}; fitted: "
        f"{', '.join(parameters)}); {f'any of these would: {remedies}' if remedies else known}; "
        "or hold one of them at a known value."
    )


def bench_inertia(robot: RobotSpec, joint: str) -> tuple[float, float]:
    """Inertia of a joint in the bench model, armature included [kg m^2], and pull of gravity.

    At the default pose; the pull is how much gravity moves the joint back [N m/rad].
    """
    model = bench_spec(robot, joint).compile()
    data, dof = mujoco.MjData(model), model.joint(joint).dofadr[0]
    pull, step = [], 1e-3
    for shift in (step, -step, 0.0):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[dof] += shift
        mujoco.mj_forward(model, data)
        pull.append(float(data.qfrc_bias[dof]))
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    # The bias is the torque that holds the pose: where it grows with the angle, gravity pulls back.
    return float(inertia[dof, dof]), (pull[0] - pull[1]) / (2.0 * step)


def bench_experiment(robot: RobotSpec, joint_name: str) -> tuple[Experiment, dict[str, float]]:
    """The paper's sweep of one joint, and nominal values of every parameter."""
    joint = robot.joint(joint_name)
    inertia, gravity = bench_inertia(robot, joint_name)
    experiment = Experiment(
        inertia=inertia - joint.drive.armature,
        gravity=gravity,
        viscous=joint.drive.viscous_damping,
        frequency_hz=np.geomspace(*joint.band_hz, 60),
    )
    return experiment, published(robot, joint_name) | {"delay": robot.timestep_s}


def response(experiment: Experiment, values: Mapping[str, float]) -> ComplexArray:
    """Position of the joint over its command, shape (f,)."""
    s = 2j * np.pi * experiment.frequency_hz
    kp = values["stiffness"] * experiment.gain_scale
    kd = values["damping"] * experiment.damping_scale
    inertia = experiment.inertia + values["armature"]
    wait = np.exp(-s * values["delay"])
    dry = 4.0 * values["frictionloss"] / (np.pi * np.abs(s) * experiment.amplitude)
    size = np.ones(len(s))
    # Dry friction depends on the size of the motion it allows: a fixed point, halfway each time.
    for _ in range(_ROUNDS if values["frictionloss"] > 0.0 else 1):
        passive = inertia * s**2 + (experiment.viscous + dry / size) * s + experiment.gravity
        h = kp * wait / (passive + kd * s + kp)
        size = 0.5 * (size + np.maximum(np.abs(h), 1e-3))
    return np.asarray(h)


def _observed(experiments: Sequence[Experiment], values: Mapping[str, float]) -> Array:
    """Everything observed, divided by its standard deviation."""
    parts = []
    for experiment in experiments:
        h = response(experiment, values)
        parts.append(np.log(np.abs(h)) / experiment.noise)
        if experiment.phase:
            parts.append(np.unwrap(np.angle(h)) / experiment.noise)
    return np.concatenate(parts)


def _candidates(experiments: Sequence[Experiment]) -> dict[str, list[Experiment]]:
    """Further experiments, in words and with what would then be known."""
    first = experiments[0]
    heavy, quiet = replace(first, inertia=3.0 * first.inertia), 0.25 * first.amplitude
    pulled = replace(first, gravity=2.0)
    further = {
        "sweep a second pose or a known payload (three times the inertia)": heavy,
        "sweep a pose in which gravity pulls the joint back (m g l of 2 N m/rad)": pulled,
        "sweep again with half the stiffness on the drive": replace(first, gain_scale=0.5),
        "sweep again with half the damping on the drive": replace(first, damping_scale=0.5),
        "sweep again at a quarter of the amplitude": replace(first, amplitude=quiet),
    }
    out = {words: [*experiments, one] for words, one in further.items()}
    if not all(one.phase for one in experiments):
        out["use the phase as well"] = [replace(one, phase=True) for one in experiments]
    return out
