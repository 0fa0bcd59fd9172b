"""What a set of experiments can tell apart, before anything is fitted (reading A10).

A linear joint with position command responds with

    H = kp exp(-s delay) / ((J + armature) s^2 + (kd + viscous + dry) s + kp + m g l),

with kp and kd the true torques per angle, torque_scale times the gains on the drive. Dry friction
enters by its describing function, 4 frictionloss / (pi omega amplitude |H|), which is how it
depends on amplitude. From |H| in one pose only stiffness / inertia and damping / inertia can be
seen, and no amount of data changes that; a second pose, a torque channel or other gains on the
drive do. The Fisher information of the logarithm of the response shows it for any set of
parameters and experiments, and which single further experiment would help.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import IdentifiabilityError, PronkError
from pronk.robots.model import bench_spec
from pronk.robots.robot import Robot

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

PARAMETERS = (
    "stiffness",
    "damping",
    "armature",
    "frictionloss",
    "viscous",
    "delay",
    "torque_scale",
)
"""What can be fitted; the rest is taken for known."""

SD_MAX = 0.3
"""Relative standard deviation beyond which a parameter counts as unknown: at 95 % it would reach
from a half to twice its value."""
CONDITION_MAX = 1e5
"""Condition of the Jacobian beyond which the numbers behind a small deviation are rounding."""
_SHARE = 0.02
"""Component of a blind direction from which on a parameter takes part in it; below is rounding."""
_STEP = 1e-4
_ROUNDS = 40

EXPERIMENTS: Mapping[str, str] = {
    "stiffness": "a pose or a payload in which gravity loads the joint, or a torque channel, "
    "gives the stiffness",
    "damping": "a faster sweep, or another damping on the drive, gives the damping",
    "armature": "a sweep to higher frequencies at an amplitude that the drive can follow, or a "
    "second payload, gives the armature",
    "frictionloss": "a second, smaller amplitude gives the dry friction",
    "delay": "the phase at higher frequencies, or steps logged faster, gives the delay",
    "offset": "the same pose approached from both sides gives the offset",
}
"""What to record when a drive parameter is not identified."""


def _default_frequencies() -> Array:
    return np.asarray(np.geomspace(0.1, 20.0, 60))


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One sweep of one joint."""

    inertia: float
    """Known inertia of the links about the joint [kg m^2]."""
    gravity: float = 0.0
    """m g l: how much gravity pulls the joint back [N m/rad]; negative where it pulls it over."""
    amplitude: float = 0.25
    """Peak of the command [rad] (paper F3)."""
    gain_scale: float = 1.0
    """Stiffness on the drive over its nominal value, known."""
    damping_scale: float = 1.0
    """Damping on the drive over its nominal value, known."""
    phase: bool = False
    """Whether the phase is used; the paper disregards it (F9)."""
    torque: bool = False
    """Whether the true joint torque is recorded."""
    frequency_hz: Array = field(default_factory=_default_frequencies)
    """Where the response is known [Hz], shape (f,)."""
    noise: float = 0.03
    """Standard deviation of the logarithm of the response at each frequency."""


@dataclass(frozen=True, kw_only=True)
class Identifiability:
    """What some experiments tell about some parameters."""

    parameters: tuple[str, ...]
    condition: float
    """Of the Jacobian of the log response by log parameters."""
    sd: Mapping[str, float]
    """Relative standard deviation of each parameter; infinite if it cannot be known."""
    confused: tuple[str, ...]
    """Parameters that cannot be distinguished; empty if all can."""
    cures: tuple[str, ...] = ()
    """Experiments each of which would make everything identifiable."""

    @property
    def ok(self) -> bool:
        """True if every parameter is identified."""
        return not self.confused


def identifiability(
    parameters: Sequence[str], experiments: Sequence[Experiment], nominal: Mapping[str, float]
) -> Identifiability:
    """Analyse what some experiments can tell about some parameters.

    Args:
        parameters: What is to be fitted, out of `PARAMETERS`.
        experiments: What is, or would be, recorded.
        nominal: Value of every parameter about which the response is linearized; stiffness and
            damping are needed, the rest is 0 (torque_scale 1) if not given. A fitted parameter
            must be positive.

    Raises:
        PronkError: A parameter is unknown, not positive though fitted, or there is none.
    """
    names = tuple(parameters)
    values = _checked(names, experiments, nominal)
    result = _analyse(names, experiments, values)
    if result.ok:
        return result
    return replace(result, cures=_cures(names, experiments, values))


