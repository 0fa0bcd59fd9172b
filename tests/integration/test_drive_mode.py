"""Mode `drive` on sweeps: damping, armature, friction and delay with the stiffness known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.errors import IdentifiabilityError, PronkError
from pronk.excitation.signals import Chirp
from pronk.logs.joint_log import JointLog
from pronk.match import match_logs
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
KNOWN = {"damping": 0.33, "armature": 0.0055, "frictionloss": 0.3}
LATE_S = 0.004


def sweep(amplitudes: tuple[float, ...] = (0.25, 0.125)) -> JointLog:
    """Known drive of FR_knee, three repeats an amplitude, 0.2 mrad of noise, 4 ms late."""
    rng = np.random.default_rng(3)
    excitations = [
        Excitation(offsets=Chirp(length_s=12.0, amplitude=a).samples(), repeats=3)
        for a in amplitudes
    ]
    noise = [2e-4 * rng.standard_normal(8000) for _ in range(3 * len(excitations))]
    log = synthetic_log(ROBOT, "FR_knee", excitations, 17.0, noise=noise, **KNOWN)
    late = round(LATE_S * 500.0)
    position = np.concatenate([np.repeat(log.position[:1], late, axis=0), log.position[:-late]])
    return replace(log, position=position)


def test_the_drive_is_found_again() -> None:
    found = match_logs([sweep()], ROBOT, mode="drive").gains.joints["FR_knee"]
    assert found.stiffness == 17.0
    for name, rel in (("damping", 0.02), ("armature", 0.02), ("frictionloss", 0.05)):
        assert getattr(found, name) == pytest.approx(KNOWN[name], rel=rel)
    assert found.delay_s == pytest.approx(LATE_S, abs=2e-4)
    assert found.damping_ci95[0] < found.damping < found.damping_ci95[1]
    assert found.error_db < 0.05 < 0.2 * found.naive_error_db
    assert found.flags == ()


def test_what_magnitude_and_phase_cannot_tell_apart_is_refused() -> None:
    everything = ("stiffness", "damping", "armature", "frictionloss", "delay")
    with pytest.raises(IdentifiabilityError, match=r"FR_knee.*stiffness.*armature.*payload"):
        match_logs([sweep((0.25,))], ROBOT, mode="drive", free=everything)


@pytest.mark.parametrize(
    ("mode", "free", "message"),
    [
        ("drive", ("damping", "inertia"), r"inertia.*stiffness"),
        ("gains", ("damping",), "mode drive"),
        ("both", (), "gains or drive"),
    ],
)
def test_unknown_parameters_and_modes_are_refused(
    mode: str, free: tuple[str, ...], message: str
) -> None:
    with pytest.raises(PronkError, match=message):
        match_logs([sweep((0.25,))], ROBOT, mode=mode, free=free)  # type: ignore[arg-type]
