"""The AK80-6 double pendulum of DFKI: its recordings, and parameter sets in one form.

Parameters fitted by pronk and those that DFKI publish for the design go through the same filters,
integrator and starts; each has its own law of friction. Armature is MuJoCo's, on the diagonal
alone. The published model also couples the elbow's rotor to the shoulder's acceleration (-gear Ir);
the fitted armature then stands for (gear^2 + gear) Ir.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.torque_fit import (
    FIT_HZ,
    SIGN_RAD_S,
    STRIBECK_RAD_S,
    Motion,
    TorqueFit,
    fit_torque,
    low_passed,
    motion,
)
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "ak80"
"""Folder of the recordings; not part of the repository."""
RIG = Path(__file__).with_name("ak80.xml")
"""Model of the double pendulum."""
JOINTS = ("shoulder", "elbow")
FITTED = ("torque_143339", "torque_143524", "torque_143601")
"""Recordings that the fit sees."""
HELD_OUT = ("torque_143704", "tracking_154220")
"""Recordings that judge the fit; the second is under position feedback."""
HORIZON_S = 0.5
"""Length of a rollout [s]."""
EVERY_S = 0.1
"""Time between the beginnings of two rollouts [s]."""
GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
GEAR = 6.0
"""Gear ratio of the actuators (facts.json)."""
UPPER_M = 0.2
"""Length of the upper link [m] (facts.json)."""


def rig() -> RobotSpec:
    """Return the double pendulum."""
    return load_robot(RIG)


def read_recording(name: str, folder: Path = DATA) -> JointLog:
    """Read one of the recordings."""
    path = folder / f"{name}.csv"
    if not path.is_file():
        raise LogError(f"{path} is missing: the AK80-6 recordings are not here.")
    columns = {}
    for number, joint in enumerate(JOINTS, 1):
        columns[f"position.{joint}"] = f"pos_meas{number}"
        columns[f"torque.{joint}"] = f"tau_meas{number}"
    return read_log(path, robot=rig(), options=ReadOptions(unit="rad", columns=columns))


@dataclass(frozen=True, kw_only=True)
class Pendulum:
    """Double pendulum in its five independent constants, with drives."""

    upper: float
    """Inertia of both links about the shoulder at a right angle of the elbow, less `lower`
    [kg m^2]."""
    lower: float
    """Inertia of the lower link about the elbow [kg m^2]."""
    weight: tuple[complex, complex]
    """Gravity of upper and lower link: torque is the imaginary part of it times e^(i angle)
    [N m]."""
    armature: tuple[float, float, float]
    """Added to the mass matrix: shoulder, off the diagonal, elbow [kg m^2]."""
    viscous: Array
    """Viscous friction of each joint [N m s/rad], shape (2,)."""
    dry: Array
    """Dry friction of each joint [N m], shape (2,)."""
    stribeck: Array
    """Friction of each joint that motion takes away [N m], shape (2,)."""
    arctan: bool
    """True for dry friction as arctan(100 v), the law of the published sets; False for tanh."""

    def torque(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Inverse dynamics [N m], arrays of shape (..., 2)."""
        inertial = np.einsum("...ij,...j->...i", self._mass(position), acceleration)
        return np.asarray(inertial + self._without_acceleration(position, velocity))

    def acceleration(self, position: Array, velocity: Array, torque: Array) -> Array:
        """Forward dynamics [rad/s^2], arrays of shape (n, 2)."""
        accelerating = torque - self._without_acceleration(position, velocity)
        solution = np.linalg.solve(self._mass(position), accelerating[..., None])
        return np.asarray(solution[..., 0])

    def _coupling(self, position: Array) -> NDArray[np.complex128]:
        """Coupling l1 m2 r2 e^(i q2) [kg m^2]."""
        return np.asarray(UPPER_M / GRAVITY * self.weight[1] * np.exp(1j * position[..., 1]))

    def _mass(self, position: Array) -> Array:
        """Mass matrix [kg m^2], shape (..., 2, 2)."""
        cosine = np.real(self._coupling(position))
        shoulder, off_diagonal, elbow = self.armature
        mass = np.empty((*position.shape, 2))
        mass[..., 0, 0] = self.upper + self.lower + 2.0 * cosine + shoulder
        mass[..., 0, 1] = self.lower + cosine + off_diagonal
        mass[..., 1, 0] = self.lower + cosine + off_diagonal
        mass[..., 1, 1] = self.lower + elbow
        return mass

    def _without_acceleration(self, position: Array, velocity: Array) -> Array:
        """Torque of gravity, velocity and friction [N m], shape (..., 2)."""
        sine = np.imag(self._coupling(position))
        upper_angle = position[..., 0]
        lower_angle = position[..., 0] + position[..., 1]
        upper_weight = np.imag(self.weight[0] * np.exp(1j * upper_angle))
        lower_weight = np.imag(self.weight[1] * np.exp(1j * lower_angle))
        v1 = velocity[..., 0]
        v2 = velocity[..., 1]
        shoulder = -sine * (2.0 * v1 * v2 + v2**2) + upper_weight + lower_weight
        elbow = sine * v1**2 + lower_weight
        sign = np.arctan(100.0 * velocity) if self.arctan else np.tanh(velocity / SIGN_RAD_S)
        dry = self.dry + self.stribeck * np.exp(-((velocity / STRIBECK_RAD_S) ** 2))
        rigid = np.stack([shoulder, elbow], axis=-1)
        return np.asarray(rigid + self.viscous * velocity + dry * sign)


