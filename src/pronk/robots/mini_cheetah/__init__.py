"""MIT Mini Cheetah Vision, the robot of the paper (S1 to S7)."""

from __future__ import annotations

from pronk.robots.mini_cheetah import constants as c
from pronk.robots.mini_cheetah.model import build_spec
from pronk.robots.robot import Joint, Robot


def _joint(leg: str, name: str) -> Joint:
    hips = (f"{leg}_hip_roll", f"{leg}_hip_pitch")
    # The knee is asked with the thigh clamped (F6), which takes both hip joints out of play.
    knee = name == "knee"
    # Left legs mirror right ones about the x-z plane: an axis along x changes sign, one along y
    # does not. Hind legs equal front ones as long as the trunk does not move.
    sign = -1.0 if name == "hip_roll" and leg.endswith("L") else 1.0
    return Joint(
        name=f"{leg}_{name}",
        group=name,
        drive=c.drive(name),
        range=c.RANGE[name],
        default_position=c.DEFAULT_POSITION[name],
        folded_position=c.FOLDED_POSITION[name],
        stiffness=c.DRIVE_STIFFNESS,
        damping=c.DRIVE_DAMPING,
        band_hz=c.BAND_HZ[name],
        clamped=hips if knee else (),
        chain=(f"{leg}_knee",) if knee else (*hips, f"{leg}_knee"),
        mirror=None if leg == "FR" else (f"FR_{name}", sign),
    )


MINI_CHEETAH = Robot(
    name="mini_cheetah",
    joints=tuple(_joint(leg, name) for leg in c.LEGS for name in c.LEG_JOINTS),
    build_spec=build_spec,
    base_body="trunk",
)
"""Twelve joints, FR FL HR HL, each leg hip_roll, hip_pitch, knee."""

__all__ = ["MINI_CHEETAH", "build_spec"]
