"""`python -m benchmarks ak80`: the torque fit on real AK80-6 recordings beside published sets.

The double pendulum of shared/data/ak80. The fit uses three torque logs; compared on the fourth and
on a recording under position feedback, with each parameter set that DFKI publish for the design:
torque by inverse dynamics against the sensor, both low-passed at `FIT_HZ`, and position over
rollouts of 0.5 s driven by the measured torque, which begin at the measured state. Sets published
and fitted go through the same filters, integrator and starts; each has its own law of friction.

`FIT_HZ`, no offset of the torque sensor and links straight from joint to centre of mass were chosen
on these recordings, the two compared ones included; the parameters were fitted without those two.
Armature is MuJoCo's, on the diagonal alone. The published model also couples the elbow's rotor to
the shoulder's acceleration (-gear Ir); the fitted armature then stands for (gear^2 + gear) Ir.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.runner import finish
from pronk.arrays import Array
from pronk.cli import console
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.torque import (
    BLOCK_S,
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
RIG = Path(__file__).with_name("ak80.xml")
JOINTS = ("shoulder", "elbow")
FITTED = ("torque_143339", "torque_143524", "torque_143601")
HELD_OUT = ("torque_143704", "tracking_154220")
HORIZON_S, EVERY_S = 0.5, 0.1
GRAVITY = 9.81
GEAR, UPPER_M = 6.0, 0.2
"""facts.json"""


def rig() -> RobotSpec:
    """Return the double pendulum."""
    return load_robot(RIG)


def read(name: str, data: Path = DATA) -> JointLog:
    """Read one of the recordings."""
    path = data / f"{name}.csv"
    if not path.is_file():
        raise LogError(f"{path} is missing: the AK80-6 recordings are not here.")
    names = {"position": "pos_meas", "torque": "tau_meas"}
    columns = {
        f"{ours}.{joint}": f"{theirs}{i + 1}"
        for ours, theirs in names.items()
        for i, joint in enumerate(JOINTS)
    }
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
    dry: Array
    stribeck: Array
    """Friction of each joint, shape (2,)."""
    arctan: bool
    """Dry friction as arctan(100 v), the law of the published sets (their plant model), or as
    tanh."""

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        """Inverse dynamics [N m], arrays of shape (..., 2)."""
        mass, rest = self._mass(q), self._rest(q, v)
        return np.asarray(np.einsum("...ij,...j->...i", mass, a) + rest)

    def acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """Forward dynamics [rad/s^2], arrays of shape (n, 2)."""
        right = torque - self._rest(q, v)
        return np.asarray(np.linalg.solve(self._mass(q), right[..., None])[..., 0])

    def _coupling(self, q: Array) -> NDArray[np.complex128]:
        """Coupling l1 m2 r2 e^(i q2) [kg m^2]."""
        return np.asarray(UPPER_M / GRAVITY * self.weight[1] * np.exp(1j * q[..., 1]))

    def _mass(self, q: Array) -> Array:
        cosine = np.real(self._coupling(q))
        first, off, second = self.armature
        mass = np.empty((*q.shape, 2))
        mass[..., 0, 0] = self.upper + self.lower + 2.0 * cosine + first
        mass[..., 0, 1] = mass[..., 1, 0] = self.lower + cosine + off
        mass[..., 1, 1] = self.lower + second
        return mass

    def _rest(self, q: Array, v: Array) -> Array:
        sine = np.imag(self._coupling(q))
        low = np.imag(self.weight[1] * np.exp(1j * (q[..., 0] + q[..., 1])))
        up = np.imag(self.weight[0] * np.exp(1j * q[..., 0]))
        v1, v2 = v[..., 0], v[..., 1]
        rest = np.stack([-sine * (2.0 * v1 * v2 + v2**2) + up + low, sine * v1**2 + low], axis=-1)
        sign = np.arctan(100.0 * v) if self.arctan else np.tanh(v / SIGN_RAD_S)
        dry = self.dry + self.stribeck * np.exp(-((v / STRIBECK_RAD_S) ** 2))
        return np.asarray(rest + self.viscous * v + dry * sign)


def published(facts: Mapping[str, float]) -> Pendulum:
    """One of the sets of facts.json, in its authors' equation of motion."""
    m2r2, rotor = facts["m2"] * facts["r2"], facts["Ir"]
    first = facts["m1"] * facts["r1"] + facts["m2"] * UPPER_M
    return Pendulum(
        upper=facts["I1"] + facts["m2"] * UPPER_M**2,
        lower=facts["I2"],
        weight=(complex(GRAVITY * first), complex(GRAVITY * m2r2)),
        armature=((GEAR**2 + 1.0) * rotor, -GEAR * rotor, GEAR**2 * rotor),
        viscous=np.array([facts["b1"], facts["b2"]]),
        dry=np.array([facts["cf1"], facts["cf2"]]),
        stribeck=np.zeros(2),
        arctan=True,
    )