def published(facts: Mapping[str, float]) -> Pendulum:
    """One of the sets of facts.json, in its authors' equation of motion."""
    rotor = facts["Ir"]
    first_moment = facts["m1"] * facts["r1"] + facts["m2"] * UPPER_M
    second_moment = facts["m2"] * facts["r2"]
    return Pendulum(
        upper=facts["I1"] + facts["m2"] * UPPER_M**2,
        lower=facts["I2"],
        weight=(complex(GRAVITY * first_moment), complex(GRAVITY * second_moment)),
        armature=((GEAR**2 + 1.0) * rotor, -GEAR * rotor, GEAR**2 * rotor),
        viscous=np.array([facts["b1"], facts["b2"]]),
        dry=np.array([facts["cf1"], facts["cf2"]]),
        stribeck=np.zeros(2),
        arctan=True,
    )


def fitted(fit: TorqueFit) -> Pendulum:
    """The pendulum that a fit stands for, from its torque in a few states."""
    still = np.zeros((1, 2))

    def torque(
        position: tuple[float, float], acceleration: tuple[float, float] = (0.0, 0.0)
    ) -> Array:
        states = np.array([position]), still, np.array([acceleration])
        return np.asarray(fit.torque(*states)[0])

    def friction(term: str) -> Array:
        return np.array([fit.coefficients[fit.model.columns[joint, term]] for joint in JOINTS])

    hanging = torque((0.0, 0.0))
    level = torque((np.pi / 2.0, 0.0))
    bent = (0.0, np.pi / 2.0)
    upper_weight = complex(level[0] - level[1], hanging[0] - hanging[1])
    lower_weight = complex(level[1], hanging[1])
    by_shoulder = torque(bent, (1.0, 0.0)) - torque(bent)
    by_elbow = torque(bent, (0.0, 1.0)) - torque(bent)
    coupling = -UPPER_M / GRAVITY * lower_weight.imag  # with the elbow at a right angle
    return Pendulum(
        upper=float(by_shoulder[0] - by_shoulder[1]) - coupling,
        lower=float(by_shoulder[1]) - coupling,
        weight=(upper_weight, lower_weight),
        armature=(0.0, 0.0, float(by_elbow[1] - by_shoulder[1]) + coupling),
        viscous=friction("viscous"),
        dry=friction("dry"),
        stribeck=friction("stribeck"),
        arctan=False,
    )


def torque_error(pendulum: Pendulum, moved: Motion) -> Array:
    """RMSE of torque by inverse dynamics below `FIT_HZ` [N m], shape (2,)."""
    rate_hz = 1.0 / float(moved.time[1] - moved.time[0])
    torque = pendulum.torque(moved.position, moved.velocity, moved.acceleration)
    difference = low_passed(torque - moved.torque, rate_hz, FIT_HZ)
    edge = round(0.1 * rate_hz)
    return np.asarray(np.sqrt(np.mean(difference[edge:-edge] ** 2, axis=0)))


def rollout_error(pendulum: Pendulum, moved: Motion) -> Array:
    """RMSE of position over rollouts driven by the measured torque [rad], shape (2,)."""
    step = float(moved.time[1] - moved.time[0])
    count = round(HORIZON_S / step)
    edge = round(0.1 / step)
    starts = np.arange(edge, len(moved.time) - count - edge, round(EVERY_S / step))
    position = moved.position[starts]
    velocity = moved.velocity[starts]
    squares = np.zeros(2)
    for k in range(count):
        # Semi-implicit steps with four substeps: dry friction is stiff near standstill.
        before = moved.torque[starts + k]
        after = moved.torque[starts + k + 1]
        for part in range(4):
            share = part / 4.0
            torque = (1.0 - share) * before + share * after
            velocity = velocity + step / 4.0 * pendulum.acceleration(position, velocity, torque)
            velocity = np.clip(velocity, -100.0, 100.0)
            position = position + step / 4.0 * velocity
        squares += np.sum((position - moved.position[starts + k + 1]) ** 2, axis=0)
    return np.asarray(np.sqrt(squares / (count * len(starts))))


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Errors of the fit and of the published sets on one recording."""

    recording: str
    quantity: str
    """`torque` [N m] or `position` [rad]."""
    joint: str
    errors: dict[str, float]
    """RMSE of each set by its name; pronk's is `fit`."""

    @property
    def lower_than(self) -> list[str]:
        """Published sets whose error is larger than that of the fit."""
        return [name for name, error in self.errors.items() if error > self.errors["fit"]]


def compare(folder: Path = DATA) -> tuple[TorqueFit, list[Comparison]]:
    """Fit three recordings and compare all sets on the two others."""
    logs = [read_recording(name, folder) for name in FITTED]
    fit = fit_torque(logs, rig(), JOINTS[0], links_known=False, shared=(JOINTS,))
    facts = json.loads((folder / "facts.json").read_text())["published_parameters"]
    sets = {"fit": fitted(fit)}
    for name in sorted(facts):
        sets[name] = published(facts[name])
    comparisons = []
    for recording in HELD_OUT:
        moved = motion(read_recording(recording, folder), JOINTS)
        torque = {name: torque_error(pendulum, moved) for name, pendulum in sets.items()}
        position = {name: rollout_error(pendulum, moved) for name, pendulum in sets.items()}
        for quantity, errors in (("torque", torque), ("position", position)):
            for index, joint in enumerate(JOINTS):
                comparisons.append(
                    Comparison(
                        recording=recording,
                        quantity=quantity,
                        joint=joint,
                        errors={name: float(error[index]) for name, error in errors.items()},
                    )
                )
    return fit, comparisons