def require_identifiable(
    parameters: Sequence[str], experiments: Sequence[Experiment], nominal: Mapping[str, float]
) -> Identifiability:
    """The same, refusing what cannot be distinguished.

    Raises:
        IdentifiabilityError: Some parameters cannot be distinguished; the message names them and
            the experiments that would help.
        PronkError: As `identifiability`.
    """
    result = identifiability(parameters, experiments, nominal)
    if result.ok:
        return result
    known = (
        "any of these would: " + "; ".join(result.cures)
        if result.cures
        else "no single further experiment would: fit fewer parameters"
    )
    if len(result.confused) == 1:
        words = f"these data do not identify {result.confused[0]}"
    else:
        words = f"these data cannot tell apart {', '.join(result.confused)}"
    raise IdentifiabilityError(
        f"{words} (condition {result.condition:.1e}; fitted: {', '.join(result.parameters)}); "
        f"{known}; or hold one of them at a known value."
    )


def bench_experiment(robot: Robot, joint_name: str) -> tuple[Experiment, dict[str, float]]:
    """The paper's sweep of one joint, and the nominal values, from the robot's own model.

    Returns:
        The experiment (link inertia and gravity of the bench model at the default pose), and
        nominal values for every parameter.

    Raises:
        RobotError: The robot has no such joint.
    """
    joint = robot.joint(joint_name)
    model = bench_spec(robot, joint_name).compile()
    data = mujoco.MjData(model)
    dof = int(model.jnt_dofadr[model.joint(joint_name).id])
    pull = []
    step = 1e-3
    for shift in (step, -step, 0.0):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[dof] += shift
        mujoco.mj_forward(model, data)
        pull.append(float(data.qfrc_bias[dof]))
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    experiment = Experiment(
        inertia=float(inertia[dof, dof]) - joint.drive.armature,
        # The bias is the torque that holds the pose: where it grows with the angle, gravity
        # pulls back.
        gravity=(pull[0] - pull[1]) / (2.0 * step),
        frequency_hz=np.geomspace(*joint.band_hz, 60),
    )
    nominal = {
        "stiffness": joint.stiffness,
        "damping": joint.damping,
        "armature": joint.drive.armature,
        "frictionloss": joint.drive.frictionloss,
        "viscous": joint.drive.viscous_damping,
        "delay": robot.timestep_s,
        "torque_scale": 1.0,
    }
    return experiment, nominal


def response(
    experiment: Experiment, values: Mapping[str, float]
) -> tuple[ComplexArray, ComplexArray]:
    """Responses of the joint to its command.

    Returns:
        Position over command and joint torque over command [N m/rad], each of shape (f,).
    """
    s = 2j * np.pi * experiment.frequency_hz
    scale = values["torque_scale"]
    kp = scale * values["stiffness"] * experiment.gain_scale
    kd = scale * values["damping"] * experiment.damping_scale
    inertia = experiment.inertia + values["armature"]
    wait = np.exp(-s * values["delay"])
    dry = 4.0 * values["frictionloss"] / (np.pi * np.abs(s) * experiment.amplitude)
    size = np.ones(len(s))
    # Dry friction depends on the size of the motion it allows: a fixed point, halfway each time.
    for _ in range(_ROUNDS if values["frictionloss"] > 0.0 else 1):
        passive = inertia * s**2 + (values["viscous"] + dry / size) * s + experiment.gravity
        h = kp * wait / (passive + kd * s + kp)
        size = 0.5 * (size + np.maximum(np.abs(h), 1e-3))
    return np.asarray(h), np.asarray(passive * h)


def _observed(experiments: Sequence[Experiment], values: Mapping[str, float]) -> Array:
    """Everything observed, divided by its standard deviation."""
    parts = []
    for experiment in experiments:
        for wanted, signal in zip(
            (True, experiment.torque), response(experiment, values), strict=True
        ):
            if wanted:
                parts.append(np.log(np.abs(signal)) / experiment.noise)
                if experiment.phase:
                    parts.append(np.unwrap(np.angle(signal)) / experiment.noise)
    return np.concatenate(parts)