def fitted(fit: TorqueFit) -> Pendulum:
    """The pendulum that a fit stands for, from its torque in a few states."""
    still = np.zeros((1, 2))

    def at(q: tuple[float, float], a: tuple[float, float] = (0.0, 0.0)) -> Array:
        return np.asarray(fit.torque(np.array([q]), still, np.array([a]))[0])

    hanging, level, bent = (0.0, 0.0), (np.pi / 2.0, 0.0), (0.0, np.pi / 2.0)
    down, side = at(hanging), at(level)
    weight = (complex(side[0] - side[1], down[0] - down[1]), complex(side[1], down[1]))
    first, second = at(bent, (1.0, 0.0)) - at(bent), at(bent, (0.0, 1.0)) - at(bent)
    coupling = -UPPER_M / GRAVITY * weight[1].imag  # with the elbow at a right angle
    terms = {
        term: np.array([fit.coefficients[fit.model.columns[joint, term]] for joint in JOINTS])
        for term in ("viscous", "dry", "stribeck")
    }
    return Pendulum(
        upper=float(first[0] - first[1]) - coupling,
        lower=float(first[1]) - coupling,
        weight=weight,
        armature=(0.0, 0.0, float(second[1] - first[1]) + coupling),
        arctan=False,
        **terms,
    )


def torque_error(pendulum: Pendulum, moved: Motion) -> Array:
    """RMSE of torque by inverse dynamics below `FIT_HZ` [N m], shape (2,)."""
    rate = 1.0 / float(moved.time[1] - moved.time[0])
    wrong = pendulum.torque(moved.position, moved.velocity, moved.acceleration) - moved.torque
    edge = round(0.1 * rate)
    return np.asarray(np.sqrt(np.mean(low_passed(wrong, rate, FIT_HZ)[edge:-edge] ** 2, axis=0)))


def rollout_error(pendulum: Pendulum, moved: Motion) -> Array:
    """RMSE of position over rollouts driven by the measured torque [rad], shape (2,)."""
    step = float(moved.time[1] - moved.time[0])
    count, edge = round(HORIZON_S / step), round(0.1 / step)
    starts = np.arange(edge, len(moved.time) - count - edge, round(EVERY_S / step))
    q, v, squares = moved.position[starts], moved.velocity[starts], np.zeros(2)
    for k in range(count):
        # Semi-implicit steps with four substeps: dry friction is stiff near standstill.
        for part in range(4):
            share = part / 4.0
            torque = (1.0 - share) * moved.torque[starts + k] + share * moved.torque[starts + k + 1]
            v = v + step / 4.0 * pendulum.acceleration(q, v, torque)
            v = np.clip(v, -100.0, 100.0)
            q = q + step / 4.0 * v
        squares += np.sum((q - moved.position[starts + k + 1]) ** 2, axis=0)
    return np.asarray(np.sqrt(squares / (count * len(starts))))


def run(data: Path = DATA) -> dict[str, Any]:
    """Fit three logs and compare all sets on the two others."""
    fit = fit_torque(
        [read(name, data) for name in FITTED], rig(), JOINTS[0], links_known=False, shared=(JOINTS,)
    )
    facts = json.loads((data / "facts.json").read_text())["published_parameters"]
    sets = {"fit": fitted(fit), **{name: published(one) for name, one in sorted(facts.items())}}
    errors = {}
    for log in HELD_OUT:
        moved = motion(read(log, data), JOINTS)
        errors[log] = {
            name: {"torque": torque_error(one, moved), "position": rollout_error(one, moved)}
            for name, one in sets.items()
        }
    return {"fit": fit, "errors": errors}


def ak80() -> console.Outcome:
    """Torque fit on real AK80-6 recordings beside four published parameter sets."""
    found = run()
    rows, lower, cells = [], 0, 0
    for log, errors in found["errors"].items():
        for kind, factor in (("torque", 1.0), ("position", 1e3)):
            for j, joint in enumerate(JOINTS):
                values = {name: factor * one[kind][j] for name, one in errors.items()}
                lower += sum(values["fit"] < value for name, value in values.items())
                cells += len(values) - 1
                numbers = [
                    f"{value:.3f}" if factor == 1.0 else f"{value:.1f}" for value in values.values()
                ]
                rows.append((log, f"{kind} {joint}", *numbers))
    caption = (
        f"RMSE of torque below {FIT_HZ:g} Hz [N m] and of position over rollouts of "
        f"{HORIZON_S:g} s [mrad]; fitted on {', '.join(FITTED)}; lower in {lower} of {cells}"
    )
    columns = ("recording", "what", *next(iter(found["errors"].values())))
    table = console.table("AK80-6: torque fit and published sets", columns, rows, caption)
    fit: TorqueFit = found["fit"]
    rows = [
        (
            joint,
            name,
            f"{one.value:.4g}",
            "{:.4g} to {:.4g}".format(*one.ci95),
            "yes" if one.identified else f"no: {one.reason}",
        )
        for joint, parameters in fit.joints.items()
        for name, one in parameters.items()
    ]
    columns = ("joint", "parameter", "value", "95 %", "identified")
    caption = f"{fit.blocks} blocks of {BLOCK_S:g} s; one armature for both actuators"
    parameters = console.table("Fitted drives", columns, rows, caption)
    return finish({**found, "lower": lower, "cells": cells}, table, parameters)
