"""Mode `drive` on sweeps: damping, armature, friction and delay with the stiffness known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pronk.match.drive import match_drives

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.errors import IdentifiabilityError, PronkError
from pronk.excitation.signals import Chirp
from pronk.logs.joint_log import JointLog
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
KNOWN = {"damping": 0.33, "armature": 0.0055, "frictionloss": 0.3}
LATE_S = 0.004


def sweep(joint: str, amplitudes: tuple[float, ...] = (0.25, 0.125)) -> JointLog:
    """Known drive, two amplitudes of three repeats, 0.2 mrad of noise, 4 ms late."""
    rng = np.random.default_rng(3)
    asks = [
        Excitation(offsets=Chirp(length_s=12.0, amplitude=a).samples(), repeats=3)
        for a in amplitudes
    ]
    noise = [2e-4 * rng.standard_normal(8000) for _ in range(3 * len(asks))]
    log = synthetic_log(
        ROBOT,
        joint,
        asks,
        17.0,
        KNOWN["damping"],
        armature=KNOWN["armature"],
        frictionloss=KNOWN["frictionloss"],
        noise=noise,
    )
    late = round(LATE_S * 500.0)
    position = np.concatenate([np.repeat(log.position[:1], late, axis=0), log.position[:-late]])
    return replace(log, position=position)


def test_the_drive_is_found_again() -> None:
    result = match_drives([sweep("FR_knee")], ROBOT)
    found = result.gains.joints["FR_knee"]
    assert found.stiffness == 17.0
    assert found.damping == pytest.approx(KNOWN["damping"], rel=0.02)
    assert found.armature == pytest.approx(KNOWN["armature"], rel=0.02)
    assert found.frictionloss == pytest.approx(KNOWN["frictionloss"], rel=0.05)
    assert found.delay_s == pytest.approx(LATE_S, abs=2e-4)
    low, high = found.damping_ci95
    assert low < found.damping < high
    assert found.error_db < 0.05 < 0.2 * found.naive_error_db
    assert found.flags == ()


def test_what_magnitude_and_phase_cannot_tell_is_refused_with_the_cure() -> None:
    log = sweep("FR_knee", amplitudes=(0.25,))
    everything = ("stiffness", "damping", "armature", "frictionloss", "delay")
    with pytest.raises(IdentifiabilityError) as refused:
        match_drives([log], ROBOT, free=everything)
    message = str(refused.value)
    assert message.startswith("FR_knee: ")
    for name in ("stiffness", "armature", "payload", "torque"):
        assert name in message


def test_unknown_parameters_are_refused() -> None:
    with pytest.raises(PronkError, match=r"inertia.*stiffness"):
        match_drives([sweep("FR_knee")], ROBOT, free=("damping", "inertia"))
    with pytest.raises(PronkError, match="none"):
        match_drives([sweep("FR_knee")], ROBOT, free=())