def _analyse(
    names: tuple[str, ...], experiments: Sequence[Experiment], values: Mapping[str, float]
) -> Identifiability:
    columns = []
    for name in names:
        up = {**values, name: values[name] * np.exp(_STEP)}
        down = {**values, name: values[name] * np.exp(-_STEP)}
        columns.append((_observed(experiments, up) - _observed(experiments, down)) / (2.0 * _STEP))
    jacobian = np.stack(columns, axis=1)
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")
    blind = (singular <= singular[0] / CONDITION_MAX) | (singular <= 0.0)
    with np.errstate(divide="ignore"):
        length = np.where(blind, np.inf, 1.0 / singular)
    spread = np.zeros(len(names))
    for direction, far, unseen in zip(np.abs(directions), length, blind, strict=True):
        takes_part = direction > (_SHARE if unseen else 0.0)
        spread[takes_part] = np.hypot(spread[takes_part], direction[takes_part] * far)
    sd = dict(zip(names, (float(x) for x in spread), strict=True))
    return Identifiability(
        parameters=names,
        condition=condition,
        sd=sd,
        confused=tuple(name for name in names if not sd[name] <= SD_MAX),
    )


def _candidates(
    experiments: Sequence[Experiment],
) -> list[tuple[str, list[Experiment]]]:
    """Further experiments, in words and as what would then be known."""
    first = experiments[0]

    def also(**changes: float) -> list[Experiment]:
        return [*experiments, replace(first, **changes)]  # type: ignore[arg-type]

    found = []
    if not all(e.phase for e in experiments):
        found.append(("use the phase as well", [replace(e, phase=True) for e in experiments]))
    found += [
        (
            "sweep a second pose or a known payload (three times the inertia)",
            also(inertia=3.0 * first.inertia),
        ),
        (
            "sweep a pose in which gravity pulls the joint back (m g l of 2 N m/rad)",
            also(gravity=2.0),
        ),
    ]
    if not all(e.torque for e in experiments):
        found.append(("record the joint torque", [replace(e, torque=True) for e in experiments]))
    found += [
        ("sweep again with half the stiffness on the drive", also(gain_scale=0.5)),
        ("sweep again with half the damping on the drive", also(damping_scale=0.5)),
        ("sweep again at a quarter of the amplitude", also(amplitude=0.25 * first.amplitude)),
    ]
    return found


def _cures(
    names: tuple[str, ...], experiments: Sequence[Experiment], values: Mapping[str, float]
) -> tuple[str, ...]:
    """Single experiments that would do; pairs of them where no single one does."""
    candidates = _candidates(experiments)
    single = tuple(words for words, then in candidates if _analyse(names, then, values).ok)
    if single:
        return single
    pairs = []
    for (words, _), (other, _) in combinations(candidates, 2):
        once = dict(_candidates(experiments))[words]
        then = dict(_candidates(once)).get(other)
        if then is not None and _analyse(names, then, values).ok:
            pairs.append(f"{words} and {other}")
    return tuple(pairs[:3])


def _checked(
    names: tuple[str, ...], experiments: Sequence[Experiment], nominal: Mapping[str, float]
) -> dict[str, float]:
    """Nominal values of every parameter."""
    values = {**dict.fromkeys(PARAMETERS, 0.0), "torque_scale": 1.0, **nominal}
    for name in (*names, *nominal):
        if name not in PARAMETERS:
            raise PronkError(
                f"there is no parameter {name!r}; expected some of {', '.join(PARAMETERS)}."
            )
    if not names or not experiments:
        raise PronkError(
            f"{len(names)} parameters and {len(experiments)} experiments; expected at least one "
            "of each."
        )
    for name in {*names, "stiffness", "damping"}:
        if not values[name] > 0.0:
            raise PronkError(
                f"nominal {name} is {values[name]:g}; what is fitted (and stiffness and damping) "
                "must be positive to be linearized about."
            )
    return values
