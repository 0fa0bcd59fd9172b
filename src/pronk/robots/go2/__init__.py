"""Unitree Go2: a robot that can be had, behind `--link dds`."""

from __future__ import annotations

from pronk.robots.go2 import constants as c
from pronk.robots.go2.model import build_spec
from pronk.robots.robot import Joint, Robot


def _joint(leg: str, name: str) -> Joint:
    hips = (f"{leg}_hip_roll", f"{leg}_hip_pitch")
    # As on the Mini Cheetah: the knee is asked with the thigh clamped, left legs mirror right ones.
    knee = name == "knee"
    sign = -1.0 if name == "hip_roll" and leg.endswith("L") else 1.0
    return Joint(
        name=f"{leg}_{name}",
        group=name,
        drive=c.drive(name),
        range=c.joint_range(leg, name),
        default_position=c.DEFAULT_POSITION[name],
        folded_position=c.FOLDED_POSITION[name],
        stiffness=c.DRIVE_STIFFNESS,
        damping=c.DRIVE_DAMPING,
        band_hz=c.BAND_HZ[name],
        clamped=hips if knee else (),
        chain=(f"{leg}_knee",) if knee else (*hips, f"{leg}_knee"),
        mirror=None if leg == "FR" else (f"FR_{name}", sign),
    )


GO2 = Robot(
    name="go2",
    joints=tuple(_joint(leg, name) for leg in c.LEGS for name in c.LEG_JOINTS),
    build_spec=build_spec,
    base_body="trunk",
)
"""Twelve joints, FR FL RR RL, each leg hip_roll, hip_pitch, knee (Unitree: hip, thigh, calf)."""

__all__ = ["GO2", "build_spec"]
