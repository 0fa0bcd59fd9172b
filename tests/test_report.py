"""The page and its figures, from a match whose numbers are known in closed form."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pronk import __version__
from pronk.match import gains as gains_file
from pronk.match import result as result_file
from pronk.match.gains import GroupGains, JointGains, MatchedGains, Simulator
from pronk.match.result import JointMatch, MatchResult
from pronk.response.response import FrequencyResponse

LEGS = ("FR", "FL", "HR", "HL")
# Inertia of leg and rotor about the joint [kg m^2] and the gains that a match finds.
GROUPS = {
    "hip_roll": (0.0300, 19.5, 0.48, (1.0, 10.0)),
    "hip_pitch": (0.0260, 17.5, 0.40, (1.0, 10.0)),
    "knee": (0.0070, 21.9, 0.54, (0.1, 15.0)),
}
NAIVE = (17.0, 0.4)


def second_order(omega, stiffness, damping, inertia, viscous=0.01):
    """The joint of the paper's equation M2 with a still target velocity."""
    s = 1j * omega
    return stiffness / (inertia * s**2 + (damping + viscous) * s + stiffness)


def error_db(measured, simulated, band):
    gap = 20.0 * np.log10(np.abs(measured) / np.abs(simulated))
    return float(np.sqrt(np.mean(gap[band] ** 2)))


def joint_match(name, leg, *, virtual=True, amplitudes=(0.25, 0.125), grid=21, seed=0):
    rng = np.random.default_rng(seed)
    inertia, stiffness, damping, band_hz = GROUPS[name]
    stiffness *= 1.0 + 0.02 * (leg - 1.5)
    omega = 2.0 * np.pi * np.arange(0.25, 22.6, 0.25)
    truth = second_order(omega, stiffness, damping, inertia)
    responses = []
    for amplitude in amplitudes:
        noise = 0.01 * (rng.normal(size=(3, omega.size)) + 1j * rng.normal(size=(3, omega.size)))
        repeats = truth * np.exp(-1j * omega * 0.002) + noise * 0.25 / amplitude
        coherence = 1.0 - 0.3 * (omega / omega[-1]) ** 3
        responses.append(
            FrequencyResponse(
                joint=f"{LEGS[leg]}_{name}",
                amplitude=amplitude,
                omega=omega,
                response=repeats.mean(axis=0),
                coherence=coherence,
                averages=np.full(omega.size, 12.0),
                repeats=repeats,
                estimator="H1",
                window="hann 4 s, 75 % overlap",
                segment_s=4.0,
                delay_s=0.002,
                third_harmonic=0.02,
                virtual=virtual,
                source="synthetic",
            )
        )
    first = responses[0]
    band = first.band(*band_hz)
    axis_k, axis_d = np.linspace(13, 27, grid), np.linspace(0.1, 0.7, grid)
    surface = np.array(
        [
            [error_db(first.response, second_order(omega, k, d, inertia), band) ** 2 for d in axis_d]
            for k in axis_k
        ]
    )
    naive = second_order(omega, *NAIVE, inertia)
    return JointMatch(
        joint=first.joint,
        responses=tuple(responses),
        grid_stiffness=axis_k,
        grid_damping=axis_d,
        grid_error=surface,
        stiffness=stiffness,
        damping=damping,
        covariance=np.array([[0.09, 0.0015], [0.0015, 1e-4]]),
        band_hz=band_hz,
        matched=truth,
        naive=naive,
        error_db=error_db(first.response, truth, band),
        naive_error_db=error_db(first.response, naive, band),
        zero_armature_error_db=2.9 if name == "knee" else float("nan"),
        zero_armature=second_order(omega, 27.0, 0.62, 0.0012) if name == "knee" else None,
        repeat_gains=np.array([[stiffness, damping]] * 3),
        amplitude_gains=np.array(
            [[0.25, stiffness, damping], [0.125, stiffness * 0.98, damping * 1.03]]
        ),
        flags=("coherence below 0.8 in part of the band",) if (name, leg) == ("knee", 3) else (),
    )


def synthetic(*, virtual: bool = True, robot: str = "mini_cheetah") -> MatchResult:
    joints = {
        f"{leg}_{name}": joint_match(name, i, virtual=virtual, seed=i)
        for i, leg in enumerate(LEGS)
        for name in GROUPS
    }
    per_joint = {
        name: JointGains(
            stiffness=m.stiffness,
            damping=m.damping,
            grid_stiffness=m.stiffness + 0.1,
            grid_damping=m.damping,
            stiffness_ci95=(m.stiffness - 0.6, m.stiffness + 0.6),
            damping_ci95=(m.damping - 0.02, m.damping + 0.02),
            covariance=((0.09, 0.0015), (0.0015, 1e-4)),
            band_hz=m.band_hz,
            error_db=m.error_db,
            naive_error_db=m.naive_error_db,
            coherence_min=0.91,
            armature=0.0063 if name.endswith("knee") else 0.0026,
            amplitude_spread=0.02,
            flags=m.flags,
        )
        for name, m in joints.items()
    }
    groups = {
        name: GroupGains(
            stiffness=round(k * 2) / 2,
            damping=round(d * 20) / 20,
            stiffness_range=2.0,
            damping_range=0.05,
            ellipsoid=((1.2, 0.0), (0.0, 0.001)),
            ellipsoid_center=(k, d),
        )
        for name, (_, k, d, _) in GROUPS.items()
    }
    gains = MatchedGains(
        robot=robot,
        simulator=Simulator(version="3.11.0"),
        joints=per_joint,
        groups=groups,
        logs={f"{name}.mcap": f"{i:064x}" for i, name in enumerate(joints)},
        virtual=virtual,
    )
    return MatchResult(
        gains=gains,
        joints=joints,
        seconds={"estimate": 1.2, "grid": 31.0, "refine": 4.0},
        grid_steps_per_second=6.1e5,
    )
